//! Packages that build on earlier ones: they wait, they go, and what is gone comes back as a snapshot.

mod common;

use common::{Radio, Random, Swarm, config, resolution, scan};
use flockmap::codec::{Base, Batch, Content, Decoder, Encoder, PACKAGE_BYTES_MAX};
use flockmap::grid::Layer;
use flockmap::sync::wire::{DatagramHeader, Kind, PackagesWriter};
use flockmap::{
    Changes, Codec, Event, Package, Pose, Robot, RobotConfig, RobotId, Stamp, State, Stream, Voxel, VoxelBox,
};

const LOSSY: Radio = Radio { loss: 0.2, duplication: 0.1, damage: 0.02, delay_ms: (5.0, 80.0) };
const PERFECT: Radio = common::PERFECT;

/// Publishes batches of its own against the one before, each a piece of a wall in the same place: few voxels
/// would not need what was before.
struct Sender {
    stream: Stream,
    encoder: Encoder,
    layer: Layer,
    batches: Vec<(Stamp, u32)>,
    readers: Vec<(u32, VoxelBox)>,
}

impl Sender {
    fn new(id: u16) -> Self {
        let stream = Stream { origin: RobotId(id), epoch: 1 };
        Self {
            stream,
            encoder: Encoder::new(),
            layer: Layer::default(),
            batches: Vec::new(),
            readers: Vec::new(),
        }
    }

    /// The one package of the next batch, independent or not.
    fn encode(&mut self, is_independent: bool) -> Package {
        let count = self.batches.len() as i32;
        let end = Stamp(1_000_000 * i64::from(count + 1));
        let resolution = resolution();
        let batch = Batch { stream: self.stream, start: end, end, resolution, sensor: [0; 3] };
        // Grows along the wall and turns what was published before.
        let voxels = (0..320).map(|i| {
            let voxel = Voxel::new((count * 3 + i % 8) % 24, 0, i / 8);
            (voxel, if self.layer.state(voxel) == State::Free { State::Occupied } else { State::Free })
        });
        let changes = Changes::from_voxels(voxels);
        let layer = (!is_independent).then_some(&self.layer);
        let base = Base { layer, batches: &self.batches, readers: &self.readers };
        let index = count as u32 + 1;
        let packages = self.encoder.encode_batch_against(
            Codec::Flock,
            &batch,
            index,
            &changes,
            Some(&base),
            PACKAGE_BYTES_MAX,
        );
        let [package] = packages.unwrap().try_into().unwrap();
        self.layer.apply(&changes, end);
        self.batches.push((end, index));
        package
    }

    /// As [`Self::encode`], and remembers what it looked at, as a robot does.
    fn send_and_note(&mut self, is_independent: bool) -> Package {
        let package = self.encode(is_independent);
        if !package.header().is_independent {
            self.readers.push((package.header().index, package.header().region));
        }
        package
    }

    /// Gives packages to a robot, as if the sender had sent them.
    fn give(&self, robot: &mut Robot, now: Stamp, packages: &[&Package]) {
        for package in packages {
            let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender: self.stream, stamp: now };
            let mut writer = PackagesWriter::new(header, 1_200);
            assert!(writer.push(package));
            robot.handle_datagram(now, &writer.finish()).unwrap();
        }
        // What waited for one may be more than it has time for at once.
        while robot.session().has_events() {
            robot.handle_timeout(now);
        }
    }

    fn holds_all(&self, robot: &Robot) -> bool {
        let newest = self.batches.len() as u32;
        robot.fusion().layer(self.stream).is_some_and(|layer| layer.digest() == self.layer.digest())
            && robot
                .session()
                .received(self.stream)
                .is_some_and(|received| received.contains_range(1, newest))
    }
}

fn robot(id: u16) -> Robot {
    Robot::new(config(id), Stamp(0)).unwrap()
}

#[test]
fn a_package_waits_and_is_merged_in_the_call_that_brings_what_it_builds_on() {
    let (mut sender, mut bob) = (Sender::new(1), robot(2));
    let packages: Vec<Package> = (0..5).map(|_| sender.send_and_note(false)).collect();
    let bases: Vec<u32> = packages.iter().map(|package| package.header().base).collect();
    assert_eq!(bases, [0, 1, 2, 3, 4]);
    let [one, two, three, four, five] = packages.iter().collect::<Vec<_>>().try_into().unwrap();
    let now = Stamp(1_000);
    sender.give(&mut bob, now, &[one, four, three, five, five, four]);
    assert_eq!((bob.counters().merged, bob.session().counters().waited), (1, 3));
    assert_eq!(bob.session().counters().duplicates, 2, "nothing waits twice");
    assert!(bob.session().store().get(sender.stream, 4).is_none(), "nor is it passed on");
    sender.give(&mut bob, now, &[two]);
    assert_eq!(bob.counters().merged, 5);
    assert!(sender.holds_all(&bob));
    let merged: Vec<u32> = core::iter::from_fn(|| bob.poll_event())
        .filter_map(|event| if let Event::Merged { index, .. } = event { Some(index) } else { None })
        .collect();
    assert_eq!(merged, [1, 2, 3, 4, 5]);
}

#[test]
fn what_waits_is_bounded_and_one_stream_does_not_displace_another() {
    let (mut loud, mut quiet, mut bob) = (Sender::new(1), Sender::new(3), robot(2));
    let now = Stamp(1_000);
    let few: Vec<Package> = (0..20).map(|_| quiet.send_and_note(false)).collect();
    let flood: Vec<Package> = (0..1_500).map(|_| loud.send_and_note(false)).collect();
    quiet.give(&mut bob, now, &few[1..].iter().collect::<Vec<_>>());
    loud.give(&mut bob, now, &flood[1..].iter().collect::<Vec<_>>());
    let counters = *bob.session().counters();
    assert_eq!((bob.counters().merged, counters.waited), (0, 19 + 1_499));
    assert_eq!(counters.waited - counters.waiting_dropped, 1_024);
    quiet.give(&mut bob, now, &[&few[0]]);
    assert!(quiet.holds_all(&bob));
    // Of the flood the first are kept, which can go first; the rest is asked for again.
    loud.give(&mut bob, now, &[&flood[0]]);
    assert_eq!(bob.session().received(loud.stream).unwrap().intervals(), [(1, 1_024 - 19 + 1)]);
    assert_eq!(bob.counters().damaged, 0);
}

#[test]
fn what_had_no_room_to_wait_is_wanted_again_as_soon_as_it_need_not_wait() {
    let (mut loud, mut bob) = (Sender::new(1), robot(2));
    let now = Stamp(1_000);
    let flood: Vec<Package> = (0..1_200).map(|_| loud.send_and_note(false)).collect();
    loud.give(&mut bob, now, &flood[1..].iter().collect::<Vec<_>>());
    let rejected = bob.session().counters().rejected;
    assert_eq!(bob.session().load().backed_off, 1_199 - 1_024);
    // Still none of them: what they build on is not there.
    loud.give(&mut bob, now, &[&flood[1_199]]);
    assert_eq!(bob.session().counters().rejected, rejected + 1);
    loud.give(&mut bob, now, &[&flood[0]]);
    assert_eq!(bob.counters().merged, 1_025);
    loud.give(&mut bob, now, &flood[1_025..].iter().collect::<Vec<_>>());
    assert!(loud.holds_all(&bob));
    assert_eq!(bob.session().load().backed_off, 0);
}

#[test]
fn a_package_told_alone_waits_for_one_that_looks_at_what_it_changes() {
    let (mut sender, mut bob) = (Sender::new(1), robot(2));
    let packages = [false, false, true, true].map(|is_independent| sender.send_and_note(is_independent));
    assert!(packages[2].header().is_independent && packages[2].decode().is_ok());
    assert_eq!(packages[3].header().base, 2);
    let now = Stamp(1_000);
    sender.give(&mut bob, now, &[&packages[0], &packages[3], &packages[2]]);
    assert_eq!(bob.counters().merged, 1);
    sender.give(&mut bob, now, &[&packages[1]]);
    assert!(sender.holds_all(&bob));
    assert_eq!(bob.counters().superseded, 0);
}

/// A swarm of two in which the first holds what the sender published, and the second got it as `order` says.
fn received(sender: &Sender, packages: &[Package], order: &[usize]) -> Swarm {
    let mut swarm = Swarm::new((2..=3).map(config).collect(), PERFECT, 1);
    swarm.run(2_000);
    let now = swarm.now;
    sender.give(&mut swarm.robots[0], now, &packages.iter().collect::<Vec<_>>());
    let ordered: Vec<&Package> = order.iter().map(|at| &packages[*at]).collect();
    sender.give(&mut swarm.robots[1], now, &ordered);
    swarm
}

#[test]
fn a_package_that_was_overtaken_leads_to_a_snapshot_and_to_equal_layers() {
    let mut sender = Sender::new(1);
    // A faulty sender: the third does not name the second, which looks at what it changes.
    let packages = [false, false, true, false].map(|is_independent| sender.encode(is_independent));
    assert_eq!(packages[2].header().base, 0);
    let mut swarm = received(&sender, &packages, &[0, 2, 1, 3]);
    assert_eq!(swarm.robots[1].counters().superseded, 1);
    assert_eq!(swarm.robots[1].session().counters().undecodable, 1);
    assert!(sender.holds_all(&swarm.robots[0]));
    swarm.run(5_000);
    assert!(sender.holds_all(&swarm.robots[1]));
    assert_eq!(swarm.robots[1].session().counters().caught_up, 1);
    assert!(swarm.events[1].iter().any(|event| matches!(event, Event::CaughtUp { upto: 4, .. })));
    // It is asked for once, and then there is peace.
    let states = swarm.robots[0].counters().snapshots;
    swarm.run(10_000);
    assert_eq!((states, swarm.robots[0].counters().snapshots), (1, 1));
    let more = sender.encode(false);
    sender.give(&mut swarm.robots[1], swarm.now, &[&more]);
    assert!(sender.holds_all(&swarm.robots[1]));
}

/// A package with one bit flipped, as only its check tells those who hold the packages before it.
fn damaged(package: &Package, before: &[Package]) -> Package {
    let mut layer = Layer::default();
    for one in before {
        let Ok(Content::Changes(changes)) = Decoder::new().decode_against(one, Some(&layer)) else {
            panic!()
        };
        layer.apply(&changes, one.header().batch_end);
    }
    let flipped = |at: usize| {
        let mut bytes = package.bytes().to_vec();
        bytes[at] ^= 0x10;
        let flipped = Package::parse(&bytes).ok().filter(|flipped| flipped.header() == package.header());
        flipped.filter(|flipped| Decoder::new().decode_against(flipped, Some(&layer)).is_err())
    };
    (0..package.bytes().len()).rev().find_map(flipped).unwrap()
}

#[test]
fn damaged_packages_that_build_on_each_other_show_one_by_one_ten_seconds_apart() {
    let mut sender = Sender::new(1);
    let packages: Vec<Package> = (0..8).map(|_| sender.send_and_note(false)).collect();
    let mut got = packages.clone();
    for at in [2, 3, 6] {
        got[at] = damaged(&packages[at], &packages[..at]);
    }
    let mut swarm = Swarm::new((2..=3).map(config).collect(), PERFECT, 1);
    swarm.run(2_000);
    sender.give(&mut swarm.robots[0], swarm.now, &packages.iter().collect::<Vec<_>>());
    sender.give(&mut swarm.robots[1], swarm.now, &got.iter().collect::<Vec<_>>());
    let mut shown = Vec::new();
    for _ in 0..4 {
        shown.push(swarm.robots[1].counters().damaged);
        assert_eq!(shown.len() == 4, sender.holds_all(&swarm.robots[1]));
        swarm.run(15_000);
    }
    assert_eq!(shown, [1, 2, 3, 3]);
    assert_eq!(swarm.robots[1].session().counters().undecodable, 0);
}

#[test]
fn a_package_that_is_damaged_again_and_again_is_replaced_by_a_snapshot() {
    let mut sender = Sender::new(1);
    let packages: Vec<Package> = (0..3).map(|_| sender.send_and_note(false)).collect();
    let damaged = damaged(&packages[1], &packages[..1]);
    let mut swarm = Swarm::new((2..=3).map(config).collect(), PERFECT, 1);
    swarm.run(2_000);
    sender.give(&mut swarm.robots[0], swarm.now, &packages.iter().collect::<Vec<_>>());
    swarm.cut = vec![(0, 1)];
    sender.give(&mut swarm.robots[1], swarm.now, &[&packages[0], &damaged, &packages[2]]);
    swarm.run(11_000);
    sender.give(&mut swarm.robots[1], swarm.now, &[&damaged]);
    assert_eq!(swarm.robots[1].counters().damaged, 2);
    assert_eq!(swarm.robots[1].session().counters().undecodable, 1);
    swarm.cut.clear();
    swarm.run(10_000);
    assert!(sender.holds_all(&swarm.robots[1]));
    assert_eq!(swarm.robots[1].session().counters().caught_up, 1);
}

#[test]
fn who_dropped_something_of_the_own_layer_tells_batches_that_lie_there_alone() {
    let mut configs: Vec<RobotConfig> =
        (1..=2).map(|id| RobotConfig { codec: Codec::Flock, ..config(id) }).collect();
    configs[0].fusion.own_layer_bytes_max = 60_000;
    let mut swarm = Swarm::new(configs, LOSSY, 5);
    let mut random = Random(5);
    for tick in 0..40 {
        let scan = scan(&mut random, swarm.now);
        swarm.scan(0, &scan, &Pose::from_yaw([f64::from(tick) * 0.1, 0.0, 0.0], random.unit()));
        swarm.run(100);
    }
    // And back to where it began.
    let far = Pose::from_translation([0.5, 0.3, 0.0]);
    let scan = scan(&mut random, swarm.now);
    swarm.scan(0, &scan, &far);
    swarm.robots[0].flush(swarm.now);
    swarm.run(10_000);
    let [one, two] = [&swarm.robots[0], &swarm.robots[1]];
    assert!(one.counters().blocks_dropped > 0 && one.counters().batches_independent > 0);
    assert_eq!((two.counters().damaged, two.counters().superseded), (0, 0));
    let received = two.session().received(one.own_stream()).unwrap();
    assert!(received.contains_range(1, one.session().store().newest_known(one.own_stream())));
}

#[test]
fn what_waits_below_a_snapshot_is_dropped_and_what_waits_above_goes() {
    let mut sender = Sender::new(1);
    let mut packages: Vec<Package> =
        [false, false, true].into_iter().map(|is_independent| sender.encode(is_independent)).collect();
    packages.extend((0..4).map(|_| sender.encode(false)));
    // The second is superseded by the third. The fourth is lost; those after it wait. The first robot does
    // not know the last two.
    let mut swarm = Swarm::new((2..=3).map(config).collect(), PERFECT, 1);
    swarm.run(2_000);
    let now = swarm.now;
    let all: Vec<&Package> = packages.iter().collect();
    sender.give(&mut swarm.robots[0], now, &all[..5]);
    sender.give(&mut swarm.robots[1], now, &[all[0], all[2], all[1], all[4], all[5], all[6]]);
    assert_eq!(swarm.robots[1].session().counters().waited, 3);
    swarm.run(5_000);
    assert!(sender.holds_all(&swarm.robots[1]));
    assert_eq!(swarm.robots[1].session().counters().caught_up, 1);
    assert!(swarm.agrees(), "the first robot has the last ones from the second");
}

#[test]
fn maps_agree_under_loss_whether_told_against_each_other_or_alone_or_in_turns() {
    for seed in 1..=6 {
        for codec in [Codec::Flock, Codec::Paper] {
            // Always against; as it comes; nearly always independent.
            let repair_delay_max_ms = [0, 50, 1][seed as usize % 3];
            let configs = (1..=3).map(|id| RobotConfig { codec, repair_delay_max_ms, ..config(id) });
            let mut swarm = Swarm::new(configs.collect(), LOSSY, seed);
            let mut random = Random(seed ^ 0x5eed);
            for tick in 0..60 {
                for robot in 0..swarm.robots.len() {
                    let at = [f64::from(tick) * 0.05, robot as f64 * 2.0, 0.0];
                    let scan = scan(&mut random, swarm.now);
                    swarm.scan(robot, &scan, &Pose::from_yaw(at, random.unit()));
                }
                swarm.run(100);
            }
            swarm.settle(60_000);
            assert!(swarm.agrees(), "seed {seed}, {codec}: not equal after a minute");
            swarm.assert_layers_equal_own_maps(seed);
            let sum = |count: fn(&Robot) -> u64| swarm.robots.iter().map(count).sum::<u64>();
            let alone = sum(|robot| robot.counters().batches_independent);
            println!(
                "seed {seed} {codec}: {} batches, {alone} independent, {} B, {} packages waited, {} superseded, {} undecodable, {} snapshots",
                sum(|robot| robot.counters().batches),
                sum(|robot| robot.counters().package_bytes),
                sum(|robot| robot.session().counters().waited),
                sum(|robot| robot.counters().superseded),
                sum(|robot| robot.session().counters().undecodable),
                sum(|robot| robot.counters().snapshots),
            );
            assert_eq!(sum(|robot| robot.counters().damaged), 0, "seed {seed}, {codec}");
            assert_eq!(sum(|robot| robot.counters().superseded), 0, "seed {seed}, {codec}");
            let waited = sum(|robot| robot.session().counters().waited);
            assert_eq!(waited > 0, codec == Codec::Flock);
            if codec == Codec::Paper || repair_delay_max_ms == 0 {
                assert_eq!(alone, 0);
            } else {
                assert!(alone > 0, "seed {seed}: repair was slow");
            }
        }
    }
}
