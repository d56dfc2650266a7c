//! A state that is too large for one snapshot comes in pieces, the oldest first: all of it, whatever goes on meanwhile.

#[allow(dead_code, reason = "layers are compared one by one here")]
mod common;

use common::{PERFECT, Radio, Random, Swarm, config, scan};
use flockmap::codec::ContentKind;
use flockmap::{Codec, Event, Pose, RobotConfig, Stream};

const LOSSY: Radio = Radio { loss: 0.2, duplication: 0.05, damage: 0.01, delay_ms: (5.0, 60.0) };

/// Robots that keep next to no packages, and whose snapshots have 60 kB at most: the changes of a second or two.
fn configs(count: u16) -> Vec<RobotConfig> {
    let small = |id| {
        let mut config = RobotConfig { codec: Codec::Flock, ..config(id) };
        config.session.store_bytes_max = 20_000;
        config.session.snapshot_bytes_max = 60_000;
        config
    };
    (1..=count).map(small).collect()
}

/// Where a robot is that flies to and fro over sixty metres, by tenths of a second.
fn to_and_fro(tick: i32) -> i32 {
    (tick % 300 - 150).abs()
}

/// The same, always on.
fn away(tick: i32) -> i32 {
    tick
}

/// The first robot flies so many tenths of a second, 40 cm in each.
fn fly(swarm: &mut Swarm, ticks: std::ops::Range<i32>, path: fn(i32) -> i32, random: &mut Random) {
    for tick in ticks {
        let scan = scan(random, swarm.now);
        swarm.scan(0, &scan, &Pose::from_translation([f64::from(path(tick)) * 0.4, 0.0, 0.0]));
        swarm.run(100);
    }
    swarm.robots[0].flush(swarm.now);
}

fn digest(swarm: &Swarm, robot: usize, stream: Stream) -> Option<u64> {
    swarm.robots[robot].fusion().layer(stream).map(flockmap::grid::Layer::digest)
}

fn prefix(swarm: &Swarm, robot: usize, stream: Stream) -> u32 {
    swarm.robots[robot].session().received(stream).map_or(0, |received| received.prefix())
}

/// Up to where a robot held all packages of a stream when a snapshot had come.
fn caught_up(swarm: &Swarm, robot: usize, stream: Stream) -> Vec<u32> {
    let upto = |event: &Event| match event {
        Event::CaughtUp { stream: of, upto } if *of == stream => Some(*upto),
        _ => None,
    };
    swarm.events[robot].iter().filter_map(upto).collect()
}

fn is_in_pieces(swarm: &Swarm, robot: usize, stream: Stream) -> bool {
    swarm.robots[robot].session().cuts(stream, u32::MAX).changed_upto.is_some()
}

#[test]
fn who_joins_late_gets_all_of_a_state_that_is_too_large_for_one_snapshot() {
    for (radio, seed) in [(PERFECT, 1), (LOSSY, 2), (LOSSY, 3)] {
        let mut swarm = Swarm::new(configs(2), radio, seed);
        swarm.cut = vec![(0, 1)];
        let mut random = Random(seed);
        fly(&mut swarm, 0..700, to_and_fro, &mut random);
        let own = swarm.robots[0].own_stream();
        assert!(swarm.robots[0].fusion().layer(own).unwrap().len() > 150_000);
        swarm.cut.clear();
        swarm.run(60_000);
        assert_eq!(digest(&swarm, 1, own), digest(&swarm, 0, own), "seed {seed}");
        assert_eq!(prefix(&swarm, 1, own), prefix(&swarm, 0, own), "seed {seed}");
        let pieces = caught_up(&swarm, 1, own);
        assert!(pieces.len() >= 3 && pieces.is_sorted(), "seed {seed}: {pieces:?}");
        assert!(!is_in_pieces(&swarm, 1, own));
        // Each was made once.
        assert!(swarm.robots[0].counters().snapshots <= pieces.len() as u64 + 1, "seed {seed}");
        assert_eq!(swarm.robots[1].counters().damaged, 0, "seed {seed}");
    }
}

#[test]
fn what_the_origin_says_while_pieces_come_arrives_too() {
    for (radio, seed) in [(PERFECT, 4), (LOSSY, 5)] {
        let mut swarm = Swarm::new(configs(2), radio, seed);
        swarm.cut = vec![(0, 1)];
        let mut random = Random(seed);
        fly(&mut swarm, 0..500, to_and_fro, &mut random);
        let own = swarm.robots[0].own_stream();
        swarm.cut.clear();
        // It flies over what it has seen: much of what the pieces say is outdated before they have come.
        fly(&mut swarm, 500..800, to_and_fro, &mut random);
        assert!(caught_up(&swarm, 1, own).len() >= 2, "seed {seed}");
        swarm.run(60_000);
        assert_eq!(digest(&swarm, 1, own), digest(&swarm, 0, own), "seed {seed}");
        assert_eq!(swarm.robots[1].counters().damaged, 0, "seed {seed}");
    }
}

#[test]
fn who_has_some_pieces_passes_on_what_it_has_when_the_origin_is_gone() {
    for (radio, seed) in [(PERFECT, 6), (LOSSY, 7)] {
        let mut swarm = Swarm::new(configs(3), radio, seed);
        swarm.cut = vec![(0, 1), (0, 2), (1, 2)];
        let mut random = Random(seed);
        fly(&mut swarm, 0..700, to_and_fro, &mut random);
        let own = swarm.robots[0].own_stream();
        swarm.cut = vec![(0, 2), (1, 2)];
        let mut steps = 0;
        while caught_up(&swarm, 1, own).len() < 2 {
            swarm.run(20);
            steps += 1;
            assert!(steps < 3_000, "seed {seed}");
        }
        // The origin goes out of reach.
        swarm.cut = vec![(0, 1), (0, 2)];
        assert!(is_in_pieces(&swarm, 1, own) && prefix(&swarm, 1, own) < prefix(&swarm, 0, own));
        swarm.run(60_000);
        assert!(prefix(&swarm, 2, own) > 0, "seed {seed}");
        assert_eq!(prefix(&swarm, 2, own), prefix(&swarm, 1, own), "seed {seed}");
        assert!(is_in_pieces(&swarm, 2, own), "seed {seed}");
        // It comes back.
        swarm.cut.clear();
        swarm.run(90_000);
        for robot in [1, 2] {
            assert_eq!(digest(&swarm, robot, own), digest(&swarm, 0, own), "seed {seed}, robot {robot}");
            assert!(!is_in_pieces(&swarm, robot, own), "seed {seed}, robot {robot}");
            assert_eq!(swarm.robots[robot].counters().damaged, 0, "seed {seed}");
        }
    }
}

#[test]
fn who_has_merged_some_of_a_snapshot_says_so_with_states_of_its_own() {
    for seed in [8, 9] {
        let mut swarm = Swarm::new(configs(2), LOSSY, seed);
        swarm.cut = vec![(0, 1)];
        fly(&mut swarm, 0..300, to_and_fro, &mut Random(seed));
        let own = swarm.robots[0].own_stream();
        swarm.cut.clear();
        let chunk = |event: &Event| match event {
            Event::Merged { stream, index, package, .. }
                if *stream == own && package.header().content != ContentKind::Changes =>
            {
                Some(*index)
            }
            _ => None,
        };
        // Not all of its chunks have come.
        let index = loop {
            swarm.run(5);
            let held = prefix(&swarm, 1, own);
            if let Some(index) = swarm.events[1].iter().filter_map(chunk).find(|index| *index > held) {
                break index;
            }
            assert!(held < prefix(&swarm, 0, own), "seed {seed}");
        };
        let cuts = swarm.robots[1].session().cuts(own, prefix(&swarm, 1, own));
        assert!(cuts.newest >= index && cuts.says_upto == Some(index) && !cuts.has_all, "{cuts:?}");
        swarm.run(60_000);
        let cuts = swarm.robots[1].session().cuts(own, prefix(&swarm, 1, own));
        assert!(cuts.says_upto.is_none() && cuts.has_all, "all of it is held: {cuts:?}");
    }
}

/// What an origin that has dropped some of its layer still holds, somebody else holds as well.
fn holds_what_is_left(swarm: &Swarm, robot: usize, own: Stream) -> bool {
    let [left, theirs] = [0, robot].map(|robot| swarm.robots[robot].fusion().layer(own).unwrap());
    assert!(left.lost_upto().is_some() && left.len() > 100_000, "{}", left.len());
    left.voxels().all(|(voxel, _)| left.get(voxel) == theirs.get(voxel))
}

/// The origin has no room for all that it has seen.
fn configs_of_full(count: u16) -> Vec<RobotConfig> {
    let mut configs = configs(count);
    configs[0].fusion.own_layer_bytes_max = 600_000;
    configs
}

#[test]
fn who_joins_late_gets_all_that_is_left_in_pieces_of_a_state_of_which_something_was_dropped() {
    for (radio, seed) in [(PERFECT, 8), (LOSSY, 9), (LOSSY, 10)] {
        let mut swarm = Swarm::new(configs_of_full(2), radio, seed);
        swarm.cut = vec![(0, 1)];
        let mut random = Random(seed);
        fly(&mut swarm, 0..700, away, &mut random);
        let own = swarm.robots[0].own_stream();
        swarm.cut.clear();
        // Pieces come while it flies on, and drops what the next one is to say.
        fly(&mut swarm, 700..800, away, &mut random);
        let dropped = swarm.robots[0].counters().blocks_dropped;
        swarm.run(60_000);
        assert!(dropped > 0 && holds_what_is_left(&swarm, 1, own), "seed {seed}");
        assert_eq!(prefix(&swarm, 1, own), prefix(&swarm, 0, own), "seed {seed}");
        assert!(caught_up(&swarm, 1, own).len() >= 3, "seed {seed}: {:?}", caught_up(&swarm, 1, own));
        assert!(swarm.robots[1].fusion().is_in_part(own) && !is_in_pieces(&swarm, 1, own));
        assert_eq!(swarm.robots[1].counters().damaged, 0, "seed {seed}");
    }
}

#[test]
fn the_rest_of_a_state_comes_in_pieces_too() {
    for (radio, seed) in [(PERFECT, 11), (LOSSY, 12)] {
        let mut swarm = Swarm::new(configs_of_full(3), radio, seed);
        swarm.cut = vec![(0, 2), (1, 2)];
        let mut random = Random(seed);
        fly(&mut swarm, 0..700, away, &mut random);
        swarm.run(5_000);
        let own = swarm.robots[0].own_stream();
        swarm.cut = vec![(1, 2)];
        swarm.run(40_000);
        assert!(
            swarm.robots[2].fusion().is_in_part(own) && holds_what_is_left(&swarm, 2, own),
            "seed {seed}"
        );
        // Then it hears who has all of it.
        let made = swarm.robots[1].counters().snapshot_pieces;
        swarm.cut.clear();
        swarm.run(60_000);
        assert!(swarm.robots[1].counters().snapshot_pieces >= made + 2, "seed {seed}");
        assert_eq!(digest(&swarm, 2, own), digest(&swarm, 1, own), "seed {seed}");
        assert!(!swarm.robots[2].fusion().is_in_part(own), "seed {seed}");
        let is_complete = |event: &Event| matches!(event, Event::Complete { stream } if *stream == own);
        assert!(swarm.events[2].iter().any(is_complete), "seed {seed}");
        assert_eq!(swarm.robots[2].counters().damaged, 0, "seed {seed}");
    }
}
