//! Snapshots for others that are being made, a slice at a time.

use std::collections::VecDeque;

use flockmap_codec::{Codec, EncodeError, Encoder, Package, SnapshotCoding, Span};
use flockmap_grid::{Layer, Resolution, SnapshotVoxels, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};
use flockmap_sync::Cuts;

use crate::piece::{Piece, PieceReader};

/// Steps of work in one call: some 5 ms of a slow core. Each may take a cube, a chunk or the beginning of a part
/// more.
const STEPS_MAX: u64 = 1_500_000;
/// Reading a block of a layer, in steps of the codec.
const BLOCK_STEPS: u64 = 8_000;
/// Looking whether a sensor is that of a stamp that was read.
const SENSOR_STEPS: u64 = 32;
/// Most snapshots that are wanted at a time, each of another stream. The session asks again for what finds no place.
const MAKING_MAX: usize = 8;
/// Most bytes that one may take while it is made, beside its chunks: 30 million voxels of LiDAR scans take half.
pub(crate) const BYTES_MAX: usize = 256 << 20;
/// Bytes that a piece may take while it is made for each byte that its chunks may have together: a voxel takes 7 bits or
/// more here, and one to three in chunks of `flock`.
const PIECE_SHARE: usize = 3;

/// Makes snapshots of layers as they were when they were wanted, one after the other. Of the layers it keeps copies,
/// which take what the layers change or forget meanwhile.
#[derive(Default)]
pub(crate) struct Snapshots {
    making: VecDeque<Making>,
    /// What is left of the steps of this call.
    left: u64,
    /// Most steps that were taken in one call, and of those that went beyond the limit, by how many.
    most: u64,
}

struct Making {
    stream: Stream,
    /// Of a chunk.
    bytes_max: usize,
    /// Bytes that a piece may take, if all of it is too much.
    piece_bytes: usize,
    reader: PieceReader,
    /// Of what was read.
    coding: Option<Box<(SnapshotCoding<SnapshotVoxels>, Encoder)>>,
}

/// A snapshot that is wanted.
pub(crate) struct Wanted {
    pub(crate) span: Span,
    pub(crate) newer_than: Option<Stamp>,
    /// Of a chunk.
    pub(crate) bytes_max: usize,
    /// By what it may be cut, if a piece will do.
    pub(crate) cuts: Option<Cuts>,
}

/// How the chunks of a robot are made.
#[derive(Clone, Copy)]
pub(crate) struct Form {
    pub(crate) codec: Codec,
    pub(crate) resolution: Resolution,
    /// Chunks of more bytes are of no use to the session.
    pub(crate) chunks_bytes_max: usize,
    /// Bytes that a piece may take while it is made, as a rule.
    pub(crate) piece_bytes: usize,
}

impl Snapshots {
    /// A call begins: it has time for a slice of work.
    pub(crate) const fn note_call(&mut self) {
        self.left = STEPS_MAX;
    }

    /// Begins one of a layer as it is now, or of what of it is newer than a stamp, unless one of the stream is being
    /// made, or there are too many. O(cubes).
    pub(crate) fn begin(&mut self, layer: &Layer, wanted: Wanted, form: Form) {
        let stream = wanted.span.stream;
        if self.making.len() < MAKING_MAX && !self.is_making(stream) {
            self.making.push_back(Making::new(layer, wanted, form));
        }
    }

    /// Goes on with the one that was begun first, as far as this call has time for it. Returns the stream and the
    /// chunks of one that is complete, none if it would take too much memory; `None` if nothing is left to do in
    /// this call.
    pub(crate) fn go_on(&mut self, form: Form) -> Option<(Stream, Result<Vec<Package>, EncodeError>)> {
        while self.left > 0
            && let Some(making) = self.making.front_mut()
        {
            let (steps, made) = match making.step(form, self.left) {
                Ok((steps, made)) => (steps, made.map(Ok)),
                Err(error) => (1, Some(Err(error))),
            };
            let beyond = steps.saturating_sub(self.left);
            self.left = self.left.saturating_sub(steps);
            self.most = self.most.max(STEPS_MAX - self.left + beyond);
            if let Some(result) = made {
                return self.making.pop_front().map(|making| (making.stream, result));
            }
        }
        None
    }

    /// Lets go of the one of a stream.
    pub(crate) fn forget(&mut self, stream: Stream) {
        self.making.retain(|making| making.stream != stream);
    }

    /// The streams of those being made.
    pub(crate) fn streams(&self) -> impl Iterator<Item = Stream> + '_ {
        self.making.iter().map(|making| making.stream)
    }

    fn is_making(&self, stream: Stream) -> bool {
        self.streams().any(|other| other == stream)
    }

    /// Whether there is work.
    pub(crate) fn is_busy(&self) -> bool {
        !self.making.is_empty()
    }

    /// Most steps of work that were taken in one call.
    pub(crate) const fn steps_most(&self) -> u64 {
        self.most
    }
}

impl Making {
    fn new(layer: &Layer, wanted: Wanted, form: Form) -> Self {
        let Wanted { mut span, newer_than, bytes_max, cuts } = wanted;
        let lost_upto = layer.lost_upto().filter(|lost| newer_than.is_none_or(|limit| *lost > limit));
        span.lost_upto = lost_upto.filter(|_| !mutation::is(Mutation::DropUnsaid));
        let piece_bytes = form.piece_bytes.min(PIECE_SHARE.saturating_mul(form.chunks_bytes_max));
        let reader = PieceReader::new(layer, span, newer_than, cuts, piece_bytes);
        Self { stream: span.stream, bytes_max, piece_bytes, reader, coding: None }
    }

    /// Does some of it. Returns the steps taken, and the chunks when they are made.
    fn step(&mut self, form: Form, steps_max: u64) -> Result<(u64, Option<Vec<Package>>), EncodeError> {
        if let Some(coding) = &mut self.coding {
            let (coding, encoder) = &mut **coding;
            // The paper's codec, which is tried after `flock`, may need half of it.
            if coding.bytes() > 2 * form.chunks_bytes_max {
                return Ok((1, Some(Vec::new())));
            }
            return encoder.go_on(coding, steps_max);
        }
        let blocks = self.reader.step(steps_max.div_ceil(BLOCK_STEPS) as usize);
        let steps = blocks as u64 * BLOCK_STEPS;
        if self.reader.bytes() > BYTES_MAX {
            return Ok((steps, Some(Vec::new())));
        }
        if blocks > 0 {
            return Ok((steps, None));
        }
        let (span, state) = match self.reader.take() {
            Piece::State(span, state, _) => (span, state),
            Piece::Nothing(span) => {
                let nothing = Package::of_dropped(span, form.resolution);
                return Ok((1, Some(nothing.into_iter().collect())));
            }
            Piece::TooMuch => {
                self.piece_bytes *= 2;
                let is_begun = self.piece_bytes <= BYTES_MAX && self.reader.restart(self.piece_bytes);
                return Ok((1, (!is_begun).then(Vec::new)));
            }
        };
        let steps = BLOCK_STEPS + SENSOR_STEPS * state.sensors().len() as u64;
        let coding = SnapshotCoding::new(form.codec, span, form.resolution, state, self.bytes_max)?;
        self.coding = Some(Box::new((coding, Encoder::new())));
        Ok((steps, None))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::{Changes, RobotId, State, Voxel};

    const FORM: Form = Form {
        codec: Codec::Flock,
        resolution: match Resolution::from_micrometres(100_000) {
            Some(resolution) => resolution,
            None => panic!("a resolution"),
        },
        chunks_bytes_max: 1 << 20,
        piece_bytes: crate::PIECE_BYTES,
    };

    fn span(origin: u16) -> Span {
        let stream = Stream { origin: RobotId(origin), epoch: 1 };
        Span { stream, since: 0, upto: 1, lost_upto: None, changed_upto: None, is_cut: false }
    }

    fn wanted(origin: u16, newer_than: Option<Stamp>) -> Wanted {
        Wanted { span: span(origin), newer_than, bytes_max: 1_150, cuts: None }
    }

    fn layer() -> Layer {
        let mut layer = Layer::default();
        let cube = (0..16).flat_map(|x| (0..16).flat_map(move |y| (0..16).map(move |z| (x, y, z))));
        let voxels = cube.map(|(x, y, z)| (Voxel::new(x, y, z), State::Free));
        layer.apply(&Changes::from_voxels(voxels), Stamp(1));
        layer
    }

    #[test]
    fn each_stream_has_one_at_a_time_and_they_come_in_the_order_in_which_they_were_wanted() {
        let (layer, mut snapshots) = (layer(), Snapshots::default());
        for origin in [3, 1, 3, 2, 1] {
            snapshots.begin(&layer, wanted(origin, None), FORM);
        }
        assert!(snapshots.go_on(FORM).is_none(), "no call has begun");
        snapshots.note_call();
        let mut made = Vec::new();
        while let Some((stream, chunks)) = snapshots.go_on(FORM) {
            assert!(!chunks.unwrap().is_empty());
            made.push(stream.origin.0);
        }
        assert_eq!(made, [3, 1, 2]);
        assert!(!snapshots.is_busy());
    }

    #[test]
    fn one_whose_layer_is_forgotten_is_let_go_of() {
        let (layer, mut snapshots) = (layer(), Snapshots::default());
        snapshots.begin(&layer, wanted(1, None), FORM);
        snapshots.begin(&layer, wanted(2, None), FORM);
        snapshots.forget(span(1).stream);
        snapshots.note_call();
        assert_eq!(snapshots.go_on(FORM).map(|(stream, _)| stream), Some(span(2).stream));
        assert!(!snapshots.is_busy());
    }

    #[test]
    fn no_more_wait_than_have_a_place_and_what_is_too_long_is_none() {
        let (layer, mut snapshots) = (layer(), Snapshots::default());
        for origin in 0..20 {
            snapshots.begin(&layer, wanted(origin, None), FORM);
        }
        assert_eq!(snapshots.streams().count(), MAKING_MAX);
        snapshots.forget(span(0).stream);
        snapshots.begin(&layer, wanted(0, Some(Stamp(1))), FORM);
        assert_eq!(snapshots.streams().last(), Some(span(0).stream));
        let mut made = Vec::new();
        for _ in 0..20 {
            snapshots.note_call();
            made.extend(std::iter::from_fn(|| snapshots.go_on(FORM)));
        }
        let last = made.last().map(|(stream, chunks)| (*stream, chunks.as_ref().map_or(9, Vec::len)));
        assert_eq!(last, Some((span(0).stream, 0)), "nothing is newer");
    }
}
