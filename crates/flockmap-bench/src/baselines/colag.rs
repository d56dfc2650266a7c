//! ColAG (the paper's \[6\]): the addresses of the occupied and of the unknown voxels in a region around the
//! robot; all else in the region is free.
//!
//! A message: number of boxes; each box as its lowest voxel (3 × i32) and its sides (3 numbers); number of
//! occupied voxels; their addresses; then the addresses of the unknown voxels up to the end. An address is 4
//! bytes: the place in the boxes one after the other, each in nested order. Numbers are varints.

use anyhow::{Result, ensure};
use flockmap::codec::Batch;
use flockmap::grid::{BLOCK_VOXELS, Changes, Stamp, State, StateBlock, VOXEL_LIMIT, VoxelBox, voxel_bit};

use crate::baselines::bytes::{
    Reader, nested_place, nested_voxel, put_varint, read_box, varint_up_to, write_box,
};
use crate::baselines::state_map::StateMap;
use crate::baselines::traits::{Messages, Sender};

/// What the region is.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Region {
    /// The box of the batch's changes: a box round the robot, and none larger than it has to be.
    Box,
    /// The box of the changes in each block of 8³ voxels: as little as any region could be.
    Blocks,
}

pub(crate) struct ColagSender {
    region: Region,
    published: StateMap,
}

impl ColagSender {
    pub(crate) fn new(region: Region) -> Self {
        Self { region, published: StateMap::default() }
    }
}

const METHOD: &str = "colag";

/// Most voxels in the region of a message.
const REGION_VOXELS_MAX: u64 = 1 << 26;

impl Sender for ColagSender {
    fn batch(&mut self, _now: Stamp, _batch: &Batch, changes: &Changes, out: &mut Messages) -> Result<()> {
        self.published.apply(changes)?;
        let boxes: Vec<VoxelBox> = match self.region {
            Region::Box => changes.bounding_box().into_iter().collect(),
            Region::Blocks => {
                let one = |pair| Changes::from_blocks(vec![pair]).bounding_box();
                changes.blocks().iter().filter_map(|pair| one(*pair)).collect()
            }
        };
        let volume: u128 = boxes.iter().map(VoxelBox::volume).sum();
        let fits = volume <= u128::from(REGION_VOXELS_MAX);
        ensure!(fits, "{METHOD} cannot send this: a region has at most 2²⁶ voxels");
        let mut message = Vec::new();
        put_varint(&mut message, boxes.len() as u64);
        let (mut occupied, mut unknown) = (Vec::new(), Vec::new());
        let mut first = 0u32;
        for region in &boxes {
            write_box(&mut message, region);
            self.list(region, first, &mut occupied, &mut unknown);
            first += region.volume() as u32;
        }
        put_varint(&mut message, occupied.len() as u64);
        for address in occupied.iter().chain(&unknown) {
            message.extend_from_slice(&address.to_le_bytes());
        }
        out.push(message);
        Ok(())
    }
}

impl ColagSender {
    fn list(&self, region: &VoxelBox, first: u32, occupied: &mut Vec<u32>, unknown: &mut Vec<u32>) {
        for index in region.blocks() {
            let block = self.published.block(index);
            for bit in 0..BLOCK_VOXELS {
                let list = match block.get(bit) {
                    State::Free => continue,
                    State::Occupied => &mut *occupied,
                    State::Unknown => &mut *unknown,
                };
                let voxel = index.voxel(bit);
                if region.contains(voxel) {
                    list.push(first + nested_place(region, voxel) as u32);
                }
            }
        }
    }
}

/// What a message changes: what it says to be unknown stays as it was. Memory: 160 bytes for each block of
/// the region, at most 2²⁶ voxels.
pub(crate) fn parse(message: &[u8]) -> Option<Changes> {
    let mut reader = Reader::new(message);
    // A box takes 15 bytes at least.
    let count = varint_up_to(&mut reader, message.len() as u64 / 15)?;
    let mut boxes = Vec::with_capacity(count as usize);
    let mut volume = 0u64;
    for _ in 0..count {
        let region = read_box(&mut reader, VOXEL_LIMIT as u64)?;
        if region.volume() > u128::from(REGION_VOXELS_MAX - volume) {
            return None;
        }
        boxes.push((volume, region));
        volume += region.volume() as u64;
    }
    let occupied = reader.varint()?;
    let (addresses, rest) = reader.rest().as_chunks::<4>();
    let (occupied, unknown) = addresses.split_at_checked(usize::try_from(occupied).ok()?)?;
    if !rest.is_empty() {
        return None;
    }

    let all_free = StateBlock::new([!0; 8], [0; 8]);
    let mut states = StateMap::default();
    for (_, region) in &boxes {
        let blocks = region.blocks().map(|index| (index, all_free)).collect();
        states.apply(&Changes::from_blocks(blocks).within(region)).ok()?;
    }
    let lists = [(occupied, State::Occupied), (unknown, State::Unknown)];
    for (address, state) in lists.iter().flat_map(|(list, state)| list.iter().map(move |a| (a, *state))) {
        let address = u64::from(u32::from_le_bytes(*address));
        let at = boxes.partition_point(|(first, _)| *first <= address);
        let (first, region) = boxes.get(at.checked_sub(1)?)?;
        let voxel = nested_voxel(region, address - first)?;
        states.set(voxel.block(), voxel_bit(voxel), state);
    }
    Some(Changes::from_blocks(states.blocks().collect()))
}
