//! Present states whose tiles are told one against the other, as far as they have been read.

use flockmap_codec::{Codec, ContentKind, Decoder, Package, PackageError, TilesRead};
use flockmap_grid::{PresentState, Stream};

use crate::Refusal;

/// So many bytes they may hold together at least, however small the layers are: more than one tile can need.
const BYTES_MIN: usize = 8 << 20;

/// Bytes that the present states being read may hold together: half of what layers may hold.
pub(crate) const fn bytes_max(layer_bytes_max: usize) -> usize {
    let half = layer_bytes_max / 2;
    if half > BYTES_MIN { half } else { BYTES_MIN }
}

/// Which present state of which stream: its tiles belong together.
pub(crate) type SetId = (Stream, u32);

/// The present states that are being read, as many as the session hands out tiles of; the one of which a tile was read last comes last.
pub(crate) struct Readers {
    readers: Vec<Reader>,
    bytes_max: usize,
}

struct Reader {
    id: SetId,
    upto: u32,
    read: TilesRead,
    /// Read, but there was no room for it in the layer yet: the tile before the next one.
    unmerged: Option<PresentState>,
}

impl Readers {
    pub(crate) const fn new(layer_bytes_max: usize) -> Self {
        Self { readers: Vec::new(), bytes_max: bytes_max(layer_bytes_max) }
    }

    /// The present state that a tile belongs to, if it is told against the tiles before it.
    pub(crate) fn set_of(package: &Package) -> Option<SetId> {
        let header = package.header();
        match header.content {
            ContentKind::Present { set, .. } if header.codec == Codec::Flock => Some((header.stream, set)),
            _ => None,
        }
    }

    /// Makes room for the next tile of a present state. Returns those that had to go for it: first the ones that were left alone
    /// longest.
    ///
    /// # Errors
    /// [`Refusal::Tiles`] if it would not fit even alone; nothing goes then.
    pub(crate) fn make_room(&mut self, id: SetId, tile: &Package) -> Result<Vec<SetId>, Refusal> {
        let reader = self.open(id, tile.header().index);
        if reader.unmerged.is_some() {
            return Ok(Vec::new());
        }
        let (held, mut sum) = (reader.read.memory_bytes(), reader.read.memory_bytes_with(tile));
        let max = self.bytes_max;
        if sum > max {
            return Err(Refusal::Tiles { held, max });
        }
        let others = &self.readers[..self.readers.len() - 1];
        let fits = |reader: &&Reader| {
            sum += reader.read.memory_bytes();
            sum <= max
        };
        let gone = others.len() - others.iter().rev().take_while(fits).count();
        Ok(self.readers.drain(..gone).map(|reader| reader.id).collect())
    }

    /// What the next tile of a present state says. After an error it has to be read anew from its first tile on.
    pub(crate) fn read(
        &mut self,
        id: SetId,
        decoder: &mut Decoder,
        tile: &Package,
    ) -> Result<PresentState, PackageError> {
        let reader = self.open(id, tile.header().index);
        match reader.unmerged.take() {
            Some(state) => Ok(state),
            None => decoder.decode_tile(tile, &mut reader.read),
        }
    }

    /// Keeps what a tile says for when there is room for it.
    pub(crate) fn keep(&mut self, id: SetId, tile: &Package, state: PresentState) {
        self.open(id, tile.header().index).unmerged = Some(state);
    }

    /// Lets go of a present state.
    pub(crate) fn drop_one(&mut self, id: SetId) {
        self.readers.retain(|reader| reader.id != id);
    }

    /// Lets go of the present states of a stream that say nothing beyond a package.
    pub(crate) fn drop_upto(&mut self, stream: Stream, upto: u32) {
        self.readers.retain(|reader| reader.id.0 != stream || reader.upto > upto);
    }

    /// The reader of a present state, begun if need be; it is the last one then.
    fn open(&mut self, id: SetId, upto: u32) -> &mut Reader {
        let reader = match self.readers.iter().position(|reader| reader.id == id) {
            Some(at) => self.readers.remove(at),
            None => Reader { id, upto, read: TilesRead::default(), unmerged: None },
        };
        self.readers.push(reader);
        // Just pushed.
        let last = self.readers.len() - 1;
        &mut self.readers[last]
    }
}
