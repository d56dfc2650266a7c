//! Distances between bodies and cubes.

use flockmap_grid::{BLOCK_SIDE, BlockIndex, Pose, Voxel};

/// A voxel, or another cube, in metres.
pub(super) struct Cube {
    low: [f64; 3],
    high: [f64; 3],
}

impl Cube {
    pub(super) fn of(voxel: Voxel, side: f64) -> Self {
        let at = [voxel.x, voxel.y, voxel.z];
        Self { low: at.map(|at| f64::from(at) * side), high: at.map(|at| f64::from(at + 1) * side) }
    }

    /// A block, a little larger, so that rounding loses none of its voxels.
    pub(super) fn around(index: BlockIndex, side: f64) -> Self {
        let block = Self::of(Voxel::new(index.x, index.y, index.z), side * f64::from(BLOCK_SIDE));
        let more = side * 1e-6;
        Self { low: block.low.map(|at| at - more), high: block.high.map(|at| at + more) }
    }
}

/// The share (0 to 1) of the way between two points at which it is first within a radius of a cube.
///
/// The squared distance to the cube is convex along the way, and a polynomial of degree two between the places where
/// the way crosses a plane of the cube's faces.
pub(super) fn first_touch(from: [f64; 3], to: [f64; 3], cube: &Cube, radius: f64) -> Option<f64> {
    let way: [f64; 3] = core::array::from_fn(|axis| to[axis] - from[axis]);
    let mut ends = [1.0; 7];
    for axis in 0..3 {
        for (at, face) in [cube.low[axis], cube.high[axis]].into_iter().enumerate() {
            let share = (face - from[axis]) / way[axis];
            // Of a way along the face there is none, nor of one that does not reach it.
            if share > 0.0 && share < 1.0 {
                ends[2 * axis + at] = share;
            }
        }
    }
    ends.sort_unstable_by(f64::total_cmp);
    let mut start = 0.0;
    for end in ends {
        let middle = (start + end) / 2.0;
        // Of the squared distance less the squared radius, over the share gone since `start`: a·s² + b·s + c.
        let (mut a, mut b, mut c) = (0.0, 0.0, -radius * radius);
        for axis in 0..3 {
            let at = |share: f64| from[axis] + way[axis] * share;
            let (off, slope) = if at(middle) < cube.low[axis] {
                (cube.low[axis] - at(start), -way[axis])
            } else if at(middle) > cube.high[axis] {
                (at(start) - cube.high[axis], way[axis])
            } else {
                continue;
            };
            a += slope * slope;
            b += 2.0 * off * slope;
            c += off * off;
        }
        if c <= 0.0 {
            return Some(start);
        }
        if b >= 0.0 {
            // It goes away, and does not come back.
            return None;
        }
        let inside = b * b - 4.0 * a * c;
        if inside >= 0.0 {
            let share = start + 2.0 * c / (inside.sqrt() - b);
            if share <= end {
                return Some(share);
            }
        }
        start = end;
    }
    None
}

/// A box that is turned.
pub(super) struct OrientedBox {
    centre: [f64; 3],
    axes: [[f64; 3]; 3],
    half: [f64; 3],
}

impl OrientedBox {
    pub(super) fn new(pose: &Pose, half: [f64; 3]) -> Self {
        let rows = pose.rotation_rows();
        let axes = core::array::from_fn(|axis| rows.map(|row| row[axis]));
        Self { centre: pose.translation(), axes, half }
    }

    /// Its lowest and its highest corner.
    pub(super) fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        let reach =
            |along: usize| (0..3).map(|axis| (self.axes[axis][along] * self.half[axis]).abs()).sum::<f64>();
        (
            core::array::from_fn(|along| self.centre[along] - reach(along)),
            core::array::from_fn(|along| self.centre[along] + reach(along)),
        )
    }

    /// Whether it meets a cube: no plane is between them (S. Gottschalk, M. Lin, D. Manocha, "OBBTree", SIGGRAPH
    /// 1996: fifteen directions are enough).
    pub(super) fn meets(&self, cube: &Cube) -> bool {
        let half_side = (cube.high[0] - cube.low[0]) / 2.0;
        let between: [f64; 3] =
            core::array::from_fn(|axis| self.centre[axis] - (cube.low[axis] + cube.high[axis]) / 2.0);
        let apart = |direction: [f64; 3]| {
            let dot = |a: [f64; 3]| a[0] * direction[0] + a[1] * direction[1] + a[2] * direction[2];
            let cube: f64 = direction.iter().map(|d| d.abs() * half_side).sum();
            let body: f64 = self.axes.iter().zip(self.half).map(|(axis, half)| dot(*axis).abs() * half).sum();
            dot(between).abs() > cube + body
        };
        let unit = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let across = unit.iter().flat_map(|u| self.axes.iter().map(|axis| cross(*u, *axis)));
        !unit.into_iter().chain(self.axes).chain(across).any(apart)
    }
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
