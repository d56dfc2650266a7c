//! Two robots over UDP with `std` alone: `cargo run -p flockmap --example two_over_udp`.
//!
//! Each robot has a thread, a socket and a clock of its own, and knows the address of the other one. On two
//! computers [`fly`] is the same; only that there is no [`Board`] that tells when both are done.
//!
//! A robot for real has more to it (names, broadcast, IPv6, a sensor, a disk): that is `flockmap node`.

use std::collections::BTreeMap;
use std::error::Error;
use std::net::{SocketAddr, UdpSocket};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use flockmap::{
    Destination, Path, Pose, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp, Stream, epoch,
};

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

/// Each robot takes so many scans, one every tenth of a second.
const SCANS: i64 = 20;
const SCAN_MICROS: i64 = 100_000;

/// Robots that do not agree by then never will.
const PATIENCE: Duration = Duration::from_secs(120);

/// What each robot that has mapped all holds: a digest of every layer.
type Board = Mutex<BTreeMap<u16, BTreeMap<Stream, u64>>>;

fn main() -> Result<()> {
    // Port 0: the system chooses one.
    let [one, two] = [UdpSocket::bind("127.0.0.1:0")?, UdpSocket::bind("127.0.0.1:0")?];
    let [at_one, at_two] = [one.local_addr()?, two.local_addr()?];
    let board = Board::default();
    std::thread::scope(|scope| {
        let second = scope.spawn(|| fly(2, &two, &[at_one], &board));
        fly(1, &one, &[at_two], &board)?;
        second.join().map_err(|_| "the second robot panicked")?
    })?;
    println!("both robots hold the same layers");
    Ok(())
}

/// One robot, and those it talks to.
fn fly(id: u16, socket: &UdpSocket, others: &[SocketAddr], board: &Board) -> Result<()> {
    let resolution = Resolution::from_metres(0.2).ok_or("no side of a voxel")?;
    let mut config = RobotConfig::new(RobotId(id), resolution, 20.0);
    // Another one for every run. Random bits (the crate `getrandom`) are better than these nanoseconds.
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH)?;
    config.epoch = epoch(since_1970.as_secs() as u32, since_1970.subsec_nanos());
    // The robot's clock: microseconds since it began. The others have clocks of their own.
    let began = Instant::now();
    let clock = || Stamp(began.elapsed().as_micros() as i64);
    let mut robot = Robot::new(config, clock())?;

    let mut buffer = [0; 2_048];
    let mut scans = 0;
    while !is_agreed(id, &robot, scans, board) {
        // What is due now.
        let now = clock();
        if scans < SCANS && now.0 >= scans * SCAN_MICROS {
            let (scan, pose) = sense(id, now)?;
            robot.insert_scan(now, &scan, &pose)?;
            scans += 1;
        }
        if robot.poll_timeout().is_some_and(|due| due <= now) {
            robot.handle_timeout(now);
        }

        // All that is to be sent. A path is a number that stands for an address: here, its place in the list.
        while let Some(transmit) = robot.poll_transmit(now) {
            let to = match (transmit.to, transmit.path) {
                (Destination::Everyone, _) => others,
                (Destination::Peer(_), Some(Path(place))) => &others[place as usize..][..1],
                (Destination::Peer(_), None) => &[],
            };
            for address in to {
                // What does not go out is lost, and repaired as everything that is lost.
                let _ = socket.send_to(&transmit.bytes, address);
            }
        }

        // Wait for a datagram, but not longer than until the robot or the sensor has something to do.
        let next_scan = (scans < SCANS).then_some(Stamp(scans * SCAN_MICROS));
        let due = [robot.poll_timeout(), next_scan].into_iter().flatten().min();
        let wait = due.map_or(Duration::MAX, |due| due.since(clock()));
        // Not 0, which would mean for ever.
        socket.set_read_timeout(Some(wait.clamp(Duration::from_millis(1), Duration::from_millis(100))))?;
        // An error is that nothing came, or that the other one is not there yet.
        if let Ok((length, from)) = socket.recv_from(&mut buffer)
            && let Some(place) = others.iter().position(|other| *other == from)
        {
            // Datagrams that are damaged or of strangers are counted, and change nothing.
            let _ = robot.handle_datagram_from(clock(), Path(place as u64), &buffer[..length]);
        }
        if began.elapsed() > PATIENCE {
            return Err(format!("robot {id} has waited for {PATIENCE:?}").into());
        }
    }
    let (free, occupied) = robot.map().count();
    println!("robot {id} knows {free} free and {occupied} occupied voxels");
    Ok(())
}

/// A wall on each side of a street: the robot flies along it and sees only one of them.
fn sense(id: u16, now: Stamp) -> Result<(Scan, Pose)> {
    let left = if id == 1 { 5.0 } else { -5.0 };
    let points = (-40..=40).flat_map(|x| (-5..=5).map(move |z| [x as f32 * 0.2, left, z as f32 * 0.2]));
    let scan = Scan { stamp: now, points: points.collect(), no_returns: Vec::new() };
    let pose = Pose::new([now.seconds(), 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]).ok_or("no pose")?;
    Ok((scan, pose))
}

/// Whether both robots have mapped all and hold the same; notes what this one holds.
fn is_agreed(id: u16, robot: &Robot, scans: i64, board: &Board) -> bool {
    if scans < SCANS || robot.unpublished() > 0 {
        return false;
    }
    let layers = robot.fusion().layers().map(|(stream, layer)| (stream, layer.digest()));
    let mut board = board.lock().unwrap_or_else(PoisonError::into_inner);
    board.insert(id, layers.collect());
    board.len() == 2 && board[&1] == board[&2]
}

#[test]
fn it_runs() {
    main().unwrap();
}
