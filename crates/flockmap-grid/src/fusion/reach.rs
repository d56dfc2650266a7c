//! What has a say where in a fused map.

use std::borrow::Cow;

use super::align::Alignment;
use super::fused::Fused;
use super::part::{Part, PartBlocks};
use super::sources::{Source, Sources};
use crate::submap::{BlockBox, Spans, is_reserved};
use crate::{BlockIndex, Mapper, Plane, Sheet, Stream, SubmapId};

impl Fused {
    /// Whether the own map lies in the fused one as it is, and all of it is in the mapper.
    pub(super) fn is_own_plain(&self, own: Stream, mapper: &Mapper) -> bool {
        mapper.begun_anew() == 0 && self.settings.is_unmoved(own)
    }

    /// All parts that may have a say in a box of the fused map, but for the own map where that is plain.
    pub(super) fn parts<'a>(
        &'a self,
        sources: &'a Sources,
        mapper: &'a Mapper,
        targets: &BlockBox,
    ) -> Vec<Part<'a>> {
        let mut parts = Vec::new();
        for (stream, source, _) in sources.of_others(self.is_next) {
            let origin = self.settings.origin(stream.origin);
            if origin.is_muted {
                continue;
            }
            let received = Some((&source.received, origin.clock_offset_micros));
            if source.spans.is_empty() {
                let alignment = match self.settings.is_unmoved(stream) {
                    true => Some(Cow::Borrowed(origin.alignment())),
                    false => {
                        self.settings.alignment(stream, false, SubmapId::FIRST, Sheet::FIRST).map(Cow::Owned)
                    }
                };
                let (submap, blocks) = (SubmapId::FIRST, PartBlocks::Layer(&source.layer));
                parts.extend(alignment.map(|alignment| Part { stream, submap, alignment, blocks, received }));
                continue;
            }
            self.add_submaps(stream, false, &source.spans, targets, |alignment, submap, sheet| {
                let (layer, spans) = (&source.layer, &source.spans);
                let blocks = PartBlocks::Submap { layer, spans, submap, sheet };
                parts.push(Part { stream, submap, alignment, blocks, received });
            });
        }
        let own = sources.own;
        if self.is_own_plain(own, mapper) {
            return parts;
        }
        for (submap, blocks) in mapper.submaps() {
            let alignment = self.settings.alignment(own, true, submap, Sheet::FIRST);
            if let Some(alignment) = alignment.filter(|alignment| alignment.image_of(&blocks).meets(targets))
            {
                let (alignment, blocks) = (Cow::Owned(alignment), PartBlocks::Own(mapper.blocks_of(submap)));
                parts.push(Part { stream: own, submap, alignment, blocks, received: None });
            }
        }
        if let Some(source) = sources.get(own).filter(|_| mapper.begun_anew() > 0) {
            self.add_submaps(own, true, &source.spans, targets, |alignment, submap, sheet| {
                let (layer, spans) = (&source.layer, &source.spans);
                let blocks = PartBlocks::OwnBefore { layer, spans, submap, sheet, mapper };
                parts.push(Part { stream: own, submap, alignment, blocks, received: None });
            });
        }
        parts
    }

    fn add_submaps(
        &self,
        stream: Stream,
        is_own: bool,
        spans: &Spans,
        targets: &BlockBox,
        mut add: impl FnMut(Cow<'static, Alignment>, SubmapId, Sheet),
    ) {
        for (submap, sheet, blocks) in spans.parts() {
            let alignment = self.settings.alignment(stream, is_own, submap, sheet);
            if let Some(alignment) = alignment.filter(|alignment| alignment.image_of(&blocks).meets(targets))
            {
                add(Cow::Owned(alignment), submap, sheet);
            }
        }
    }

    /// The voxels on which these voxels of a layer can have a say, and few others.
    pub(super) fn reach<'a>(
        &self,
        stream: Stream,
        source: &Source,
        is_own: bool,
        voxels: &'a [(BlockIndex, Plane)],
    ) -> Cow<'a, [(BlockIndex, Plane)]> {
        let origin = self.settings.origin(stream.origin);
        if origin.is_muted && !is_own {
            return Cow::Borrowed(&[]);
        }
        if !source.spans.is_empty() || !is_own && !self.settings.is_unmoved(stream) {
            let of = |(index, _): &(BlockIndex, Plane)| source.spans.of(*index);
            return Cow::Owned(self.reach_by(stream, is_own, voxels, of));
        }
        if is_own {
            return Cow::Borrowed(&[]);
        }
        if voxels.iter().any(|(index, _)| is_reserved(*index)) {
            let voxels: Vec<_> = voxels.iter().copied().filter(|(index, _)| !is_reserved(*index)).collect();
            return Cow::Owned(origin.alignment().reach(&voxels).into_owned());
        }
        origin.alignment().reach(voxels)
    }

    /// The same of the own map.
    pub(super) fn reach_own<'a>(
        &self,
        own: Stream,
        mapper: &Mapper,
        voxels: &'a [(BlockIndex, Plane)],
    ) -> Cow<'a, [(BlockIndex, Plane)]> {
        if self.settings.is_unmoved(own) {
            return Cow::Borrowed(voxels);
        }
        let of = |(index, _): &(BlockIndex, Plane)| mapper.place_of(*index).map(|(submap, _)| submap);
        Cow::Owned(self.reach_by(own, true, voxels, of))
    }

    /// The same of voxels that are in these submaps, on their sheets; of those without one nothing.
    pub(super) fn reach_by(
        &self,
        stream: Stream,
        is_own: bool,
        voxels: &[(BlockIndex, Plane)],
        submap_of: impl Fn(&(BlockIndex, Plane)) -> Option<SubmapId>,
    ) -> Vec<(BlockIndex, Plane)> {
        let place_of = |at: &(BlockIndex, Plane)| Some((submap_of(at)?, Sheet::of(at.0)?));
        let mut placed: Vec<_> = voxels.iter().filter_map(|at| Some((place_of(at)?, *at))).collect();
        placed.sort_by_key(|(place, _)| *place);
        let mut reached = Vec::new();
        for together in placed.chunk_by(|(a, _), (b, _)| a == b) {
            let (submap, sheet) = together[0].0;
            if let Some(alignment) = self.settings.alignment(stream, is_own, submap, sheet) {
                let voxels: Vec<_> = together.iter().map(|(_, at)| *at).collect();
                reached.extend_from_slice(&alignment.reach(&voxels));
            }
        }
        merge(reached)
    }
}

/// Each block once.
pub(super) fn merge(mut voxels: Vec<(BlockIndex, Plane)>) -> Vec<(BlockIndex, Plane)> {
    voxels.sort_unstable_by_key(|(index, _)| *index);
    voxels.dedup_by(|(later, more), (index, plane)| {
        let is_same = later == index;
        if is_same {
            *plane = core::array::from_fn(|z| plane[z] | more[z]);
        }
        is_same
    });
    voxels
}
