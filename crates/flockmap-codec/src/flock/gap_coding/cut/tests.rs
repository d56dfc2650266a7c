//! What is foretold holds, and pieces fit.

use super::*;
use crate::flock::gap_coding::payload::encode;
use crate::flock::gap_coding::tests::{Draw, any_changes, draw};
use proptest::prelude::*;

#[test]
fn logarithms_are_right() {
    for value in (0..64)
        .flat_map(|bit| [1u64 << bit, (1 << bit) + (1 << bit >> 1), (1 << bit) / 3 + 1, u64::MAX >> bit])
    {
        let expected = (value as f64).log2() * 4_294_967_296.0;
        assert!((log2(value) as f64 - expected).abs() < 64.0, "{value}");
    }
}

proptest! {
    #[test]
    fn no_payload_is_longer_than_its_estimate(changes in any_changes()) {
        let region = changes.bounding_box().unwrap();
        let mut payload = Vec::new();
        encode(&changes, &region, &mut payload);
        prop_assert!(payload.len() <= estimate(&changes, &region));
    }

    #[test]
    fn pieces_fit_and_hold_every_change_once(changes in any_changes(), payload_max in 40..1_200usize) {
        let pieces = cut(&changes, payload_max);
        for (region, piece) in &pieces {
            prop_assert_eq!(piece.bounding_box(), Some(*region));
            let mut payload = Vec::new();
            encode(piece, region, &mut payload);
            prop_assert!(payload.len() <= payload_max);
        }
        prop_assert_eq!(pieces.iter().map(|(_, piece)| piece.len()).sum::<usize>(), changes.len());
        let blocks = pieces.into_iter().flat_map(|(_, piece)| piece.blocks().to_vec()).collect();
        prop_assert_eq!(Changes::from_blocks(blocks), changes);
    }
}

#[test]
fn estimates_of_random_draws_are_nearly_exact() {
    for (n, ratio) in [1e-4, 1e-3, 1e-2, 0.1, 0.3, 0.5, 0.9, 1.0].into_iter().enumerate() {
        let changes = draw(&Draw::of_ratio([64; 3], ratio, n as u64));
        let region = changes.bounding_box().unwrap();
        let mut payload = Vec::new();
        encode(&changes, &region, &mut payload);
        let estimate = estimate(&changes, &region);
        assert!(
            (payload.len()..=payload.len() + 7).contains(&estimate),
            "{ratio}: {estimate} for {}",
            payload.len()
        );
    }
}

#[test]
fn pieces_of_a_large_draw_are_nearly_full() {
    let changes = draw(&Draw::of_ratio([64, 128, 64], 0.05, 7));
    let whole = estimate(&changes, &changes.bounding_box().unwrap());
    let pieces = cut(&changes, 1_110);
    let cost: usize = pieces.iter().map(|(region, piece)| estimate(piece, region)).sum();
    assert!(cost <= whole * 103 / 100, "{cost} bytes in {} pieces, {whole} as one", pieces.len());
    assert!(pieces.len() <= whole * 14 / 10 / 1_110 + 1, "{} pieces for {whole} bytes", pieces.len());
}

#[test]
fn what_is_far_apart_is_cut_without_a_box_around_it() {
    use flockmap_grid::{State, Voxel};
    let far = 1 << 20;
    let changes = Changes::from_voxels([
        (Voxel::new(0, 0, 0), State::Free),
        (Voxel::new(far, far, -far), State::Occupied),
    ]);
    assert_eq!(estimate(&changes, &changes.bounding_box().unwrap()), usize::MAX);
    let sizes: Vec<_> = cut(&changes, 100).iter().map(|(region, _)| region.size()).collect();
    assert_eq!(sizes, [[1; 3]; 2]);
    assert_eq!(cut(&Changes::default(), 100), []);
}
