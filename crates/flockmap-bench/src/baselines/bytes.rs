//! What the messages of several methods are made of. What reads them gives `None` for damaged ones.

use anyhow::{Context, Result, ensure};
pub(crate) use flockmap::codec::bytes::{Reader, put_varint};
use flockmap::grid::{Voxel, VoxelBox};

/// Most bytes that the packed part of a message may become, 64 MiB.
pub(crate) const UNPACKED_BYTES_MAX: usize = 64 << 20;

/// Most voxels that one message may speak of, 2²³.
pub(crate) const MESSAGE_VOXELS_MAX: u64 = 1 << 23;

/// Appends a box: its lowest voxel, then its sides as varints.
pub(crate) fn write_box(out: &mut Vec<u8>, region: &VoxelBox) {
    let min = region.min();
    out.extend([min.x, min.y, min.z].iter().flat_map(|index| index.to_le_bytes()));
    region.size().into_iter().for_each(|side| put_varint(out, u64::from(side)));
}

/// A box as [`write_box`] puts it, with sides of at most so many voxels.
pub(crate) fn read_box(reader: &mut Reader<'_>, side_max: u64) -> Option<VoxelBox> {
    let [x, y, z] = [reader.u32()?, reader.u32()?, reader.u32()?].map(|index| index as i32);
    let mut side = || Some(varint_up_to(reader, side_max)? as u32);
    VoxelBox::new(Voxel::new(x, y, z), [side()?, side()?, side()?])
}

/// A varint of at most `max`.
pub(crate) fn varint_up_to(reader: &mut Reader<'_>, max: u64) -> Option<u64> {
    reader.varint().filter(|value| *value <= max)
}

/// Some numbers of 8 bytes.
pub(crate) fn read_f64s<const N: usize>(reader: &mut Reader<'_>) -> Option<[f64; N]> {
    let mut numbers = [0.0; N];
    for number in &mut numbers {
        *number = f64::from_le_bytes(reader.array()?);
    }
    Some(numbers)
}

/// The place of a voxel in a box that holds it, in nested order: x slowest, z fastest. The box has at most
/// 2⁶³ voxels.
pub(crate) fn nested_place(region: &VoxelBox, voxel: Voxel) -> u64 {
    let (min, [_, ny, nz]) = (region.min(), region.size().map(u64::from));
    let [x, y, z] = [voxel.x - min.x, voxel.y - min.y, voxel.z - min.z].map(|d| d as u64);
    (x * ny + y) * nz + z
}

/// The voxel at a place in nested order; `None` beyond the box.
pub(crate) fn nested_voxel(region: &VoxelBox, place: u64) -> Option<Voxel> {
    let (min, [nx, ny, nz]) = (region.min(), region.size().map(u64::from));
    let (xy, z) = (place / nz, place % nz);
    let (x, y) = (xy / ny, xy % ny);
    (x < nx).then(|| Voxel::new(min.x + x as i32, min.y + y as i32, min.z + z as i32))
}

/// Packs with zstd.
pub(crate) struct Packer {
    method: &'static str,
    zstd: Option<zstd::bulk::Compressor<'static>>,
}

impl Packer {
    pub(crate) fn new(method: &'static str, level: i32) -> Self {
        Self { method, zstd: zstd::bulk::Compressor::new(level).ok() }
    }

    /// The length of `plain`, then one zstd frame of it.
    pub(crate) fn pack(&mut self, plain: &[u8]) -> Result<Vec<u8>> {
        let method = self.method;
        ensure!(
            plain.len() <= UNPACKED_BYTES_MAX,
            "{method} cannot send this: its messages unpack to at most 64 MiB"
        );
        let frame = self.zstd.as_mut().and_then(|zstd| zstd.compress(plain).ok());
        let frame = frame.with_context(|| format!("{method}: zstd needs memory to compress"))?;
        let mut out = Vec::with_capacity(frame.len() + 5);
        put_varint(&mut out, plain.len() as u64);
        out.extend_from_slice(&frame);
        Ok(out)
    }
}

/// What the rest of a message was made of by [`Packer::pack`]. Takes the memory that the message asks for, at
/// most [`UNPACKED_BYTES_MAX`].
pub(crate) fn unpack(reader: &mut Reader<'_>) -> Option<Vec<u8>> {
    let length = varint_up_to(reader, UNPACKED_BYTES_MAX as u64)? as usize;
    let plain = zstd::bulk::decompress(reader.rest(), length).ok()?;
    (plain.len() == length).then_some(plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back() {
        for value in [0, 1, 127, 128, 300, 1 << 40, (1 << 63) - 1] {
            let mut out = Vec::new();
            put_varint(&mut out, value);
            assert_eq!(varint_up_to(&mut Reader::new(&out), value), Some(value));
            assert!(value == 0 || varint_up_to(&mut Reader::new(&out), value - 1).is_none());
        }
    }

    #[test]
    fn a_frame_is_no_larger_than_it_says() {
        let packed = Packer::new("test", 3).pack(&[7; 5_000]).unwrap();
        assert_eq!(unpack(&mut Reader::new(&packed)).unwrap(), [7; 5_000]);
        let mut small = Vec::new();
        put_varint(&mut small, 4_999);
        small.extend_from_slice(&packed[2..]);
        assert!(unpack(&mut Reader::new(&small)).is_none());
        let mut huge = Vec::new();
        put_varint(&mut huge, UNPACKED_BYTES_MAX as u64 + 1);
        huge.extend_from_slice(&packed[2..]);
        assert!(unpack(&mut Reader::new(&huge)).is_none());
    }
}
