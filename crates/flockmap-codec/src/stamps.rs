//! The stamps of a present state, after its states and the same for all codecs.
//!
//! Nothing if all known voxels have one stamp, which the header has. Else one zlib stream of: the number of stamps;
//! the differences from each stamp to the next; then for each known voxel along the Hilbert walk of the box the number
//! of its stamp, the low bytes of all voxels first, and the high bytes after them if there are more than 256 stamps.

use flockmap_grid::{BlockIndex, Changes, PresentState, Stamp, StateBlock, Voxel, VoxelBox, voxel_bit};
use std::collections::BTreeMap;

use crate::code_grid::CodeGrid;
use crate::deflate::{Deflater, inflate_up_to};
use crate::hilbert::walk;
use crate::pack::{FREE, OCCUPIED, UNKNOWN};
use crate::varint::{self, Reader};
use crate::{Codec, PackageError};

/// Most distinct stamps in a tile.
pub(crate) const STAMPS_MAX: usize = 1 << 16;

/// The most blocks that the parts of a tile may have, counted together: what bounds the memory of a decoded
/// tile, at 160 bytes a block, to some 12 MB for a package of 1,150 bytes.
pub(crate) fn part_blocks_max(payload_bytes: usize) -> usize {
    payload_bytes.saturating_mul(64)
}

/// Appends the stamps of `parts`, whose voxels all lie in `region`. At most [`STAMPS_MAX`] parts.
pub(crate) fn encode(
    parts: &[(Stamp, Changes)],
    region: &VoxelBox,
    deflater: &mut Deflater,
    out: &mut Vec<u8>,
) {
    if parts.len() < 2 {
        return;
    }
    let mut bytes = Vec::new();
    varint::write(&mut bytes, parts.len() as u64);
    for pair in parts.windows(2) {
        if let [(earlier, _), (later, _)] = pair {
            varint::write(&mut bytes, later.0.wrapping_sub(earlier.0) as u64);
        }
    }
    // Numbers from 1; 0 stands for voxels that are not known.
    let mut numbers = vec![0u32; region.volume() as usize];
    let size = region.size().map(|side| side as usize);
    for (number, (_, states)) in (1..).zip(parts) {
        for (voxel, _) in states.voxels() {
            if let Some(to) = numbers.get_mut(place(region, voxel)) {
                *to = number;
            }
        }
    }
    let mut high = Vec::new();
    walk(size, |leaf| {
        leaf.for_each(|index| {
            if let Some(number) = numbers.get(index).and_then(|number| number.checked_sub(1)) {
                bytes.push(number as u8);
                high.push((number >> 8) as u8);
            }
        });
    });
    if parts.len() > 256 {
        bytes.append(&mut high);
    }
    deflater.deflate(&bytes, out);
}

/// Joins `states`, what is known in `region`, with the stamps in `bytes`. `first` and `last` are the oldest and the
/// newest stamp by the header. `payload_bytes` is the length of the whole payload, which sets the limits.
pub(crate) fn decode(
    codec: Codec,
    bytes: &[u8],
    states: Changes,
    region: VoxelBox,
    [first, last]: [Stamp; 2],
    payload_bytes: usize,
    grid: &mut CodeGrid,
) -> Result<PresentState, PackageError> {
    let wrong = |rule| PackageError::Payload { codec, rule };
    if bytes.is_empty() {
        if first != last {
            return Err(wrong("a tile without stamps of its own has one stamp"));
        }
        let parts = if states.is_empty() { Vec::new() } else { vec![(first, states)] };
        return Ok(PresentState { region, parts, sensors: Vec::new() });
    }
    let known = states.len();
    let stamps_max = known.min(STAMPS_MAX);
    let inflated = inflate_up_to(bytes, 10 * (stamps_max + 1) + 2 * known)
        .ok_or_else(|| wrong("stamps are one whole zlib stream and nothing after it"))?;

    let mut reader = Reader::new(&inflated);
    let count = reader.number("number of stamps", stamps_max as u64)? as usize;
    let mut stamps = vec![first];
    for _ in 1..count {
        let difference = reader.number("difference of stamps", u64::MAX)?;
        let earlier = stamps.last().map_or(first.0, |stamp| stamp.0);
        let stamp = earlier.checked_add_unsigned(difference).filter(|stamp| *stamp > earlier);
        stamps.push(Stamp(stamp.ok_or_else(|| wrong("stamps ascend within 64 bits"))?));
    }
    if count < 2 || stamps.last() != Some(&last) {
        return Err(wrong("two stamps or more, the last of them the newest by the header"));
    }
    let numbers = reader.rest();
    let (low, high) = numbers.split_at_checked(known).ok_or_else(|| wrong("a stamp for each known voxel"))?;
    if high.len() != if count > 256 { known } else { 0 } {
        return Err(wrong("a stamp for each known voxel, and nothing after them"));
    }
    let mut numbers = low.iter().zip(high.iter().copied().chain(core::iter::repeat(0)));

    grid.fill(&states, &region, UNKNOWN);
    let codes = grid.codes();
    let mut blocks = BTreeMap::<(u16, BlockIndex), StateBlock>::new();
    let blocks_max = part_blocks_max(payload_bytes);
    let mut fault = None;
    walk(region.size().map(|side| side as usize), |leaf| {
        leaf.for_each(|index| {
            let state = match codes.get(index) {
                Some(&FREE) => flockmap_grid::State::Free,
                Some(&OCCUPIED) => flockmap_grid::State::Occupied,
                _ => return,
            };
            let Some((low, high)) = numbers.next() else { return };
            let number = u16::from_le_bytes([*low, high]);
            if usize::from(number) >= count {
                fault = Some("a voxel has one of the stamps that there are");
            } else if blocks.len() > blocks_max {
                fault = Some("no more than 64 blocks of equal stamp for each byte of payload");
            }
            if fault.is_none() {
                let voxel = voxel_at(&region, index);
                blocks.entry((number, voxel.block())).or_default().set(voxel_bit(voxel), state);
            }
        });
    });
    if let Some(rule) = fault {
        return Err(wrong(rule));
    }

    let mut parts: Vec<(Stamp, Changes)> = Vec::new();
    let mut blocks = blocks.into_iter().peekable();
    for (number, stamp) in stamps.into_iter().enumerate() {
        let mut part = Vec::new();
        while let Some(((_, index), block)) = blocks.next_if(|((of, _), _)| usize::from(*of) == number) {
            part.push((index, block));
        }
        if part.is_empty() {
            return Err(wrong("every stamp has a voxel"));
        }
        parts.push((stamp, Changes::from_blocks(part)));
    }
    Ok(PresentState { region, parts, sensors: Vec::new() })
}

fn place(region: &VoxelBox, voxel: Voxel) -> usize {
    let (min, size) = (region.min(), region.size().map(|s| s as usize));
    let [x, y, z] = [voxel.x - min.x, voxel.y - min.y, voxel.z - min.z].map(|d| d as usize);
    (z * size[1] + y) * size[0] + x
}

fn voxel_at(region: &VoxelBox, index: usize) -> Voxel {
    let (min, size) = (region.min(), region.size().map(|s| s as usize));
    let (xy, x) = (index / size[0], index % size[0]);
    Voxel::new(min.x + x as i32, min.y + (xy % size[1]) as i32, min.z + (xy / size[1]) as i32)
}
