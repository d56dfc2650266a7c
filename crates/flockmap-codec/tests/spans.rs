//! Packages, spans and whole states in any order: the newest state of each voxel stays.

mod common;

use std::collections::BTreeMap;

use common::{resolution, stream};
use flockmap_codec::{Batch, ChunksRead, Codec, Content, Decoder, Encoder, PACKAGE_BYTES_MIN, Package, Span};
use flockmap_grid::{Changes, Layer, Stamp, State, Voxel};
use proptest::prelude::*;

/// The newest state of each voxel, Occupied first at equal stamps.
type Naive = BTreeMap<Voxel, (Stamp, bool)>;

fn note(naive: &mut Naive, changes: &Changes, stamp: Stamp) {
    for (voxel, state) in changes.voxels() {
        let word = (stamp, state == State::Occupied);
        let known = naive.entry(voxel).or_insert(word);
        *known = word.max(*known);
    }
}

fn assert_same(layer: &Layer, naive: &Naive) -> Result<(), TestCaseError> {
    prop_assert_eq!(layer.len(), naive.len());
    for (voxel, (stamp, is_occupied)) in naive {
        let state = if *is_occupied { State::Occupied } else { State::Free };
        prop_assert_eq!(layer.get(*voxel), Some((state, *stamp)));
    }
    Ok(())
}

fn changes() -> impl Strategy<Value = Changes> {
    let voxel = (-9..12i32, -9..12i32, -3..9i32).prop_map(|(x, y, z)| Voxel::new(x, y, z));
    let state = prop_oneof![3 => Just(State::Free), 1 => Just(State::Occupied)];
    prop::collection::vec((voxel, state), 1..200).prop_map(Changes::from_voxels)
}

/// What is delivered: a package, or the chunks of a set in their order.
#[derive(Clone, Debug)]
enum Delivery {
    Package(usize),
    Set(usize),
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(80) })]

    #[test]
    fn old_states_never_overwrite_newer_ones_in_any_order(
        batches in prop::collection::vec(changes(), 1..12), codec in prop::sample::select(&[Codec::Flock, Codec::Paper][..]),
        spans in prop::collection::vec((any::<prop::sample::Index>(), any::<prop::sample::Index>()), 1..5),
        order in prop::collection::vec(any::<prop::sample::Index>(), 0..60),
    ) {
        let mut encoder = Encoder::new();
        // Each batch in several packages; the layer after each of them.
        let mut packages: Vec<Package> = Vec::new();
        let (mut sender, mut after) = (Layer::default(), vec![Layer::default()]);
        for (number, changes) in (1..).zip(&batches) {
            let end = Stamp(number * 1_000);
            let batch = Batch { stream: stream(), start: end, end, resolution: resolution(), sensor: [0; 3] };
            let first = packages.len() as u32 + 1;
            for package in encoder.encode_batch(codec, &batch, first, changes, PACKAGE_BYTES_MIN).unwrap() {
                let Content::Changes(changes) = package.decode().unwrap() else { unreachable!() };
                sender.apply(&changes, end);
                after.push(sender.clone());
                packages.push(package);
            }
        }
        let sets: Vec<(Span, Vec<Package>)> = spans.iter().map(|(since, upto)| {
            let upto = 1 + upto.index(packages.len());
            let since = since.index(upto);
            let newer_than = (since > 0).then(|| packages[since].header().batch_end.plus_micros(-1));
            let state = after[upto].snapshot_voxels(newer_than).unwrap();
            let span = Span::new(stream(), since as u32, upto as u32);
            (span, encoder.encode_span(codec, span, resolution(), &state, PACKAGE_BYTES_MIN).unwrap())
        }).collect();
        let all: Vec<Delivery> =
            (0..packages.len()).map(Delivery::Package).chain((0..sets.len()).map(Delivery::Set)).collect();
        let (mut layer, mut naive, mut decoder) = (Layer::default(), Naive::new(), Decoder::new());
        let mut held = vec![false; packages.len() + 1];
        for delivery in order.iter().map(|at| at.get(&all)) {
            match delivery {
                Delivery::Package(at) => {
                    let Content::Changes(changes) = packages[*at].decode().unwrap() else { unreachable!() };
                    layer.apply(&changes, packages[*at].header().batch_end);
                    note(&mut naive, &changes, packages[*at].header().batch_end);
                    held[at + 1] = true;
                }
                Delivery::Set(at) => {
                    let mut read = ChunksRead::default();
                    for chunk in &sets[*at].1 {
                        let state = match chunk.header().codec {
                            Codec::Flock => decoder.decode_chunk(chunk, &mut read).unwrap(),
                            _ => match chunk.decode().unwrap() {
                                Content::Snapshot(state) => state,
                                Content::Changes(_) => unreachable!(),
                            },
                        };
                        layer.apply_snapshot(&state);
                        state.parts.iter().for_each(|(stamp, part)| note(&mut naive, part, *stamp));
                    }
                    let Span { since, upto, .. } = sets[*at].0;
                    if (1..=since).all(|index| held[index as usize]) {
                        (since + 1..=upto).for_each(|index| held[index as usize] = true);
                    }
                }
            }
            assert_same(&layer, &naive)?;
            // What counts as received is known: the layer has every voxel of it, or a newer state.
            let prefix = (1..held.len()).take_while(|index| held[*index]).count();
            let mut merged = layer.clone();
            if let Some(state) = after[prefix].snapshot() {
                merged.apply_snapshot(&state);
            }
            prop_assert_eq!(merged.digest(), layer.digest(), "packages 1 to {} are held", prefix);
        }
    }
}
