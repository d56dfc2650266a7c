//! The changed voxels as a sorted list of addresses, differences of neighbours as varints, zstd 19 on top:
//! what a good engineer would try before anything else. Of three layouts the smallest is sent.
//!
//! A message: layout (u8), lowest voxel of the box (3 × i32), sides of the box (3 varints), then length and
//! zstd frame of the lists. Layout 0, nested order: number of voxels; distances to the voxel before; a bit a
//! voxel, 1 for occupied. Layout 1, nested order, and 2, Morton order: number of runs of neighbouring voxels;
//! the gap before each; the length of each, less 1; then lengths of runs of one state along the list, free
//! first.

use anyhow::{Context, Result, ensure};
use flockmap::codec::Batch;
use flockmap::grid::{Changes, Stamp, State, Voxel, VoxelBox};

use crate::baselines::bytes::{
    MESSAGE_VOXELS_MAX, Packer, Reader, nested_place, nested_voxel, put_varint, read_box, unpack,
    varint_up_to, write_box,
};
use crate::baselines::morton::{interleave, separate};
use crate::baselines::traits::{Messages, Sender};

const METHOD: &str = "address-delta-zstd";

pub(crate) struct AddressDeltaSender {
    packer: Packer,
}

impl AddressDeltaSender {
    pub(crate) fn new() -> Self {
        Self { packer: Packer::new(METHOD, 19) }
    }
}

impl Sender for AddressDeltaSender {
    fn batch(&mut self, _now: Stamp, _batch: &Batch, changes: &Changes, out: &mut Messages) -> Result<()> {
        let fits = changes.len() as u64 <= MESSAGE_VOXELS_MAX;
        ensure!(fits, "{METHOD} cannot send this: a message has at most 2²³ voxels");
        let Some(region) = changes.bounding_box() else { return Ok(()) };
        let order = |order: Order| -> Option<Vec<(u64, State)>> {
            let addresses =
                changes.voxels().map(|(voxel, state)| Some((order.address(&region, voxel)?, state)));
            let mut list = addresses.collect::<Option<Vec<_>>>()?;
            list.sort_unstable_by_key(|(address, _)| *address);
            Some(list)
        };
        let nested = order(Order::Nested).context("a box of more than 2⁶² voxels")?;
        let mut layouts = vec![(0, singles(&nested)), (1, runs(&nested))];
        layouts.extend(order(Order::Morton).map(|morton| (2, runs(&morton))));
        let packed = layouts.into_iter().map(|(layout, lists)| Ok((layout, self.packer.pack(&lists)?)));
        let packed = packed.collect::<Result<Vec<(u8, Vec<u8>)>>>()?;
        let smallest = packed.into_iter().min_by_key(|(_, packed)| packed.len());
        let Some((layout, packed)) = smallest else { return Ok(()) };
        let mut message = vec![layout];
        write_box(&mut message, &region);
        message.extend_from_slice(&packed);
        out.push(message);
        Ok(())
    }
}

/// What the address of a voxel in its box is.
#[derive(Clone, Copy)]
enum Order {
    /// x slowest, z fastest.
    Nested,
    /// The bits of x, y and z in turn.
    Morton,
}

const MORTON_BITS: u32 = 20;
const ADDRESS_MAX: u64 = 1 << 62;

impl Order {
    /// `None` if the box is too large for it.
    fn address(self, region: &VoxelBox, voxel: Voxel) -> Option<u64> {
        let (min, size) = (region.min(), region.size());
        match self {
            Self::Nested => {
                let fits = region.volume() <= u128::from(ADDRESS_MAX);
                fits.then(|| nested_place(region, voxel))
            }
            Self::Morton => {
                let fits = size.iter().all(|side| *side <= 1 << MORTON_BITS);
                let place = [voxel.x - min.x, voxel.y - min.y, voxel.z - min.z].map(|d| d as u64);
                fits.then(|| interleave(place))
            }
        }
    }

    /// `None` if there is no such voxel in the box.
    fn voxel(self, region: &VoxelBox, address: u64) -> Option<Voxel> {
        match self {
            Self::Nested => nested_voxel(region, address),
            Self::Morton => {
                let (min, place) = (region.min(), separate(address));
                let is_inside = place.iter().zip(region.size()).all(|(at, side)| *at < u64::from(side));
                let [x, y, z] = place.map(|at| at as i32);
                is_inside.then(|| Voxel::new(min.x + x, min.y + y, min.z + z))
            }
        }
    }
}

fn singles(list: &[(u64, State)]) -> Vec<u8> {
    let mut out = Vec::with_capacity(2 * list.len());
    put_varint(&mut out, list.len() as u64);
    let mut next = 0;
    for (address, _) in list {
        put_varint(&mut out, address - next);
        next = address + 1;
    }
    out.extend(list.chunks(8).map(|eight| {
        eight
            .iter()
            .enumerate()
            .fold(0, |byte, (bit, (_, state))| byte | u8::from(*state == State::Occupied) << bit)
    }));
    out
}

fn runs(list: &[(u64, State)]) -> Vec<u8> {
    let (mut gaps, mut lengths, mut count) = (Vec::new(), Vec::new(), 0);
    let mut next = 0;
    for run in list.chunk_by(|(a, _), (b, _)| a + 1 == *b) {
        let Some((first, _)) = run.first() else { continue };
        put_varint(&mut gaps, first - next);
        put_varint(&mut lengths, run.len() as u64 - 1);
        next = first + run.len() as u64;
        count += 1;
    }
    let mut out = Vec::with_capacity(2 * gaps.len());
    put_varint(&mut out, count);
    out.extend_from_slice(&gaps);
    out.extend_from_slice(&lengths);
    if list.first().is_some_and(|(_, state)| *state == State::Occupied) {
        out.push(0);
    }
    for run in list.chunk_by(|(_, a), (_, b)| a == b) {
        put_varint(&mut out, run.len() as u64);
    }
    out
}

/// What a message changes. Memory: what it unpacks to, at most 64 MiB, and 16 bytes for each of at most 2²³
/// voxels.
pub(crate) fn parse(message: &[u8]) -> Option<Changes> {
    let mut reader = Reader::new(message);
    let layout = reader.u8()?;
    let region = read_box(&mut reader, u64::from(u32::MAX))?;
    let lists = unpack(&mut reader)?;
    let mut lists = Reader::new(&lists);
    let voxels = match layout {
        0 => read_singles(&mut lists, &region)?,
        1 => read_runs(&mut lists, &region, Order::Nested)?,
        2 => read_runs(&mut lists, &region, Order::Morton)?,
        _ => return None,
    };
    lists.is_empty().then(|| Changes::from_voxels(voxels))
}

fn read_singles(lists: &mut Reader<'_>, region: &VoxelBox) -> Option<Vec<(Voxel, State)>> {
    // A distance takes a byte at least.
    let count = varint_up_to(lists, MESSAGE_VOXELS_MAX.min(lists.rest().len() as u64))? as usize;
    let mut voxels = Vec::with_capacity(count);
    let mut next = 0u64;
    for _ in 0..count {
        let address = next + varint_up_to(lists, ADDRESS_MAX - next)?;
        voxels.push((Order::Nested.voxel(region, address)?, State::Free));
        next = address + 1;
    }
    let bits = lists.bytes(count.div_ceil(8))?;
    for (eight, byte) in voxels.chunks_mut(8).zip(bits) {
        for (bit, (_, state)) in eight.iter_mut().enumerate() {
            if byte >> bit & 1 == 1 {
                *state = State::Occupied;
            }
        }
    }
    Some(voxels)
}

fn read_runs(lists: &mut Reader<'_>, region: &VoxelBox, order: Order) -> Option<Vec<(Voxel, State)>> {
    // A run takes two bytes at least.
    let count = varint_up_to(lists, lists.rest().len() as u64 / 2)?;
    let gaps = (0..count).map(|_| varint_up_to(lists, ADDRESS_MAX)).collect::<Option<Vec<_>>>()?;
    let mut voxels: Vec<(Voxel, State)> = Vec::new();
    let mut next = 0u64;
    for gap in gaps {
        let room = MESSAGE_VOXELS_MAX - voxels.len() as u64;
        let length = 1 + varint_up_to(lists, room.checked_sub(1)?)?;
        let first = next.checked_add(gap).filter(|first| *first <= ADDRESS_MAX)?;
        next = first + length;
        for address in first..next {
            voxels.push((order.voxel(region, address)?, State::Free));
        }
    }
    let (mut done, mut state) = (0usize, State::Free);
    while done < voxels.len() {
        let length = varint_up_to(lists, (voxels.len() - done) as u64)? as usize;
        if length == 0 && done > 0 {
            return None;
        }
        voxels.get_mut(done..done + length)?.iter_mut().for_each(|voxel| voxel.1 = state);
        done += length;
        state = if state == State::Free { State::Occupied } else { State::Free };
    }
    Some(voxels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_layout_gives_back_what_went_in(
            voxels in prop::collection::vec(((-9..9i32, -40..40i32, 5..12i32), any::<bool>()), 1..300),
        ) {
            let state = |occupied| if occupied { State::Occupied } else { State::Free };
            let voxel = |(x, y, z)| Voxel::new(x, y, z);
            let changes = Changes::from_voxels(voxels.into_iter().map(|(v, o)| (voxel(v), state(o))));
            let region = changes.bounding_box().unwrap();
            for (order, layout) in [(Order::Nested, 0), (Order::Nested, 1), (Order::Morton, 2)] {
                let mut list: Vec<_> =
                    changes.voxels().map(|(v, s)| (order.address(&region, v).unwrap(), s)).collect();
                list.sort_unstable_by_key(|(address, _)| *address);
                let lists = if layout == 0 { singles(&list) } else { runs(&list) };
                let mut reader = Reader::new(&lists);
                let read = if layout == 0 {
                    read_singles(&mut reader, &region)
                } else {
                    read_runs(&mut reader, &region, order)
                };
                prop_assert_eq!(&Changes::from_voxels(read.unwrap()), &changes);
                prop_assert!(reader.is_empty());
            }
        }
    }
}
