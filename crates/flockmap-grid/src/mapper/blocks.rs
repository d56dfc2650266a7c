//! The blocks of a map, by their indices.

use super::block::MapBlock;
use crate::BlockIndex;
use rustc_hash::FxHashMap;

/// Blocks in a list, and the place there of each. Several can be changed at a time.
#[derive(Default)]
pub(super) struct Blocks {
    places: FxHashMap<BlockIndex, u32>,
    list: Vec<(BlockIndex, Box<MapBlock>)>,
}

impl Blocks {
    pub(super) fn len(&self) -> usize {
        self.list.len()
    }

    /// Room in the table and in the list.
    pub(super) fn capacity(&self) -> [usize; 2] {
        [self.places.capacity(), self.list.capacity()]
    }

    pub(super) fn contains(&self, index: BlockIndex) -> bool {
        self.places.contains_key(&index)
    }

    pub(super) fn get(&self, index: BlockIndex) -> Option<&MapBlock> {
        Some(&self.list[*self.places.get(&index)? as usize].1)
    }

    pub(super) fn get_mut(&mut self, index: BlockIndex) -> Option<&mut MapBlock> {
        Some(&mut self.list[*self.places.get(&index)? as usize].1)
    }

    /// The block and its place, made if it is not there.
    pub(super) fn entry(
        &mut self,
        index: BlockIndex,
        new: impl FnOnce() -> MapBlock,
    ) -> (&mut MapBlock, u32) {
        let next = self.list.len() as u32;
        let place = *self.places.entry(index).or_insert(next);
        if place == next {
            let capacity = self.list.capacity();
            if self.list.len() == capacity {
                self.list.reserve_exact((capacity / 4).max(4));
            }
            self.list.push((index, Box::new(new())));
        }
        (&mut self.list[place as usize].1, place)
    }

    /// The blocks at these places, ascending.
    pub(super) fn at(&mut self, places: impl Iterator<Item = u32>) -> impl Iterator<Item = &mut MapBlock> {
        let (mut rest, mut first) = (self.list.as_mut_slice(), 0);
        places.map_while(move |place| {
            let (block, after) =
                core::mem::take(&mut rest).get_mut((place - first) as usize..)?.split_first_mut()?;
            (rest, first) = (after, place + 1);
            Some(&mut *block.1)
        })
    }

    pub(super) fn remove(&mut self, index: BlockIndex) -> Option<Box<MapBlock>> {
        let place = self.places.remove(&index)?;
        let (_, block) = self.list.swap_remove(place as usize);
        if let Some((moved, _)) = self.list.get(place as usize) {
            self.places.insert(*moved, place);
        }
        Some(block)
    }

    /// In no order.
    pub(super) fn iter(&self) -> impl Iterator<Item = (BlockIndex, &MapBlock)> {
        self.list.iter().map(|(index, block)| (*index, &**block))
    }

    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut MapBlock> {
        self.list.iter_mut().map(|(_, block)| &mut **block)
    }
}
