//! Snapshots whose chunks are told one against the other: handed out in their order, while later ones wait.

use flockmap_codec::{Codec, ContentKind, Package};
use flockmap_grid::Stream;
use std::cmp::Ordering;
use std::collections::BTreeMap;

/// Snapshots, of those whose chunks are told one against the other, that are handed out side by side.
pub const SNAPSHOTS_READ_MAX: usize = 4;
/// Chunks of one snapshot that may wait for the ones before them.
pub(crate) const CHUNKS_WAITING_MAX: usize = 256;

/// Which snapshot of which stream: its chunks belong together, whoever they come from.
pub(crate) type ChainId = (Stream, u32);

/// The snapshots that are being read; the one of which a chunk came last comes last.
#[derive(Debug, Default)]
pub(crate) struct Chains(Vec<Chain>);

#[derive(Debug)]
struct Chain {
    id: ChainId,
    upto: u32,
    /// The first chunk that is not merged yet.
    next: u32,
    waiting: BTreeMap<u32, Package>,
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
    /// The snapshot that a chunk belongs to, and its number, if it is told against the chunks before it.
    pub(crate) fn place_of(package: &Package) -> Option<(ChainId, u32)> {
        let header = package.header();
        match header.content {
            ContentKind::Snapshot { set, chunk, .. } if header.codec == Codec::Flock => {
                Some(((header.stream, set), chunk))
            }
            _ => None,
        }
    }

    /// Makes a place for the snapshot of a chunk, if it has none. Returns the one that had to go for it: the one that was left alone longest.
    pub(crate) fn open(&mut self, id: ChainId, upto: u32) -> Option<ChainId> {
        let mut dropped = None;
        let chain = match self.0.iter().position(|chain| chain.id == id) {
            Some(at) => self.0.remove(at),
            None => {
                if self.0.len() >= SNAPSHOTS_READ_MAX {
                    dropped = Some(self.0.remove(0).id);
                }
                Chain { id, upto, next: 0, waiting: BTreeMap::new() }
            }
        };
        self.0.push(chain);
        dropped
    }

    /// Where a chunk stands in a snapshot that is [open](Self::open).
    pub(crate) fn place(&self, id: ChainId, chunk: u32) -> Place {
        let next = self.0.iter().find(|chain| chain.id == id).map_or(0, |chain| chain.next);
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

    /// Lets go of a snapshot.
    pub(crate) fn drop_one(&mut self, id: ChainId) {
        self.0.retain(|chain| chain.id != id);
    }

    /// Lets go of the snapshots of a stream that say nothing beyond a package.
    pub(crate) fn drop_upto(&mut self, stream: Stream, upto: u32) {
        self.0.retain(|chain| chain.id.0 != stream || chain.upto > upto);
    }

    fn chain(&mut self, id: ChainId) -> Option<&mut Chain> {
        self.0.iter_mut().find(|chain| chain.id == id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::RobotId;

    fn id(set: u32) -> ChainId {
        (Stream { origin: RobotId(set as u16 % 3), epoch: 1 }, set)
    }

    #[test]
    fn the_snapshot_that_was_left_alone_longest_goes() {
        let mut chains = Chains::default();
        for set in 0..SNAPSHOTS_READ_MAX as u32 {
            assert_eq!(chains.open(id(set), 10 + set), None);
        }
        assert_eq!(chains.open(id(0), 10), None);
        assert_eq!(chains.open(id(77), 99), Some(id(1)));
        assert_eq!(chains.0.len(), SNAPSHOTS_READ_MAX);
        chains.drop_one(id(77));
        assert_eq!(chains.0.len(), SNAPSHOTS_READ_MAX - 1);
        // 0 and 3 are of one stream, up to packages 10 and 13.
        chains.drop_upto(id(0).0, 12);
        let left: Vec<ChainId> = chains.0.iter().map(|chain| chain.id).collect();
        assert_eq!(left, [id(2), id(3)]);
    }

    #[test]
    fn a_chunk_is_next_once_all_before_it_are_merged() {
        let mut chains = Chains::default();
        chains.open(id(0), 9);
        assert_eq!([0, 1].map(|chunk| chains.place(id(0), chunk)), [Place::Next, Place::Later]);
        // Not its turn: nothing changes.
        chains.note_merged(id(0), 1);
        chains.note_merged(id(0), 0);
        assert_eq!([0, 1].map(|chunk| chains.place(id(0), chunk)), [Place::Merged, Place::Next]);
        assert!(chains.take_next(id(0)).is_none());
    }
}
