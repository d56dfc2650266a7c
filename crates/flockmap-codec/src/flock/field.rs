//! What both sides know of the blocks round a package: the states before its cycle, and what the package has told so far.

use flockmap_grid::{BlockIndex, Overtaken, StateBlock};

use super::block::{self, TurnedChanges};
use super::cells::{BlockCells, Turn};
use super::order::BlockBox;
use crate::reference::Known;

/// The blocks that a package has looked at. 520 bytes for each that is known or was told of, and four for each block in
/// reach.
#[derive(Default)]
pub(crate) struct Field {
    /// The box in reach, one block larger than that of the package on each side.
    min: [i32; 3],
    size: [usize; 3],
    /// By place in the box: where the cells of a block are.
    slots: Vec<u32>,
    cells: Vec<BlockCells>,
    /// How much was known of each before.
    counts: Vec<block::KnownClasses>,
}

/// A block that was not looked at yet.
const NOT_ASKED: u32 = 0;
/// The block in the middle of its neighbours.
pub(crate) const OWN: usize = 13;
/// The cells of blocks of which nothing is known.
pub(crate) const NOTHING: u32 = 1;
/// So many blocks are looked up at once.
pub(crate) const AHEAD: usize = 16;
/// The first slot of a block that was taken in.
const FIRST_SLOT: u32 = 2;

impl Field {
    /// Forgets everything, for a package whose blocks lie in `region`.
    pub(crate) fn clear(&mut self, region: BlockBox) {
        self.min = region.min.map(|min| min.saturating_sub(1));
        self.size = region.size().map(|side| side as usize + 2);
        self.slots.clear();
        self.slots.resize(self.size.iter().product(), NOT_ASKED);
        if self.cells.len() < FIRST_SLOT as usize {
            self.cells.resize(FIRST_SLOT as usize, BlockCells::UNKNOWN);
        }
        self.counts.clear();
        self.counts.resize(FIRST_SLOT as usize, block::KnownClasses::default());
    }

    pub(crate) fn cells(&self) -> &[BlockCells] {
        &self.cells
    }

    /// The place of the lowest neighbour of a block.
    fn place(&self, block: BlockIndex) -> usize {
        let at = [block.x, block.y, block.z];
        let [x, y, z]: [usize; 3] =
            core::array::from_fn(|a| at[a].wrapping_sub(1).wrapping_sub(self.min[a]) as u32 as usize);
        (z * self.size[1] + y) * self.size[0] + x
    }

    /// The place of a block itself.
    fn own_place(&self, block: BlockIndex) -> usize {
        self.place(block) + 1 + self.size[0] * (1 + self.size[1])
    }

    /// The slot of a block: [`NOTHING`] if nothing is known of it.
    pub(crate) fn ask(&mut self, known: &Known<'_>, block: BlockIndex, turn: Turn) -> Result<u32, Overtaken> {
        let place = self.own_place(block);
        match self.slots.get(place) {
            None => Ok(NOTHING),
            Some(&NOT_ASKED) => Ok(self.admit(place, known.block(block)?, turn)),
            Some(slot) => Ok(*slot),
        }
    }

    /// Takes in what is known of a block that was asked for, which has its own place in the box. Returns its slot.
    #[inline(never)]
    fn admit(&mut self, place: usize, known: Option<&StateBlock>, turn: Turn) -> u32 {
        let mut slot = NOTHING;
        // A block that only this cycle told of was there before it too, without a voxel, where some of the cycle has been merged already.
        let known = known.map(|states| (states, block::KnownClasses::of(states)));
        if let Some((states, classes)) = known.filter(|(_, classes)| classes.is_any()) {
            slot = self.counts.len() as u32;
            self.counts.push(classes);
            // Older packages leave theirs behind.
            if self.cells.len() < self.counts.len() {
                self.cells.push(BlockCells::UNKNOWN);
            }
            if let Some(cells) = self.cells.get_mut(slot as usize) {
                cells.set(states, turn.is_up[0]);
            }
        }
        if let Some(place) = self.slots.get_mut(place) {
            *place = slot;
        }
        slot
    }

    /// How much was known of a block of the package before, without taking it in: most blocks that are asked for do not change.
    pub(crate) fn classes(
        &self,
        known: &Known<'_>,
        block: BlockIndex,
    ) -> Result<block::KnownClasses, Overtaken> {
        match self.slots.get(self.own_place(block)) {
            Some(&slot) if slot != NOT_ASKED => Ok(self.counts(slot)),
            _ => Ok(known.block(block)?.map(block::KnownClasses::of).unwrap_or_default()),
        }
    }

    /// The same of many blocks, in their order: all are looked up before any is looked at, so that the processor can wait for several at
    /// once.
    pub(crate) fn classes_of(
        &self,
        known: &Known<'_>,
        blocks: impl Iterator<Item = BlockIndex>,
        found: &mut Vec<(BlockIndex, block::KnownClasses)>,
    ) -> Result<(), Overtaken> {
        let mut states = [None; AHEAD];
        found.clear();
        for (block, states) in blocks.zip(&mut states) {
            let slot = self.slots.get(self.own_place(block)).copied().unwrap_or(NOT_ASKED);
            found.push((block, self.counts(slot)));
            if slot == NOT_ASKED {
                *states = known.block(block)?;
            }
        }
        for ((_, classes), states) in found.iter_mut().zip(states) {
            if let Some(states) = states {
                *classes = block::KnownClasses::of(states);
            }
        }
        Ok(())
    }

    /// How many blocks have been taken in so far: those of which something was known, and those that were told of.
    pub(crate) fn taken_in(&self) -> u64 {
        self.counts.len() as u64 - u64::from(FIRST_SLOT)
    }

    /// How much was known of a block before.
    pub(crate) fn counts(&self, slot: u32) -> block::KnownClasses {
        self.counts.get(slot as usize).copied().unwrap_or_default()
    }

    /// The slots of a block, which is [`OWN`], and its neighbours by x + 3·y + 9·z, each −1 … 1 plus one; mirrored as a turn says. Only of those that
    /// contexts look at: the neighbours beyond it along one to three axes, and those before it along one to three.
    pub(crate) fn around(
        &mut self,
        known: &Known<'_>,
        block: BlockIndex,
        turn: Turn,
    ) -> Result<[u32; 27], Overtaken> {
        let mut slots = [NOTHING; 27];
        // All are looked up before any is taken in, so that the processor can wait for several at once.
        let mut found = [(0, 0, None); 16];
        let mut count = 0;
        let place = self.place(block);
        let [row, slice] = [self.size[0], self.size[0] * self.size[1]];
        let side = turn.is_up.map(|is_up| if is_up { 1 } else { -1 });
        for axes in 0..8 {
            // The block itself is on neither side.
            let sides = [side, side.map(|side| -side)];
            for side in sides.into_iter().take(if axes == 0 { 1 } else { 2 }) {
                let offset: [i32; 3] = core::array::from_fn(|a| side[a] * (axes >> a & 1));
                let [x, y, z] = offset.map(|offset| (offset + 1) as usize);
                let (number, place) = ((z * 9 + y * 3 + x) % 27, place + z * slice + y * row + x);
                let slot = self.slots.get(place).copied().unwrap_or(NOTHING);
                if slot == NOT_ASKED {
                    let [dx, dy, dz] = offset;
                    let neighbour = BlockIndex::new(block.x + dx, block.y + dy, block.z + dz);
                    found[count % 16] = (number, place, known.block(neighbour)?);
                    count += 1;
                } else if slot != NOTHING
                    && let Some(cells) = self.cells.get_mut(slot as usize)
                {
                    cells.mirror(turn.is_up[0]);
                }
                slots[number] = slot;
            }
        }
        for (number, place, states) in found.into_iter().take(count) {
            slots[number % 27] = self.admit(place, states, turn);
        }
        Ok(slots)
    }

    /// Takes in what was told of a block in a slot. Returns it as it is, not turned.
    pub(crate) fn tell(
        &mut self,
        slot: u32,
        block: BlockIndex,
        turn: Turn,
        told: &TurnedChanges,
    ) -> StateBlock {
        let mut slot = slot;
        if slot == NOTHING {
            let place = self.own_place(block);
            slot = self.counts.len() as u32;
            if let Some(own) = self.slots.get_mut(place) {
                *own = slot;
            }
            self.counts.push(block::KnownClasses::default());
            let unknown = BlockCells { is_mirrored: turn.is_up[0], ..BlockCells::UNKNOWN };
            match self.cells.get_mut(slot as usize) {
                Some(cells) => *cells = unknown,
                None => self.cells.push(unknown),
            }
        }
        let (free, occupied) = (turn.back_but_x(&told.free), turn.back_but_x(&told.occupied));
        if let Some(cells) = self.cells.get_mut(slot as usize) {
            cells.change(&free, &occupied);
        }
        StateBlock::new(turn.back_x(&free), turn.back_x(&occupied))
    }
}
