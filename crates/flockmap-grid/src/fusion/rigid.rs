//! A rigid motion of the voxels of a block, a row of eight at a time.

use crate::{BlockIndex, Plane, Pose, Resolution, VOXEL_LIMIT, Voxel, bit_of};

/// A rigid motion in voxel units.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rigid {
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
}

/// Coordinates of the images of a row of voxels: by axis, by voxel.
pub(super) type Row<T> = [[T; 8]; 3];

/// The centre of a voxel and that of the voxel into which it is brought lie within half the diagonal of a voxel, 0.87. So the voxels that
/// may be brought into this one are, along an axis, the whole numbers from 1.37 below the image of its centre to 0.37 above it: from the
/// one nearest to the first of these to the one nearest to the second.
const NEAR: [f64; 2] = [-0.87, -0.13];

/// Voxels along a side of what the images of a block can touch: its diagonal from centre to centre, 12.1, and what is in reach.
const WINDOW: usize = 16;

impl Rigid {
    pub(super) fn new(pose: &Pose, resolution: Resolution) -> Self {
        let scale = 1.0 / resolution.metres();
        Self { rotation: pose.rotation_rows(), translation: pose.translation().map(|t| t * scale) }
    }

    /// The image of the centre of a voxel. Each function here adds in this order, so that all agree to the last bit.
    fn image(&self, v: Voxel) -> [f64; 3] {
        let p = [v.x, v.y, v.z].map(|i| f64::from(i) + 0.5);
        core::array::from_fn(|axis| {
            let [a, b, c] = self.rotation[axis];
            a * p[0] + b * p[1] + c * p[2] + self.translation[axis]
        })
    }

    /// The voxel of the target grid that holds the centre of this voxel.
    pub(super) fn voxel(&self, v: Voxel) -> Voxel {
        let [x, y, z] = self.image(v).map(floor);
        Voxel::new(x, y, z)
    }

    /// The lowest and the highest voxel of those that the inverse may bring into this one: two along each axis at most.
    pub(super) fn near(&self, v: Voxel) -> [Voxel; 2] {
        let image = self.image(v);
        NEAR.map(|end| {
            let [x, y, z] = image.map(|at| nearest(at + end));
            Voxel::new(x, y, z)
        })
    }

    /// The same for all voxels of a block that `mask` holds, which has some: no more than 16 along each axis.
    pub(super) fn near_block(&self, index: BlockIndex, mask: &Plane) -> [Voxel; 2] {
        let (min, max) = corners(index, mask);
        // Sums are rounded in the same direction at both ends, so that what lies between stays between.
        let end = |is_upper: bool| {
            let [x, y, z] = core::array::from_fn(|axis| {
                let turn = self.rotation[axis];
                let pick = |a: usize, low: i32, high: i32| {
                    f64::from(if (turn[a] >= 0.0) == is_upper { high } else { low }) + 0.5
                };
                let p = [pick(0, min.x, max.x), pick(1, min.y, max.y), pick(2, min.z, max.z)];
                let at = turn[0] * p[0] + turn[1] * p[1] + turn[2] * p[2] + self.translation[axis];
                nearest(at + NEAR[usize::from(is_upper)])
            });
            Voxel::new(x, y, z)
        };
        [end(false), end(true)]
    }

    /// Hands on each row of a block in which `mask` has voxels: the number of its first bit, the eight bits of `mask`, the images.
    #[inline(always)]
    fn rows(&self, index: BlockIndex, mask: &Plane, mut row: impl FnMut(usize, u8, &Row<f64>)) {
        let corner = index.corner();
        let along_x: Row<f64> = self
            .rotation
            .map(|turn| core::array::from_fn(|x| turn[0] * (f64::from(corner.x + x as i32) + 0.5)));
        for z in (0..8).filter(|z| mask[*z] != 0) {
            let along_z = self.rotation.map(|turn| turn[2] * (f64::from(corner.z + z as i32) + 0.5));
            for y in 0..8 {
                let bits = (mask[z] >> (8 * y)) as u8;
                if bits == 0 {
                    continue;
                }
                let mut images = along_x;
                for axis in 0..3 {
                    let along_y = self.rotation[axis][1] * (f64::from(corner.y + y as i32) + 0.5);
                    for image in &mut images[axis] {
                        *image = *image + along_y + along_z[axis] + self.translation[axis];
                    }
                }
                row(z * 64 + y * 8, bits, &images);
            }
        }
    }

    /// For each voxel of a block that `mask` holds: its bit, and the voxel that holds the image of its centre.
    #[inline(always)]
    pub(super) fn each_voxel(&self, index: BlockIndex, mask: &Plane, mut found: impl FnMut(usize, [i32; 3])) {
        self.rows(index, mask, |first, bits, images| {
            let voxels = whole(images, floor);
            each_bit(bits, |x| found(first + x, [voxels[0][x], voxels[1][x], voxels[2][x]]));
        });
    }

    /// The voxels that the inverse may bring into a voxel of `mask`, and those into which these are brought: block by block, no block
    /// twice.
    pub(super) fn near_voxels(&self, index: BlockIndex, mask: &Plane, found: impl FnMut(BlockIndex, &Plane)) {
        if *mask == [0; 8] {
            return;
        }
        let [low, high] = self.near_block(index, mask);
        let mut window = Window::new(low);
        self.rows(index, mask, |_, bits, images| {
            let lows = whole(images, |at| nearest(at + NEAR[0]));
            let highs = whole(images, |at| nearest(at + NEAR[1]));
            each_bit(bits, |x| {
                window.mark([lows[0][x], lows[1][x], lows[2][x]], [highs[0][x], highs[1][x], highs[2][x]]);
            });
        });
        window.blocks(high, found);
    }
}

/// Each number of a row made whole. Loops over arrays that are there, which the compiler turns into several at once; `map` it would not.
#[inline(always)]
fn whole(row: &Row<f64>, round: impl Fn(f64) -> i32) -> Row<i32> {
    let mut whole = [[0; 8]; 3];
    for (to, from) in whole.iter_mut().zip(row) {
        for (to, from) in to.iter_mut().zip(from) {
            *to = round(*from);
        }
    }
    whole
}

#[inline(always)]
fn each_bit(bits: u8, mut found: impl FnMut(usize)) {
    let mut left = bits;
    while left != 0 {
        found(left.trailing_zeros() as usize & 7);
        left &= left - 1;
    }
}

/// Added to a number below 2³¹, as those of the grid are, this leaves its nearest whole number in the lowest bits.
const WHOLE: f64 = 6_755_399_441_055_744.0;

/// The nearest whole number. Without a call or a branch, so that the compiler can take several at once.
#[inline(always)]
fn nearest(at: f64) -> i32 {
    (at + WHOLE).to_bits() as i32
}

/// Rounded down, likewise.
#[inline(always)]
fn floor(at: f64) -> i32 {
    let whole = (at + WHOLE) - WHOLE;
    nearest(whole - if whole > at { 1.0 } else { 0.0 })
}

/// The lowest and the highest voxel of a box that holds those of `mask`, which has some.
fn corners(index: BlockIndex, mask: &Plane) -> (Voxel, Voxel) {
    let all = mask.iter().fold(0, |all, slice| all | slice);
    let columns = (0..8).fold(0u8, |columns, y| columns | (all >> (8 * y)) as u8);
    let ends = |low: u32, high: u32| [low.min(7) as i32, 7 - high.min(7) as i32];
    let x = ends(columns.trailing_zeros(), columns.leading_zeros());
    let y = ends(all.trailing_zeros() / 8, all.leading_zeros() / 8);
    let z = [mask.iter().position(|z| *z != 0), mask.iter().rposition(|z| *z != 0)]
        .map(|z| z.unwrap_or_default() as i32);
    let corner = index.corner();
    let at = |end: usize| Voxel::new(corner.x + x[end], corner.y + y[end], corner.z + z[end]);
    (at(0), at(1))
}

/// Voxels near the images of a block.
struct Window {
    low: Voxel,
    /// A bit for each voxel along x, by z and y from the lowest.
    rows: [u16; WINDOW * WINDOW],
}

impl Window {
    fn new(low: Voxel) -> Self {
        Self { low, rows: [0; WINDOW * WINDOW] }
    }

    /// The voxels of a box, which has one or two along each axis.
    #[inline(always)]
    fn mark(&mut self, low: [i32; 3], high: [i32; 3]) {
        let from = [self.low.x, self.low.y, self.low.z];
        let at = |end: [i32; 3], axis: usize| end[axis].wrapping_sub(from[axis]) as usize & (WINDOW - 1);
        let bits = 1 << at(low, 0) | 1 << at(high, 0);
        let (y, z) = ([at(low, 1), at(high, 1)], [at(low, 2) * WINDOW, at(high, 2) * WINDOW]);
        self.rows[z[0] + y[0]] |= bits;
        self.rows[z[0] + y[1]] |= bits;
        self.rows[z[1] + y[0]] |= bits;
        self.rows[z[1] + y[1]] |= bits;
    }

    /// What was marked, block by block, and what of it lies in the grid.
    fn blocks(&self, high: Voxel, mut found: impl FnMut(BlockIndex, &Plane)) {
        let mut planes = [[0u64; 8]; 27];
        let first = self.low.block();
        let [height, depth] = [high.y - self.low.y, high.z - self.low.z].map(|last| last.max(0) as usize);
        for z in 0..=depth.min(WINDOW - 1) {
            for y in 0..=height.min(WINDOW - 1) {
                let bits = u32::from(self.rows[z * WINDOW + y]) << (self.low.x & 7);
                if bits == 0 {
                    continue;
                }
                let (y, z) = (self.low.y + y as i32, self.low.z + z as i32);
                let column = ((z >> 3) - first.z) * 9 + ((y >> 3) - first.y) * 3;
                for (x, byte) in bits.to_le_bytes().into_iter().take(3).enumerate() {
                    if let Some(plane) = planes.get_mut(column as usize + x) {
                        plane[z as usize & 7] |= u64::from(byte) << (8 * (y & 7));
                    }
                }
            }
        }
        for (number, plane) in planes.iter_mut().enumerate().filter(|(_, plane)| **plane != [0; 8]) {
            let [x, y, z] = [number % 3, number / 3 % 3, number / 9].map(|at| at as i32);
            let index = BlockIndex::new(first.x + x, first.y + y, first.z + z);
            keep_in_grid(index, plane);
            if *plane != [0; 8] {
                found(index, plane);
            }
        }
    }
}

/// Takes the voxels out of a plane that lie beyond the end of the grid.
fn keep_in_grid(index: BlockIndex, plane: &mut Plane) {
    let is_within = |at: i32| (-VOXEL_LIMIT / 8..VOXEL_LIMIT / 8).contains(&at);
    if [index.x, index.y, index.z].into_iter().all(is_within) {
        return;
    }
    let corner = index.corner();
    for bit in 0..512 {
        let [x, y, z] = bit_of(bit);
        if !Voxel::new(corner.x + x, corner.y + y, corner.z + z).in_limits() {
            plane[bit / 64] &= !(1 << (bit % 64));
        }
    }
}
