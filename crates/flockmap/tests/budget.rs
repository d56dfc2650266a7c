//! Where the radio takes less than the map changes: what waits is merged in the map, obstacles go on, and in
//! the end all is published.

mod common;

use common::{Radio, Random, Swarm, config, scan};
use flockmap::sync::IntervalSet;
use flockmap::sync::wire::{DatagramHeader, Echo, Kind, OriginRange, Received, Request};
use flockmap::{BatchConfig, Event, Pose, Robot, RobotConfig, RobotId, SessionConfig, Stamp, State, Stream};

const LOSSY: Radio = Radio { loss: 0.2, duplication: 0.0, damage: 0.0, delay_ms: (20.0, 20.0) };

fn thin(id: u16, bytes_per_s: Option<u32>) -> RobotConfig {
    let mut config = config(id);
    config.session = SessionConfig { radio_bytes_per_s: bytes_per_s, ..config.session };
    config.batch =
        BatchConfig { publish_period_ms: 1_000, obstacle_period_ms: Some(100), ..BatchConfig::default() };
    config
}

fn pose(step: i32) -> Pose {
    Pose::from_translation([f64::from(step) * 0.1, 0.0, 0.0])
}

/// Two robots that look into ever new rooms for so many steps of 100 ms; the ages in milliseconds, sorted, at
/// which the second one got obstacles of the first.
fn fly(swarm: &mut Swarm, seed: u64, steps: i32) -> Vec<i64> {
    let mut random = Random(seed);
    let (mut ages, mut seen) = (Vec::new(), 0);
    for step in 0..steps {
        for robot in 0..2 {
            let scan = scan(&mut random, swarm.now);
            swarm.scan(robot, &scan, &pose(step));
        }
        for _ in 0..10 {
            swarm.run(10);
            for event in &swarm.events[1][seen..] {
                if let Event::Merged { batch_end, changes, .. } = event {
                    let count = changes.voxels().filter(|(_, state)| *state == State::Occupied).count();
                    ages.extend(std::iter::repeat_n(swarm.now.micros_since(*batch_end) / 1_000, count));
                }
            }
            seen = swarm.events[1].len();
        }
    }
    ages.sort_unstable();
    ages
}

#[test]
fn obstacles_stay_fresh_where_the_radio_takes_half_of_what_the_map_needs() {
    let mut late = Vec::new();
    for seed in 0..5 {
        let mut free = Swarm::new(vec![thin(1, None), thin(2, None)], common::PERFECT, seed);
        fly(&mut free, seed, 200);
        assert_eq!(free.robots[0].counters().batches_deferred, 0, "without a budget nothing is deferred");
        let needed = free.bytes / 2 / 20;
        let mut swarm =
            Swarm::new(vec![thin(1, Some(needed as u32 / 2)), thin(2, Some(needed as u32 / 2))], LOSSY, seed);
        let ages = fly(&mut swarm, seed, 200);
        let (median, almost_all) = (ages[ages.len() / 2], ages[ages.len() * 9 / 10]);
        // One loss at the wrong moment delays all that builds on it: of single flights less is asked than of
        // most.
        assert!(median < 2_500 && almost_all < 8_000, "seed {seed}: {median} and {almost_all} ms");
        late.push(almost_all);
        let counters = *swarm.robots[0].counters();
        assert!(counters.batches_deferred > 0 && counters.batches_in_parts > 0, "seed {seed}: {counters:?}");
        assert!(swarm.robots[0].unpublished() > 0, "seed {seed}: what is left out can be counted");
        swarm.settle(300_000);
        assert!(swarm.agrees(), "seed {seed}");
        swarm.assert_layers_equal_own_maps(seed);
    }
    late.sort_unstable();
    assert!(late[2] < 4_000, "nine of ten obstacles come within {late:?} ms");
}

#[test]
fn who_never_has_enough_cannot_hold_back_the_map_of_the_others() {
    let peer = Stream { origin: RobotId(9), epoch: 1 };
    let mut config = thin(1, None);
    config.session.link_bytes_per_s = Some(4_000);
    let mut robot = Robot::new(config, Stamp(0)).unwrap();
    let (own, mut random) = (robot.own_stream(), Random(5));
    let mut published = Vec::new();
    for ms in 0..40_000 {
        let now = Stamp(ms * 1_000);
        if ms % 100 == 0 {
            robot.insert_scan(now, &scan(&mut random, now), &pose(ms as i32 / 100)).unwrap();
            // It hears this robot, and states that it holds all but the newest five, again and again.
            let newest = robot.session().received(own).and_then(|received| received.last()).unwrap_or(0);
            let received = IntervalSet::from_intervals(4, vec![(1, newest.max(6) - 5)]);
            let received = (newest > 5).then_some(Received {
                in_part: None,
                is_oldest_wanted: false,
                stream: own,
                from: 1,
                received,
            });
            let echo = Echo { robot: own.origin, epoch_low: 1, stamp_low: 0, age_micros: 0 };
            let request = Request {
                origins: Some(OriginRange::all_from(RobotId(0))),
                all_echoes: true,
                echoes: vec![echo],
                received: received.into_iter().collect(),
                ..Request::default()
            };
            let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender: peer, stamp: now };
            let bytes = request.emit(header, 1_200);
            robot.handle_datagram(now, &bytes).unwrap();
        }
        if robot.poll_timeout().is_some_and(|at| at <= now) {
            robot.handle_timeout(now);
        }
        while robot.poll_transmit(now).is_some() {}
        while let Some(event) = robot.poll_event() {
            if let Event::BatchClosed { .. } = event {
                published.push(ms);
            }
        }
    }
    let longest = published.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap();
    assert!(robot.counters().batches_deferred > 5, "{:?}", robot.counters());
    assert!(longest <= 2_200, "nothing was published for {longest} ms");
}
