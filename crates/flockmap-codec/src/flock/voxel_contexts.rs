//! The contexts of the Unknown voxels of a row: what is known of the cells round each, and along its ray.
//!
//! They are made for a row at once, as bytes with a bit for each voxel. The contexts of one voxel are the same bit
//! of every byte.

use fearless_simd::prelude::*;
use fearless_simd::{i8x16, i8x32, u64x2, u64x4};

use super::cells::{Row, STATES, new, occupied};
use super::neighbourhood::{Neighbourhood, ROW, SLICE};
use super::rays::Rays;

/// Contexts of an unknown voxel by the cells around it.
pub(crate) const NEAR_CONTEXTS: usize = 1 << 16;
/// Contexts of an unknown voxel by the cells along its ray.
pub(crate) const RAY_CONTEXTS: usize = 1 << 15;
/// Contexts of a voxel beyond the nearest cells and the ray, each with a table.
pub(crate) const WIDE_PLACES: usize = 6;

// Where each of their tables begins.
const OBSTACLES: usize = 4_096;
const ASKEW: usize = OBSTACLES + 4_096;
const DISTANT: usize = ASKEW + 4_096;
const COUNTS: usize = DISTANT + 4_096;
const SLOPES: usize = COUNTS + 2_048;
/// Values of all of them.
pub(crate) const WIDE_SUMS: usize = SLOPES + 16_384;

/// Of a row, as it began.
pub(crate) struct RowContexts<S: Simd> {
    simd: S,
    /// The sixteen bytes of the nearest cells, and those of the cells along the ray.
    near_and_ray: u64x4<S>,
    /// 48 bytes of cells that are farther away, for the sums.
    wide: (u64x4<S>, u64x2<S>),
    /// What is the same for all voxels of the row, of the nearest cells and of the ray.
    all: u32,
    /// How many cells round the row are Occupied, new and known, in eight classes each, four times.
    counts: usize,
    /// The slopes of the rays along x and along y, in eight steps each, 256 times.
    slopes: usize,
    own: &'static [Own; 2],
}

/// Of a voxel, when all voxels of its row before it are coded.
pub(crate) struct VoxelContexts<'a, S: Simd> {
    row: &'a RowContexts<S>,
    x: u32,
    near_and_ray: u32,
}

impl<S: Simd> VoxelContexts<'_, S> {
    #[inline(always)]
    pub(crate) fn near(&self) -> usize {
        (self.near_and_ray & 0xffff) as usize
    }

    #[inline(always)]
    pub(crate) fn ray(&self) -> usize {
        (self.near_and_ray >> 16) as usize % RAY_CONTEXTS
    }

    /// Where its values are in the tables of the others.
    #[inline(always)]
    pub(crate) fn wide_places(&self) -> [usize; WIDE_PLACES] {
        let (low, high) = self.row.wide;
        let wide = u64::from(column_of_32(low, self.x)) | u64::from(column_of_16(high, self.x)) << 32;
        let twelve = |at: u32| (wide >> at) as usize & 4_095;
        let near = self.near();
        [
            twelve(0),
            OBSTACLES + twelve(12),
            ASKEW + twelve(24),
            DISTANT + twelve(36),
            COUNTS + (self.row.counts | near & 1 | near >> 1 & 2),
            SLOPES + (self.row.slopes | near >> 4 & 0xf0 | near & 15),
        ]
    }
}

/// One bit of each of 32 bytes: a shift of the words that they are in brings it to the highest place, in whatever order
/// the bytes stand there.
#[inline(always)]
fn column_of_32<S: Simd>(bytes: u64x4<S>, bit: u32) -> u32 {
    let highest: i8x32<S> = (bytes << (7 - (bit & 7))).bitcast();
    highest.simd_lt(0).to_bitmask() as u32
}

#[inline(always)]
fn column_of_16<S: Simd>(bytes: u64x2<S>, bit: u32) -> u16 {
    let highest: i8x16<S> = (bytes << (7 - (bit & 7))).bitcast();
    highest.simd_lt(0).to_bitmask() as u16
}

/// What a voxel that was seen adds to the contexts of the two after it, as if it were the first of its row.
struct Own {
    near_and_ray: [u64; 4],
    wide: ([u64; 4], [u64; 2]),
}

/// By whether the sensor is farther away along y than along x, and whether the voxel is Occupied.
static OWN: [[Own; 2]; 2] = {
    // A bit of the voxel after it, and of the one after that. The two bits of a state stand two bytes apart.
    const fn own(near: u64, changed: u64, found: u64, distant: u64) -> Own {
        Own {
            near_and_ray: [0, (near << 1).to_le(), 0, 0],
            wide: ([(changed << 1).to_le(), 0, (found << 1).to_le(), 0], [0, (distant << 2).to_le()]),
        }
    }
    [
        [own(1, 1 << 16, 0, 1), own(1 | 1 << 16, 1 << 16, 1 << 16, 1 | 1 << 16)],
        [own(1 << 8, 0, 0, 1 << 8), own(1 << 8 | 1 << 24, 0, 1 << 24, 1 << 8 | 1 << 24)],
    ]
};

impl<S: Simd> RowContexts<S> {
    /// Of the row at a place, in the current slice of the rays.
    #[inline(always)]
    pub(crate) fn of(simd: S, cells: &Neighbourhood, at: usize, rays: &Rays) -> Self {
        let slope_y = rays.slope_y((at & 15).wrapping_sub(3));
        let slope_x = rays.slope_x;
        let (wide, near_and_ray, slope_b, slope_c);
        if rays.is_by_rows {
            (slope_b, slope_c) = (slope_y, slope_x);
            near_and_ray = self::near_and_ray::<true>(cells, at, slope_x, slope_y);
            wide = self::wide::<true>(cells, at);
        } else {
            (slope_b, slope_c) = (slope_x, slope_y);
            near_and_ray = self::near_and_ray::<false>(cells, at, slope_x, slope_y);
            wide = self::wide::<false>(cells, at);
        }
        // In memory the lowest byte comes first, on every machine.
        let [a, b, c, d, e, f] = wide.map(u64::to_le);
        // In four steps each; and whether they are in the upper two.
        let slope = (slope_b / 4).min(3) as u32 | ((slope_c / 4).min(3) as u32) << 2;
        let all = (slope >> 1 & 1 | slope >> 2 & 2) << 14 | slope << 24;
        Self {
            simd,
            near_and_ray: near_and_ray.map(u64::to_le).simd_into(simd),
            wide: ([a, b, c, d].simd_into(simd), [e, f].simd_into(simd)),
            all,
            counts: counts(cells, at) << 2,
            slopes: ((slope_x >> 1).min(7) | (slope_y >> 1).min(7) << 3) << 8,
            own: &OWN[usize::from(rays.is_by_rows)],
        }
    }

    /// Of a voxel.
    #[inline(always)]
    pub(crate) fn of_voxel(&self, x: u32) -> VoxelContexts<'_, S> {
        VoxelContexts { row: self, x, near_and_ray: column_of_32(self.near_and_ray, x) | self.all }
    }

    /// Takes in that a voxel of the row was seen: those after it know.
    #[inline(always)]
    pub(crate) fn note(&mut self, x: u32, is_occupied: bool) {
        let (own, x) = (&self.own[usize::from(is_occupied)], x & 7);
        // Bits beyond the row come to those of voxels that are coded.
        self.near_and_ray |= u64x4::simd_from(self.simd, own.near_and_ray) << x;
        self.wide.0 |= u64x4::simd_from(self.simd, own.wide.0) << x;
        self.wide.1 |= u64x2::simd_from(self.simd, own.wide.1) << x;
    }
}

/// The nearest cells, those of the row itself not among them, and the cells along the ray.
#[inline(always)]
fn near_and_ray<const BY_ROWS: bool>(
    cells: &Neighbourhood,
    at: usize,
    slope_x: usize,
    slope_y: usize,
) -> [u64; 4] {
    // Rows and voxels back along the axis on which the sensor is farther away, and along the other.
    let (b, c) = if BY_ROWS { ((ROW, 0), (0, 1)) } else { ((0, 1), (ROW, 0)) };
    let behind = |rows: usize, x: isize| cells.shifted(at.wrapping_sub(rows), -x) & STATES;
    let before = |rows: usize, x: isize| cells.shifted(at + rows, x);
    // Where the ray through a voxel was some slices before, or will be some after.
    let along = |slope: usize, slices: usize| (slices * slope + 8) >> 4;
    let ray =
        |slices: usize| (slices * SLICE + along(slope_y, slices) * ROW, along(slope_x, slices) as isize);
    let [ray_1, ray_2, ray_3] = [ray(1), ray(2), ray(3)];
    let is_known = |row: Row| (row | row >> 16) & 0xff;
    let pair = |one: Row, other: Row| one | other << 8;
    let next = before(ray_1.0, ray_1.1);
    [
        pair(behind(SLICE, 0), behind(SLICE + b.0, b.1))
            | pair(behind(SLICE + c.0, c.1), behind(SLICE + ROW, 1)) << 32,
        pair(behind(b.0, b.1), behind(c.0, c.1))
            | u64::from(new(cells.shifted(at.wrapping_sub(ROW), -1))) << 32
            | is_known(next) << 40,
        pair(behind(ray_1.0, ray_1.1), behind(ray_2.0, ray_2.1))
            | pair(behind(ray_3.0, ray_3.1), next & STATES) << 32,
        is_known(before(ray_2.0, ray_2.1)) << 32
            | is_known(before(b.0, b.1)) << 40
            | is_known(before(c.0, c.1)) << 48,
    ]
}

/// Eight cells of each voxel of a row in each word, one in each byte.
#[inline(always)]
fn wide<const BY_ROWS: bool>(cells: &Neighbourhood, at: usize) -> [u64; 6] {
    // So many steps back along b and along c, and on along z.
    let cell = |b: isize, c: isize, z: isize| {
        let (rows, x) = if BY_ROWS { (b, c) } else { (c, b) };
        cells.shifted(at.wrapping_add_signed(16 * z - rows), -x)
    };
    let state = |b, c, z| cell(b, c, z) & STATES;
    let fresh = |b, c, z| u64::from(new(cell(b, c, z)));
    let known = |b, c, z| u64::from(occupied(cell(b, c, z)) & !new(cell(b, c, z)));
    let found = |b, c, z| u64::from(occupied(cell(b, c, z)) & new(cell(b, c, z)));
    // The two bits of a state stand two bytes apart.
    let states = |[one, two, three, four]: [Row; 4]| one | two << 8 | three << 32 | four << 40;
    let bits = |bits: [u64; 8]| bits.into_iter().rev().fold(0, |all, byte| all << 8 | byte);
    let over = state(0, 0, -1);
    [
        bits([
            fresh(1, -2, 0),
            fresh(1, -1, 0),
            fresh(1, 0, 0),
            fresh(1, 1, 0),
            fresh(1, 2, 0),
            fresh(-2, 0, -1),
            fresh(-1, 0, -1),
            fresh(0, 0, -1),
        ]),
        bits([
            fresh(1, 0, -1),
            fresh(2, 0, -1),
            fresh(0, 1, -1),
            fresh(0, -1, -1),
            known(0, 0, 1),
            known(-1, 0, 1),
            known(0, -1, 1),
            known(1, 0, 1),
        ]),
        bits([
            known(0, 1, 1),
            known(0, 0, 2),
            found(1, 0, 0),
            found(0, 1, 0),
            found(0, 0, -1),
            found(1, 1, 0),
            found(1, 0, -1),
            found(0, 1, -1),
        ]),
        states([state(-1, 0, -1), state(0, -1, -1), state(1, -1, -1), state(-1, 1, -1)]),
        states([state(1, -1, 0), over, state(0, 1, -2), over]),
        states([state(2, 0, 0), state(0, 2, 0), state(0, 0, -2), state(1, 0, -2)]),
    ]
}

/// How many of the ten columns round a row have an Occupied, a new, and a known cell and no new one.
#[inline(always)]
fn counts(cells: &Neighbourhood, at: usize) -> usize {
    let mut all = 0;
    for slice in [at.wrapping_sub(16), at, at + 16] {
        all |= cells.row(slice.wrapping_sub(1)) | cells.row(slice) | cells.row(slice + 1);
    }
    let ten = |lanes: Row| (lanes >> 2 & 1_023) as usize;
    let fresh = ten(all >> 32);
    let class = |which: usize, columns: usize| usize::from(CLASSES[which][columns]);
    class(0, ten(all >> 48)) | class(1, fresh) << 3 | class(1, ten(all | all >> 16) & !fresh) << 6
}

/// Classes by ten bits: how many are set.
static CLASSES: [[u8; 1_024]; 2] = {
    const BOUNDS: [[u32; 7]; 2] = [[1, 2, 3, 4, 6, 8, 9], [1, 2, 3, 5, 7, 9, 10]];
    let mut table = [[0; 1_024]; 2];
    let mut at = 0;
    while at < 2 * 1_024 * 7 {
        let (which, columns, bound) = (at / 7 / 1_024, at / 7 % 1_024, at % 7);
        table[which][columns] += ((columns as u32).count_ones() >= BOUNDS[which][bound]) as u8;
        at += 1;
    }
    table
};
