//! Snapshots that are read and coded in slices: the same bytes, and no slice does much more than it may.

mod common;

use common::{Random, resolution, stream};
use flockmap_codec::{Codec, EncodeError, Encoder, PACKAGE_BYTES_MIN, SnapshotCoding, Span};
use flockmap_grid::{Changes, Layer, Stamp, State, Voxel};
use proptest::prelude::*;

fn changes() -> impl Strategy<Value = Changes> {
    let voxel = (-40..60i32, -40..60i32, -3..9i32).prop_map(|(x, y, z)| Voxel::new(x, y, z));
    let state = prop_oneof![3 => Just(State::Free), 1 => Just(State::Occupied)];
    prop::collection::vec((voxel, state), 1..300).prop_map(Changes::from_voxels)
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(120) })]

    #[test]
    fn chunks_made_in_slices_are_those_made_at_once(
        batches in prop::collection::vec(changes(), 1..12),
        codec in prop::sample::select(&Codec::ALL[..]),
        since in prop::option::of(0..12_000i64),
        is_packed in any::<bool>(),
        slices in prop::collection::vec(1..2_000_000u64, 1..20),
        bytes_max in prop::sample::select(&[PACKAGE_BYTES_MIN, 400, 1_150][..]),
    ) {
        let mut layer = Layer::default();
        for (number, changes) in (1..).zip(&batches) {
            layer.apply(changes, Stamp(number * 1_000));
            layer.note_sensor(Stamp(number * 1_000), [number as i32 * 16, 0, 0]);
        }
        if is_packed {
            layer.pack();
        }
        let newer_than = since.map(Stamp);
        let span = Span::new(stream(), u32::from(since.is_some()), 9);
        let Some(state) = layer.snapshot_voxels(newer_than) else { return Ok(()) };
        let at_once = Encoder::new().encode_span(codec, span, resolution(), &state, bytes_max);

        let mut slices = slices.iter().cycle();
        let mut reader = layer.read_snapshot(newer_than);
        // What becomes of the layer meanwhile does not matter.
        layer.apply(&batches[0], Stamp(50_000));
        while reader.step(*slices.next().unwrap() as usize % 7 + 1) > 0 {}
        let mut coding = SnapshotCoding::new(codec, span, resolution(), reader.finish().unwrap(), bytes_max).unwrap();
        let other = layer.snapshot_since(Stamp(10_000)).unwrap();
        let mut encoder = Encoder::new();
        let in_slices = loop {
            // Other work with the same encoder in between.
            encoder.encode_snapshot(codec, stream(), 1, resolution(), &other, 1_150).unwrap();
            match encoder.go_on(&mut coding, *slices.next().unwrap()) {
                Ok((_, Some(chunks))) => break Ok(chunks),
                Ok((steps, None)) => prop_assert!(steps > 0),
                Err(error) => break Err(error),
            }
        };
        prop_assert_eq!(in_slices, at_once);
    }
}

/// A wall of noise that grows: many stamps in each block.
fn layer() -> Layer {
    let mut layer = Layer::default();
    let mut random = Random(7);
    for batch in 0..60i64 {
        let voxels = (0..4_000).map(|_| {
            let mut place = |side: i32| (random.next() % side as u64) as i32;
            let at = Voxel::new((batch / 4) as i32 * 8 + place(60), place(64), place(64));
            (at, if place(30) == 0 { State::Occupied } else { State::Free })
        });
        layer.apply(&Changes::from_voxels(voxels), Stamp(batch * 500_000));
    }
    layer
}

#[test]
fn no_slice_takes_much_more_than_it_may() {
    let mut layer = layer();
    layer.pack();
    let mut reader = layer.read_snapshot(None);
    let blocks = layer.block_count();
    let mut read = 0;
    loop {
        match reader.step(20) {
            0 => break,
            // A cube is read as a whole.
            step => {
                assert!(step < 20 + 64, "{step} blocks");
                read += step;
            }
        }
    }
    assert_eq!(read, blocks);
    let state = reader.finish().unwrap();
    for codec in [Codec::Flock, Codec::Paper] {
        let span = Span::new(stream(), 0, 9);
        let mut coding = SnapshotCoding::new(codec, span, resolution(), &state, 1_150).unwrap();
        let mut encoder = Encoder::new();
        let (mut slices, mut most) = (0, 0);
        let chunks = loop {
            let (steps, chunks) = encoder.go_on(&mut coding, 200_000).unwrap();
            (slices, most) = (slices + 1, most.max(steps));
            if let Some(chunks) = chunks {
                break chunks;
            }
        };
        println!("{codec}: {} chunks in {slices} slices of at most {most} steps", chunks.len());
        assert!(slices > 40, "{codec}: {slices} slices");
        // A chunk, the beginning of a part of 4,000 blocks at most, or a run of blocks more.
        assert!(most < 200_000 + 4_000_000, "{codec}: {most} steps in a slice");
    }
}

#[test]
fn work_that_cannot_be_done_says_so_before_it_begins() {
    let state = layer().snapshot_voxels(None).unwrap();
    let begin = |since, upto, bytes_max| {
        let span = Span::new(stream(), since, upto);
        SnapshotCoding::new(Codec::Flock, span, resolution(), &state, bytes_max).err()
    };
    assert_eq!(begin(3, 3, 1_150), Some(EncodeError::IndexOutOfRange { first: 3, count: 1 }));
    assert_eq!(begin(0, 3, 10), Some(EncodeError::BytesMaxTooSmall { bytes_max: 10 }));
    assert_eq!(begin(0, 3, 1_150), None);
}
