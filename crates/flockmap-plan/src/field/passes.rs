//! The three passes over a box, each kept so that a later one need not be done again where it finds nothing new.

use flockmap_grid::{BlockIndex, MapView, VoxelBox};

use super::cell::{Cell, Group, LANES};
use super::line::Lines;
use super::row::{GROUP_BYTES, row};
use crate::Obstacles;

/// How the voxels of a box lie in memory: x fastest, then y, then z.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Shape {
    pub(super) region: VoxelBox,
    /// The lowest x of the first group, which is that of a block.
    x: i32,
    groups: usize,
    ys: usize,
    zs: usize,
}

impl Shape {
    pub(super) fn new(region: VoxelBox) -> Self {
        let (x, [_, ys, zs]) = (region.min().block().corner().x, region.size());
        let groups = ((region.max().x - x) as usize + 1).div_ceil(LANES);
        Self { region, x, groups, ys: ys as usize, zs: zs as usize }
    }

    /// Groups of the box.
    pub(super) fn len(&self) -> u128 {
        self.groups as u128 * self.ys as u128 * self.zs as u128
    }

    fn columns(&self) -> usize {
        self.ys * self.groups
    }

    /// Group and lane of a voxel of the box.
    #[inline]
    pub(super) fn place(&self, [x, y, z]: [i32; 3]) -> (usize, usize) {
        let min = self.region.min();
        let (x, y, z) = ((x - self.x) as usize, (y - min.y) as usize, (z - min.z) as usize);
        ((z * self.ys + y) * self.groups + x / LANES, x % LANES)
    }
}

/// Squared distances to the nearest obstacle: on the line along x, in the plane of x and z, and in space.
#[derive(Clone, Debug)]
pub(super) struct Passes<T> {
    along_x: Vec<Group<T>>,
    in_plane: Vec<Group<T>>,
    pub(super) in_space: Vec<Group<T>>,
}

impl<T: Cell> Passes<T> {
    pub(super) fn new() -> Self {
        Self { along_x: Vec::new(), in_plane: Vec::new(), in_space: Vec::new() }
    }

    /// All three passes.
    pub(super) fn anew(&mut self, shape: &Shape, view: &MapView, obstacles: Obstacles) {
        for pass in [&mut self.along_x, &mut self.in_plane, &mut self.in_space] {
            pass.resize(shape.len() as usize, [T::NONE; LANES]);
        }
        let (low, high) = (shape.region.min().block(), shape.region.max().block());
        let view = view.open_in(&shape.region);
        let mut rows = Rows::new(shape);
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                rows.load(shape, &view, obstacles, y, z);
                rows.each(shape, |at, group| self.along_x[at] = group);
            }
        }
        let mut lines = Lines::new(shape.zs);
        for column in 0..shape.columns() {
            lines.load(self.along_x[column..].iter().step_by(shape.columns()).copied());
            lines.each(|z, group| self.in_plane[column + z * shape.columns()] = group);
        }
        let mut lines = Lines::new(shape.ys);
        for z in 0..shape.zs {
            for group in 0..shape.groups {
                let first = z * shape.columns() + group;
                lines.load(self.in_plane[first..].iter().step_by(shape.groups).copied());
                lines.each(|y, least| self.in_space[first + y * shape.groups] = least);
            }
        }
    }

    /// Does again what depends on these blocks, whose lines along x come in ascending order of y and z.
    pub(super) fn again(
        &mut self,
        shape: &Shape,
        view: &MapView,
        obstacles: Obstacles,
        changed: &[[i32; 2]],
    ) {
        let mut columns = vec![false; shape.columns()];
        let mut rows = Rows::new(shape);
        for [y, z] in changed {
            rows.load(shape, view, obstacles, *y, *z);
            rows.each(shape, |at, group| {
                if self.along_x[at] != group {
                    self.along_x[at] = group;
                    columns[at % shape.columns()] = true;
                }
            });
        }
        let mut lines = Lines::new(shape.zs);
        let mut stale = Vec::new();
        for column in (0..shape.columns()).filter(|column| columns[*column]) {
            lines.load(self.along_x[column..].iter().step_by(shape.columns()).copied());
            lines.each(|z, group| {
                let cell = &mut self.in_plane[column + z * shape.columns()];
                if *cell != group {
                    let (y, line) = (column / shape.groups, column % shape.groups);
                    stale.push(Stale { line: z * shape.groups + line, y, before: *cell });
                    *cell = group;
                }
            });
        }
        stale.sort_unstable_by_key(|stale| (stale.line, stale.y));
        let mut lines = Lines::new(shape.ys);
        for stale in stale.chunk_by(|a, b| a.line == b.line) {
            self.line_again(shape, &mut lines, stale);
        }
    }

    /// The third pass again along one group of lines, some cells of which changed.
    fn line_again(&mut self, shape: &Shape, lines: &mut Lines<T>, stale: &[Stale<T>]) {
        let line = stale[0].line;
        let first = line / shape.groups * shape.columns() + line % shape.groups;
        lines.load(self.in_plane[first..].iter().step_by(shape.groups).copied());
        let cells = || (first..).step_by(shape.groups).take(shape.ys);
        if stale.len() > STALE_MAX {
            lines.each(|y, least| self.in_space[first + y * shape.groups] = least);
            return;
        }
        // A cell that fell can be the least now. One that rose may have been: then there may be another.
        for (y, at) in cells().enumerate() {
            let mut least = self.in_space[at];
            let mut has_lost = false;
            for stale in stale {
                let square = T::square(y.abs_diff(stale.y) as u16);
                let now = &self.in_plane[first + stale.y * shape.groups];
                for lane in 0..LANES {
                    let before = stale.before[lane];
                    has_lost |= (now[lane] > before) & (before.plus(square) <= least[lane]);
                    least[lane] = least[lane].lesser(now[lane].plus(square));
                }
            }
            self.in_space[at] = if has_lost { lines.at(y).0 } else { least };
        }
    }
}

/// A group of the second pass that changed.
struct Stale<T> {
    /// Its group of lines along y, by z, then x.
    line: usize,
    y: usize,
    before: Group<T>,
}

/// If more cells of a group of lines changed, the lines are done as a whole.
const STALE_MAX: usize = 6;

/// The obstacles of the 64 rows along x that go through the same blocks.
struct Rows {
    /// By z, y, x.
    bytes: Vec<u8>,
    to_right: Vec<u16>,
    /// The rows' block.
    y: i32,
    z: i32,
}

impl Rows {
    fn new(shape: &Shape) -> Self {
        let length = shape.groups * GROUP_BYTES;
        Self { bytes: vec![0; 64 * length], to_right: vec![0; length], y: 0, z: 0 }
    }

    fn load(&mut self, shape: &Shape, view: &MapView, obstacles: Obstacles, y: i32, z: i32) {
        (self.y, self.z) = (y, z);
        let (low, high) = (shape.region.min(), shape.region.max());
        let length = self.to_right.len();
        for (at, x) in (low.block().x..=high.block().x).enumerate() {
            let corner = x * 8;
            let from = (low.x - corner).max(0);
            let to = (high.x - corner).min(7);
            let mask = (0xFFu8 << from) & (0xFF >> (7 - to));
            let plane = view.with_block(BlockIndex::new(x, y, z), |block| obstacles.of(Some(block)));
            let plane = plane.unwrap_or_else(|| obstacles.of(None));
            for (z, slice) in plane.into_iter().enumerate() {
                for (y, byte) in slice.to_le_bytes().into_iter().enumerate() {
                    self.bytes[(z * 8 + y) * length + at] = byte & mask;
                }
            }
        }
    }

    /// The first pass over those rows that belong to the box.
    fn each<T: Cell>(&mut self, shape: &Shape, mut out: impl FnMut(usize, Group<T>)) {
        let (low, high) = (shape.region.min(), shape.region.max());
        let length = self.to_right.len();
        for z in low.z.max(self.z * 8)..=high.z.min(self.z * 8 + 7) {
            for y in low.y.max(self.y * 8)..=high.y.min(self.y * 8 + 7) {
                let bytes = &self.bytes[(((z & 7) * 8 + (y & 7)) as usize * length)..][..length];
                let first = ((z - low.z) as usize * shape.ys + (y - low.y) as usize) * shape.groups;
                row(bytes, &mut self.to_right, |group, squares| out(first + group, squares));
            }
        }
    }
}
