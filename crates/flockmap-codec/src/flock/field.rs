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
}

/// A block that was not looked at yet.
const NOT_ASKED: u32 = 0;
/// The block in the middle of its neighbours.
const OWN: usize = 13;
/// So many blocks are looked up at once.
pub(crate) const AHEAD: usize = 16;
/// The first slot of a block that was taken in.
const FIRST_SLOT: usize = 2;

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
        // All are looked up before any is taken in, so that the processor can wait for several at once.
        let mut found = [(0, 0, None); 16];
        let mut count = 0;
        let [column, row, slice] = self.places.steps;
        let lowest = self.places.of(block) - (column + row + slice);
        let side = orientation.is_up.map(|is_up| if is_up { 1 } else { -1 });
        for axes in 0..8 {
            // The block itself is on neither side.
            let sides = [side, side.map(|side| -side)];
            for side in sides.into_iter().take(if axes == 0 { 1 } else { 2 }) {
                let offset: [i32; 3] = core::array::from_fn(|a| side[a] * (axes >> a & 1));
                let [x, y, z] = offset.map(|offset| (offset + 1) as usize);
                let (number, place) = ((z * 9 + y * 3 + x) % 27, lowest + z * slice + y * row + x * column);
                let slot = self.slots.get(place).copied().unwrap_or(NOTHING);
                if slot == NOT_ASKED {
                    let [dx, dy, dz] = offset;
                    let neighbour = BlockIndex::new(block.x + dx, block.y + dy, block.z + dz);
                    found[count % 16] = (number, place, known.block(neighbour)?);
                    count += 1;
                } else if slot != NOTHING
                    && let Some(cells) = self.cells.get_mut(slot as usize)
                {
                    cells.mirror(orientation.is_up[0]);
                }
                slots[number] = slot;
            }
        }
        for (number, place, states) in found.into_iter().take(count) {
            slots[number % 27] = self.admit(place, states.as_ref(), orientation);
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
