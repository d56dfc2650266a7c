//! What is known of each voxel of a block, and what this package says of it.
//!
//! A cell is four bits: what a voxel is known to be, and whether this package changed it. A row is a word
//! with a lane of sixteen bits for each of the four, so that one operation looks at all cells of a row.

use flockmap_grid::{Plane, StateBlock};

use super::planes::mirrored_bytes;

/// Four lanes. The first two are a state: 0 unknown, 1 freed by this package, 2 Free before it, 3 Occupied.
/// The third: changed by this package. The last: Occupied.
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

/// The cells of a row in which some voxels changed, the first of which is so many from the lowest.
#[inline]
pub(crate) fn changed(row: Row, bits: Bits, first: usize) -> Row {
    let coded = (Row::from(bits.free | bits.occupied) * LANES) << first;
    row & !coded | ((Row::from(bits.free) * FREED) | (Row::from(bits.occupied) * LANES)) << first
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

    /// Reverses x if it does not run as asked for.
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
                slice[y] = changed(slice[y], Bits { free: free[y], occupied: occupied[y] }, 0);
            }
        }
    }
}
