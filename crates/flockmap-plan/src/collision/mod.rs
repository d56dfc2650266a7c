//! Whether a body collides with the voxels of a map, as cubes, without a distance field.

mod shape;

use flockmap_grid::{BlockIndex, MapView, Pose, VOXEL_LIMIT, Voxel, VoxelBox, set_bits};

use crate::Obstacles;
use crate::error::{QUESTION_BLOCKS_MAX, QuestionError};
use shape::{Cube, OrientedBox, first_touch};

/// Where a sphere on its way first meets an obstacle.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Hit {
    /// The obstacle.
    pub voxel: Voxel,
    /// Metres that the centre has gone by then. 0 if it began in touch with the obstacle.
    pub along_m: f64,
}

/// Answers whether bodies collide with the obstacles of a map.
///
/// Obstacles are the full cubes of their voxels and the answers are exact, to rounding. Touching counts: leave some
/// micrometres where a body may stand on something. Positions and lengths are in metres, in the frame of the map.
/// A question costs a hash look-up for each block of 8³ voxels that the body's bounding box meets (of a sweep: the
/// boxes of its pieces, in order, up to the first hit), and a little for each obstacle in those. What is larger than
/// [`QUESTION_BLOCKS_MAX`] blocks is refused before anything is looked at.
///
/// ```
/// use flockmap_grid::{BlockIndex, MapView, Resolution, State, StateBlock, Voxel};
/// use flockmap_plan::{Collision, Obstacles};
///
/// let mut map = MapView::new(Resolution::from_metres(0.5).unwrap());
/// let mut wall = StateBlock::default();
/// wall.set(0, State::Occupied);
/// map.set_block(BlockIndex::new(1, 0, 0), &wall); // x: 4 to 4.5 m
/// let collision = Collision::new(&map, Obstacles::Occupied);
/// assert_eq!(collision.sphere([3.0, 0.2, 0.2], 0.9), Ok(None));
/// assert_eq!(collision.sphere([3.0, 0.2, 0.2], 1.1), Ok(Some(Voxel::new(8, 0, 0))));
/// let hit = collision.swept_sphere([0.0, 0.2, 0.2], [9.0, 0.2, 0.2], 0.25).unwrap().unwrap();
/// assert_eq!((hit.voxel, hit.along_m), (Voxel::new(8, 0, 0), 3.75));
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Collision<'a> {
    view: &'a MapView,
    obstacles: Obstacles,
}

impl<'a> Collision<'a> {
    /// For the obstacles of a view.
    pub const fn new(view: &'a MapView, obstacles: Obstacles) -> Self {
        Self { view, obstacles }
    }

    /// An obstacle that a sphere meets.
    pub fn sphere(&self, centre: [f64; 3], radius_m: f64) -> Result<Option<Voxel>, QuestionError> {
        Ok(self.swept_sphere(centre, centre, radius_m)?.map(|hit| hit.voxel))
    }

    /// An obstacle that an axis-aligned box meets; `low` and `high` in any order.
    pub fn aligned_box(&self, low: [f64; 3], high: [f64; 3]) -> Result<Option<Voxel>, QuestionError> {
        self.first_in(&self.region(&[low, high], 0.0)?, |_| true)
    }

    /// An obstacle that a box meets which is turned and moved by a pose (its centre, in the map); `half_m`: from the
    /// centre to its faces along its own axes.
    pub fn oriented_box(&self, pose: &Pose, half_m: [f64; 3]) -> Result<Option<Voxel>, QuestionError> {
        for half in half_m {
            check_length(half)?;
        }
        let body = OrientedBox::new(pose, half_m);
        let (low, high) = body.bounds();
        self.first_in(&self.region(&[low, high], 0.0)?, |cube| body.meets(cube))
    }

    /// What a sphere meets first on the straight way of its centre. Of obstacles met at the same time, the one with
    /// the lowest x, y, z.
    pub fn swept_sphere(
        &self,
        from: [f64; 3],
        to: [f64; 3],
        radius_m: f64,
    ) -> Result<Option<Hit>, QuestionError> {
        Ok(self.path(&[from, to], radius_m)?.map(|(_, hit)| hit))
    }

    /// What a sphere meets first on the way of its centre along a line of straight parts, and on which of them (0 is
    /// that from the first point to the second). `along_m` is from the beginning of the line. A single point is a
    /// sphere; of no points, nothing is in the way.
    pub fn path(&self, points: &[[f64; 3]], radius_m: f64) -> Result<Option<(usize, Hit)>, QuestionError> {
        check_length(radius_m)?;
        for at in points.iter().flatten() {
            self.check_place(*at)?;
        }
        let parts = || points.iter().enumerate().take((points.len() - 1).max(1));
        let part = |at: usize| (points[at], points[(at + 1).min(points.len() - 1)]);
        if points.is_empty() {
            return Ok(None);
        }
        let blocks: f64 = parts().map(|(at, _)| self.blocks_of_sweep(part(at), radius_m)).sum();
        if blocks > QUESTION_BLOCKS_MAX as f64 {
            return Err(QuestionError::TooLarge { blocks });
        }
        let mut gone_m = 0.0;
        for (at, _) in parts() {
            let (from, to) = part(at);
            let length_m = length(from, to);
            if let Some((share, voxel)) = self.sweep(from, to, radius_m)? {
                return Ok(Some((at, Hit { voxel, along_m: gone_m + share * length_m })));
            }
            gone_m += length_m;
        }
        Ok(None)
    }

    /// [`Self::sphere`] for many: whether each is in touch with an obstacle.
    pub fn spheres(
        &self,
        centres: &[[f64; 3]],
        radius_m: f64,
        collides: &mut [bool],
    ) -> Result<(), QuestionError> {
        if centres.len() != collides.len() {
            return Err(QuestionError::Lengths(centres.len(), collides.len()));
        }
        for (centre, collides) in centres.iter().zip(collides) {
            *collides = self.sphere(*centre, radius_m)?.is_some();
        }
        Ok(())
    }

    /// The share of the way at which the sphere meets its first obstacle.
    ///
    /// The way is gone in pieces. Whatever is met on a piece lies in the bounding box of that piece, so what was found
    /// in the pieces so far is the first if it is met before their end.
    fn sweep(
        &self,
        from: [f64; 3],
        to: [f64; 3],
        radius_m: f64,
    ) -> Result<Option<(f64, Voxel)>, QuestionError> {
        let side = self.view.resolution().metres();
        let pieces = self.pieces(from, to, radius_m);
        let mut first: Option<(f64, Voxel)> = None;
        for piece in 0..pieces as u64 {
            let [start, end] = [piece, piece + 1].map(|at| at as f64 / pieces);
            let at = |share: f64| core::array::from_fn(|axis| from[axis] + (to[axis] - from[axis]) * share);
            let region = self.region(&[at(start), at(end)], radius_m)?;
            // In the order in which the sphere reaches them: most need not be looked into.
            let mut reached: Vec<(f64, BlockIndex)> = region
                .blocks()
                .filter(|index| self.obstacles_of(*index, &region).next().is_some())
                .filter_map(|index| {
                    Some((first_touch(from, to, &Cube::around(index, side), radius_m)?, index))
                })
                .collect();
            reached.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            for (share, index) in reached {
                if first.is_some_and(|best| best < (share, index.corner())) {
                    break;
                }
                for voxel in self.obstacles_of(index, &region) {
                    // Where it stands in obstacles, most of them are behind the one that is known.
                    if first.is_some_and(|best| best <= (share, voxel)) {
                        continue;
                    }
                    if let Some(share) = first_touch(from, to, &Cube::of(voxel, side), radius_m)
                        && first.is_none_or(|best| (share, voxel) < best)
                    {
                        first = Some((share, voxel));
                    }
                }
            }
            if first.is_some_and(|(share, _)| share <= end) {
                break;
            }
        }
        Ok(first)
    }

    /// The first obstacle of a box that meets a condition.
    fn first_in(
        &self,
        region: &VoxelBox,
        meets: impl Fn(&Cube) -> bool,
    ) -> Result<Option<Voxel>, QuestionError> {
        let blocks: f64 = region.size().iter().map(|size| f64::from(*size) / 8.0 + 2.0).product();
        if blocks > QUESTION_BLOCKS_MAX as f64 {
            return Err(QuestionError::TooLarge { blocks });
        }
        let side = self.view.resolution().metres();
        let reached = region.blocks().filter(|index| {
            self.obstacles_of(*index, region).next().is_some() && meets(&Cube::around(*index, side))
        });
        let mut all = reached.flat_map(|index| self.obstacles_of(index, region));
        Ok(all.find(|voxel| meets(&Cube::of(*voxel, side))))
    }

    fn obstacles_of(&self, index: BlockIndex, region: &VoxelBox) -> impl Iterator<Item = Voxel> + use<> {
        let plane = self.view.with_block(index, |block| self.obstacles.of(Some(block)));
        let (plane, within) = (plane.unwrap_or_else(|| self.obstacles.of(None)), region.plane(index));
        set_bits(&core::array::from_fn(|z| plane[z] & within[z])).map(move |bit| index.voxel(bit))
    }

    /// The voxels that touch the bounding box of two points, grown by a radius.
    fn region(&self, points: &[[f64; 3]; 2], radius_m: f64) -> Result<VoxelBox, QuestionError> {
        let side = self.view.resolution().metres();
        let mut ends = [[0; 3]; 2];
        for axis in 0..3 {
            let [a, b] = points.map(|point| point[axis]);
            self.check_place(a)?;
            self.check_place(b)?;
            let low = ((a.min(b) - radius_m) / side).ceil() - 1.0;
            let high = ((a.max(b) + radius_m) / side).floor();
            // Beyond the grid nothing is known, and nothing can be.
            let limit = f64::from(VOXEL_LIMIT);
            ends[0][axis] = low.clamp(-limit, limit) as i32;
            ends[1][axis] = high.clamp(-limit, limit) as i32;
        }
        let [low, high] = ends.map(|[x, y, z]| Voxel::new(x, y, z));
        VoxelBox::spanning(low, high).ok_or(QuestionError::NotInGrid(points[0][0]))
    }

    /// Into how many pieces a sweep is cut: each about as long as the sphere is wide, or as a block.
    fn pieces(&self, from: [f64; 3], to: [f64; 3], radius_m: f64) -> f64 {
        let long = (2.0 * radius_m).max(8.0 * self.view.resolution().metres());
        (length(from, to) / long).ceil().max(1.0)
    }

    /// Blocks that a sweep looks at, at most.
    fn blocks_of_sweep(&self, (from, to): ([f64; 3], [f64; 3]), radius_m: f64) -> f64 {
        let pieces = self.pieces(from, to, radius_m);
        let block = 8.0 * self.view.resolution().metres();
        let blocks = |axis: usize| ((to[axis] - from[axis]).abs() / pieces + 2.0 * radius_m) / block + 2.0;
        pieces * blocks(0) * blocks(1) * blocks(2)
    }

    fn check_place(&self, at: f64) -> Result<(), QuestionError> {
        let end = f64::from(VOXEL_LIMIT) * self.view.resolution().metres();
        if at.abs() <= end { Ok(()) } else { Err(QuestionError::NotInGrid(at)) }
    }
}

fn check_length(length_m: f64) -> Result<(), QuestionError> {
    if length_m >= 0.0 && length_m.is_finite() { Ok(()) } else { Err(QuestionError::NotInGrid(length_m)) }
}

fn length(from: [f64; 3], to: [f64; 3]) -> f64 {
    from.iter().zip(to).map(|(a, b)| (b - a).powi(2)).sum::<f64>().sqrt()
}
