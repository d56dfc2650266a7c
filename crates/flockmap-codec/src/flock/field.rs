//! What both sides know of the blocks round a package: the states before its batch, and what the package has
//! said so far.

use flockmap_grid::{BaseSuperseded, BlockIndex, StateBlock};

use super::block_box::{BlockBox, Places};
use super::cells::BlockCells;
use super::known::{Known, KnownClasses};
use super::neighbourhood::NOTHING;
use super::orientation::{Orientation, TurnedChanges};

/// The blocks that a package has looked at. 520 bytes for each that is known or has changes, and four for
/// each block in reach.
#[derive(Default)]
pub(crate) struct Field {
    places: Places,
    /// By place in the box of the package or round it: where the cells of a block are.
    slots: Vec<u32>,
    cells: Vec<BlockCells>,
    /// How much was known of each before.
    classes: Vec<KnownClasses>,
    /// The neighbours of a block that are looked up together.
    found: Vec<Option<StateBlock>>,
}

/// A block that was not looked at yet.
const NOT_ASKED: u32 = 0;
/// The block in the middle of its neighbours.
const OWN: usize = 13;
/// So many blocks are looked up at once.
pub(crate) const AHEAD: usize = 16;
/// The first slot of a block that was taken in.
const FIRST_SLOT: usize = 2;

/// The numbers of the bits that are set.
fn bits_of(bits: u32) -> impl Iterator<Item = usize> {
    let first = (bits != 0).then_some(bits);
    core::iter::successors(first, |bits| Some(bits & (bits - 1)).filter(|bits| *bits != 0))
        .map(|bits| bits.trailing_zeros() as usize)
}

/// The slots of a block and its neighbours by x + 3·y + 9·z, each −1 … 1 plus one.
pub(crate) type Around = [u32; 27];

impl Field {
    /// Forgets everything, for a package whose blocks lie in `region`.
    pub(crate) fn clear(&mut self, region: BlockBox) {
        self.places = Places::round(region);
        self.slots.clear();
        self.slots.resize(self.places.count, NOT_ASKED);
        if self.cells.len() < FIRST_SLOT {
            self.cells.resize(FIRST_SLOT, BlockCells::UNKNOWN);
        }
        self.classes.clear();
        self.classes.resize(FIRST_SLOT, KnownClasses::default());
    }

    pub(crate) fn cells(&self) -> &[BlockCells] {
        &self.cells
    }

    /// How many blocks have been taken in so far: those of which something was known, and those with
    /// changes.
    pub(crate) fn taken_in(&self) -> u64 {
        (self.classes.len() - FIRST_SLOT) as u64
    }

    /// How much was known of a block of the package before, without taking it in: most blocks that are asked
    /// for do not change.
    pub(crate) fn classes(
        &self,
        known: &Known<'_>,
        block: BlockIndex,
    ) -> Result<KnownClasses, BaseSuperseded> {
        match self.slots.get(self.places.of(block)) {
            Some(&slot) if slot != NOT_ASKED => Ok(self.classes_in(slot)),
            _ => Ok(known.block(block)?.map(|states| KnownClasses::of(&states)).unwrap_or_default()),
        }
    }

    /// The same of many blocks, in their order: all are looked up before any is looked at, so that the
    /// processor can wait for several at once.
    pub(crate) fn classes_of(
        &self,
        known: &Known<'_>,
        blocks: impl Iterator<Item = BlockIndex>,
        found: &mut Vec<(BlockIndex, KnownClasses)>,
    ) -> Result<(), BaseSuperseded> {
        let mut states = [None; AHEAD];
        found.clear();
        for (block, states) in blocks.zip(&mut states) {
            let slot = self.slots.get(self.places.of(block)).copied().unwrap_or(NOT_ASKED);
            found.push((block, self.classes_in(slot)));
            if slot == NOT_ASKED {
                *states = known.block(block)?;
            }
        }
        for ((_, classes), states) in found.iter_mut().zip(states) {
            if let Some(states) = states {
                *classes = KnownClasses::of(&states);
            }
        }
        Ok(())
    }

    fn classes_in(&self, slot: u32) -> KnownClasses {
        self.classes.get(slot as usize).copied().unwrap_or_default()
    }

    /// The slots of a block and its neighbours, all mirrored as the orientation says. Only of those that
    /// contexts look at: the neighbours beyond it along one to three axes, and those before it along one to
    /// three.
    pub(crate) fn around(
        &mut self,
        known: &Known<'_>,
        block: BlockIndex,
        orientation: Orientation,
    ) -> Result<Around, BaseSuperseded> {
        let mut slots = [NOTHING; 27];
        let own = self.places.of(block);
        let side = orientation.is_up.map(|is_up| if is_up { 1 } else { -1 });
        // Steps to the neighbours beyond along each axis: from place to place, and in `slots`.
        let of_place: [isize; 3] = core::array::from_fn(|a| side[a] * self.places.steps[a] as isize);
        let of_number: [isize; 3] = core::array::from_fn(|a| side[a] * [1, 3, 9][a]);
        let along = |steps: [isize; 3], axes: usize| {
            (steps[0] & -(axes as isize & 1))
                + (steps[1] & -(axes as isize >> 1 & 1))
                + (steps[2] & -(axes as isize >> 2))
        };
        // The neighbours that nobody has asked for yet: by axes those beyond, then those before.
        let mut asked = 0u32;
        for axes in 0..8 {
            let (place, number) = (along(of_place, axes), along(of_number, axes));
            let slot = |place: usize| self.slots.get(place).copied().unwrap_or(NOTHING);
            let (beyond, before) =
                (slot(own.wrapping_add_signed(place)), slot(own.wrapping_add_signed(-place)));
            slots[OWN.wrapping_add_signed(number) % 27] = beyond;
            slots[OWN.wrapping_add_signed(-number) % 27] = before;
            asked |= u32::from(beyond == NOT_ASKED) << axes | u32::from(before == NOT_ASKED) << (axes + 8);
        }
        for slot in slots {
            // Of the first two there are no cells.
            if let Some(cells) = self.cells.get_mut(slot as usize) {
                cells.mirror(orientation.is_up[0]);
            }
        }
        // The block itself is on neither side. All are looked up before any is taken in, so that the processor can
        // wait for several at once.
        asked &= !(1 << 8);
        self.found.clear();
        for n in bits_of(asked) {
            let sign = if n < 8 { 1 } else { -1 };
            let [x, y, z] = core::array::from_fn(|a| sign * side[a] as i32 * (n as i32 >> a & 1));
            self.found.push(known.block(BlockIndex::new(block.x + x, block.y + y, block.z + z))?);
        }
        for (at, n) in bits_of(asked).enumerate() {
            let sign = if n < 8 { 1 } else { -1 };
            let (place, number) = (sign * along(of_place, n & 7), sign * along(of_number, n & 7));
            let states = self.found.get(at).copied().flatten();
            slots[OWN.wrapping_add_signed(number) % 27] =
                self.admit(own.wrapping_add_signed(place), states.as_ref(), orientation);
        }
        Ok(slots)
    }

    /// Takes in what is known of a block that was asked for. Returns its slot.
    #[inline(never)]
    fn admit(&mut self, place: usize, known: Option<&StateBlock>, orientation: Orientation) -> u32 {
        let is_mirrored = orientation.is_up[0];
        // Where some of this batch has been merged already, a block that nothing else has changed has an entry
        // without a voxel.
        let known = known.map(|states| (states, KnownClasses::of(states)));
        let slot = match known.filter(|(_, classes)| classes.is_any()) {
            None => NOTHING,
            Some((states, classes)) => {
                let (slot, cells) = self.add(classes);
                cells.set(states, is_mirrored);
                slot
            }
        };
        if let Some(place) = self.slots.get_mut(place) {
            *place = slot;
        }
        slot
    }

    /// A new slot; the cells there may be those of an older package.
    fn add(&mut self, classes: KnownClasses) -> (u32, &mut BlockCells) {
        let slot = self.classes.len();
        self.classes.push(classes);
        if self.cells.len() == slot {
            self.cells.push(BlockCells::UNKNOWN);
        }
        (slot as u32, &mut self.cells[slot])
    }

    /// Takes in the changes of a block. Returns them as they are, not turned.
    pub(crate) fn note(
        &mut self,
        slots: &Around,
        block: BlockIndex,
        orientation: Orientation,
        coded: &TurnedChanges,
    ) -> StateBlock {
        let mut slot = slots[OWN];
        if slot == NOTHING {
            let cells;
            (slot, cells) = self.add(KnownClasses::default());
            *cells = BlockCells { is_mirrored: orientation.is_up[0], ..BlockCells::UNKNOWN };
            if let Some(own) = self.slots.get_mut(self.places.of(block)) {
                *own = slot;
            }
        }
        let (free, occupied) = (orientation.back_but_x(&coded.free), orientation.back_but_x(&coded.occupied));
        if let Some(cells) = self.cells.get_mut(slot as usize) {
            cells.change(&free, &occupied);
        }
        StateBlock::new(orientation.back_x(&free), orientation.back_x(&occupied))
    }
}
