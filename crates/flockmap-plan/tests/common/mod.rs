//! Maps for tests.

#![allow(dead_code, reason = "each test uses its part")]

use flockmap_grid::{
    BLOCK_VOXELS, BlockIndex, MapView, Resolution, State, StateBlock, Voxel, VoxelBox, voxel_bit,
};
use proptest::prelude::*;

/// Voxels and their states, some of them where others are.
pub(crate) fn voxels(within: i32, most: usize) -> impl Strategy<Value = Vec<(Voxel, State)>> {
    let state = prop_oneof![Just(State::Free), Just(State::Occupied), Just(State::Unknown)];
    let at = || -within..=within;
    let voxel = (at(), at(), at()).prop_map(|(x, y, z)| Voxel::new(x, y, z));
    prop::collection::vec((voxel, state), 0..=most)
}

/// A box near the origin.
pub(crate) fn region(within: i32, longest: u32) -> impl Strategy<Value = VoxelBox> {
    let (at, size) = (|| -within..=within, || 1..=longest);
    (at(), at(), at(), size(), size(), size())
        .prop_map(|(x, y, z, a, b, c)| VoxelBox::new(Voxel::new(x, y, z), [a, b, c]).unwrap())
}

pub(crate) fn empty() -> MapView {
    MapView::new(Resolution::from_metres(0.25).unwrap())
}

/// Sets voxels of a map one after the other.
pub(crate) fn write(map: &mut MapView, voxels: &[(Voxel, State)]) {
    for (voxel, state) in voxels {
        let mut block = map.block(voxel.block()).unwrap_or_default();
        block.set(voxel_bit(*voxel), *state);
        map.set_block(voxel.block(), &block);
    }
}

/// A map on which everything within so many blocks of the origin is Free, but for these.
pub(crate) fn seen(blocks: i32, voxels: &[(Voxel, State)]) -> MapView {
    let mut map = empty();
    let mut free = StateBlock::default();
    (0..BLOCK_VOXELS).for_each(|bit| free.set(bit, State::Free));
    for x in -blocks..blocks {
        for y in -blocks..blocks {
            (-blocks..blocks).for_each(|z| map.set_block(BlockIndex::new(x, y, z), &free));
        }
    }
    write(&mut map, voxels);
    map
}
