//! Any bytes as a package: refused, or they say something that the format allows and that can be said again.
//!
//! Input: a byte that chooses the layer which the package is decoded against, and the package.

use flockmap_codec::{
    Base, Batch, Codec, Content, ContentKind, EncodeError, Header, PACKAGE_BYTES_MAX, Package, PackageError,
};
use flockmap_grid::{BlockIndex, Changes, Layer, Snapshot, Stamp, StateBlock, VoxelBox};

use super::{Fuzz, Random, grid};

/// What is larger is not encoded again: it takes long.
const AGAIN_BLOCKS_MAX: usize = 64;
const AGAIN_VOXELS_MAX: u128 = 1 << 18;

/// The headers of packages end before this.
const HEADER_BYTES_MAX: usize = 96;

pub(crate) fn run(fuzz: &mut Fuzz, input: &[u8]) {
    let Some((seed, bytes)) = input.split_first() else { return };
    let Ok(package) = Package::parse(bytes) else { return };
    assert_eq!(package.bytes(), bytes);
    let header = *package.header();
    check_header(&header);
    let layer = layer_beside(&header.region, header.batch_end, *seed);
    let (package, content) = match fuzz.decoder.decode_against(&package, layer.as_ref()) {
        Ok(content) => (package, content),
        Err(PackageError::Check { stated, found }) => mended(&package, [stated, found], |package| {
            fuzz.decoder.decode_against(package, layer.as_ref()).ok()
        }),
        Err(error) => return fuzz.digest.add(error.to_string().as_bytes()),
    };
    fuzz.digest.add_content(&content);
    match &content {
        Content::Changes(changes) => {
            check_changes(&header, bytes.len(), changes);
            decode_twice(fuzz, &package, changes, layer.clone());
            say_again(fuzz, &header, changes, layer.as_ref());
        }
        Content::Snapshot(state) => check_snapshot(&header, state),
    }
}

/// What was decoded is of interest though its check was wrong: the package with the check that fits, and what
/// it says.
pub(crate) fn mended<T>(
    package: &Package,
    [stated, found]: [u32; 2],
    mut decode: impl FnMut(&Package) -> Option<T>,
) -> (Package, T) {
    let bytes = package.bytes();
    for at in 0..bytes.len().min(HEADER_BYTES_MAX) {
        if bytes[at..].starts_with(&stated.to_le_bytes()) {
            let bytes = [&bytes[..at], &found.to_le_bytes(), &bytes[at + 4..]].concat();
            if let Ok(mended) = Package::parse(&bytes)
                && mended.header() == package.header()
                && let Some(content) = decode(&mended)
            {
                return (mended, content);
            }
        }
    }
    panic!("decoded once more it says something else: {package:?}")
}

fn check_header(header: &Header) {
    assert!(header.index > 0 && header.base < header.index);
    assert!(header.batch_start <= header.batch_end);
    assert!(header.is_independent || header.base > 0);
    assert_eq!(header.region.intersection(&grid()), Some(header.region));
    if let ContentKind::Snapshot { chunk, chunks, .. } = header.content {
        assert!(chunk < chunks && header.is_independent && header.base == 0);
    }
}

/// What all packages keep to, and what bounds the memory that a package makes a receiver hold.
fn check_changes(header: &Header, bytes: usize, changes: &Changes) {
    assert!(lies_in(changes, &header.region), "{changes:?} in {:?}", header.region);
    let (voxels, blocks) = (changes.len(), changes.blocks().len());
    match header.codec {
        Codec::Raw => assert!(voxels <= 4 * bytes),
        Codec::Racer => assert!(voxels <= bytes / 5),
        Codec::Flock => assert!(blocks <= 4 * bytes || voxels <= 16 * bytes + 64),
        _ => assert!(voxels <= 4 * 1_032 * bytes),
    }
}

pub(crate) fn check_snapshot(header: &Header, state: &Snapshot) {
    assert_eq!(state.region, header.region);
    assert!(state.parts.is_sorted_by(|a, b| a.0 < b.0));
    for (stamp, part) in &state.parts {
        assert!((header.batch_start..=header.batch_end).contains(stamp));
        assert!(!part.is_empty() && lies_in(part, &header.region));
    }
    let all = Changes::from_blocks(state.parts.iter().flat_map(|part| part.1.blocks()).copied().collect());
    assert_eq!(all.len(), state.parts.iter().map(|part| part.1.len()).sum::<usize>());
}

fn lies_in(changes: &Changes, region: &VoxelBox) -> bool {
    changes.is_empty() || changes.bounding_box().is_some_and(|found| found.union(region) == *region)
}

/// A package that comes again after it was merged.
fn decode_twice(fuzz: &mut Fuzz, package: &Package, changes: &Changes, layer: Option<Layer>) {
    let Some(mut layer) = layer else { return };
    layer.apply(changes, package.header().batch_end);
    match fuzz.decoder.decode_against(package, Some(&layer)) {
        Ok(content) => assert_eq!(content, Content::Changes(changes.clone())),
        Err(PackageError::BaseSuperseded(_)) => {}
        Err(error) => panic!("{error}"),
    }
}

/// What could be read can be written, in packages of usual size.
fn say_again(fuzz: &mut Fuzz, header: &Header, changes: &Changes, layer: Option<&Layer>) {
    if changes.blocks().len() > AGAIN_BLOCKS_MAX || header.region.volume() > AGAIN_VOXELS_MAX {
        return;
    }
    let batch = Batch {
        stream: header.stream,
        start: header.batch_start,
        end: header.batch_end,
        resolution: header.resolution,
        // Sixteenths of a voxel, up to 2³¹ of them: most places of the grid are out of reach.
        sensor: {
            let Some(corner) = changes.voxels().next().map(|(voxel, _)| voxel) else { return };
            [corner.x, corner.y, corner.z].map(|at| at.saturating_mul(16))
        },
    };
    let base = Base { layer, batches: &[], readers: &[] };
    let packages = fuzz.encoder.encode_batch_against(
        header.codec,
        &batch,
        header.index,
        changes,
        Some(&base),
        PACKAGE_BYTES_MAX,
    );
    let packages = match packages {
        Ok(packages) => packages,
        // The layer may hold something newer; there may be no index left.
        Err(EncodeError::BaseSuperseded(_) | EncodeError::IndexOutOfRange { .. }) => return,
        Err(error) => panic!("{error}"),
    };
    let mut blocks = Vec::new();
    for package in &packages {
        fuzz.note(package);
        match fuzz.decoder.decode_against(package, layer) {
            Ok(Content::Changes(piece)) => blocks.extend_from_slice(piece.blocks()),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(&Changes::from_blocks(blocks), changes);
}

/// What a receiver may hold in and beside a box: nothing, older batches, the same batch, or even a newer one.
pub(crate) fn layer_beside(region: &VoxelBox, batch_end: Stamp, seed: u8) -> Option<Layer> {
    if seed == 0 {
        return None;
    }
    let mut random = Random(seed.into());
    let (low, high) = (region.min().block(), region.max().block());
    let mut layer = Layer::default();
    for older in [1_000_000, 500_000, (seed % 4).min(1).into(), (seed % 16).min(1).into()] {
        let blocks = (0..seed % 24).map(|_| {
            let mut place = |low: i32, high: i32| {
                let width = (high - low).min(3) as u64 + 3;
                low - 1 + (random.next() % width) as i32
            };
            let index = BlockIndex::new(place(low.x, high.x), place(low.y, high.y), place(low.z, high.z));
            (index, block(&mut random))
        });
        let changes = Changes::from_blocks(blocks.collect()).within(&grid());
        let stamp = batch_end.plus_micros(-older);
        layer.apply(&changes, if seed % 64 == 63 { stamp.plus_micros(1) } else { stamp });
    }
    Some(layer)
}

/// Free space, a wall, or anything.
fn block(random: &mut Random) -> StateBlock {
    match random.next() % 4 {
        0 => StateBlock::new([u64::MAX; 8], [0; 8]),
        1 => StateBlock::new([u64::MAX; 8], [0x0101_0101_0101_0101 << (random.next() % 8); 8]),
        2 => StateBlock::new(core::array::from_fn(|_| random.next()), [0; 8]),
        _ => StateBlock::new(
            core::array::from_fn(|_| random.next()),
            core::array::from_fn(|_| random.next() & random.next()),
        ),
    }
}
