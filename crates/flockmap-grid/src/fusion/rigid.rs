//! A rigid motion of the voxels of a block, a row of eight at a time.

use crate::block::{extent, plane_within};
use crate::{BlockIndex, Plane, Pose, Resolution, VOXEL_LIMIT, Voxel, VoxelBox};

/// A rigid motion in voxel units.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rigid {
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
}

/// Coordinates of the images of a row of voxels: by axis, by voxel.
pub(super) type Row<T> = [[T; 8]; 3];

/// The centre of a voxel and that of the voxel into which it is brought lie within half the diagonal of a
/// voxel, 0.87. So the voxels that may be brought into this one are, along an axis, the whole numbers from
/// 1.37 below the image of its centre to 0.37 above it: from the one nearest to the first of these to the one
/// nearest to the second.
const NEAR: [f64; 2] = [-0.87, -0.13];

/// Far more than what rounding takes from or adds to a coordinate of the grid.
const SLACK: f64 = 1.0 / 65_536.0;

/// Parts into which a voxel is divided: no image of a block's voxels is 32 voxels from that of its first.
const PART: i32 = 1 << PART_BITS;
const PART_BITS: u32 = 26;

/// Parts by which what is reckoned in parts can be off: at most 11 of the steps, which are rounded, and 8 of
/// the numbers, which have 24 bits below the voxel at the end of the grid.
const DOUBT: i32 = 256;

/// Voxels along a side of what the images of a block can touch: its diagonal from centre to centre, 12.1, and
/// what is in reach.
const WINDOW: usize = 16;

impl Rigid {
    pub(super) fn new(pose: &Pose, resolution: Resolution) -> Self {
        let scale = 1.0 / resolution.metres();
        Self { rotation: pose.rotation_rows(), translation: pose.translation().map(|t| t * scale) }
    }

    /// The motion of what was shifted before.
    pub(super) fn after_shift(&self, shift: [f64; 3]) -> Self {
        Self { rotation: self.rotation, translation: self.transform(shift) }
    }

    /// The motion, and a shift after it.
    pub(super) fn before_shift(&self, shift: [f64; 3]) -> Self {
        let translation = core::array::from_fn(|axis| self.translation[axis] + shift[axis]);
        Self { rotation: self.rotation, translation }
    }

    /// The image of a point, in voxels.
    pub(super) fn transform(&self, p: [f64; 3]) -> [f64; 3] {
        core::array::from_fn(|axis| {
            let [a, b, c] = self.rotation[axis];
            a * p[0] + b * p[1] + c * p[2] + self.translation[axis]
        })
    }

    /// The image of the centre of a voxel. Each function here adds in this order, so that all agree to the
    /// last bit.
    fn image(&self, v: Voxel) -> [f64; 3] {
        core::array::from_fn(|axis| self.image_along(axis, v))
    }

    #[inline(always)]
    fn image_along(&self, axis: usize, v: Voxel) -> f64 {
        let p = [v.x, v.y, v.z].map(|i| f64::from(i) + 0.5);
        let [a, b, c] = self.rotation[axis];
        a * p[0] + b * p[1] + c * p[2] + self.translation[axis]
    }

    /// The voxel of the target grid that holds the centre of this voxel.
    pub(super) fn voxel(&self, v: Voxel) -> Voxel {
        let [x, y, z] = self.image(v).map(floor);
        Voxel::new(x, y, z)
    }

    /// The lowest and the highest voxel of those that the inverse may bring into this one: two along each
    /// axis at most.
    pub(super) fn near(&self, v: Voxel) -> [Voxel; 2] {
        let image = self.image(v);
        NEAR.map(|end| {
            let [x, y, z] = image.map(|at| nearest(at + end));
            Voxel::new(x, y, z)
        })
    }

    /// The same for all voxels of a block that `mask` holds, which has some: no more than 16 along each axis.
    pub(super) fn near_block(&self, index: BlockIndex, mask: &Plane) -> [Voxel; 2] {
        self.near_box(corners(index, mask))
    }

    /// The same for a box.
    fn near_box(&self, (min, max): (Voxel, Voxel)) -> [Voxel; 2] {
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

    /// Calls `row` for each row of a block in which `mask` has voxels: the number of its first bit, the eight
    /// bits of `mask`, the images.
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

    /// Calls `row` for each row of a block in which `mask` has voxels: the number of its first bit, the eight
    /// bits of `mask`, the voxels that hold the images of the centres. Reckoned in parts of a voxel, whole
    /// numbers that the compiler adds several at once; only what comes so near to a border that these do not
    /// settle the side is worked out as [`Self::voxel`] does.
    #[inline(always)]
    pub(super) fn each_row(
        &self,
        index: BlockIndex,
        mask: &Plane,
        mut row: impl FnMut(usize, u8, &Row<i32>),
    ) {
        let corner = index.corner();
        let start = self.image(corner);
        let anchor = start.map(floor);
        let parts = |at: f64| nearest(at * f64::from(PART));
        let start: [i32; 3] = core::array::from_fn(|axis| parts(start[axis] - f64::from(anchor[axis])));
        let step = self.rotation.map(|turn| turn.map(parts));
        let along_x: Row<i32> = step.map(|step| core::array::from_fn(|x| step[0] * x as i32));
        for z in (0..8).filter(|z| mask[*z] != 0) {
            for y in 0..8 {
                let bits = (mask[z] >> (8 * y)) as u8;
                if bits == 0 {
                    continue;
                }
                let mut voxels = along_x;
                for axis in 0..3 {
                    let first = start[axis] + step[axis][1] * y + step[axis][2] * z as i32;
                    let mut is_near_border = 0;
                    for at in &mut voxels[axis] {
                        let parts = first + *at;
                        is_near_border |= i32::from((parts + DOUBT) & (PART - 1) < 2 * DOUBT);
                        *at = (parts >> PART_BITS) + anchor[axis];
                    }
                    if is_near_border != 0 {
                        for (x, at) in voxels[axis].iter_mut().enumerate() {
                            let v = Voxel::new(corner.x + x as i32, corner.y + y, corner.z + z as i32);
                            *at = floor(self.image_along(axis, v));
                        }
                    }
                }
                row(z * 64 + y as usize * 8, bits, &voxels);
            }
        }
    }

    /// The voxels that hold the images of the centres of those of `mask`: block by block, no block twice.
    pub(super) fn images(&self, index: BlockIndex, mask: &Plane, mut found: impl FnMut(BlockIndex, &Plane)) {
        if *mask == [0; 8] {
            return;
        }
        let low = self.near_block(index, mask)[0].block();
        let mut planes: Planes = [0; 32 * 8];
        self.each_row(index, mask, |_, bits, voxels| {
            let places = places(voxels, low);
            each_bit(bits, |x| planes[(places[x] as usize >> 6) % planes.len()] |= 1 << (places[x] & 63));
        });
        for (number, plane) in (0..27).zip(planes.as_chunks().0) {
            if *plane != [0; 8] {
                found(numbered(low, number), plane);
            }
        }
    }

    /// The voxels that the inverse may bring into a voxel of `mask`, those into which these are brought, and
    /// few others: block by block, no block twice.
    pub(super) fn near_voxels(
        &self,
        inverse: &Self,
        index: BlockIndex,
        mask: &Plane,
        found: impl FnMut(BlockIndex, &Plane),
    ) {
        if *mask == [0; 8] {
            return;
        }
        let (min, max) = corners(index, mask);
        let [low, high] = self.near_box((min, max));
        let mut window = Window::new(low);
        if is_dense(index, mask) {
            window.mark_near_box(inverse, (min, max), high);
        } else {
            self.rows(index, mask, |_, bits, images| {
                let lows = whole(images, |at| nearest(at + NEAR[0]));
                let highs = whole(images, |at| nearest(at + NEAR[1]));
                each_bit(bits, |x| {
                    window
                        .mark([lows[0][x], lows[1][x], lows[2][x]], [highs[0][x], highs[1][x], highs[2][x]]);
                });
            });
        }
        window.blocks(high, found);
    }
}

/// Planes of three blocks along each axis, one after the other.
pub(super) type Planes = [u64; 32 * 8];

/// The block of a number among three along each axis from the first.
pub(super) fn numbered(first: BlockIndex, number: i32) -> BlockIndex {
    BlockIndex::new(first.x + number % 3, first.y + number / 3 % 3, first.z + number / 9)
}

/// Where each voxel of a row lies in such planes, if `low` is the first block: 64 times the number of the
/// word, and the bit.
#[inline(always)]
pub(super) fn places(voxels: &Row<i32>, low: BlockIndex) -> [i32; 8] {
    let corner = low.corner();
    let mut places = [0; 8];
    for (x, place) in places.iter_mut().enumerate() {
        let at = [voxels[0][x] - corner.x, voxels[1][x] - corner.y, voxels[2][x] - corner.z];
        let block = (at[2] >> 3) * 9 + (at[1] >> 3) * 3 + (at[0] >> 3);
        *place = block << 9 | (at[2] & 7) << 6 | (at[1] & 7) << 3 | (at[0] & 7);
    }
    places
}

/// Whether so many voxels of a block are meant that their neighbours are near nearly all of the box around them.
pub(super) fn is_dense(index: BlockIndex, mask: &Plane) -> bool {
    let (min, max) = corners(index, mask);
    let volume = (max.x - min.x + 1) * (max.y - min.y + 1) * (max.z - min.z + 1);
    let voxels: u32 = mask.iter().map(|slice| slice.count_ones()).sum();
    voxels * 4 >= volume as u32
}

/// Each number of a row made whole. Loops over arrays that are there, which the compiler turns into several
/// at once; `map` it would not.
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

/// Added to a number below 2³¹, as those of the grid are, this leaves its nearest whole number in the lowest
/// bits.
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
    let (corner, (low, high)) = (index.corner(), extent(mask));
    let at = |[x, y, z]: [i32; 3]| Voxel::new(corner.x + x, corner.y + y, corner.z + z);
    (at(low), at(high))
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

    /// What may be brought into a box, up to the voxel `high`: what `inverse` brings so near to it that the
    /// voxels may have a part in common. Along a row these are neighbours, and the faces of the box say where
    /// they begin and end.
    fn mark_near_box(&mut self, inverse: &Rigid, (min, max): (Voxel, Voxel), high: Voxel) {
        let low = self.low;
        let (min, max) = ([min.x, min.y, min.z].map(f64::from), [max.x, max.y, max.z].map(f64::from));
        // By axis of the box: how far a step along the row goes, as a divisor; where the faces are, seen from
        // the start of a row.
        let start = inverse.image(low);
        let turn = inverse.rotation;
        let reach = turn.map(|turn| turn.iter().map(|part| part.abs()).sum::<f64>() * 0.5 + SLACK);
        let step: [f64; 3] = core::array::from_fn(|axis| {
            let step = turn[axis][0];
            // What is so small does not matter over a row; it only must not divide by nothing.
            1.0 / if step.abs() < SLACK / 64.0 { SLACK / 64.0 } else { step }
        });
        let faces: [[f64; 2]; 3] = core::array::from_fn(|axis| {
            [min[axis] + 0.5 - reach[axis] - start[axis], max[axis] + 0.5 + reach[axis] - start[axis]]
        });
        for z in 0..=(high.z - low.z).clamp(0, WINDOW as i32 - 1) {
            for y in 0..=(high.y - low.y).clamp(0, WINDOW as i32 - 1) {
                let (mut first, mut last) = (0.0f64, f64::from(high.x - low.x));
                for axis in 0..3 {
                    let at = f64::from(y) * turn[axis][1] + f64::from(z) * turn[axis][2];
                    let [a, b] = faces[axis].map(|face| (face - at) * step[axis]);
                    first = first.max(a.min(b));
                    last = last.min(a.max(b));
                }
                if first <= last {
                    // Rounded up and down, unless it is next to a whole number.
                    let (first, last) = (nearest(first + 0.499), nearest(last - 0.499));
                    let bits = (2u32 << (last & 15)) - (1 << (first & 15));
                    self.rows[z as usize * WINDOW + y as usize] = bits as u16;
                }
            }
        }
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
        let [low, high] = [-VOXEL_LIMIT, VOXEL_LIMIT].map(|end| Voxel::new(end, end, end));
        for (number, mut plane) in (0..).zip(planes).filter(|(_, plane)| *plane != [0; 8]) {
            let index = numbered(first, number);
            // Only at its end does the grid cut a block.
            if VoxelBox::new(index.corner(), [8; 3]).is_none() {
                let in_grid = plane_within(index, low, high);
                plane = core::array::from_fn(|z| plane[z] & in_grid[z]);
            }
            if plane != [0; 8] {
                found(index, &plane);
            }
        }
    }
}
