//! Snapshots for others that are being made, a slice at a time.

use std::collections::VecDeque;

use flockmap_codec::{Codec, EncodeError, Encoder, Package, SnapshotCoding, Span};
use flockmap_grid::{Layer, Resolution, SnapshotVoxels, Stamp, Stream};
use flockmap_sync::Cuts;

use crate::piece::{Piece, PieceReader};

/// Steps of work in one call: some 15 ms on the machine of `BENCHMARK.md`. Each may take a cube, a chunk or
/// the beginning of a part more.
const STEPS_MAX: u64 = 1_500_000;
/// Reading a block of a layer, in steps of the codec.
const BLOCK_STEPS: u64 = 8_000;
/// Looking whether a sensor is that of a stamp that was read.
const SENSOR_STEPS: u64 = 32;
/// Listing a cube that is to be read.
const CUBE_STEPS: u64 = 40;
/// Most snapshots that wait for their turn, each of another stream. The session asks again for what finds no place.
const WANTED_MAX: usize = 8;
/// Most bytes that one may take while it is made, beside its chunks: 30 million voxels of LiDAR scans take half.
pub(crate) const BYTES_MAX: usize = 256 << 20;
/// States kept of which only a piece was made so far: what is there twice for them, all together. Beyond, the one that was
/// used longest ago goes.
pub(crate) const KEPT_BYTES_MAX: usize = 32 << 20;
const KEPT_MAX: usize = 8;
/// Bytes that a piece may take while it is made for each byte that its chunks may have together: a voxel takes 7 bits or
/// more here, and one to three in chunks of `flock`.
const PIECE_SHARE: usize = 3;

/// Makes the snapshots that are wanted one after the other, each of a layer as it is when its turn comes. It shares the
/// cubes of that layer, and keeps those that the layer changes or forgets meanwhile. All pieces of a state are of the layer
/// as it was when the first one was begun: what is dropped of it meanwhile, they say all the same.
#[derive(Default)]
pub(crate) struct Snapshots {
    wanted: VecDeque<Wanted>,
    making: Option<Making>,
    /// What further pieces are made of, those used last at the end.
    kept: VecDeque<Source>,
    /// What is left of the steps of this call.
    left: u64,
    /// Most steps that were taken in one call, and of those that went beyond the limit, by how many.
    most: u64,
}

struct Making {
    source: Source,
    /// Of a chunk.
    bytes_max: usize,
    /// Bytes that a piece may take, if all of it is too much.
    piece_bytes: usize,
    /// Further pieces are to be made.
    is_cut: bool,
    /// Of what was read.
    coding: Option<Box<(SnapshotCoding<SnapshotVoxels>, Encoder)>>,
}

/// What a snapshot is made of.
struct Source {
    stream: Stream,
    reader: PieceReader,
    /// [`Layer::bytes_left_in_copies`] when it was begun.
    left: u64,
}

/// A snapshot that is wanted: of packages 1 to `upto` of a stream, or what of it is newer than a stamp.
#[derive(Clone, Copy)]
pub(crate) struct Wanted {
    pub(crate) stream: Stream,
    pub(crate) since: u32,
    pub(crate) upto: u32,
    pub(crate) newer_than: Option<Stamp>,
    /// Of a chunk.
    pub(crate) bytes_max: usize,
    /// A piece of it will do.
    pub(crate) in_pieces: bool,
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

    /// Notes that one is wanted, unless one of the stream is already, or there are too many.
    pub(crate) fn want(&mut self, wanted: Wanted) {
        if self.wanted.len() < WANTED_MAX && self.streams().all(|stream| stream != wanted.stream) {
            self.wanted.push_back(wanted);
        }
    }

    /// The one whose turn it is to [begin](Self::begin), if this call has time for it.
    pub(crate) fn take_turn(&mut self) -> Option<Wanted> {
        if self.making.is_none() && self.left > 0 { self.wanted.pop_front() } else { None }
    }

    /// Begins one of a layer as it is now, or the next piece of one as it was. O(cubes).
    pub(crate) fn begin(&mut self, layer: &Layer, wanted: Wanted, cuts: Cuts, form: Form) {
        let kept = self.kept_for(&wanted).and_then(|at| self.kept.remove(at));
        let making = Making::new(layer, wanted, cuts, form, kept);
        self.spend(CUBE_STEPS * making.source.reader.cubes() as u64);
        self.making = Some(making);
    }

    /// The state of which a piece ended where this one is to begin; or another one of the stream that has all packages up to
    /// the wanted one: who wants a piece of an older state once more may lack what is newer.
    fn kept_for(&self, wanted: &Wanted) -> Option<usize> {
        let is_of = |source: &Source| source.stream == wanted.stream && source.reader.has(wanted.since);
        let ends_there = |source: &Source| is_of(source) && source.reader.ended_at() == wanted.since;
        let has_all = |source: &Source| is_of(source) && source.reader.newest() >= wanted.upto;
        let (exact, other) = (self.kept.iter().rposition(ends_there), self.kept.iter().rposition(has_all));
        exact.or(other).filter(|_| wanted.in_pieces && wanted.since > 0)
    }

    /// Lets go of what was kept for further pieces where that is too much by now. `left`: of a layer that is there, its
    /// [`Layer::bytes_left_in_copies`].
    pub(crate) fn trim_kept(&mut self, left: impl Fn(Stream) -> Option<u64>) {
        self.kept.retain(|source| left(source.stream).is_some());
        let bytes = |source: &Source| {
            let alone = left(source.stream).map_or(0, |left| left.saturating_sub(source.left));
            source.reader.bytes_beside() as u64 + alone
        };
        while self.kept.len() > KEPT_MAX || self.kept.iter().map(bytes).sum::<u64>() > KEPT_BYTES_MAX as u64 {
            self.kept.pop_front();
        }
    }

    /// Goes on with the one that was begun, as far as this call has time for it. Returns the stream and the chunks of
    /// one that is complete, none if it would take too much memory; `None` if nothing is left to do in this call.
    pub(crate) fn go_on(&mut self, form: Form) -> Option<(Stream, Result<Vec<Package>, EncodeError>)> {
        while self.left > 0
            && let Some(making) = &mut self.making
        {
            let (steps, made) = match making.step(form, self.left) {
                Ok((steps, made)) => (steps, made.map(Ok)),
                Err(error) => (1, Some(Err(error))),
            };
            self.spend(steps);
            if let Some(result) = made {
                let Making { source, is_cut, .. } = self.making.take()?;
                let stream = source.stream;
                self.kept.extend(Some(source).filter(|_| is_cut));
                return Some((stream, result));
            }
        }
        None
    }

    fn spend(&mut self, steps: u64) {
        let beyond = steps.saturating_sub(self.left);
        self.left = self.left.saturating_sub(steps);
        self.most = self.most.max(STEPS_MAX - self.left + beyond);
    }

    /// Lets go of the one of a stream.
    pub(crate) fn forget(&mut self, stream: Stream) {
        self.wanted.retain(|wanted| wanted.stream != stream);
        self.kept.retain(|source| source.stream != stream);
        self.making.take_if(|making| making.source.stream == stream);
    }

    /// The streams of those that are wanted or being made.
    pub(crate) fn streams(&self) -> impl Iterator<Item = Stream> + '_ {
        self.making
            .iter()
            .map(|making| making.source.stream)
            .chain(self.wanted.iter().map(|wanted| wanted.stream))
    }

    /// Whether there is work.
    pub(crate) fn is_busy(&self) -> bool {
        self.making.is_some() || !self.wanted.is_empty()
    }

    /// Most steps of work that were taken in one call.
    pub(crate) const fn steps_most(&self) -> u64 {
        self.most
    }
}

impl Making {
    /// `kept`: of the same stream, a state of which a piece was made.
    fn new(layer: &Layer, wanted: Wanted, cuts: Cuts, form: Form, mut kept: Option<Source>) -> Self {
        let Wanted { stream, since, upto, newer_than, bytes_max, in_pieces } = wanted;
        let piece_bytes = form.piece_bytes.min(PIECE_SHARE.saturating_mul(form.chunks_bytes_max));
        let begin = || {
            let Cuts { changed_upto, says_upto, .. } = cuts;
            let span = Span { changed_upto, says_upto, ..Span::new(stream, since, upto) };
            let cuts = Some(cuts).filter(|_| in_pieces);
            let reader = PieceReader::new(layer, span, newer_than, cuts, piece_bytes);
            Source { stream, reader, left: layer.bytes_left_in_copies() }
        };
        let source =
            kept.take_if(|source| source.reader.go_on(since, newer_than, piece_bytes)).unwrap_or_else(begin);
        Self { source, bytes_max, piece_bytes, is_cut: false, coding: None }
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
        let blocks = self.source.reader.step(steps_max.div_ceil(BLOCK_STEPS) as usize);
        let steps = blocks as u64 * BLOCK_STEPS;
        if self.source.reader.bytes() > BYTES_MAX {
            return Ok((steps, Some(Vec::new())));
        }
        if blocks > 0 {
            return Ok((steps, None));
        }
        let (span, state) = match self.source.reader.take() {
            Piece::State(span, state, rest) => {
                self.is_cut = rest.is_some();
                (span, state)
            }
            Piece::Nothing(span) => {
                let nothing = Package::of_dropped(span, form.resolution);
                return Ok((1, Some(nothing.into_iter().collect())));
            }
            Piece::TooMuch => {
                self.piece_bytes = self.piece_bytes.max(1).saturating_mul(2);
                let is_begun = self.piece_bytes <= BYTES_MAX && self.source.reader.restart(self.piece_bytes);
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

    fn stream(origin: u16) -> Stream {
        Stream { origin: RobotId(origin), epoch: 1 }
    }

    fn wanted(origin: u16, newer_than: Option<Stamp>) -> Wanted {
        Wanted { stream: stream(origin), since: 0, upto: 1, newer_than, bytes_max: 1_150, in_pieces: false }
    }

    /// The next one that is made in this call, of the same layer as all others.
    fn go_on(
        snapshots: &mut Snapshots,
        layer: &Layer,
    ) -> Option<(Stream, Result<Vec<Package>, EncodeError>)> {
        if let Some(wanted) = snapshots.take_turn() {
            let cuts =
                Cuts { stamps: Vec::new(), newest: 1, has_all: true, changed_upto: None, says_upto: None };
            snapshots.begin(layer, wanted, cuts, FORM);
        }
        snapshots.go_on(FORM)
    }

    /// Makes what is wanted, in as many calls as it takes.
    fn make(snapshots: &mut Snapshots, layer: &Layer, cuts: Cuts, form: Form) -> Vec<Package> {
        snapshots.note_call();
        let wanted = snapshots.take_turn().unwrap();
        snapshots.begin(layer, wanted, cuts, form);
        let made = (0..1_000).find_map(|_| {
            snapshots.note_call();
            snapshots.go_on(form)
        });
        made.expect("no endless loop").1.unwrap()
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
            snapshots.want(wanted(origin, None));
        }
        assert!(go_on(&mut snapshots, &layer).is_none(), "no call has begun");
        snapshots.note_call();
        let mut made = Vec::new();
        while let Some((stream, chunks)) = go_on(&mut snapshots, &layer) {
            assert!(!chunks.unwrap().is_empty());
            made.push(stream.origin.0);
        }
        assert_eq!(made, [3, 1, 2]);
        assert!(!snapshots.is_busy());
    }

    #[test]
    fn a_piece_of_an_older_state_is_given_once_and_then_one_of_the_newest() {
        let (mut layer, form) = (Layer::default(), Form { piece_bytes: 1, ..FORM });
        let (mut snapshots, mut published) = (Snapshots::default(), 0);
        // (since, packages by then, the newest package of the state of which the piece is)
        for (since, newest, of) in [(0, 3, 3), (1, 5, 3), (1, 5, 5), (2, 5, 5)] {
            while published < newest {
                published += 1;
                let voxels = (0..8).map(|x| (Voxel::new(8 * published as i32 + x, 0, 0), State::Free));
                layer.apply(&Changes::from_voxels(voxels), Stamp(published.into()));
            }
            let stamps = (1..newest).map(|number| (number, Stamp(number.into()))).collect();
            let cuts = Cuts { stamps, newest, has_all: true, changed_upto: None, says_upto: None };
            let newer_than = (since > 0).then_some(Stamp(since.into()));
            snapshots.want(Wanted { since, upto: newest, in_pieces: true, ..wanted(1, newer_than) });
            let chunks = make(&mut snapshots, &layer, cuts, form);
            assert_eq!((chunks[0].header().index, chunks[0].header().changed_upto), (since + 1, Some(of)));
        }
    }

    #[test]
    fn a_limit_of_zero_for_a_piece_ends_in_a_piece() {
        let (mut layer, form) = (layer(), Form { piece_bytes: 0, ..FORM });
        // Nothing stands any more of package 1, so that no piece can end with it.
        for (stamp, x) in [(2, 0), (3, 100)] {
            let voxels = (0..16).flat_map(|y| (0..16).flat_map(move |z| (x..x + 16).map(move |x| (x, y, z))));
            let voxels = voxels.map(|(x, y, z)| (Voxel::new(x, y, z), State::Free));
            layer.apply(&Changes::from_voxels(voxels), Stamp(stamp));
        }
        let stamps = vec![(1, Stamp(1))];
        let cuts = Cuts { stamps, newest: 3, has_all: true, changed_upto: None, says_upto: None };
        let mut snapshots = Snapshots::default();
        snapshots.want(Wanted { in_pieces: true, upto: 3, ..wanted(1, None) });
        assert!(!make(&mut snapshots, &layer, cuts, form).is_empty());
    }

    #[test]
    fn one_whose_layer_is_forgotten_is_let_go_of() {
        let (layer, mut snapshots) = (layer(), Snapshots::default());
        snapshots.want(wanted(1, None));
        snapshots.want(wanted(2, None));
        snapshots.forget(stream(1));
        snapshots.note_call();
        assert_eq!(go_on(&mut snapshots, &layer).map(|(stream, _)| stream), Some(stream(2)));
        assert!(!snapshots.is_busy());
    }

    #[test]
    fn no_more_wait_than_have_a_place_and_what_is_too_long_is_none() {
        let (layer, mut snapshots) = (layer(), Snapshots::default());
        for origin in 0..20 {
            snapshots.want(wanted(origin, None));
        }
        assert_eq!(snapshots.streams().count(), WANTED_MAX);
        snapshots.forget(stream(0));
        snapshots.want(wanted(0, Some(Stamp(1))));
        assert_eq!(snapshots.streams().last(), Some(stream(0)));
        let mut made = Vec::new();
        for _ in 0..20 {
            snapshots.note_call();
            made.extend(std::iter::from_fn(|| go_on(&mut snapshots, &layer)));
        }
        let last = made.last().map(|(stream, chunks)| (*stream, chunks.as_ref().map_or(9, Vec::len)));
        assert_eq!(last, Some((stream(0), 0)), "nothing is newer");
    }

    #[test]
    fn what_is_kept_for_further_pieces_is_let_go_of_at_its_limit() {
        // Two stamps, each of which is too much for a piece.
        let mut layer = layer();
        let later = (0..16).map(|x| (Voxel::new(x, 40, 0), State::Free));
        layer.apply(&Changes::from_voxels(later), Stamp(2));
        let form = Form { piece_bytes: 1, ..FORM };
        let mut snapshots = Snapshots::default();
        let make = |snapshots: &mut Snapshots, since| {
            let cuts = Cuts {
                stamps: vec![(1, Stamp(1))],
                newest: 2,
                has_all: true,
                changed_upto: None,
                says_upto: None,
            };
            let newer_than = (since > 0).then_some(Stamp(1));
            snapshots.want(Wanted { since, upto: 2, in_pieces: true, ..wanted(1, newer_than) });
            snapshots.note_call();
            let wanted = snapshots.take_turn().unwrap();
            snapshots.begin(&layer, wanted, cuts, form);
            snapshots.go_on(form).unwrap().1.unwrap()
        };
        let header = *make(&mut snapshots, 0)[0].header();
        assert_eq!((header.index, header.changed_upto, header.is_of_all), (1, Some(2), true));
        let beside = snapshots.kept[0].reader.bytes_beside() as u64;
        let most = KEPT_BYTES_MAX as u64 - beside;
        snapshots.trim_kept(|_| Some(most));
        assert_eq!(snapshots.kept.len(), 1);
        snapshots.trim_kept(|_| Some(most + 1));
        assert_eq!(snapshots.kept.len(), 0);
        make(&mut snapshots, 0);
        snapshots.trim_kept(|_| None);
        assert_eq!(snapshots.kept.len(), 0, "the layer is gone");
        // The last piece leaves nothing to be kept.
        make(&mut snapshots, 0);
        let header = *make(&mut snapshots, 1)[0].header();
        assert_eq!((header.index, header.changed_upto, snapshots.kept.len()), (2, None, 0));
    }
}
