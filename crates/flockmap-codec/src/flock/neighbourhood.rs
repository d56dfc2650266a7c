//! A block and what is around it, turned.
//!
//! The rows of a block and of three voxels around it are laid out so that its farthest slice from the sensor
//! comes first, and in each slice the farthest row and voxel. So the voxel behind another always has the
//! lower number, and one piece of code serves all directions.

use fearless_simd::{Level, dispatch};

use super::cells::{Bits, BlockCells, LANES, Row, changed};
use super::orientation::Orientation;
use super::planes::exchange;

/// Rows of the neighbourhood from one row to the next.
pub(crate) const ROW: usize = 1;
/// Rows of the neighbourhood from one slice to the next.
pub(crate) const SLICE: usize = 16;
/// Cells around the block that are filled, on every side.
const MARGIN: usize = 3;
/// Those that are needed on the side of the sensor.
const NEAR_MARGIN: usize = 2;

/// The cells of the middle of a row, as in [`BlockCells`].
#[inline]
pub(crate) fn middle(row: Row) -> Row {
    row >> MARGIN & (0xff * LANES)
}

/// The number of the cells of which nothing is known.
pub(crate) const NOTHING: u32 = 1;

/// A block in the middle of its surroundings, turned. Cells out of reach are unknown.
pub(crate) struct Neighbourhood {
    rows: [Row; 256],
}

impl Default for Neighbourhood {
    fn default() -> Self {
        Self { rows: [0; 256] }
    }
}

impl Neighbourhood {
    /// The place of the row (y, z) of the block.
    #[inline]
    pub(crate) const fn place(y: usize, z: usize) -> usize {
        (z + MARGIN) * SLICE + (y + MARGIN) * ROW
    }

    /// The row at a place, its voxel −3 in the lowest bit of each lane.
    #[inline]
    pub(crate) fn row(&self, at: usize) -> Row {
        self.rows[at & 255]
    }

    /// The cells of the eight voxels of the block in a row, or of those so many before or after.
    #[inline]
    pub(crate) fn shifted(&self, at: usize, by: isize) -> Row {
        self.row(at) >> ((MARGIN as isize + by) & 63)
    }

    /// Changes voxels of the block.
    #[inline]
    pub(crate) fn change(&mut self, at: usize, bits: Bits) {
        let row = &mut self.rows[at & 255];
        *row = changed(*row, bits, MARGIN);
    }

    /// Takes in a block and its 26 neighbours, which `slots` gives by x + 3·y + 9·z, each −1 … 1 plus one;
    /// they are mirrored as the orientation says.
    pub(crate) fn gather(&mut self, orientation: Orientation, slots: &[u32; 27], cells: &[BlockCells]) {
        dispatch!(Level::new(), _simd => self.gather_by(orientation, slots, cells));
    }

    #[inline(always)]
    fn gather_by(&mut self, orientation: Orientation, slots: &[u32; 27], cells: &[BlockCells]) {
        // Rows go straight to where they belong, unless x itself is the slow axis: then slices are turned
        // afterwards.
        match (orientation.major == 1, orientation.is_up[1]) {
            (false, false) => self.gather_rows::<SLICE, ROW, false>(orientation, slots, cells),
            (false, true) => self.gather_rows::<SLICE, ROW, true>(orientation, slots, cells),
            (true, false) => self.gather_rows::<ROW, SLICE, false>(orientation, slots, cells),
            (true, true) => self.gather_rows::<ROW, SLICE, true>(orientation, slots, cells),
        }
        if orientation.major == 0 {
            self.swap_x_and_z();
        }
    }

    /// `FAST` from row to row and `SLOW` from slice to slice, as blocks are stored; rows from the highest to
    /// the lowest if `IS_UP`.
    #[inline(always)]
    fn gather_rows<const SLOW: usize, const FAST: usize, const IS_UP: bool>(
        &mut self,
        orientation: Orientation,
        slots: &[u32; 27],
        cells: &[BlockCells],
    ) {
        self.rows.fill(0);
        for part_z in 0..3 {
            for part_y in 0..3 {
                let first = part_y * 3 + part_z * 9;
                let mut columns = [0, 1, 2].map(|x| slots[(first + x) % 27]);
                if columns == [NOTHING; 3] {
                    continue;
                }
                if orientation.is_up[0] {
                    columns.swap(0, 2);
                }
                let [Some(before), Some(own), Some(after)] =
                    columns.map(|slot| cells.get(slot as usize).map(|block| block.rows.as_chunks::<8>().0))
                else {
                    continue;
                };
                for (from, to) in places(part_z, orientation.is_up[2]) {
                    let (Some(before), Some(own), Some(after)) =
                        (before.get(from), own.get(from), after.get(from))
                    else {
                        continue;
                    };
                    // A window in which all rows of the slice lie, so that the compiler sees that they do.
                    let to = to % 16 * SLOW;
                    let Some(window) = self.rows.get_mut(to..to + 15 * FAST + 1) else { continue };
                    let mut put = |place: usize, y: usize| {
                        let y = if IS_UP { 7 - y } else { y };
                        window[place * FAST] = joined(before[y], own[y], after[y]);
                    };
                    match (part_y, IS_UP) {
                        (1, _) => (0..8).for_each(|y| put(MARGIN + y, y)),
                        (0, false) | (2, true) => (0..MARGIN).for_each(|y| put(y, 8 - MARGIN + y)),
                        (_, _) => (0..NEAR_MARGIN).for_each(|y| put(MARGIN + 8 + y, y)),
                    }
                }
            }
        }
    }

    /// Swaps the bits of lanes with the slices, for all rows of a slice at once.
    #[inline(always)]
    fn swap_x_and_z(&mut self) {
        let (slices, _) = self.rows.as_chunks_mut::<SLICE>();
        for (apart, mask) in [(8, 0x00ff), (4, 0x0f0f), (2, 0x3333), (1, 0x5555)] {
            let mask = mask * LANES;
            for z in (0..SLICE).filter(|z| z & apart == 0) {
                let (head, tail) = slices.split_at_mut(z + apart);
                let (Some(low), Some(high)) = (head.get_mut(z), tail.first_mut()) else { continue };
                for (low, high) in low.iter_mut().zip(high) {
                    (*low, *high) = exchange(*low, *high, mask, apart);
                }
            }
        }
    }
}

/// A row with those before and after it.
#[inline(always)]
const fn joined(before: Row, own: Row, after: Row) -> Row {
    const THREE: Row = 7 * LANES;
    before >> 5 & THREE | own << MARGIN | (after & THREE) << (MARGIN + 8)
}

/// Along an axis, for the neighbour on the lower side, the block itself, or the neighbour on the upper side:
/// the places in that block and where they come to lie in the neighbourhood.
#[inline]
fn places(part: usize, is_up: bool) -> impl Iterator<Item = (usize, usize)> + Clone {
    let block = 8;
    let (from, to, count) = match (part, is_up) {
        (1, _) => (0, MARGIN, block),
        // The far side: its last three places, seen from afar.
        (0, false) => (block - MARGIN, 0, MARGIN),
        (2, true) => (block - MARGIN, 0, MARGIN),
        (_, _) => (0, MARGIN + block, NEAR_MARGIN),
    };
    (0..count).map(move |n| {
        let place = from + n;
        (if is_up { block - 1 - place } else { place }, to + n)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn turned(orientation: Orientation, at: [i32; 3]) -> [i32; 3] {
        let mut at: [i32; 3] = core::array::from_fn(|a| if orientation.is_up[a] { 7 - at[a] } else { at[a] });
        at.swap(orientation.major, 2);
        at
    }

    proptest! {
        #[test]
        fn the_neighbourhood_is_the_turned_surroundings(
            major in 0usize..3,
            is_up in any::<[bool; 3]>(),
            seed in any::<u64>(),
        ) {
            // Every voxel of 27 blocks has a cell by a hash of its place.
            let cell = |x: i32, y: i32, z: i32| {
                let mix = (x as u64) << 40 ^ (y as u64 & 0xffff) << 20 ^ (z as u64 & 0xffff) ^ seed;
                mix.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 60 & 15
            };
            let mut cells = vec![BlockCells::UNKNOWN; 2];
            let mut slots = [0; 27];
            for (number, slot) in slots.iter_mut().enumerate() {
                let [bx, by, bz] = [number % 3, number / 3 % 3, number / 9].map(|b| 8 * (b as i32 - 1));
                *slot = cells.len() as u32;
                let rows = core::array::from_fn(|row| {
                    let at = |x| cell(bx + x, by + row as i32 % 8, bz + row as i32 / 8);
                    (0..32).map(|bit| (at(bit % 8) >> (bit / 8) & 1) << (bit % 8 + bit / 8 * 16)).sum()
                });
                let mut block = BlockCells { rows, is_mirrored: false };
                block.mirror(is_up[0]);
                cells.push(block);
            }
            let orientation = Orientation { major, is_up };
            let mut neighbourhood = Neighbourhood::default();
            neighbourhood.gather(orientation, &slots, &cells);
            for z in -3..11i32 {
                for y in -3..11i32 {
                    for x in -3..11i32 {
                        let [tx, ty, tz] = turned(orientation, [x, y, z]).map(|at| (at + 3) as usize);
                        if tx.max(ty).max(tz) >= 3 + 8 + NEAR_MARGIN {
                            continue;
                        }
                        let row = neighbourhood.row(tz * SLICE + ty * ROW) >> tx;
                        let found = (0..4).map(|lane| (row >> (16 * lane) & 1) << lane).sum::<u64>();
                        prop_assert_eq!(found, cell(x, y, z));
                    }
                }
            }
        }
    }
}
