//! The frames of the feed: what they say, and how they become bytes. `docs/map-output.md` has them byte by byte.

mod blocks;
mod hello;
mod playback;
mod robots;
mod submaps;

use flockmap_grid::Stamp;

use crate::FeedError;
use crate::bytes::{Fields, put_text};

pub(crate) use blocks::BlocksFrame;
pub use blocks::{Block, Blocks};
pub use hello::{Have, NodeHello, ReaderHello};
pub use playback::Playback;
pub use robots::{Link, RobotPose, SeenScan};
pub use submaps::RunSubmaps;

/// The version of the feed that is spoken here.
pub const FEED_VERSION: u8 = 1;

/// Most bytes of a frame behind its length, as readers must take them. Nodes send less: 64 KiB and one block.
pub const FRAME_BYTES_MAX: usize = 1 << 20;

/// Most bytes of a reader's hello behind its length.
pub const HELLO_BYTES_MAX: usize = 256;

/// The length of a frame stands before it.
pub(crate) const LENGTH_BYTES: usize = 4;

/// A counter has a length, a name of at least nothing, and a value.
const COUNTER_BYTES_MIN: usize = 1 + 8;

const HELLO: u8 = 1;
const BLOCKS: u8 = 2;
const ANEW: u8 = 3;
const POSES: u8 = 4;
const COUNTERS: u8 = 5;
const END: u8 = 6;
const LINKS: u8 = 7;
const SCAN: u8 = 8;
const PLAYBACK: u8 = 9;
const SUBMAPS: u8 = 10;

/// Flag of both hellos, and of blocks frames: the origin of every voxel.
const ORIGINS: u8 = 1;

/// What the node has counted.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct NodeCounts {
    /// The time on the node's clock.
    pub now: Stamp,
    /// Names and values.
    pub counters: Vec<(String, u64)>,
}

/// A frame from a node.
#[derive(Clone, PartialEq, Debug)]
pub enum Message {
    /// The first one.
    Hello(NodeHello),
    /// A part of the map.
    Blocks(Blocks),
    /// The reader begins with nothing, at this version of the node's map.
    Anew {
        /// The version.
        began: u64,
    },
    /// Where robots are: all that are known.
    Poses(Vec<RobotPose>),
    /// What was counted.
    Counters(NodeCounts),
    /// How the other robots are heard: all that are. For readers that want links.
    Links(Vec<Link>),
    /// What the sensor saw newest. For readers that want scans.
    Scan(SeenScan),
    /// Which time of a recording is shown.
    Playback(Playback),
    /// Which submaps there are, and how they lie: of all runs that are known. For readers that want submaps.
    Submaps(Vec<RunSubmaps>),
    /// The last one, with the reason for people.
    End(String),
    /// A kind of a later version of the feed. It means nothing here.
    Unknown(u8),
}

impl Message {
    /// The message as a frame. What is too long is cut.
    pub fn emit(&self) -> Vec<u8> {
        match self {
            Self::Hello(hello) => frame(HELLO, |bytes| hello.put(bytes)),
            Self::Blocks(blocks) => {
                let mut frame = BlocksFrame::new(blocks.origins);
                blocks.blocks.iter().for_each(|block| frame.push(block));
                frame.finish(blocks.upto, blocks.newest, blocks.stamp)
            }
            Self::Anew { began } => frame(ANEW, |bytes| bytes.extend_from_slice(&began.to_le_bytes())),
            Self::Poses(poses) => frame(POSES, |bytes| RobotPose::put_all(poses, bytes)),
            Self::Links(links) => frame(LINKS, |bytes| Link::put_all(links, bytes)),
            Self::Scan(scan) => frame(SCAN, |bytes| scan.put(bytes)),
            Self::Playback(playback) => frame(PLAYBACK, |bytes| playback.put(bytes)),
            Self::Submaps(runs) => frame(SUBMAPS, |bytes| RunSubmaps::put_all(runs, bytes)),
            Self::Counters(counts) => frame(COUNTERS, |bytes| {
                bytes.extend_from_slice(&counts.now.0.to_le_bytes());
                let counters = &counts.counters[..counts.counters.len().min(1 << 10)];
                bytes.extend_from_slice(&(counters.len() as u16).to_le_bytes());
                for (name, value) in counters {
                    put_text(bytes, name);
                    bytes.extend_from_slice(&value.to_le_bytes());
                }
            }),
            Self::End(text) => frame(END, |bytes| {
                bytes.extend_from_slice(&text.as_bytes()[..text.floor_char_boundary(1_024)]);
            }),
            Self::Unknown(kind) => frame(*kind, |_| {}),
        }
    }

    /// Reads a frame that [`Splitter`](crate::Splitter) found. Takes no more memory than a few times its bytes.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(kind: u8, body: &[u8]) -> Result<Self, FeedError> {
        Ok(match kind {
            HELLO => Self::Hello(NodeHello::parse(body)?),
            BLOCKS => Self::Blocks(Blocks::parse(body)?),
            ANEW => Self::Anew { began: Fields::new("begin-anew", body).u64("version")? },
            POSES => Self::Poses(RobotPose::parse_all(body)?),
            LINKS => Self::Links(Link::parse_all(body)?),
            SCAN => Self::Scan(SeenScan::parse(body)?),
            PLAYBACK => Self::Playback(Playback::parse(body)?),
            SUBMAPS => Self::Submaps(RunSubmaps::parse_all(body)?),
            COUNTERS => {
                let mut fields = Fields::new("counters", body);
                let (now, count) = (Stamp(fields.i64("time")?), fields.u16("count")?);
                let count = fields.check_count("counters", count.into(), COUNTER_BYTES_MIN)?;
                let counter = |_| Ok((fields.text("name")?, fields.u64("value")?));
                let counters = (0..count).map(counter).collect::<Result<_, FeedError>>()?;
                Self::Counters(NodeCounts { now, counters })
            }
            END => Self::End(Fields::new("end", body).text_to_end("reason")?),
            unknown => Self::Unknown(unknown),
        })
    }
}

/// A frame of a kind, with the body that `put` writes.
fn frame(kind: u8, put: impl FnOnce(&mut Vec<u8>)) -> Vec<u8> {
    let mut bytes = vec![0; LENGTH_BYTES];
    bytes.push(kind);
    put(&mut bytes);
    let length = (bytes.len() - LENGTH_BYTES) as u32;
    bytes[..LENGTH_BYTES].copy_from_slice(&length.to_le_bytes());
    bytes
}

const fn field(kind: &'static str, field: &'static str, got: u64, expected: &'static str) -> FeedError {
    FeedError::Field { kind, field, got, expected }
}
