//! The stamps of a snapshot, after its states and the same for all codecs.
//!
//! Nothing if all known voxels have one stamp, which the header has. Else one zlib stream of: the number of
//! stamps; the differences from each stamp to the next; then for each known voxel along the Hilbert walk of
//! the box the number of its stamp, the low bytes of all voxels first, and the high bytes after them if there
//! are more than 256 stamps.

use flockmap_grid::{Changes, Snapshot, Stamp, StateBlock, VoxelBox};

use super::blocks::Blocks;
use super::codes::{FREE, OCCUPIED, UNKNOWN};
use super::grid::{CodeGrid, place};
use super::hilbert::{Places, walk, walk_places};
use crate::bytes::put_varint;
use crate::codec::Codec;
use crate::deflate::{Deflater, inflate_up_to};
use crate::error::PackageError;
use crate::fields::Fields;
use crate::work::{self, Work};

/// Most distinct stamps in a chunk.
pub(crate) const STAMPS_MAX: usize = 1 << 16;

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
    put_varint(&mut bytes, parts.len() as u64);
    for pair in parts.windows(2) {
        if let [(earlier, _), (later, _)] = pair {
            put_varint(&mut bytes, later.0.wrapping_sub(earlier.0) as u64);
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

/// The steps that [`decode`] takes for such parts.
pub(crate) fn steps(parts: &[(Stamp, Changes)], region: &VoxelBox) -> u64 {
    if parts.len() < 2 {
        return 0;
    }
    let known: usize = parts.iter().map(|(_, part)| part.len()).sum();
    let blocks: usize = parts.iter().map(|(_, part)| part.blocks().len()).sum();
    work::of_stamps(region.volume() as u64, known as u64) + work::BLOCK_STEPS * blocks as u64
}

/// Joins `states`, what is known in `region`, with the stamps in `bytes`. `first` and `last` are the oldest
/// and the newest stamp by the header. What it takes counts as `work` of the whole payload.
pub(crate) fn decode(
    codec: Codec,
    bytes: &[u8],
    states: Changes,
    region: &VoxelBox,
    [first, last]: [Stamp; 2],
    work: &mut Work,
    grid: &mut CodeGrid,
) -> Result<Snapshot, PackageError> {
    let wrong = |rule| PackageError::Payload { codec, rule };
    if bytes.is_empty() {
        if first != last {
            return Err(wrong("a chunk without stamps of its own has one stamp"));
        }
        let parts = if states.is_empty() { Vec::new() } else { vec![(first, states)] };
        return Ok(Snapshot { region: *region, parts, sensors: Vec::new() });
    }
    let known = states.len();
    work.take(work::of_stamps(region.volume() as u64, known as u64))?;
    let stamps_max = known.min(STAMPS_MAX);
    let inflated = inflate_up_to(bytes, 10 * (stamps_max + 1) + 2 * known)
        .ok_or_else(|| wrong("stamps are one whole zlib stream and nothing after it"))?;

    let mut reader = Fields::new(&inflated);
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

    grid.fill(&states, region, UNKNOWN);
    let codes = grid.codes();
    let size = region.size().map(|side| side as usize);
    let places = Places::of(size);
    let mut blocks = Blocks::new(region, work);
    walk_places(size, |leaf| {
        leaf.for_each(|at| {
            let [x, y, z] = places.place(at);
            let index = (z as usize * size[1] + y as usize) * size[0] + x as usize;
            let plane = match codes.get(index) {
                Some(&FREE) => 0,
                Some(&OCCUPIED) => 1,
                _ => return,
            };
            let Some((low, high)) = numbers.next() else { return };
            let number = u16::from_le_bytes([*low, high]);
            if usize::from(number) >= count {
                blocks.fault.get_or_insert_with(|| wrong("a voxel has one of the stamps that there are"));
            } else if let Some((planes, bit)) = blocks.at(number, [x, y, z]) {
                planes[plane][bit >> 6 & 7] |= 1 << (bit & 63);
            }
        });
    });
    let mut blocks = blocks.finish()?;
    blocks.sort_unstable_by_key(|(of, _)| *of);
    let parts: Vec<(Stamp, Changes)> = blocks
        .chunk_by(|((a, _), _), ((b, _), _)| a == b)
        .filter_map(|part| {
            let ((number, _), _) = part.first()?;
            let blocks =
                part.iter().map(|((_, index), [free, occupied])| (*index, StateBlock::new(*free, *occupied)));
            Some((*stamps.get(usize::from(*number))?, Changes::from_blocks(blocks.collect())))
        })
        .collect();
    if parts.len() < count {
        return Err(wrong("every stamp has a voxel"));
    }
    Ok(Snapshot { region: *region, parts, sensors: Vec::new() })
}
