//! The header of a package.

use flockmap_grid::{Resolution, RobotId, Stamp, Stream, Voxel, VoxelBox, seconds_of_epoch};

use crate::bytes::{THREE_MAX, of_three, put_three, put_varint, put_zigzag};
use crate::codec::Codec;
use crate::error::PackageError;
use crate::fields::Fields;
use crate::limits::FORMAT_VERSION;
use crate::priority::Priority;

/// What a package says about itself: 20 to 30 bytes on the wire as a rule, with the check.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Header {
    /// Whose observations these are.
    pub stream: Stream,
    /// Changes: the number of this package in its stream, from 1. Snapshot: the newest package of the
    /// stream that is contained, together with all before it; from 1.
    pub index: u32,
    /// Changes: when the batch began, some hundredths of a second before its end, rounded down. Snapshot: the oldest
    /// stamp in the package. On the origin's clock.
    pub batch_start: Stamp,
    /// Changes: when the batch was closed; the stamp of every voxel in the package, the same in all packages
    /// of one batch. Snapshot: the newest stamp in the package. Never before `batch_start`.
    pub batch_end: Stamp,
    /// The newest package that this one builds on: who is to decode it must hold packages 1 to `base` of
    /// the stream. 0: none is needed. Always below `index`; 0 in a snapshot.
    pub base: u32,
    /// Whether the payload can be decoded without what earlier packages said. Its `base` is then only
    /// what has to be merged first: an earlier package that is coded against what this one changes. True for a
    /// snapshot, and where `base` is 0.
    pub is_independent: bool,
    /// Side of a voxel.
    pub resolution: Resolution,
    /// The box that the payload speaks of, in the origin's grid.
    pub region: VoxelBox,
    /// How the payload is coded.
    pub codec: Codec,
    /// Changes or snapshot.
    pub content: ContentKind,
    /// Of a snapshot: who made it had to drop some of what it should hold for want of room, none of it newer than
    /// this stamp. `None`: nothing is lacking; so of all changes.
    pub lost_upto: Option<Stamp>,
    /// Of a snapshot: who made it knew of packages that are not contained, up to this one at most, and what these changed
    /// is not in it, nor what was there before. `None`: nothing is lacking for that; so of all changes. From 1.
    pub changed_upto: Option<u32>,
    /// Of a snapshot that is not cut: who made it had merged some of what packages that are not contained said, up to this
    /// one at most, and that may be in it too. `None`: nothing of the kind. From 1.
    pub says_upto: Option<u32>,
    /// Of a snapshot with `changed_upto`: nothing is in it that is newer than the packages that are contained.
    pub is_cut: bool,
    /// Of a snapshot that is cut: who made it held all packages up to `changed_upto`. So what it says of a voxel is the
    /// newest that they say.
    pub is_of_all: bool,
    /// What to send first where there is not room for all. Of a snapshot always `Obstacles`.
    pub priority: Priority,
}

/// What kind of content a package has.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum ContentKind {
    /// What changed in one batch; voxels of the box that are not named stay as they are.
    Changes,
    /// One chunk of the state of the stream after packages 1 to `index`, or of the part of it that packages
    /// after `since` made. Who has packages 1 to `since` and all chunks of the snapshot knows all that packages 1
    /// to `index` said, but for what later ones changed ([`Header::changed_upto`]).
    Snapshot {
        /// 0: the whole state. Else the chunks hold every voxel whose newest change is in the packages from
        /// `since` + 1 to `index`, and may hold others. Below `index`.
        since: u32,
        /// The id of the snapshot: a check of the whole state that was cut into chunks. Chunks with different ids
        /// must not be counted together.
        id: u32,
        /// Number of this chunk, from 0.
        chunk: u32,
        /// Number of chunks of the snapshot, at least 1.
        chunks: u32,
    },
}

/// What follows the fields of [`Header`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tail {
    /// Bytes of header up to the check; all of them are checked.
    pub(crate) checked: usize,
    /// CRC-32 over header and decoded content.
    pub(crate) check: u32,
}

/// Bytes of the check, behind the header.
pub(crate) const CHECK_BYTES: usize = 4;

const KIND_CHANGES: u8 = 0;
const KIND_SNAPSHOT: u8 = 1;
/// Changes that are coded without what was before, and are to be merged after their base.
const KIND_INDEPENDENT: u8 = 2;
/// A snapshot that lacks what was dropped.
const KIND_SNAPSHOT_IN_PART: u8 = 3;
/// In the byte of codec and kind: bits 0 to 2 are the codec, 3 and 4 the kind, 5 and 6 the priority, or of a snapshot
/// what there is to say of later packages; bit 7: the box is made of whole blocks, and counted in these.
const BOX_IN_BLOCKS: u8 = 1 << 7;
const KIND_SHIFT: u32 = 3;
const PRIORITY_SHIFT: u32 = 5;
/// The stream stands behind version, codec and kind.
pub(crate) const STREAM_AT: usize = 2;
/// What a snapshot has in place of a priority: it lacks what packages that are not contained changed, or says some of it …
const OF_LATER: u8 = 1;
/// … or lacks that and all that is newer …
const CUT: u8 = 3;
/// … of the state of a robot that held all of them.
const CUT_OF_ALL: u8 = 2;
/// Voxels along the side of a block.
const BLOCK_SIDE: u32 = 8;

impl Header {
    /// Appends everything up to the check. The length goes with the values: `base` takes less the nearer
    /// it is to `index`, and the box takes less if it is made of whole blocks.
    pub(crate) fn write(&self, out: &mut Vec<u8>) {
        let kind = match self.content {
            ContentKind::Changes if self.is_independent && self.base != 0 => KIND_INDEPENDENT,
            ContentKind::Changes => KIND_CHANGES,
            ContentKind::Snapshot { .. } if self.lost_upto.is_some() => KIND_SNAPSHOT_IN_PART,
            ContentKind::Snapshot { .. } => KIND_SNAPSHOT,
        };
        out.push(FORMAT_VERSION);
        let (unit, flag) = if is_in_blocks(&self.region) { (BLOCK_SIDE, BOX_IN_BLOCKS) } else { (1, 0) };
        let priority = match self.content {
            ContentKind::Changes => self.priority as u8,
            ContentKind::Snapshot { .. } => self.later(),
        };
        out.push(self.codec.id() | kind << KIND_SHIFT | priority << PRIORITY_SHIFT | flag);
        put_varint(out, u64::from(self.stream.origin.0));
        put_varint(out, self.stream.epoch);
        put_varint(out, u64::from(self.index));
        let end = self.batch_end.0.wrapping_sub(epoch_micros(self.stream.epoch));
        if self.content == ContentKind::Changes {
            let is_whole = end % HUNDREDTH == 0;
            put_varint(out, hundredths(self.batch_start, self.batch_end) << 1 | u64::from(is_whole));
            put_zigzag(out, if is_whole { end / HUNDREDTH } else { end });
        } else {
            put_zigzag(out, end);
            put_varint(out, self.batch_end.0.wrapping_sub(self.batch_start.0) as u64);
        }
        put_varint(out, resolution_code(self.resolution));
        write_box(&self.region, unit, out);
        match self.content {
            ContentKind::Changes => write_back(self.index, self.base, out),
            ContentKind::Snapshot { since, id, chunk, chunks } => {
                write_back(self.index, since, out);
                out.extend_from_slice(&id.to_le_bytes());
                put_varint(out, u64::from(chunk));
                put_varint(out, u64::from(chunks));
                if let Some(lost_upto) = self.lost_upto {
                    put_zigzag(out, lost_upto.0.wrapping_sub(epoch_micros(self.stream.epoch)));
                }
                match (self.later(), self.changed_upto) {
                    (OF_LATER, changed_upto) => {
                        put_varint(out, changed_upto.unwrap_or(0).into());
                        put_varint(out, self.says_upto.unwrap_or(0).into());
                    }
                    (_, Some(changed_upto)) => {
                        put_zigzag(out, i64::from(changed_upto) - i64::from(self.index))
                    }
                    (_, None) => {}
                }
            }
        }
    }

    const fn later(&self) -> u8 {
        match (self.changed_upto, self.says_upto, self.is_cut, self.is_of_all) {
            (None, None, ..) => 0,
            (Some(_), _, true, false) => CUT,
            (Some(_), _, true, true) => CUT_OF_ALL,
            (..) => OF_LATER,
        }
    }

    /// Of a snapshot: of all packages up to this one, nothing newer is known of what it says.
    pub fn newest_of(&self) -> u32 {
        self.changed_upto.filter(|_| self.is_of_all).map_or(self.index, |upto| upto.max(self.index))
    }

    /// Bytes of the header, with the check.
    pub(crate) fn byte_len(&self) -> usize {
        let mut bytes = Vec::with_capacity(96);
        self.write(&mut bytes);
        bytes.len() + CHECK_BYTES
    }

    /// Reads header and check from the front of `bytes`; returns the payload, which is all of the rest.
    pub(crate) fn read(bytes: &[u8]) -> Result<(Self, Tail, &[u8]), PackageError> {
        let wrong = |rule| PackageError::Header { rule };
        let mut reader = Fields::new(bytes);
        let version = reader.byte("version")?;
        if version != FORMAT_VERSION {
            return Err(PackageError::Version { found: version });
        }
        let all = reader.byte("codec and kind")?;
        let (codec, kind, priority) = (all & 7, all >> KIND_SHIFT & 3, all >> PRIORITY_SHIFT & 3);
        let codec = Codec::from_id(codec).ok_or(PackageError::Codec { found: codec })?;
        let unit = if all & BOX_IN_BLOCKS == 0 { 1 } else { BLOCK_SIDE };
        let is_snapshot = [KIND_SNAPSHOT, KIND_SNAPSHOT_IN_PART].contains(&kind);
        let later = if is_snapshot { priority } else { 0 };
        let (is_cut, is_of_all) = ([CUT, CUT_OF_ALL].contains(&later), later == CUT_OF_ALL);
        let priority = Priority::ALL.get(if is_snapshot { 0 } else { usize::from(priority) }).copied();
        let priority = priority.ok_or_else(|| wrong("priorities are 0 to 2"))?;
        let u32_max = u64::from(u32::MAX);
        let origin = RobotId(reader.number("origin", u64::from(u16::MAX))? as u16);
        let epoch = reader.number("epoch", u64::MAX)?;
        let index = reader.number("index", u32_max)? as u32;
        if index == 0 {
            return Err(wrong("indices begin at 1"));
        }
        let (end, duration) = if is_snapshot {
            (reader.signed("batch end")?, Some(reader.number("batch duration", u64::MAX)?))
        } else {
            let duration = reader.number("batch duration", u64::MAX)?;
            let end = reader.signed("batch end")?;
            let end = if duration & 1 == 0 { Some(end) } else { end.checked_mul(HUNDREDTH) };
            // There is one form of each.
            let end = end.filter(|end| (end % HUNDREDTH == 0) == (duration & 1 == 1));
            let end =
                end.ok_or_else(|| wrong("a batch that ends at a whole hundredth of a second says so"))?;
            (end, (duration >> 1).checked_mul(HUNDREDTH as u64))
        };
        let batch_end = Stamp(end.wrapping_add(epoch_micros(epoch)));
        let batch_start = duration.and_then(|duration| batch_end.0.checked_sub_unsigned(duration)).map(Stamp);
        let batch_start =
            batch_start.ok_or_else(|| wrong("the batch starts within the range of 64-bit stamps"))?;
        let resolution = read_resolution(&mut reader)?;
        let region = read_box(&mut reader, unit)?;
        if unit == 1 && is_in_blocks(&region) {
            return Err(wrong("a box of whole blocks is counted in blocks"));
        }
        let (mut lost_upto, mut changed_upto, mut says_upto) = (None, None, None);
        let (content, base) = if is_snapshot {
            let since = read_back(&mut reader, index, "since", "a span begins after an earlier package")?;
            let id = reader.u32_le("snapshot id")?;
            let chunk = reader.number("chunk", u32_max)? as u32;
            let chunks = reader.number("chunks", u32_max)? as u32;
            if chunk >= chunks {
                return Err(wrong("a chunk number is below the number of chunks"));
            }
            if kind == KIND_SNAPSHOT_IN_PART {
                let lost = reader.signed("newest stamp dropped")?;
                lost_upto = Some(Stamp(lost.wrapping_add(epoch_micros(epoch))));
            }
            if later == OF_LATER {
                let mut upto = |what| {
                    reader.number(what, u32_max).map(|upto| Some(upto as u32).filter(|upto| *upto > 0))
                };
                (changed_upto, says_upto) = (upto("changed upto")?, upto("says upto")?);
                changed_upto
                    .or(says_upto)
                    .ok_or_else(|| wrong("of later packages there is something to say"))?;
            } else if later != 0 {
                let upto = reader.signed("changed upto")?.checked_add(i64::from(index));
                changed_upto = upto.and_then(|upto| u32::try_from(upto).ok()).filter(|upto| *upto > 0);
                changed_upto.ok_or_else(|| wrong("indices begin at 1"))?;
            }
            (ContentKind::Snapshot { since, id, chunk, chunks }, 0)
        } else {
            let base = read_back(&mut reader, index, "base", "a base is an earlier package")?;
            if base == 0 && kind == KIND_INDEPENDENT {
                return Err(wrong("who is to be merged after another names it"));
            }
            (ContentKind::Changes, base)
        };
        let checked = reader.offset();
        let check = reader.u32_le("check")?;
        let stream = Stream { origin, epoch };
        let is_independent = base == 0 || kind == KIND_INDEPENDENT;
        let header = Self {
            stream,
            index,
            batch_start,
            batch_end,
            base,
            is_independent,
            resolution,
            region,
            codec,
            content,
            lost_upto,
            changed_upto,
            says_upto,
            is_cut,
            is_of_all,
            priority,
        };
        Ok((header, Tail { checked, check }, reader.rest()))
    }
}

/// An earlier package as the number of steps back from `index`; 0 for none.
fn write_back(index: u32, earlier: u32, out: &mut Vec<u8>) {
    let back = if earlier == 0 { 0 } else { index.saturating_sub(earlier) };
    put_varint(out, u64::from(back));
}

fn read_back(
    reader: &mut Fields<'_>,
    index: u32,
    field: &'static str,
    rule: &'static str,
) -> Result<u32, PackageError> {
    match reader.number(field, u64::from(u32::MAX))? as u32 {
        0 => Ok(0),
        back if back < index => Ok(index - back),
        _ => Err(PackageError::Header { rule }),
    }
}

/// Real robots take the seconds since 1970 for their epoch, and their clocks count microseconds: what is
/// left of a stamp is the time since the run began, which is short. Any other epoch does no harm.
fn epoch_micros(epoch: u64) -> i64 {
    i64::from(seconds_of_epoch(epoch)) * 1_000_000
}

/// Microseconds.
const HUNDREDTH: i64 = 10_000;

/// So many hundredths of a second before its end a batch begins, rounded up as far as 64-bit stamps go.
fn hundredths(start: Stamp, end: Stamp) -> u64 {
    let micros = |from: i64| end.0.wrapping_sub(from) as u64;
    micros(start.0).div_ceil(HUNDREDTH as u64).min(micros(i64::MIN) / HUNDREDTH as u64)
}

/// When a batch begins, as a package says it.
pub(crate) fn rounded_start(start: Stamp, end: Stamp) -> Stamp {
    Stamp(end.0.wrapping_sub((hundredths(start, end) * HUNDREDTH as u64) as i64))
}

/// Four times the centimetres where they are whole; four times the millimetres and two where these are; else twice
/// the micrometres and one.
fn resolution_code(resolution: Resolution) -> u64 {
    match u64::from(resolution.micrometres()) {
        micrometres if micrometres.is_multiple_of(10_000) => micrometres / 10_000 * 4,
        micrometres if micrometres.is_multiple_of(1_000) => micrometres / 1_000 * 4 + 2,
        micrometres => micrometres * 2 + 1,
    }
}

fn read_resolution(reader: &mut Fields<'_>) -> Result<Resolution, PackageError> {
    let code = reader.number("resolution", u64::from(u32::MAX))?;
    let micrometres = match code & 3 {
        0 => code / 4 * 10_000,
        2 => code / 4 * 1_000,
        _ => code / 2,
    };
    u32::try_from(micrometres)
        .ok()
        .and_then(Resolution::from_micrometres)
        // There is one form of each.
        .filter(|resolution| resolution_code(*resolution) == code)
        .ok_or(PackageError::Header {
            rule: "the resolution is 1,000 to 100,000,000 micrometres in its shorter form",
        })
}

fn is_in_blocks(region: &VoxelBox) -> bool {
    let min = region.min();
    let corner = [min.x, min.y, min.z];
    corner.iter().all(|corner| corner.rem_euclid(BLOCK_SIDE as i32) == 0)
        && region
            .size()
            .iter()
            .all(|size| size.is_multiple_of(BLOCK_SIDE) && size / BLOCK_SIDE - 1 <= THREE_MAX)
}

/// Corner and size in `unit`s of voxels along each axis, of which the box is made.
fn write_box(region: &VoxelBox, unit: u32, out: &mut Vec<u8>) {
    let min = region.min();
    for corner in [min.x, min.y, min.z] {
        put_zigzag(out, i64::from(corner).div_euclid(i64::from(unit)));
    }
    let less_one = region.size().map(|size| (size / unit).saturating_sub(1));
    match unit {
        BLOCK_SIDE => put_three(out, less_one),
        _ => less_one.iter().for_each(|size| put_varint(out, u64::from(*size))),
    }
}

fn read_box(reader: &mut Fields<'_>, unit: u32) -> Result<VoxelBox, PackageError> {
    let mut corner = [0i32; 3];
    for corner in &mut corner {
        let low = reader.signed("box corner")?.checked_mul(i64::from(unit)).ok_or(BOX)?;
        *corner = i32::try_from(low).map_err(|_| BOX)?;
    }
    let mut size = [0u32; 3];
    if unit == BLOCK_SIDE {
        size =
            of_three(reader.number("box size", (1 << 63) - 1)?).map(|less_one| (less_one + 1) * BLOCK_SIDE);
    } else {
        for size in &mut size {
            *size = reader.number("box size", u64::from(u32::MAX) - 1)? as u32 + 1;
        }
    }
    VoxelBox::new(Voxel::new(corner[0], corner[1], corner[2]), size).ok_or(BOX)
}

const BOX: PackageError = PackageError::Header { rule: "the box lies within the limits of the grid" };

#[cfg(test)]
mod tests;
