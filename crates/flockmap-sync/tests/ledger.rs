//! What is in flight to a peer is not sent to it again before it can have said that it is lost.

use flockmap_codec::{Batch, Codec, Encoder};
use flockmap_grid::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
use flockmap_sync::wire::{
    Datagram, DatagramHeader, Echo, Kind, OriginRange, Received, Request, is_sealed, parse_packages,
};
use flockmap_sync::{Cast, IntervalSet, Session, SessionConfig};

const MS: i64 = 1_000;
const OWN: Stream = run(1);

const fn run(robot: u16) -> Stream {
    Stream { origin: RobotId(robot), epoch: 1 }
}

/// A robot whose peers say what a test wants them to say; the round trip is `2 * DELAY`.
struct Robot {
    session: Session,
    now: i64,
}

const DELAY: i64 = 50 * MS;

impl Robot {
    fn new(config: SessionConfig) -> Self {
        Self { session: Session::new(OWN, config, 1).unwrap(), now: 0 }
    }

    /// A request of a peer arrives that left `DELAY` ago, when the peer had just heard what this robot had
    /// sent `2 * DELAY` ago. `received`: of the run of this robot; `None`: it does not name it.
    fn hears(&mut self, robot: u16, has_room: bool, received: Option<&[(u32, u32)]>) {
        let echo =
            Echo { robot: OWN.origin, epoch_low: 1, stamp_low: (self.now - 2 * DELAY) as u32, age_micros: 0 };
        let received = received.map(|received| Received {
            in_part: None,
            stream: OWN,
            is_oldest_wanted: false,
            from: 1,
            received: IntervalSet::from_intervals(64, received.to_vec()),
        });
        let request = Request {
            origins: Some(OriginRange::all_from(RobotId(0))),
            all_echoes: true,
            no_new_streams: !has_room,
            echoes: vec![echo],
            received: received.into_iter().collect(),
            ..Request::default()
        };
        let stamp = Stamp(self.now - DELAY);
        let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender: run(robot), stamp };
        self.session.handle_datagram(Stamp(self.now), &request.emit(header, 1_200)).unwrap();
        while self.session.poll_event().is_some() {}
    }

    fn publish(&mut self) {
        let end = Stamp(self.now);
        let resolution = Resolution::from_metres(0.1).unwrap();
        let batch = Batch { stream: OWN, start: end, end, resolution, sensor: [0; 3] };
        let changes = Changes::from_voxels([(Voxel::new(1, 2, 3), State::Free)]);
        let index = self.session.store().newest_known(OWN) + 1;
        let package = Encoder::new().encode_whole(Codec::Raw, &batch, index, &changes).unwrap();
        self.session.publish(end, package).unwrap();
    }

    /// The indices of the packages that go out now.
    fn sends(&mut self) -> Vec<u32> {
        let mut indices = Vec::new();
        while let Some(transmit) = self.session.poll_transmit(Stamp(self.now)) {
            assert!(!is_sealed(&transmit.bytes));
            let datagram = Datagram::new_checked(&transmit.bytes).unwrap();
            if datagram.header().kind == Kind::Packages {
                indices.extend(parse_packages(&datagram).unwrap().iter().map(|p| p.header().index));
            }
        }
        indices
    }

    fn wait(&mut self, micros: i64) {
        self.now += micros;
        self.session.handle_timeout(Stamp(self.now));
    }
}

fn broadcast() -> SessionConfig {
    SessionConfig { cast: Cast::Broadcast, ..SessionConfig::default() }
}

/// By broadcast: robot 2 has room for the run, robot 3 has none.
fn one_package_to_two_of_which_one_has_no_room() -> Robot {
    let mut robot = Robot::new(broadcast());
    robot.now = 1_000 * MS;
    for peer in [2, 3] {
        robot.hears(peer, peer == 2, None);
    }
    robot.publish();
    assert_eq!(robot.sends(), [1]);
    robot
}

#[test]
fn who_finds_room_for_a_run_is_not_sent_at_once_what_has_just_gone_out_to_everyone() {
    let mut robot = one_package_to_two_of_which_one_has_no_room();
    // Robot 3 has found room, and said so before the package came.
    robot.wait(25 * MS);
    robot.hears(3, false, Some(&[]));
    assert_eq!(robot.sends(), [0; 0]);
    // It has room for any run.
    robot.wait(25 * MS);
    robot.hears(3, true, None);
    assert_eq!(robot.sends(), [0; 0]);
    // It says so again after the package should have come.
    robot.wait(200 * MS);
    robot.hears(3, false, Some(&[]));
    assert_eq!(robot.sends(), [1]);
    assert_eq!(robot.session.counters().lost, 1);
}

#[test]
fn what_went_out_to_one_that_has_room_again_is_not_sent_at_once() {
    for cast in [Cast::Unicast, Cast::Broadcast] {
        let mut robot = Robot::new(SessionConfig { cast, ..SessionConfig::default() });
        robot.now = 1_000 * MS;
        robot.hears(2, true, None);
        robot.publish();
        assert_eq!(robot.sends(), [1], "{cast:?}");
        // Its streams are full, and it does not name this one; then it does.
        robot.wait(20 * MS);
        robot.hears(2, false, None);
        assert_eq!(robot.sends(), [0; 0], "{cast:?}");
        robot.wait(20 * MS);
        robot.hears(2, false, Some(&[]));
        assert_eq!(robot.sends(), [0; 0], "{cast:?}");
        robot.wait(60 * MS);
        robot.hears(2, false, Some(&[(1, 1)]));
        assert_eq!(robot.session.counters().confirmed, 1, "{cast:?}");
    }
}

#[test]
fn what_nobody_has_a_place_for_leaves_the_ledger_and_is_not_counted_as_lost() {
    let mut robot = one_package_to_two_of_which_one_has_no_room();
    robot.wait(300 * MS);
    robot.hears(3, false, None);
    let in_flight: Vec<usize> = robot.session.peers().map(|peer| peer.in_flight).collect();
    assert_eq!((in_flight, robot.session.counters().lost), (vec![1, 0], 0));
}

#[test]
fn a_full_ledger_keeps_what_may_still_be_under_way() {
    let mut robot = Robot::new(SessionConfig { in_flight_max: 2, ..broadcast() });
    robot.now = 1_000 * MS;
    for peer in [2, 3] {
        robot.hears(peer, true, None);
    }
    // Robot 2 is fast, and so five packages go out while nothing comes from robot 3, of which four can be noted.
    for index in 1..=5 {
        robot.publish();
        assert_eq!(robot.sends(), [index]);
        robot.wait(10 * MS);
        robot.hears(2, true, Some(&[(1, index)]));
    }
    // The first one is late: as old as half a round trip, it is not lost yet.
    robot.hears(3, true, Some(&[(2, 4)]));
    assert!(!robot.sends().contains(&1));
    robot.wait(300 * MS);
    robot.hears(3, true, Some(&[(2, 5)]));
    assert_eq!(robot.sends(), [1]);
}
