//! Snapshots whose chunks build on one another: given out in their order, while later ones wait.

use flockmap_codec::{Codec, ContentKind, Package};
use flockmap_grid::Stream;
use std::cmp::Ordering;
use std::collections::BTreeMap;

/// Chunks of one snapshot that may wait for the ones before them.
pub(crate) const CHUNKS_WAITING_MAX: usize = 256;

/// Which snapshot of which stream: its chunks belong together, whoever they come from.
pub(crate) type ChainId = (Stream, u32);

/// The snapshots that are being read; the one of which a chunk came last comes last.
#[derive(Debug)]
pub(crate) struct Chains {
    chains: Vec<Chain>,
    /// As many as are received at once, so that none that is still received has to go for another.
    max: usize,
}

#[derive(Debug)]
struct Chain {
    id: ChainId,
    upto: u32,
    /// The first chunk that is not merged yet.
    next: u32,
    waiting: BTreeMap<u32, Package>,
    /// What was merged of it may be gone again.
    is_spoiled: bool,
}

/// Where a chunk stands.
#[derive(PartialEq, Eq, Debug)]
pub(crate) enum Place {
    /// It was merged before.
    Merged,
    Next,
    /// After the ones before it.
    Later,
}

impl Chains {
    /// For so many snapshots, at least 1.
    pub(crate) const fn new(max: usize) -> Self {
        Self { chains: Vec::new(), max }
    }

    /// The snapshot that a chunk belongs to, and its number, if it builds on the chunks before it.
    pub(crate) fn place_of(package: &Package) -> Option<(ChainId, u32)> {
        let header = package.header();
        match header.content {
            ContentKind::Snapshot { id: snapshot_id, chunk, .. } if header.codec == Codec::Flock => {
                Some(((header.stream, snapshot_id), chunk))
            }
            _ => None,
        }
    }

    /// Makes a place for the snapshot of a chunk, if it has none. Returns the one that had to go for it: one
    /// that is not received any more, else the one that was left alone longest.
    pub(crate) fn open(
        &mut self,
        id: ChainId,
        upto: u32,
        is_received: impl Fn(ChainId) -> bool,
    ) -> Option<ChainId> {
        let mut dropped = None;
        let chain = match self.chains.iter().position(|chain| chain.id == id) {
            Some(at) => self.chains.remove(at),
            None => {
                if self.chains.len() >= self.max {
                    let ended = self.chains.iter().position(|chain| !is_received(chain.id));
                    dropped = Some(self.chains.remove(ended.unwrap_or(0)).id);
                }
                Chain { id, upto, next: 0, waiting: BTreeMap::new(), is_spoiled: false }
            }
        };
        self.chains.push(chain);
        dropped
    }

    /// Where a chunk stands in a snapshot that is [open](Self::open).
    pub(crate) fn place(&self, id: ChainId, chunk: u32) -> Place {
        let next = self.chains.iter().find(|chain| chain.id == id).map_or(0, |chain| chain.next);
        match chunk.cmp(&next) {
            Ordering::Less => Place::Merged,
            Ordering::Equal => Place::Next,
            Ordering::Greater => Place::Later,
        }
    }

    /// Lets a chunk wait. Returns the one that has to go for it, the highest.
    pub(crate) fn wait(&mut self, id: ChainId, chunk: u32, package: Package) -> Option<Package> {
        let Some(chain) = self.chain(id) else { return Some(package) };
        chain.waiting.insert(chunk, package);
        if chain.waiting.len() <= CHUNKS_WAITING_MAX {
            return None;
        }
        chain.waiting.pop_last().map(|(_, package)| package)
    }

    /// Notes that a chunk was merged.
    pub(crate) fn note_merged(&mut self, id: ChainId, chunk: u32) {
        if let Some(chain) = self.chain(id)
            && chain.next == chunk
        {
            chain.next += 1;
        }
    }

    /// The chunk that comes next, if it is here.
    pub(crate) fn take_next(&mut self, id: ChainId) -> Option<Package> {
        let chain = self.chain(id)?;
        chain.waiting.remove(&chain.next)
    }

    /// Whether there is one.
    pub(crate) fn has(&self, id: ChainId) -> bool {
        self.chains.iter().any(|chain| chain.id == id)
    }

    /// What was merged of a stream so far may be gone again.
    pub(crate) fn spoil(&mut self, stream: Stream) {
        let of_stream = self.chains.iter_mut().filter(|chain| chain.id.0 == stream);
        of_stream.for_each(|chain| chain.is_spoiled = true);
    }

    /// Whether what was merged of a snapshot may be gone again.
    pub(crate) fn is_spoiled(&self, id: ChainId) -> bool {
        self.chains.iter().any(|chain| chain.id == id && chain.is_spoiled)
    }

    /// Lets go of a snapshot.
    pub(crate) fn drop_one(&mut self, id: ChainId) {
        self.chains.retain(|chain| chain.id != id);
    }

    /// Lets go of the snapshots of a stream that say nothing beyond a package.
    pub(crate) fn drop_upto(&mut self, stream: Stream, upto: u32) {
        self.chains.retain(|chain| chain.id.0 != stream || chain.upto > upto);
    }

    fn chain(&mut self, id: ChainId) -> Option<&mut Chain> {
        self.chains.iter_mut().find(|chain| chain.id == id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::RobotId;

    fn id(snapshot_id: u32) -> ChainId {
        (Stream { origin: RobotId(snapshot_id as u16 % 3), epoch: 1 }, snapshot_id)
    }

    fn open(chains: &mut Chains, number: u32, upto: u32) -> Option<ChainId> {
        chains.open(id(number), upto, |id| id.1 != 2)
    }

    #[test]
    fn one_that_is_not_received_any_more_goes_first_and_then_the_one_left_alone_longest() {
        let mut chains = Chains::new(4);
        for number in 0..4 {
            assert_eq!(open(&mut chains, number, 10 + number), None);
        }
        assert_eq!(open(&mut chains, 0, 10), None);
        assert_eq!(open(&mut chains, 77, 99), Some(id(2)));
        assert_eq!(open(&mut chains, 78, 99), Some(id(1)));
        assert_eq!(chains.chains.len(), 4);
        chains.drop_one(id(77));
        chains.drop_one(id(78));
        // 0 and 3 are of one stream, up to packages 10 and 13.
        chains.drop_upto(id(0).0, 12);
        let left: Vec<ChainId> = chains.chains.iter().map(|chain| chain.id).collect();
        assert_eq!(left, [id(3)]);
    }

    #[test]
    fn a_chunk_is_next_once_all_before_it_are_merged() {
        let mut chains = Chains::new(4);
        open(&mut chains, 0, 9);
        assert_eq!([0, 1].map(|chunk| chains.place(id(0), chunk)), [Place::Next, Place::Later]);
        // Not its turn: nothing changes.
        chains.note_merged(id(0), 1);
        chains.note_merged(id(0), 0);
        assert_eq!([0, 1].map(|chunk| chains.place(id(0), chunk)), [Place::Merged, Place::Next]);
        assert!(chains.take_next(id(0)).is_none());
    }
}
