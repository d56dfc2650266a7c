//! Present states whose tiles are told one against the other: handed out in their order, while later ones wait.

use flockmap_codec::{Codec, ContentKind, Package};
use flockmap_grid::Stream;
use std::cmp::Ordering;
use std::collections::BTreeMap;

/// Present states, of those whose tiles are told one against the other, that are handed out side by side.
pub const STATES_READ_MAX: usize = 4;
/// Tiles of one present state that may wait for the ones before them.
pub(crate) const TILES_WAITING_MAX: usize = 256;

/// Which present state of which stream: its tiles belong together, whoever they come from.
pub(crate) type ChainId = (Stream, u32);

/// The present states that are being read; the one of which a tile came last comes last.
#[derive(Debug, Default)]
pub(crate) struct Chains(Vec<Chain>);

#[derive(Debug)]
struct Chain {
    id: ChainId,
    upto: u32,
    /// The first tile that is not merged yet.
    next: u32,
    waiting: BTreeMap<u32, Package>,
}

/// Where a tile stands.
#[derive(PartialEq, Eq, Debug)]
pub(crate) enum Place {
    /// It was merged before.
    Merged,
    Next,
    /// After the ones before it.
    Later,
}

impl Chains {
    /// The present state that a tile belongs to, and its number, if it is told against the tiles before it.
    pub(crate) fn place_of(package: &Package) -> Option<(ChainId, u32)> {
        let header = package.header();
        match header.content {
            ContentKind::Present { set, tile, .. } if header.codec == Codec::Flock => {
                Some(((header.stream, set), tile))
            }
            _ => None,
        }
    }

    /// Makes a place for the present state of a tile, if it has none. Returns the one that had to go for it: the one that was left alone longest.
    pub(crate) fn open(&mut self, id: ChainId, upto: u32) -> Option<ChainId> {
        let mut dropped = None;
        let chain = match self.0.iter().position(|chain| chain.id == id) {
            Some(at) => self.0.remove(at),
            None => {
                if self.0.len() >= STATES_READ_MAX {
                    dropped = Some(self.0.remove(0).id);
                }
                Chain { id, upto, next: 0, waiting: BTreeMap::new() }
            }
        };
        self.0.push(chain);
        dropped
    }

    /// Where a tile stands in a present state that is [open](Self::open).
    pub(crate) fn place(&self, id: ChainId, tile: u32) -> Place {
        let next = self.0.iter().find(|chain| chain.id == id).map_or(0, |chain| chain.next);
        match tile.cmp(&next) {
            Ordering::Less => Place::Merged,
            Ordering::Equal => Place::Next,
            Ordering::Greater => Place::Later,
        }
    }

    /// Lets a tile wait. Returns the one that has to go for it, the highest.
    pub(crate) fn wait(&mut self, id: ChainId, tile: u32, package: Package) -> Option<Package> {
        let Some(chain) = self.chain(id) else { return Some(package) };
        chain.waiting.insert(tile, package);
        if chain.waiting.len() <= TILES_WAITING_MAX {
            return None;
        }
        chain.waiting.pop_last().map(|(_, package)| package)
    }

    /// Notes that a tile was merged.
    pub(crate) fn note_merged(&mut self, id: ChainId, tile: u32) {
        if let Some(chain) = self.chain(id)
            && chain.next == tile
        {
            chain.next += 1;
        }
    }

    /// The tile that comes next, if it is here.
    pub(crate) fn take_next(&mut self, id: ChainId) -> Option<Package> {
        let chain = self.chain(id)?;
        chain.waiting.remove(&chain.next)
    }

    /// Lets go of a present state.
    pub(crate) fn drop_one(&mut self, id: ChainId) {
        self.0.retain(|chain| chain.id != id);
    }

    /// Lets go of the present states of a stream that say nothing beyond a package.
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
    fn the_present_state_that_was_left_alone_longest_goes() {
        let mut chains = Chains::default();
        for set in 0..STATES_READ_MAX as u32 {
            assert_eq!(chains.open(id(set), 10 + set), None);
        }
        assert_eq!(chains.open(id(0), 10), None);
        assert_eq!(chains.open(id(77), 99), Some(id(1)));
        assert_eq!(chains.0.len(), STATES_READ_MAX);
        chains.drop_one(id(77));
        assert_eq!(chains.0.len(), STATES_READ_MAX - 1);
        // 0 and 3 are of one stream, up to packages 10 and 13.
        chains.drop_upto(id(0).0, 12);
        let left: Vec<ChainId> = chains.0.iter().map(|chain| chain.id).collect();
        assert_eq!(left, [id(2), id(3)]);
    }

    #[test]
    fn a_tile_is_next_once_all_before_it_are_merged() {
        let mut chains = Chains::default();
        chains.open(id(0), 9);
        assert_eq!([0, 1].map(|tile| chains.place(id(0), tile)), [Place::Next, Place::Later]);
        // Not its turn: nothing changes.
        chains.note_merged(id(0), 1);
        chains.note_merged(id(0), 0);
        assert_eq!([0, 1].map(|tile| chains.place(id(0), tile)), [Place::Merged, Place::Next]);
        assert!(chains.take_next(id(0)).is_none());
    }
}
