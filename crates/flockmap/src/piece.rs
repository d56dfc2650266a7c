//! As much of a state as makes one snapshot: all of it, or the oldest part.

use flockmap_codec::Span;
use flockmap_grid::{Layer, SnapshotReader, SnapshotVoxels, Stamp};
use flockmap_mutation::{self as mutation, Mutation};
use flockmap_sync::Cuts;

/// For each block when it is coded: a table of what was said, which may be half empty.
const CODED_BLOCK_BYTES: usize = 300;

/// How much makes one snapshot.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct PieceLimit {
    /// Bytes that it takes while it is made, beside its chunks: some 3 for each voxel, and 140 to 300 for each block.
    pub bytes: usize,
    /// Voxels, of which each takes one to three bits in the chunks.
    pub voxels: usize,
}

/// Reads a state in steps: of a layer as it is now, whatever becomes of it meanwhile. Where it is more than a limit, what
/// is newest is left out; a further piece brings that.
#[derive(Debug)]
pub struct PieceReader {
    reader: SnapshotReader,
    span: Span,
    cuts: Option<Cuts>,
    limit: PieceLimit,
}

/// What was read.
#[derive(Debug)]
pub enum Piece {
    /// A state with the packages that it contains. Of what is newer than the stamp, if there is one, further pieces are to
    /// be made.
    State(Span, SnapshotVoxels, Option<Stamp>),
    /// Nothing is known.
    Nothing(Span),
    /// It is too much, and no package is known that the older part goes up to: a larger limit is needed.
    TooMuch,
}

impl PieceReader {
    /// Begins to read a layer, or what of it is newer than a stamp; it contains the packages of `span`. It can be cut by
    /// `cuts`, unless something was dropped of it: of what age, a piece could not say. O(cubes).
    pub fn new(
        layer: &Layer,
        span: Span,
        newer_than: Option<Stamp>,
        cuts: Option<Cuts>,
        limit: PieceLimit,
    ) -> Self {
        let cuts = cuts.filter(|_| layer.lost_upto().is_none());
        Self { reader: layer.read_snapshot(newer_than), span, cuts, limit }
    }

    /// Reads some blocks, and the rest of a cube. Returns how many; 0: all is read. Some 20 µs for each.
    pub fn step(&mut self, blocks_max: usize) -> usize {
        let Self { reader, cuts, limit, .. } = self;
        let blocks = reader.step(blocks_max);
        if cuts.is_some() && !limit.is_kept(reader.read()) {
            // A little less, so that it is not done again after every step.
            let less = PieceLimit { bytes: limit.bytes / 8 * 7, voxels: limit.voxels / 8 * 7 };
            reader.keep_oldest(|read| less.is_kept(read));
        }
        blocks
    }

    /// Bytes that it takes to make a snapshot of what was read so far.
    pub fn bytes(&self) -> usize {
        bytes_of(self.reader.read())
    }

    /// What was read, after [`Self::step`] has read all. Nothing is left here.
    pub fn finish(&mut self) -> Piece {
        let (mut reader, mut span) = (core::mem::take(&mut self.reader), self.span);
        if let (Some(cuts), Some(limit)) = (&self.cuts, reader.upto()) {
            let Some((upto, stamp)) = cuts.upto(span.since, limit) else { return Piece::TooMuch };
            reader.keep_upto(stamp);
            let changed_upto = Some(cuts.newest).filter(|_| !mutation::is(Mutation::PieceUnsaid));
            span = Span { upto, changed_upto, is_cut: changed_upto.is_some(), ..span };
        }
        let rest = reader.upto();
        match reader.finish() {
            Some(state) => Piece::State(span, state, rest),
            None => Piece::Nothing(span),
        }
    }
}

impl PieceLimit {
    fn is_kept(&self, read: &SnapshotVoxels) -> bool {
        bytes_of(read) <= self.bytes && read.len() <= self.voxels
    }
}

fn bytes_of(read: &SnapshotVoxels) -> usize {
    read.memory_bytes() + read.block_count() * CODED_BLOCK_BYTES
}
