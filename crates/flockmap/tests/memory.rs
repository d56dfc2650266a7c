//! Hostile packages fill every limit of a robot: it holds no more than `RobotConfig::memory_of_others_max`
//! states.

use flockmap::codec::{Base, Encoder, PACKAGE_BYTES_MAX};
use flockmap::grid::Layer;
use flockmap::sync::wire::{DatagramHeader, Kind, PackagesWriter};
use flockmap::{
    Batch, Changes, Codec, Event, Package, Refusal, Resolution, Robot, RobotConfig, RobotId, Stamp, State,
    Stream, Voxel,
};
use peak_alloc::PeakAlloc;

/// Counts the bytes that are held, and the most that ever were.
#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

fn resolution() -> Resolution {
    Resolution::from_metres(0.1).unwrap()
}

fn config(layer_bytes_max: usize) -> RobotConfig {
    let mut config = RobotConfig::new(RobotId(1), resolution(), 7.0);
    config.session.peers_max = 2;
    config.session.streams_max = 2;
    config.session.store_bytes_max = 1 << 20;
    config.session.snapshot_bytes_max = 1 << 20;
    config.fusion.layer_bytes_max = layer_bytes_max;
    config
}

/// A hostile robot.
struct Sender {
    stream: Stream,
    encoder: Encoder,
    next: u32,
}

impl Sender {
    fn new(id: u16) -> Self {
        Self { stream: Stream { origin: RobotId(id), epoch: 1 }, encoder: Encoder::new(), next: 1 }
    }

    fn encode(&mut self, codec: Codec, changes: &Changes, base: Option<&Base<'_>>) -> Vec<Package> {
        let stamp = Stamp(i64::from(self.next));
        let batch =
            Batch { stream: self.stream, start: stamp, end: stamp, resolution: resolution(), sensor: [0; 3] };
        let packages = self
            .encoder
            .encode_batch_against(codec, &batch, self.next, changes, base, PACKAGE_BYTES_MAX)
            .unwrap();
        self.next += packages.len() as u32;
        packages
    }

    /// The chunks of a snapshot of so many blocks, a voxel in each.
    fn send_state(&mut self, side: i32) -> Vec<Package> {
        let mut layer = Layer::default();
        let all = (0..side).flat_map(|x| (0..side).flat_map(move |y| (0..side).map(move |z| [x, y, z])));
        let voxels = all.map(|at| at.map(|i| i * 8)).map(|[x, y, z]| (Voxel::new(x, y, z), State::Occupied));
        layer.apply(&Changes::from_voxels(voxels), Stamp(1));
        let state = layer.snapshot().unwrap();
        let bytes_max = PACKAGE_BYTES_MAX;
        self.encoder.encode_snapshot(Codec::Flock, self.stream, 9, resolution(), &state, bytes_max).unwrap()
    }

    fn send(&self, robot: &mut Robot, package: &Package) {
        let now = Stamp(i64::from(self.next) * 1_000);
        let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender: self.stream, stamp: now };
        let mut writer = PackagesWriter::new(header, 1_200);
        assert!(writer.push(package));
        robot.handle_datagram(now, &writer.finish()).unwrap();
    }
}

/// Runs a case; the most that the robot held must be within what is stated, and at least `least`, or the case
/// is no case.
fn case(name: &str, config: RobotConfig, least: usize, fill: impl FnOnce(&mut Robot)) {
    let stated = config.memory_of_others_max();
    let before = ALLOCATOR.current_usage();
    let mut robot = Robot::new(config, Stamp(0)).unwrap();
    ALLOCATOR.reset_peak_usage();
    fill(&mut robot);
    let measured = ALLOCATOR.peak_usage() - before;
    println!("{name}: {measured} of {stated} bytes stated");
    assert!(measured <= stated, "{name}: {measured} bytes received, {stated} stated");
    assert!(
        measured >= least,
        "{name}: {measured} bytes received, at least {least} expected: nothing was filled"
    );
}

/// The layers are full, and they say so, and the heap agrees with what they say that they hold.
fn is_within(robot: &Robot, before: usize, layer_bytes_max: usize) {
    assert!(robot.counters().blocks_dropped > 0);
    let said = robot.fusion().memory_bytes_of_others(robot.mapper());
    // What a package may need is reckoned at its worst before it is merged.
    assert!(said <= layer_bytes_max && said > layer_bytes_max / 5, "{said} of {layer_bytes_max}");
    let received = ALLOCATOR.current_usage() - before;
    println!("  layers of {said} bytes, {received} on the heap with all else");
    // The store has a mebibyte, and there are the tables of the codecs.
    assert!(received > said && received < said + (2 << 20), "{received} bytes received, {said} said");
}

fn cube(side: i32) -> Changes {
    let all =
        (0..side).flat_map(|x| (0..side).flat_map(move |y| (0..side).map(move |z| Voxel::new(x, y, z))));
    Changes::from_voxels(all.map(|voxel| (voxel, State::Free)))
}

/// One test, since the counter is one for the whole process.
#[test]
fn hostile_packages_cannot_make_a_robot_hold_more_than_is_stated() {
    let stated = RobotConfig::new(RobotId(1), resolution(), 7.0).memory_of_others_max();
    println!("by default {stated} bytes are stated");
    assert!(stated < 2_700_000_000, "{stated}");
    let mut broadcast = RobotConfig::new(RobotId(1), resolution(), 7.0);
    broadcast.session.cast = flockmap::Cast::Broadcast;
    let stated = broadcast.memory_of_others_max();
    assert!(stated < 3_000_000_000, "{stated}");

    // 512 blocks, each voxel of which changed last in another batch, and then again in further ones.
    let mut sender = Sender::new(2);
    let packages: Vec<Package> = (0..600)
        .flat_map(|bit| {
            let voxel = |block: i32| {
                let [bx, by, bz] = [block & 7, block >> 3 & 7, block >> 6].map(|at| at * 8);
                (Voxel::new(bx + (bit & 7), by + (bit >> 3 & 7), bz + (bit >> 6 & 7)), State::Free)
            };
            sender.encode(Codec::Paper, &Changes::from_voxels((0..512).map(voxel)), None)
        })
        .collect();
    case("layers of many stamps", config(4 << 20), 3 << 20, |robot| {
        let before = ALLOCATOR.current_usage();
        for package in &packages {
            sender.send(robot, package);
            while robot.poll_event().is_some() {}
        }
        let layer = robot.fusion().layer(sender.stream).unwrap();
        assert!(layer.block_count() <= 512 && layer.len() > 10_000, "{} voxels", layer.len());
        is_within(robot, before, 4 << 20);
    });

    // As many voxels in a datagram as may be, again and again, and nobody takes the events.
    let mut sender = Sender::new(2);
    // The largest that a package may say.
    let cube = cube(32);
    let packages: Vec<Package> = (0..2_500).flat_map(|_| sender.encode(Codec::Paper, &cube, None)).collect();
    assert!(packages.iter().all(|package| package.bytes().len() <= PACKAGE_BYTES_MAX));
    case("events that nobody takes", config(32 << 20), 2 << 20, |robot| {
        for package in &packages {
            sender.send(robot, package);
        }
        assert_eq!(robot.counters().merged, packages.len() as u64);
        assert!(robot.counters().events_dropped > 0);
    });

    // Blocks far apart, more than there may be.
    let mut sender = Sender::new(2);
    let apart = (0..3_000).map(|n| Changes::from_voxels([(Voxel::new(n * 700, 0, 0), State::Occupied)]));
    let packages: Vec<Package> =
        apart.flat_map(|changes| sender.encode(Codec::Raw, &changes, None)).collect();
    case("blocks far apart", config(2 << 20), 1_800_000, |robot| {
        let before = ALLOCATOR.current_usage();
        for package in &packages {
            sender.send(robot, package);
            while robot.poll_event().is_some() {}
        }
        is_within(robot, before, 2 << 20);
    });

    // Batches with a sensor each, of which nothing stands.
    let mut sender = Sender::new(2);
    let packages: Vec<Package> = (0..20_000)
        .flat_map(|n| {
            // A wall: of few voxels the codec would not say where they were seen from.
            let wall =
                (0..320).map(|at| (Voxel::new(20, at % 16, at / 16), [State::Free, State::Occupied][n % 2]));
            sender.encode(Codec::Flock, &Changes::from_voxels(wall), None)
        })
        .collect();
    assert!(packages.iter().all(|package| package.sensor().is_some()));
    case("batches of which nothing stands", config(2 << 20), 500_000, |robot| {
        for package in &packages {
            sender.send(robot, package);
            while robot.poll_event().is_some() {}
        }
        assert_eq!(robot.counters().merged, 20_000);
        let bytes = robot.fusion().memory_bytes_of_others(robot.mapper());
        assert!(bytes < 200_000, "{bytes}: 20,000 sensors would be a million");
    });

    // As many snapshots as are received at once, never completed, and two more, for which there is no place.
    let states: Vec<(Sender, Vec<Package>)> = (2..12)
        .map(|id| {
            let mut sender = Sender::new(id);
            let mut chunks = sender.send_state(20);
            chunks.pop();
            (sender, chunks)
        })
        .collect();
    let mut large = config(16 << 20);
    (large.session.peers_max, large.session.streams_max) = (16, 16);
    case("snapshots that are being read", large, 17_000_000, |robot| {
        for (sender, chunks) in &states {
            for chunk in chunks {
                sender.send(robot, chunk);
                while robot.poll_event().is_some() {}
            }
        }
        assert!(robot.session().counters().too_many_transfers > 0 && robot.counters().no_room > 0);
        assert_eq!(robot.counters().damaged, 0);
    });

    // One that is larger than all that are being read may be.
    let mut sender = Sender::new(2);
    let chunks = sender.send_state(32);
    case("a snapshot that is too large", config(16 << 20), 10_000_000, |robot| {
        let mut refused = 0;
        for chunk in &chunks {
            sender.send(robot, chunk);
            while let Some(event) = robot.poll_event() {
                let is_refused = matches!(event, Event::Refused { reason: Refusal::Chunks { .. }, .. });
                refused += u64::from(is_refused);
            }
        }
        assert!(refused > 0 && robot.counters().no_room == refused, "{refused}, {:?}", robot.counters());
        assert!(
            robot.fusion().layer(sender.stream).unwrap().block_count() > 8_000,
            "what was read before is merged"
        );
    });

    // Packages that wait for one that never comes.
    let mut sender = Sender::new(2);
    let mut layer = Layer::default();
    let far = |n: i32| {
        Changes::from_voxels((0..200).map(|k| (Voxel::new((k * 37 + n) % 90, k % 9, n % 7), State::Free)))
    };
    layer.apply(&far(0), Stamp(1));
    sender.encode(Codec::Flock, &far(0), None);
    let packages: Vec<Package> = (0..1_500)
        .flat_map(|n| {
            let base = Base { layer: Some(&layer), batches: &[(Stamp(1), 1)], readers: &[] };
            sender.encode(Codec::Flock, &far(n), Some(&base))
        })
        .collect();
    case("packages that wait", config(1 << 20), 300_000, |robot| {
        for package in &packages {
            sender.send(robot, package);
        }
        assert!(robot.session().counters().waiting_dropped > 0, "{:?}", robot.counters());
    });
}
