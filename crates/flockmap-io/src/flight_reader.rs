//! The feed of a flight, read back from its record.

use std::path::Path;
use std::sync::Arc;

use flockmap_feed::FRAME_BYTES_MAX;
use flockmap_grid::Stamp;

use crate::error::{Fault, Place, ReadError};
use crate::flight_recorder::{FEED_FIELD, FEED_SCHEMA};
use crate::mcap_file::McapReader;
use crate::protobuf;

/// Largest chunk that is held, packed and unpacked. The recorder makes chunks of 1 MiB and a message.
const CHUNK_BYTES_MAX: u64 = 64 << 20;

/// A frame of the feed, with its length before it: frames of one topic, one after the other, are what a reader of
/// the node got.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct FeedFrame {
    /// When it came, on the node's clock.
    pub stamp: Stamp,
    /// The topic, `/NAME/feed`: whose feed it is.
    pub topic: Arc<str>,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

/// The frames of a record, read as they are asked for. A damaged chunk is left out and reported, and what follows it
/// is read; a file whose end is missing is read as far as it goes.
///
/// Memory: a chunk, packed and unpacked, of 64 MiB each at most, and a frame of 1 MiB.
pub struct FlightFrames {
    reader: McapReader,
    path: std::path::PathBuf,
    /// Topic of the last frame.
    topic: Arc<str>,
}

/// Opens a record that a node has written of its flight: [`FlightRecorder`](crate::FlightRecorder). A record of other
/// things has no frames.
///
/// # Errors
/// It cannot be opened, or is no MCAP file.
pub fn open_flight(path: impl AsRef<Path>) -> Result<FlightFrames, ReadError> {
    let path = path.as_ref().to_owned();
    let reader = McapReader::open(&path, CHUNK_BYTES_MAX).map_err(|fault| fault.in_file(&path))?;
    Ok(FlightFrames { reader, path, topic: Arc::from("") })
}

impl Iterator for FlightFrames {
    type Item = Result<FeedFrame, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let (channel, data) = match self.reader.next_message()? {
                Ok(found) => found,
                Err(fault) => return Some(Err(fault.in_file(&self.path))),
            };
            if channel.schema != FEED_SCHEMA || channel.encoding != "protobuf" {
                continue;
            }
            if *self.topic != *channel.topic {
                self.topic = Arc::from(channel.topic.as_str());
            }
            let data = self.reader.data(data);
            let frame = match protobuf::bytes_of(data, FEED_FIELD) {
                Some(frame) if frame.len() <= FRAME_BYTES_MAX + 4 => frame,
                found => {
                    let expected = format!("a frame of at most {FRAME_BYTES_MAX} bytes on {}", channel.topic);
                    let found =
                        found.map_or_else(|| "none".to_owned(), |frame| format!("{} bytes", frame.len()));
                    return Some(Err(Fault::damaged(Place::Whole, expected, found).in_file(&self.path)));
                }
            };
            let stamp = Stamp(i64::try_from(self.reader.log_time() / 1_000).unwrap_or(i64::MAX));
            return Some(Ok(FeedFrame { stamp, topic: Arc::clone(&self.topic), bytes: frame.to_vec() }));
        }
    }
}

impl core::fmt::Debug for FlightFrames {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "FlightFrames of {}", self.path.display())
    }
}
