//! The contexts of the flags of rows and slices. Each has a trained table, and the values of all add up.

use super::cells::Row;
use super::neighbourhood::Neighbourhood;

/// Flags that are mixed.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum MixedFlag {
    /// Whether a row changes beyond which nothing has.
    ColdRow = 0,
    /// Whether Free voxels of a row become Occupied.
    FreeToOccupied = 1,
    /// Whether a slice changes beyond which nothing has.
    ColdSlice = 2,
}

pub(crate) const MIXED_FLAGS: usize = 3;
/// Contexts of a flag that have a value in the sums.
pub(crate) const FLAG_PLACES: usize = 4;

// Where in the sums each table begins.
const KNOWN: usize = 8_192;
const OCCUPIED: usize = KNOWN + 4_096;
const PLACE: usize = OCCUPIED + 4_096;
/// Values of all tables of a flag.
pub(crate) const FLAG_SUMS: usize = PLACE + 4_096;

/// Where the values of a flag are in the sums: of the row at a place, of which these voxels may change, and
/// with a class below 64.
#[inline(always)]
pub(crate) fn of_row(cells: &Neighbourhood, at: usize, voxels: u8, class: usize) -> [usize; FLAG_PLACES] {
    // So many rows and slices on.
    let row = |y: isize, z: isize| cells.row(at.wrapping_add_signed(16 * z + y));
    let known = |row: Row| ((row | row >> 16) >> 3) as u8;
    let fresh = |row: Row| (row >> 35) as u8;
    let occupied = |row: Row| (row >> 51) as u8;
    let few = |bits: u8| class_of(0, bits);
    let most = |bits: u8| class_of(1, bits);
    let some = |bits: u8| class_of(2, bits);

    let (own, over, beside, beyond) = (row(0, 0), row(0, -1), row(-1, 0), row(-1, -1));
    let (under, next, over_next, over_2, beside_2) =
        (row(0, 1), row(1, 0), row(1, -1), row(0, -2), row(-2, 0));
    let near = fresh(over_2 | row(-1, -2) | beside_2 | row(-2, -1) | row(-2, -2));
    let aside = fresh(over_next | row(1, -2));
    let far = fresh(row(0, -3) | row(-1, -3) | row(-3, 0) | row(-3, -1));
    let ends = own | over | beside | beyond;
    let ends = usize::from(ends >> 43 & 7 != 0) | usize::from(ends >> 32 & 3 != 0) << 1;
    let aside = usize::from(aside != 0) + usize::from(aside & aside.wrapping_sub(1) != 0);
    let y = (at & 15).wrapping_sub(3) & 7;
    let z = (at >> 4).wrapping_sub(3) & 7;
    let class = class & 63;
    [
        class | few(near & voxels) << 6 | aside << 8 | usize::from(far != 0) << 10 | ends << 11,
        KNOWN
            + (most(known(over))
                | most(known(beside)) << 2
                | most(known(under)) << 4
                | most(known(next)) << 6
                | some(known(own)) << 8
                | most(known(over_next)) << 10),
        OCCUPIED
            + (few(occupied(over | beside | beyond))
                | few(occupied(under | next)) << 2
                | few(occupied(over_next | over_2 | beside_2 | row(1, 1) | row(-1, 1))) << 4
                | few(occupied(own)) << 6
                | class_of(3, voxels) << 8
                | some(known(own)) << 10),
        PLACE + (class | y << 6 | z << 9),
    ]
}

/// A slice beyond which nothing has changed.
pub(crate) struct Slice {
    /// All its rows laid over each other, those of the slice beyond it, and those of the slice before it.
    pub(crate) rows: [Row; 3],
    /// How many have Unknown voxels.
    pub(crate) unknown_rows: usize,
    pub(crate) z: usize,
    /// How many slices of the block have changes so far.
    pub(crate) changed: usize,
    /// From the middle of the block to the sensor across the slices, in sixteenths of a voxel.
    pub(crate) distance: i32,
}

impl Slice {
    /// Where the values of its flag are in the sums; the class is below 64.
    #[inline(always)]
    pub(crate) fn places(&self, class: usize) -> [usize; FLAG_PLACES] {
        let known = self.rows.map(|row| class_of(1, ((row | row >> 16) >> 3) as u8));
        let occupied = self.rows.map(|row| ((row >> 51) as u8).count_ones() as usize);
        let blocks = (self.distance >> 7).clamp(0, 15) as usize;
        let class = class & 63;
        [
            class | self.z << 6 | self.changed.min(3) << 9 | occupied[0].min(3) << 11,
            KNOWN
                + (known[0]
                    | known[1] << 2
                    | known[2] << 4
                    | self.unknown_rows.min(15) << 6
                    | occupied[1].min(3) << 10),
            OCCUPIED + (occupied[0] | occupied[1] << 4 | occupied[2] << 8),
            PLACE
                + (blocks
                    | self.z << 4
                    | self.changed.min(3) << 7
                    | (self.unknown_rows / 3).min(3) << 9
                    | usize::from(occupied[0] > 0) << 11),
        ]
    }
}

#[inline(always)]
fn class_of(which: usize, bits: u8) -> usize {
    usize::from(CLASSES[which][usize::from(bits)] & 3)
}

/// Classes by eight bits: how many are set.
static CLASSES: [[u8; 256]; 4] = {
    const BOUNDS: [[u32; 3]; 4] = [[1, 2, 4], [1, 4, 8], [1, 3, 5], [3, 6, 8]];
    let mut table = [[0; 256]; 4];
    let mut at = 0;
    while at < 4 * 256 * 3 {
        let (which, bits, bound) = (at / 3 / 256, at / 3 % 256, at % 3);
        table[which][bits] += ((bits as u32).count_ones() >= BOUNDS[which][bound]) as u8;
        at += 1;
    }
    table
};
