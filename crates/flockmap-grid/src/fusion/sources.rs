//! The layers of all streams, with those that are leaving.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::received::Received;
use crate::layer::PackedCube;
use crate::submap::Spans;
use crate::unpacked::Unpacked;
use crate::{BlockIndex, DiscardedLayer, Layer, RobotId, Stream};

/// What came of a stream.
#[derive(Default)]
pub(super) struct Source {
    /// The same on every robot that has applied the same, with the stamps of the origin.
    pub layer: Layer,
    /// When it came here. Of the own stream nothing is noted: the mapper says what was seen when.
    pub received: Received,
    /// Which of its blocks are in which submap.
    pub spans: Spans,
    /// Cubes of the layer with blocks that may be in another submap than was known when they came.
    pub unnoted: Vec<BlockIndex>,
    /// No two sources have the same, also of a stream that comes back.
    number: u64,
    /// `Sources::changed` when it was changed last.
    changed_at: u64,
}

/// Of all streams.
pub(super) struct Sources {
    pub own: Stream,
    sources: BTreeMap<Stream, Source>,
    /// Forgotten, and still in the map that is shown.
    leaving: Vec<Leaving>,
    /// In no map any more, and not yet let go of, with the bytes that count for them until they are.
    discarded: Vec<(DiscardedLayer, usize)>,
    /// Of the sources of others, with those that are leaving or discarded.
    bytes: usize,
    /// Cubes of layers, for who reads them.
    unpacked: Arc<Unpacked<PackedCube>>,
    numbers: u64,
    /// How often blocks of layers of others were changed.
    changed: u64,
    /// Layers of others of which something is not packed, by when they were changed last.
    open: BTreeSet<(u64, Stream)>,
}

struct Leaving {
    stream: Stream,
    source: Source,
    /// The map that is being made does not have it any more.
    is_left_out: bool,
}

impl Source {
    pub(super) fn memory_bytes(&self) -> usize {
        self.layer.memory_bytes()
            + self.received.memory_bytes()
            + self.spans.memory_bytes()
            + self.unnoted.capacity() * size_of::<BlockIndex>()
    }

    pub(super) const fn number(&self) -> u64 {
        self.number
    }
}

impl Sources {
    pub(super) fn new(own: Stream) -> Self {
        Self {
            own,
            sources: BTreeMap::new(),
            leaving: Vec::new(),
            discarded: Vec::new(),
            bytes: 0,
            unpacked: Arc::default(),
            numbers: 0,
            changed: 0,
            open: BTreeSet::new(),
        }
    }

    pub(super) fn get(&self, stream: Stream) -> Option<&Source> {
        self.sources.get(&stream)
    }

    /// All but those that are leaving, in ascending order of their streams.
    pub(super) fn iter(&self) -> impl Iterator<Item = (Stream, &Source)> {
        self.sources.iter().map(|(stream, source)| (*stream, source))
    }

    /// All but the own one, with those that are leaving, as long as they are in the map that is shown, or in the
    /// one that is being made. With each whether it is leaving.
    pub(super) fn of_others(&self, is_next: bool) -> impl Iterator<Item = (Stream, &Source, bool)> {
        let leaving = self.leaving.iter().filter(move |leaving| !(is_next && leaving.is_left_out));
        let leaving = leaving.map(|leaving| (leaving.stream, &leaving.source, true));
        let others = self.iter().filter(|(stream, _)| *stream != self.own);
        others.map(|(stream, source)| (stream, source, false)).chain(leaving)
    }

    /// The source with this number, with its stream.
    pub(super) fn numbered(&self, number: u64) -> Option<(Stream, &Source)> {
        let leaving = self.leaving.iter().map(|leaving| (leaving.stream, &leaving.source));
        self.iter().chain(leaving).find(|(_, source)| source.number() == number)
    }

    /// A stream with blocks of which it is to be noted in which submap they are.
    pub(super) fn unnoted(&self) -> Option<Stream> {
        self.iter().find(|(_, source)| !source.unnoted.is_empty()).map(|(stream, _)| stream)
    }

    /// Whether there is something of an origin in a map, or was.
    pub(super) fn has_of(&self, origin: RobotId) -> bool {
        self.of_others(false).any(|(stream, _, _)| stream.origin == origin)
    }

    /// Of the sources of others, with those that are leaving or discarded.
    pub(super) const fn bytes(&self) -> usize {
        self.bytes
    }

    /// Whether there are as many as there may be, beside as many that are leaving.
    pub(super) fn is_full(&self, max: usize) -> bool {
        self.sources.len() >= max || self.leaving.len() >= max
    }

    /// How often a cube of a layer was unpacked to be read.
    pub(super) fn unpacked(&self) -> usize {
        self.unpacked.count()
    }

    pub(super) const fn is_any_leaving(&self) -> bool {
        !self.leaving.is_empty()
    }

    pub(super) const fn is_any_discarded(&self) -> bool {
        !self.discarded.is_empty()
    }

    /// Changes a source, which is made if need be, and the count of bytes with it.
    pub(super) fn change<T>(&mut self, stream: Stream, change: impl FnOnce(&mut Source) -> T) -> T {
        let source = self.sources.entry(stream).or_insert_with(|| {
            self.numbers += 1;
            Source { layer: Layer::new(&self.unpacked), number: self.numbers, ..Source::default() }
        });
        let (before, changed) = (source.memory_bytes(), source.layer.changed());
        let result = change(source);
        if stream != self.own {
            self.bytes = self.bytes + source.memory_bytes() - before;
            // A layer that has taken the place of another one counts from the beginning.
            let now = source.layer.changed();
            self.changed += now.checked_sub(changed).unwrap_or(now);
            self.open.remove(&(source.changed_at, stream));
            source.changed_at = self.changed;
            self.open.insert((self.changed, stream));
        }
        result
    }

    /// Packs what was published: [`Layer::make_room`]. Returns how many blocks it has packed.
    pub(super) fn make_room_of_own(&mut self, cold: u64, blocks_max: usize) -> usize {
        self.sources.get_mut(&self.own).map_or(0, |source| source.layer.make_room(cold, blocks_max))
    }

    /// The same of the layers of others, the one that was changed longest ago first. A layer is packed whole if `cold`
    /// blocks were changed in others since it was. Of each of the rest stays open what its share of the last `cold`
    /// changes may have touched, were all changed as often. O(layers that are not packed whole).
    pub(super) fn make_room_of_others(&mut self, cold: u64, blocks_max: usize) -> usize {
        let mut packed = 0;
        let cold_of_one = cold / self.open.len().max(1) as u64;
        let mut all_packed = Vec::new();
        for &(changed_at, stream) in &self.open {
            let Some(source) = self.sources.get_mut(&stream).filter(|_| packed < blocks_max) else { break };
            let before = source.memory_bytes();
            let cold = if changed_at + cold <= self.changed { 0 } else { cold_of_one };
            packed += source.layer.make_room(cold, blocks_max - packed);
            self.bytes = self.bytes + source.memory_bytes() - before;
            if source.layer.is_packed() {
                all_packed.push((changed_at, stream));
            }
        }
        for at in &all_packed {
            self.open.remove(at);
        }
        packed
    }

    /// The own stream is another one; the source of the former one is in no map, and is discarded.
    pub(super) fn begin_run(&mut self, own: Stream) {
        if let Some(source) = self.sources.remove(&self.own) {
            self.discarded.push((source.layer.discard(), 0));
        }
        self.own = own;
    }

    /// The source of a stream leaves; the own one is in no map, so it is gone at once.
    pub(super) fn forget(&mut self, stream: Stream) {
        if let Some(source) = self.sources.remove(&stream)
            && stream != self.own
        {
            self.open.remove(&(source.changed_at, stream));
            self.leaving.push(Leaving { stream, source, is_left_out: false });
        }
    }

    /// Those that are leaving now are not in the map that is made from now on.
    pub(super) fn leave_out(&mut self) {
        self.leaving.iter_mut().for_each(|leaving| leaving.is_left_out = true);
    }

    /// The map that was made without those that were left out is shown: they are discarded. Returns which they were.
    pub(super) fn discard_left_out(&mut self) -> Vec<Stream> {
        let mut dropped = Vec::new();
        for Leaving { stream, source, .. } in self.leaving.extract_if(.., |leaving| leaving.is_left_out) {
            dropped.push(stream);
            let bytes = source.memory_bytes();
            self.discarded.push((source.layer.discard(), bytes));
        }
        dropped
    }

    /// Lets go of what is discarded, `blocks_max` blocks at most, and what of a cube goes beyond that.
    pub(super) fn free(&mut self, mut blocks_max: usize) {
        while blocks_max > 0
            && let Some((layer, bytes)) = self.discarded.last_mut()
        {
            match layer.free(blocks_max) {
                0 => {
                    self.bytes -= *bytes;
                    self.discarded.pop();
                }
                freed => blocks_max = blocks_max.saturating_sub(freed),
            }
        }
    }
}
