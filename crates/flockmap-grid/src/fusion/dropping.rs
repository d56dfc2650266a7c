//! At the limit: what is far and old goes for what is near and new.

use core::cmp::Reverse;
use std::borrow::Cow;

use super::dropped::{Candidate, Dropped};
use super::fused::Fused;
use super::reach::merge;
use super::sources::Source;
use super::{Fusion, FusionError};
use crate::layer::{cube_of, first_of, is_kept};
use crate::{BLOCK_SIDE, BlockIndex, Changes, Mapper, Plane, Sheet, Stamp, Stream, SubmapId};

/// So many of all cubes are chosen at a time.
const CHOSEN_SHARE: usize = 8;
/// Blocks along a side of a cube.
const CUBE_SIDE: f64 = 4.0;

impl Fusion {
    /// What was dropped since this was asked last, of each stream once.
    pub fn take_dropped(&mut self) -> Vec<Dropped> {
        core::mem::take(&mut self.dropping.dropped)
    }

    /// Notes where the own robot is: metres in its map.
    pub(super) fn note_near(&mut self, sensor: Option<[f64; 3]>) {
        let block_m = self.resolution.metres() * f64::from(BLOCK_SIDE);
        self.dropping.near = sensor.map(|at| at.map(|at| at / block_m)).or(self.dropping.near);
    }

    /// Makes room for parts that a layer is to take over, where packing makes none: drops the farthest and oldest
    /// cubes, and leaves out of the parts what is farther and older still. Each part has a stamp. O(cubes) once for an
    /// eighth of them; beside that what is dropped is worked out anew in the fused map, 10 to 40 µs for a block.
    ///
    /// # Errors
    /// [`FusionError`] where something that was forgotten gives room in a moment; nothing is changed then.
    pub(super) fn make_room_by_dropping(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        parts: &mut Vec<(Stamp, Changes)>,
        sensors: usize,
        now: Stamp,
    ) -> Result<(), FusionError> {
        let is_own = stream == self.sources.own;
        loop {
            match self.check_room(mapper, stream, parts.iter().map(|(_, part)| part), sensors) {
                Err(FusionError::OwnLayerFull { .. }) => {}
                // What was forgotten goes first, in a moment.
                Err(FusionError::LayersFull { .. })
                    if !self.sources.is_any_leaving() && !self.sources.is_any_discarded() => {}
                result => return result,
            }
            let worst = self.worst(is_own, now).map(|candidate| candidate.rank);
            if !self.leave_out(mapper, stream, parts, worst, now)
                && let Some(Candidate { stream, at, .. }) = self.dropping.next[usize::from(is_own)].pop()
            {
                let drop = |source: &mut Source| (source.layer.drop_cube(at), source.layer.lost_upto());
                let (known, newest) = self.sources.change(stream, drop);
                self.show_without(mapper, stream, &known);
                self.note_dropped(stream, known.len(), newest.unwrap_or_default());
            }
            if parts.is_empty() {
                return Ok(());
            }
        }
    }

    /// Leaves out of parts what is not worth that something of this rank is dropped for it; where nothing is left that
    /// could go, everything, also what is said of submaps. Whether that is any.
    fn leave_out(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        parts: &mut Vec<(Stamp, Changes)>,
        worst: Option<u64>,
        now: Stamp,
    ) -> bool {
        // With what is there of its cube it goes or stays.
        let newest = |fusion: &Self, at, stamp: Stamp| {
            let held = fusion.sources.get(stream).and_then(|source| source.layer.newest_in(at));
            held.map_or(stamp, |held| held.max(stamp))
        };
        let mut refused = Vec::new();
        for (stamp, part) in parts.iter_mut() {
            let is_out = |index: BlockIndex| {
                let at = cube_of(index);
                worst.is_none_or(|worst| {
                    !is_kept(at) && self.rank(stream, at, newest(self, at, *stamp), now) >= worst
                })
            };
            let (out, stay): (Vec<_>, Vec<_>) = part.blocks().iter().partition(|(index, _)| is_out(*index));
            if !out.is_empty() {
                refused.extend(out.iter().map(|(index, _)| (cube_of(*index), *stamp)));
                *part = Changes::from_blocks(stay);
            }
        }
        parts.retain(|(_, part)| !part.is_empty());
        for (at, stamp) in &refused {
            let newest = newest(self, *at, *stamp);
            let known = self.sources.change(stream, |source| source.layer.refuse(*at, *stamp));
            self.show_without(mapper, stream, &known);
            self.note_dropped(stream, known.len().max(1), newest);
        }
        !refused.is_empty()
    }

    /// The cube that is to go next, if there is any.
    fn worst(&mut self, is_own: bool, now: Stamp) -> Option<&Candidate> {
        let list = usize::from(is_own);
        for is_first in [true, false] {
            while let Some(candidate) = self.dropping.next[list].last() {
                let source = self.sources.get(candidate.stream);
                if source.and_then(|source| source.layer.newest_in(candidate.at)) == Some(candidate.newest) {
                    return self.dropping.next[list].last();
                }
                self.dropping.next[list].pop();
            }
            if is_first {
                self.dropping.next[list] = self.choose(is_own, now);
            }
        }
        None
    }

    /// The eighth of all cubes that are farthest and oldest, the worst last. O(cubes).
    fn choose(&self, is_own: bool, now: Stamp) -> Vec<Candidate> {
        let own = self.sources.own;
        let concerned = self.sources.iter().filter(|(stream, _)| (*stream == own) == is_own);
        let mut all: Vec<Candidate> = concerned
            .flat_map(|(stream, source)| {
                let cubes = source.layer.cubes_with_newest().filter(|(at, _)| !is_kept(*at));
                cubes.map(move |(at, newest)| (stream, at, newest))
            })
            .map(|(stream, at, newest)| Candidate {
                rank: self.rank(stream, at, newest, now),
                stream,
                at,
                newest,
            })
            .collect();
        let key = |candidate: &Candidate| (Reverse(candidate.rank), candidate.stream, candidate.at);
        let count = all.len().div_ceil(CHOSEN_SHARE);
        if count < all.len() {
            all.select_nth_unstable_by_key(count, key);
            all.truncate(count);
        }
        all.sort_unstable_by_key(|candidate| Reverse(key(candidate)));
        all
    }

    /// How little a cube is worth: its distance from the own robot times its age.
    fn rank(&self, stream: Stream, at: BlockIndex, stamp: Stamp, now: Stamp) -> u64 {
        let origin = self.wanted.origin(stream.origin);
        let middle = Sheet::of(first_of(at)).unwrap_or_default().middle().map(f64::from);
        let centre = [at.x, at.y, at.z].map(|at| (f64::from(at) + 0.5) * CUBE_SIDE);
        let distance = self.dropping.near.map_or(0, |near| {
            let block_m = self.resolution.metres() * f64::from(BLOCK_SIDE);
            let spans = self.sources.get(stream).map(|source| &source.spans);
            let submap = spans.map_or(SubmapId::FIRST, |spans| spans.at(stamp));
            let local = core::array::from_fn(|axis| (centre[axis] - middle[axis]) * block_m);
            let in_map = self.wanted.submap(stream, submap).transform(local);
            let is_own = stream == self.sources.own;
            let centre = if is_own { in_map } else { origin.pose().transform(in_map) };
            let centre = centre.map(|at| at / block_m);
            let squares = centre.iter().zip(near).map(|(at, near)| (at - near) * (at - near));
            squares.sum::<f64>().sqrt() as u64
        });
        let made = match self.sources.get(stream) {
            Some(source) if stream != self.sources.own => {
                source.received.made(stamp, origin.clock_offset_micros)
            }
            _ => stamp,
        };
        let age_ms = now.micros_since(made).max(0) as u64 / 1_000;
        (distance + 1).saturating_mul(age_ms + 1)
    }

    /// Something is gone from a layer: the fused map, and the one that is being made, are worked out there anew.
    pub(super) fn show_without(&mut self, mapper: &Mapper, stream: Stream, known: &[(BlockIndex, Plane)]) {
        let Some(source) = self.sources.get(stream).filter(|_| !known.is_empty()) else { return };
        let is_own = stream == self.sources.own;
        // The map that is being made began as the one that is shown.
        let reach = |fused: &Fused| fused.reach(stream, source, is_own, known).into_owned();
        let reached = merge(self.maps().flat_map(reach).collect());
        self.note_blocks(stream, known.iter().map(|(index, _)| *index));
        if !reached.is_empty() && !flockmap_mutation::is(flockmap_mutation::Mutation::DroppedShown) {
            self.refresh(mapper, |_| Cow::Borrowed(&reached));
            self.shown.view.forget_emptied();
        }
    }

    pub(super) fn note_dropped(&mut self, stream: Stream, blocks: usize, newest: Stamp) {
        match self.dropping.dropped.iter_mut().find(|dropped| dropped.stream == stream) {
            Some(dropped) => {
                dropped.blocks += blocks;
                dropped.newest = dropped.newest.max(newest);
            }
            None => self.dropping.dropped.push(Dropped { stream, blocks, newest }),
        }
    }

    /// Whether something of a stream is lacking in its layer: [`Layer::lost_upto`](crate::Layer::lost_upto). O(1).
    pub fn is_in_part(&self, stream: Stream) -> bool {
        self.layer(stream).is_some_and(|layer| layer.lost_upto().is_some())
    }
}
