//! A block of a layer: states, a stamp for each voxel, and what was before the newest batch.

use super::stamps::BlockStamps;
use crate::block::{meet, set_bits};
use crate::{Plane, Stamp, State, StateBlock};

/// A block as it is read and written.
#[derive(Clone, PartialEq, Debug)]
pub(super) struct LayerBlock {
    pub(super) states: StateBlock,
    pub(super) stamps: BlockStamps,
    /// The states before the newest stamp, if that is known.
    pub(super) before: Option<StateBlock>,
}

impl LayerBlock {
    /// Nothing is known yet; `stamp` is that of what comes.
    pub(super) fn new(stamp: Stamp) -> Self {
        Self {
            states: StateBlock::default(),
            stamps: BlockStamps::new(stamp),
            before: Some(StateBlock::default()),
        }
    }

    /// Takes over what is newer than what is known; `is_batch`: what was there before remains known. Returns the
    /// voxels that it took over.
    pub(super) fn take_over(&mut self, new: &StateBlock, stamp: Stamp, is_batch: bool) -> Plane {
        self.keep_before(new, stamp, is_batch);
        let mut mask = new.known();
        if self.stamps.newest() >= stamp
            && !flockmap_mutation::is(flockmap_mutation::Mutation::StampCompareDropped)
        {
            self.keep_newer(&mut mask, new, stamp);
        }
        if mask != [0; 8] {
            self.states.overlay(&new.masked(&mask));
            self.stamps.set(&mask, stamp, &self.states.known());
        }
        mask
    }

    /// The states before the batch with this stamp and the newest stamp in the block; `Err` with the latter where
    /// they are not known any more.
    #[inline]
    pub(super) fn known_before(&self, stamp: Stamp) -> Result<(StateBlock, Stamp), Stamp> {
        let newest = self.stamps.newest();
        if newest < stamp {
            return Ok((self.states, newest));
        }
        let before = self.before.filter(|_| newest == stamp);
        before.map(|before| (before, newest)).ok_or(newest)
    }

    /// State of a voxel and when it was set. `None` if it is Unknown.
    pub(super) fn get(&self, bit: usize) -> Option<(State, Stamp)> {
        match self.states.get(bit) {
            State::Unknown => None,
            state => Some((state, self.stamps.get(bit))),
        }
    }

    /// Keeps what is known before something with this stamp is taken over.
    fn keep_before(&mut self, new: &StateBlock, stamp: Stamp, is_batch: bool) {
        match stamp.cmp(&self.stamps.newest()) {
            core::cmp::Ordering::Greater if is_batch => self.before = Some(self.states),
            // More of the same batch.
            core::cmp::Ordering::Equal if is_batch => {}
            // An older state that comes late is a part of what was before, unless another one stands there:
            // which of them is newer is not known.
            core::cmp::Ordering::Less => {
                let is_certain = |before: &StateBlock| {
                    !meet(before.free(), new.occupied()) && !meet(before.occupied(), new.free())
                };
                self.before = self.before.filter(is_certain).map(|mut before| {
                    before.overlay(new);
                    before
                });
            }
            // A snapshot names no voxel twice: something is missing before it.
            _ => self.before = None,
        }
    }

    /// Takes the voxels out of `mask` whose known state stands against a new one of this stamp.
    fn keep_newer(&self, mask: &mut Plane, new: &StateBlock, stamp: Stamp) {
        let known = self.states.known();
        let rivals: Plane = core::array::from_fn(|z| mask[z] & known[z]);
        set_bits(&rivals).for_each(|bit| {
            let stays = match self.stamps.get(bit).cmp(&stamp) {
                core::cmp::Ordering::Less => false,
                core::cmp::Ordering::Greater => true,
                core::cmp::Ordering::Equal => {
                    !(new.get(bit) == State::Occupied && self.states.get(bit) == State::Free)
                }
            };
            if stays {
                mask[bit / 64] &= !(1 << (bit % 64));
            }
        });
    }
}
