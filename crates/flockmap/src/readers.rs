//! Snapshots whose chunks build on one another, as far as they have been read.

use core::time::Duration;
use flockmap_codec::{ChunksRead, Codec, ContentKind, Decoder, Package, PackageError};
use flockmap_grid::{DiscardedLayer, Snapshot, Stamp, Stream};

use crate::Refusal;

/// So many bytes they may hold together at least, however small the layers are: more than one chunk can need.
const BYTES_MIN: usize = 8 << 20;

/// A snapshot of which nothing more was merged for so long goes for others: as long as the session waits for
/// chunks of one.
const STALE: Duration = Duration::from_secs(30);

/// Blocks that are let go of in one call, some 0.2 µs each.
const FREED_BLOCKS: usize = 2_048;

/// Bytes that the snapshots being read may hold together: half of what layers may hold.
pub(crate) const fn bytes_max(layer_bytes_max: usize) -> usize {
    let half = layer_bytes_max / 2;
    if half > BYTES_MIN { half } else { BYTES_MIN }
}

/// Which snapshot of which stream: its chunks belong together.
pub(crate) type SnapshotId = (Stream, u32);

/// The snapshots that are being read, as many as the session hands out chunks of.
pub(crate) struct Readers {
    readers: Vec<Reader>,
    bytes_max: usize,
    /// Snapshots begun so far.
    begun: u64,
    /// What was read of those that are gone, as far as it was not let go of yet.
    discarded: Vec<DiscardedLayer>,
}

struct Reader {
    id: SnapshotId,
    upto: u32,
    /// Which one it is of all that were begun: the lower, the earlier.
    number: u64,
    /// When something of it was merged last, or it was begun.
    progress_at: Stamp,
    read: ChunksRead,
    /// Read, but there was no room for it in the layer yet: the chunk before the next one.
    unmerged: Option<Snapshot>,
}

impl Readers {
    pub(crate) const fn new(layer_bytes_max: usize) -> Self {
        let bytes_max = bytes_max(layer_bytes_max);
        Self { readers: Vec::new(), bytes_max, begun: 0, discarded: Vec::new() }
    }

    /// The snapshot that a chunk belongs to, if it builds on the chunks before it.
    pub(crate) fn snapshot_of(package: &Package) -> Option<SnapshotId> {
        let header = package.header();
        match header.content {
            ContentKind::Snapshot { id: snapshot_id, .. } if header.codec == Codec::Flock => {
                Some((header.stream, snapshot_id))
            }
            _ => None,
        }
    }

    /// Makes room for the next chunk of a snapshot. Returns those that had to go for it: such as were begun
    /// later, or of which nothing was merged for 30 s. So the one that was begun first always goes on, and
    /// all become complete one after the other.
    ///
    /// # Errors
    /// [`Refusal::Chunks`] if the others leave too little, or it would not fit even alone; nothing goes then.
    pub(crate) fn make_room(
        &mut self,
        now: Stamp,
        id: SnapshotId,
        chunk: &Package,
    ) -> Result<Vec<SnapshotId>, Refusal> {
        let max = self.bytes_max;
        let discarded: usize = self.discarded.iter().map(DiscardedLayer::memory_bytes).sum();
        let reader = self.open(now, id, chunk.header().index);
        if reader.unmerged.is_some() {
            return Ok(Vec::new());
        }
        let (number, received, mut sum) =
            (reader.number, reader.read.memory_bytes(), discarded + reader.read.memory_bytes_with(chunk));
        let refused = Refusal::Chunks { received, max };
        // First those that stay whatever comes, then the others, of which as many stay as fit.
        let rank = |reader: &Reader| (now.since(reader.progress_at) >= STALE, reader.number);
        let others = self.readers.iter().filter(|other| other.id != id);
        let mut others: Vec<_> = others.map(|other| (rank(other), other)).collect();
        others.sort_unstable_by_key(|(rank, _)| *rank);
        let mut gone = Vec::new();
        for (rank, other) in others {
            let bytes = other.read.memory_bytes();
            if sum + bytes <= max {
                sum += bytes;
            } else if rank > (false, number) {
                gone.push(other.id);
            } else {
                return Err(refused);
            }
        }
        if sum > max {
            return Err(refused);
        }
        self.keep_those(|reader| !gone.contains(&reader.id));
        Ok(gone)
    }

    /// What the next chunk of a snapshot says. After an error it has to be read anew from its first chunk on.
    pub(crate) fn read(
        &mut self,
        now: Stamp,
        id: SnapshotId,
        decoder: &mut Decoder,
        chunk: &Package,
    ) -> Result<Snapshot, PackageError> {
        let reader = self.open(now, id, chunk.header().index);
        match reader.unmerged.take() {
            Some(state) => Ok(state),
            None => decoder.decode_chunk(chunk, &mut reader.read),
        }
    }

    /// Keeps what a chunk says for when there is room for it.
    pub(crate) fn keep(&mut self, id: SnapshotId, state: Snapshot) {
        if let Some(reader) = self.readers.iter_mut().find(|reader| reader.id == id) {
            reader.unmerged = Some(state);
        }
    }

    /// Lets go of a snapshot.
    pub(crate) fn drop_one(&mut self, id: SnapshotId) {
        self.keep_those(|reader| reader.id != id);
    }

    /// Lets go of the snapshots of a stream that say nothing beyond a package.
    pub(crate) fn drop_upto(&mut self, stream: Stream, upto: u32) {
        self.keep_those(|reader| reader.id.0 != stream || reader.upto > upto);
    }

    fn keep_those(&mut self, is_kept: impl Fn(&Reader) -> bool) {
        let gone = self.readers.extract_if(.., |reader| !is_kept(reader));
        self.discarded.extend(gone.flat_map(|reader| reader.read.discard()));
    }

    /// Lets go of some of what was read of those that are gone.
    pub(crate) fn free(&mut self) {
        if self.discarded.last_mut().is_some_and(|discarded| discarded.free(FREED_BLOCKS) == 0) {
            self.discarded.pop();
        }
    }

    pub(crate) const fn is_any_discarded(&self) -> bool {
        !self.discarded.is_empty()
    }

    /// Notes that what a chunk of a snapshot says is in the layer.
    pub(crate) fn note_merged(&mut self, now: Stamp, id: SnapshotId) {
        if let Some(reader) = self.readers.iter_mut().find(|reader| reader.id == id) {
            reader.progress_at = now;
        }
    }

    /// The reader of a snapshot, begun if need be.
    fn open(&mut self, now: Stamp, id: SnapshotId, upto: u32) -> &mut Reader {
        let at = self.readers.iter().position(|reader| reader.id == id).unwrap_or_else(|| {
            self.begun += 1;
            let (number, read) = (self.begun, ChunksRead::default());
            self.readers.push(Reader { id, upto, number, progress_at: now, read, unmerged: None });
            self.readers.len() - 1
        });
        &mut self.readers[at]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_codec::Encoder;
    use flockmap_grid::{Changes, Layer, Resolution, RobotId, State, Voxel};

    fn id(number: u32) -> SnapshotId {
        (Stream { origin: RobotId(number as u16), epoch: 1 }, number)
    }

    /// The chunks of some walls; and room for two of which one chunk was read, and not for the second chunk
    /// of both.
    fn walls() -> (Vec<Package>, usize) {
        let wall =
            |x| (0..64).flat_map(move |y| (0..64).map(move |z| (Voxel::new(x, y, z), State::Occupied)));
        let mut layer = Layer::default();
        layer.apply(&Changes::from_voxels((0..40).flat_map(|n| wall(5 * n + n * n % 3))), Stamp(1));
        let state = layer.snapshot().unwrap();
        let resolution = Resolution::from_micrometres(100_000).unwrap();
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        let chunks =
            Encoder::new().encode_snapshot(Codec::Flock, stream, 9, resolution, &state, 500).unwrap();
        assert!(chunks.len() >= 3, "{} chunks", chunks.len());
        let mut read = ChunksRead::default();
        let first = read.memory_bytes_with(&chunks[0]);
        Decoder::new().decode_chunk(&chunks[0], &mut read).unwrap();
        let room = read.memory_bytes_with(&chunks[1]).max(read.memory_bytes() + first);
        assert!(
            room < read.memory_bytes() + read.memory_bytes_with(&chunks[1]),
            "chunks of about one length"
        );
        (chunks, room)
    }

    #[test]
    fn who_came_first_goes_on_and_who_stands_still_gives_way() {
        let (walls, room) = walls();
        let mut readers = Readers::new(0);
        const NONE: [u32; 0] = [];
        let mut decoder = Decoder::new();
        // A chunk of one of them, at a time: what had to go for it, or that there is no room.
        let mut give = |readers: &mut Readers, now: Stamp, number: u32, chunk: usize| {
            let gone = readers.make_room(now, id(number), &walls[chunk])?;
            readers.read(now, id(number), &mut decoder, &walls[chunk]).unwrap();
            readers.note_merged(now, id(number));
            Ok::<_, Refusal>(gone.into_iter().map(|(_, number)| number).collect::<Vec<_>>())
        };
        let now = Stamp(0);
        readers.bytes_max = room;
        assert_eq!(give(&mut readers, now, 1, 0).unwrap(), NONE);
        assert_eq!(give(&mut readers, now, 2, 0).unwrap(), NONE);
        assert!(give(&mut readers, now, 3, 0).is_err());
        assert!(give(&mut readers, now, 2, 1).is_err());
        assert_eq!(readers.readers.len(), 3, "nothing goes where something is refused");
        assert_eq!(give(&mut readers, now, 1, 1).unwrap(), [2]);
        // The first stands still: for the time of a transfer it keeps its place.
        assert!(give(&mut readers, Stamp(0).plus(STALE - Duration::from_micros(1)), 3, 0).is_err());
        assert_eq!(give(&mut readers, Stamp(0).plus(STALE), 3, 0).unwrap(), [1]);
    }
}
