//! As much of a state as makes one snapshot: all of it, or the oldest part.

use flockmap_codec::Span;
use flockmap_grid::{Layer, SnapshotReader, SnapshotVoxels, Stamp};
use flockmap_mutation::{self as mutation, Mutation};
use flockmap_sync::Cuts;

/// For each block when it is coded: a table of what was said, which may be half empty.
const CODED_BLOCK_BYTES: usize = 300;

/// Bytes that a snapshot takes while it is made, beside its chunks, where it is cut: by default.
pub const PIECE_BYTES: usize = 48 << 20;

/// Reads a state in steps: of a layer as it is now, whatever becomes of it meanwhile. Where it would take more bytes than
/// a limit to make a snapshot of it, some 3 for each voxel and 140 to 300 for each block, what is newest is left out; a
/// further piece brings that.
#[derive(Debug)]
pub struct PieceReader {
    reader: SnapshotReader,
    span: Span,
    cuts: Option<Cuts>,
    bytes_max: usize,
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
        bytes_max: usize,
    ) -> Self {
        let cuts = cuts.filter(|_| layer.lost_upto().is_none());
        Self { reader: layer.read_snapshot(newer_than), span, cuts, bytes_max }
    }

    /// Reads some blocks, and the rest of a cube. Returns how many; 0: all is read. Some 20 µs for each.
    pub fn step(&mut self, blocks_max: usize) -> usize {
        let Self { reader, cuts, bytes_max, .. } = self;
        let blocks = reader.step(blocks_max);
        if cuts.is_some() && bytes_of(reader.read()) > *bytes_max {
            // A little less, so that it is not done again after every step.
            reader.keep_oldest(|read| bytes_of(read) <= *bytes_max / 8 * 7);
        }
        blocks
    }

    /// Cubes of the layer that are still to be read.
    pub fn cubes(&self) -> usize {
        self.reader.cubes()
    }

    /// Bytes that it takes to make a snapshot of what was read so far.
    pub fn bytes(&self) -> usize {
        bytes_of(self.reader.read())
    }

    /// What was read, after [`Self::step`] has read all. It can be read [once more](Self::restart).
    pub fn take(&mut self) -> Piece {
        let (reader, mut span) = (&mut self.reader, self.span);
        if let (Some(cuts), Some(limit)) = (&self.cuts, reader.upto()) {
            let Some((upto, stamp)) = cuts.upto(span.since, limit) else { return Piece::TooMuch };
            reader.keep_upto(stamp);
            if reader.read().is_empty() {
                // Nothing stands any more of what these packages said. Of no state the newest stamp could be told.
                return Piece::TooMuch;
            }
            let changed_upto = Some(cuts.newest).filter(|_| !mutation::is(Mutation::PieceUnsaid));
            span = Span { upto, changed_upto, is_cut: changed_upto.is_some(), ..span };
        }
        let rest = reader.upto();
        match reader.take() {
            Some(state) => Piece::State(span, state, rest),
            None => Piece::Nothing(span),
        }
    }

    /// Reads the same state once more, with a larger limit. `false` if there is nothing to cut it by. O(cubes).
    pub fn restart(&mut self, bytes_max: usize) -> bool {
        if self.cuts.is_some() {
            self.reader.restart();
            self.bytes_max = bytes_max;
        }
        self.cuts.is_some()
    }
}

fn bytes_of(read: &SnapshotVoxels) -> usize {
    read.memory_bytes() + read.block_count() * CODED_BLOCK_BYTES
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::{Changes, RobotId, State, Stream, Voxel};
    use proptest::prelude::*;

    fn span(since: u32, upto: u32) -> Span {
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        Span { stream, since, upto, lost_upto: None, changed_upto: None, is_cut: false }
    }

    /// All pieces of a layer, one after the other, each as large as it has to be.
    fn pieces(layer: &Layer, cuts: &Cuts, bytes_max: usize) -> Vec<(Span, SnapshotVoxels)> {
        let (mut pieces, mut since, mut newer_than) = (Vec::new(), 0, None);
        loop {
            let mut bytes_max = bytes_max;
            let of = span(since, cuts.newest);
            let mut reader = PieceReader::new(layer, of, newer_than, Some(cuts.clone()), bytes_max);
            let (of, state, rest) = loop {
                while reader.step(1) > 0 {}
                match reader.take() {
                    Piece::State(of, state, rest) => break (of, state, rest),
                    Piece::Nothing(_) => return pieces,
                    Piece::TooMuch => {
                        bytes_max *= 2;
                        assert!(reader.restart(bytes_max));
                    }
                }
            };
            pieces.push((of, state));
            if rest.is_none() {
                return pieces;
            }
            (since, newer_than) = (of.upto, rest);
        }
    }

    proptest! {
        /// Voxels are seen again, so that of some packages nothing stands any more; and of some the stamp is forgotten.
        #[test]
        fn the_pieces_of_a_layer_say_all_of_it_and_each_no_more_than_its_packages(
            seen in prop::collection::vec((0..100i32, 1..60i32), 1..120),
            known in prop::collection::vec(prop::bool::weighted(0.3), 120), bytes_max in 0..8_000usize,
        ) {
            let (mut layer, mut stamps) = (Layer::default(), Vec::new());
            for (number, (from, count)) in (1u32..).zip(&seen) {
                let voxels = (*from..from + count).map(|x| (Voxel::new(x * 3, x % 7, 0), State::Free));
                layer.apply(&Changes::from_voxels(voxels), Stamp(i64::from(number) * 10));
                if known[number as usize - 1] && number < seen.len() as u32 {
                    stamps.push((number, Stamp(i64::from(number) * 10)));
                }
            }
            let cuts = Cuts { stamps, newest: seen.len() as u32, changed_upto: None };
            let (mut together, mut before) = (Layer::default(), 0);
            for (of, state) in pieces(&layer, &cuts, bytes_max) {
                prop_assert!(of.since == before && of.upto > before && !state.is_empty());
                before = of.upto;
                for (stamp, part) in state.parts() {
                    prop_assert!(stamp.0 <= i64::from(of.upto) * 10 && stamp.0 > i64::from(of.since) * 10);
                    together.apply(&part, stamp);
                }
                prop_assert_eq!(of.changed_upto, (of.upto < cuts.newest).then_some(cuts.newest));
                prop_assert_eq!(of.is_cut, of.changed_upto.is_some());
            }
            prop_assert_eq!(before, cuts.newest, "all packages are contained");
            prop_assert_eq!(together.digest(), layer.digest());
        }
    }
}
