//! The changes of one block as decisions.
//!
//! Rows of eight voxels go from the slice that is farthest from the sensor to the nearest, see
//! `neighbourhood.rs`. What is known already is settled eight voxels at a time; each unknown voxel beside a
//! change is a decision with two contexts: the cells around it, and the cells along the ray from the sensor
//! through it. Where nothing has changed beyond a slice, one decision is for its 64 voxels.

use fearless_simd::Simd;

use super::cells::{Bits, Row, STATES, free, new, occupied, unknown};
use super::decide::{Decide, RowKind, UnknownRow};
use super::flag_contexts::{self, MixedFlag, Slice};
use super::known::KnownClasses;
use super::neighbourhood::{Neighbourhood, ROW, SLICE, middle};
use super::orientation::{Distance, TurnedChanges};
use super::rays::Rays;
use super::voxel_contexts::RowContexts;

// Contexts of flags. The first 2,268 are for the flag of a block, see `flags.rs`.
const FREE_TO_OCCUPIED_IN_BLOCK: usize = 2_300;
const OCCUPIED_TO_FREE_IN_BLOCK: usize = 2_400;
const FREE_TO_OCCUPIED: usize = 2_500;
const OCCUPIED_TO_FREE: usize = 2_550;

const FREE_TO_OCCUPIED_IN_ROW: usize = 2_560;
const OCCUPIED_TO_FREE_IN_ROW: usize = 2_570;
const SURE_ROW: usize = 2_580;
const COLD_ROW: usize = 2_600;
const COLD_SLICE: usize = 2_640;

/// Makes the decisions of a block that has changes; `truth` is what a writer has to say, and `flips`
/// whether any Free voxel becomes Occupied by it and any Occupied one Free. Returns what was coded, and leaves
/// it in `cells`.
#[inline(always)]
pub(crate) fn code<S: Simd, D: Decide>(
    simd: S,
    decide: &mut D,
    cells: &mut Neighbourhood,
    distance: Distance,
    before: KnownClasses,
    truth: &TurnedChanges,
    flips: [bool; 2],
) -> TurnedChanges {
    let class = before.free * 8 + before.occupied;
    let to_occupied = before.free != 0 && decide.flag(FREE_TO_OCCUPIED_IN_BLOCK + class, flips[0]);
    let to_free = before.occupied != 0 && decide.flag(OCCUPIED_TO_FREE_IN_BLOCK + class, flips[1]);
    let mut block = Block {
        simd,
        decide,
        cells,
        coded: TurnedChanges::default(),
        rays: Rays::of(distance),
        is_surprised: false,
        is_expected: false,
    };
    for z in 0..8 {
        block.is_expected = false;
        if !to_occupied && !to_free && block.is_quiet(z, truth) {
            continue;
        }
        block.rays.enter(z);
        for y in 0..8 {
            let at = Neighbourhood::place(y, z);
            let truth = if D::KNOWS { truth.row(y, z) } else { Bits { free: 0, occupied: 0 } };
            let own = middle(block.cells.row(at));
            if to_occupied && free(own) != 0 {
                block.free_to_occupied(at, own, truth);
            }
            if to_free && occupied(own) != 0 {
                block.occupied_to_free(at, own, truth);
            }
            if unknown(own) != 0 {
                block.unknown(at, own, truth);
            }
        }
    }
    block.coded
}

struct Block<'a, S, D> {
    simd: S,
    decide: &'a mut D,
    cells: &'a mut Neighbourhood,
    coded: TurnedChanges,
    rays: Rays,
    /// A row changed although nothing beyond it had.
    is_surprised: bool,
    /// The slice has changes although nothing beyond it had, and none was found yet.
    is_expected: bool,
}

impl<S: Simd, D: Decide> Block<'_, S, D> {
    /// Whether a slice has no changes, if nothing beyond it has.
    #[inline(always)]
    fn is_quiet(&mut self, z: usize, truth: &TurnedChanges) -> bool {
        let at = Neighbourhood::place(0, z);
        let row = |at: usize| self.cells.row(at);
        let (mut own, mut over) = (0, row(at - SLICE - ROW));
        for y in 0..8 {
            own |= row(at + y * ROW);
            over |= row(at + y * ROW - SLICE);
        }
        let behind = own | over | row(at - ROW);
        if new(middle(behind | behind << 1)) != 0 {
            return false;
        }
        let mut under = row(at + 8 * ROW);
        let mut unknown_rows = 0;
        for y in 0..8 {
            unknown_rows += usize::from(unknown(middle(row(at + y * ROW))) != 0);
            under |= row(at + y * ROW + SLICE);
        }
        if unknown_rows == 0 {
            return true;
        }
        let before = under | own >> 1;
        let class = if middle(own | behind | behind << 1 | before) & STATES == 0 {
            0
        } else {
            1 + usize::from(occupied(middle(behind)) != 0)
                + 2 * usize::from(occupied(middle(under)) != 0)
                + 4 * usize::from(middle(before) & STATES != 0)
                + 8 * usize::from(self.is_surprised)
        };
        let class = class * 3 + usize::from(unknown_rows > 2) + usize::from(unknown_rows > 5);
        let changed = (0..z).filter(|z| (self.coded.free[*z] | self.coded.occupied[*z]) != 0).count();
        let slice =
            Slice { rows: [own, over, under], unknown_rows, z, changed, distance: self.rays.distance[2] };
        let has_changes = (truth.free[z] | truth.occupied[z]) != 0;
        let places = || slice.places(class);
        self.is_expected =
            self.decide.mixed_flag(MixedFlag::ColdSlice, COLD_SLICE + class, places, has_changes);
        !self.is_expected
    }

    /// Free voxels in which an obstacle appeared.
    #[inline(always)]
    fn free_to_occupied(&mut self, at: usize, own: Row, truth: Bits) {
        let voxels = free(own);
        let row = |at: usize| self.cells.row(at);
        let around = middle(row(at - SLICE) | row(at + SLICE) | row(at - ROW) | row(at + ROW)) | own;
        let class = usize::from(occupied(around) != 0)
            + 2 * usize::from(occupied(own) != 0)
            + 4 * usize::from(new(around) != 0);
        let cells = &*self.cells;
        let places = || flag_contexts::of_row(cells, at, voxels, class);
        let may = truth.occupied & voxels != 0;
        if !self.decide.mixed_flag(MixedFlag::FreeToOccupied, FREE_TO_OCCUPIED_IN_ROW + class, places, may) {
            return;
        }
        for bit in bits_of(voxels) {
            let shifted = |at: usize, by: isize| self.cells.shifted(at, by);
            let beyond = [shifted(at, -1), shifted(at - ROW, 0), shifted(at - SLICE, 0)];
            let within = [shifted(at, 1), shifted(at + ROW, 0), shifted(at + SLICE, 0)];
            let count =
                |rows: &[Row; 3], of: fn(Row) -> u8| rows.iter().filter(|row| of(**row) & bit != 0).count();
            let beside = count(&beyond, occupied) + count(&within, occupied);
            let context = FREE_TO_OCCUPIED + beside.min(3) * 4 + count(&beyond, new);
            if self.decide.flag(context, truth.occupied & bit != 0) {
                self.note(at, Bits { free: 0, occupied: bit });
            }
        }
    }

    /// Obstacles that are gone.
    fn occupied_to_free(&mut self, at: usize, own: Row, truth: Bits) {
        let voxels = occupied(own);
        if self.decide.flag(OCCUPIED_TO_FREE_IN_ROW, truth.free & voxels != 0) {
            for bit in bits_of(voxels) {
                if self.decide.flag(OCCUPIED_TO_FREE, truth.free & bit != 0) {
                    self.note(at, Bits { free: bit, occupied: 0 });
                }
            }
        }
    }

    /// Unknown voxels that were seen.
    #[inline(always)]
    fn unknown(&mut self, at: usize, own: Row, truth: Bits) {
        let voxels = unknown(own);
        let kind = match self.row_class(at, own, voxels) {
            RowClass::Cold(class) => {
                let cells = &*self.cells;
                let places = || flag_contexts::of_row(cells, at, voxels, class);
                let is_seen = (truth.free | truth.occupied) & voxels != 0;
                if !self.decide.mixed_flag(MixedFlag::ColdRow, COLD_ROW + class, places, is_seen) {
                    return;
                }
                self.is_surprised = true;
                self.is_expected = false;
                RowKind::Surprise
            }
            RowClass::Sure(class) => {
                if !self.decide.flag(SURE_ROW + class, truth.free & voxels != voxels) {
                    self.note(at, Bits { free: voxels, occupied: 0 });
                    return;
                }
                RowKind::Ordinary
            }
            RowClass::Hot => RowKind::Ordinary,
        };
        let contexts = RowContexts::of(self.simd, self.cells, at, &self.rays);
        let coded = self.decide.row(UnknownRow { voxels, kind, contexts }, truth);
        self.note(at, coded);
    }

    #[inline(always)]
    fn row_class(&self, at: usize, own: Row, voxels: u8) -> RowClass {
        let row = |at: usize| self.cells.row(at);
        let fresh = row(at);
        let [over, over_row, beside] = [row(at - SLICE), row(at - SLICE - ROW), row(at - ROW)];
        let beyond = over | over_row | beside;
        let behind = middle(beyond | beyond << 1 | fresh << 1);
        let hot = new(behind) & voxels;
        if hot == 0 {
            let under = row(at + SLICE) | row(at + ROW);
            let before = middle(under | fresh >> 1);
            let expected = 17 * usize::from(self.is_expected);
            if (own | behind | before) & STATES == 0 {
                return RowClass::Cold(expected);
            }
            return RowClass::Cold(
                1 + usize::from(occupied(own | middle(beyond)) != 0)
                    + 2 * usize::from(occupied(middle(under)) != 0)
                    + 4 * usize::from(before & STATES != 0)
                    + 8 * usize::from(self.is_surprised)
                    + expected,
            );
        }
        if hot == voxels {
            let is_free = |row: Row| row ^ row >> 16;
            let all_free = is_free(over) & is_free(over_row) & is_free(beside);
            if (middle(all_free & all_free << 1) as u8) & voxels == voxels {
                let all_new = over & over_row & beside;
                let is_new = new(middle(all_new & all_new << 1)) & voxels == voxels;
                return RowClass::Sure(usize::from(is_new) + 2 * usize::from(occupied(own) != 0));
            }
        }
        RowClass::Hot
    }

    #[inline(always)]
    fn note(&mut self, at: usize, bits: Bits) {
        self.cells.change(at, bits);
        let (z, shift) = ((at >> 4).wrapping_sub(3) & 7, 8 * ((at & 15).wrapping_sub(3) & 7));
        self.coded.free[z] |= u64::from(bits.free) << shift;
        self.coded.occupied[z] |= u64::from(bits.occupied) << shift;
    }
}

/// The bits that are set, one at a time.
fn bits_of(byte: u8) -> impl Iterator<Item = u8> {
    (0..8).map(|x| 1 << x).filter(move |bit| byte & bit != 0)
}

enum RowClass {
    /// Nothing beyond the row has changed.
    Cold(usize),
    /// All that is beyond it is Free, and some of it has just been seen.
    Sure(usize),
    Hot,
}
