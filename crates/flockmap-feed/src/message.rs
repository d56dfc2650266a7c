//! The frames of the feed: what they say, and how they become bytes. `docs/map-output.md` has them byte by byte.

use core::time::Duration;

use flockmap_grid::{BlockIndex, Plane, Resolution, RobotId, Stamp, StateBlock, Stream, VOXEL_LIMIT, meet};

use crate::FeedError;
use crate::bytes::{Fields, put_plane, put_text};

/// The version of the feed that is spoken here.
pub const FEED_VERSION: u8 = 1;

/// Most bytes of a frame behind its length, as readers must take them. Nodes send less: 64 KiB and one block.
pub const FRAME_BYTES_MAX: usize = 1 << 20;

/// Most bytes of a reader's hello behind its length.
pub const HELLO_BYTES_MAX: usize = 256;

/// The length of a frame stands before it.
pub(crate) const LENGTH_BYTES: usize = 4;

const MAGIC: [u8; 4] = *b"FLKM";

/// A block without origins: index and two planes.
const BLOCK_BYTES: usize = 3 * 4 + 2 * 64;
/// A robot in a poses frame.
const POSE_BYTES: usize = 2 + 8 + 3 * 8 + 1 + 4 * 8 + 8;
/// A counter has a length, a name of at least nothing, and a value.
const COUNTER_BYTES_MIN: usize = 1 + 8;

const HELLO: u8 = 1;
const BLOCKS: u8 = 2;
const ANEW: u8 = 3;
const POSES: u8 = 4;
const COUNTERS: u8 = 5;
const END: u8 = 6;

/// Flag of both hellos, and of blocks frames: the origin of every voxel.
const ORIGINS: u8 = 1;
/// Flag of the node's hello.
const GOES_ON: u8 = 2;

/// What a reader has of a map. Versions count within one feed, which is one run of a node.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Have {
    /// The feed, never 0.
    pub feed: u64,
    /// The version of the node's map when the reader began with nothing.
    pub began: u64,
    /// It has all that changed up to this version.
    pub upto: u64,
}

/// The first and only thing that a reader says.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct ReaderHello {
    /// Whether it wants to know who saw each voxel last.
    pub origins: bool,
    /// What it has from before.
    pub have: Option<Have>,
}

/// What a node says first.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct NodeHello {
    /// Whether it says who saw each voxel last.
    pub origins: bool,
    /// Whether it goes on from what the reader has. Otherwise [`Message::Anew`] follows.
    pub goes_on: bool,
    /// Whose map it is.
    pub robot: RobotId,
    /// The side of a voxel.
    pub resolution: Resolution,
    /// Of this run of the node; never 0.
    pub feed: u64,
    /// Name of the robot, for people. At most 255 bytes.
    pub name: String,
    /// Name of the frame that the map is in. At most 255 bytes.
    pub frame: String,
}

/// A block as it is.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Block {
    /// Where.
    pub index: BlockIndex,
    /// What is known of it; nothing if it was emptied.
    pub states: StateBlock,
    /// Who saw which of its known voxels last. Without a robot twice; together all known voxels. Empty in a
    /// feed without origins.
    pub origins: Vec<(RobotId, Plane)>,
}

/// A part of the map.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Blocks {
    /// The reader now has all that changed up to this version.
    pub upto: u64,
    /// The newest version of the node's map.
    pub newest: u64,
    /// When the node's map came to the newest version, on the node's clock.
    pub stamp: Stamp,
    /// Whether origins are there.
    pub origins: bool,
    /// In ascending order of the version at which they changed last.
    pub blocks: Vec<Block>,
}

/// Where a robot is, as far as the node knows.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct RobotPose {
    /// The robot and its run.
    pub stream: Stream,
    /// Where its sensor was, in metres in the frame of the map.
    pub position: [f64; 3],
    /// How its sensor was turned in the map: a quaternion x, y, z, w. Known of the node's own robot.
    pub orientation: Option<[f64; 4]>,
    /// How long ago that was when the frame was made.
    pub age: Duration,
}

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
    /// The last one, with the reason for people.
    End(String),
    /// A kind of a later version of the feed. It means nothing here.
    Unknown(u8),
}

impl ReaderHello {
    /// The hello as a frame.
    pub fn emit(&self) -> Vec<u8> {
        frame(HELLO, |bytes| {
            bytes.extend_from_slice(&MAGIC);
            bytes.push(FEED_VERSION);
            bytes.push(if self.origins { ORIGINS } else { 0 });
            let have = self.have.map_or([0; 3], |have| [have.feed, have.began, have.upto]);
            have.iter().for_each(|number| bytes.extend_from_slice(&number.to_le_bytes()));
        })
    }

    /// Reads a frame that [`Splitter`](crate::Splitter) found. Bytes behind what is known are ignored, and so
    /// are unknown flags: they are of later versions. A reader that says more than the node can know has
    /// nothing.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(kind: u8, body: &[u8]) -> Result<Self, FeedError> {
        if kind != HELLO {
            return Err(field("reader's", "kind", kind.into(), "1, a hello"));
        }
        let mut fields = Fields::new("hello", body);
        check_magic(&mut fields)?;
        let origins = fields.u8("flags")? & ORIGINS != 0;
        let [feed, began, upto] = [fields.u64("feed id")?, fields.u64("began")?, fields.u64("upto")?];
        let have = (feed != 0).then_some(Have { feed, began, upto });
        Ok(Self { origins, have })
    }
}

impl Message {
    /// The message as a frame. A text that is too long is cut.
    pub fn emit(&self) -> Vec<u8> {
        match self {
            Self::Hello(hello) => frame(HELLO, |bytes| hello.put(bytes)),
            Self::Blocks(blocks) => {
                let mut frame = BlocksFrame::new(blocks.origins);
                blocks.blocks.iter().for_each(|block| frame.push(block));
                frame.finish(blocks.upto, blocks.newest, blocks.stamp)
            }
            Self::Anew { began } => frame(ANEW, |bytes| bytes.extend_from_slice(&began.to_le_bytes())),
            Self::Poses(poses) => frame(POSES, |bytes| {
                let poses = &poses[..poses.len().min((FRAME_BYTES_MAX - 3) / POSE_BYTES)];
                bytes.extend_from_slice(&(poses.len() as u16).to_le_bytes());
                poses.iter().for_each(|pose| pose.put(bytes));
            }),
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
            POSES => {
                let mut fields = Fields::new("poses", body);
                let count = fields.u16("count")?;
                let count = fields.check_count("robots", count.into(), POSE_BYTES)?;
                Self::Poses((0..count).map(|_| RobotPose::parse(&mut fields)).collect::<Result<_, _>>()?)
            }
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

impl NodeHello {
    fn put(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&MAGIC);
        bytes.push(FEED_VERSION);
        bytes.push(if self.origins { ORIGINS } else { 0 } | if self.goes_on { GOES_ON } else { 0 });
        bytes.extend_from_slice(&self.robot.0.to_le_bytes());
        bytes.extend_from_slice(&self.resolution.micrometres().to_le_bytes());
        bytes.extend_from_slice(&self.feed.to_le_bytes());
        put_text(bytes, &self.name);
        put_text(bytes, &self.frame);
    }

    fn parse(body: &[u8]) -> Result<Self, FeedError> {
        let mut fields = Fields::new("hello", body);
        check_magic(&mut fields)?;
        let flags = fields.u8("flags")?;
        let robot = RobotId(fields.u16("robot id")?);
        let micrometres = fields.u32("resolution")?;
        let resolution = Resolution::from_micrometres(micrometres).ok_or_else(|| {
            field("hello", "resolution", micrometres.into(), "1,000 to 100,000,000 micrometres")
        })?;
        let feed = fields.u64("feed id")?;
        if feed == 0 {
            return Err(field("hello", "feed id", feed, "any other number"));
        }
        Ok(Self {
            origins: flags & ORIGINS != 0,
            goes_on: flags & GOES_ON != 0,
            robot,
            resolution,
            feed,
            name: fields.text("name")?,
            frame: fields.text("frame")?,
        })
    }
}

impl Blocks {
    fn parse(body: &[u8]) -> Result<Self, FeedError> {
        let mut fields = Fields::new("blocks", body);
        let [upto, newest] = [fields.u64("upto")?, fields.u64("newest")?];
        let stamp = Stamp(fields.i64("stamp")?);
        let origins = fields.u8("flags")? & ORIGINS != 0;
        let count = fields.u32("count")? as usize;
        let count = fields.check_count("blocks", count, BLOCK_BYTES)?;
        let blocks = (0..count).map(|_| Block::parse(&mut fields, origins)).collect::<Result<_, _>>()?;
        Ok(Self { upto, newest, stamp, origins, blocks })
    }
}

impl Block {
    fn parse(fields: &mut Fields<'_>, with_origins: bool) -> Result<Self, FeedError> {
        let mut at = [0; 3];
        for at in &mut at {
            *at = fields.i32("block index")?;
            if at.unsigned_abs() > VOXEL_LIMIT as u32 / 8 {
                let expected = "-33,554,432 to 33,554,432, as two's complement";
                return Err(field("blocks", "block index", u64::from(*at as u32), expected));
            }
        }
        let index = BlockIndex::new(at[0], at[1], at[2]);
        let [free, occupied] = [fields.plane("free plane")?, fields.plane("occupied plane")?];
        if meet(&free, &occupied) {
            return Err(FeedError::Block(index));
        }
        let states = StateBlock::new(free, occupied);
        let origins = if with_origins { parse_origins(fields, index, &states.known())? } else { Vec::new() };
        Ok(Self { index, states, origins })
    }
}

/// Origins that share no voxel, and have all that are known.
fn parse_origins(
    fields: &mut Fields<'_>,
    index: BlockIndex,
    known: &Plane,
) -> Result<Vec<(RobotId, Plane)>, FeedError> {
    let count = usize::from(fields.u16("number of origins")?);
    if count == 1 {
        let only = RobotId(fields.u16("origin")?);
        return if *known == [0; 8] { Err(FeedError::Block(index)) } else { Ok(vec![(only, *known)]) };
    }
    let count = fields.check_count("origins", count, 2 + 64)?;
    let (mut origins, mut seen) = (Vec::with_capacity(count), [0; 8]);
    for _ in 0..count {
        let (origin, plane) = (RobotId(fields.u16("origin")?), fields.plane("plane of an origin")?);
        if plane == [0; 8] || meet(&plane, &seen) || origins.iter().any(|(other, _)| *other == origin) {
            return Err(FeedError::Block(index));
        }
        seen = core::array::from_fn(|z| seen[z] | plane[z]);
        origins.push((origin, plane));
    }
    if seen == *known { Ok(origins) } else { Err(FeedError::Block(index)) }
}

impl RobotPose {
    fn put(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.stream.origin.0.to_le_bytes());
        bytes.extend_from_slice(&self.stream.epoch.to_le_bytes());
        self.position.iter().for_each(|at| bytes.extend_from_slice(&at.to_le_bytes()));
        bytes.push(u8::from(self.orientation.is_some()));
        let orientation = self.orientation.unwrap_or_default();
        orientation.iter().for_each(|part| bytes.extend_from_slice(&part.to_le_bytes()));
        let age = u64::try_from(self.age.as_micros()).unwrap_or(u64::MAX);
        bytes.extend_from_slice(&age.to_le_bytes());
    }

    fn parse(fields: &mut Fields<'_>) -> Result<Self, FeedError> {
        let stream = Stream { origin: RobotId(fields.u16("robot id")?), epoch: fields.u64("epoch")? };
        let (mut position, mut orientation) = ([0.0; 3], [0.0; 4]);
        for at in &mut position {
            *at = fields.f64("position")?;
        }
        let is_known = fields.u8("orientation")?;
        for part in &mut orientation {
            *part = fields.f64("orientation")?;
        }
        let age = Duration::from_micros(fields.u64("age")?);
        let orientation = (is_known != 0).then_some(orientation);
        let is_finite = |numbers: &[f64]| numbers.iter().all(|number| number.is_finite());
        if !is_finite(&position) || orientation.is_some_and(|turn| !is_finite(&turn)) {
            return Err(field("poses", "pose of robot", stream.origin.0.into(), "finite numbers"));
        }
        Ok(Self { stream, position, orientation, age })
    }
}

/// A blocks frame that is written block by block.
pub(crate) struct BlocksFrame {
    bytes: Vec<u8>,
    count: u32,
    origins: bool,
}

/// Length, kind, two versions, stamp, flags, count.
const BLOCKS_HEAD_BYTES: usize = LENGTH_BYTES + 1 + 3 * 8 + 1 + 4;

impl BlocksFrame {
    pub(crate) fn new(origins: bool) -> Self {
        Self { bytes: vec![0; BLOCKS_HEAD_BYTES], count: 0, origins }
    }

    pub(crate) const fn len(&self) -> usize {
        self.bytes.len()
    }

    pub(crate) fn push(&mut self, block: &Block) {
        let Block { index, states, origins } = block;
        let bytes = &mut self.bytes;
        [index.x, index.y, index.z].iter().for_each(|at| bytes.extend_from_slice(&at.to_le_bytes()));
        put_plane(bytes, states.free());
        put_plane(bytes, states.occupied());
        if self.origins {
            bytes.extend_from_slice(&(origins.len() as u16).to_le_bytes());
            for (origin, plane) in origins {
                bytes.extend_from_slice(&origin.0.to_le_bytes());
                if origins.len() > 1 {
                    put_plane(bytes, plane);
                }
            }
        }
        self.count += 1;
    }

    pub(crate) fn finish(mut self, upto: u64, newest: u64, stamp: Stamp) -> Vec<u8> {
        let mut head = ((self.bytes.len() - LENGTH_BYTES) as u32).to_le_bytes().to_vec();
        head.push(BLOCKS);
        head.extend_from_slice(&upto.to_le_bytes());
        head.extend_from_slice(&newest.to_le_bytes());
        head.extend_from_slice(&stamp.0.to_le_bytes());
        head.push(if self.origins { ORIGINS } else { 0 });
        head.extend_from_slice(&self.count.to_le_bytes());
        self.bytes[..BLOCKS_HEAD_BYTES].copy_from_slice(&head);
        self.bytes
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

fn check_magic(fields: &mut Fields<'_>) -> Result<(), FeedError> {
    let magic = fields.bytes("magic", MAGIC.len())?;
    if magic != MAGIC {
        let got = magic.iter().fold(0, |number, byte| number << 8 | u64::from(*byte));
        return Err(field("hello", "magic", got, "FLKM, which is 1179405133"));
    }
    match fields.u8("version")? {
        FEED_VERSION => Ok(()),
        other => Err(FeedError::Version(other)),
    }
}

const fn field(kind: &'static str, field: &'static str, got: u64, expected: &'static str) -> FeedError {
    FeedError::Field { kind, field, got, expected }
}
