//! The map is made anew a part at a time, or at once.

use std::collections::BTreeSet;

use super::Fusion;
use super::reach::merge;
use super::rebuild::Rebuild;
use super::settings::Settings;
use crate::{Mapper, SubmapId};

/// So many blocks of a layer are let go of in the time in which one block of the map is worked out.
const FREED_PER_BLOCK: usize = 16;

impl Fusion {
    /// Goes on making the map by what was set: works out `blocks_max` blocks at most (0 counts as 1), fewer where much
    /// is contested, and goes through as many blocks of layers. The map stays as it is, but for what is seen and
    /// received, until all that differs is worked out; then it is the new one. Layers that were forgotten are let go of
    /// a part at a time as well. Returns whether there is more to do.
    /// O(`blocks_max`), 10 to 40 µs for a block as a rule; O(cubes of 4³ blocks of the layers) when it begins, O(blocks
    /// that changed meanwhile) when it ends.
    pub fn work(&mut self, mapper: &Mapper, blocks_max: usize) -> bool {
        self.note_late(mapper, blocks_max.max(1));
        if self.next.is_none() && self.sources.unnoted().is_none() {
            self.begin(mapper);
        }
        if let Some(mut next) = self.next.take() {
            self.refreshed += next.work(&self.shown, &self.sources, mapper, blocks_max) as u64;
            if next.is_done() {
                next.finish(&mut self.shown);
                self.forget_left_out();
            } else {
                self.next = Some(next);
            }
        }
        self.sources.free(blocks_max.max(1).saturating_mul(FREED_PER_BLOCK));
        self.has_work()
    }

    /// Whether something was set or forgotten that is not in force yet: call [`Self::work`].
    pub fn is_rebuilding(&self) -> bool {
        self.is_changing() || self.is_moved()
    }

    /// Whether [`Self::work`] has anything to do: the map is made anew, or layers that were forgotten are let go of.
    pub fn has_work(&self) -> bool {
        self.is_changing() || self.is_moved() && !self.holds_moves || self.sources.is_any_discarded()
    }

    /// Whether something but a move of submaps is not in force yet.
    fn is_changing(&self) -> bool {
        let is_left = self.sources.is_any_leaving() || self.sources.unnoted().is_some();
        self.next.is_some() || !self.due.is_empty() || is_left
    }

    /// Whether submaps were moved, and the map is not being made by that yet.
    pub fn is_moved(&self) -> bool {
        !self.due_submaps.is_empty()
    }

    /// Whether [`Self::work`] is to leave submaps where they are for now: it has no clock to see how often they are moved.
    pub const fn hold_moves(&mut self, holds: bool) {
        self.holds_moves = holds;
    }

    /// Cubes of 4³ blocks of layers that are still to be gone through for the map that is being made; `None` if none is.
    pub fn cubes_left(&self) -> Option<usize> {
        self.next.as_ref().map(Rebuild::cubes_left)
    }

    /// Makes the fused map anew from the mapper and all layers, by what is set: what comes out as it was is no change.
    /// All at once, O(voxels).
    pub fn rebuild(&mut self, mapper: &Mapper) {
        self.next = None;
        self.due.clear();
        self.due_submaps.clear();
        self.note_late(mapper, usize::MAX);
        self.sources.leave_out();
        self.forget_left_out();
        self.sources.free(usize::MAX);
        self.shown.settings = self.wanted.clone();
        self.shown.outdated.clear();
        let (shown, own) = (&self.shown, self.sources.own);
        let mut reached: Vec<_> =
            shown.view.blocks().map(|(index, states)| (index, states.known())).collect();
        let of_mapper: Vec<_> = mapper.blocks().map(|(index, block)| (index, block.known())).collect();
        reached.extend_from_slice(&shown.reach_own(own, mapper, &of_mapper));
        for (stream, source) in self.sources.iter() {
            let known: Vec<_> = source.layer.blocks().map(|(index, block)| (index, block.known())).collect();
            reached.extend_from_slice(&shown.reach(stream, source, stream == own, &known));
        }
        let reached = merge(reached);
        self.refreshed += reached.len() as u64;
        self.shown.refresh(&self.sources, mapper, &reached);
        self.shown.view.forget_emptied();
    }

    /// Begins to make the map by what is set now, if that makes a difference.
    fn begin(&mut self, mapper: &Mapper) {
        let Self { shown, wanted, due, due_submaps, holds_moves, sources, .. } = self;
        let mut due = core::mem::take(due);
        due.retain(|id| !wanted.origin(*id).is_as(shown.settings.origin(*id)) || shown.outdated.contains(id));
        let mut submaps = Vec::new();
        // What begins is made by all that was set.
        let is_held = *holds_moves && due.is_empty() && !sources.is_any_leaving();
        let due_streams = if is_held { BTreeSet::new() } else { core::mem::take(due_submaps) };
        for stream in due_streams {
            let of_stream = |settings: &Settings, submap| settings.submap(stream, submap);
            let is_moved =
                |submap: &SubmapId| of_stream(wanted, *submap) != of_stream(&shown.settings, *submap);
            let mut add = |submap| submaps.push((stream, submap));
            if stream == sources.own {
                // The mapper writes in submaps of which the own layer may not have the record yet.
                let begun = core::iter::successors(Some(SubmapId::FIRST), |submap| submap.next());
                begun.take_while(|submap| *submap <= mapper.submap()).filter(is_moved).for_each(&mut add);
            } else if let Some(source) = sources.get(stream) {
                source.spans.submaps().filter(is_moved).for_each(&mut add);
            }
        }
        if !due.is_empty() || !submaps.is_empty() || sources.is_any_leaving() {
            self.next = Some(Rebuild::begin(shown, wanted.clone(), &due, &submaps, sources, mapper));
        }
    }

    /// What was left out is in no map any more.
    fn forget_left_out(&mut self) {
        for stream in self.sources.discard_left_out() {
            self.forget_plain(stream.origin);
            if self.sources.get(stream).is_none() {
                self.settings_mut().for_each(|settings| settings.forget_submaps(stream));
            }
        }
    }
}
