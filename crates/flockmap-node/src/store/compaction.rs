//! A segment that says in few bytes what all before it say: the present state of each stream. Made on a thread of its own, from copies that the robot
//! gives stream by stream.

use std::sync::Arc;

use flockmap::codec::{Encoder, PACKAGE_BYTES_MAX};
use flockmap::grid::Layer;
use flockmap::{Codec, Package, Resolution, Robot, Stream};

use super::log::{LogError, create};
use super::record::{HEADERS_BYTES, INTERVALS_MAX, Record, SegmentHeader};
use super::{Disk, DiskFile};

/// What the name of a compacted segment ends with until it is complete.
pub(super) const UNFINISHED: &str = ".unfinished";

/// Records are handed to the system in portions of about so many bytes.
const PORTION_BYTES: usize = 64 << 10;

/// A copy of what a robot has of one stream.
pub(super) struct StreamCopy {
    stream: Stream,
    codec: Codec,
    resolution: Resolution,
    /// All packages up to this one are in the layer.
    upto: u32,
    layer: Layer,
    /// Held beyond that, and in the layer too.
    beyond: Vec<(u32, u32)>,
    /// Of a stream of which not even the first package is held: packages as they came.
    packages: Vec<Package>,
}

impl StreamCopy {
    /// The first stream after `after` that the robot has something of. Copies its layer: 1 ms for 3 MB.
    pub(super) fn next(robot: &Robot, after: Option<Stream>) -> Option<Self> {
        let session = robot.session();
        let later = session.streams().filter(|stream| after.is_none_or(|after| *stream > after));
        later.into_iter().find_map(|stream| {
            let held = session.held(stream)?;
            let layer = robot.fusion().layer(stream)?;
            let upto = held.prefix();
            let is_whole_from_start = upto > 0;
            Some(Self {
                stream,
                codec: robot.config().codec,
                resolution: robot.config().mapper.resolution,
                upto,
                layer: if is_whole_from_start { layer.clone() } else { Layer::default() },
                beyond: held.within(upto.saturating_add(1), u32::MAX).intervals().to_vec(),
                packages: match is_whole_from_start {
                    true => Vec::new(),
                    false => {
                        session.store().range(stream, 1, u32::MAX).map(|(_, p)| p.package.clone()).collect()
                    }
                },
            })
        })
    }

    pub(super) const fn stream(&self) -> Stream {
        self.stream
    }

    /// The records that make the same layer again.
    fn into_records(self, encoder: &mut Encoder) -> Result<Vec<Record>, String> {
        let Self { stream, upto, .. } = self;
        let Some(state) = self.layer.present_state().filter(|_| upto > 0) else {
            return Ok(self.packages.into_iter().map(Record::Package).collect());
        };
        let tiles = encoder
            .encode_present(self.codec, stream, upto, self.resolution, &state, PACKAGE_BYTES_MAX)
            .map_err(|error| format!("the present state of {stream:?} could not be coded: {error}"))?;
        let held = self.beyond.chunks(INTERVALS_MAX);
        let held = held.map(|intervals| Record::Held { stream, upto, intervals: intervals.to_vec() });
        Ok(tiles.into_iter().map(Record::Package).chain(held).collect())
    }
}

/// A compacted segment that is being written. Dropped before its end, it leaves a file behind that the next start removes.
pub(super) struct Compaction {
    disk: Arc<dyn Disk>,
    header: SegmentHeader,
    file: Box<dyn DiskFile>,
    name: String,
    seed: u32,
    bytes: u64,
    bytes_max: u64,
    encoder: Encoder,
}

impl Compaction {
    pub(super) fn begin(
        disk: Arc<dyn Disk>,
        header: SegmentHeader,
        bytes_max: u64,
    ) -> Result<Self, LogError> {
        let name = header.name() + UNFINISHED;
        let file = create(&*disk, &header, &name)
            .map_err(|source| LogError::Disk { what: "begin a compacted segment", source })?;
        let (seed, bytes) = (header.seed(), HEADERS_BYTES as u64);
        Ok(Self { disk, header, file, name, seed, bytes, bytes_max, encoder: Encoder::new() })
    }

    /// Writes one stream.
    pub(super) fn add(&mut self, copy: StreamCopy) -> Result<(), String> {
        let mut buffer = Vec::new();
        let mut records = copy.into_records(&mut self.encoder)?.into_iter().peekable();
        while let Some(record) = records.next() {
            record.write(self.seed, &mut buffer);
            if records.peek().is_none() || buffer.len() >= PORTION_BYTES {
                self.bytes += buffer.len() as u64;
                if self.bytes > self.bytes_max {
                    return Err(format!(
                        "the map alone takes more than {} bytes, which is 7/16 of bytes_max: raise it",
                        self.bytes_max
                    ));
                }
                self.file.write_all(&buffer).map_err(|error| format!("cannot write: {error}"))?;
                buffer.clear();
            }
        }
        Ok(())
    }

    /// Makes it safe, and gives it its name: from here on it counts, and all before it does not. Returns its bytes.
    pub(super) fn finish(mut self) -> Result<u64, String> {
        let fail = |error| format!("cannot finish a compacted segment: {error}");
        self.file.sync().map_err(fail)?;
        drop(self.file);
        self.disk.rename(&self.name, &self.header.name()).map_err(fail)?;
        self.disk.sync_folder().map_err(fail)?;
        Ok(self.bytes)
    }

    /// Takes the file away again; what is left is removed at the next start.
    pub(super) fn abandon(self) {
        drop(self.file);
        let _ = self.disk.remove(&self.name);
    }
}
