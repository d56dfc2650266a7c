//! Submaps in fusion: when they begin, which blocks they have, and how they lie.

use std::borrow::Cow;
use std::collections::BTreeSet;

use flockmap_mutation::{self as mutation, Mutation};
use rustc_hash::FxHashMap;

use super::Fusion;
use super::fused::Fused;
use super::part::is_over;
use super::reach::merge;
use crate::layer::first_of;
use crate::submap::{BlockBox, is_reserved, record};
use crate::{
    BLOCK_VOXELS, BlockIndex, Mapper, MovedBlock, Plane, Pose, Sheet, Stamp, State, Stream, SubmapId,
};

/// A block of a layer that is in another submap from now on, and the one in which it was, if that was known.
type Moved = (BlockIndex, Option<SubmapId>);

impl Fusion {
    /// How a submap of a stream lies in the map of its stream, as far as that is known; the first one without a pose
    /// as the stream does, others as the one before. It [comes into force](Self::work) as an alignment does.
    pub fn submap_pose(&self, stream: Stream, submap: SubmapId) -> Pose {
        self.wanted.submap(stream, submap)
    }

    /// How submaps of a stream lie in the fused map as it is now, `T_own_submap`: those that do not lie as the one before
    /// them does, ascending, the first one of the stream among them. O(submaps of which a pose is known).
    pub fn shown_submaps(&self, stream: Stream) -> Vec<(SubmapId, Pose)> {
        let settings = &self.shown.settings;
        let of_stream = match stream == self.sources.own {
            true => Pose::IDENTITY,
            false => *settings.origin(stream.origin).pose(),
        };
        let mut poses = vec![(SubmapId::FIRST, settings.submap(stream, SubmapId::FIRST))];
        poses.extend(settings.submaps(stream).filter(|(submap, _)| *submap > SubmapId::FIRST));
        poses.dedup_by_key(|(_, pose)| *pose);
        for (_, pose) in &mut poses {
            *pose = if *pose == Pose::IDENTITY { of_stream } else { of_stream.compose(pose) };
        }
        poses
    }

    /// Says how a submap lies in the map of its stream: for the own stream, of which this robot knows it first.
    pub fn set_submap_pose(&mut self, stream: Stream, submap: SubmapId, pose: Pose) {
        if self.wanted.submap(stream, submap) != pose {
            self.due_submaps.insert(stream);
        }
        self.wanted.set_submap(stream, submap, pose);
    }

    /// The voxels of a block of a submap of the own run that are Occupied in the fused map. O(512) where it was moved.
    pub fn occupied_in_view(&self, submap: SubmapId, block: BlockIndex) -> Plane {
        let view = &self.shown.view;
        match self.shown.settings.alignment(self.sources.own, true, submap, Sheet::FIRST) {
            None => [0; 8],
            Some(at) if at.is_identity() => view.block(block).map_or([0; 8], |states| *states.occupied()),
            Some(at) => {
                let mut occupied = [0; 8];
                for bit in 0..BLOCK_VOXELS {
                    let is_occupied = view.state(at.voxel(block.voxel(bit))) == State::Occupied;
                    occupied[bit / 64] |= u64::from(is_occupied) << (bit % 64);
                }
                occupied
            }
        }
    }

    /// The submaps of a stream that are known to have begun, in their order; the first one is always there.
    pub fn submaps(&self, stream: Stream) -> impl Iterator<Item = SubmapId> {
        let spans = self.sources.get(stream).map(|source| &source.spans);
        let begun = spans.map_or_else(|| vec![SubmapId::FIRST], |spans| spans.submaps().collect());
        begun.into_iter()
    }

    /// The stamp from which on a submap goes, as far as that is known; of the first one there is none.
    pub fn submap_began(&self, stream: Stream, submap: SubmapId) -> Option<Stamp> {
        self.sources.get(stream).and_then(|source| source.spans.began(submap))
    }

    /// Blocks of a layer that are not fused, since it is not known in which submap they are. O(blocks).
    pub fn unplaced(&self, stream: Stream) -> usize {
        let Some(source) = self.sources.get(stream) else { return 0 };
        let blocks = source.layer.blocks().filter(|(index, _)| Sheet::of(*index).is_some());
        blocks.filter(|(index, _)| source.spans.of(*index).is_none()).count()
    }

    /// Takes in what a layer has taken over: records of submaps, and in which submaps blocks are. Returns the blocks
    /// that moved to another one.
    pub(super) fn note_taken(&mut self, stream: Stream, taken: &[(BlockIndex, Plane)]) -> Vec<Moved> {
        let records: BTreeSet<_> = taken.iter().filter_map(|(index, _)| record::submap_at(*index)).collect();
        for submap in records {
            self.read_record(stream, submap);
        }
        self.note_blocks(stream, taken.iter().map(|(index, _)| *index))
    }

    fn read_record(&mut self, stream: Stream, submap: SubmapId) {
        let is_own = stream == self.sources.own;
        let Some(source) = self.sources.get(stream) else { return };
        let record = record::read(&source.layer, submap);
        if let Some(began) = record.began {
            self.sources.change(stream, |source| {
                // Until the first one is known nothing of the own layer is fused, also not what began anew in the own map.
                let is_all = is_own && source.spans.is_empty();
                let cubes = source.layer.cube_indices().filter(|at| !is_reserved(first_of(*at)));
                let blocks = || cubes.map(BlockBox::of_cube).reduce(BlockBox::union);
                if source.spans.begin(submap, began, blocks) {
                    // What came before its submap is known: another part has it from now on, even where that lies alike.
                    let late =
                        source.layer.cubes_with_newest().filter(|(_, newest)| is_all || *newest >= began);
                    source.unnoted.extend(late.map(|(at, _)| at));
                    source.unnoted.sort_unstable();
                    source.unnoted.dedup();
                }
            });
        }
        let is_known = submap == SubmapId::FIRST || self.submap_began(stream, submap).is_some();
        let is_once = mutation::is(Mutation::SubmapSetOnce) && self.wanted.has_submap(stream, submap);
        if let Some(pose) = record.pose.filter(|_| is_known && !is_once) {
            self.set_submap_pose(stream, submap, pose);
        }
    }

    /// Notes in which submaps blocks are now. Returns those that moved to another one.
    pub(super) fn note_blocks(
        &mut self,
        stream: Stream,
        blocks: impl Iterator<Item = BlockIndex>,
    ) -> Vec<Moved> {
        if self.sources.get(stream).is_none_or(|source| source.spans.is_empty()) {
            return Vec::new();
        }
        self.sources.change(stream, |source| {
            let mut moved = Vec::new();
            for index in blocks {
                let before = source.spans.of(index);
                source.spans.note(index, source.layer.newest_of(index));
                if source.spans.of(index) != before {
                    moved.push((index, before));
                }
            }
            moved
        })
    }

    /// Notes in which submaps blocks are that came before it was known when these began; as many as this, and what of
    /// a cube goes beyond.
    pub(super) fn note_late(&mut self, mapper: &Mapper, blocks_max: usize) {
        let mut noted = 0;
        while noted < blocks_max
            && let Some(stream) = self.sources.unnoted()
        {
            let known = self.sources.change(stream, |source| {
                let cube = source.unnoted.pop();
                if source.unnoted.is_empty() {
                    source.unnoted = Vec::new();
                }
                cube.map_or_else(Vec::new, |at| source.layer.known_in_cube(at))
            });
            noted += known.len().max(1);
            let moved = self.note_blocks(stream, known.iter().map(|(index, _)| *index));
            self.refresh_taken(mapper, stream, &known, &moved);
        }
    }

    /// Works out anew what a layer has taken over, and what moved to another submap, there and where it was.
    pub(super) fn refresh_taken(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        taken: &[(BlockIndex, Plane)],
        moved: &[Moved],
    ) {
        let is_own = stream == self.sources.own;
        let Some(source) = self.sources.get(stream) else { return };
        // Of the own layer only what the own map does not have any more has a say.
        let has_say = |index: BlockIndex| !is_own || is_over(mapper, index);
        let taken: Vec<_> = taken.iter().copied().filter(|(index, _)| has_say(*index)).collect();
        let moved: Vec<_> = moved.iter().copied().filter(|(index, _)| has_say(*index)).collect();
        let submap_of: FxHashMap<_, _> = moved.iter().copied().collect();
        let moved = if mutation::is(Mutation::MovedShown) { Vec::new() } else { moved };
        let whole: Vec<(BlockIndex, Plane)> = moved
            .iter()
            .filter_map(|(index, _)| Some((*index, source.layer.block(*index)?.known())))
            .collect();
        let before = |(index, _): &(BlockIndex, Plane)| submap_of.get(index).copied().flatten();
        let of_moved = |fused: &Fused| {
            let mut all = fused.reach(stream, source, is_own, &whole).into_owned();
            all.extend(fused.reach_by(stream, is_own, &whole, before));
            all
        };
        // The map that is being made began as the one that is shown.
        let moved: Vec<_> = self.maps().flat_map(of_moved).collect();
        let reach = |fused: &Fused| {
            let mut all = fused.reach(stream, source, is_own, &taken).into_owned();
            if !moved.is_empty() {
                all.extend_from_slice(&moved);
                all = merge(all);
            }
            all
        };
        let reached: Vec<_> = self.maps().map(reach).collect();
        self.refresh_each(mapper, &reached);
    }

    /// What became of blocks of the own map that were in another submap, began anew, or are gone: it is worked out anew
    /// where they were, and where what was published of them is.
    pub(super) fn refresh_moved(&mut self, mapper: &Mapper, moved: &[MovedBlock]) {
        let own = self.sources.own;
        if moved.is_empty() || self.maps().all(|fused| fused.is_own_plain(own, mapper)) {
            return;
        }
        let known: Vec<_> = moved.iter().map(|block| (block.index, block.known)).collect();
        let submap_of: FxHashMap<_, _> = moved.iter().map(|block| (block.index, block.submap)).collect();
        let before = |(index, _): &(BlockIndex, Plane)| submap_of.get(index).copied();
        let mut published = Vec::new();
        for block in moved {
            let sheets = (0..=block.sheet.number()).filter_map(Sheet::new);
            published.extend(sheets.filter_map(|sheet| Some((sheet.block(block.index)?, [u64::MAX; 8]))));
        }
        let source = self.sources.get(own);
        let reach = |fused: &Fused| {
            let mut all = fused.reach_by(own, true, &known, before);
            all.extend_from_slice(&fused.reach_own(own, mapper, &known));
            if let Some(source) = source {
                all.extend_from_slice(&fused.reach(own, source, true, &published));
            }
            all
        };
        // The map that is being made began as the one that is shown.
        let reached = merge(self.maps().flat_map(reach).collect());
        self.refresh(mapper, |_| Cow::Borrowed(&reached));
    }
}
