//! The states of the voxels of a box as bytes, in each of these codecs.

use flockmap_grid::{Changes, VoxelBox};

use super::codes::{Codes, UNCHANGED, UNKNOWN, pack, packed_len};
use super::grid::{CodeGrid, nested_columns};
use super::hilbert::walk;
use super::{addresses, voxels};
use crate::codec::Codec;
use crate::deflate::{Deflater, EXPANSION_MAX, inflate_exact};
use crate::error::PackageError;
use crate::limits::BOX_VOXELS_MAX;
use crate::work::{self, Work};

/// What holds for the voxels of the box that are in no state.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Others {
    /// They are as before: a package of changes.
    Unchanged,
    /// They are Unknown: a snapshot.
    Unknown,
}

impl Others {
    pub(crate) fn code(self) -> u8 {
        match self {
            Self::Unchanged => UNCHANGED,
            Self::Unknown => UNKNOWN,
        }
    }
}

/// Memory that is used again from package to package: up to 2.25 bytes for each voxel of the largest box so
/// far.
#[derive(Default)]
pub(crate) struct Scratch {
    /// The codes by place in the box.
    pub(crate) grid: CodeGrid,
    /// The codes in the order of the codec.
    sequence: Vec<u8>,
    packed: Vec<u8>,
}

/// The most voxels that the box of a payload of this many bytes may have.
pub(crate) fn voxels_max(codec: Codec, payload_bytes: usize, others: Others) -> u64 {
    let payload = payload_bytes as u64;
    let filled = match codec {
        Codec::Raw => payload.saturating_mul(4),
        Codec::NestedZlib | Codec::Paper => payload.saturating_mul(4 * EXPANSION_MAX as u64),
        // An address list does not fill its box, but the stamps of a snapshot are laid out over it.
        Codec::Racer if others == Others::Unknown => (payload + 1).saturating_mul(4 * EXPANSION_MAX as u64),
        // An address list does not fill its box, nor do decisions.
        Codec::Racer | Codec::Flock => BOX_VOXELS_MAX,
    };
    filled.min(BOX_VOXELS_MAX)
}

/// Appends `states`, all inside `region`, which has at most [`BOX_VOXELS_MAX`] voxels. Returns the steps that
/// [`decode`] takes for them.
pub(crate) fn encode(
    codec: Codec,
    states: &Changes,
    region: &VoxelBox,
    others: Others,
    scratch: &mut Scratch,
    deflater: &mut Deflater,
    out: &mut Vec<u8>,
) -> u64 {
    let blocks = states.blocks().len();
    if codec == Codec::Racer {
        addresses::encode(states, region, out);
        return steps(codec, 0, 0, &mut [], blocks);
    }
    let Scratch { grid, sequence, packed } = scratch;
    grid.fill(states, region, others.code());
    let codes = grid.codes();
    let size = region.size().map(|side| side as usize);
    sequence.clear();
    if codec == Codec::Paper {
        sequence.resize(codes.len(), 0);
        let mut rest = sequence.as_mut_slice();
        walk(size, |leaf| {
            let Some((part, after)) = core::mem::take(&mut rest).split_at_mut_checked(leaf.len()) else {
                return;
            };
            rest = after;
            let mut part = part.iter_mut();
            leaf.for_each(|index| {
                if let (Some(to), Some(code)) = (part.next(), codes.get(index)) {
                    *to = *code;
                }
            });
        });
    } else {
        for start in nested_columns(size) {
            let column = codes.get(start..).unwrap_or_default();
            sequence.extend(column.iter().step_by(size[0] * size[1]));
        }
    }
    pack(sequence, packed);
    if codec == Codec::Raw {
        out.extend_from_slice(packed);
    } else {
        deflater.deflate(packed, out);
    }
    steps(codec, codes.len(), others.code(), packed, blocks)
}

/// The states in `payload`; the inverse of [`encode`]. Takes no memory before it is sure that `payload` can
/// fill the box, see [`voxels_max`], and counts its work.
pub(crate) fn decode(
    codec: Codec,
    payload: &[u8],
    region: &VoxelBox,
    others: Others,
    scratch: &mut Scratch,
    work: &mut Work,
) -> Result<Changes, PackageError> {
    let limit = voxels_max(codec, payload.len(), others);
    let volume = region.volume();
    if volume > u128::from(limit) {
        return Err(PackageError::BoxTooLarge { voxels: volume, payload: payload.len(), codec, limit });
    }
    if codec == Codec::Racer {
        let states = addresses::decode(payload, region)?;
        work.take(work::BLOCK_STEPS * states.blocks().len() as u64)?;
        return Ok(states);
    }
    let wrong = |rule| PackageError::Payload { codec, rule };
    let volume = volume as usize;
    let length = packed_len(volume);
    // What is there already is written over.
    if scratch.packed.len() < length {
        scratch.packed.resize(length, 0);
    }
    let packed = scratch.packed.get_mut(..length).unwrap_or_default();
    if codec == Codec::Raw {
        if payload.len() != length {
            return Err(wrong(FILLED));
        }
        packed.copy_from_slice(payload);
    } else {
        work.take(work::of_stream(volume as u64))?;
        inflate_exact(payload, packed).ok_or_else(|| {
            wrong("one whole zlib stream that gives two bits for each voxel of the box, and nothing after it")
        })?;
    }
    fill_last(packed, volume, others.code()).ok_or_else(|| wrong(FILLED))?;
    let codes = Codes::new(packed, others.code());
    let rule = match others {
        Others::Unchanged => "no voxel changes to Unknown (code 10)",
        Others::Unknown => "no voxel of a snapshot is Unchanged (code 11)",
    };
    voxels::voxels(codec, codes, region, work, rule)
}

const FILLED: &str = "two bits for each voxel of the box, zeros after the last";

/// Puts `background` in place of the zeros after the last code. `None` if there is something else.
fn fill_last(packed: &mut [u8], codes: usize, background: u8) -> Option<()> {
    let bits = 2 * (codes % 4);
    if bits != 0 {
        let last = packed.last_mut()?;
        if *last >> bits != 0 {
            return None;
        }
        *last |= (background * 0b0101_0101) << bits;
    }
    Some(())
}

/// The steps of [`decode`] for what was encoded last; `known` are the blocks of it.
fn steps(codec: Codec, volume: usize, background: u8, packed: &mut [u8], blocks: usize) -> u64 {
    let codes = match codec {
        Codec::Racer | Codec::Flock => 0,
        _ => {
            // Zeros, as they were just packed.
            let _ = fill_last(packed, volume, background);
            let stream = if codec == Codec::Raw { 0 } else { work::of_stream(volume as u64) };
            stream + Codes::new(packed, background).steps()
        }
    };
    codes + work::BLOCK_STEPS * blocks as u64
}
