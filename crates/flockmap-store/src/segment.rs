//! A segment: its name, and the header that it begins with (`docs/store.md`).

use std::fmt;

use flockmap::{Resolution, RobotId};

const MAGIC: &[u8; 8] = b"FLKSTORE";
/// Goes up with every change of the layout.
pub const STORE_VERSION: u8 = 2;

const HEADER_BYTES: usize = 36;
/// The header stands there twice, so that one spoilt byte does not cost a whole segment.
pub(crate) const HEADERS_BYTES: usize = 2 * HEADER_BYTES;
const IS_COMPACTED: u8 = 1;

/// Whose store it is. One of another robot is not opened.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Identity {
    /// The swarm.
    pub swarm: u16,
    /// The robot.
    pub robot: RobotId,
    /// The side of its voxels.
    pub resolution: Resolution,
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { swarm, robot, resolution } = self;
        write!(f, "robot {robot} of swarm {swarm} with voxels of {} m", resolution.metres())
    }
}

/// What a segment says about itself.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct SegmentHeader {
    pub(crate) identity: Identity,
    /// The run that wrote it.
    pub(crate) epoch: u64,
    /// Its place among the segments.
    pub(crate) number: u32,
    /// It says all that the segments with lower numbers say.
    pub(crate) is_compacted: bool,
}

/// Why a segment has no header that can be used.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub(crate) enum NoHeader {
    /// The file ends before it.
    #[error("ends within its header")]
    Torn,
    /// Neither of its two copies is sound.
    #[error("its header is damaged")]
    Damaged,
    /// Sound, and of another version.
    #[error("written by another version ({0})")]
    Version(u8),
}

impl SegmentHeader {
    pub(crate) fn name(&self) -> String {
        segment_name(self.number, self.epoch)
    }

    pub(crate) fn write(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADERS_BYTES);
        bytes.extend_from_slice(MAGIC);
        bytes.push(STORE_VERSION);
        bytes.push(if self.is_compacted { IS_COMPACTED } else { 0 });
        bytes.extend_from_slice(&self.identity.swarm.to_le_bytes());
        bytes.extend_from_slice(&self.identity.robot.0.to_le_bytes());
        bytes.extend_from_slice(&[0; 2]);
        bytes.extend_from_slice(&self.identity.resolution.micrometres().to_le_bytes());
        bytes.extend_from_slice(&self.epoch.to_le_bytes());
        bytes.extend_from_slice(&self.number.to_le_bytes());
        bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
        bytes.repeat(2)
    }

    /// Reads the two copies that a segment begins with.
    pub(crate) fn read(bytes: &[u8]) -> Result<Self, NoHeader> {
        let Some(copies) = bytes.get(..HEADERS_BYTES) else { return Err(NoHeader::Torn) };
        let mut why = NoHeader::Damaged;
        for copy in copies.chunks(HEADER_BYTES) {
            match Self::read_copy(copy) {
                Ok(header) => return Ok(header),
                Err(NoHeader::Damaged) => {}
                Err(version) => why = version,
            }
        }
        Err(why)
    }

    fn read_copy(copy: &[u8]) -> Result<Self, NoHeader> {
        let u16_at = |at: usize| u16::from_le_bytes([copy[at], copy[at + 1]]);
        let u32_at = |at: usize| u32::from_le_bytes([copy[at], copy[at + 1], copy[at + 2], copy[at + 3]]);
        let (content, _) = copy.split_at(HEADER_BYTES - 4);
        if !content.starts_with(MAGIC) || u32_at(HEADER_BYTES - 4) != crc32fast::hash(content) {
            return Err(NoHeader::Damaged);
        }
        if copy[8] != STORE_VERSION {
            return Err(NoHeader::Version(copy[8]));
        }
        let resolution = Resolution::from_micrometres(u32_at(16)).ok_or(NoHeader::Damaged)?;
        Ok(Self {
            identity: Identity { swarm: u16_at(10), robot: RobotId(u16_at(12)), resolution },
            epoch: u64::from(u32_at(20)) | u64::from(u32_at(24)) << 32,
            number: u32_at(28),
            is_compacted: copy[9] & IS_COMPACTED != 0,
        })
    }

    /// Checks of records begin from here: those of another segment are none of this one.
    pub(crate) fn seed(&self) -> u32 {
        // Without its own check, behind which every header would have the same one.
        crc32fast::hash(&self.write()[..HEADER_BYTES - 4])
    }
}

/// `NUMBER-EPOCH.log`: the epoch is safe even where the header is spoilt.
pub(crate) fn segment_name(number: u32, epoch: u64) -> String {
    format!("{number:08}-{epoch:020}.log")
}

/// Number and epoch of a segment; `None` for all other files.
pub(crate) fn parse_name(name: &str) -> Option<(u32, u64)> {
    let (number, epoch) = name.strip_suffix(".log")?.split_once('-')?;
    let (number, epoch) = (number.parse().ok()?, epoch.parse().ok()?);
    (segment_name(number, epoch) == name).then_some((number, epoch))
}

/// Whether this is a segment of version 1, whose epochs had 32 bits.
pub(crate) fn is_of_version_1(name: &str) -> bool {
    let parts = name.strip_suffix(".log").and_then(|name| name.split_once('-'));
    parts.is_some_and(|(number, epoch)| {
        let are_digits = number.bytes().chain(epoch.bytes()).all(|b| b.is_ascii_digit());
        number.len() >= 8 && epoch.len() == 10 && are_digits
    })
}
