//! Tiles of present states that are told one against the other: read in their order, while later ones wait.

use core::cmp::Ordering;
use std::collections::BTreeMap;

use flockmap_codec::{Codec, ContentKind, Decoder, Package, PackageError, TilesRead};
use flockmap_grid::{PresentState, Stamp, Stream};

use crate::Refusal;

/// A present state of which nothing more was merged for so long gives way to others: as long as the session waits for tiles of one.
const STALE: i64 = 30_000_000;
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
    /// As many as the session receives at once, so that none that is still received has to go for another.
    sets_max: usize,
    bytes_max: usize,
    /// Sets opened so far.
    opened: u64,
}

/// Which present state of which stream: its tiles belong together.
pub(crate) type SetId = (Stream, u32);

/// A present state as far as it has been read.
pub(crate) struct TileSet {
    id: SetId,
    upto: u32,
    /// Which one it is of all that were opened: the lower, the earlier.
    number: u64,
    /// When something of it was merged last, or it was opened.
    progress_at: Stamp,
    read: TilesRead,
    /// Read, but there was no room for it in the layer yet: the tile before the next one.
    pub(crate) unmerged: Option<PresentState>,
    waiting: BTreeMap<u32, Package>,
}

impl Tiles {
    pub(crate) const fn new(sets_max: usize, layer_bytes_max: usize) -> Self {
        Self { sets: Vec::new(), sets_max, bytes_max: bytes_max(layer_bytes_max), opened: 0 }
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

    /// The present state of a tile, begun if need be. Returns the one too that had to go for it: one that the session does not receive any more,
    /// else the one that was left alone longest.
    pub(crate) fn open(
        &mut self,
        now: Stamp,
        id: SetId,
        upto: u32,
        is_received: impl Fn(SetId) -> bool,
    ) -> (&mut TileSet, Option<SetId>) {
        let at = self.sets.iter().position(|set| set.id == id);
        let mut dropped = None;
        let set = match at {
            Some(at) => self.sets.remove(at),
            None => {
                if self.sets.len() >= self.sets_max {
                    let ended = self.sets.iter().position(|set| !is_received(set.id));
                    dropped = Some(self.sets.remove(ended.unwrap_or(0)).id);
                }
                self.opened += 1;
                let (read, waiting) = (TilesRead::default(), BTreeMap::new());
                TileSet { id, upto, number: self.opened, progress_at: now, read, unmerged: None, waiting }
            }
        };
        self.sets.push(set);
        // Just pushed.
        let last = self.sets.len() - 1;
        (&mut self.sets[last], dropped)
    }

    /// Makes room for a tile of the present state that was opened last. Returns those that had to go for it: such as were opened later, or of
    /// which nothing was merged for 30 s. So the one that was opened first always goes on, and all become complete one after the other.
    ///
    /// # Errors
    /// [`Refusal::Tiles`] if the others leave too little, or it would not fit even alone; nothing goes then.
    pub(crate) fn make_room(&mut self, now: Stamp, tile: &Package) -> Result<Vec<SetId>, Refusal> {
        let Some((last, others)) = self.sets.split_last().filter(|(last, _)| last.unmerged.is_none()) else {
            return Ok(Vec::new());
        };
        let is_stale = |set: &TileSet| now.micros_since(set.progress_at) >= STALE;
        let (mut sum, max) = (last.read.memory_bytes_with(tile), self.bytes_max);
        let refused = Refusal::Tiles { held: last.read.memory_bytes(), max };
        // First those that must stay, then the others, of which as many stay as fit.
        let mut others: Vec<_> = others.iter().map(|set| ((is_stale(set), set.number), set)).collect();
        others.sort_unstable_by_key(|(place, _)| *place);
        let mut gone = Vec::new();
        for (place, set) in others {
            let bytes = set.read.memory_bytes();
            if sum + bytes <= max {
                sum += bytes;
            } else if place > (false, last.number) {
                gone.push(set.id);
            } else {
                return Err(refused);
            }
        }
        if sum > max {
            return Err(refused);
        }
        self.sets.retain(|set| !gone.contains(&set.id));
        Ok(gone)
    }

    pub(crate) fn get_mut(&mut self, id: SetId) -> Option<&mut TileSet> {
        self.sets.iter_mut().find(|set| set.id == id)
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

    /// Notes that the tile whose turn it was is in the layer.
    pub(crate) const fn note_merged(&mut self, now: Stamp) {
        self.progress_at = now;
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
    use flockmap_codec::Encoder;
    use flockmap_grid::{Changes, Layer, Resolution, RobotId, State, Voxel};

    fn id(set: u32) -> SetId {
        (Stream { origin: RobotId(set as u16 % 3), epoch: 1 }, set)
    }

    fn open(tiles: &mut Tiles, number: u32, upto: u32) -> Option<SetId> {
        tiles.open(Stamp(0), id(number), upto, |id| id.1 != 2).1
    }

    #[test]
    fn one_that_is_not_received_any_more_goes_first_and_then_the_one_left_alone_longest() {
        let mut tiles = Tiles::new(4, 0);
        for set in 0..4 {
            assert_eq!(open(&mut tiles, set, 10 + set), None);
        }
        assert_eq!(open(&mut tiles, 0, 10), None);
        assert_eq!(open(&mut tiles, 77, 99), Some(id(2)));
        assert_eq!(open(&mut tiles, 78, 99), Some(id(1)));
        assert_eq!(tiles.sets.len(), 4);
        tiles.drop_set(id(77));
        tiles.drop_set(id(78));
        // 0 and 3 are of one stream, up to packages 10 and 13.
        tiles.drop_upto(id(0).0, 12);
        let left: Vec<SetId> = tiles.sets.iter().map(|set| set.id).collect();
        assert_eq!(left, [id(3)]);
    }

    /// The tiles of some walls; and room for two of which one tile was read, and not for the second tile of both.
    fn walls() -> (Vec<Package>, usize) {
        let wall =
            |x| (0..64).flat_map(move |y| (0..64).map(move |z| (Voxel::new(x, y, z), State::Occupied)));
        let mut layer = Layer::default();
        layer.apply(&Changes::from_voxels((0..40).flat_map(|n| wall(5 * n + n * n % 3))), Stamp(1));
        let state = layer.present_state().unwrap();
        let resolution = Resolution::from_micrometres(100_000).unwrap();
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        let tiles = Encoder::new().encode_present(Codec::Flock, stream, 9, resolution, &state, 400).unwrap();
        assert!(tiles.len() >= 3, "{} tiles", tiles.len());
        let mut read = TilesRead::default();
        let first = read.memory_bytes_with(&tiles[0]);
        Decoder::new().decode_tile(&tiles[0], &mut read).unwrap();
        let room = read.memory_bytes_with(&tiles[1]).max(read.memory_bytes() + first);
        (tiles, room)
    }

    #[test]
    fn who_came_first_goes_on_and_who_stands_still_gives_way() {
        let (walls, room) = walls();
        let mut tiles = Tiles::new(8, 0);
        const NONE: [u32; 0] = [];
        let mut decoder = Decoder::new();
        // A tile of one of them, at a time: what had to go for it, or that there is no room.
        let mut give = |tiles: &mut Tiles, now: Stamp, set: u32, tile: usize| {
            let _ = tiles.open(now, id(set), 9, |_| true);
            let gone = tiles.make_room(now, &walls[tile])?;
            let set = tiles.get_mut(id(set)).unwrap();
            set.read(&mut decoder, &walls[tile]).unwrap();
            set.note_merged(now);
            Ok::<_, Refusal>(gone.into_iter().map(|(_, set)| set).collect::<Vec<_>>())
        };
        let now = Stamp(0);
        tiles.bytes_max = room;
        assert_eq!(give(&mut tiles, now, 1, 0).unwrap(), NONE);
        assert_eq!(give(&mut tiles, now, 2, 0).unwrap(), NONE);
        assert!(give(&mut tiles, now, 3, 0).is_err());
        assert!(give(&mut tiles, now, 2, 1).is_err());
        assert_eq!(tiles.sets.len(), 3, "nothing goes where something is refused");
        assert_eq!(give(&mut tiles, now, 1, 1).unwrap(), [2]);
        // The first stands still: for the time of a transfer it keeps its place.
        assert!(give(&mut tiles, Stamp(STALE - 1), 3, 0).is_err());
        assert_eq!(give(&mut tiles, Stamp(STALE), 3, 0).unwrap(), [1]);
    }
}
