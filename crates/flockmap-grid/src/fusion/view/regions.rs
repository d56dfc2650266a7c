//! The regions of a map: open where something is written to, packed where nothing was for long.

use core::ops::Deref;
use std::collections::VecDeque;
use std::sync::Arc;

use rustc_hash::FxHashMap;

use super::packed::PackedRegion;
use crate::fusion::region::{BLOCK_BYTES_MAX, Region, indices, region_of};
use crate::memory::table_bytes;
use crate::unpacked::{Packed, Unpacked};
use crate::{BlockIndex, StateBlock};

/// When blocks were written to so often, it is looked whether so many regions lie cold, and so many blocks are packed at
/// most, or one region of up to 512.
const LOOKED_EVERY: u64 = 256;
/// A region is cold to which nothing was written while blocks were written to four times as often as there are open
/// ones, but between these. To write what was there counts: so what a robot looks at stays open, however large it is,
/// and what it has left behind is packed within half a minute as a rule.
const COLD: [u64; 2] = [32_768, 131_072];

/// All regions of a map, by their indices.
#[derive(Clone, Debug, Default)]
pub(super) struct Regions {
    places: FxHashMap<BlockIndex, Place>,
    /// Each open region once, in the order in which they are looked at.
    queue: VecDeque<BlockIndex>,
    /// Blocks of open regions.
    open: usize,
    /// Of all regions.
    bytes: usize,
    /// How often blocks were written to.
    written: u64,
}

/// A region where it lies. Copies of a map share it until one of them writes to it.
#[derive(Clone, Debug)]
pub(super) enum Place {
    Open {
        region: Arc<Region>,
        /// [`Regions::written`] when something was written to it last.
        touched: u64,
    },
    Packed(Arc<PackedRegion>),
}

/// The most that a block takes: it is alone in its region, the table of regions is filled to 7/16, the queue to half.
pub(super) const REGION_BLOCK_BYTES_MAX: usize =
    BLOCK_BYTES_MAX + (PLACE_BYTES + 1) * 16 / 7 + 2 * size_of::<BlockIndex>();
/// A region in the table.
const PLACE_BYTES: usize = size_of::<(BlockIndex, Place)>();

/// A region to be read.
pub(super) enum Reading<'a> {
    Open(&'a Region),
    Unpacked(Arc<Region>),
}

impl Deref for Reading<'_> {
    type Target = Region;

    fn deref(&self) -> &Region {
        match self {
            Self::Open(region) => region,
            Self::Unpacked(region) => region,
        }
    }
}

impl Regions {
    pub(super) fn get(&self, at: BlockIndex) -> Option<&Place> {
        self.places.get(&at)
    }

    /// In no order.
    pub(super) fn iter(&self) -> impl Iterator<Item = (BlockIndex, &Place)> {
        self.places.iter().map(|(at, place)| (*at, place))
    }

    /// Number of regions.
    pub(super) fn len(&self) -> usize {
        self.places.len()
    }

    /// Number of blocks that are not packed.
    pub(super) const fn open_count(&self) -> usize {
        self.open
    }

    /// Bytes on the heap. O(1).
    pub(super) fn memory_bytes(&self) -> usize {
        let queue = self.queue.capacity() * size_of::<BlockIndex>();
        self.bytes + table_bytes(self.places.len(), PLACE_BYTES) + queue
    }

    /// Writes to a block: `change` says of its states what they are from `version` on, or that they stay. Its region is
    /// unpacked if need be, and some that lie cold are packed now and then. Returns the states before, if the block was
    /// there, and now; `None` if they stay.
    pub(super) fn write(
        &mut self,
        index: BlockIndex,
        version: u64,
        unpacked: &Unpacked<PackedRegion>,
        change: impl FnOnce(StateBlock) -> Option<StateBlock>,
    ) -> Option<(Option<StateBlock>, StateBlock)> {
        self.note_written();
        let at = region_of(index);
        let before = self.open(at, unpacked).and_then(|region| region.block(index).copied());
        let states = change(before.unwrap_or_default())?;
        let place = self.places.entry(at).or_insert_with(|| {
            self.queue.push_back(at);
            Place::Open { region: Arc::default(), touched: self.written }
        });
        let region = place.open_mut();
        self.bytes -= region.memory_bytes();
        let region = Arc::make_mut(region);
        region.set(index, states, version);
        self.bytes += region.memory_bytes();
        self.open += usize::from(before.is_none());
        Some((before, states))
    }

    /// The region to write to, if it is there.
    fn open(&mut self, at: BlockIndex, unpacked: &Unpacked<PackedRegion>) -> Option<&Region> {
        let place = self.places.get_mut(&at)?;
        match place {
            Place::Open { touched, .. } => *touched = self.written,
            Place::Packed(packed) => {
                let region = unpacked.take(packed);
                self.bytes = self.bytes + region.memory_bytes() - packed.memory_bytes();
                self.open += region.parts().len();
                self.queue.push_back(at);
                *place = Place::Open { region: Arc::new(region), touched: self.written };
            }
        }
        Some(place.open_mut())
    }

    /// Lets go of the blocks of which nothing is known. O(blocks).
    pub(super) fn forget_emptied(&mut self) {
        let Self { places, bytes, open, .. } = self;
        places.retain(|_, place| {
            if !place.has_emptied() {
                return true;
            }
            *bytes -= place.memory_bytes();
            *open -= place.open_count();
            match place {
                Place::Open { region, .. } => Arc::make_mut(region).forget_emptied(),
                Place::Packed(packed) => *packed = Arc::new(packed.without_emptied()),
            }
            if place.is_empty() {
                return false;
            }
            *open += place.open_count();
            *bytes += place.memory_bytes();
            true
        });
        places.shrink_to_fit();
        self.queue.retain(|at| places.contains_key(at));
        self.queue.shrink_to_fit();
    }

    /// Packs all that is open and takes fewer bytes then. O(open blocks).
    pub(super) fn pack(&mut self) {
        for at in core::mem::take(&mut self.queue) {
            self.pack_region(at);
        }
        self.queue.shrink_to_fit();
    }

    /// Puts the same regions in place of some, which are open.
    pub(super) fn replace(&mut self, opened: Vec<(BlockIndex, Place)>) {
        for (at, place) in opened {
            let (bytes, open) = (place.memory_bytes(), place.open_count());
            if let Some(before) = self.places.insert(at, place) {
                self.bytes = self.bytes + bytes - before.memory_bytes();
                self.open = self.open + open - before.open_count();
            }
            self.queue.push_back(at);
        }
    }

    /// What it counts as it goes is what there is.
    #[cfg(test)]
    pub(super) fn check_counts(&self) {
        let sum = |of: fn(&Place) -> usize| self.places.values().map(of).sum::<usize>();
        assert_eq!((self.bytes, self.open), (sum(Place::memory_bytes), sum(Place::open_count)));
        let is_open = |at: &&BlockIndex| matches!(self.places[*at], Place::Open { .. });
        let mut open: Vec<_> = self.places.keys().filter(is_open).collect();
        let mut queue: Vec<_> = self.queue.iter().collect();
        open.sort_unstable();
        queue.sort_unstable();
        assert_eq!(open, queue, "each open region stands in the queue once");
    }

    /// Notes that a block is written to, and packs some of those that lie cold now and then.
    fn note_written(&mut self) {
        self.written += 1;
        if self.written.is_multiple_of(LOOKED_EVERY) {
            self.pack_cold();
        }
    }

    fn pack_cold(&mut self) {
        let cold = (4 * self.open as u64).clamp(COLD[0], COLD[1]);
        let limit = self.written.saturating_sub(cold);
        let mut packed = 0;
        for _ in 0..self.queue.len().min(LOOKED_EVERY as usize) {
            let Some(at) = self.queue.pop_front() else { break };
            match self.places.get(&at) {
                Some(Place::Open { touched, .. }) if *touched >= limit => self.queue.push_back(at),
                Some(place) if packed > 0 && packed + place.open_count() > LOOKED_EVERY as usize => {
                    self.queue.push_front(at);
                    break;
                }
                _ => packed += self.pack_region(at),
            }
        }
    }

    /// Packs an open region that is not in the queue any more, if that takes fewer bytes. Returns the number of its
    /// blocks.
    fn pack_region(&mut self, at: BlockIndex) -> usize {
        let Some(place) = self.places.get_mut(&at) else { return 0 };
        let Place::Open { region, touched } = place else { return 0 };
        let (blocks, bytes) = (region.parts().len(), region.memory_bytes());
        let packed = PackedRegion::pack(at, region);
        if packed.memory_bytes() < bytes {
            self.bytes = self.bytes + packed.memory_bytes() - bytes;
            self.open -= blocks;
            *place = Place::Packed(Arc::new(packed));
        } else {
            // Looked at again as if something was written to it.
            *touched = self.written;
            self.queue.push_back(at);
        }
        blocks
    }
}

impl Place {
    /// The region to be changed, which was opened.
    fn open_mut(&mut self) -> &mut Arc<Region> {
        match self {
            Self::Open { region, .. } => region,
            Self::Packed(_) => unreachable!("it was opened"),
        }
    }

    /// The region to be read, kept unpacked for who reads it again.
    pub(super) fn read(&self, unpacked: &Unpacked<PackedRegion>) -> Reading<'_> {
        match self {
            Self::Open { region, .. } => Reading::Open(region),
            Self::Packed(packed) => Reading::Unpacked(unpacked.read(packed)),
        }
    }

    /// The region to be read by who does not read it again soon.
    pub(super) fn read_once(&self, unpacked: &Unpacked<PackedRegion>) -> Reading<'_> {
        match self {
            Self::Open { region, .. } => Reading::Open(region),
            Self::Packed(packed) => {
                Reading::Unpacked(unpacked.find(packed).unwrap_or_else(|| Arc::new(packed.unpack())))
            }
        }
    }

    /// The same, open.
    pub(super) fn opened(&self, unpacked: &Unpacked<PackedRegion>) -> Self {
        match self.read_once(unpacked) {
            Reading::Open(_) => self.clone(),
            Reading::Unpacked(region) => Self::Open { region, touched: 0 },
        }
    }

    /// Of the block that changed last.
    pub(super) fn version(&self) -> u64 {
        match self {
            Self::Open { region, .. } => region.version(),
            Self::Packed(packed) => packed.version(),
        }
    }

    /// The blocks with the versions at which they changed last. O(blocks); nothing is unpacked. `at` is the region's
    /// own index.
    pub(super) fn versions(&self, at: BlockIndex) -> impl Iterator<Item = (BlockIndex, u64)> + use<'_> {
        let (open, packed) = match self {
            Self::Open { region, .. } => (Some(region), None),
            Self::Packed(packed) => (None, Some(packed.versions(at))),
        };
        let open = open.into_iter().flat_map(move |region| {
            indices(at, region.places()).zip(region.parts().iter().map(|block| block.version))
        });
        open.chain(packed.into_iter().flatten())
    }

    /// The version at which a block changed last. O(1); O(blocks) where it is packed, and nothing is unpacked.
    pub(super) fn changed_at(&self, index: BlockIndex) -> Option<u64> {
        match self {
            Self::Open { region, .. } => region.changed_at(index),
            Self::Packed(packed) => {
                let versions = packed.versions(region_of(index));
                versions.into_iter().find(|(other, _)| *other == index).map(|(_, version)| version)
            }
        }
    }

    /// Whether it is the same one, of a map and its copy.
    pub(super) fn is_shared_with(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Open { region, .. }, Self::Open { region: other, .. }) => Arc::ptr_eq(region, other),
            (Self::Packed(packed), Self::Packed(other)) => Arc::ptr_eq(packed, other),
            _ => false,
        }
    }

    /// Bytes on the heap.
    pub(super) fn memory_bytes(&self) -> usize {
        match self {
            Self::Open { region, .. } => region.memory_bytes(),
            Self::Packed(packed) => packed.memory_bytes(),
        }
    }

    fn has_emptied(&self) -> bool {
        match self {
            Self::Open { region, .. } => region.has_emptied(),
            Self::Packed(packed) => packed.has_emptied(),
        }
    }

    fn is_empty(&self) -> bool {
        match self {
            Self::Open { region, .. } => region.is_empty(),
            Self::Packed(packed) => packed.len() == 0,
        }
    }

    /// Blocks that are not packed.
    fn open_count(&self) -> usize {
        match self {
            Self::Open { region, .. } => region.parts().len(),
            Self::Packed(_) => 0,
        }
    }
}
