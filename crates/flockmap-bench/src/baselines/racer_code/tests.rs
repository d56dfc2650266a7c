//! What RACER's map sharing does, and what comes of it.

use flockmap::grid::{MapperConfig, Pose, Preset, Resolution, RobotId, Scan, Stamp, State, Voxel, VoxelBox};
use flockmap::sync::IntervalSet;
use flockmap_netsim::{Addressees, Datagram, Node};
use proptest::prelude::*;

use super::config::*;
use super::message::*;
use super::robot::*;

const MS: i64 = 1_000;

fn config(id: u16, robots: u16) -> RacerConfig {
    let resolution = Resolution::from_metres(0.1).unwrap();
    RacerConfig::new(RobotId(id), robots, MapperConfig::preset(Preset::OctoMap, resolution, 7.0))
}

fn robot(id: u16, robots: u16) -> RacerRobot {
    RacerRobot::new(config(id, robots), Stamp(0)).unwrap()
}

/// One ray of `length` voxels along x, in row `y`: makes so many voxels known.
fn scan(robot: &mut RacerRobot, y: i32, length: usize) {
    let end = [0.1 * length as f32 - 0.05, 0.0, 0.0];
    let scan = Scan { stamp: Stamp(1), points: vec![end], no_returns: Vec::new() };
    robot.insert_scan(&scan, &Pose::from_yaw([0.001, 0.1 * f64::from(y) + 0.05, 0.05], 0.0), &[]);
}

/// Makes rows of 50 voxels known until so many are listed.
fn list(robot: &mut RacerRobot, voxels: u64) {
    let mut y = 0;
    while robot.counters().listed < voxels {
        scan(robot, y, 50);
        y += 1;
    }
}

/// The beat of a robot: what it sends then.
fn beat(robot: &mut RacerRobot) -> Vec<Datagram> {
    robot.handle_timeout(robot.poll_timeout().unwrap());
    sent(robot)
}

/// What a robot has to send.
fn sent(robot: &mut RacerRobot) -> Vec<Datagram> {
    core::iter::from_fn(|| robot.poll_transmit(Stamp(0))).collect()
}

/// Whether a robot gets a datagram of another one.
fn is_for(datagram: &Datagram, id: u16) -> bool {
    !matches!(datagram.to, Addressees::One(to) if to != RobotId(id))
}

/// A message with the byte that says what it is.
fn datagram(topic: u8, message: &[u8]) -> Vec<u8> {
    [&[topic], message].concat()
}

/// One beat of each robot in turn, with everything delivered at once; what was sent.
fn round(robots: &mut [RacerRobot]) -> Vec<Datagram> {
    let mut all = Vec::new();
    for at in 0..robots.len() {
        let mut said: Vec<_> = beat(&mut robots[at]).into_iter().map(|transmit| (at, transmit)).collect();
        while !said.is_empty() {
            let mut answers = Vec::new();
            for (from, transmit) in said {
                for to in (0..robots.len()).filter(|to| *to != from) {
                    if is_for(&transmit, robots[to].config().id.0) {
                        robots[to].receive(&transmit.bytes).unwrap();
                        answers.extend(sent(&mut robots[to]).into_iter().map(|t| (to, t)));
                    }
                }
                all.push(transmit);
            }
            said = answers;
        }
    }
    all
}

#[test]
fn messages_have_the_sizes_of_their_serialisation() {
    let chunk = |n: usize| {
        let (addresses, states) = ((0..n as u32).collect(), vec![1; n]);
        ChunkData { from: 1, to: 2, owner: 3, index: 4, addresses, states }.emit().len()
    };
    assert_eq!((chunk(0), chunk(1), chunk(200)), (52, 57, 1_052));
    let stamps = |lists: &[usize]| {
        let set =
            |n: &usize| IntervalSet::from_intervals(0, (1..=*n as u32).map(|i| (3 * i, 3 * i)).collect());
        ChunkStamps { from: 1, held: lists.iter().map(set).collect(), time_s: 0.5 }.emit().len()
    };
    // 16 + Σ (4 + 4 m), where m bounds make m / 2 intervals.
    assert_eq!((stamps(&[]), stamps(&[1, 1]), stamps(&[0, 3])), (16, 40, 16 + 4 + 4 + 24));
    // Two robots and the place of the ground station.
    let sent = beat(&mut robot(1, 2));
    assert_eq!((sent.len(), sent[0].bytes.len()), (1, 1 + 16 + 3 * 4));
}

#[test]
fn the_tail_stays_behind_for_ever() {
    let mut robots = [robot(1, 2), robot(2, 2)];
    list(&mut robots[0], 400);
    for _ in 0..20 {
        round(&mut robots);
    }
    assert_eq!(robots[0].counters().listed, 400);
    // Only while more than 200 are pending is one cut: the second 200 stay.
    assert_eq!((robots[0].counters().chunks, robots[0].left_behind()), (1, 200));
    assert_eq!(robots[1].observed_by(RobotId(1)).len(), 200);
    scan(&mut robots[0], 100, 1);
    for _ in 0..5 {
        round(&mut robots);
    }
    assert_eq!((robots[0].left_behind(), robots[1].observed_by(RobotId(1)).len()), (1, 400));
}

#[test]
fn a_voxel_that_flips_after_its_chunk_was_sent_stays_stale() {
    let mut robots = [robot(1, 2), robot(2, 2)];
    scan(&mut robots[0], 0, 31);
    let end = Voxel::new(30, 0, 0);
    assert_eq!(robots[0].state(end), State::Occupied);
    list(&mut robots[0], 300);
    for _ in 0..5 {
        round(&mut robots);
    }
    assert_eq!(robots[1].state(end), State::Occupied);
    // What stood there has gone.
    for _ in 0..20 {
        scan(&mut robots[0], 0, 60);
    }
    list(&mut robots[0], 900);
    for _ in 0..20 {
        round(&mut robots);
    }
    assert_eq!(robots[0].state(end), State::Free);
    assert_eq!(robots[1].state(end), State::Occupied);
}

#[test]
fn states_are_those_of_the_first_transmission() {
    // It flips after its chunk is cut and before anybody asks for it: the newer state is sent.
    let mut robots = [robot(1, 2), robot(2, 2)];
    scan(&mut robots[0], 0, 31);
    list(&mut robots[0], 300);
    for _ in 0..20 {
        scan(&mut robots[0], 0, 60);
    }
    for _ in 0..5 {
        round(&mut robots);
    }
    assert_eq!(robots[1].state(Voxel::new(30, 0, 0)), State::Free);
}

#[test]
fn what_a_team_mate_sent_is_not_listed_again() {
    let mut robots = [robot(1, 2), robot(2, 2)];
    list(&mut robots[0], 300);
    for _ in 0..5 {
        round(&mut robots);
    }
    list(&mut robots[1], 100);
    assert_eq!(robots[1].counters().listed, 100, "of the first rows only the tail is new to robot 2");
    assert!(robots[1].mapper().blocks().map(|(_, block)| block.known_count()).sum::<u32>() >= 300);
}

#[test]
fn a_chunk_under_way_is_sent_again_when_the_round_trip_takes_longer_than_the_pause() {
    for (delay_beats, resent) in [(0, 0), (1, 0), (3, 3)] {
        let (mut owner, mut other) = (robot(1, 2), robot(2, 2));
        list(&mut owner, 800);
        let chunks = owner.counters().chunks;
        assert_eq!(chunks, 3);
        let mut under_way: Vec<(usize, Vec<Datagram>)> = Vec::new();
        for now in 0..20 {
            for stamps in beat(&mut other) {
                owner.receive(&stamps.bytes).unwrap();
            }
            let answers: Vec<_> = sent(&mut owner).into_iter().filter(|t| t.bytes[0] == CHUNK).collect();
            under_way.push((now + delay_beats, answers));
            under_way.retain(|(due, answers)| {
                if *due <= now {
                    answers.iter().for_each(|t| other.receive(&t.bytes).unwrap());
                }
                *due > now
            });
        }
        assert_eq!(owner.counters().chunks_resent, resent, "after {delay_beats} beats");
        assert_eq!(other.counters().duplicates, resent);
        assert_eq!(other.observed_by(RobotId(1)).len(), 600);
    }
}

#[test]
fn an_announcement_is_answered_only_every_third_time() {
    let (mut owner, mut other) = (robot(1, 2), robot(2, 2));
    list(&mut owner, 300);
    let mut answers = Vec::new();
    for _ in 0..10 {
        for stamps in beat(&mut other) {
            owner.receive(&stamps.bytes).unwrap();
        }
        answers.push(sent(&mut owner).len());
    }
    assert_eq!(answers.iter().sum::<usize>(), 10 - owner.counters().throttled as usize);
    assert!(answers.windows(3).all(|three| three.iter().sum::<usize>() <= 1), "{answers:?}");
    assert!(answers.iter().sum::<usize>() >= 3, "{answers:?}");
}

#[test]
fn a_lost_chunk_is_repaired() {
    let (mut owner, mut other) = (robot(1, 2), robot(2, 2));
    list(&mut owner, 1_100);
    for number in 0..20 {
        for stamps in beat(&mut other) {
            owner.receive(&stamps.bytes).unwrap();
        }
        for (at, transmit) in sent(&mut owner).into_iter().enumerate() {
            // Of the first answer, the second and the fourth chunk are lost.
            if number > 0 || at % 2 == 0 {
                other.receive(&transmit.bytes).unwrap();
            }
        }
        if number == 1 {
            assert_eq!(other.held(RobotId(1)).unwrap().intervals(), [(1, 1), (3, 3), (5, 5)]);
        }
    }
    assert_eq!(other.held(RobotId(1)).unwrap().intervals(), [(1, 5)]);
    assert_eq!(owner.counters().chunks_resent, 2);
}

#[test]
fn chunks_are_relayed_with_the_states_that_they_have() {
    let mut robots = [robot(1, 3), robot(2, 3), robot(3, 3)];
    list(&mut robots[0], 300);
    for _ in 0..5 {
        for pair in [0..2, 1..3] {
            let [a, b] = &mut robots[pair] else { unreachable!() };
            for _ in 0..2 {
                beat(b).iter().for_each(|t| a.receive(&t.bytes).unwrap());
                sent(a).iter().for_each(|t| b.receive(&t.bytes).unwrap());
            }
        }
    }
    let [first, second, third] = &robots;
    assert!(second.counters().chunks_relayed > 0);
    assert_eq!(third.observed_by(RobotId(1)), first.observed_by(RobotId(1)));
    assert_eq!(third.observed_by(RobotId(1)).len(), 200);
}

#[test]
fn on_a_shared_medium_everyone_takes_in_what_was_meant_for_another() {
    for (cast, overheard) in [(RacerCast::Broadcast, 200), (RacerCast::Unicast, 0)] {
        let mut robots: Vec<RacerRobot> = (1..=3)
            .map(|id| RacerRobot::new(RacerConfig { cast, ..config(id, 3) }, Stamp(0)).unwrap())
            .collect();
        list(&mut robots[0], 300);
        let [first, second, third] = robots.as_mut_slice() else { unreachable!() };
        for t in beat(second) {
            first.receive(&t.bytes).unwrap();
        }
        for t in sent(first) {
            let one = cast == RacerCast::Unicast;
            assert_eq!(t.to, if one { Addressees::One(RobotId(2)) } else { Addressees::All });
            if is_for(&t, 3) {
                third.receive(&t.bytes).unwrap();
            }
        }
        beat(third);
        assert_eq!(third.observed_by(RobotId(1)).len(), overheard);
    }
}

#[test]
fn the_new_chunks_of_an_owner_that_starts_again_are_taken_for_known() {
    let mut robots = [robot(1, 2), robot(2, 2)];
    list(&mut robots[0], 500);
    for _ in 0..5 {
        round(&mut robots);
    }
    let before = robots[1].observed_by(RobotId(1));
    robots[0] = robot(1, 2);
    // It is elsewhere now.
    for y in 500..508 {
        scan(&mut robots[0], y, 50);
    }
    assert_eq!(robots[0].counters().chunks, 1);
    for _ in 0..20 {
        round(&mut robots);
    }
    assert_eq!(robots[1].observed_by(RobotId(1)), before, "no run, so chunk 1 is known already");
    assert_eq!(robots[1].state(Voxel::new(5, 503, 0)), State::Unknown);
    // Nor does it get back what it sent before.
    assert_eq!(robots[0].state(Voxel::new(5, 0, 0)), State::Unknown);
}

#[test]
fn a_received_chunk_overwrites_what_the_robot_saw_itself() {
    let mut other = robot(2, 2);
    scan(&mut other, 0, 31);
    assert_eq!(other.state(Voxel::new(10, 0, 0)), State::Free);
    let region = other.config().region;
    let [_, size_y, size_z] = region.size();
    let address = ((10 + 1_024) * size_y + 1_024) * size_z + 512;
    let chunk = ChunkData { from: 1, to: 2, owner: 1, index: 1, addresses: vec![address], states: vec![1] };
    other.receive(&datagram(CHUNK, &chunk.emit())).unwrap();
    beat(&mut other);
    assert_eq!(other.state(Voxel::new(10, 0, 0)), State::Occupied);
    assert_eq!(other.observed_by(RobotId(1)).get(Voxel::new(10, 0, 0)), State::Occupied);
}

#[test]
fn every_voxel_of_the_grid_has_its_address_and_what_lies_outside_is_not_sent() {
    let region = VoxelBox::new(Voxel::new(-2, 0, 0), [20, 3, 4]).unwrap();
    let mut small = RacerRobot::new(RacerConfig { region, ..config(1, 2) }, Stamp(0)).unwrap();
    let chunk = |index, addresses: Vec<u32>| {
        let states = vec![0; addresses.len()];
        ChunkData { from: 2, to: 1, owner: 2, index, addresses, states }
    };
    let (all, outside) = ((0..200).collect(), vec![240]);
    small.receive(&datagram(CHUNK, &chunk(1, all).emit())).unwrap();
    small.receive(&datagram(CHUNK, &chunk(2, (200..240).collect()).emit())).unwrap();
    assert!(small.receive(&datagram(CHUNK, &chunk(3, outside).emit())).is_err());
    beat(&mut small);
    let published = small.observed_by(RobotId(2));
    assert_eq!(published.len(), 240);
    assert!(region.voxels().all(|voxel| published.get(voxel) == State::Free));
    scan(&mut small, 1, 50);
    assert_eq!(small.counters().outside, 50 - 18, "the ray leaves the grid after 18 voxels");
}

#[test]
fn a_swarm_that_cannot_work_is_named() {
    let error = RacerRobot::new(config(3, 2), Stamp(0)).err().unwrap();
    assert!(error.to_string().contains("robot 3 of 2"), "{error}");
    let region = VoxelBox::new(Voxel::new(0, 0, 0), [4_096, 4_096, 512]).unwrap();
    let error = RacerRobot::new(RacerConfig { region, ..config(1, 2) }, Stamp(0)).err().unwrap();
    assert!(error.to_string().contains("2^32"), "{error}");
}

#[test]
fn beats_go_on_at_their_pace_after_a_late_one() {
    let mut robot = robot(1, 2);
    let first = robot.poll_timeout().unwrap();
    robot.handle_timeout(first.plus_micros(-1));
    assert!(robot.poll_transmit(first).is_none());
    robot.handle_timeout(first.plus_micros(250 * MS));
    assert_eq!(robot.poll_timeout(), Some(first.plus_micros(300 * MS)));
    assert_eq!(sent(&mut robot).len(), 1);
}

#[test]
fn every_truncation_is_refused() {
    let chunk = ChunkData { from: 1, to: 2, owner: 1, index: 1, addresses: vec![5, 6], states: vec![0, 1] };
    let stamps = ChunkStamps {
        from: 1,
        held: vec![IntervalSet::from_intervals(0, vec![(1, 4), (7, 7)]), IntervalSet::new(0)],
        time_s: 0.25,
    };
    assert_eq!(ChunkData::parse(&chunk.emit()).unwrap(), chunk);
    assert_eq!(ChunkStamps::parse(&stamps.emit()).unwrap(), stamps);
    for (topic, bytes) in [(CHUNK, chunk.emit()), (STAMPS, stamps.emit())] {
        let mut robot = robot(2, 2);
        for end in 0..bytes.len() {
            let result = robot.receive(&datagram(topic, &bytes[..end]));
            let error = result.unwrap_err().to_string();
            assert!(error.starts_with("damaged message of racer-code"), "{topic} {end}: {error}");
        }
        let longer = [bytes.as_slice(), &[0]].concat();
        assert!(robot.receive(&datagram(topic, &longer)).is_err());
        assert_eq!(robot.counters().damaged, bytes.len() as u64 + 1);
    }
}

proptest! {
    #[test]
    fn garbage_never_panics_and_never_makes_more_than_it_says(
        bytes in prop::collection::vec(any::<u8>(), 0..300), flip in any::<(usize, u8)>(),
        size in 0..5_000u32,
    ) {
        let mut robot = robot(2, 2);
        list(&mut robot, 450);
        let chunk = ChunkData {
            from: 1, to: 2, owner: 1, index: 1, addresses: (0..100).collect(), states: vec![1; 100],
        };
        let held = vec![IntervalSet::from_intervals(0, vec![(1, size + 1)])];
        let stamps = ChunkStamps { from: 1, held, time_s: f64::from(size) };
        for topic in [CHUNK, STAMPS] {
            let _ = robot.receive(&datagram(topic, &bytes));
            for good in [chunk.emit(), stamps.emit()] {
                let mut bad = good;
                let at = flip.0 % bad.len();
                bad[at] ^= flip.1;
                let _ = robot.receive(&datagram(topic, &bad));
            }
        }
        beat(&mut robot);
        prop_assert!(robot.observed_by(RobotId(1)).len() <= 100);
        prop_assert!(robot.observed_by(RobotId(2)).len() <= 400);
    }
}
