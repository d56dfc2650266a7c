//! The datagrams that cost a robot most, made by somebody who has no key because there is none: for each kind
//! of package the worst that a search finds, in milliseconds, and in milliseconds for each kilobyte on the
//! air.
//!
//! `cargo run --release -p flockmap --example worst_datagram [PART OF A NAME]`
//!
//! *decode*: reading all packages of the datagram, refused or not. *robot*: `Robot::handle_datagram` where
//! the checks are right, so that what was read is merged into a layer and the fused map. *aligned*: the same
//! where the frame of the sender is turned.
//!
//! Each of the three is done once more in [`counted`], in this order, so that instructions can be counted,
//! row by row:
//!
//! `valgrind --tool=callgrind --toggle-collect=worst_datagram::counted --dump-after=worst_datagram::counted
//! target/release/examples/worst_datagram PART`

use std::hint::black_box;
use std::time::Instant;

use flate2::{Compress, Compression, FlushCompress};
use flockmap::codec::{ChunksRead, ContentKind, Decoder, Header, PACKAGE_BYTES_MAX, PackageError, Priority};
use flockmap::grid::{Layer, VoxelBox};
use flockmap::sync::wire::{DatagramHeader, Kind, PackagesWriter};
use flockmap::{
    Changes, Codec, Package, Pose, Resolution, Robot, RobotConfig, RobotId, Stamp, State, Stream, Voxel,
};

const SENDER: Stream = Stream { origin: RobotId(7), epoch: 1 };
/// Measured so often; the shortest counts, since what else runs on the machine only adds.
const TIMES: usize = 9;

/// A payload, and what its header has to say of it.
struct Draft {
    size: [u32; 3],
    stamps: u64,
    payload: Vec<u8>,
}

/// What is made worst of.
struct Case {
    name: String,
    codec: Codec,
    is_snapshot: bool,
    /// Coded against the layer of [`known`].
    is_against: bool,
    /// All drafts with at most so many bytes.
    drafts: Box<dyn Fn(usize) -> Vec<Draft>>,
}

fn main() {
    println!(
        "ms for a datagram, and ms/KB:      decode          robot        aligned   verdict, packages, box"
    );
    let layer = known();
    // Names to look at, or all.
    let filter = std::env::args().nth(1).unwrap_or_default();
    for case in cases().into_iter().filter(|case| case.name.contains(&filter)) {
        report(&case, &layer, PACKAGE_BYTES_MAX);
        // As many short ones as there is room for.
        report(&case, &layer, 64);
    }
}

/// What it takes in milliseconds, the packages, their box.
type Found = (f64, Vec<Package>, [u32; 3]);

/// Finds the draft that is worst to read, and that which is worst to merge from a turned frame; says what
/// they cost.
fn report(case: &Case, layer: &Layer, package_bytes: usize) {
    let mut decoder = Decoder::new();
    let mut worst: [Option<Found>; 2] = [None, None];
    // No header is longer.
    for draft in (case.drafts)(package_bytes - 38) {
        let Some(packages) = fill(case, &draft, &mut decoder, layer) else { continue };
        let read = shortest(2, || decode_all(&packages, layer));
        let is_taken = decode_one(&mut decoder, &packages[0], layer).is_ok();
        let merged = if is_taken { robot_ms(case, &packages, layer, &turned()) } else { 0.0 };
        for (worst, ms) in worst.iter_mut().zip([read, merged]) {
            if worst.as_ref().is_none_or(|(most, ..)| ms > *most) {
                *worst = Some((ms, packages.clone(), draft.size));
            }
        }
    }
    let [Some((_, read, size)), Some((most, merged, size_merged))] = worst else { return };
    print(case, layer, &read, size);
    if most > 0.0 && merged[0].bytes() != read[0].bytes() {
        print(case, layer, &merged, size_merged);
    }
}

/// A frame that lies otherwise.
fn turned() -> Pose {
    Pose::from_yaw([3.3, -1.2, 0.4], 0.3)
}

fn print(case: &Case, layer: &Layer, packages: &[Package], size: [u32; 3]) {
    let bytes = datagram(packages).len();
    let decode = shortest(TIMES, || decode_all(packages, layer));
    let verdict = match decode_one(&mut Decoder::new(), &packages[0], layer) {
        Ok(()) => "taken".to_owned(),
        Err(error) => error.to_string(),
    };
    let [robot, aligned] =
        [Pose::IDENTITY, turned()].map(|pose| shortest(TIMES, || robot_ms(case, packages, layer, &pose)));
    let mut decoder = Decoder::new();
    counted(|| {
        for package in packages {
            let _ = black_box(decode_one(&mut decoder, package, layer));
        }
    });
    for pose in [Pose::IDENTITY, turned()] {
        let (mut robot, bytes) = (robot_for(case, layer, &pose), datagram(packages));
        counted(|| robot.handle_datagram(Stamp(2_000), &bytes));
    }
    let per_kb = |ms: f64| ms * 1024.0 / bytes as f64;
    println!(
        "{:<30} {decode:>7.3} {:>6.3} {robot:>7.3} {:>6.3} {aligned:>7.3} {:>6.3}   {verdict:.90}; {} × {} B, {size:?}",
        case.name,
        per_kb(decode),
        per_kb(robot),
        per_kb(aligned),
        packages.len(),
        packages[0].bytes().len(),
    );
}

fn decode_one(decoder: &mut Decoder, package: &Package, layer: &Layer) -> Result<(), PackageError> {
    if matches!(package.header().content, ContentKind::Snapshot { .. })
        && package.header().codec == Codec::Flock
    {
        return decoder.decode_chunk(package, &mut ChunksRead::default()).map(drop);
    }
    decoder.decode_against(package, Some(layer)).map(drop)
}

fn decode_all(packages: &[Package], layer: &Layer) -> f64 {
    thread_local!(static DECODER: std::cell::RefCell<Decoder> = Decoder::new().into());
    DECODER.with_borrow_mut(|decoder| {
        let start = Instant::now();
        for package in packages {
            let package = Package::parse(package.bytes()).unwrap();
            let _ = black_box(decode_one(decoder, &package, layer));
        }
        start.elapsed().as_secs_f64() * 1e3
    })
}

fn shortest(times: usize, measure: impl FnMut() -> f64) -> f64 {
    std::iter::repeat_with(measure).take(times).fold(f64::INFINITY, f64::min)
}

/// Has a name of its own for the profiler.
#[inline(never)]
fn counted<T>(work: impl FnOnce() -> T) {
    drop(black_box(work()));
}

/// A robot that gets a datagram of a case.
fn robot_for(case: &Case, layer: &Layer, pose: &Pose) -> Robot {
    let config = RobotConfig::new(RobotId(1), resolution(), 7.0);
    let mut robot = Robot::new(config, Stamp(0)).unwrap();
    if case.is_against {
        let state = layer.snapshot().unwrap();
        let changes = &state.parts[0].1;
        let mut encoder = flockmap::codec::Encoder::new();
        let batch = flockmap::Batch {
            stream: SENDER,
            start: Stamp(1),
            end: Stamp(1),
            resolution: resolution(),
            sensor: [0; 3],
        };
        for package in encoder.encode_batch(Codec::Flock, &batch, 1, changes, PACKAGE_BYTES_MAX).unwrap() {
            robot.handle_datagram(Stamp(10), &datagram(&[package])).unwrap();
        }
    }
    robot.set_alignment(SENDER.origin, pose).unwrap();
    robot.finish_rebuild();
    robot
}

/// What a robot takes for a datagram, with whatever of it is merged.
fn robot_ms(case: &Case, packages: &[Package], layer: &Layer, pose: &Pose) -> f64 {
    let (mut robot, bytes) = (robot_for(case, layer, pose), datagram(packages));
    let start = Instant::now();
    let _ = black_box(robot.handle_datagram(Stamp(2_000), &bytes));
    start.elapsed().as_secs_f64() * 1e3
}

fn datagram(packages: &[Package]) -> Vec<u8> {
    let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender: SENDER, stamp: Stamp(5) };
    let mut writer = PackagesWriter::new(header, 1_200);
    for package in packages {
        assert!(writer.push(package), "{package:?}");
    }
    writer.finish()
}

/// As many packages with this payload as a datagram takes, with right checks if they can be read at all.
fn fill(case: &Case, draft: &Draft, decoder: &mut Decoder, layer: &Layer) -> Option<Vec<Package>> {
    let mut packages = Vec::new();
    let mut room = 1_200 - 24;
    for index in 500.. {
        let package = package(case, draft, index, decoder, layer)?;
        let bytes = package.bytes().len() + 3;
        if package.bytes().len() > PACKAGE_BYTES_MAX || bytes > room {
            break;
        }
        room -= bytes;
        packages.push(package);
    }
    (!packages.is_empty()).then_some(packages)
}

fn package(case: &Case, draft: &Draft, index: u32, decoder: &mut Decoder, layer: &Layer) -> Option<Package> {
    let [x, y, z] = draft.size.map(|side| -(side as i32 / 2) & !7);
    let content = match case.is_snapshot {
        false => ContentKind::Changes,
        true => ContentKind::Snapshot { since: 0, id: index, chunk: 0, chunks: 1 },
    };
    let mut header = Header {
        stream: SENDER,
        index,
        batch_start: Stamp(1_000_000 + i64::from(index)),
        batch_end: Stamp(1_000_000 + i64::from(index) + draft.stamps.max(1) as i64 - 1),
        base: if case.is_against { 1 } else { 0 },
        is_independent: !case.is_against,
        resolution: resolution(),
        region: VoxelBox::new(Voxel::new(x, y, z), draft.size)?,
        codec: case.codec,
        content,
        lost_upto: None,
        changed_upto: None,
        says_upto: None,
        is_cut: false,
        is_of_all: false,
        priority: Priority::Obstacles,
    };
    let mut check = 0;
    for _ in 0..3 {
        let package = Package::from_parts(&header, &draft.payload, check);
        match decode_one(decoder, &package, layer) {
            Err(PackageError::Check { found, .. }) => check = found,
            Err(PackageError::Header { .. }) => header.priority = Priority::NearFree,
            _ => return Some(package),
        }
    }
    None
}

fn resolution() -> Resolution {
    Resolution::from_micrometres(100_000).unwrap()
}

/// A layer that knows something of every block of a large box.
fn known() -> Layer {
    let side = 24;
    let blocks = (0..side * side * side)
        .map(|n| [n % side, n / side % side, n / side / side].map(|at| (at - side / 2) * 8));
    let voxels =
        blocks.flat_map(|[x, y, z]| (0..6).map(move |n| (Voxel::new(x + n, y + 3, z + n / 2), State::Free)));
    let mut layer = Layer::default();
    layer.apply(&Changes::from_voxels(voxels), Stamp(1));
    layer
}

/// Sides of boxes of about so many voxels: cubes, and what is thin.
fn boxes(voxels: u64) -> Vec<[u32; 3]> {
    let cube = (voxels as f64).cbrt() as u32;
    let flat = (voxels as f64 / 8.0).sqrt() as u32;
    let line = u32::try_from(voxels).unwrap_or(1);
    [[cube; 3], [flat, flat, 8], [1, 1, line], [line, 1, 1]]
        .into_iter()
        .filter(|size| !size.contains(&0))
        .collect()
}

fn volume(size: [u32; 3]) -> usize {
    size.iter().map(|side| *side as usize).product()
}

/// A zlib stream of exactly so many bytes where it is shorter: empty blocks say nothing.
fn zlib(data: &[u8], length: usize) -> Option<Vec<u8>> {
    let mut body = Vec::with_capacity(data.len() / 2 + 1_000);
    let mut state = Compress::new(Compression::new(9), false);
    state.compress_vec(data, &mut body, FlushCompress::Finish).ok()?;
    let (a, b) = data.iter().fold((1u32, 0u32), |(a, b), byte| {
        let a = (a + u32::from(*byte)) % 65_521;
        (a, (b + a) % 65_521)
    });
    let mut out = vec![0x78, 0x9c];
    while out.len() + 5 + body.len() + 4 <= length {
        out.extend([0, 0, 0, 0xff, 0xff]);
    }
    out.extend(body);
    out.extend((b << 16 | a).to_be_bytes());
    (out.len() <= length).then_some(out)
}

/// Packed codes of a box: `pattern` repeated, the bits after the last code zero.
fn codes(voxels: usize, pattern: &[u8]) -> Vec<u8> {
    let mut bytes: Vec<u8> = pattern.iter().copied().cycle().take(voxels.div_ceil(4)).collect();
    if let (Some(last), rest @ 1..) = (bytes.last_mut(), voxels % 4) {
        *last &= (1 << (2 * rest)) - 1;
    }
    bytes
}

/// A pattern in which one byte of so many differs.
fn sparse(nothing: u8, something: u8, every: usize) -> Vec<u8> {
    let mut pattern = vec![nothing; every];
    pattern[every / 2] = something;
    pattern
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// Bytes that draw each decision somehow.
fn decisions(kind: usize, length: usize) -> Vec<u8> {
    let mut random = 0x9e37_79b9_7f4a_7c15u64;
    (0..length)
        .map(|at| {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            match kind {
                0 => 0,
                1 => 0xff,
                2 => (random >> 33) as u8,
                3 => {
                    if at % 16 == 0 {
                        0xff
                    } else {
                        0
                    }
                }
                4 => {
                    if at % 16 == 0 {
                        0
                    } else {
                        0xff
                    }
                }
                5 => (random >> 33) as u8 & (random >> 41) as u8 & (random >> 49) as u8,
                _ => (random >> 33) as u8 | (random >> 41) as u8 | (random >> 49) as u8,
            }
        })
        .collect()
}

fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    let nothing = 0xff;
    let patterns: Vec<(&str, Vec<u8>)> = vec![
        ("nothing", vec![nothing]),
        ("all Free", vec![0]),
        ("all Occupied", vec![0x55]),
        ("checkerboard", vec![0x44]),
        ("every other", vec![0xcc]),
        ("one of 32", sparse(nothing, 0xfc, 8)),
        ("one of 128", sparse(nothing, 0xfc, 32)),
        ("one of 512", sparse(nothing, 0xfc, 128)),
        ("one of 4,096", sparse(nothing, 0xfc, 1_024)),
    ];
    for codec in [Codec::Paper, Codec::NestedZlib] {
        for (name, pattern) in patterns.clone() {
            let drafts = move |length: usize| grids(length, &pattern);
            cases.push(Case::changes(format!("{codec}, {name}"), codec, drafts));
        }
        let unknown = 0xaa;
        for (name, pattern) in [
            ("nothing", vec![unknown]),
            ("all Free", vec![0]),
            ("every other", vec![0x88]),
            ("one of 512", sparse(unknown, 0xa8, 128)),
        ] {
            for stamps in [1u64, 2, 40, 300] {
                let pattern = pattern.clone();
                let drafts = move |length: usize| chunks(length, &pattern, stamps);
                cases.push(Case::snapshot(format!("{codec}, {name}, {stamps} stamps"), codec, drafts));
            }
        }
    }
    cases.push(Case::changes("raw, all Free".into(), Codec::Raw, |length| {
        let side = ((length * 4) as f64).cbrt() as u32;
        let sizes = [[side; 3], [length as u32 * 4, 1, 1]];
        sizes.map(|size| Draft { size, stamps: 1, payload: codes(volume(size), &[0]) }).into()
    }));
    cases.push(Case::changes("racer, voxels far apart".into(), Codec::Racer, |length| {
        let entry = |n: usize| [&(n as u32 * 512).to_le_bytes()[..], &[1]].concat();
        vec![Draft { size: [8, 8, 1 << 21], stamps: 1, payload: (0..length / 5).flat_map(entry).collect() }]
    }));
    for is_against in [false, true] {
        let against = if is_against { ", against" } else { "" };
        cases.push(Case {
            is_against,
            ..Case::changes(format!("flock{against}"), Codec::Flock, |length| {
                let sides = [1, 2, 4, 6, 8, 10, 12, 16, 20, 24, 32, 48, 63];
                let sizes =
                    sides.map(|side| [side * 8; 3]).into_iter().chain([[8, 8, 1 << 21], [1 << 14, 8, 8]]);
                let payload = |size: [u32; 3], kind, before| {
                    let mut payload = vec![before, 0, 0, 0];
                    varint(&mut payload, volume(size) as u64 / 512 - u64::from(before >> 2));
                    let rest = length.saturating_sub(payload.len());
                    payload.extend(decisions(kind, rest));
                    Draft { size, stamps: 1, payload }
                };
                sizes
                    .flat_map(|size| {
                        (0..7).flat_map(move |kind| {
                            [0, 1, 2].map(|snapshot_id| payload(size, kind, snapshot_id))
                        })
                    })
                    .collect()
            })
        });
    }
    cases.push(Case::changes("flock, noise".into(), Codec::Flock, |length| {
        let sizes = [1, 3, 4, 6, 8, 12, 16, 20, 24, 32, 48, 64].map(|side| [side * 8; 3]);
        let draft = |size, kind, head: u32| {
            let mut payload = vec![3];
            payload.extend(head.to_be_bytes());
            payload.extend(decisions(kind, length.saturating_sub(5)));
            payload.truncate(length);
            Draft { size, stamps: 1, payload }
        };
        let mut drafts = Vec::new();
        for size in sizes {
            for head in (0..64u32).map(|head| head * 0x0400_0000) {
                drafts.extend((0..7).map(|kind| draft(size, kind, head)));
            }
        }
        drafts
    }));
    cases.push(Case::snapshot("flock, chunk of sections".into(), Codec::Flock, |length| {
        let mut drafts = Vec::new();
        for side in [1u64, 2, 4, 6, 8, 12, 16, 24, 32, 63] {
            for rest in [6, 16, 40, 100, 300, 1_000] {
                for kind in 0..7 {
                    let size = [8 * side as u32; 3];
                    let mut payload = Vec::new();
                    loop {
                        let mut section = vec![u8::from(!payload.is_empty())];
                        section.extend([0; 3]);
                        (0..3).for_each(|_| varint(&mut section, side - 1));
                        let mut body = vec![0, 0, 0, 0];
                        varint(&mut body, side.pow(3));
                        body.extend(decisions(kind, rest));
                        varint(&mut section, body.len() as u64);
                        section.extend(body);
                        if payload.len() + section.len() > length {
                            break;
                        }
                        payload.extend(section);
                    }
                    if !payload.is_empty() {
                        drafts.push(Draft { size, stamps: 100, payload });
                    }
                }
            }
        }
        drafts
    }));
    cases
}

/// Boxes of many sizes, filled with a pattern.
fn grids(length: usize, pattern: &[u8]) -> Vec<Draft> {
    let sizes = (6..=17).flat_map(|n| boxes((length as u64 * 4_128) >> (17 - n)));
    sizes
        .filter_map(|size| {
            Some(Draft { size, stamps: 1, payload: zlib(&codes(volume(size), pattern), length)? })
        })
        .collect()
}

/// The same as a snapshot, the stamps one after the other.
fn chunks(length: usize, pattern: &[u8], stamps: u64) -> Vec<Draft> {
    let sizes = (4..=16).flat_map(|n| boxes((length as u64 * 4_128) >> (17 - n)));
    let draft = |size: [u32; 3]| {
        let voxels = volume(size);
        let codes = codes(voxels, pattern);
        let known = (0..voxels).filter(|at| codes[at / 4] >> (2 * (at % 4)) & 3 != 2).count();
        let mut tail = Vec::new();
        if stamps > 1 && known as u64 >= stamps {
            let mut bytes = Vec::new();
            varint(&mut bytes, stamps);
            bytes.extend((1..stamps).map(|_| 1));
            bytes.extend((0..known).map(|n| (n as u64 % stamps) as u8));
            if stamps > 256 {
                bytes.extend((0..known).map(|n| ((n as u64 % stamps) >> 8) as u8));
            }
            tail = zlib_short(&bytes)?;
        }
        let states = zlib(&codes, length.checked_sub(tail.len() + 2)?)?;
        let mut payload = Vec::new();
        varint(&mut payload, states.len() as u64);
        payload.extend(states);
        payload.extend(&tail);
        Some(Draft { size, stamps: if tail.is_empty() { 1 } else { stamps }, payload })
    };
    sizes.filter_map(draft).collect()
}

/// As short as it gets.
fn zlib_short(data: &[u8]) -> Option<Vec<u8>> {
    let mut length = 64;
    while length < 4_096 {
        if let Some(stream) = zlib(data, length) {
            return Some(stream);
        }
        length *= 2;
    }
    None
}

impl Case {
    fn changes(name: String, codec: Codec, drafts: impl Fn(usize) -> Vec<Draft> + 'static) -> Self {
        Self { name, codec, is_snapshot: false, is_against: false, drafts: Box::new(drafts) }
    }

    fn snapshot(name: String, codec: Codec, drafts: impl Fn(usize) -> Vec<Draft> + 'static) -> Self {
        Self { is_snapshot: true, ..Self::changes(name, codec, drafts) }
    }
}
