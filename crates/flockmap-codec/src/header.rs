//! The header of a package.

use flockmap_grid::{Resolution, RobotId, Stamp, Stream, Voxel, VoxelBox};

use crate::varint::{self, Reader};
use crate::{Codec, PackageError};

/// The version of the package format, the first byte of every package.
pub const FORMAT_VERSION: u8 = 1;

/// What a package says about itself: 35 to 45 bytes on the wire as a rule.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Header {
    /// Whose observations these are.
    pub stream: Stream,
    /// Changes: the number of this package in its stream, from 1.
    /// Present state: the newest package of the stream that is contained, together with all before it; from 1.
    pub index: u32,
    /// Changes: when the cycle began. Present state: the oldest stamp in the package. On the origin's clock.
    pub cycle_start: Stamp,
    /// Changes: when the cycle was closed; the stamp of every voxel in the package, the same in all packages of
    /// one cycle. Present state: the newest stamp in the package. Never before `cycle_start`.
    pub cycle_end: Stamp,
    /// The index of the package whose state this one was coded against, 0 for none. Always below `index`.
    pub reference: u32,
    /// Side of a voxel.
    pub resolution: Resolution,
    /// The box that the payload speaks of, in the origin's grid.
    pub region: VoxelBox,
    /// How the payload is coded.
    pub codec: Codec,
    /// Changes or present state.
    pub content: ContentKind,
}

/// What kind of content a package has.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum ContentKind {
    /// What changed in one cycle; voxels of the box that are not named stay as they are.
    Changes,
    /// One tile of the state of the stream after packages 1 to `index`. Who has all tiles of a set knows
    /// all that these packages said.
    Present {
        /// Tells sets apart: a check of the whole state that was cut into tiles. Tiles of different sets must
        /// not be counted together.
        set: u32,
        /// Number of this tile, from 0.
        tile: u32,
        /// Number of tiles in the set, at least 1.
        tiles: u32,
    },
}

/// What follows the fields of [`Header`]: payload length, then check.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tail {
    /// Bytes of header up to the check; all of them are checked.
    pub(crate) checked: usize,
    /// CRC-32 over header and decoded content.
    pub(crate) check: u32,
}

const KIND_CHANGES: u8 = 0;
const KIND_PRESENT: u8 = 1;

impl Header {
    /// Appends everything up to the check: the fields, then the payload length.
    pub(crate) fn write(&self, payload_bytes: usize, out: &mut Vec<u8>) {
        out.push(FORMAT_VERSION);
        out.push(self.codec.id());
        out.push(match self.content {
            ContentKind::Changes => KIND_CHANGES,
            ContentKind::Present { .. } => KIND_PRESENT,
        });
        varint::write(out, u64::from(self.stream.origin.0));
        varint::write(out, u64::from(self.stream.epoch));
        varint::write(out, u64::from(self.index));
        varint::write_signed(out, self.cycle_end.0);
        varint::write(out, self.cycle_end.0.wrapping_sub(self.cycle_start.0) as u64);
        varint::write(out, u64::from(self.reference));
        varint::write(out, u64::from(self.resolution.micrometres()));
        let min = self.region.min();
        for corner in [min.x, min.y, min.z] {
            varint::write_signed(out, i64::from(corner));
        }
        for size in self.region.size() {
            varint::write(out, u64::from(size - 1));
        }
        if let ContentKind::Present { set, tile, tiles } = self.content {
            out.extend_from_slice(&set.to_le_bytes());
            varint::write(out, u64::from(tile));
            varint::write(out, u64::from(tiles));
        }
        varint::write(out, payload_bytes as u64);
    }

    /// Reads header, payload length and check from the front of `bytes`; returns the payload, which must be all
    /// of the rest.
    pub(crate) fn read(bytes: &[u8]) -> Result<(Self, Tail, &[u8]), PackageError> {
        let mut reader = Reader::new(bytes);
        let version = reader.byte("version")?;
        if version != FORMAT_VERSION {
            return Err(PackageError::Version { found: version });
        }
        let codec = reader.byte("codec")?;
        let codec = Codec::from_id(codec).ok_or(PackageError::Codec { found: codec })?;
        let kind = reader.byte("content kind")?;
        if kind != KIND_CHANGES && kind != KIND_PRESENT {
            return Err(PackageError::ContentKind { found: kind });
        }
        let u32_max = u64::from(u32::MAX);
        let origin = RobotId(reader.number("origin", u64::from(u16::MAX))? as u16);
        let epoch = reader.number("epoch", u32_max)? as u32;
        let index = reader.number("index", u32_max)? as u32;
        let cycle_end = Stamp(reader.signed("cycle end")?);
        let duration = reader.number("cycle duration", u64::MAX)?;
        let reference = reader.number("reference", u32_max)? as u32;
        let resolution = reader.number("resolution", u32_max)? as u32;
        let mut corner = [0i32; 3];
        for corner in &mut corner {
            *corner = i32::try_from(reader.signed("box corner")?).map_err(|_| BOX)?;
        }
        let mut size = [0u32; 3];
        for size in &mut size {
            *size = reader.number("box size", u32_max - 1)? as u32 + 1;
        }
        let content = if kind == KIND_PRESENT {
            let set = reader.u32_le("set")?;
            let tile = reader.number("tile", u32_max)? as u32;
            let tiles = reader.number("tiles", u32_max)? as u32;
            if tile >= tiles {
                return Err(PackageError::Header { rule: "a tile number is below the number of tiles" });
            }
            ContentKind::Present { set, tile, tiles }
        } else {
            ContentKind::Changes
        };
        let payload_bytes = reader.number("payload length", u64::MAX)?;
        let checked = reader.offset();
        let check = reader.u32_le("check")?;
        let payload = reader.rest();

        if index == 0 {
            return Err(PackageError::Header { rule: "indices begin at 1" });
        }
        if reference != 0 {
            return Err(PackageError::Header { rule: "the codecs of this version take no reference" });
        }
        let cycle_start = cycle_end.0.checked_sub_unsigned(duration).map(Stamp);
        let cycle_start = cycle_start
            .ok_or(PackageError::Header { rule: "the cycle starts within the range of 64-bit stamps" })?;
        let resolution = Resolution::from_micrometres(resolution)
            .ok_or(PackageError::Header { rule: "the resolution is 1,000 to 100,000,000 micrometres" })?;
        let region = VoxelBox::new(Voxel::new(corner[0], corner[1], corner[2]), size).ok_or(BOX)?;
        if payload_bytes != payload.len() as u64 {
            return Err(PackageError::PayloadLength { stated: payload_bytes, found: payload.len() });
        }
        let stream = Stream { origin, epoch };
        let header =
            Self { stream, index, cycle_start, cycle_end, reference, resolution, region, codec, content };
        Ok((header, Tail { checked, check }, payload))
    }
}

const BOX: PackageError = PackageError::Header { rule: "the box lies within the limits of the grid" };
