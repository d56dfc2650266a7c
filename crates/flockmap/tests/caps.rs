//! At the limits of layers: what is near and new is held, what was dropped is said and comes back when there is room,
//! nothing is sent in vain, and no voxel is wrong.

#[allow(dead_code, reason = "layers are compared in part here")]
mod common;

use common::{PERFECT, Radio, Random, Swarm, config, scan};
use flockmap::grid::Layer;
use flockmap::{Codec, Event, Pose, RobotConfig, Stream};

const LOSSY: Radio = Radio { loss: 0.2, duplication: 0.05, damage: 0.01, delay_ms: (5.0, 60.0) };

/// Robots in `flock`; what is not asked of the store of packages has to come from layers.
fn configs(count: u16, store_bytes_max: usize) -> Vec<RobotConfig> {
    let with_store = |id| {
        let mut config = RobotConfig { codec: Codec::Flock, ..config(id) };
        config.session.store_bytes_max = store_bytes_max;
        config
    };
    (1..=count).map(with_store).collect()
}

/// A robot flies so many tenths of a second, 40 cm in each, from a place on.
fn fly(swarm: &mut Swarm, robot: usize, ticks: std::ops::Range<i32>, random: &mut Random) {
    for tick in ticks {
        let scan = scan(random, swarm.now);
        swarm.scan(robot, &scan, &Pose::from_translation([f64::from(tick) * 0.4, 0.0, 0.0]));
        swarm.run(100);
    }
    swarm.robots[robot].flush(swarm.now);
    swarm.run(3_000);
}

fn layer(swarm: &Swarm, robot: usize, stream: Stream) -> &Layer {
    swarm.robots[robot].fusion().layer(stream).unwrap()
}

fn holds_all(swarm: &Swarm, robot: usize, stream: Stream) -> bool {
    let newest = swarm.robots.iter().map(|robot| robot.session().store().newest_known(stream)).max().unwrap();
    swarm.robots[robot].session().received(stream).is_some_and(|received| received.contains_range(1, newest))
}

/// What a layer knows is what that of another robot, which lacks nothing, knows too. Returns how much it lacks.
fn lacks(part: &Layer, whole: &Layer) -> usize {
    assert!(whole.lost_upto().is_none());
    for (voxel, _) in part.voxels() {
        assert_eq!(part.get(voxel), whole.get(voxel), "{voxel:?}");
    }
    whole.len() - part.len()
}

/// Bytes that flow in a minute in which nobody has anything to say but requests.
fn check_quiet(swarm: &mut Swarm) {
    let packages = |swarm: &Swarm| {
        swarm.robots.iter().map(|r| r.session().counters().packages_out.datagrams).sum::<u64>()
    };
    let before = packages(swarm);
    swarm.run(60_000);
    assert_eq!(packages(swarm), before, "something is sent in vain");
}

fn dropped_events(swarm: &Swarm, robot: usize) -> usize {
    swarm.events[robot].iter().filter(|event| matches!(event, Event::Dropped { .. })).count()
}

#[test]
fn what_others_say_beyond_the_limit_takes_the_place_of_what_is_far_and_old() {
    for (radio, seed) in [(PERFECT, 1), (LOSSY, 2), (LOSSY, 3)] {
        let mut configs = configs(2, 64 << 20);
        configs[1].fusion.layer_bytes_max = 400_000;
        let mut swarm = Swarm::new(configs, radio, seed);
        let mut random = Random(seed);
        fly(&mut swarm, 0, 0..300, &mut random);
        swarm.run(20_000);
        let own = swarm.robots[0].own_stream();
        assert!(holds_all(&swarm, 1, own), "seed {seed}");
        let (part, whole) = (layer(&swarm, 1, own), layer(&swarm, 0, own));
        let lacking = lacks(part, whole);
        assert!(lacking > whole.len() / 3, "seed {seed}: {lacking} of {} are lacking", whole.len());
        // The newest is there: all that was seen in the last ten metres.
        let newest = whole.newest().unwrap().plus_micros(-2_500_000);
        let seen = whole.voxels().filter(|(voxel, _)| whole.get(*voxel).is_some_and(|(_, at)| at > newest));
        let (mut all, mut held) = (0, 0);
        for (voxel, state) in seen {
            all += 1;
            held += usize::from(part.state(voxel) == state);
        }
        assert!(all > 5_000 && held * 100 >= all * 97, "seed {seed}: {held} of the newest {all}");
        let robot = &swarm.robots[1];
        assert!(robot.fusion().memory_bytes_of_others(robot.mapper()) <= 400_000 && robot.is_full());
        assert!(robot.counters().blocks_dropped > 0 && dropped_events(&swarm, 1) > 0);
        assert_eq!((robot.counters().no_room, robot.counters().damaged), (0, 0));
        check_quiet(&mut swarm);
    }
}

#[test]
fn who_joins_late_gets_what_an_origin_that_dropped_still_has_and_the_rest_from_who_has_it() {
    for (radio, seed) in [(PERFECT, 1), (LOSSY, 2)] {
        // The second robot has heard all of it from the beginning, the third one joins when all is over.
        let mut configs = configs(3, 20_000);
        configs[0].fusion.own_layer_bytes_max = 250_000;
        let mut swarm = Swarm::new(configs, radio, seed);
        swarm.cut = vec![(0, 2), (1, 2)];
        let mut random = Random(seed);
        fly(&mut swarm, 0, 0..300, &mut random);
        swarm.run(10_000);
        let own = swarm.robots[0].own_stream();
        assert!(holds_all(&swarm, 1, own), "seed {seed}");
        let dropped = lacks(layer(&swarm, 0, own), layer(&swarm, 1, own));
        assert!(dropped > 10_000 && dropped_events(&swarm, 0) > 0, "seed {seed}: {dropped}");
        // It hears the origin alone at first.
        swarm.cut = vec![(1, 2)];
        swarm.run(30_000);
        assert!(holds_all(&swarm, 2, own), "seed {seed}");
        assert_eq!(lacks(layer(&swarm, 2, own), layer(&swarm, 1, own)), dropped, "seed {seed}");
        assert!(
            swarm.robots[2].fusion().is_in_part(own) && swarm.robots[2].session().lost_upto(own).is_some()
        );
        check_quiet(&mut swarm);
        // What the origin says now it can decode.
        let independent = swarm.robots[0].counters().batches_independent;
        fly(&mut swarm, 0, 300..330, &mut random);
        swarm.run(5_000);
        assert!(swarm.robots[0].counters().batches_independent > independent + 3);
        assert!(holds_all(&swarm, 2, own), "seed {seed}");
        assert_eq!(lacks(layer(&swarm, 2, own), layer(&swarm, 1, own)), dropped, "seed {seed}");
        // Then it hears who has all.
        swarm.cut.clear();
        swarm.run(40_000);
        assert_eq!(layer(&swarm, 2, own).digest(), layer(&swarm, 1, own).digest(), "seed {seed}");
        assert!(
            !swarm.robots[2].fusion().is_in_part(own) && swarm.robots[2].session().lost_upto(own).is_none()
        );
        assert!(
            swarm.events[2].iter().any(|event| matches!(event, Event::Complete { stream } if *stream == own))
        );
        check_quiet(&mut swarm);
    }
}

/// The second robot hears the first one, by packages or by a snapshot; then much of the third, so that of the first
/// something has to go; and then that run of the third is forgotten.
fn drop_and_get_back(joins_late: bool) {
    let mut configs = configs(3, 20_000);
    configs[1].fusion.layer_bytes_max = 700_000;
    configs[1].session.epochs_max = 1;
    let (again, mut swarm) = (configs[2].clone(), Swarm::new(configs, PERFECT, 4));
    let mut random = Random(4);
    if joins_late {
        swarm.cut = vec![(0, 1), (0, 2)];
    }
    fly(&mut swarm, 0, 0..60, &mut random);
    swarm.cut.clear();
    swarm.run(10_000);
    let first = swarm.robots[0].own_stream();
    assert_eq!(layer(&swarm, 1, first).digest(), layer(&swarm, 0, first).digest());
    assert_eq!(swarm.robots[1].session().counters().caught_up > 0, joins_late);
    fly(&mut swarm, 2, 0..300, &mut random);
    assert!(lacks(layer(&swarm, 1, first), layer(&swarm, 0, first)) > 1_000 && swarm.robots[1].is_full());
    // It begins again, and its former run goes.
    let mut again = RobotConfig { epoch: 9, ..again };
    again.seed = 77;
    swarm.robots[2] = flockmap::Robot::new(again, swarm.now).unwrap();
    fly(&mut swarm, 2, 0..3, &mut random);
    swarm.run(60_000);
    assert!(!swarm.robots[1].is_full());
    assert_eq!(layer(&swarm, 1, first).digest(), layer(&swarm, 0, first).digest());
    assert!(swarm.robots[1].fusion().layers().all(|(_, layer)| layer.lost_upto().is_none()));
    check_quiet(&mut swarm);
}

#[test]
fn what_was_dropped_comes_back_when_a_run_that_is_forgotten_gives_room() {
    drop_and_get_back(false);
}

/// Once its chunks counted as read, since they had been read when it came first.
#[test]
fn a_snapshot_that_came_before_is_read_anew_when_something_of_it_was_dropped() {
    drop_and_get_back(true);
}

#[test]
fn of_which_everything_was_dropped_a_snapshot_says_just_that() {
    let mut configs = configs(2, 20_000);
    // There is no room for anything.
    configs[0].fusion.own_layer_bytes_max = 100;
    let mut swarm = Swarm::new(configs, PERFECT, 5);
    swarm.cut = vec![(0, 1)];
    fly(&mut swarm, 0, 0..40, &mut Random(5));
    let own = swarm.robots[0].own_stream();
    assert!(layer(&swarm, 0, own).is_empty());
    swarm.cut.clear();
    swarm.run(20_000);
    assert!(holds_all(&swarm, 1, own), "what nobody has any more is not asked for for ever");
    assert!(swarm.robots[1].fusion().is_in_part(own));
    check_quiet(&mut swarm);
    // And what it says from now on is understood.
    fly(&mut swarm, 0, 40..50, &mut Random(6));
    assert!(holds_all(&swarm, 1, own));
    assert!(layer(&swarm, 1, own).len() > 10_000);
    assert_eq!(swarm.robots[1].counters().superseded, 0);
}
