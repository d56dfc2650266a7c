//! Payload: the bytes of one arithmetic coder, which give the number of changes and then each of them, and
//! zeros up to the length that [`voxels_max`] asks for.

use flockmap_grid::{BlockIndex, Changes, State, StateBlock, VoxelBox, set_bits};

use super::law::Gaps;
use super::limits::{bytes_min, voxels_max};
use super::places::Order;
use crate::codec::Codec;
use crate::error::PackageError;
use crate::limits::BOX_VOXELS_MAX;
use crate::work::{self, Work};
use flockmap_coder::{BitReader, BitWriter, FineBits};

/// Appends the payload for `changes`, all inside `region`, which has at most [`BOX_VOXELS_MAX`] voxels. No
/// changes: no bytes.
pub(crate) fn encode(changes: &Changes, region: &VoxelBox, out: &mut Vec<u8>) {
    debug_assert!(region.volume() <= u128::from(BOX_VOXELS_MAX));
    let (start, total) = (out.len(), changes.len());
    if total == 0 {
        return;
    }
    let order = Order::new(region);
    let mut walk = Walk::new(total as u32, region.volume() as u32);
    let mut bits = BitWriter::new(out);
    number(&mut bits, total as u32);
    for (index, block) in changes.blocks() {
        let part = order.part(*index);
        for bit in set_bits(&block.known()) {
            walk.step(&mut bits, part.place(bit as u32), block.get(bit) == State::Occupied);
        }
    }
    bits.finish();
    let length = (out.len() - start).max(bytes_min(total, changes.blocks().len()));
    out.resize(start + length, 0);
}

/// The changes in `payload`; the inverse of [`encode`]. The number is checked against the box and
/// [`voxels_max`] before memory is taken. Any other bytes give some changes inside the box: whether they are
/// right is for the check of the package to say.
///
/// # Errors
/// [`PackageError::BoxTooLarge`] for more than [`BOX_VOXELS_MAX`] voxels, [`PackageError::Payload`] for too
/// many changes.
pub(crate) fn decode(payload: &[u8], region: &VoxelBox, work: &mut Work) -> Result<Changes, PackageError> {
    let (codec, voxels) = (Codec::Flock, region.volume());
    if voxels > u128::from(BOX_VOXELS_MAX) {
        return Err(PackageError::BoxTooLarge {
            voxels,
            payload: payload.len(),
            codec,
            limit: BOX_VOXELS_MAX,
        });
    }
    let limit = (voxels as usize).min(voxels_max(payload.len()));
    let mut bits = BitReader::new(payload);
    let total = number(&mut bits, 0);
    if total as usize > limit {
        let rule = "there are no more changes than voxels in the box, and than so many bytes may hold";
        return Err(PackageError::Payload { codec, rule });
    }
    work.take(work::CHANGE_STEPS * u64::from(total))?;
    let order = Order::new(region);
    let mut walk = Walk::new(total, voxels as u32);
    let mut blocks: Vec<(BlockIndex, StateBlock)> = Vec::new();
    let mut current = None;
    let (mut free, mut occupied) = ([0u64; 8], [0u64; 8]);
    while walk.left > 0 {
        let (place, is_occupied) = walk.step(&mut bits, 0, false);
        let part = match current {
            Some(part) if order.reaches(&part, place) => part,
            _ => {
                work.take(work::GAP_CODED_BLOCK_STEPS)?;
                let next = order.part_at(place);
                if let Some(part) = current.replace(next) {
                    blocks.push((part.index, StateBlock::new(free, occupied)));
                    (free, occupied) = ([0; 8], [0; 8]);
                }
                next
            }
        };
        let bit = part.bit(place);
        let plane = if is_occupied { &mut occupied } else { &mut free };
        // A bit number is below 512.
        plane[bit as usize >> 6 & 7] |= 1 << (bit & 63);
    }
    blocks.extend(current.map(|part| (part.index, StateBlock::new(free, occupied))));
    Ok(Changes::from_blocks(blocks))
}

/// Writes or reads a number of 1 … 2²⁸ − 1: how many bits follow the highest one, each with a probability of
/// ¾ that there are more, then these as they are. A reader's `truth` means nothing.
pub(super) fn number(bits: &mut impl FineBits, truth: u32) -> u32 {
    let mut length = 0;
    while length < 27 && bits.bit(3 << 30, truth >> length > 1) {
        length += 1;
    }
    (0..length).rev().fold(1, |number, bit| number << 1 | u32::from(bits.bit(1 << 31, truth >> bit & 1 == 1)))
}

/// From change to change along the order of the box: writer and reader take the same steps.
struct Walk {
    /// Changes to come.
    left: u32,
    /// Voxels to come: those after the last change.
    rest: u32,
    /// Place of the voxel after the last change.
    next: u32,
    /// Changes so far, and how many of them became Occupied.
    seen: u32,
    occupied: u32,
}

impl Walk {
    fn new(changes: u32, voxels: u32) -> Self {
        Self { left: changes, rest: voxels, next: 0, seen: 0, occupied: 0 }
    }

    /// Writes or reads the next change: its place and whether it is Occupied. A reader's arguments mean
    /// nothing.
    #[inline]
    fn step(&mut self, bits: &mut impl FineBits, place: u32, is_occupied: bool) -> (u32, bool) {
        let gap = Gaps::new(self.left, self.rest).code(bits, place.wrapping_sub(self.next));
        // As if one of each had come before the first: this costs as much as to send the number of Occupied,
        // and no more.
        let probability = (u64::from(self.occupied + 1) << 32) / u64::from(self.seen + 2);
        let is_occupied = bits.bit(probability as u32, is_occupied);
        let place = self.next + gap;
        self.left -= 1;
        self.rest -= gap + 1;
        self.next = place + 1;
        self.seen += 1;
        self.occupied += u32::from(is_occupied);
        (place, is_occupied)
    }
}
