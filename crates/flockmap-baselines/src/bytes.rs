//! Reading and writing the bytes of messages, with errors that say what was expected.

use flockmap_codec::bytes::{self, put_varint};

use crate::{ReceiveError, SendError};

/// Most bytes that the packed part of a message may become, 64 MiB.
pub(crate) const UNPACKED_BYTES_MAX: usize = 64 << 20;

/// Most voxels that one message may speak of, 2²³.
pub(crate) const MESSAGE_VOXELS_MAX: u64 = 1 << 23;

/// Reads a message of one method from the front; what is wrong with it is said in `rule`s.
pub(crate) struct Reader<'a> {
    method: &'static str,
    bytes: bytes::Reader<'a>,
}

impl<'a> Reader<'a> {
    pub(crate) const fn new(method: &'static str, bytes: &'a [u8]) -> Self {
        Self { method, bytes: bytes::Reader::new(bytes) }
    }

    /// What is wrong, as an error.
    pub(crate) const fn wrong(&self, rule: &'static str) -> ReceiveError {
        ReceiveError::Message { method: self.method, rule }
    }

    pub(crate) const fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// What has not been read.
    pub(crate) const fn rest(&self) -> &'a [u8] {
        self.bytes.rest()
    }

    pub(crate) fn take(&mut self, count: usize, rule: &'static str) -> Result<&'a [u8], ReceiveError> {
        self.bytes.bytes(count).ok_or_else(|| self.wrong(rule))
    }

    pub(crate) fn array<const N: usize>(&mut self, rule: &'static str) -> Result<[u8; N], ReceiveError> {
        self.bytes.array().ok_or_else(|| self.wrong(rule))
    }

    pub(crate) fn u8(&mut self, rule: &'static str) -> Result<u8, ReceiveError> {
        self.array(rule).map(|[byte]| byte)
    }

    pub(crate) fn u32(&mut self, rule: &'static str) -> Result<u32, ReceiveError> {
        self.array(rule).map(u32::from_le_bytes)
    }

    pub(crate) fn i32(&mut self, rule: &'static str) -> Result<i32, ReceiveError> {
        self.array(rule).map(i32::from_le_bytes)
    }

    pub(crate) fn f64(&mut self, rule: &'static str) -> Result<f64, ReceiveError> {
        self.array(rule).map(f64::from_le_bytes)
    }

    /// A number of at most `max`, in its shortest form.
    pub(crate) fn varint(&mut self, max: u64, rule: &'static str) -> Result<u64, ReceiveError> {
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
    pub(crate) fn pack(&mut self, plain: &[u8]) -> Result<Vec<u8>, SendError> {
        let limit = SendError::Limit { method: self.method, limit: "its messages unpack to at most 64 MiB" };
        if plain.len() > UNPACKED_BYTES_MAX {
            return Err(limit);
        }
        let memory = SendError::Limit { method: self.method, limit: "zstd needs memory to compress" };
        let frame = self.zstd.as_mut().and_then(|zstd| zstd.compress(plain).ok()).ok_or(memory)?;
        let mut out = Vec::with_capacity(frame.len() + 5);
        put_varint(&mut out, plain.len() as u64);
        out.extend_from_slice(&frame);
        Ok(out)
    }
}

/// What the rest of a message was made of by [`Packer::pack`]. Takes the memory that the message asks for, at most
/// [`UNPACKED_BYTES_MAX`].
pub(crate) fn unpack(reader: &mut Reader<'_>) -> Result<Vec<u8>, ReceiveError> {
    let rule = "a length of at most 64 MiB and one zstd frame of that length";
    let length = reader.varint(UNPACKED_BYTES_MAX as u64, rule)? as usize;
    let plain = zstd::bulk::decompress(reader.rest(), length).map_err(|_| reader.wrong(rule))?;
    if plain.len() == length { Ok(plain) } else { Err(reader.wrong(rule)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_at_most_what_it_may_be() {
        let mut out = Vec::new();
        put_varint(&mut out, 300);
        assert_eq!(Reader::new("test", &out).varint(300, "n"), Ok(300));
        let wrong = Err(ReceiveError::Message { method: "test", rule: "n" });
        assert_eq!(Reader::new("test", &out).varint(299, "n"), wrong);
        assert_eq!(Reader::new("test", &[]).varint(299, "n"), wrong);
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
