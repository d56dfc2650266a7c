//! A copy of what a robot has of one stream, which another thread makes into few bytes: for the disk, or for whoever comes
//! late.

use flockmap::codec::{ContentKind, Encoder, PACKAGE_BYTES_MAX, Span};
use flockmap::grid::Layer;
use flockmap::sync::{Cuts, IntervalSet};
use flockmap::{Codec, PIECE_BYTES, Package, Piece, PieceReader, Resolution, Robot, Stamp, Stream};

use crate::record::Contents;

/// A copy of what a robot has of one stream.
pub struct StreamCopy {
    stream: Stream,
    codec: Codec,
    resolution: Resolution,
    what: What,
}

/// What makes a layer again: packages, or the chunks of snapshots, in the order in which they can be read.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Coded {
    /// Packages or chunks.
    pub packages: Vec<Package>,
    /// Behind the chunks of a history with gaps: what it contains.
    pub contents: Option<Contents>,
}

enum What {
    /// All packages received are in the layer, but for what was dropped of them.
    /// `newer`: only what packages after one changed is wanted, which is newer than a stamp.
    State { layer: Box<Layer>, received: IntervalSet, newer: Option<(u32, Stamp)>, cuts: Cuts },
    /// The layer lacks what some of them say.
    Packages(Vec<Package>),
    /// And they are not all there any more.
    Nothing(&'static str),
}

const OWN_LAYER_LACKS: &str =
    "there was no place for the own layer, and not all own packages are in memory any more";

impl StreamCopy {
    /// What the robot has of a stream, with no event of the robot left unread; of it what who holds packages 1 to `since`
    /// lacks, as far as that is known, else all. `None` if it has nothing. Copies the layer, which shares its cubes:
    /// O(cubes).
    pub fn of(robot: &Robot, stream: Stream, since: u32) -> Option<Self> {
        let (codec, resolution) = (robot.config().codec, robot.config().mapper.resolution);
        Some(Self { stream, codec, resolution, what: What::of(robot, stream, since)? })
    }

    /// The first stream after `after` that the robot has something of, with no event of the robot left
    /// unread. Copies its layer, which shares its cubes: O(cubes).
    pub fn next(robot: &Robot, after: Option<Stream>) -> Option<Self> {
        let later = robot.session().streams().filter(|stream| after.is_none_or(|after| *stream > after));
        later.into_iter().find_map(|stream| Self::of(robot, stream, 0))
    }

    /// The stream.
    pub const fn stream(&self) -> Stream {
        self.stream
    }

    /// What makes the same layer again. Some 0.2 µs for each voxel.
    ///
    /// # Errors
    /// What was in the way.
    pub fn code(self, encoder: &mut Encoder) -> Result<Coded, String> {
        let Self { stream, codec, resolution, what } = self;
        let (layer, received, newer, cuts) = match what {
            What::State { layer, received, newer, cuts } => (layer, received, newer, cuts),
            What::Packages(packages) => return Ok(Coded { packages, contents: None }),
            What::Nothing(why) => return Err(why.into()),
        };
        let cannot = |why: &str| format!("the snapshot of {stream:?} cannot be coded: {why}");
        let Some(upto) = received.last() else { return Ok(Coded::default()) };
        // One of a history with gaps says by itself no more than its newest package.
        let is_whole = received.contains_range(1, upto);
        let newer = newer.filter(|(since, _)| is_whole && *since < upto);
        let since = newer.map_or(if is_whole { 0 } else { upto - 1 }, |(since, _)| since);
        let says_upto = cuts.says_upto.filter(|said| *said > upto);
        let span = Span { changed_upto: cuts.changed_upto, says_upto, ..Span::new(stream, since, upto) };
        let cuts = Some(cuts).filter(|_| is_whole);
        let (mut chunks, mut bytes_max) = (Vec::new(), PIECE_BYTES);
        let mut reader = PieceReader::new(&layer, span, newer.map(|(_, stamp)| stamp), cuts, bytes_max);
        loop {
            while reader.step(usize::MAX) > 0 {}
            match reader.take() {
                Piece::TooMuch => {
                    bytes_max = bytes_max.saturating_mul(2);
                    reader.restart(bytes_max);
                }
                Piece::State(of, state, rest) => {
                    let piece = encoder.encode_span(codec, of, resolution, &state, PACKAGE_BYTES_MAX);
                    chunks.extend(piece.map_err(|error| cannot(&error.to_string()))?);
                    bytes_max = PIECE_BYTES;
                    if rest.is_none() || !reader.go_on(of.upto, rest, bytes_max) {
                        break;
                    }
                }
                Piece::Nothing(of) => {
                    chunks.extend(Package::of_dropped(of, resolution));
                    break;
                }
            }
        }
        let contents = match chunks.first().map(|chunk| chunk.header().content) {
            Some(ContentKind::Snapshot { id: snapshot_id, .. }) if !is_whole => {
                Some(Contents { stream, snapshot_id, intervals: received.intervals().to_vec() })
            }
            _ => None,
        };
        Ok(Coded { packages: chunks, contents })
    }
}

impl What {
    fn of(robot: &Robot, stream: Stream, since: u32) -> Option<Self> {
        let (session, received) = (robot.session(), robot.session().received(stream)?);
        let stored = || session.store().range(stream, 1, u32::MAX).map(|(_, p)| p.package.clone());
        let layer = robot.fusion().layer(stream);
        let lacks_packages = stream == robot.own_stream() && !robot.own_layer_has_all();
        if lacks_packages || layer.is_some_and(|layer| layer.lost_upto().is_some()) {
            let packages: Vec<Package> = stored().collect();
            let is_all = packages.len() as u64 == received.count();
            if is_all || lacks_packages {
                return Some(if is_all { Self::Packages(packages) } else { Self::Nothing(OWN_LAYER_LACKS) });
            }
        }
        let cuts = session.cuts(stream, received.prefix());
        let newer = session.store().newer_than(stream, since).map(|stamp| (since, stamp));
        Some(Self::State { layer: Box::new(layer?.clone()), received: received.clone(), newer, cuts })
    }
}
