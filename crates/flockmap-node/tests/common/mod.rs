//! What the tests of nodes share.
#![allow(missing_docs, reason = "tests")]
#![allow(dead_code, reason = "each test uses a part of it")]

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use flockmap::{Pose, Resolution, RobotConfig, RobotId, Scan, Stamp};
use flockmap_io::RecordWriter;
use flockmap_node::{Frame, Frames, UdpOptions, UdpSockets};
use flockmap_worlds::{Flight, Lidar, ScanOptions, Trajectory, TrajectoryOptions, World};

/// Far more than any step of a test takes.
pub(crate) const PATIENCE: Duration = Duration::from_secs(40);

pub(crate) fn config(id: u16) -> RobotConfig {
    let mut config = RobotConfig::new(RobotId(id), Resolution::from_metres(0.2).unwrap(), 7.0);
    config.batch.publish_period_ms = 100;
    config
}

pub(crate) fn loopback() -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], 0))
}

/// Sockets of so many robots that know each other.
pub(crate) fn swarm(count: usize) -> Vec<UdpSockets> {
    let mut sockets: Vec<UdpSockets> =
        (0..count).map(|_| UdpSockets::bind(&UdpOptions::new(loopback())).unwrap()).collect();
    let addresses: Vec<SocketAddr> = sockets.iter().map(|s| s.local_addr().unwrap()).collect();
    for (own, sockets) in sockets.iter_mut().enumerate() {
        for (_, &address) in addresses.iter().enumerate().filter(|(other, _)| *other != own) {
            sockets.add_peer(address);
        }
    }
    sockets
}

/// What a robot sees that goes along x through a corridor; `robot` shifts where it begins. Ten scans a second.
pub(crate) fn corridor(robot: u16, scans: usize) -> impl Iterator<Item = Frame> + Send {
    (0..scans).map(move |k| {
        let x = f64::from(robot) * 3.0 + 0.1 * k as f64;
        let wall = |side: f32| {
            (-30..30).flat_map(move |a| (-4..4).map(move |z| [a as f32 * 0.2, side, z as f32 * 0.2]))
        };
        let points = wall(2.1).chain(wall(-2.1)).collect();
        let scan = Scan { stamp: Stamp(1_000_000 + k as i64 * 100_000), points, no_returns: Vec::new() };
        Frame { scan, t_map_sensor: Pose::from_translation([x, 0.0, 1.0]), points_dropped: 0 }
    })
}

pub(crate) fn frames(frames: impl Iterator<Item = Frame> + Send + 'static) -> Frames {
    Frames::new(frames.map(Ok))
}

/// Waits until `is_so`; panics after far too long.
pub(crate) fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let began = Instant::now();
    while !is_so() {
        assert!(began.elapsed() < PATIENCE, "waited in vain until {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

pub(crate) type Shared<T> = Arc<std::sync::Mutex<T>>;

pub(crate) fn new_dir(name: &str) -> PathBuf {
    let dir = std::env::temp_dir().join(format!("flockmap-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&dir).unwrap();
    dir
}

/// A short flight through an office, thinned, as a record.
pub(crate) fn write_record(dir: &Path, seconds: f64) {
    let world = Arc::new(World::indoor(1));
    let options = TrajectoryOptions { duration_s: seconds, ..TrajectoryOptions::default() };
    let scan = ScanOptions { range_m: 7.0, ..ScanOptions::default() };
    let trajectory = Trajectory::plan(&world, 1, 1, &options).unwrap().remove(0);
    let mut writer = RecordWriter::create(dir.join("robot1.mcap"), "robot1").unwrap();
    for frame in Flight::new(world, Lidar::Mid360, scan, trajectory).step_by(2) {
        writer.write(&frame.scan, &frame.t_map_sensor).unwrap();
    }
    writer.finish().unwrap();
}
