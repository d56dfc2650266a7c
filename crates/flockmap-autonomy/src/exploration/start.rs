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
    // Some way beyond the region, since things there block cells within.
    let (min, max) = (grid.region().min().block(), grid.region().max().block());
    for z in min.z - 2..=max.z + 2 {
        for y in min.y - 2..=max.y + 2 {
            for x in min.x - 2..=max.x + 2 {
                let index = BlockIndex::new(x, y, z);
                let occupied = solid.get(&index).copied().unwrap_or_default();
                grid.take_in(index, StateBlock::new([u64::MAX; 8], occupied));
            }
        }
    }
    Ok(grid)
}

/// Places for robots to start from: together, near the middle, in the largest part of the world that hangs together.
/// Fewer than asked for if there is no room for more.
pub(super) fn places(
    truth: &NavigationGrid,
    robots: usize,
    separation_m: f64,
    may_fly: impl Fn(usize) -> bool,
) -> Vec<[f64; 3]> {
    let cells = largest_part(truth, |cell| truth.is_passable(cell, false) && may_fly(cell));
    let mut sum = [0.0; 3];
    for &cell in &cells {
        let centre = truth.centre(cell as usize);
        for a in 0..3 {
            sum[a] += centre[a];
        }
    }
    let middle = sum.map(|v| v / cells.len().max(1) as f64);
    let away = |cell: &u32| distance(truth.centre(*cell as usize), middle);
    let mut by_distance = cells;
    by_distance.sort_by(|a, b| away(a).total_cmp(&away(b)));
    let mut places: Vec<[f64; 3]> = Vec::new();
    for cell in by_distance {
        let place = truth.centre(cell as usize);
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

/// The largest set of cells that fit and hang together by faces, ascending; of two of a size the one with the
/// lowest cell.
fn largest_part(grid: &NavigationGrid, fits: impl Fn(usize) -> bool) -> Vec<u32> {
    let mut open: Vec<bool> = (0..grid.count()).map(fits).collect();
    let mut best = Vec::new();
    for first in 0..grid.count() {
        if !open[first] {
            continue;
        }
        open[first] = false;
        let mut part = vec![first as u32];
        let mut done = 0;
        while let Some(&cell) = part.get(done) {
            done += 1;
            for next in grid.beside(cell as usize) {
                if open[next] {
                    open[next] = false;
                    part.push(next as u32);
                }
            }
        }
        if part.len() > best.len() {
            best = part;
        }
    }
    best.sort_unstable();
    best
}

/// Whether nothing solid is near a place.
fn has_room(truth: &NavigationGrid, place: [f64; 3]) -> bool {
    let reach = (ROOM_M / truth.cell_m()).ceil() as i32;
    let steps = -reach..=reach;
    steps.clone().all(|z| {
        steps.clone().all(|y| {
            steps.clone().all(|x| {
                let d = [x, y, z].map(|i| f64::from(i) * truth.cell_m());
                let point = core::array::from_fn(|a| place[a] + d[a]);
                d.iter().map(|d| d * d).sum::<f64>().sqrt() > ROOM_M
                    || truth.cell_at(point).is_none_or(|cell| truth.cell_state(cell) != CellState::Occupied)
            })
        })
    })
}
