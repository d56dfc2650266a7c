//! A snapshot that is coded in pieces.

use core::borrow::Borrow;

use crc32fast::Hasher;
use flockmap_grid::{BLOCK_SIDE, Resolution, SnapshotVoxels, Stamp, Voxel, VoxelBox};

use crate::check;
use crate::codec::Codec;
use crate::draft::ChunkDraft;
use crate::error::EncodeError;
use crate::header::{ContentKind, Header};
use crate::limits::PACKAGE_BYTES_MIN;
use crate::package::Package;
use crate::priority::Priority;
use crate::source::Span;
use crate::{flock, paper, work};

/// Bits of a voxel from which on a snapshot in `flock` is compared with one of the paper. Maps of real
/// flights take one or less.
const FLOCK_BITS_MAX: usize = 3;

/// A snapshot on its way to chunks. [`Encoder::go_on`](crate::Encoder::go_on) does some of the work at a time, so that
/// whoever makes it can do other things in between; what comes out does not depend on how much is done at once.
/// Beside the state it holds 140 to 300 bytes for each block, 80 KB, the chunks, and where they are of another codec than
/// [`Codec::Flock`] the state once more.
pub struct SnapshotCoding<S> {
    headers: Headers,
    state: S,
    /// Wanted; that of the chunks being made is in `headers`.
    codec: Codec,
    stage: Stage,
    /// The chunks of [`Codec::Flock`], if they are to be compared with those of the paper's codec.
    flock: Vec<Package>,
}

enum Stage {
    Flock {
        writer: Box<flock::SnapshotWriter>,
        id: Hasher,
    },
    Paper {
        writer: Box<paper::SnapshotWriter>,
        id: Hasher,
    },
    /// All is coded; chunks get their headers.
    Sealing {
        drafts: std::vec::IntoIter<ChunkDraft>,
        id: u32,
        chunks: Vec<Package>,
    },
}

impl<S: Borrow<SnapshotVoxels>> SnapshotCoding<S> {
    /// Begins to code a state as chunks of at most `bytes_max` bytes each; see
    /// [`Encoder::encode_span`](crate::Encoder::encode_span). O(sensors), and room for its blocks.
    ///
    /// # Errors
    /// [`EncodeError`] where `span` is none, or `bytes_max` is too small for any package.
    pub fn new(
        codec: Codec,
        span: Span,
        resolution: Resolution,
        state: S,
        bytes_max: usize,
    ) -> Result<Self, EncodeError> {
        if span.upto == 0 || span.since >= span.upto {
            return Err(EncodeError::IndexOutOfRange { first: span.since, count: 1 });
        }
        if bytes_max < PACKAGE_BYTES_MIN {
            return Err(EncodeError::BytesMaxTooSmall { bytes_max });
        }
        let headers = Headers::new(codec, span, resolution, state.borrow(), bytes_max);
        let stage = headers.begin(state.borrow());
        Ok(Self { headers, state, codec, stage, flock: Vec::new() })
    }

    /// Bytes of payload of the chunks so far, for who has no use for more than some. O(chunks).
    pub fn bytes(&self) -> usize {
        match &self.stage {
            Stage::Flock { writer, .. } => writer.bytes(),
            Stage::Paper { writer, .. } => writer.bytes(),
            // No more come.
            Stage::Sealing { .. } => 0,
        }
    }

    /// Goes on until it has taken so many steps, or a section, a part or a chunk more. Returns the steps taken, and
    /// all chunks when they are made.
    pub(crate) fn step(
        &mut self,
        paper: &mut paper::Writer,
        flock: &mut Option<Box<flock::Workspace>>,
        steps_max: u64,
    ) -> Result<(u64, Option<Vec<Package>>), EncodeError> {
        let mut steps = 0;
        while steps < steps_max {
            let (headers, state) = (self.headers, self.state.borrow());
            let room = |region: &VoxelBox, ends: [Stamp; 2]| headers.room(region, ends);
            let left = steps_max - steps;
            let taken = match &mut self.stage {
                Stage::Flock { writer, id } => {
                    let seen = |stamp, part: &_| check::hash_part(id, stamp, part);
                    writer.step(flock.get_or_insert_default(), state, room, seen, left)?
                }
                Stage::Paper { writer, id } => {
                    let seen = |stamp, part: &_| check::hash_part(id, stamp, part);
                    writer.step(paper, state, room, seen, left)?
                }
                Stage::Sealing { drafts, id, chunks } => match drafts.next() {
                    Some(draft) => {
                        let (number, count) = (chunks.len() as u32, chunks.len() + drafts.len() + 1);
                        let header = headers.header(draft.region, draft.ends, *id, [number, count as u32]);
                        let chunk = Package::seal(&header, &draft.payload, &draft.content);
                        if chunk.bytes().len() <= headers.bytes_max {
                            chunks.push(chunk);
                        } else if headers.codec == self.codec && self.codec == Codec::Flock {
                            // Not even a block fits; the paper's chunks can be cut further.
                            (*drafts, *chunks) = Default::default();
                        } else {
                            return Err(EncodeError::BytesMaxTooSmall { bytes_max: headers.bytes_max });
                        }
                        work::SEAL_STEPS
                    }
                    None => 0,
                },
            };
            steps += taken;
            if taken == 0
                && let Some(chunks) = self.next_stage(paper)?
            {
                return Ok((steps, Some(chunks)));
            }
        }
        Ok((steps, None))
    }

    /// Goes on to the next stage; all chunks after the last one.
    fn next_stage(&mut self, paper: &mut paper::Writer) -> Result<Option<Vec<Package>>, EncodeError> {
        let state = self.state.borrow();
        let none = Stage::Sealing { drafts: Vec::new().into_iter(), id: 0, chunks: Vec::new() };
        let (drafts, id) = match core::mem::replace(&mut self.stage, none) {
            Stage::Flock { writer, id } => (writer.finish()?, id),
            Stage::Paper { writer, id } => (writer.finish(paper, state)?, id),
            Stage::Sealing { chunks, .. } => return Ok(self.settle(chunks)),
        };
        let chunks = Vec::with_capacity(drafts.len());
        self.stage = Stage::Sealing { drafts: drafts.into_iter(), id: id.finalize(), chunks };
        Ok(None)
    }

    /// The chunks, or nothing if another codec is to be tried too.
    fn settle(&mut self, chunks: Vec<Package>) -> Option<Vec<Package>> {
        let state = self.state.borrow();
        let bytes = |chunks: &[Package]| chunks.iter().map(|chunk| chunk.bytes().len()).sum::<usize>();
        if self.codec != Codec::Flock {
            return Some(chunks);
        }
        if self.headers.codec == Codec::Paper {
            let is_shorter = self.flock.is_empty() || bytes(&chunks) < bytes(&self.flock);
            return Some(if is_shorter { chunks } else { core::mem::take(&mut self.flock) });
        }
        if !chunks.is_empty() && bytes(&chunks) * 8 <= FLOCK_BITS_MAX * state.len() {
            return Some(chunks);
        }
        // A history without a pattern: the paper's codec may be shorter.
        self.flock = chunks;
        let Headers { span, resolution, bytes_max, .. } = self.headers;
        self.headers = Headers::new(Codec::Paper, span, resolution, state, bytes_max);
        self.stage = self.headers.begin(state);
        None
    }
}

impl Package {
    /// The only chunk of a snapshot of which everything was dropped for want of room: it says no more than that.
    /// `None` where nothing was ([`Span::lost_upto`]), or `span` is none.
    pub fn of_dropped(span: Span, resolution: Resolution) -> Option<Self> {
        let lost_upto = span.lost_upto.filter(|_| span.since < span.upto)?;
        let state = SnapshotVoxels::default();
        let headers = Headers::new(Codec::Flock, span, resolution, &state, 0);
        let id = check::begin_snapshot_id(Codec::Flock, 0, &span, &state).finalize();
        // Any box of a block will do.
        let region = VoxelBox::new(Voxel::new(0, 0, 0), [BLOCK_SIDE as u32; 3])?;
        let header = headers.header(region, [lost_upto; 2], id, [0, 1]);
        Some(Self::seal(&header, &[], &check::of_chunk(&[], &[])))
    }
}

/// What the headers of all chunks in one codec have in common.
#[derive(Clone, Copy)]
struct Headers {
    codec: Codec,
    span: Span,
    resolution: Resolution,
    bytes_max: usize,
    /// There are no more chunks.
    most: u32,
}

impl Headers {
    fn new(
        codec: Codec,
        span: Span,
        resolution: Resolution,
        state: &SnapshotVoxels,
        bytes_max: usize,
    ) -> Self {
        // There are no more chunks than voxels, or than blocks where these are not cut.
        let most = if codec == Codec::Flock { state.part_blocks() } else { state.len() };
        Self { codec, span, resolution, bytes_max, most: u32::try_from(most).unwrap_or(u32::MAX) }
    }

    fn begin(&self, state: &SnapshotVoxels) -> Stage {
        let id = check::begin_snapshot_id(self.codec, self.bytes_max, &self.span, state);
        if self.codec == Codec::Flock {
            Stage::Flock { writer: Box::new(flock::SnapshotWriter::new(state)), id }
        } else {
            Stage::Paper { writer: Box::new(paper::SnapshotWriter::new(self.codec)), id }
        }
    }

    fn header(
        &self,
        region: VoxelBox,
        [batch_start, batch_end]: [Stamp; 2],
        id: u32,
        [chunk, chunks]: [u32; 2],
    ) -> Header {
        let Span { stream, since, upto, lost_upto, changed_upto, says_upto, is_cut, is_of_all } = self.span;
        Header {
            stream,
            index: upto,
            batch_start,
            batch_end,
            base: 0,
            is_independent: true,
            resolution: self.resolution,
            region,
            codec: self.codec,
            content: ContentKind::Snapshot { since, id, chunk, chunks },
            lost_upto,
            changed_upto,
            says_upto,
            is_cut,
            is_of_all,
            priority: Priority::Obstacles,
        }
    }

    /// Bytes of payload for which a chunk has room that spans a box and some stamps.
    fn room(&self, region: &VoxelBox, ends: [Stamp; 2]) -> usize {
        self.bytes_max.saturating_sub(self.header(*region, ends, 0, [self.most; 2]).byte_len())
    }
}
