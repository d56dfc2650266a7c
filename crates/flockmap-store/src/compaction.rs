//! A segment that says in few bytes what all before it say: the snapshot of each stream. Made from copies
//! that the robot gives stream by stream, so that it can be coded and written on another thread.

use std::fmt;
use std::io::ErrorKind;
use std::sync::Arc;

use flockmap::codec::{ContentKind, Encoder, PACKAGE_BYTES_MAX, Span};
use flockmap::grid::Layer;
use flockmap::sync::{Cuts, IntervalSet};
use flockmap::{Codec, PIECE_BYTES, Package, Piece, PieceReader, Resolution, Robot, Stream};

use crate::log::create;
use crate::record::{Contents, Record};
use crate::segment::{HEADERS_BYTES, SegmentHeader};
use crate::{Disk, DiskFile};

/// What the name of a compacted segment ends with until it is complete.
pub(crate) const UNFINISHED: &str = ".unfinished";

/// Records are handed to the system in portions of about so many bytes.
const PORTION_BYTES: usize = 64 << 10;

/// A copy of what a robot has of one stream.
pub struct StreamCopy {
    stream: Stream,
    codec: Codec,
    resolution: Resolution,
    what: What,
}

enum What {
    /// All packages received are in the layer, but for what was dropped of them.
    State { layer: Box<Layer>, received: IntervalSet, cuts: Cuts },
    /// The layer lacks what some of them say.
    Packages(Vec<Package>),
    /// And they are not all there any more.
    Nothing(&'static str),
}

const OWN_LAYER_LACKS: &str =
    "there was no place for the own layer, and not all own packages are in memory any more";

impl StreamCopy {
    /// The first stream after `after` that the robot has something of, with no event of the robot left
    /// unread. Copies its layer, which shares its cubes: O(cubes).
    pub fn next(robot: &Robot, after: Option<Stream>) -> Option<Self> {
        let later = robot.session().streams().filter(|stream| after.is_none_or(|after| *stream > after));
        later.into_iter().find_map(|stream| {
            Some(Self {
                stream,
                codec: robot.config().codec,
                resolution: robot.config().mapper.resolution,
                what: What::of(robot, stream)?,
            })
        })
    }

    /// The stream.
    pub const fn stream(&self) -> Stream {
        self.stream
    }

    /// The records that make the same layer again.
    fn into_records(self, encoder: &mut Encoder) -> Result<Vec<Record>, String> {
        let Self { stream, codec, resolution, what } = self;
        let (layer, received, cuts) = match what {
            What::State { layer, received, cuts } => (layer, received, cuts),
            What::Packages(packages) => return Ok(packages.into_iter().map(Record::Package).collect()),
            What::Nothing(why) => return Err(why.into()),
        };
        let cannot = |why: &str| format!("the snapshot of {stream:?} cannot be coded: {why}");
        let Some(upto) = received.last() else { return Ok(Vec::new()) };
        // One of a history with gaps says by itself no more than its newest package.
        let is_whole = received.contains_range(1, upto);
        let since = if is_whole { 0 } else { upto - 1 };
        let says_upto = cuts.says_upto.filter(|said| *said > upto);
        let span = Span { changed_upto: cuts.changed_upto, says_upto, ..Span::new(stream, since, upto) };
        let cuts = Some(cuts).filter(|_| is_whole);
        let (mut chunks, mut bytes_max) = (Vec::new(), PIECE_BYTES);
        let mut reader = PieceReader::new(&layer, span, None, cuts, bytes_max);
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
        Ok(chunks.into_iter().map(Record::Package).chain(contents.map(Record::Contents)).collect())
    }
}

impl What {
    fn of(robot: &Robot, stream: Stream) -> Option<Self> {
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
        Some(Self::State { layer: Box::new(layer?.clone()), received: received.clone(), cuts })
    }
}

/// A compacted segment that is being written. Dropped before its end, it leaves a file behind that the next
/// start removes.
pub struct Compaction {
    disk: Arc<dyn Disk>,
    header: SegmentHeader,
    name: String,
    /// What is being written, or why it cannot be.
    file: Result<Box<dyn DiskFile>, String>,
    seed: u32,
    bytes: u64,
    bytes_max: u64,
    encoder: Encoder,
    last: Option<Stream>,
}

/// The end of a compaction, for [`StoreLog::end_compaction`](crate::StoreLog::end_compaction).
#[derive(Debug)]
pub struct Compacted {
    pub(crate) header: SegmentHeader,
    /// Its bytes, or why there is none.
    pub(crate) result: Result<u64, String>,
    /// Nothing of it is there but what counts.
    pub(crate) is_gone: bool,
}

impl Compaction {
    /// What goes wrong here and later is reported at its end.
    pub(crate) fn begin(disk: Arc<dyn Disk>, header: SegmentHeader, bytes_max: u64) -> Self {
        let name = header.name() + UNFINISHED;
        let file = create(&*disk, &header, &name)
            .map_err(|error| format!("cannot begin a compacted segment: {error}"));
        Self {
            disk,
            header,
            name,
            file,
            seed: header.seed(),
            bytes: HEADERS_BYTES as u64,
            bytes_max,
            encoder: Encoder::new(),
            last: None,
        }
    }

    /// Copies and writes the next stream of the robot, with no event of the robot left unread. `false`: there
    /// is none any more, or it has failed; then it is to be [finished](Self::finish).
    pub fn step(&mut self, robot: &Robot) -> bool {
        StreamCopy::next(robot, self.last).is_some_and(|copy| self.add(copy))
    }

    /// Writes one stream. `false`: it has failed.
    pub fn add(&mut self, copy: StreamCopy) -> bool {
        self.last = Some(copy.stream);
        if self.file.is_ok()
            && let Err(why) = self.write(copy)
        {
            self.file = Err(why);
        }
        self.file.is_ok()
    }

    fn write(&mut self, copy: StreamCopy) -> Result<(), String> {
        let file = self.file.as_mut().map_err(|why| why.clone())?;
        let mut buffer = Vec::new();
        let mut records = copy.into_records(&mut self.encoder)?.into_iter().peekable();
        while let Some(record) = records.next() {
            record.write(self.seed, &mut buffer);
            if records.peek().is_none() || buffer.len() >= PORTION_BYTES {
                self.bytes += buffer.len() as u64;
                if self.bytes > self.bytes_max {
                    return Err(format!(
                        "the map by itself takes more than {} bytes, and bytes_max leaves it no more (at most 7/16): raise it",
                        self.bytes_max
                    ));
                }
                file.write_all(&buffer).map_err(|error| format!("cannot write: {error}"))?;
                buffer.clear();
            }
        }
        Ok(())
    }

    /// Makes it safe, and gives it its name: from here on it counts, and all before it does not.
    pub fn finish(self) -> Compacted {
        let Self { disk, header, name, file, bytes, .. } = self;
        let finish = |mut file: Box<dyn DiskFile>| {
            file.sync()?;
            drop(file);
            disk.rename(&name, &header.name())?;
            disk.sync_folder()
        };
        let result = file.and_then(|file| {
            finish(file).map_err(|error| format!("cannot finish a compacted segment: {error}"))
        });
        // What is left is removed at the next start, or is whole and counts.
        let remove = |name: &str| {
            disk.remove(name).map_or_else(|error| error.kind() == ErrorKind::NotFound, |()| true)
        };
        let is_gone = result.is_ok() || (remove(&name) & remove(&header.name()));
        Compacted { header, result: result.map(|()| bytes), is_gone }
    }

    /// Takes the file away again.
    pub fn abandon(mut self, why: &str) -> Compacted {
        self.file = Err(why.to_owned());
        self.finish()
    }
}

impl fmt::Debug for Compaction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Compaction").field("name", &self.name).finish_non_exhaustive()
    }
}
