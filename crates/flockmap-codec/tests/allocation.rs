//! What a received package can make a robot hold.

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use common::{batch, forest_batch, resolution, stream};
use flockmap_codec::{
    Base, Codec, Content, Decoder, EncodeError, Encoder, PACKAGE_BYTES_MAX, Package, PackageError, Span,
};
use flockmap_grid::{Changes, Layer, Snapshot, Stamp, State, Voxel};

/// Counts the bytes that are held, and the most that ever were.
struct Counting;

static HELD: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: hands everything to the system's allocator and only counts.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let held = HELD.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        PEAK.fetch_max(held, Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The most bytes held at once during `work` beyond what was held before.
fn peak_of<R>(work: impl FnOnce() -> R) -> (usize, R) {
    let before = HELD.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    let result = work();
    (PEAK.load(Ordering::Relaxed) - before, result)
}

/// The header of `package` with another box size, and its payload.
fn with_box(package: &Package, size: [u32; 3]) -> Vec<u8> {
    fn varint(mut value: u64, out: &mut Vec<u8>) {
        while value >= 0x80 {
            out.push(value as u8 | 0x80);
            value >>= 7;
        }
        out.push(value as u8);
    }
    let header = package.header();
    // Boxes of `flock` are made of blocks, and counted in these.
    let (unit, flag) = if header.codec == Codec::Flock { (8, 1 << 7) } else { (1, 0) };
    let mut bytes = vec![flockmap_codec::FORMAT_VERSION, flag | header.codec.id()];
    varint(header.stream.origin.0.into(), &mut bytes);
    varint(header.stream.epoch, &mut bytes);
    varint(header.index.into(), &mut bytes);
    let since_epoch =
        header.batch_end.0 - i64::from(flockmap_grid::seconds_of_epoch(header.stream.epoch)) * 1_000_000;
    let is_whole = since_epoch % 10_000 == 0;
    let hundredths = header.batch_end.micros_since(header.batch_start) as u64 / 10_000;
    varint(hundredths << 1 | u64::from(is_whole), &mut bytes);
    varint((if is_whole { since_epoch / 10_000 } else { since_epoch } as u64) << 1, &mut bytes);
    varint(u64::from(header.resolution.micrometres()) / 10_000 * 4, &mut bytes);
    bytes.extend([0, 0, 0]);
    let less_one = size.map(|side| u64::from(side.div_ceil(unit)) - 1);
    if unit == 8 {
        // A bit of each in turns.
        varint((0..63).map(|bit| (less_one[bit % 3] >> (bit / 3) & 1) << bit).sum(), &mut bytes);
    } else {
        less_one.into_iter().for_each(|side| varint(side, &mut bytes));
    }
    // No base, a check, a payload.
    bytes.extend([0; 5]);
    bytes.extend(&package.bytes()[package.bytes().len() - 1000..]);
    bytes
}

/// One test, since the counter is one for the whole process.
#[test]
fn memory_stays_within_the_stated_limits() {
    let mut random = common::Random(5);
    let noise = (0..20_000).map(|_| {
        let mut place = || (random.next() % 60) as i32;
        (Voxel::new(place(), place(), place()), State::Free)
    });
    let noise = Changes::from_voxels(noise.collect::<Vec<_>>());
    let mut encoder = Encoder::new();
    // Tables of the walk are made once.
    encoder.encode_whole(Codec::Paper, &batch(), 1, &noise).unwrap();

    // A box that no package may have, one that the payload cannot fill, and one that it could.
    for codec in Codec::ALL {
        let package = encoder.encode_whole(codec, &batch(), 1, &noise).unwrap();
        for (size, limit) in [
            ([1 << 28, 1 << 28, 1 << 28], 20_000),
            ([1 << 9, 1 << 9, (1 << 9) + 1], 20_000),
            ([4_128_001, 1, 1], if codec == Codec::Racer { 100_000 } else { 20_000 }),
            ([160, 160, 160], 12_000_000),
            ([1, 4_128_000, 1], 12_000_000),
            // The thinnest box that `flock` takes.
            ([8, 8, 1 << 21], 12_000_000),
        ] {
            let bytes = with_box(&package, size);
            let (peak, result) = peak_of(|| Package::parse(&bytes).and_then(|package| package.decode()));
            assert!(result.is_err());
            assert!(peak < limit, "{codec} box {size:?}: {peak} bytes for {result:?}");
            if limit == 20_000 {
                assert!(matches!(
                    result,
                    Err(PackageError::BoxTooLarge { .. }
                        | PackageError::Header { .. }
                        | PackageError::Work { .. })
                ));
            }
        }
    }

    // A huge empty cube is far more than a small package may say.
    let cube = (0..160).flat_map(|x| (0..160).flat_map(move |y| (0..160).map(move |z| (x, y, z))));
    let cube = Changes::from_voxels(cube.map(|(x, y, z)| (Voxel::new(x, y, z), State::Free)));
    assert_eq!(encoder.encode_whole(Codec::Paper, &batch(), 1, &cube), Err(EncodeError::TooMuchWork));
    let mut decoder = Decoder::new();
    for package in encoder.encode_batch(Codec::Paper, &batch(), 1, &cube, PACKAGE_BYTES_MAX).unwrap() {
        let (peak, result) = peak_of(|| decoder.decode(&package));
        result.unwrap();
        assert!(peak < 2_000_000, "{peak}");
    }

    // Chunks of many stamps, over and over with one decoder.
    let mut parts: Vec<(Stamp, Vec<_>)> = (0..300).map(|n| (Stamp(n), Vec::new())).collect();
    for (n, entry) in noise.voxels().enumerate() {
        parts[n % 300].1.push(entry);
    }
    let parts = parts.into_iter().map(|(stamp, voxels)| (stamp, Changes::from_voxels(voxels)));
    let state =
        Snapshot { region: noise.bounding_box().unwrap(), parts: parts.collect(), sensors: Vec::new() };
    let chunks = encoder.encode_snapshot(Codec::Paper, stream(), 1, resolution(), &state, 1150).unwrap();
    let mut decoder = Decoder::new();
    for chunk in &chunks {
        let (peak, result) = peak_of(|| decoder.decode(chunk));
        result.unwrap();
        assert!(peak < 24_000_000, "{peak}");
    }

    voxels_far_apart_take_no_memory_between_them();
    flock_holds_what_it_says_and_no_more_the_second_time();
    a_snapshot_takes_few_bytes_for_each_known_voxel();
}

/// A layer of some 300,000 voxels whose blocks were each changed by a hundred batches or more: a wall of
/// noise that thickens.
fn layer_of_many_stamps() -> Layer {
    let mut layer = Layer::default();
    let mut random = common::Random(7);
    for batch in 0..200i64 {
        let near = (batch / 4) as i32;
        let voxels = (0..5_000).map(|_| {
            let mut place = |side: i32| (random.next() % side as u64) as i32;
            let at = Voxel::new(near + place(60), place(64), place(64));
            (at, if place(30) == 0 { State::Occupied } else { State::Free })
        });
        layer.apply(&Changes::from_voxels(voxels), Stamp(batch * 500_000));
    }
    layer
}

fn a_snapshot_takes_few_bytes_for_each_known_voxel() {
    let layer = layer_of_many_stamps();
    let voxels = layer.len();
    assert!(voxels > 200_000, "{voxels}");
    for codec in [Codec::Flock, Codec::Paper] {
        let mut encoder = Encoder::new();
        for newer_than in [None, Some(Stamp(60_000_000))] {
            let (peak, chunks) = peak_of(|| {
                let state = layer.snapshot_voxels(newer_than).unwrap();
                let span = Span::new(stream(), u32::from(newer_than.is_some()), 9);
                encoder.encode_span(codec, span, resolution(), &state, PACKAGE_BYTES_MAX).unwrap()
            });
            let bytes: usize = chunks.iter().map(|chunk| chunk.bytes().len()).sum();
            println!(
                "{codec} {newer_than:?}: {peak} bytes for {voxels} voxels in {} blocks, {} chunks of {bytes} bytes",
                layer.block_count(),
                chunks.len()
            );
            // The encoder's own memory comes on top: 15 MB for the cut in space.
            let own = if codec == Codec::Flock { 1_000_000 } else { 15_000_000 };
            assert!(peak < own + 60 * voxels, "{codec}: {peak} bytes for {voxels} voxels");
        }
    }
}

fn voxels_far_apart_take_no_memory_between_them() {
    let end = 1 << 28;
    let voxels = [[-end; 3], [end, 0, 0], [0, end, end]].map(|[x, y, z]| (Voxel::new(x, y, z), State::Free));
    let changes = Changes::from_voxels(voxels);
    let region = changes.bounding_box().unwrap();
    let state = Snapshot { region, parts: vec![(Stamp(5), changes.clone())], sensors: Vec::new() };
    for codec in Codec::ALL {
        let mut encoder = Encoder::new();
        let (peak, _) = peak_of(|| {
            encoder.encode_batch(codec, &batch(), 1, &changes, PACKAGE_BYTES_MAX).unwrap();
            encoder.encode_snapshot(codec, stream(), 1, resolution(), &state, PACKAGE_BYTES_MAX).unwrap();
        });
        // The tables of `flock` are unpacked once in a process: 2.3 MB, and as much again meanwhile.
        assert!(peak < 5_000_000, "{codec}: {peak}");
    }
}

fn flock_holds_what_it_says_and_no_more_the_second_time() {
    // A fifth of the voxels of a batch was known before, so that every block was.
    let (first, second): (Vec<_>, Vec<_>) =
        forest_batch().voxels().partition(|(voxel, _)| (voxel.x + 2 * voxel.y).rem_euclid(5) == 0);
    let mut layer = Layer::default();
    layer.apply(&Changes::from_voxels(first), batch().start);
    let changes = Changes::from_voxels(second);
    let base = Base { layer: Some(&layer), batches: &[], readers: &[] };
    let (mut encoder, mut decoder) = (Encoder::new(), Decoder::new());
    let mut encode = || {
        let against = Some(&base);
        encoder
            .encode_batch_against(Codec::Flock, &batch(), 100, &changes, against, PACKAGE_BYTES_MAX)
            .unwrap()
    };
    // The shipped tables are unpacked once in a process.
    let packages = encode();
    let mut decode = |package: &Package| match decoder.decode_against(package, Some(&layer)) {
        Ok(Content::Changes(changes)) => changes.blocks().len(),
        other => panic!("{other:?}"),
    };
    let held = HELD.load(Ordering::Relaxed);
    let largest = packages.iter().map(&mut decode).max().unwrap();
    let kept = HELD.load(Ordering::Relaxed) - held;
    // No more blocks than are known can be beside one.
    assert!(kept < 40_000 + 550 * layer.block_count(), "{kept}");
    // From now on nothing but what is returned, and lists of it meanwhile.
    let held = HELD.load(Ordering::Relaxed);
    for package in &packages {
        let (peak, _) = peak_of(|| decode(package));
        assert!(peak < 600 * largest, "{peak} for at most {largest} blocks");
    }
    let (peak, again) = peak_of(&mut encode);
    assert_eq!(again, packages);
    assert!(peak < 500 * changes.blocks().len(), "{peak} for {} blocks", changes.blocks().len());
    drop(again);
    assert_eq!(HELD.load(Ordering::Relaxed), held);
}
