//! From a package back to its content.

use flockmap_grid::{DiscardedLayer, Layer, Snapshot};
use flockmap_mutation::{self as mutation, Mutation};

use crate::check;
use crate::codec::Codec;
use crate::error::PackageError;
use crate::header::ContentKind;
use crate::package::{Content, Package};
use crate::priority::Priority;
use crate::work::{self, Work};
use crate::{flock, paper};

/// Decodes packages and keeps its memory from one to the next: up to 2.25 bytes for each voxel of the largest
/// box so far. For [`Codec::Flock`] in place of that: 550 bytes for each block of the largest package and
/// each known one in its box or beside it, 45 bytes at most for each block of the box (of which there are at
/// most 2¹⁸), and 40 KB. The tables of that codec, 2.3 MB, are one for the whole process, and take
/// twice that while they are unpacked. One for each thread.
#[derive(Default)]
pub struct Decoder {
    paper: paper::Scratch,
    /// Made with the first package in that codec.
    flock: Option<Box<flock::Workspace>>,
    steps: u64,
}

impl Decoder {
    /// A decoder that holds no memory yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// The content of a package that needs nothing else, see [`Package::decode`].
    pub fn decode(&mut self, package: &Package) -> Result<Content, PackageError> {
        self.decode_against(package, None)
    }

    /// The content of a package that was coded against what earlier ones said: `layer` is that of its stream
    /// and must hold all packages up to `base` of the header. Packages of the same batch may have been
    /// applied to it already.
    ///
    /// # Errors
    /// [`PackageError::BaseSuperseded`] if a later batch or a snapshot has been applied to a block that the
    /// package builds on: what it was before is gone, and the package can only be replaced by a snapshot.
    pub fn decode_against(
        &mut self,
        package: &Package,
        layer: Option<&Layer>,
    ) -> Result<Content, PackageError> {
        let header = package.header();
        if header.codec == Codec::Flock && matches!(header.content, ContentKind::Snapshot { .. }) {
            return self.decode_chunk(package, &mut ChunksRead::default()).map(Content::Snapshot);
        }
        let mut work = Work::new(header.codec, package.payload().len());
        let content = self.content(package, layer, &mut work);
        self.steps = work.taken();
        let content = content?;
        let hash = match &content {
            Content::Changes(changes) => {
                if changes.has_occupied() != (header.priority == Priority::Obstacles) {
                    let rule = "the priority of obstacles is that of changes to Occupied";
                    return Err(PackageError::Header { rule });
                }
                check::of_changes(changes)
            }
            Content::Snapshot(state) => check::of_chunk(&state.parts, &state.sensors),
        };
        if !mutation::is(Mutation::CheckSkipped) {
            package.verify(&hash)?;
        }
        Ok(content)
    }

    /// What the payload says, before it is checked.
    fn content(
        &mut self,
        package: &Package,
        layer: Option<&Layer>,
        work: &mut Work,
    ) -> Result<Content, PackageError> {
        let (header, payload) = (package.header(), package.payload());
        let (codec, region) = (header.codec, &header.region);
        if header.content != ContentKind::Changes {
            let ends = [header.batch_start, header.batch_end];
            let state = paper::decode_chunk(&mut self.paper, codec, payload, region, ends, work);
            return state.map(Content::Snapshot);
        }
        if codec != Codec::Flock {
            return paper::decode_batch(&mut self.paper, codec, payload, region, work).map(Content::Changes);
        }
        let layer = layer.filter(|_| !header.is_independent);
        if !header.is_independent && layer.is_none() {
            return Err(PackageError::BaseMissing { base: header.base });
        }
        let changes = flock::decode_batch(&mut self.flock, layer, header.batch_end, payload, region, work);
        changes.map(Content::Changes)
    }

    /// The content of a chunk of [`Codec::Flock`] that continues those read before; it then counts among them.
    ///
    /// # Errors
    /// [`PackageError::ChunkMissing`] if it is not the chunk that comes next; then nothing has changed. After
    /// any other error `before` is as if nothing had been read: what the chunks said is safe, but all of them
    /// are needed again to go on.
    pub fn decode_chunk(
        &mut self,
        package: &Package,
        before: &mut ChunksRead,
    ) -> Result<Snapshot, PackageError> {
        let header = package.header();
        let ContentKind::Snapshot { chunk, .. } = header.content else {
            return Err(PackageError::Header { rule: "a chunk is of a snapshot" });
        };
        if chunk != before.next || header.codec != Codec::Flock {
            return Err(PackageError::ChunkMissing { chunk: before.next });
        }
        let ChunksRead { mut coded, mut carried, next, .. } = core::mem::take(before);
        let (payload, ends) = (package.payload(), [header.batch_start, header.batch_end]);
        let mut work = Work::new(header.codec, payload.len());
        let read = (&mut coded, &mut carried);
        let state = flock::decode_chunk(&mut self.flock, read, payload, &header.region, ends, &mut work);
        self.steps = work.taken();
        let checked = state.and_then(|state| {
            package.verify(&check::of_chunk(&state.parts, &state.sensors))?;
            Ok(state)
        });
        *before = match &checked {
            Ok(_) => ChunksRead { coded, carried, next: next.saturating_add(1), spoilt: Layer::default() },
            // To let go of it takes a while, which is for the caller to spend.
            Err(_) => ChunksRead { spoilt: coded, ..ChunksRead::default() },
        };
        checked
    }

    /// Steps of work that the last package took, as `WIRE.md` counts them; of a refused one those up to its
    /// refusal.
    pub const fn steps(&self) -> u64 {
        self.steps
    }

    /// The same, and none from then on until the next package.
    pub const fn take_steps(&mut self) -> u64 {
        core::mem::replace(&mut self.steps, 0)
    }
}

/// The chunks of one snapshot that have been read, from the first on. In [`Codec::Flock`] each chunk is coded
/// against those before it; in the other codecs each is independent. Holds as much as a [`Layer`] of what was
/// read, and 39 KB.
#[derive(Clone, Debug, Default)]
pub struct ChunksRead {
    coded: Layer,
    carried: flock::CarriedState,
    next: u32,
    /// What was read before one that was wrong. Nobody looks at it any more.
    spoilt: Layer,
}

impl ChunksRead {
    /// The number of the chunk that can be read now.
    pub const fn next(&self) -> u32 {
        self.next
    }

    /// Blocks with a known voxel so far.
    pub fn block_count(&self) -> usize {
        self.coded.block_count()
    }

    /// Bytes that it holds. O(1).
    pub fn memory_bytes(&self) -> usize {
        self.coded.memory_bytes() + self.carried.memory_bytes()
    }

    /// Lets go of it, but not at once.
    pub fn discard(self) -> impl Iterator<Item = DiscardedLayer> {
        [self.coded, self.spoilt].into_iter().filter(|layer| !layer.is_empty()).map(Layer::discard)
    }

    /// Bytes that it may hold at most while and after this chunk is read, beside the stamps of the voxels of
    /// the chunk: it adds at most as many blocks as its bytes may ask for. O(1).
    pub fn memory_bytes_with(&self, chunk: &Package) -> usize {
        let blocks = work::limit(chunk.payload().len()) / work::BLOCK_STEPS;
        self.coded.memory_bytes_with(usize::try_from(blocks).unwrap_or(usize::MAX))
            + flock::CarriedState::MEMORY_MAX
    }
}

impl Package {
    /// The content. An error means that the package is damaged, or is not of this version: none of it may be
    /// used.
    ///
    /// Takes at most 2.5 bytes of memory for each voxel of the box while it works, and the box is refused
    /// before that if the payload could not fill it: 12 MB for a package of 1,150 bytes, twice that for a
    /// snapshot. To decode many packages use a [`Decoder`], which keeps its memory.
    pub fn decode(&self) -> Result<Content, PackageError> {
        Decoder::new().decode(self)
    }

    /// From where the changes were seen, in sixteenths of a voxel, if the package says so: packages of
    /// changes in [`Codec::Flock`] do. What [`Layer::note_sensor`] wants to know.
    pub fn sensor(&self) -> Option<[i32; 3]> {
        let header = self.header();
        let is_known = header.codec == Codec::Flock && header.content == ContentKind::Changes;
        if is_known { flock::sensor(self.payload(), &header.region) } else { None }
    }
}
