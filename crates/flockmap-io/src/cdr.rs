//! CDR, the encoding of ROS 2 messages (OMG DDS-RTPS 10.5, "plain CDR" of XCDR version 1).
//!
//! Written by hand rather than taken from a serde crate: point data is handed on without copying, both byte orders
//! are read, and an error names the byte.

use crate::error::{Fault, Place};

/// Longest string taken from a message: names of frames and fields.
const STRING_BYTES_MAX: u32 = 4096;

/// Reads a message: each number lies at a multiple of its own size, counted from after the four bytes in front.
pub(crate) struct CdrReader<'a> {
    body: &'a [u8],
    at: usize,
    big_endian: bool,
}

const HEADER_BYTES: usize = 4;

impl<'a> CdrReader<'a> {
    pub(crate) fn new(message: &'a [u8]) -> Result<Self, Fault> {
        let big_endian = match message {
            [0, 0, _, _, ..] => true,
            [0, 1, _, _, ..] => false,
            [a, b, _, _, ..] => {
                return Err(Fault::foreign(
                    Place::Byte(0),
                    "plain CDR (first bytes 00 00 or 00 01)",
                    format!("{a:02x} {b:02x}"),
                ));
            }
            _ => {
                return Err(Fault::truncated(
                    Place::Byte(0),
                    "4 bytes in front of the CDR data",
                    format!("{} bytes", message.len()),
                ));
            }
        };
        Ok(Self { body: message.get(HEADER_BYTES..).unwrap_or_default(), at: 0, big_endian })
    }

    /// The place of the next byte in the message.
    pub(crate) const fn place(&self) -> Place {
        Place::Byte((self.at + HEADER_BYTES) as u64)
    }

    fn take(&mut self, n: usize, what: &str) -> Result<&'a [u8], Fault> {
        let rest = self.body.get(self.at..).unwrap_or_default();
        let Some(taken) = rest.get(..n) else {
            return Err(Fault::truncated(
                self.place(),
                format!("{n} bytes of {what}"),
                format!("{} bytes", rest.len()),
            ));
        };
        self.at += n;
        Ok(taken)
    }

    fn number<const N: usize>(&mut self, what: &str) -> Result<[u8; N], Fault> {
        self.at = self.at.next_multiple_of(N);
        let mut bytes = [0; N];
        bytes.copy_from_slice(self.take(N, what)?);
        if self.big_endian {
            bytes.reverse();
        }
        Ok(bytes)
    }

    pub(crate) fn u8(&mut self, what: &str) -> Result<u8, Fault> {
        self.number::<1>(what).map(u8::from_le_bytes)
    }

    pub(crate) fn u32(&mut self, what: &str) -> Result<u32, Fault> {
        self.number(what).map(u32::from_le_bytes)
    }

    pub(crate) fn i32(&mut self, what: &str) -> Result<i32, Fault> {
        self.number(what).map(i32::from_le_bytes)
    }

    pub(crate) fn f64(&mut self, what: &str) -> Result<f64, Fault> {
        self.number(what).map(f64::from_le_bytes)
    }

    pub(crate) fn string(&mut self, what: &str) -> Result<String, Fault> {
        let place = self.place();
        let length = self.u32(what)?;
        if length > STRING_BYTES_MAX {
            return Err(Fault::damaged(
                place,
                format!("a {what} of at most {STRING_BYTES_MAX} bytes"),
                format!("{length} bytes"),
            ));
        }
        let bytes = self.take(length as usize, what)?;
        // The closing zero counts; some writers leave it out of an empty string.
        let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        Ok(String::from_utf8_lossy(text).into_owned())
    }

    /// A sequence of bytes, not copied.
    pub(crate) fn bytes(&mut self, what: &str) -> Result<&'a [u8], Fault> {
        let length = self.u32(what)?;
        self.take(length as usize, what)
    }

    /// Length of a sequence whose elements take at least `element_bytes` each: more cannot follow than fit.
    pub(crate) fn sequence(&mut self, element_bytes: usize, what: &str) -> Result<u32, Fault> {
        let place = self.place();
        let length = self.u32(what)?;
        let left = self.body.len().saturating_sub(self.at);
        if length as usize > left / element_bytes {
            return Err(Fault::damaged(
                place,
                format!("at most {} elements of {what} in {left} bytes", left / element_bytes),
                length.to_string(),
            ));
        }
        Ok(length)
    }
}

/// Writes a message, little-endian.
pub(crate) struct CdrWriter {
    message: Vec<u8>,
}

impl CdrWriter {
    pub(crate) fn new() -> Self {
        Self { message: vec![0, 1, 0, 0] }
    }

    pub(crate) fn finish(self) -> Vec<u8> {
        self.message
    }

    fn number<const N: usize>(&mut self, bytes: [u8; N]) {
        let padded = (self.message.len() - HEADER_BYTES).next_multiple_of(N) + HEADER_BYTES;
        self.message.resize(padded, 0);
        self.message.extend_from_slice(&bytes);
    }

    pub(crate) fn u8(&mut self, value: u8) {
        self.number([value]);
    }

    pub(crate) fn u32(&mut self, value: u32) {
        self.number(value.to_le_bytes());
    }

    pub(crate) fn i32(&mut self, value: i32) {
        self.number(value.to_le_bytes());
    }

    pub(crate) fn f64(&mut self, value: f64) {
        self.number(value.to_le_bytes());
    }

    pub(crate) fn string(&mut self, value: &str) {
        self.u32(value.len() as u32 + 1);
        self.message.extend_from_slice(value.as_bytes());
        self.message.push(0);
    }

    /// A sequence of `length` bytes, given piece by piece.
    pub(crate) fn bytes<'p>(&mut self, length: usize, pieces: impl Iterator<Item = &'p [u8]>) {
        self.u32(length as u32);
        self.message.reserve(length);
        for piece in pieces {
            self.message.extend_from_slice(piece);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_lie_at_multiples_of_their_size_counted_after_the_header() {
        let mut writer = CdrWriter::new();
        writer.u8(7);
        writer.f64(1.5);
        writer.string("ab");
        writer.u32(9);
        let message = writer.finish();
        assert_eq!(&message[..5], &[0, 1, 0, 0, 7]);
        assert_eq!(&message[12..20], &1.5f64.to_le_bytes());
        assert_eq!(&message[20..27], &[3, 0, 0, 0, b'a', b'b', 0]);
        assert_eq!(&message[28..], &[9, 0, 0, 0]);
        let mut reader = CdrReader::new(&message).unwrap();
        assert_eq!(reader.u8("").unwrap(), 7);
        assert_eq!(reader.f64("").unwrap(), 1.5);
        assert_eq!(reader.string("").unwrap(), "ab");
        assert_eq!(reader.u32("").unwrap(), 9);
        assert!(reader.u8("end").is_err());
    }

    #[test]
    fn big_endian_is_read_and_other_encapsulations_are_named() {
        let mut reader = CdrReader::new(&[0, 0, 0, 0, 0, 0, 1, 2]).unwrap();
        assert_eq!(reader.u32("").unwrap(), 0x0102);
        let Err(fault) = CdrReader::new(&[0, 3, 0, 0]) else { panic!("parameter list accepted") };
        assert!(fault.problem.to_string().contains("00 03"), "{}", fault.problem);
        assert!(CdrReader::new(&[0, 1, 0]).is_err());
    }

    #[test]
    fn a_length_beyond_the_message_is_refused_before_anything_is_held() {
        let mut reader = CdrReader::new(&[0, 1, 0, 0, 255, 255, 255, 127, 1, 2]).unwrap();
        assert!(reader.sequence(1, "points").is_err());
        let mut reader = CdrReader::new(&[0, 1, 0, 0, 255, 255, 255, 127, 1, 2]).unwrap();
        assert!(reader.bytes("points").is_err());
        let mut reader = CdrReader::new(&[0, 1, 0, 0, 255, 255, 255, 127, 1, 2]).unwrap();
        assert!(reader.string("frame").is_err());
    }
}
