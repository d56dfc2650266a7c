//! From changes, or from the state of a layer, to packages.

use core::borrow::Borrow;

use flockmap_grid::{Changes, Resolution, Snapshot, SnapshotVoxels, Stream, VoxelBox};

use crate::base::Base;
use crate::check;
use crate::codec::Codec;
use crate::draft::BatchDraft;
use crate::error::EncodeError;
use crate::header::{ContentKind, Header, rounded_start};
use crate::limits::PACKAGE_BYTES_MIN;
use crate::package::Package;
use crate::priority::Priority;
use crate::snapshot_coding::SnapshotCoding;
use crate::source::{Batch, Span};
use crate::{flock, paper};

/// Makes packages. Keeps its memory from one to the next: up to 2.25 bytes for each voxel of the largest box
/// so far, and 300 KB. For [`Codec::Flock`] in place of that: 550 bytes for each block of the largest package
/// and each known one in its box or beside it, 45 bytes at most for each block of the box, and 40 KB. One for
/// each thread. The same input gives the same packages, whatever was encoded before.
#[derive(Default)]
pub struct Encoder {
    paper: paper::Writer,
    /// Made with the first package in that codec.
    flock: Option<Box<flock::Workspace>>,
}

impl Encoder {
    /// An encoder.
    pub fn new() -> Self {
        Self::default()
    }

    /// One package for all changes, whatever its size, as the paper sends it (Sec. III). For benchmarks: what
    /// goes over a radio is better cut to its datagrams by [`Self::encode_batch`].
    pub fn encode_whole(
        &mut self,
        codec: Codec,
        batch: &Batch,
        index: u32,
        changes: &Changes,
    ) -> Result<Package, EncodeError> {
        check_batch(batch, index, changes)?;
        if codec == Codec::Flock {
            let mut packages = self.encode_batch(codec, batch, index, changes, WHOLE_BYTES_MAX)?;
            return match packages.len() {
                1 => packages.pop().ok_or(EncodeError::Empty),
                _ => Err(EncodeError::BoxTooLarge {
                    voxels: changes.bounding_box().map_or(0, |region| region.volume()),
                }),
            };
        }
        let draft = paper::encode_whole(&mut self.paper, codec, changes)?;
        let header = changes_header(codec, batch, index, draft.region);
        Ok(seal_changes(&header, batch, &draft))
    }

    /// The changes of a batch as packages of at most `bytes_max` bytes each, numbered from `first_index`.
    /// Each has a tight box of its own and is of use without the others; no two share a voxel. No changes: no
    /// packages.
    ///
    /// The changes are cut in two across the longest side of their box until each piece fits. What a piece
    /// will take is forecast from the pieces before it, so that few are encoded in vain.
    pub fn encode_batch(
        &mut self,
        codec: Codec,
        batch: &Batch,
        first_index: u32,
        changes: &Changes,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        self.encode_batch_against(codec, batch, first_index, changes, None, bytes_max)
    }

    /// As [`Self::encode_batch`], coded against what the receivers hold already. Their headers say in
    /// `base` which packages a receiver must have before it can decode them, with
    /// [`Decoder::decode_against`](crate::Decoder::decode_against).
    pub fn encode_batch_against(
        &mut self,
        codec: Codec,
        batch: &Batch,
        first_index: u32,
        changes: &Changes,
        base: Option<&Base<'_>>,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        if changes.is_empty() {
            return Ok(Vec::new());
        }
        check_batch(batch, first_index, changes)?;
        check_limit(bytes_max)?;
        // Only `flock` builds on what was before, and there is nothing before the first package.
        let may_build = codec == Codec::Flock && first_index > 1;
        let base = base.filter(|_| may_build);
        let room = |number: usize, region: &VoxelBox| {
            let index = u32::try_from(number).map_or(u32::MAX, |number| first_index.saturating_add(number));
            // The base is not known yet: the first package takes most bytes to name.
            let longest = Header { base: may_build.into(), ..changes_header(codec, batch, index, *region) };
            bytes_max.saturating_sub(longest.byte_len())
        };
        let drafts = if codec == Codec::Flock {
            let layer = base.and_then(|base| base.layer);
            flock::encode_batch(self.flock.get_or_insert_default(), layer, batch, changes, room)?
        } else {
            paper::encode_batch(&mut self.paper, codec, changes, room)?
        };
        let count = drafts.len();
        if u64::from(first_index) + count as u64 - 1 > u64::from(u32::MAX) {
            return Err(EncodeError::IndexOutOfRange { first: first_index, count });
        }
        let packages = (first_index..=u32::MAX).zip(drafts).map(|(index, draft)| {
            let written = draft.base.zip(base);
            let written = written.map_or(0, |(stamp, to)| to.newest_package(stamp, first_index));
            let read = base.map_or(0, |base| base.newest_dependent(&draft.region));
            let base = written.max(read).min(first_index - 1);
            let header = changes_header(codec, batch, index, draft.region);
            let header = Header { base, is_independent: written == 0, ..header };
            check_length(seal_changes(&header, batch, &draft), bytes_max)
        });
        packages.collect()
    }

    /// The state of a layer as chunks of at most `bytes_max` bytes each, codes `00 01 10` (Sec. IV-B of the
    /// paper), with the stamp of every voxel. `upto_index` is the newest package whose changes, with those of
    /// all before it, are in `state`. Always at least one chunk: where nothing is known, one that says so of a
    /// single voxel.
    ///
    /// Chunks of [`Codec::Flock`] are coded one against the other, see [`ChunksRead`](crate::ChunksRead). They
    /// are those of [`Codec::Paper`] where that takes fewer bytes.
    pub fn encode_snapshot(
        &mut self,
        codec: Codec,
        stream: Stream,
        upto_index: u32,
        resolution: Resolution,
        state: &Snapshot,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        check_rules(state)?;
        let voxels = SnapshotVoxels::from_state(state);
        let voxels = voxels.ok_or(EncodeError::Snapshot { rule: "at most 2³² blocks" })?;
        let span = Span::new(stream, 0, upto_index);
        self.encode_span(codec, span, resolution, &voxels, bytes_max)
    }

    /// The same of a state in less memory, that need not be whole: see
    /// [`Layer::snapshot_voxels`](flockmap_grid::Layer::snapshot_voxels). What it takes while it works, beside what
    /// the encoder keeps, is said at [`SnapshotCoding`]; 15 MB more where chunks are of another codec than
    /// [`Codec::Flock`].
    pub fn encode_span(
        &mut self,
        codec: Codec,
        span: Span,
        resolution: Resolution,
        state: &SnapshotVoxels,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        let mut coding = SnapshotCoding::new(codec, span, resolution, state, bytes_max)?;
        loop {
            if let (_, Some(chunks)) = self.go_on(&mut coding, u64::MAX)? {
                return Ok(chunks);
            }
        }
    }

    /// Does some of the work of a snapshot: until it has taken `steps_max` steps, at least 1, or what cannot be
    /// stopped in more: the beginning of a part (what has one stamp), or a chunk. A step is some 10 ns, a chunk of
    /// [`Codec::Flock`] has at most half a million. Returns the steps taken; and all chunks, when they are made.
    ///
    /// # Errors
    /// [`EncodeError`]; the work is of no use then.
    pub fn go_on<S: Borrow<SnapshotVoxels>>(
        &mut self,
        coding: &mut SnapshotCoding<S>,
        steps_max: u64,
    ) -> Result<(u64, Option<Vec<Package>>), EncodeError> {
        coding.step(&mut self.paper, &mut self.flock, steps_max)
    }
}

/// No package comes near this: those of the largest box have some 50 MB.
const WHOLE_BYTES_MAX: usize = 1 << 30;

fn changes_header(codec: Codec, batch: &Batch, index: u32, region: VoxelBox) -> Header {
    Header {
        stream: batch.stream,
        index,
        batch_start: rounded_start(batch.start, batch.end),
        batch_end: batch.end,
        base: 0,
        is_independent: true,
        resolution: batch.resolution,
        region,
        codec,
        content: ContentKind::Changes,
        lost_upto: None,
        changed_upto: None,
        says_upto: None,
        is_cut: false,
        is_of_all: false,
        priority: Priority::Obstacles,
    }
}

/// `header` but for the priority.
fn seal_changes(header: &Header, batch: &Batch, draft: &BatchDraft) -> Package {
    let priority = Priority::of(&draft.changes, &draft.region, batch.sensor, batch.resolution);
    Package::seal(&Header { priority, ..*header }, &draft.payload, &check::of_changes(&draft.changes))
}

fn check_batch(batch: &Batch, index: u32, changes: &Changes) -> Result<(), EncodeError> {
    if changes.is_empty() {
        return Err(EncodeError::Empty);
    }
    if batch.end < batch.start {
        return Err(EncodeError::BatchEndsBeforeStart);
    }
    if index == 0 {
        return Err(EncodeError::IndexOutOfRange { first: 0, count: 1 });
    }
    Ok(())
}

fn check_limit(bytes_max: usize) -> Result<(), EncodeError> {
    if bytes_max < PACKAGE_BYTES_MIN { Err(EncodeError::BytesMaxTooSmall { bytes_max }) } else { Ok(()) }
}

/// What could not be cut further may be too long.
fn check_length(package: Package, bytes_max: usize) -> Result<Package, EncodeError> {
    if package.bytes().len() > bytes_max {
        Err(EncodeError::BytesMaxTooSmall { bytes_max })
    } else {
        Ok(package)
    }
}

/// Whether a snapshot is one.
fn check_rules(state: &Snapshot) -> Result<(), EncodeError> {
    let wrong = |rule| Err(EncodeError::Snapshot { rule });
    if !state.parts.is_sorted_by(|a, b| a.0 < b.0) {
        return wrong("the stamps of the parts ascend");
    }
    let parts = || state.parts.iter().map(|(_, part)| part);
    if parts().any(Changes::is_empty) {
        return wrong("no part is empty");
    }
    let inside = |part: &Changes| part.bounding_box().is_some_and(|b| b.union(&state.region) == state.region);
    if !parts().all(inside) {
        return wrong("all voxels lie in the region");
    }
    let blocks = parts().flat_map(|part| part.blocks().iter().copied()).collect();
    let all = Changes::from_blocks(blocks);
    if all.len() != parts().map(Changes::len).sum::<usize>() {
        return wrong("no voxel is in two parts");
    }
    Ok(())
}
