//! The codecs: the states of the voxels of a box as bytes. A new codec is a new arm here.

use flockmap_grid::{Changes, State, Voxel, VoxelBox};

use crate::code_grid::{CodeGrid, nested_columns};
use crate::deflate::{Deflater, EXPANSION_MAX, inflate_exact};
use crate::hilbert::walk;
use crate::pack::{UNCHANGED, UNKNOWN, pack, packed_len, unpack};
use crate::{BOX_VOXELS_MAX, Codec, PackageError};

/// What holds for the voxels of the box that are in no state.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Others {
    /// They are as before: a package of changes.
    Unchanged,
    /// They are Unknown: a present state.
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

/// Memory that is used again from package to package: up to 2.25 bytes for each voxel of the largest box so far.
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
        // An address list does not fill its box, but the stamps of a present state are laid out over it.
        Codec::Racer if others == Others::Unknown => (payload + 1).saturating_mul(4 * EXPANSION_MAX as u64),
        // An address list does not fill its box, nor do decisions.
        Codec::Racer | Codec::Flock => BOX_VOXELS_MAX,
    };
    filled.min(BOX_VOXELS_MAX)
}

/// Appends `states`, all inside `region`, which has at most [`BOX_VOXELS_MAX`] voxels.
pub(crate) fn encode(
    codec: Codec,
    states: &Changes,
    region: &VoxelBox,
    others: Others,
    scratch: &mut Scratch,
    deflater: &mut Deflater,
    out: &mut Vec<u8>,
) {
    if codec == Codec::Racer {
        return encode_addresses(states, region, out);
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
}

/// The states in `payload`; the inverse of [`encode`]. Takes no memory before it is sure that `payload` can fill
/// the box, see [`voxels_max`].
pub(crate) fn decode(
    codec: Codec,
    payload: &[u8],
    region: &VoxelBox,
    others: Others,
    scratch: &mut Scratch,
) -> Result<Changes, PackageError> {
    let limit = voxels_max(codec, payload.len(), others);
    let voxels = region.volume();
    if voxels > u128::from(limit) {
        return Err(PackageError::BoxTooLarge { voxels, payload: payload.len(), codec, limit });
    }
    if codec == Codec::Racer {
        return decode_addresses(payload, region);
    }
    let volume = voxels as usize;
    let Scratch { grid, sequence, packed } = scratch;
    let packed = if codec == Codec::Raw {
        payload
    } else {
        packed.clear();
        packed.resize(packed_len(volume), 0);
        inflate_exact(payload, packed).ok_or(PackageError::Payload {
            codec,
            rule: "one whole zlib stream that gives two bits for each voxel of the box, and nothing after it",
        })?;
        packed
    };
    sequence.clear();
    sequence.resize(volume, 0);
    unpack(packed, sequence).ok_or(PackageError::Payload {
        codec,
        rule: "two bits for each voxel of the box, zeros after the last",
    })?;

    grid.clear(volume, others.code());
    let codes = grid.codes_mut();
    let size = region.size().map(|side| side as usize);
    if codec == Codec::Paper {
        let mut rest = sequence.as_slice();
        walk(size, |leaf| {
            let Some((part, after)) = rest.split_at_checked(leaf.len()) else { return };
            rest = after;
            let mut part = part.iter();
            leaf.for_each(|index| {
                if let (Some(code), Some(to)) = (part.next(), codes.get_mut(index)) {
                    *to = *code;
                }
            });
        });
    } else {
        for (start, column) in nested_columns(size).zip(sequence.chunks_exact(size[2])) {
            let to = codes.get_mut(start..).unwrap_or_default();
            to.iter_mut().step_by(size[0] * size[1]).zip(column).for_each(|(to, code)| *to = *code);
        }
    }
    grid.states(region, others.code()).ok_or(PackageError::Payload {
        codec,
        rule: match others {
            Others::Unchanged => "no voxel changes to Unknown (code 10)",
            Others::Unknown => "no voxel of a present state is Unchanged (code 11)",
        },
    })
}

/// Bytes for each voxel in the list of addresses.
const ADDRESS_BYTES: usize = 5;

/// For each voxel of `states`, ascending: the place in nested order as `u32`, then 0 for Free or 1 for Occupied.
fn encode_addresses(states: &Changes, region: &VoxelBox, out: &mut Vec<u8>) {
    let (min, [_, ny, nz]) = (region.min(), region.size());
    let mut list: Vec<(u32, u8)> = states
        .voxels()
        .map(|(v, state)| {
            let [x, y, z] = [v.x - min.x, v.y - min.y, v.z - min.z].map(|d| d as u32);
            ((x * ny + y) * nz + z, u8::from(state == State::Occupied))
        })
        .collect();
    list.sort_unstable();
    out.reserve(list.len() * ADDRESS_BYTES);
    for (address, state) in list {
        out.extend_from_slice(&address.to_le_bytes());
        out.push(state);
    }
}

fn decode_addresses(payload: &[u8], region: &VoxelBox) -> Result<Changes, PackageError> {
    let wrong = |rule| PackageError::Payload { codec: Codec::Racer, rule };
    let (entries, rest) = payload.as_chunks::<ADDRESS_BYTES>();
    if !rest.is_empty() {
        return Err(wrong("five bytes for each voxel"));
    }
    let (min, [nx, ny, nz]) = (region.min(), region.size());
    let mut next = 0u32;
    let mut voxels = Vec::with_capacity(entries.len());
    for &[a, b, c, d, state] in entries {
        let address = u32::from_le_bytes([a, b, c, d]);
        let (xy, z) = (address / nz, address % nz);
        let (x, y) = (xy / ny, xy % ny);
        if address < next || x >= nx {
            return Err(wrong("addresses ascend and lie in the box"));
        }
        next = address + 1;
        let state = match state {
            0 => State::Free,
            1 => State::Occupied,
            _ => return Err(wrong("a state is 0 for Free or 1 for Occupied")),
        };
        voxels.push((Voxel::new(min.x + x as i32, min.y + y as i32, min.z + z as i32), state));
    }
    Ok(Changes::from_voxels(voxels))
}
