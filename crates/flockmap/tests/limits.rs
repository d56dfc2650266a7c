//! Poses that are none, places beyond the grid, and stamps far off: refused with an error that says so, or right.

use flockmap::codec::{Encoder, PACKAGE_BYTES_MAX};
use flockmap::grid::Layer;
use flockmap::sync::wire::{DatagramHeader, Kind, PackagesWriter};
use flockmap::{
    Batch, Changes, Codec, Event, Pose, PoseError, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp,
    State, Stream, Voxel,
};
use proptest::prelude::*;

const SECOND: i64 = 1_000_000;

fn resolution() -> Resolution {
    Resolution::from_metres(0.1).unwrap()
}

fn robot(id: u16, now: Stamp) -> Robot {
    Robot::new(RobotConfig::new(RobotId(id), resolution(), 7.0), now).unwrap()
}

/// A wall across the x axis.
fn wall(stamp: Stamp, x: f32) -> Scan {
    let points = (-10..=10).map(|j| [x, 0.1 * j as f32, 0.05]).collect();
    Scan { stamp, points, no_returns: Vec::new() }
}

/// Two robots and a radio without loss. Their clocks show the same.
struct Pair {
    robots: [Robot; 2],
    now: Stamp,
}

impl Pair {
    fn new() -> Self {
        let mut pair = Self { robots: [1, 2].map(|id| robot(id, Stamp(0))), now: Stamp(0) };
        pair.run(SECOND);
        pair
    }

    fn run(&mut self, micros: i64) {
        let end = self.now.plus_micros(micros);
        while self.now < end {
            self.now = self.now.plus_micros(20_000);
            let [a, b] = &mut self.robots;
            for robot in [&mut *a, &mut *b] {
                robot.handle_timeout(self.now);
            }
            for (from, to) in [(0, 1), (1, 0)] {
                while let Some(transmit) = self.robots[from].poll_transmit(self.now) {
                    self.robots[to].handle_datagram(self.now, &transmit.bytes).unwrap();
                }
            }
            self.robots.iter_mut().for_each(|robot| while robot.poll_event().is_some() {});
        }
    }

    fn scan(&mut self, number: usize, scan: &Scan) {
        self.robots[number].insert_scan(self.now, scan, &Pose::IDENTITY).unwrap();
    }

    /// The voxels of the first robot that the second holds otherwise, or not at all.
    fn differing(&mut self) -> Vec<Voxel> {
        self.robots[0].flush(self.now);
        self.run(5 * SECOND);
        let [a, b] = &self.robots;
        let nothing = Layer::default();
        let layer = b.fusion().layer(a.own_stream()).unwrap_or(&nothing);
        let all = Changes::from_blocks(a.mapper().blocks().map(|(index, block)| (index, *block)).collect());
        all.voxels().filter(|(voxel, state)| layer.state(*voxel) != *state).map(|(voxel, _)| voxel).collect()
    }
}

#[test]
fn what_is_no_pose_or_lies_beyond_the_grid_is_refused_and_nothing_changes() {
    let mut pair = Pair::new();
    let now = pair.now;
    pair.scan(0, &wall(now, 3.0));
    pair.run(3 * SECOND);
    let turned = Pose::from_yaw([1.0, 2.0, 0.0], 0.5);
    let robot = &mut pair.robots[1];
    robot.set_alignment(RobotId(1), &turned).unwrap();
    robot.finish_rebuild();
    let before: Vec<_> = robot.map().voxels().collect();
    assert!(before.iter().any(|(_, state)| *state == State::Occupied));
    let none = [
        Pose::from_translation([f64::NAN, 0.0, 0.0]),
        Pose::from_yaw([1.0, 0.0, 0.0], f64::NAN),
        Pose::from_translation([1e300, 0.0, 0.0]),
        Pose::from_translation([0.0, f64::INFINITY, 0.0]),
        Pose::new([1.7e308, 1.7e308, 0.0], [0.0, 0.0, 0.382, 0.924]).unwrap(),
        Pose::from_translation([26_843_545.0, 0.0, 0.0]),
    ];
    let later = pair.now.plus_micros(SECOND);
    for pose in &none {
        let counters = *robot.counters();
        let said = robot.set_alignment(RobotId(1), pose).unwrap_err();
        let texts = [
            "is not finite: give no pose",
            "beyond the grid, which at voxels of 0.1 m goes to ±26843443.2 m",
        ];
        assert!(texts.iter().any(|text| said.to_string().contains(text)), "{said}");
        let same = robot.insert_scan(later, &wall(later, 2.0), pose).unwrap_err();
        assert_eq!(format!("{same:?}"), format!("{said:?}"));
        let place = robot.set_teammate(RobotId(7), pose.translation(), later);
        assert!(place.is_err() || matches!(said, PoseError::Rotation(_)), "{pose:?}");
        assert_eq!(*robot.counters(), counters);
        assert_eq!(robot.mapper().block_count(), 0);
        assert_eq!(robot.map().voxels().collect::<Vec<_>>(), before);
    }
    // The first robot's wall is still where its alignment was.
    robot.set_alignment(RobotId(1), &turned).unwrap();
    assert!(!robot.is_rebuilding());
    assert_eq!(robot.map().voxels().collect::<Vec<_>>(), before);
}

#[test]
fn a_scan_stamped_at_the_end_of_time_counts_as_made_now_and_no_voxel_differs() {
    for stamp in [Stamp(i64::MAX), Stamp(i64::MAX - 1), Stamp(i64::MIN), Stamp(i64::MIN / 2), Stamp(SECOND)] {
        let mut pair = Pair::new();
        pair.scan(0, &wall(stamp, 3.0));
        pair.run(2 * SECOND);
        for step in 0..60 {
            let now = pair.now;
            pair.scan(0, &wall(now, 5.0));
            if step % 5 == 0 {
                pair.run(SECOND / 5);
            }
        }
        assert_eq!(pair.differing(), [], "first scan stamped {stamp:?}");
        let robot = &pair.robots[0];
        assert_eq!(robot.counters().scans_ahead, u64::from(stamp > Stamp(SECOND)));
        let newest = robot.fusion().layer(robot.own_stream()).unwrap().newest().unwrap();
        assert!(newest <= pair.now, "{newest:?} at {:?}", pair.now);
    }
}

#[test]
fn a_stamp_ahead_of_the_clock_hides_nothing_from_a_team_mate() {
    for ahead in [0, 9_900_000, 3_600 * SECOND, i64::MAX] {
        let mut pair = Pair::new();
        pair.robots[0].set_clock_offset(RobotId(2), Some(0));
        pair.robots[1].set_clock_offset(RobotId(1), Some(0));
        let now = pair.now;
        pair.scan(
            0,
            &Scan { stamp: now.plus_micros(ahead), points: vec![[0.5, 0.0, 0.05]], no_returns: vec![] },
        );
        pair.run(SECOND);
        for _ in 0..5 {
            let now = pair.now;
            pair.scan(0, &wall(now, 5.0));
            pair.run(SECOND / 5);
        }
        pair.run(4 * SECOND);
        let place = [3.05, 0.05, 0.05];
        assert_eq!(pair.robots[1].map().state_at(place), State::Free, "the first robot saw that it is free");
        let now = pair.now;
        pair.scan(1, &wall(now, 3.0));
        assert_eq!(pair.robots[1].map().state_at(place), State::Occupied, "{ahead} µs ahead");
    }
}

/// A team-mate that stamps as it likes.
struct Faulty {
    stream: Stream,
    next: u32,
}

impl Faulty {
    fn send(&mut self, robot: &mut Robot, now: Stamp, stamp: Stamp, voxels: &[(Voxel, State)]) {
        let batch =
            Batch { stream: self.stream, start: stamp, end: stamp, resolution: resolution(), sensor: [0; 3] };
        let changes = Changes::from_voxels(voxels.iter().copied());
        let packages = Encoder::new()
            .encode_batch(Codec::Paper, &batch, self.next, &changes, PACKAGE_BYTES_MAX)
            .unwrap();
        self.next += packages.len() as u32;
        let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender: self.stream, stamp: now };
        let mut writer = PackagesWriter::new(header, 1_200);
        assert!(packages.iter().all(|package| writer.push(package)));
        robot.handle_datagram(now, &writer.finish()).unwrap();
    }
}

#[test]
fn a_faulty_team_mate_hides_nothing_either_whatever_its_clock_is_taken_for() {
    let place = Voxel::new(30, 0, 0);
    for ahead in [0, 9_900_000, 3_600 * SECOND, i64::MAX] {
        for [offset, then] in [[0, 0], [7_200 * SECOND, 0], [0, -7_200 * SECOND], [i64::MIN, i64::MAX]] {
            let (mut robot, now) = (robot(2, Stamp(0)), Stamp(100 * SECOND));
            let mut faulty = Faulty { stream: Stream { origin: RobotId(1), epoch: 1 }, next: 1 };
            robot.set_clock_offset(RobotId(1), Some(offset));
            let stamp = now.plus_micros(offset).plus_micros(ahead);
            faulty.send(&mut robot, now, stamp, &[(place, State::Free), (Voxel::new(31, 0, 0), State::Free)]);
            assert_eq!(robot.map().state(place), State::Free);
            robot.set_clock_offset(RobotId(1), Some(then));
            robot.finish_rebuild();
            let report = robot.insert_scan(now, &wall(now, 3.05), &Pose::IDENTITY).unwrap();
            assert_eq!(report.stamp, now);
            let at = || format!("{ahead} µs ahead of a clock that is {offset} µs ahead, and {then} later");
            assert_eq!(robot.map().state(place), State::Occupied, "{}", at());
            // Made from scratch, the map is the same.
            let kept: Vec<_> = robot.map().voxels().collect();
            for is_muted in [true, false] {
                robot.set_muted(RobotId(1), is_muted);
                robot.finish_rebuild();
            }
            assert_eq!(robot.map().voxels().collect::<Vec<_>>(), kept, "{}", at());
        }
    }
}

#[test]
fn what_a_former_run_saw_hides_nothing_when_the_clock_begins_anew() {
    let mut former = robot(1, Stamp(0));
    let late = Stamp(5_000 * SECOND);
    former.insert_scan(late, &wall(late, 5.0), &Pose::IDENTITY).unwrap();
    former.flush(late);
    // After the start the clock shows 0 again.
    let mut config = RobotConfig::new(RobotId(1), resolution(), 7.0);
    config.epoch = 2;
    let mut again = Robot::new(config, Stamp(0)).unwrap();
    while let Some(event) = former.poll_event() {
        let Event::BatchClosed { packages, .. } = event else { continue };
        packages.into_iter().for_each(|package| again.restore(Stamp(0), package).unwrap());
    }
    let place = Voxel::new(30, 0, 0);
    assert_eq!(again.map().state(place), State::Free);
    let now = Stamp(SECOND);
    again.insert_scan(now, &wall(now, 3.05), &Pose::IDENTITY).unwrap();
    assert_eq!(again.map().state(place), State::Occupied);
}

#[test]
fn a_team_mate_seen_in_the_future_is_taken_for_one_as_long_as_any_other() {
    for seen in [Stamp(0), Stamp(3_600 * SECOND), Stamp(i64::MAX)] {
        let mut robot = robot(1, Stamp(0));
        robot.set_teammate(RobotId(2), [3.0, 0.0, 0.0], seen).unwrap();
        let mut masked = |at: Stamp| {
            let scan = Scan { stamp: at, points: vec![[2.9, 0.1, 0.1]], no_returns: Vec::new() };
            robot.insert_scan(at, &scan, &Pose::IDENTITY).unwrap().masked
        };
        assert_eq!(masked(Stamp(SECOND / 10)), 1);
        assert_eq!(masked(Stamp(3 * SECOND)), 0, "seen at {seen:?}");
    }
}

#[test]
fn a_clock_that_is_set_back_stands_still_until_it_has_come_up_again() {
    let mut pair = Pair::new();
    let now = pair.now;
    pair.scan(0, &wall(now, 3.0));
    pair.run(SECOND);
    let back = Stamp(pair.now.0 - 500_000);
    let report = pair.robots[0].insert_scan(back, &wall(pair.now, 5.0), &Pose::IDENTITY).unwrap();
    assert_eq!(report.stamp, pair.now, "not ahead of the clock, which stands still");
    assert_eq!(pair.robots[0].counters().scans_ahead, 0);
    assert_eq!(pair.differing(), []);
}

fn stamp() -> impl Strategy<Value = i64> {
    let special = vec![i64::MIN, i64::MIN + 1, -1, 0, i64::MAX - 1, i64::MAX];
    prop_oneof![4 => -5 * SECOND..20 * SECOND, 1 => any::<i64>(), 1 => prop::sample::select(special)]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    /// Whatever the stamps: the others hold what the robot has, and what it sees last is what its own fused
    /// map shows.
    #[test]
    fn stamps_of_all_kinds_make_no_voxel_differ(
        scans in prop::collection::vec((0..2usize, stamp(), 1.0..6.5f32, 0..SECOND), 1..14),
    ) {
        let mut pair = Pair::new();
        for (number, stamp, x, pause) in scans {
            let now = pair.now;
            pair.scan(number, &wall(Stamp(stamp), x));
            pair.scan(number, &wall(now, x));
            let robot = &pair.robots[number];
            // It was seen now: nothing that came before is newer.
            for (index, block) in robot.mapper().blocks() {
                let seen = Changes::from_blocks(vec![(index, *block)]);
                for (voxel, state) in seen.voxels() {
                    if robot.mapper().last_seen(voxel) == Some(now) {
                        prop_assert_eq!(robot.map().state(voxel), state, "{:?}", voxel);
                    }
                }
            }
            pair.run(pause);
        }
        prop_assert_eq!(pair.differing(), []);
        pair.robots.reverse();
        prop_assert_eq!(pair.differing(), []);
    }
}
