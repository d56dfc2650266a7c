//! Reading and writing the bytes of messages, with errors that say what was expected.

use anyhow::{Context, Error, Result, anyhow, ensure};
use flockmap::codec::bytes::{self, put_varint};
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

/// Reads a message of one method from the front.
pub(crate) struct Reader<'a> {
    method: &'static str,
    bytes: bytes::Reader<'a>,
}

impl<'a> Reader<'a> {
    pub(crate) const fn new(method: &'static str, bytes: &'a [u8]) -> Self {
        Self { method, bytes: bytes::Reader::new(bytes) }
    }

    /// What is wrong, as an error.
    pub(crate) fn wrong(&self, rule: &str) -> Error {
        anyhow!("damaged message of {}: expected {rule}", self.method)
    }

    pub(crate) const fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// What has not been read.
    pub(crate) const fn rest(&self) -> &'a [u8] {
        self.bytes.rest()
    }

    pub(crate) fn take(&mut self, count: usize, rule: &'static str) -> Result<&'a [u8]> {
        self.bytes.bytes(count).ok_or_else(|| self.wrong(rule))
    }

    pub(crate) fn array<const N: usize>(&mut self, rule: &'static str) -> Result<[u8; N]> {
        self.bytes.array().ok_or_else(|| self.wrong(rule))
    }

    pub(crate) fn u8(&mut self, rule: &'static str) -> Result<u8> {
        self.array::<1>(rule).map(|[byte]| byte)
    }

    pub(crate) fn u32(&mut self, rule: &'static str) -> Result<u32> {
        self.array(rule).map(u32::from_le_bytes)
    }

    pub(crate) fn i32(&mut self, rule: &'static str) -> Result<i32> {
        self.array(rule).map(i32::from_le_bytes)
    }

    pub(crate) fn f64(&mut self, rule: &'static str) -> Result<f64> {
        self.array(rule).map(f64::from_le_bytes)
    }

    /// A box as [`write_box`] puts it, with sides of at most so many voxels.
    pub(crate) fn voxel_box(&mut self, side_max: u64, rule: &'static str) -> Result<VoxelBox> {
        let min = Voxel::new(self.i32(rule)?, self.i32(rule)?, self.i32(rule)?);
        let mut size = [0; 3];
        for side in &mut size {
            *side = self.varint(side_max, rule)? as u32;
        }
        VoxelBox::new(min, size).ok_or_else(|| self.wrong(rule))
    }

    /// A number of at most `max`.
    pub(crate) fn varint(&mut self, max: u64, rule: &'static str) -> Result<u64> {
        self.bytes.varint().filter(|value| *value <= max).ok_or_else(|| self.wrong(rule))
    }
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

/// What the rest of a message was made of by [`Packer::pack`]. Takes the memory that the message asks for, at most
/// [`UNPACKED_BYTES_MAX`].
pub(crate) fn unpack(reader: &mut Reader<'_>) -> Result<Vec<u8>> {
    let rule = "a length of at most 64 MiB and one zstd frame of that length";
    let length = reader.varint(UNPACKED_BYTES_MAX as u64, rule)? as usize;
    let plain = zstd::bulk::decompress(reader.rest(), length).map_err(|_| reader.wrong(rule))?;
    if plain.len() == length { Ok(plain) } else { Err(reader.wrong(rule)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back() {
        for value in [0, 1, 127, 128, 300, 1 << 40, (1 << 63) - 1] {
            let mut out = Vec::new();
            put_varint(&mut out, value);
            assert_eq!(Reader::new("test", &out).varint(value, "n").unwrap(), value);
            assert!(value == 0 || Reader::new("test", &out).varint(value - 1, "n").is_err());
        }
        assert!(Reader::new("test", &[0xff; 12]).varint(u64::MAX, "n").is_err());
    }

    #[test]
    fn a_frame_is_no_larger_than_it_says() {
        let packed = Packer::new("test", 3).pack(&[7; 5_000]).unwrap();
        assert_eq!(unpack(&mut Reader::new("test", &packed)).unwrap(), [7; 5_000]);
        let mut small = Vec::new();
        put_varint(&mut small, 4_999);
        small.extend_from_slice(&packed[2..]);
        assert!(unpack(&mut Reader::new("test", &small)).is_err());
        let mut huge = Vec::new();
        put_varint(&mut huge, UNPACKED_BYTES_MAX as u64 + 1);
        huge.extend_from_slice(&packed[2..]);
        assert!(unpack(&mut Reader::new("test", &huge)).is_err());
    }
}
