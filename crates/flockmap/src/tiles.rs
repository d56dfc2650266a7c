//! Tiles of present states that are told one against the other: read in their order, while later ones wait.

use core::cmp::Ordering;
use std::collections::BTreeMap;

use flockmap_codec::{Codec, ContentKind, Decoder, Package, PackageError, TilesRead};
use flockmap_grid::{PresentState, Stream};

use crate::Refusal;

/// Present states that are read side by side.
pub(crate) const SETS_MAX: usize = 4;
/// So many bytes they may hold together at least, however small the layers are: more than one tile can need.
const BYTES_MIN: usize = 8 << 20;
/// Tiles of one present state that may wait for the ones before them.
pub(crate) const WAITING_MAX: usize = 256;

/// Bytes that the present states being read may hold together: half of what layers may hold.
pub(crate) const fn bytes_max(layer_bytes_max: usize) -> usize {
    let half = layer_bytes_max / 2;
    if half > BYTES_MIN { half } else { BYTES_MIN }
}

/// The present states that are being read; the one that was added to last comes last.
pub(crate) struct Tiles {
    sets: Vec<TileSet>,
    bytes_max: usize,
}

/// Which present state of which stream: its tiles belong together.
pub(crate) type SetId = (Stream, u32);

/// A present state as far as it has been read.
pub(crate) struct TileSet {
    id: SetId,
    upto: u32,
    read: TilesRead,
    /// Read, but there was no room for it in the layer yet: the tile before the next one.
    pub(crate) unmerged: Option<PresentState>,
    waiting: BTreeMap<u32, Package>,
}

impl Tiles {
    pub(crate) const fn new(layer_bytes_max: usize) -> Self {
        Self { sets: Vec::new(), bytes_max: bytes_max(layer_bytes_max) }
    }

    /// The present state that a tile belongs to, and its number, if it is told against the tiles before it.
    pub(crate) fn place_of(package: &Package) -> Option<(SetId, u32)> {
        let header = package.header();
        match header.content {
            ContentKind::Present { set, tile, .. } if header.codec == Codec::Flock => {
                Some(((header.stream, set), tile))
            }
            _ => None,
        }
    }

    /// The present state of a tile, begun if need be. Returns the one too that had to go for it.
    pub(crate) fn open(&mut self, id: SetId, upto: u32) -> (&mut TileSet, Option<SetId>) {
        let at = self.sets.iter().position(|set| set.id == id);
        let mut dropped = None;
        let set = match at {
            Some(at) => self.sets.remove(at),
            None => {
                if self.sets.len() >= SETS_MAX {
                    dropped = Some(self.sets.remove(0).id);
                }
                let (read, waiting) = (TilesRead::default(), BTreeMap::new());
                TileSet { id, upto, read, unmerged: None, waiting }
            }
        };
        self.sets.push(set);
        // Just pushed.
        let last = self.sets.len() - 1;
        (&mut self.sets[last], dropped)
    }

    /// Makes room for a tile of the present state that was opened last. Returns those that had to go for it: first the ones that were left alone
    /// longest.
    ///
    /// # Errors
    /// [`Refusal::Tiles`] if it would not fit even alone; nothing goes then.
    pub(crate) fn make_room(&mut self, tile: &Package) -> Result<Vec<SetId>, Refusal> {
        let Some((last, others)) = self.sets.split_last().filter(|(last, _)| last.unmerged.is_none()) else {
            return Ok(Vec::new());
        };
        let (mut sum, max) = (last.read.memory_bytes_with(tile), self.bytes_max);
        if sum > max {
            return Err(Refusal::Tiles { held: last.read.memory_bytes(), max });
        }
        let fits = |set: &&TileSet| {
            sum += set.read.memory_bytes();
            sum <= max
        };
        let kept = others.iter().rev().take_while(fits).count();
        let gone = others.len() - kept;
        Ok(self.sets.drain(..gone).map(|set| set.id).collect())
    }

    /// Lets go of a present state.
    pub(crate) fn drop_set(&mut self, id: SetId) {
        self.sets.retain(|set| set.id != id);
    }

    /// Lets go of the present states of a stream that say nothing beyond a package.
    pub(crate) fn drop_upto(&mut self, stream: Stream, upto: u32) {
        self.sets.retain(|set| set.id.0 != stream || set.upto > upto);
    }
}

/// When a tile can be read.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Turn {
    /// It was read and merged before.
    Past,
    Now,
    /// When the ones before it have been.
    Later,
}

impl TileSet {
    pub(crate) fn turn_of(&self, tile: u32) -> Turn {
        let next = self.read.next() - u32::from(self.unmerged.is_some());
        match tile.cmp(&next) {
            Ordering::Less => Turn::Past,
            Ordering::Equal => Turn::Now,
            Ordering::Greater => Turn::Later,
        }
    }

    /// What the tile says whose turn it is. After an error the present state has to be read anew.
    pub(crate) fn read(
        &mut self,
        decoder: &mut Decoder,
        package: &Package,
    ) -> Result<PresentState, PackageError> {
        match self.unmerged.take() {
            Some(state) => Ok(state),
            None => decoder.decode_tile(package, &mut self.read),
        }
    }

    /// Lets a tile wait. Returns the one that has to go for it, the highest.
    pub(crate) fn wait(&mut self, tile: u32, package: Package) -> Option<Package> {
        self.waiting.insert(tile, package);
        if self.waiting.len() <= WAITING_MAX {
            return None;
        }
        self.waiting.pop_last().map(|(_, package)| package)
    }

    /// The tile that comes next, if it is here.
    pub(crate) fn take_next(&mut self) -> Option<Package> {
        self.waiting.remove(&self.read.next())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::RobotId;

    fn id(set: u32) -> SetId {
        (Stream { origin: RobotId(set as u16 % 3), epoch: 1 }, set)
    }

    #[test]
    fn the_present_state_that_was_left_alone_longest_goes() {
        let mut tiles = Tiles::new(0);
        for set in 0..SETS_MAX as u32 {
            assert_eq!(tiles.open(id(set), 10 + set).1, None);
        }
        assert_eq!(tiles.open(id(0), 10).1, None);
        assert_eq!(tiles.open(id(77), 99).1, Some(id(1)));
        assert_eq!(tiles.sets.len(), SETS_MAX);
        tiles.drop_set(id(77));
        assert_eq!(tiles.sets.len(), SETS_MAX - 1);
        // 0 and 3 are of one stream, up to packages 10 and 13.
        tiles.drop_upto(id(0).0, 12);
        let left: Vec<SetId> = tiles.sets.iter().map(|set| set.id).collect();
        assert_eq!(left, [id(2), id(3)]);
    }
}
