//! Shapes that generated worlds are made of, drawn in metres into a set of cells.

use super::World;
use crate::cells::CellSet;
use crate::curve::{between, distance};
use crate::random::{hash_at, unit};
use flockmap_grid::{Resolution, Voxel, VoxelBox};

/// Side of a cell of generated worlds: 5 cm.
pub(super) const CELL_M: f64 = 0.05;

/// What shapes are drawn on. Whatever lies outside of its box is cut off.
pub(super) struct Canvas {
    cells: CellSet,
}

impl Canvas {
    /// An empty canvas from corner `min` to corner `max`, in metres.
    pub(super) fn new(min: [f64; 3], max: [f64; 3]) -> Self {
        let low = min.map(index_at);
        let high = max.map(|v| index_at(v - 1e-6));
        let region = VoxelBox::spanning(voxel(low), voxel(high)).expect("generated worlds are small");
        Self { cells: CellSet::new(region).expect("generated worlds are small") }
    }

    /// The world of what was drawn.
    pub(super) fn into_world(self) -> World {
        let resolution = Resolution::from_micrometres(50_000).expect("5 cm is a resolution");
        World::sealed(resolution, self.cells, None)
    }

    /// A box with corners `min` and `max`, in metres: the cells whose centre lies in it.
    pub(super) fn slab(&mut self, min: [f64; 3], max: [f64; 3]) {
        self.each_in(min, max, |canvas, cell, _| canvas.put(cell));
    }

    /// Empties the cells whose centre lies in the box.
    pub(super) fn carve(&mut self, min: [f64; 3], max: [f64; 3]) {
        self.each_in(min, max, |canvas, cell, _| canvas.cells.remove(cell));
    }

    /// A solid ellipsoid with a surface that is rough by `roughness` (0 … 1) of its radii.
    pub(super) fn boulder(&mut self, centre: [f64; 3], radii: [f64; 3], roughness: f64, seed: u64) {
        self.each_around(centre, radii, |canvas, cell, square| {
            let lump =
                unit(hash_at(seed, i64::from(cell.x >> 2), i64::from(cell.y >> 2), i64::from(cell.z >> 2)));
            if square <= 1.0 - roughness * lump {
                canvas.put(cell);
            }
        });
    }

    /// Leaves: an ellipsoid of which a share `density` of the cells is filled at random, thinning out to its
    /// rim.
    pub(super) fn foliage(&mut self, centre: [f64; 3], radii: [f64; 3], density: f64, seed: u64) {
        self.each_around(centre, radii, |canvas, cell, square| {
            let rim = 1.0 - square;
            let bits = hash_at(seed, i64::from(cell.x), i64::from(cell.y), i64::from(cell.z));
            if rim > 0.0 && unit(bits) < density * (2.0 * rim).min(1.0) {
                canvas.put(cell);
            }
        });
    }

    /// A straight piece of stem or branch from `a` to `b`, `radius_a` and `radius_b` thick at its ends; never
    /// thinner than one cell.
    pub(super) fn limb(&mut self, a: [f64; 3], b: [f64; 3], radius_a: f64, radius_b: f64) {
        let steps = (distance(a, b) / (0.6 * CELL_M)).ceil().max(1.0) as u32;
        for step in 0..=steps {
            let s = f64::from(step) / f64::from(steps);
            let centre = between(a, b, s);
            let radius = radius_a + (radius_b - radius_a) * s;
            self.put(voxel(centre.map(index_at)));
            if radius > 0.5 * CELL_M {
                self.each_around(centre, [radius; 3], |canvas, cell, square| {
                    if square <= 1.0 {
                        canvas.put(cell);
                    }
                });
            }
        }
    }

    /// Calls `visit` for each cell of the canvas that an ellipsoid may reach, with the square of its distance
    /// from the centre in radii.
    fn each_around(
        &mut self,
        centre: [f64; 3],
        radii: [f64; 3],
        mut visit: impl FnMut(&mut Self, Voxel, f64),
    ) {
        let [min, max] = [-1.0, 1.0].map(|side| core::array::from_fn(|a| centre[a] + side * radii[a]));
        self.each_in(min, max, |canvas, cell, point| {
            let parts = (0..3).map(|a| (point[a] - centre[a]) / radii[a]);
            visit(canvas, cell, parts.map(|v| v * v).sum());
        });
    }

    fn put(&mut self, cell: Voxel) {
        // A generated world is far below the limit of a set; a cell over it would only be missing.
        let _ = self.cells.insert(cell);
    }

    /// Calls `visit` for each cell of the canvas whose centre lies in the box.
    fn each_in(&mut self, min: [f64; 3], max: [f64; 3], mut visit: impl FnMut(&mut Self, Voxel, [f64; 3])) {
        let low = min.map(|v| (v / CELL_M - 0.5).ceil() as i32);
        let high = max.map(|v| (v / CELL_M - 0.5).floor() as i32);
        if (0..3).any(|a| low[a] > high[a]) {
            return;
        }
        let cells = VoxelBox::spanning(voxel(low), voxel(high));
        let inside = cells.and_then(|cells| cells.intersection(&self.cells.region()));
        // By `for_each`, which takes a nested iterator apart; a loop pays for each step of it.
        inside.into_iter().flat_map(|cells| cells.voxels()).for_each(|cell| {
            visit(self, cell, [cell.x, cell.y, cell.z].map(|n| (f64::from(n) + 0.5) * CELL_M));
        });
    }
}

fn index_at(metres: f64) -> i32 {
    (metres / CELL_M).floor() as i32
}

const fn voxel([x, y, z]: [i32; 3]) -> Voxel {
    Voxel::new(x, y, z)
}
