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
/// [further piece](Self::go_on) of the same state brings that.
#[derive(Debug)]
pub struct PieceReader {
    reader: SnapshotReader,
    span: Span,
    /// Since where it was listed, and since where it is read.
    listed_since: u32,
    ended_at: u32,
    newer_than: Option<Stamp>,
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
    /// Begins to read a layer, or what of it is newer than a stamp; it contains the packages of `span`, and what the
    /// layer lacks, it lacks. It can be cut by `cuts`. O(cubes).
    pub fn new(
        layer: &Layer,
        span: Span,
        newer_than: Option<Stamp>,
        cuts: Option<Cuts>,
        bytes_max: usize,
    ) -> Self {
        let lost_upto = layer.lost_upto().filter(|_| !mutation::is(Mutation::DropUnsaid));
        let (reader, span) = (layer.read_snapshot(newer_than), Span { lost_upto, ..span });
        let Span { since, upto, .. } = span;
        Self { reader, span, listed_since: since, ended_at: upto, newer_than, cuts, bytes_max }
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

    /// Bytes that it takes beside that and beside what it shares with the layer.
    pub fn bytes_beside(&self) -> usize {
        self.reader.memory_bytes()
    }

    /// What was read, after [`Self::step`] has read all.
    pub fn take(&mut self) -> Piece {
        // What is lacking and older, who gets this lacks already.
        let lost_upto = self.span.lost_upto.filter(|lost| self.newer_than.is_none_or(|limit| *lost > limit));
        let (reader, mut span) = (&mut self.reader, Span { lost_upto, ..self.span });
        if let (Some(cuts), Some(limit)) = (&self.cuts, reader.upto()) {
            let Some((upto, stamp)) = cuts.upto(span.since, limit) else { return Piece::TooMuch };
            reader.keep_upto(stamp);
            if reader.read().is_empty() {
                // Nothing stands any more of what these packages said. Of no state the newest stamp could be told.
                return Piece::TooMuch;
            }
            let changed_upto = Some(cuts.newest).filter(|_| !mutation::is(Mutation::PieceUnsaid));
            let is_cut = changed_upto.is_some();
            span = Span {
                upto,
                changed_upto,
                says_upto: None,
                is_cut,
                is_of_all: is_cut && cuts.has_all,
                ..span
            };
        }
        let rest = reader.upto();
        self.ended_at = span.upto;
        match reader.take() {
            Some(state) => Piece::State(span, state, rest),
            None => Piece::Nothing(span),
        }
    }

    /// Reads the same once more, with a larger limit. `false` if there is nothing to cut it by. O(cubes).
    pub fn restart(&mut self, bytes_max: usize) -> bool {
        if self.cuts.is_some() {
            self.reader.restart(self.newer_than);
            self.bytes_max = bytes_max;
        }
        self.cuts.is_some()
    }

    /// The newest package of the piece that was taken last.
    pub const fn ended_at(&self) -> u32 {
        self.ended_at
    }

    /// The newest package of the whole state.
    pub const fn newest(&self) -> u32 {
        self.span.upto
    }

    /// Whether there is something of packages after this one, and all of it.
    pub fn has(&self, since: u32) -> bool {
        (self.listed_since..self.span.upto).contains(&since)
    }

    /// Reads a further piece of the same state: what is newer than the stamp, of packages after `since`. `false` if
    /// [there is none](Self::has). O(cubes).
    pub fn go_on(&mut self, since: u32, newer_than: Option<Stamp>, bytes_max: usize) -> bool {
        let has_it = self.has(since);
        if has_it {
            (self.span.since, self.newer_than, self.bytes_max) = (since, newer_than, bytes_max);
            self.reader.restart(newer_than);
        }
        has_it
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
        Span::new(stream, since, upto)
    }

    /// All pieces of a layer, one after the other, each as large as it has to be.
    fn pieces(layer: &Layer, cuts: &Cuts, bytes_max: usize) -> Vec<(Span, SnapshotVoxels)> {
        let mut pieces = Vec::new();
        let mut reader = PieceReader::new(layer, span(0, cuts.newest), None, Some(cuts.clone()), bytes_max);
        loop {
            let mut bytes_max = bytes_max;
            let (of, state, rest) = loop {
                while reader.step(1) > 0 {}
                match reader.take() {
                    Piece::State(of, state, rest) => break (of, state, rest),
                    Piece::Nothing(_) => return pieces,
                    Piece::TooMuch => {
                        bytes_max = 2 * bytes_max.max(1);
                        assert!(reader.restart(bytes_max));
                    }
                }
            };
            pieces.push((of, state));
            if rest.is_none() {
                return pieces;
            }
            assert!(reader.go_on(of.upto, rest, bytes_max));
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
            let cuts = Cuts { stamps, newest: seen.len() as u32, has_all: true, changed_upto: None, says_upto: None };
            let (mut together, mut before) = (Layer::default(), 0);
            for (of, state) in pieces(&layer, &cuts, bytes_max) {
                prop_assert!(of.since == before && of.upto > before && !state.is_empty());
                before = of.upto;
                for (stamp, part) in state.parts() {
                    prop_assert!(stamp.0 <= i64::from(of.upto) * 10 && stamp.0 > i64::from(of.since) * 10);
                    together.apply(&part, stamp);
                }
                prop_assert_eq!(of.changed_upto, (of.upto < cuts.newest).then_some(cuts.newest));
                prop_assert_eq!((of.is_cut, of.is_of_all), (of.changed_upto.is_some(), of.changed_upto.is_some()));
            }
            prop_assert_eq!(before, cuts.newest, "all packages are contained");
            prop_assert_eq!(together.digest(), layer.digest());
        }
    }
}
