//! A map that is made by other settings, a part at a time, while the one that is shown stands.

use std::collections::BTreeSet;

use rustc_hash::FxHashMap;

use super::fused::{Fused, whole};
use super::region::region_of;
use super::settings::Settings;
use super::sources::Sources;
use crate::submap::BlockBox;
use crate::{BlockIndex, Mapper, Plane, RobotId, Stream, SubmapId, Voxel, voxel_bit};

/// What is worked out so far, and what is left.
///
/// It begins as a copy of the map that is shown, in O(1). Of the layers whose settings differ, or which leave, all
/// blocks that they reach by the settings of the one map or of the other are worked out, each once. What is seen or
/// received meanwhile is taken into both maps, so of a layer only what was there at the beginning is gone through.
pub(super) struct Rebuild {
    pub fused: Fused,
    /// Version of the map that is shown when this began.
    began: u64,
    /// What of the layers is left: the number of a source, one of its cubes. The last first.
    cubes: Vec<(u64, BlockIndex)>,
    /// Blocks of the own map that are left.
    own: Vec<BlockIndex>,
    /// Blocks that are reached and not worked out yet.
    targets: Vec<(BlockIndex, Plane)>,
    /// By region, the blocks that were reached.
    reached: FxHashMap<BlockIndex, Plane>,
}

impl Rebuild {
    /// `due`: the origins of which layers are gone through; `moved`: of which only these submaps are, ascending. O(cubes of
    /// their layers), and O(blocks of the own map) where that is one of them.
    pub(super) fn begin(
        shown: &Fused,
        settings: Settings,
        due: &BTreeSet<RobotId>,
        moved: &[(Stream, SubmapId)],
        sources: &mut Sources,
        mapper: &Mapper,
    ) -> Self {
        let (mut cubes, mut own) = (Vec::new(), Vec::new());
        for of_stream in moved.chunk_by(|(a, _), (b, _)| a == b) {
            let (stream, is_own) = (of_stream[0].0, of_stream[0].0 == sources.own);
            let is_moved = |submap| of_stream.binary_search(&(stream, submap)).is_ok();
            if is_own {
                let is_there =
                    |at: &BlockIndex| mapper.place_of(*at).is_some_and(|(submap, _)| is_moved(submap));
                own = mapper.indices().filter(is_there).collect();
                own.sort_by_cached_key(|at| parent_of(*at));
            }
            if let Some(source) = sources.get(stream).filter(|_| is_own || !due.contains(&stream.origin)) {
                let parts = source.spans.parts().filter(|(submap, ..)| is_moved(*submap));
                let boxes: Vec<_> = parts.map(|(.., blocks)| blocks).collect();
                let is_there = |at: &BlockIndex| {
                    source.spans.is_empty()
                        || boxes.iter().any(|blocks| blocks.meets(&BlockBox::of_cube(*at)))
                };
                let found = source.layer.cube_indices().filter(is_there);
                cubes.extend(found.map(|at| (source.number(), at)));
            }
        }
        for (stream, source, is_leaving) in sources.of_others(false) {
            let id = stream.origin;
            let is_silent = shown.settings.origin(id).is_muted && settings.origin(id).is_muted;
            if (is_leaving || due.contains(&id)) && !is_silent {
                cubes.extend(source.layer.cube_indices().map(|at| (source.number(), at)));
            }
        }
        // Neighbours follow one another: so what they have in common is unpacked once, as a rule.
        cubes.sort_unstable_by_key(|(number, at)| (*number, parent_of(*at), *at));
        sources.leave_out();
        let outdated = shown.outdated.difference(due).copied().collect();
        Self {
            fused: Fused { settings, view: shown.view.staged(), outdated, is_next: true },
            began: shown.view.version(),
            cubes,
            own,
            targets: Vec::new(),
            reached: FxHashMap::default(),
        }
    }

    /// Works out `blocks_max` blocks at most (0 counts as 1), and fewer where much is contested or packed; goes through as
    /// many blocks of layers, and what of a cube goes beyond that. Returns how many blocks it has worked out.
    pub(super) fn work(
        &mut self,
        shown: &Fused,
        sources: &Sources,
        mapper: &Mapper,
        blocks_max: usize,
    ) -> usize {
        let (mut left, mut worked_out) = (blocks_max.max(1), 0);
        while left > 0 {
            let unpacked = sources.unpacked();
            if let Some((number, at)) = self.cubes.pop_if(|_| self.targets.is_empty()) {
                left = left.saturating_sub(self.find(shown, sources, number, at));
            }
            if let Some(at) = self.own.pop_if(|_| self.targets.is_empty()) {
                left = left.saturating_sub(self.find_own(shown, sources, mapper, at));
            }
            let now = self.targets.split_off(self.targets.len().saturating_sub(left.min(AT_ONCE)));
            if now.is_empty() && self.cubes.is_empty() && self.own.is_empty() {
                break;
            }
            let looked = self.fused.refresh(sources, mapper, &now);
            worked_out += now.len();
            let unpacked = sources.unpacked().wrapping_sub(unpacked) * BLOCKS_PER_CUBE;
            left = left.saturating_sub(now.len() + looked / LOOKS_PER_BLOCK + unpacked);
        }
        worked_out
    }

    /// Whether all is worked out.
    pub(super) const fn is_done(&self) -> bool {
        self.cubes.is_empty() && self.own.is_empty() && self.targets.is_empty()
    }

    /// Cubes of layers that are left.
    pub(super) const fn cubes_left(&self) -> usize {
        self.cubes.len()
    }

    /// Notes what a cube of a layer reaches and was not reached before. Returns how many blocks the cube has.
    fn find(&mut self, shown: &Fused, sources: &Sources, number: u64, at: BlockIndex) -> usize {
        let Some((stream, source)) = sources.numbered(number) else { return 1 };
        let known = source.layer.known_in_cube(at);
        for fused in [shown, &self.fused] {
            let reached = fused.reach(stream, source, stream == sources.own, &known);
            note(&mut self.reached, &mut self.targets, &reached);
        }
        known.len().max(1)
    }

    /// The same of a block of the own map.
    fn find_own(&mut self, shown: &Fused, sources: &Sources, mapper: &Mapper, at: BlockIndex) -> usize {
        let known = [(at, mapper.block(at).map_or([0; 8], |block| block.known()))];
        for fused in [shown, &self.fused] {
            let reached = fused.reach_own(sources.own, mapper, &known);
            note(&mut self.reached, &mut self.targets, &reached);
        }
        1
    }

    /// All is worked out: the map is shown from now on in place of another.
    pub(super) fn finish(self, shown: &mut Fused) {
        let Self { mut fused, began, .. } = self;
        fused.view.supersede(&shown.view, began);
        fused.view.forget_emptied();
        *shown = Fused { is_next: false, ..fused };
    }
}

/// Notes which blocks are reached that were not before.
fn note(
    all: &mut FxHashMap<BlockIndex, Plane>,
    targets: &mut Vec<(BlockIndex, Plane)>,
    reached: &[(BlockIndex, Plane)],
) {
    for (index, _) in reached {
        let region = all.entry(region_of(*index)).or_default();
        let bit = voxel_bit(Voxel::new(index.x, index.y, index.z));
        if region[bit / 64] >> (bit % 64) & 1 == 0 {
            region[bit / 64] |= 1 << (bit % 64);
            targets.push(whole(*index));
        }
    }
}

/// Blocks that are worked out together, before it is seen how much of them was contested.
const AT_ONCE: usize = 8;

/// To look into a slanted layer for a voxel so often takes as long as to work out a block that is not contested.
const LOOKS_PER_BLOCK: usize = 32;

/// To unpack a cube takes as long as to work out so many blocks: up to a millisecond.
const BLOCKS_PER_CUBE: usize = 32;

/// The cube of cubes.
const fn parent_of(cube: BlockIndex) -> BlockIndex {
    BlockIndex { x: cube.x >> 2, y: cube.y >> 2, z: cube.z >> 2 }
}
