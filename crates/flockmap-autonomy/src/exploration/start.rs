//! The world as it is, and where robots start in it.

use crate::{CellState, NavigationConfig, NavigationError, NavigationGrid};
use flockmap_grid::{BlockIndex, Plane, StateBlock, Voxel, VoxelBox, voxel_bit};
use flockmap_worlds::World;
use flockmap_worlds::curve::distance;
use std::collections::BTreeMap;

/// Metres around a start that are free: a robot on its spot sees nothing below itself.
pub(super) const ROOM_M: f64 = 0.7;

/// The navigation grid of a robot that knows all of the world.
pub(super) fn truth(world: &World, config: &NavigationConfig) -> Result<NavigationGrid, NavigationError> {
    let mut grid = NavigationGrid::new(config)?;
    let (cell, voxel) = (world.resolution().metres(), config.resolution.metres());
    let mut solid: BTreeMap<BlockIndex, Plane> = BTreeMap::new();
    for index in world.solid_cells() {
        let index = [index.x, index.y, index.z].map(f64::from);
        let low = index.map(|i| (i * cell / voxel + 1e-6).floor() as i32);
        let high = index.map(|i| ((i + 1.0) * cell / voxel - 1e-6).floor() as i32);
        let [low, high] = [low, high].map(|[x, y, z]| Voxel::new(x, y, z));
        for voxel in VoxelBox::spanning(low, high).into_iter().flat_map(|part| part.voxels()) {
            let bit = voxel_bit(voxel);
            solid.entry(voxel.block()).or_default()[bit >> 6] |= 1 << (bit & 63);
        }
    }
    for index in grid.reached.blocks() {
        let occupied = solid.get(&index).copied().unwrap_or_default();
        grid.take_in(index, StateBlock::new([u64::MAX; 8], occupied));
    }
    Ok(grid)
}

/// Places for robots to start from: together, near the middle, in the largest part of the world that hangs
/// together. Fewer than asked for if there is no room for more.
pub(super) fn places(
    truth: &NavigationGrid,
    robots: usize,
    separation_m: f64,
    may_fly: impl Fn(usize) -> bool,
) -> Vec<[f64; 3]> {
    let open = (0..truth.count()).map(|cell| truth.is_passable(cell, false) && may_fly(cell)).collect();
    let mut by_distance = truth.cells.largest_part(open);
    let middle = truth.cells.middle(&by_distance);
    let away = |cell: &u32| distance(truth.cells.centre(*cell as usize), middle);
    by_distance.sort_by(|a, b| away(a).total_cmp(&away(b)));
    let mut places: Vec<[f64; 3]> = Vec::new();
    for cell in by_distance {
        let place = truth.cells.centre(cell as usize);
        let apart = |other: &[f64; 3]| {
            let (dx, dy) = (other[0] - place[0], other[1] - place[1]);
            (dx * dx + dy * dy).sqrt() >= separation_m + 0.5
        };
        if places.iter().all(apart) && has_room(truth, place) {
            places.push(place);
            if places.len() == robots {
                break;
            }
        }
    }
    places
}

/// Whether nothing solid is near a place.
fn has_room(truth: &NavigationGrid, place: [f64; 3]) -> bool {
    truth.cells.near(place, ROOM_M).all(|cell| {
        distance(truth.cells.centre(cell), place) > ROOM_M || truth.cell_state(cell) != CellState::Occupied
    })
}
