//! The surface of a world as points with normals, for renderings that paint points instead of casting rays.

use crate::cells::{Bits, CellSet, cell_bit, cell_of};
use core::ops::Range;
use flockmap_grid::{Resolution, Voxel};
use rustc_hash::FxHashMap;

/// Metres between points, if the cells of the world are not larger. (MARSIM's `downsample_res`.)
const SPACING_M: f64 = 0.1;

/// Points from this far around make a normal, in spacings.
const NORMAL_REACH: i32 = 3;

/// Most cubes with points in them, one or two each. Where a world has more, they are taken further apart.
const POINTS_MAX: usize = 1 << 22;

/// Most bricks of 4³ places for points (256 bytes each); more mean points further apart, too.
const BRICKS_MAX: usize = 1 << 20;

/// The surface of a world: a point for each cube of `spacing` that has surface in it, at the centre of the open
/// faces of its solid cells; two for a thin sheet, one on each side.
#[derive(Clone, Debug)]
pub(crate) struct Surface {
    /// Metres between points.
    pub(crate) spacing_m: f64,
    pub(crate) patches: Vec<Patch>,
    points: Vec<SurfacePoint>,
}

/// A place on the surface of a world.
#[derive(Clone, Debug)]
pub(crate) struct SurfacePoint {
    /// Metres from the centre of its patch.
    pub(crate) offset: [f32; 3],
    /// Unit normal of the surface, with any sign; all zero where the points around make no plane.
    pub(crate) normal: [f32; 3],
    /// To which sides the surface is open: bit `2 · axis` down, bit `2 · axis + 1` up.
    open: u8,
}

/// A piece of surface: the points of a cube of 4³ spacings.
#[derive(Clone, Debug)]
pub(crate) struct Patch {
    /// Centre of the cube in metres.
    centre: [f64; 3],
    /// To which sides any of its points is open.
    open: u8,
    points: Range<u32>,
}

impl Patch {
    /// Where the centre is seen from a place, along the axes of the map, in metres.
    #[inline]
    pub(crate) fn centre_from(&self, place: [f64; 3]) -> [f32; 3] {
        core::array::from_fn(|a| (self.centre[a] - place[a]) as f32)
    }

    /// Whether any open side of a point looks to a sensor from which the centre is seen at `centre`.
    #[inline]
    pub(crate) fn faces(&self, centre: [f32; 3], spacing: f32) -> bool {
        self.open & sides(centre, 3.0 * spacing) != 0
    }
}

impl SurfacePoint {
    /// Whether any open side looks to a sensor from which the point is seen at `place` (metres along the axes
    /// of the map). Faces lie within `spacing` of the point.
    #[inline]
    pub(crate) fn faces(&self, place: [f32; 3], spacing: f32) -> bool {
        self.open & sides(place, spacing) != 0
    }
}

/// Which sides of something at `place` look to the sensor, if they lie within `reach` of it.
#[inline]
fn sides(place: [f32; 3], reach: f32) -> u8 {
    let mut sides = 0;
    for (a, p) in place.into_iter().enumerate() {
        sides |= u8::from(p > -reach) << (2 * a) | u8::from(p < reach) << (2 * a + 1);
    }
    sides
}

impl Surface {
    /// The surface of a set of cells.
    ///
    /// Cost: some 50 ns a cell of the surface and 1 µs a point. Memory: [`POINTS_MAX`] and [`BRICKS_MAX`] are
    /// kept by larger spacing, so at most 240 MB, and 700 MB while it is made.
    pub(crate) fn new(solid: &CellSet, resolution: Resolution) -> Self {
        // At least one cell; as many as come nearest to the spacing.
        let mut cells = ((SPACING_M / resolution.metres() + 0.5) as i32).max(1);
        let bricks = loop {
            match Bricks::gather(solid, cells, POINTS_MAX, BRICKS_MAX) {
                Some(bricks) => break bricks,
                None => cells *= 2,
            }
        };
        let spacing_m = f64::from(cells) * resolution.metres();
        bricks.into_surface(spacing_m)
    }

    /// The points of a patch.
    pub(crate) fn points(&self, patch: &Patch) -> &[SurfacePoint] {
        self.points.get(patch.points.start as usize..patch.points.end as usize).unwrap_or_default()
    }

    /// Metres from the centre of a patch within which all its points are.
    pub(crate) fn patch_reach_m(&self) -> f64 {
        2.0 * 3f64.sqrt() * self.spacing_m
    }
}

/// What the points of one cube of the spacing are made from. Lengths are in half cells from its corner.
#[derive(Clone, Copy, Debug)]
struct Gathered {
    place: [i32; 3],
    /// Sum of the centres of its open faces, and their number.
    sum: [i32; 3],
    count: i32,
    /// For each of six sides (x down, x up, y down …) the number of open faces and the sum of where they lie
    /// along their axis.
    sides: [(i32, i32); 6],
}

impl Gathered {
    /// The axis along which this is a thin sheet, open on both sides and on no other.
    fn sheet(&self) -> Option<usize> {
        let is_open = |side: usize| self.sides[side].0 > 0;
        let mut axes = (0..3).filter(|a| is_open(2 * a) || is_open(2 * a + 1));
        let axis = axes.next().filter(|a| is_open(2 * a) && is_open(2 * a + 1))?;
        axes.next().is_none().then_some(axis)
    }

    /// Which sides are open, one bit each.
    fn open(&self) -> u8 {
        (0..6).map(|side| u8::from(self.sides[side].0 > 0) << side).sum()
    }
}

/// All points of a surface, found by their place.
struct Bricks {
    /// Cells along the side of a place.
    cells: i32,
    of: FxHashMap<[i32; 3], u32>,
    /// For each of 4³ places 0, or one more than its point.
    bricks: Vec<[u32; 64]>,
    points: Vec<Gathered>,
}

impl Bricks {
    /// `None` if there are too many.
    fn gather(solid: &CellSet, cells: i32, points_max: usize, bricks_max: usize) -> Option<Self> {
        let mut all = Self { cells, of: FxHashMap::default(), bricks: Vec::new(), points: Vec::new() };
        for (corner, brick) in solid.bricks() {
            let open = open_faces(solid, corner, brick);
            for bit in Bits(open.iter().fold(0, |all, face| all | face)) {
                let cell = cell_of(corner, bit);
                let cell = [cell.x, cell.y, cell.z];
                let place = cell.map(|c| c.div_euclid(cells));
                let point = all.point_mut(place, points_max, bricks_max)?;
                let centre: [i32; 3] = core::array::from_fn(|a| 2 * (cell[a] - place[a] * cells) + 1);
                for (side, _) in open.iter().enumerate().filter(|(_, face)| **face >> bit & 1 != 0) {
                    let along = centre[side / 2] + if side % 2 == 0 { -1 } else { 1 };
                    let mut face = centre;
                    face[side / 2] = along;
                    for (sum, v) in point.sum.iter_mut().zip(face) {
                        *sum += v;
                    }
                    point.count += 1;
                    point.sides[side].0 += 1;
                    point.sides[side].1 += along;
                }
            }
        }
        Some(all)
    }

    fn point_mut(&mut self, place: [i32; 3], points_max: usize, bricks_max: usize) -> Option<&mut Gathered> {
        let next = self.bricks.len();
        let brick = *self.of.entry(place.map(|p| p >> 2)).or_insert(next as u32) as usize;
        if brick == next {
            if next == bricks_max {
                return None;
            }
            self.bricks.push([0; 64]);
        }
        let slot = &mut self.bricks[brick][cell_bit(Voxel::new(place[0], place[1], place[2])) as usize];
        if *slot == 0 {
            if self.points.len() == points_max {
                return None;
            }
            self.points.push(Gathered { place, sum: [0; 3], count: 0, sides: [(0, 0); 6] });
            *slot = self.points.len() as u32;
        }
        self.points.get_mut(*slot as usize - 1)
    }

    fn into_surface(self, spacing_m: f64) -> Surface {
        let mut order: Vec<([i32; 3], u32)> = self.of.iter().map(|(&brick, &index)| (brick, index)).collect();
        order.sort_unstable();
        let mut surface = Surface {
            spacing_m,
            patches: Vec::with_capacity(order.len()),
            points: Vec::with_capacity(self.points.len()),
        };
        let mut around = Vec::new();
        for (brick, index) in order {
            // Places are counted from the centre of the brick, in spacings.
            let middle = brick.map(|b| b * 4 + 2);
            let first = surface.points.len() as u32;
            self.points_around(brick, middle, &mut around);
            for point in self.points_of(index) {
                let at = self.centre(point, middle);
                let normal = normal(at, &around).map(|v| v as f32);
                let mut push = |at: [f64; 3], open| {
                    let offset = at.map(|v| (v * spacing_m) as f32);
                    surface.points.push(SurfacePoint { offset, normal, open });
                };
                // The two sides of a sheet are two surfaces; in their middle there is none.
                if let Some(axis) = point.sheet() {
                    for side in [2 * axis, 2 * axis + 1] {
                        let (count, sum) = point.sides[side];
                        let mut face = at;
                        face[axis] = f64::from(point.place[axis] - middle[axis])
                            + f64::from(sum) / f64::from(2 * self.cells * count);
                        push(face, 1 << side);
                    }
                } else {
                    push(at, point.open());
                }
            }
            let last = surface.points.len() as u32;
            surface.patches.push(Patch {
                centre: middle.map(|p| f64::from(p) * spacing_m),
                open: surface.points[first as usize..].iter().fold(0, |open, point| open | point.open),
                points: first..last,
            });
        }
        surface
    }

    /// The points of a brick.
    fn points_of(&self, brick: u32) -> impl Iterator<Item = &Gathered> {
        let slots = self.bricks[brick as usize].iter();
        slots.filter(|slot| **slot != 0).map(|slot| &self.points[*slot as usize - 1])
    }

    /// A point in spacings from the corner of place `middle`.
    fn centre(&self, point: &Gathered, middle: [i32; 3]) -> [f64; 3] {
        let half_cells = f64::from(2 * self.cells * point.count);
        core::array::from_fn(|a| f64::from(point.place[a] - middle[a]) + f64::from(point.sum[a]) / half_cells)
    }

    /// All points that are near enough to one of the brick to make its normal.
    fn points_around(&self, brick: [i32; 3], middle: [i32; 3], around: &mut Vec<[f64; 3]>) {
        around.clear();
        let first = brick.map(|b| b * 4 - NORMAL_REACH);
        let last = brick.map(|b| b * 4 + 3 + NORMAL_REACH);
        let beside = (0..27).map(|k| [brick[0] + k % 3 - 1, brick[1] + k / 3 % 3 - 1, brick[2] + k / 9 - 1]);
        let points = beside.filter_map(|brick| self.of.get(&brick)).flat_map(|index| self.points_of(*index));
        let is_near = |point: &&Gathered| (0..3).all(|a| (first[a]..=last[a]).contains(&point.place[a]));
        // By `for_each`, which takes a nested iterator apart; `extend` pays for each step of it.
        points.filter(is_near).for_each(|point| around.push(self.centre(point, middle)));
    }
}

/// For each of six sides (x down, x up, y down …) the cells of a brick that have no neighbour there.
fn open_faces(solid: &CellSet, corner: Voxel, brick: u64) -> [u64; 6] {
    let beside = |x, y, z| solid.brick(Voxel::new(corner.x + x, corner.y + y, corner.z + z));
    // Cells at x = 0, at x = 3, at y = 0, at y = 3.
    const X0: u64 = 0x1111_1111_1111_1111;
    const X3: u64 = X0 << 3;
    const Y0: u64 = 0x000f_000f_000f_000f;
    const Y3: u64 = Y0 << 12;
    [
        brick & !((brick & !X3) << 1 | (beside(-4, 0, 0) & X3) >> 3),
        brick & !((brick & !X0) >> 1 | (beside(4, 0, 0) & X0) << 3),
        brick & !((brick & !Y3) << 4 | (beside(0, -4, 0) & Y3) >> 12),
        brick & !((brick & !Y0) >> 4 | (beside(0, 4, 0) & Y0) << 12),
        brick & !(brick << 16 | beside(0, 0, -4) >> 48),
        brick & !(brick >> 16 | beside(0, 0, 4) << 48),
    ]
}

/// The direction in which the points around `at` spread least, or zero where they lie on a line or are fewer
/// than three.
fn normal(at: [f64; 3], around: &[[f64; 3]]) -> [f64; 3] {
    let reach = f64::from(NORMAL_REACH * NORMAL_REACH);
    // Moments about `at`, which is near the mean.
    let (mut count, mut sum, mut square) = (0.0, [0.0; 3], [[0.0; 3]; 3]);
    for point in around {
        let d: [f64; 3] = core::array::from_fn(|a| point[a] - at[a]);
        if d[0] * d[0] + d[1] * d[1] + d[2] * d[2] > reach {
            continue;
        }
        count += 1.0;
        for a in 0..3 {
            sum[a] += d[a];
            for b in a..3 {
                square[a][b] += d[a] * d[b];
            }
        }
    }
    if count < 3.0 {
        return [0.0; 3];
    }
    let spread = |a: usize, b: usize| square[a.min(b)][a.max(b)] / count - sum[a] * sum[b] / (count * count);
    let (values, vectors) = eigen([0, 1, 2].map(|a| [0, 1, 2].map(|b| spread(a, b))));
    let mut order = [0, 1, 2];
    order.sort_unstable_by(|&a, &b| values[a].total_cmp(&values[b]));
    let [least, middle, most] = order;
    if values[middle] <= 0.01 * values[most] {
        return [0.0; 3];
    }
    core::array::from_fn(|a| vectors[a][least])
}

/// Eigenvalues and eigenvectors (columns) of a symmetric matrix, by Jacobi's rotations. Converges
/// quadratically; six sweeps are far more than doubles can distinguish.
fn eigen(mut m: [[f64; 3]; 3]) -> ([f64; 3], [[f64; 3]; 3]) {
    let mut vectors = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for _ in 0..6 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if m[p][q].abs() <= 1e-15 * (m[p][p].abs() + m[q][q].abs()) {
                continue;
            }
            // Tangent of the angle that makes m[p][q] zero, the smaller of the two.
            let theta = (m[q][q] - m[p][p]) / (2.0 * m[p][q]);
            let sign = if theta < 0.0 { -1.0 } else { 1.0 };
            let t = sign / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            for row in m.iter_mut().chain(&mut vectors) {
                (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
            }
            let (upper, lower) = (m[p], m[q]);
            m[p] = core::array::from_fn(|k| c * upper[k] - s * lower[k]);
            m[q] = core::array::from_fn(|k| s * upper[k] + c * lower[k]);
        }
    }
    ([m[0][0], m[1][1], m[2][2]], vectors)
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::VoxelBox;

    fn set(cells: impl IntoIterator<Item = [i32; 3]>) -> CellSet {
        let region = VoxelBox::new(Voxel::new(-64, -64, -64), [128; 3]).unwrap();
        let mut set = CellSet::new(region).unwrap();
        for [x, y, z] in cells {
            set.insert(Voxel::new(x, y, z)).unwrap();
        }
        set
    }

    #[test]
    fn a_face_is_open_where_the_next_cell_is_not_solid() {
        // A heap without order, with neighbours across the borders of bricks.
        let cells: Vec<[i32; 3]> = (0..4_000u64)
            .map(|i| {
                let bits = crate::random::mix(i);
                [bits & 15, bits >> 4 & 15, bits >> 8 & 15].map(|v| v as i32 - 8)
            })
            .collect();
        let solid = set(cells);
        let steps = [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]];
        for (corner, brick) in solid.bricks() {
            let open = open_faces(&solid, corner, brick);
            for bit in 0..64 {
                let [x, y, z] = [corner.x + (bit & 3), corner.y + (bit >> 2 & 3), corner.z + (bit >> 4)];
                for (side, [dx, dy, dz]) in steps.into_iter().enumerate() {
                    let is_open = solid.contains(Voxel::new(x, y, z))
                        && !solid.contains(Voxel::new(x + dx, y + dy, z + dz));
                    assert_eq!(open[side] >> bit & 1 != 0, is_open);
                }
            }
        }
    }

    #[test]
    fn normals_stand_on_walls_floors_and_slopes() {
        let resolution = Resolution::from_metres(0.05).unwrap();
        type Plane = fn(i32, i32) -> [i32; 3];
        let planes: [(Plane, [f64; 3]); 4] = [
            (|a, b| [a, b, 3], [0.0, 0.0, 1.0]),
            (|a, b| [5, a, b], [1.0, 0.0, 0.0]),
            (|a, b| [a, a, b], [0.5f64.sqrt(), -0.5f64.sqrt(), 0.0]),
            (|a, b| [a, b, b], [0.0, 0.5f64.sqrt(), -0.5f64.sqrt()]),
        ];
        for (plane, expected) in planes {
            let cells = (-60..60).flat_map(|a| (-60..60).map(move |b| plane(a, b)));
            let surface = Surface::new(&set(cells), resolution);
            assert_eq!(surface.spacing_m, 0.1);
            assert!(surface.points.len() > 3_000, "{}", surface.points.len());
            for point in &surface.points {
                let normal = point.normal.map(f64::from);
                let cosine: f64 = (0..3).map(|a| normal[a] * expected[a]).sum();
                assert!(cosine.abs() > 0.99, "{normal:?} should be {expected:?}");
            }
        }
    }

    #[test]
    fn a_line_of_cells_has_no_normal() {
        let surface = Surface::new(&set((-50..50).map(|z| [0, 0, z])), Resolution::from_metres(0.1).unwrap());
        assert_eq!(surface.points.len(), 100);
        assert!(surface.points.iter().all(|point| point.normal == [0.0; 3]));
    }

    #[test]
    fn a_sheet_has_points_on_both_of_its_sides() {
        // 0.1 m thick, as wide as the cubes in which points are gathered.
        let cells = (-40..40).flat_map(|a| (-40..40).flat_map(move |b| (0..2).map(move |z| [a, b, z])));
        let surface = Surface::new(&set(cells), Resolution::from_metres(0.05).unwrap());
        for patch in &surface.patches {
            for point in surface.points(patch) {
                let [x, y, z]: [f64; 3] =
                    core::array::from_fn(|a| patch.centre[a] + f64::from(point.offset[a]));
                if x.abs().max(y.abs()) > 1.85 {
                    continue;
                }
                assert_eq!(point.faces([0.0, 0.0, -5.0], 0.1), z > 0.05, "{z}");
                assert!(z.abs() < 1e-6 || (z - 0.1).abs() < 1e-6, "{z}");
            }
        }
    }

    #[test]
    fn too_many_points_are_taken_further_apart() {
        let cells = (0..40).flat_map(|a| (0..40).map(move |b| [a, b, 0]));
        assert!(Bricks::gather(&set(cells.clone()), 1, 1_600, 100).is_some());
        assert!(Bricks::gather(&set(cells.clone()), 1, 1_599, 100).is_none());
        assert!(Bricks::gather(&set(cells), 1, 1_600, 99).is_none());
    }

    #[test]
    fn points_lie_on_the_open_faces() {
        // A block of 2 × 2 × 1 m: its points lie on its skin, and none inside.
        let cells = (0..40).flat_map(|x| (0..40).flat_map(move |y| (0..20).map(move |z| [x, y, z])));
        let surface = Surface::new(&set(cells), Resolution::from_metres(0.05).unwrap());
        for patch in &surface.patches {
            for point in surface.points(patch) {
                let at: [f64; 3] = core::array::from_fn(|a| patch.centre[a] + f64::from(point.offset[a]));
                let depth =
                    (0..3).map(|a| at[a].min([2.0, 2.0, 1.0][a] - at[a])).fold(f64::INFINITY, f64::min);
                assert!((-1e-6..0.051).contains(&depth), "{at:?}");
            }
        }
    }
}
