//! Snapshots whose chunks are told one against the other, as far as they have been read.

use flockmap_codec::{ChunksRead, Codec, ContentKind, Decoder, Package, PackageError};
use flockmap_grid::{Snapshot, Stream};

use crate::Refusal;

/// So many bytes they may hold together at least, however small the layers are: more than one chunk can need.
const BYTES_MIN: usize = 8 << 20;

/// Bytes that the snapshots being read may hold together: half of what layers may hold.
pub(crate) const fn bytes_max(layer_bytes_max: usize) -> usize {
    let half = layer_bytes_max / 2;
    if half > BYTES_MIN { half } else { BYTES_MIN }
}

/// Which snapshot of which stream: its chunks belong together.
pub(crate) type SnapshotId = (Stream, u32);

/// The snapshots that are being read, as many as the session hands out chunks of; the one of which a chunk was read last comes last.
pub(crate) struct Readers {
    readers: Vec<Reader>,
    bytes_max: usize,
}

struct Reader {
    id: SnapshotId,
    upto: u32,
    read: ChunksRead,
    /// Read, but there was no room for it in the layer yet: the chunk before the next one.
    unmerged: Option<Snapshot>,
}

impl Readers {
    pub(crate) const fn new(layer_bytes_max: usize) -> Self {
        Self { readers: Vec::new(), bytes_max: bytes_max(layer_bytes_max) }
    }

    /// The snapshot that a chunk belongs to, if it is told against the chunks before it.
    pub(crate) fn snapshot_of(package: &Package) -> Option<SnapshotId> {
        let header = package.header();
        match header.content {
            ContentKind::Snapshot { set, .. } if header.codec == Codec::Flock => Some((header.stream, set)),
            _ => None,
        }
    }

    /// Makes room for the next chunk of a snapshot. Returns those that had to go for it: first the ones that were left alone
    /// longest.
    ///
    /// # Errors
    /// [`Refusal::Chunks`] if it would not fit even alone; nothing goes then.
    pub(crate) fn make_room(&mut self, id: SnapshotId, chunk: &Package) -> Result<Vec<SnapshotId>, Refusal> {
        let reader = self.open(id, chunk.header().index);
        if reader.unmerged.is_some() {
            return Ok(Vec::new());
        }
        let (received, mut sum) = (reader.read.memory_bytes(), reader.read.memory_bytes_with(chunk));
        let max = self.bytes_max;
        if sum > max {
            return Err(Refusal::Chunks { received, max });
        }
        let others = &self.readers[..self.readers.len() - 1];
        let fits = |reader: &&Reader| {
            sum += reader.read.memory_bytes();
            sum <= max
        };
        let gone = others.len() - others.iter().rev().take_while(fits).count();
        Ok(self.readers.drain(..gone).map(|reader| reader.id).collect())
    }

    /// What the next chunk of a snapshot says. After an error it has to be read anew from its first chunk on.
    pub(crate) fn read(
        &mut self,
        id: SnapshotId,
        decoder: &mut Decoder,
        chunk: &Package,
    ) -> Result<Snapshot, PackageError> {
        let reader = self.open(id, chunk.header().index);
        match reader.unmerged.take() {
            Some(state) => Ok(state),
            None => decoder.decode_chunk(chunk, &mut reader.read),
        }
    }

    /// Keeps what a chunk says for when there is room for it.
    pub(crate) fn keep(&mut self, id: SnapshotId, chunk: &Package, state: Snapshot) {
        self.open(id, chunk.header().index).unmerged = Some(state);
    }

    /// Lets go of a snapshot.
    pub(crate) fn drop_one(&mut self, id: SnapshotId) {
        self.readers.retain(|reader| reader.id != id);
    }

    /// Lets go of the snapshots of a stream that say nothing beyond a package.
    pub(crate) fn drop_upto(&mut self, stream: Stream, upto: u32) {
        self.readers.retain(|reader| reader.id.0 != stream || reader.upto > upto);
    }

    /// The reader of a snapshot, begun if need be; it is the last one then.
    fn open(&mut self, id: SnapshotId, upto: u32) -> &mut Reader {
        let reader = match self.readers.iter().position(|reader| reader.id == id) {
            Some(at) => self.readers.remove(at),
            None => Reader { id, upto, read: ChunksRead::default(), unmerged: None },
        };
        self.readers.push(reader);
        // Just pushed.
        let last = self.readers.len() - 1;
        &mut self.readers[last]
    }
}
