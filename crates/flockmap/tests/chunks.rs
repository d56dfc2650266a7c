//! Snapshots whose chunks build on one another, over radios that lose and reorder them.

mod common;

use common::{PERFECT, Radio, Random, Swarm, config, scan};
use flockmap::codec::Encoder;
use flockmap::codec::{Content, ContentKind, Span};
use flockmap::grid::{Snapshot, SnapshotVoxels};
use flockmap::sync::wire::{DatagramHeader, Kind, PackagesWriter};
use flockmap::{
    Changes, Codec, Event, Package, Pose, Robot, RobotConfig, RobotId, Stamp, State, Stream, Voxel,
};

const LOSSY: Radio = Radio { loss: 0.2, duplication: 0.1, damage: 0.02, delay_ms: (5.0, 80.0) };

/// The first robot has explored alone; who misses more than a few packages gets the snapshot.
fn explored(codec: Codec, radio: Radio, seed: u64, robots: u16) -> Swarm {
    let configs = (1..=robots).map(|id| {
        let mut config = RobotConfig { codec, ..config(id) };
        config.session.snapshot_range_max = Some(5);
        config
    });
    let mut swarm = Swarm::new(configs.collect(), radio, seed);
    swarm.cut = (1..robots.into()).map(|other| (0, other)).collect();
    let mut random = Random(seed);
    for tick in 0..80 {
        let at = [f64::from(tick) * 0.05, 0.0, 0.0];
        let scan = scan(&mut random, swarm.now);
        swarm.scan(0, &scan, &Pose::from_yaw(at, random.unit()));
        swarm.run(100);
    }
    swarm.robots[0].flush(swarm.now);
    swarm
}

#[test]
fn a_late_joiner_catches_up_over_a_bad_radio_by_chunks_in_their_order() {
    for seed in 1..=4 {
        let mut swarm = explored(Codec::Flock, LOSSY, seed, 3);
        swarm.cut.clear();
        swarm.settle(60_000);
        assert!(swarm.agrees(), "seed {seed}");
        swarm.assert_layers_equal_own_maps(seed);
        let caught_up =
            |robot: usize| swarm.events[robot].iter().any(|e| matches!(e, Event::CaughtUp { .. }));
        assert!(caught_up(1) || caught_up(2), "seed {seed}: by a snapshot");
        let waited: u64 = [1, 2].map(|robot| swarm.robots[robot].session().counters().waited).iter().sum();
        let [first, second] = [1, 2].map(|robot| *swarm.robots[robot].counters());
        assert!(waited > 0, "seed {seed}: chunks came out of order");
        assert_eq!(first.damaged + second.damaged, 0, "seed {seed}");
    }
}

#[test]
fn a_snapshot_of_noise_takes_no_more_than_the_papers() {
    let bytes = [Codec::Flock, Codec::Paper].map(|codec| {
        // In one place, walls that come and go: what is left of each batch has no pattern.
        let mut swarm = Swarm::new(vec![config(1)], PERFECT, 7);
        let mut random = Random(7);
        for _ in 0..300 {
            let scan = scan(&mut random, swarm.now);
            swarm.scan(0, &scan, &Pose::IDENTITY);
            swarm.run(100);
        }
        let robot = &swarm.robots[0];
        let state = robot.fusion().layer(robot.own_stream()).unwrap().snapshot().unwrap();
        assert!(!state.sensors.is_empty());
        let resolution = common::resolution();
        let chunks = Encoder::new().encode_snapshot(codec, robot.own_stream(), 9, resolution, &state, 1_150);
        chunks.unwrap().iter().map(|chunk| chunk.bytes().len()).sum::<usize>()
    });
    println!("{bytes:?} B");
    assert!(bytes[0] <= bytes[1], "{bytes:?} B");
}

/// The chunks of a snapshot, as a robot of that name sends them.
fn give(robot: &mut Robot, sender: u16, now: Stamp, chunks: &[&Package]) {
    for chunk in chunks {
        let sender = Stream { origin: RobotId(sender), epoch: 1 };
        let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender, stamp: now };
        let mut writer = PackagesWriter::new(header, 1_200);
        assert!(writer.push(chunk));
        robot.handle_datagram(now, &writer.finish()).unwrap();
    }
    // What waited for one may be more than it has time for at once.
    while robot.session().has_events() {
        robot.handle_timeout(now);
    }
}

/// A snapshot with its chunks, and a robot that knows nothing.
fn chunks(seed: u64) -> (Vec<Package>, u64, Robot) {
    let swarm = explored(Codec::Flock, PERFECT, seed, 1);
    let robot = &swarm.robots[0];
    let layer = robot.fusion().layer(robot.own_stream()).unwrap();
    let state = layer.snapshot().unwrap();
    let resolution = common::resolution();
    let chunks = Encoder::new().encode_snapshot(Codec::Flock, robot.own_stream(), 9, resolution, &state, 600);
    let chunks = chunks.unwrap();
    assert!(chunks.len() > 9 && chunks.iter().all(|chunk| chunk.header().codec == Codec::Flock));
    (chunks, layer.digest(), Robot::new(config(9), swarm.now).unwrap())
}

#[test]
fn chunks_backwards_from_two_robots_are_merged_when_the_first_comes() {
    let (chunks, digest, mut bob) = chunks(3);
    let stream = chunks[0].header().stream;
    let now = Stamp(60_000_000);
    let backwards: Vec<&Package> = chunks.iter().rev().collect();
    let (first, later) = backwards.split_last().unwrap();
    give(&mut bob, 1, now, later);
    give(&mut bob, 2, now, later);
    assert_eq!(bob.counters().merged, 0);
    give(&mut bob, 2, now, &[*first]);
    assert_eq!(bob.counters().merged as usize, chunks.len());
    assert_eq!(bob.fusion().layer(stream).unwrap().digest(), digest);
    assert!(bob.session().received(stream).unwrap().contains_range(1, 9));
}

#[test]
fn a_damaged_chunk_makes_the_snapshot_begin_again_and_does_no_harm() {
    let (chunks, digest, mut bob) = chunks(4);
    let stream = chunks[0].header().stream;
    let now = Stamp(60_000_000);
    let damaged = |chunk: &Package| {
        let is_other = |bytes: &Vec<u8>| {
            Package::parse(bytes)
                .is_ok_and(|package| package.header() == chunk.header() && package.bytes() != chunk.bytes())
        };
        let mut bytes = chunk.bytes().to_vec();
        let end = bytes.len() - 40;
        bytes[end] ^= 0x40;
        assert!(is_other(&bytes));
        Package::parse(&bytes).unwrap()
    };
    let bad = damaged(&chunks[2]);
    give(&mut bob, 1, now, &[&chunks[0], &chunks[1], &bad, &chunks[3]]);
    assert_eq!((bob.counters().merged, bob.counters().damaged), (2, 1));
    assert_eq!(bob.session().counters().snapshots_restarted, 1);
    // The rest of this sending finds nothing to go on from; the next sending does.
    give(&mut bob, 1, now, &chunks.iter().skip(4).collect::<Vec<_>>());
    let later = now.plus_micros(11_000_000);
    give(&mut bob, 1, later, &chunks.iter().collect::<Vec<_>>());
    assert_eq!(bob.fusion().layer(stream).unwrap().digest(), digest);
    assert!(bob.session().received(stream).unwrap().contains_range(1, 9));
}

#[test]
fn what_of_a_snapshot_has_no_room_is_known_to_be_lacking_and_not_asked_for_again() {
    let (chunks, _, _) = chunks(5);
    let mut config = config(9);
    config.fusion.layer_bytes_max = 60_000;
    let mut bob = Robot::new(config, Stamp(0)).unwrap();
    let now = Stamp(60_000_000);
    give(&mut bob, 1, now, &chunks.iter().collect::<Vec<_>>());
    let stream = chunks[0].header().stream;
    assert!(bob.session().received(stream).unwrap().contains_range(1, 9));
    assert!(bob.session().lost_upto(stream).is_some() && bob.fusion().is_in_part(stream) && bob.is_full());
    assert!(bob.fusion().memory_bytes_of_others(bob.mapper()) <= 60_000);
    assert!(bob.counters().blocks_dropped > 0);
    assert_eq!((bob.counters().no_room, bob.counters().damaged), (0, 0));
}

/// Once four were read at a time and each new one pushed another out, so that of seven in turns none was ever
/// complete.
#[test]
fn snapshots_of_many_robots_that_come_in_turns_all_become_complete() {
    let (one, _, mut bob) = chunks(7);
    let states: Vec<Vec<Package>> = (1..=7).map(|origin| renamed(&one, origin)).collect();
    for chunk in 0..states[0].len() {
        for (origin, chunks) in (1..).zip(&states) {
            let now = Stamp(60_000_000 + 50_000 * (chunk as i64 * 7 + i64::from(origin)));
            give(&mut bob, origin, now, &[&chunks[chunk]]);
        }
    }
    for (origin, chunks) in (1..).zip(&states) {
        let received = bob.session().received(chunks[0].header().stream).unwrap();
        assert!(received.contains_range(1, 9), "origin {origin}");
    }
    assert_eq!(bob.session().counters().snapshots_restarted, 0);
}

#[test]
fn a_snapshot_of_which_nothing_new_comes_gives_its_place_away() {
    let (one, ..) = chunks(3);
    let mut narrow = config(9);
    narrow.session.transfers_max = 1;
    let mut bob = Robot::new(narrow, Stamp(0)).unwrap();
    let states = [renamed(&one, 11), renamed(&one, 12)];
    // The first chunk of the one is offered again and again, and right after it one of the other.
    for seconds in (0..40).step_by(5) {
        for (origin, chunks) in (11..).zip(&states) {
            give(&mut bob, origin, Stamp(seconds * 1_000_000), &[&chunks[0]]);
        }
    }
    give(&mut bob, 12, Stamp(40_000_000), &states[1].iter().collect::<Vec<_>>());
    let received = bob.session().received(states[1][0].header().stream).unwrap();
    assert!(received.contains_range(1, 9));
}

#[test]
fn of_more_snapshots_than_are_received_at_once_each_goes_through_in_its_time() {
    let (one, _, mut bob) = chunks(12);
    let states: Vec<Vec<Package>> = (11..=22).map(|origin| renamed(&one, origin)).collect();
    let now = Stamp(60_000_000);
    for chunk in 0..3 {
        for (origin, chunks) in (11..).zip(&states) {
            give(&mut bob, origin, now, &[&chunks[chunk]]);
        }
    }
    for (origin, chunks) in (11..).zip(&states) {
        give(&mut bob, origin, now, &chunks.iter().collect::<Vec<_>>());
        let received = bob.session().received(chunks[0].header().stream).unwrap();
        assert!(received.contains_range(1, 9), "origin {origin}");
    }
}

/// The same state as that of another robot.
fn renamed(chunks: &[Package], origin: u16) -> Vec<Package> {
    let mut decoder = flockmap::codec::Decoder::new();
    let mut before = flockmap::codec::ChunksRead::default();
    let mut layer = flockmap::grid::Layer::default();
    for chunk in chunks {
        assert!(matches!(chunk.header().content, ContentKind::Snapshot { .. }));
        layer.apply_snapshot(&decoder.decode_chunk(chunk, &mut before).unwrap());
    }
    let stream = Stream { origin: RobotId(origin), epoch: 1 };
    let state = layer.snapshot().unwrap();
    let chunks = Encoder::new().encode_snapshot(Codec::Flock, stream, 9, common::resolution(), &state, 600);
    let chunks = chunks.unwrap();
    let Ok(Content::Snapshot(_)) = chunks[0].decode() else { panic!("the first chunk is independent") };
    chunks
}

/// A snapshot in one chunk that lacks something, as new as a stamp at most.
fn in_part(since: u32, upto: u32, lost_upto: i64, voxel: Voxel, stamp: i64) -> Package {
    let stream = Stream { origin: RobotId(1), epoch: 1 };
    let lost_upto = Some(Stamp(lost_upto));
    let span = Span { lost_upto, ..Span::new(stream, since, upto) };
    let changes = Changes::from_voxels([(voxel, State::Free)]);
    let region = changes.bounding_box().unwrap();
    let state = Snapshot { region, parts: vec![(Stamp(stamp), changes)], sensors: Vec::new() };
    let state = SnapshotVoxels::from_state(&state).unwrap();
    let chunks = Encoder::new().encode_span(Codec::Flock, span, common::resolution(), &state, 1_150).unwrap();
    chunks.into_iter().next().unwrap()
}

#[test]
fn of_two_snapshots_in_part_the_older_one_brings_nothing_back_that_the_newer_one_may_have_made_outdated() {
    let [old, new] = [Voxel::new(1, 2, 3), Voxel::new(40, 2, 3)];
    // Something as new as 20 was dropped by who made the newer one: what it was, nobody here knows.
    let newer = in_part(3, 17, 20, new, 30);
    let older = in_part(0, 3, 5, old, 4);
    let now = Stamp(60_000_000);
    // It waits for the packages before it, gives its place to one that need not wait, and comes once more.
    let mut narrow = config(9);
    narrow.session.transfers_max = 1;
    let mut bob = Robot::new(narrow, Stamp(0)).unwrap();
    give(&mut bob, 1, now, &[&newer]);
    give(&mut bob, 2, now, &[&older]);
    give(&mut bob, 3, now, &[&newer]);
    let stream = newer.header().stream;
    assert!(bob.session().received(stream).unwrap().contains_range(1, 17));
    let layer = bob.fusion().layer(stream).unwrap();
    assert_eq!((layer.get(old), layer.get(new)), (None, Some((State::Free, Stamp(30)))));
    assert_eq!((layer.lost_upto(), bob.session().lost_upto(stream)), (Some(Stamp(20)), Some(Stamp(20))));
}
