//! No package asks for more work than its length allows: what is encoded stays within it, and what goes
//! beyond is refused early.

mod common;

use common::{batch, changes, forest_batch, resolution, stream};
use flate2::{Compress, Compression, FlushCompress};
use flockmap_codec::{
    Base, ChunksRead, Codec, Content, Decoder, EncodeError, Encoder, Header, PACKAGE_BYTES_MAX, Package,
    PackageError, Priority,
};
use flockmap_grid::{Changes, Layer, Snapshot, Stamp, State, Voxel, VoxelBox};
use proptest::prelude::*;

/// The most steps for a package of so many bytes, all of which are taken for payload.
fn limit(package: &Package) -> u64 {
    224 * package.bytes().len() as u64 + 6_144
}

/// A box full of one state, of two in layers, or with few voxels far apart: what compresses best.
fn smooth() -> impl Strategy<Value = Changes> {
    let size = prop_oneof![[1..30i32, 1..30, 1..24], [1..4i32, 1..4, 1..900]];
    (size, [1..5i32, 1..5, 1..5], 1..60i32, -90..90i32).prop_map(|(size, step, layer, corner)| {
        let all = (0..size[0]).step_by(step[0] as usize).flat_map(move |x| {
            let rows = (0..size[1]).step_by(step[1] as usize);
            rows.flat_map(move |y| (0..size[2]).step_by(step[2] as usize).map(move |z| [x, y, z]))
        });
        Changes::from_voxels(all.map(|[x, y, z]| {
            let state = if z / layer % 2 == 0 { State::Free } else { State::Occupied };
            (Voxel::new(corner + x, y - corner, z), state)
        }))
    })
}

fn few_far_apart() -> impl Strategy<Value = Changes> {
    prop::collection::vec([-90..90i32, -90..90, -20..20], 1..30).prop_map(|places| {
        Changes::from_voxels(places.into_iter().map(|[x, y, z]| (Voxel::new(x, y, z), State::Occupied)))
    })
}

fn read_all(packages: &[Package]) -> usize {
    let (mut decoder, mut before) = (Decoder::new(), ChunksRead::default());
    let read = |package: &Package| {
        let is_chunk = package.header().content != flockmap_codec::ContentKind::Changes;
        let voxels = if is_chunk && package.header().codec == Codec::Flock {
            let state = decoder.decode_chunk(package, &mut before).unwrap();
            state.parts.iter().map(|(_, part)| part.len()).sum()
        } else {
            match decoder.decode(package).unwrap() {
                Content::Changes(changes) => changes.len(),
                Content::Snapshot(state) => state.parts.iter().map(|(_, part)| part.len()).sum(),
            }
        };
        assert!(decoder.steps() <= limit(package), "{} steps for {package:?}", decoder.steps());
        voxels
    };
    packages.iter().map(read).sum()
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(16) })]

    #[test]
    fn whatever_is_encoded_is_read_within_the_limit(
        changes in prop_oneof![2 => smooth(), 1 => few_far_apart(), 1 => changes()],
        bytes_max in prop_oneof![Just(PACKAGE_BYTES_MAX), 600..1_200usize],
        stamps in 1..6i32,
    ) {
        let mut encoder = Encoder::new();
        for codec in Codec::ALL {
            let packages = encoder.encode_batch(codec, &batch(), 1, &changes, bytes_max).unwrap();
            prop_assert_eq!(read_all(&packages), changes.len());
            match encoder.encode_whole(codec, &batch(), 1, &changes) {
                Ok(whole) => prop_assert_eq!(read_all(&[whole]), changes.len()),
                Err(EncodeError::TooMuchWork | EncodeError::BoxTooLarge { .. }) => {}
                Err(other) => panic!("{other}"),
            }
            let part = |stamp| {
                let of = |voxel: Voxel| (voxel.x >> 3).rem_euclid(stamps) == stamp;
                let part = Changes::from_voxels(changes.voxels().filter(|(voxel, _)| of(*voxel)));
                (Stamp(i64::from(stamp)), part)
            };
            let parts = (0..stamps).map(part).filter(|(_, part)| !part.is_empty()).collect();
            let state = Snapshot { region: changes.bounding_box().unwrap(), parts, sensors: Vec::new() };
            let chunks = encoder.encode_snapshot(codec, stream(), 9, resolution(), &state, bytes_max).unwrap();
            prop_assert_eq!(read_all(&chunks), changes.len());
        }
    }
}

/// A package of `paper` whose box is a cube and whose codes are all the same byte.
fn cube(side: u32, byte: u8) -> Package {
    let codes = vec![byte; (side * side * side / 4) as usize];
    let mut payload = Vec::with_capacity(codes.len());
    let mut deflate = Compress::new(Compression::new(9), true);
    deflate.compress_vec(&codes, &mut payload, FlushCompress::Finish).unwrap();
    let header = Header {
        stream: stream(),
        index: 1,
        batch_start: Stamp(0),
        batch_end: Stamp(0),
        base: 0,
        is_independent: true,
        resolution: resolution(),
        region: VoxelBox::new(Voxel::new(0, 0, 0), [side; 3]).unwrap(),
        codec: Codec::Paper,
        content: flockmap_codec::ContentKind::Changes,
        lost_upto: None,
        changed_upto: None,
        says_upto: None,
        is_cut: false,
        is_of_all: false,
        priority: Priority::NearFree,
    };
    let package = Package::from_parts(&header, &payload, 0);
    assert!(package.bytes().len() <= PACKAGE_BYTES_MAX, "{package:?}");
    package
}

#[test]
fn a_large_box_that_says_nothing_takes_one_step_for_32_voxels() {
    let mut decoder = Decoder::new();
    let package = cube(160, 0xff);
    let Err(PackageError::Check { found, .. }) = decoder.decode(&package) else { panic!("a wrong check") };
    assert_eq!(decoder.steps(), 160 * 160 * 160 / 32);
    let right = Package::from_parts(package.header(), payload_of(&package), found);
    assert_eq!(decoder.decode(&right), Ok(Content::Changes(Changes::default())));
}

/// The payload of a package of [`cube`]: from the head of its zlib stream.
fn payload_of(package: &Package) -> &[u8] {
    let at = package.bytes().windows(2).position(|head| head == [0x78, 0xda]).unwrap();
    &package.bytes()[at..]
}

#[test]
fn a_large_box_that_says_much_is_refused_before_a_voxel_is_looked_for() {
    let mut decoder = Decoder::new();
    for (byte, what) in [(0x00, "all Free"), (0x55, "all Occupied"), (0x44, "a checkerboard")] {
        let package = cube(160, byte);
        let limit = 224 * payload_of(&package).len() as u64 + 6_144;
        let error = decoder.decode(&package).unwrap_err();
        let payload = payload_of(&package).len();
        assert_eq!(error, PackageError::Work { codec: Codec::Paper, payload, limit }, "{what}");
        assert!(error.to_string().contains("steps of work"), "{error}");
        // What says nothing was looked for; the 8,000 groups of 128 bytes that say something were not taken up.
        assert_eq!(decoder.steps(), 128_000, "{what}");
    }
}

/// What is known is fetched from a table that may be far larger than a cache.
#[test]
fn blocks_of_which_something_is_known_take_more_steps() {
    let blocks = (0..24 * 24 * 24).map(|n| [n % 24, n / 24 % 24, n / 576].map(|at| at * 8));
    let mut layer = Layer::default();
    let known = blocks.map(|[x, y, z]| (Voxel::new(x + 1, y + 2, z + 3), State::Free));
    layer.apply(&Changes::from_voxels(known), Stamp(-9));
    let header = Header {
        base: 1,
        index: 2,
        is_independent: false,
        codec: Codec::Flock,
        region: VoxelBox::new(Voxel::new(0, 0, 0), [192; 3]).unwrap(),
        ..*cube(8, 0xff).header()
    };
    // Tables and sensor, 13,824 blocks, and decisions that are all the same: of one kind or the other.
    let refused = [0x00, 0xff].map(|byte| {
        let mut payload = vec![0, 0, 0, 0, 0x80, 0x6c];
        payload.resize(800, byte);
        let package = Package::from_parts(&header, &payload, 0);
        [Layer::default(), layer.clone()].map(|layer| {
            let error = Decoder::new().decode_against(&package, Some(&layer)).unwrap_err();
            matches!(error, PackageError::Work { .. })
        })
    });
    assert!(refused.contains(&[false, true]), "{refused:?}");
}

/// Blocks in rows, each with a slab of one state at the height `z` in it.
fn rows(z: i32, blocks: i32, state: State) -> Changes {
    let voxel = |n: i32, at: i32| Voxel::new(n % 12 * 8 + at % 8, n / 12 % 12 * 8 + at / 8, n / 144 * 8 + z);
    Changes::from_voxels((0..blocks).flat_map(|n| (0..40).map(move |at| (voxel(n, at), state))))
}

/// Else a reader could refuse what its writer found to be within the limit.
#[test]
fn a_package_asks_for_the_same_steps_whatever_of_its_batch_was_merged_before() {
    let (mut encoder, mut decoder) = (Encoder::new(), Decoder::new());
    let mut before = Layer::default();
    before.apply(&rows(2, 300, State::Free), Stamp(batch().start.0 - 1));
    let changes = rows(5, 600, State::Free);
    let batches = [(Stamp(batch().start.0 - 1), 1)];
    let base = Base { layer: Some(&before), batches: &batches, readers: &[] };
    let packages =
        encoder.encode_batch_against(Codec::Flock, &batch(), 2, &changes, Some(&base), 300).unwrap();
    assert!(packages.len() > 3 && packages.iter().any(|package| package.header().base > 0));
    let mut steps = Vec::new();
    let mut merged = before.clone();
    for package in &packages {
        let Content::Changes(changes) = decoder.decode_against(package, Some(&before)).unwrap() else {
            panic!()
        };
        steps.push(decoder.steps());
        merged.apply(&changes, batch().end);
    }
    for (package, steps) in packages.iter().zip(steps) {
        decoder.decode_against(package, Some(&merged)).unwrap();
        assert_eq!(decoder.steps(), steps, "{package:?}");
    }
}

/// Few voxels that change among many blocks that are known: the shortest packages, and those that look at most.
#[test]
fn what_is_told_against_a_large_layer_is_read_within_the_limit() {
    let (mut encoder, mut decoder) = (Encoder::new(), Decoder::new());
    let mut before = Layer::default();
    before.apply(&rows(2, 144 * 9, State::Free), Stamp(batch().start.0 - 1));
    let batches = [(Stamp(batch().start.0 - 1), 1)];
    let base = Base { layer: Some(&before), batches: &batches, readers: &[] };
    for every in [1, 2, 5, 17, 60, 400] {
        for state in [State::Free, State::Occupied] {
            let all = rows(2, 144 * 9, state);
            let some = all.voxels().enumerate().filter(|(n, _)| n / 40 % every == 0);
            let moved = some.map(|(_, (voxel, state))| (Voxel::new(voxel.x, voxel.y, voxel.z + 2), state));
            let changes = Changes::from_voxels(moved);
            let encoded =
                encoder.encode_batch_against(Codec::Flock, &batch(), 2, &changes, Some(&base), 1_150);
            let mut read = 0;
            for package in encoded.unwrap() {
                let content = decoder.decode_against(&package, Some(&before)).unwrap();
                let Content::Changes(changes) = content else { panic!() };
                assert!(decoder.steps() <= limit(&package));
                read += changes.len();
            }
            assert_eq!(read, changes.len(), "every {every}");
        }
    }
}

#[test]
fn flights_ask_for_a_fraction_of_the_limit() {
    let (mut encoder, mut decoder) = (Encoder::new(), Decoder::new());
    for codec in Codec::ALL {
        let packages = encoder.encode_batch(codec, &batch(), 1, &forest_batch(), PACKAGE_BYTES_MAX).unwrap();
        for package in packages {
            decoder.decode(&package).unwrap();
            assert!(decoder.steps() * 10 < limit(&package) * 8, "{} steps for {package:?}", decoder.steps());
        }
    }
}
