//! What both sides say first.

use flockmap_grid::{Resolution, RobotId};

use super::{FEED_VERSION, HELLO, ORIGINS, field, frame};
use crate::FeedError;
use crate::bytes::{Fields, put_text};

const MAGIC: [u8; 4] = *b"FLKM";

/// Flag of the node's hello.
const GOES_ON: u8 = 2;

/// Flags of the reader's hello, beside [`ORIGINS`].
const NO_MAP: u8 = 2;
const LINKS: u8 = 4;
const SCANS: u8 = 8;
const SUBMAPS: u8 = 16;

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
    /// Whether it wants no map: all but [`Message::Anew`](super::Message::Anew) and
    /// [`Message::Blocks`](super::Message::Blocks).
    pub no_map: bool,
    /// Whether it wants to know how robots hear each other.
    pub links: bool,
    /// Whether it wants what the sensor sees.
    pub scans: bool,
    /// Whether it wants to know how submaps lie.
    pub submaps: bool,
    /// What it has from before.
    pub have: Option<Have>,
}

/// What a node says first.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct NodeHello {
    /// Whether it says who saw each voxel last.
    pub origins: bool,
    /// Whether it goes on from what the reader has. Otherwise [`Message::Anew`](super::Message::Anew) follows.
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

impl ReaderHello {
    /// The hello as a frame.
    pub fn emit(&self) -> Vec<u8> {
        frame(HELLO, |bytes| {
            bytes.extend_from_slice(&MAGIC);
            bytes.push(FEED_VERSION);
            let flags = [
                (self.origins, ORIGINS),
                (self.no_map, NO_MAP),
                (self.links, LINKS),
                (self.scans, SCANS),
                (self.submaps, SUBMAPS),
            ];
            bytes.push(flags.iter().filter(|(is_set, _)| *is_set).map(|(_, flag)| flag).sum());
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
        let flags = fields.u8("flags")?;
        let wants = |flag: u8| flags & flag != 0;
        let [feed, began, upto] = [fields.u64("feed id")?, fields.u64("began")?, fields.u64("upto")?];
        let have = (feed != 0).then_some(Have { feed, began, upto });
        Ok(Self {
            origins: wants(ORIGINS),
            no_map: wants(NO_MAP),
            links: wants(LINKS),
            scans: wants(SCANS),
            submaps: wants(SUBMAPS),
            have,
        })
    }
}

impl NodeHello {
    pub(super) fn put(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&MAGIC);
        bytes.push(FEED_VERSION);
        bytes.push(if self.origins { ORIGINS } else { 0 } | if self.goes_on { GOES_ON } else { 0 });
        bytes.extend_from_slice(&self.robot.0.to_le_bytes());
        bytes.extend_from_slice(&self.resolution.micrometres().to_le_bytes());
        bytes.extend_from_slice(&self.feed.to_le_bytes());
        put_text(bytes, &self.name);
        put_text(bytes, &self.frame);
    }

    pub(super) fn parse(body: &[u8]) -> Result<Self, FeedError> {
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
