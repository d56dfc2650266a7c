//! The cells of a block and of its neighbours, turned so that coding always goes the same way.
//!
//! A cell is four bits: what a voxel is known to be, and whether this package changed it. A row is a word with a lane of sixteen
//! bits for each of the four, so that one operation looks at all cells of a row. The rows of a block and of three voxels around
//! it are laid out so that its farthest slice from the sensor comes first, along the axis on which the sensor is farthest away,
//! and in each slice the farthest row and voxel. So the voxel behind another always has the lower number, and one piece of code
//! serves all directions.

use flockmap_grid::StateBlock;

use super::field::NOTHING;

/// Four lanes. The first two are a state: 0 unknown, 1 freed by this package, 2 Free before it, 3 Occupied. The third: changed by this
/// package. The last: Occupied.
pub(crate) type Row = u64;

/// The lowest bit of each lane.
pub(crate) const LANES: Row = 0x0001_0001_0001_0001;
/// The lowest bits of the lanes that differ in a voxel freed by this package: 1 and changed.
const FREED: Row = 0x0000_0001_0000_0001;
/// The eight lowest bits of the lanes of the state.
pub(crate) const STATES: Row = 0x00ff_00ff;

/// The voxels of a row that became Free and Occupied.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Bits {
    pub(crate) free: u8,
    pub(crate) occupied: u8,
}

/// The cells of a row in which some voxels changed.
#[inline]
fn changed(row: Row, bits: Bits) -> Row {
    row & !(Row::from(bits.free | bits.occupied) * LANES)
        | (Row::from(bits.free) * FREED)
        | (Row::from(bits.occupied) * LANES)
}

/// The cells of the middle of a row, as in [`BlockCells`].
#[inline]
pub(crate) fn middle(row: Row) -> Row {
    row >> MARGIN & (0xff * LANES)
}

/// The unknown voxels of the eight lowest.
#[inline]
pub(crate) fn unknown(row: Row) -> u8 {
    !(row | row >> 16) as u8
}

/// The changed voxels of the eight lowest.
#[inline]
pub(crate) fn new(row: Row) -> u8 {
    (row >> 32) as u8
}

/// The Occupied voxels of the eight lowest.
#[inline]
pub(crate) fn occupied(row: Row) -> u8 {
    (row >> 48) as u8
}

/// The Free voxels of the eight lowest.
#[inline]
pub(crate) fn free(row: Row) -> u8 {
    (row ^ row >> 16) as u8
}

/// Voxels of eight slices: bits along x, bytes along y.
pub(crate) type Plane = [u64; 8];

/// The cells of a block, not turned: a row along x by y and z.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BlockCells {
    pub(crate) rows: [Row; 64],
    /// Whether x runs downwards.
    pub(crate) is_mirrored: bool,
}

impl BlockCells {
    /// Nothing known.
    pub(crate) const UNKNOWN: Self = Self { rows: [0; 64], is_mirrored: false };

    /// Sets what is known of a block.
    pub(crate) fn set(&mut self, states: &StateBlock, is_mirrored: bool) {
        self.is_mirrored = is_mirrored;
        let mirrored = |slice: u64| if is_mirrored { mirrored_bytes(slice) } else { slice };
        let (slices, _) = self.rows.as_chunks_mut::<8>();
        for ((slice, free), occupied) in slices.iter_mut().zip(states.free()).zip(states.occupied()) {
            let (free, occupied) = (mirrored(*free).to_le_bytes(), mirrored(*occupied).to_le_bytes());
            for y in 0..8 {
                let occupied = Row::from(occupied[y]);
                slice[y] = occupied | (occupied | Row::from(free[y])) << 16 | occupied << 48;
            }
        }
    }

    /// Makes x run the other way if it does not run as asked for.
    #[inline]
    pub(crate) fn mirror(&mut self, is_mirrored: bool) {
        if self.is_mirrored != is_mirrored {
            self.is_mirrored = is_mirrored;
            self.rows.iter_mut().for_each(|row| *row = mirrored_bytes(*row));
        }
    }

    /// Takes in changes, mirrored as the block is.
    pub(crate) fn change(&mut self, free: &Plane, occupied: &Plane) {
        let (slices, _) = self.rows.as_chunks_mut::<8>();
        for ((slice, free), occupied) in slices.iter_mut().zip(free).zip(occupied) {
            if free | occupied == 0 {
                continue;
            }
            let (free, occupied) = (free.to_le_bytes(), occupied.to_le_bytes());
            for y in 0..8 {
                slice[y] = changed(slice[y], Bits { free: free[y], occupied: occupied[y] });
            }
        }
    }
}

/// Reverses the bits of each byte.
#[inline]
const fn mirrored_bytes(word: u64) -> u64 {
    const NIBBLES: u64 = 0x0f0f_0f0f_0f0f_0f0f;
    const PAIRS: u64 = 0x3333_3333_3333_3333;
    const SINGLES: u64 = 0x5555_5555_5555_5555;
    let word = (word >> 4 & NIBBLES) | (word & NIBBLES) << 4;
    let word = (word >> 2 & PAIRS) | (word & PAIRS) << 2;
    (word >> 1 & SINGLES) | (word & SINGLES) << 1
}

/// Rows of the neighbourhood from one row to the next.
pub(crate) const ROW: usize = 1;
/// Rows of the neighbourhood from one slice to the next.
pub(crate) const SLICE: usize = 16;
/// Cells around the block that are filled, on every side.
const MARGIN: usize = 3;
/// Those that are needed on the side of the sensor.
const NEAR_MARGIN: usize = 2;

/// How a block is turned: which axis becomes the slices, and which axes are mirrored.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Turn {
    /// The axis that is swapped with z: the one along which the sensor is farthest away.
    pub(crate) major: usize,
    /// By axis: the sensor lies below the block, so that far is up.
    pub(crate) is_up: [bool; 3],
}

impl Turn {
    /// Turns a plane.
    pub(crate) fn turned(self, plane: &Plane) -> Plane {
        self.swapped(&self.mirrored(plane, self.is_up))
    }

    /// The inverse of [`Self::turned`], except that x runs downwards still if it was mirrored.
    pub(crate) fn back_but_x(self, plane: &Plane) -> Plane {
        self.mirrored(&self.swapped(plane), [false, self.is_up[1], self.is_up[2]])
    }

    /// Runs x the right way again.
    pub(crate) fn back_x(self, plane: &Plane) -> Plane {
        self.mirrored(plane, [self.is_up[0], false, false])
    }

    fn mirrored(self, plane: &Plane, [x, y, z]: [bool; 3]) -> Plane {
        let mut plane = *plane;
        if x {
            plane = plane.map(mirrored_bytes);
        }
        if y {
            plane = plane.map(u64::swap_bytes);
        }
        if z {
            plane.reverse();
        }
        plane
    }

    fn swapped(self, plane: &Plane) -> Plane {
        match self.major {
            0 => swapped_x_and_z(*plane),
            1 => transpose(*plane),
            _ => *plane,
        }
    }
}

/// A block in the middle of its surroundings, turned. Cells out of reach are unknown.
pub(crate) struct Neighbourhood {
    rows: [Row; 256],
}

impl Neighbourhood {
    pub(crate) fn new() -> Self {
        Self { rows: [0; 256] }
    }

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
        let told = (Row::from(bits.free | bits.occupied) * LANES) << MARGIN;
        *row = *row & !told | ((Row::from(bits.free) * FREED) | (Row::from(bits.occupied) * LANES)) << MARGIN;
    }

    /// Takes in a block and its 26 neighbours, which `slots` gives by x + 3·y + 9·z, each −1 … 1 plus one; they are mirrored as
    /// the turn says.
    pub(crate) fn gather(&mut self, turn: Turn, slots: &[u32; 27], cells: &[BlockCells]) {
        // Rows go straight to where they belong, unless x itself is the slow axis: then slices are turned afterwards.
        match (turn.major == 1, turn.is_up[1]) {
            (false, false) => self.gather_rows::<SLICE, ROW, false>(turn, slots, cells),
            (false, true) => self.gather_rows::<SLICE, ROW, true>(turn, slots, cells),
            (true, false) => self.gather_rows::<ROW, SLICE, false>(turn, slots, cells),
            (true, true) => self.gather_rows::<ROW, SLICE, true>(turn, slots, cells),
        }
        if turn.major == 0 {
            self.swap_x_and_z();
        }
    }

    /// `FAST` from row to row and `SLOW` from slice to slice, as blocks are stored; rows from the highest to the lowest if `IS_UP`.
    fn gather_rows<const SLOW: usize, const FAST: usize, const IS_UP: bool>(
        &mut self,
        turn: Turn,
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
                if turn.is_up[0] {
                    columns.swap(0, 2);
                }
                let [Some(before), Some(own), Some(after)] =
                    columns.map(|slot| cells.get(slot as usize).map(|block| block.rows.as_chunks::<8>().0))
                else {
                    continue;
                };
                for (from, to) in places(part_z, turn.is_up[2]) {
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
    fn swap_x_and_z(&mut self) {
        let (slices, _) = self.rows.as_chunks_mut::<SLICE>();
        for (apart, mask) in [(8, 0x00ff), (4, 0x0f0f), (2, 0x3333), (1, 0x5555)] {
            let mask = mask * LANES;
            for z in (0..SLICE).filter(|z| z & apart == 0) {
                let (head, tail) = slices.split_at_mut(z + apart);
                let (Some(low), Some(high)) = (head.get_mut(z), tail.first_mut()) else { continue };
                for (low, high) in low.iter_mut().zip(high) {
                    let differ = (*low >> apart ^ *high) & mask;
                    *low ^= differ << apart;
                    *high ^= differ;
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

/// Along an axis, for the neighbour on the lower side, the block itself, or the neighbour on the upper side: the places in that block and
/// where they come to lie in the neighbourhood.
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

/// Swaps the words of a plane with parts of each word: bytes if a part has 8 bits, bits of bytes if it has 1.
#[inline]
fn swapped<const PART: u32>(plane: Plane, fours: u64, pairs: u64, singles: u64) -> Plane {
    /// Exchanges the upper parts of `a` with the lower parts of `b`.
    #[inline]
    const fn exchange(a: u64, b: u64, mask: u64, shift: u32) -> (u64, u64) {
        let differ = (a >> shift ^ b) & mask;
        (a ^ differ << shift, b ^ differ)
    }
    let [a, b, c, d, e, f, g, h] = plane;
    let (a, e) = exchange(a, e, fours, 4 * PART);
    let (b, f) = exchange(b, f, fours, 4 * PART);
    let (c, g) = exchange(c, g, fours, 4 * PART);
    let (d, h) = exchange(d, h, fours, 4 * PART);
    let (a, c) = exchange(a, c, pairs, 2 * PART);
    let (b, d) = exchange(b, d, pairs, 2 * PART);
    let (e, g) = exchange(e, g, pairs, 2 * PART);
    let (f, h) = exchange(f, h, pairs, 2 * PART);
    let (a, b) = exchange(a, b, singles, PART);
    let (c, d) = exchange(c, d, singles, PART);
    let (e, f) = exchange(e, f, singles, PART);
    let (g, h) = exchange(g, h, singles, PART);
    [a, b, c, d, e, f, g, h]
}

/// Swaps slices and rows.
#[inline]
fn transpose(plane: Plane) -> Plane {
    swapped::<8>(plane, 0x0000_0000_ffff_ffff, 0x0000_ffff_0000_ffff, 0x00ff_00ff_00ff_00ff)
}

/// Swaps slices and the voxels of rows.
#[inline]
fn swapped_x_and_z(plane: Plane) -> Plane {
    swapped::<1>(plane, 0x0f0f_0f0f_0f0f_0f0f, 0x3333_3333_3333_3333, 0x5555_5555_5555_5555)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn turned(turn: Turn, at: [i32; 3]) -> [i32; 3] {
        let mut at: [i32; 3] = core::array::from_fn(|a| if turn.is_up[a] { 7 - at[a] } else { at[a] });
        at.swap(turn.major, 2);
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
            let turn = Turn { major, is_up };
            let mut neighbourhood = Neighbourhood::new();
            neighbourhood.gather(turn, &slots, &cells);
            for z in -3..11i32 {
                for y in -3..11i32 {
                    for x in -3..11i32 {
                        let [tx, ty, tz] = turned(turn, [x, y, z]).map(|at| (at + 3) as usize);
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

        #[test]
        fn a_plane_is_turned_and_back(major in 0usize..3, is_up in any::<[bool; 3]>(), plane in any::<Plane>()) {
            let turn = Turn { major, is_up };
            let there = turn.turned(&plane);
            for (x, y, z) in (0..512).map(|bit| (bit & 7, bit >> 3 & 7, bit >> 6)) {
                let [tx, ty, tz] = turned(turn, [x, y, z]);
                let bit = |plane: &Plane, x: i32, y: i32, z: i32| plane[z as usize] >> (x + 8 * y) & 1;
                prop_assert_eq!(bit(&there, tx, ty, tz), bit(&plane, x, y, z));
            }
            prop_assert_eq!(turn.back_x(&turn.back_but_x(&there)), plane);
        }
    }
}
