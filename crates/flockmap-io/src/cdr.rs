//! CDR, the encoding of ROS 2 messages (OMG DDS-RTPS 10.5, "plain CDR" of XCDR version 1).
//!
//! A message is read piece by piece, so that each limit is checked before what follows it is read, and an
//! error names its byte. Point data is forwarded without copying.

use byteorder::{BigEndian, LittleEndian};
use cdr_encoding::{CdrDeserializer, to_writer};
use serde::de::Deserialize;
use serde::ser::{Serialize, Serializer};

use crate::error::{Fault, Place};

/// Longest string taken from a message: names of frames and fields.
const STRING_BYTES_MAX: usize = 4096;
/// What is in front of little-endian data. Numbers are aligned as counted from behind it.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Reads a message in either byte order.
pub(crate) struct CdrReader<'a> {
    order: Order<'a>,
    bytes: usize,
}

enum Order<'a> {
    Little(CdrDeserializer<'a, LittleEndian>),
    Big(CdrDeserializer<'a, BigEndian>),
}

impl<'a> CdrReader<'a> {
    pub(crate) fn new(message: &'a [u8]) -> Result<Self, Fault> {
        let order = match message {
            [0, 0, _, _, body @ ..] => Order::Big(CdrDeserializer::new(body)),
            [0, 1, _, _, body @ ..] => Order::Little(CdrDeserializer::new(body)),
            [a, b, _, _, ..] => {
                let expected = "plain CDR (first bytes 00 00 or 00 01)";
                return Err(Fault::foreign(Place::Byte(0), expected, format!("{a:02x} {b:02x}")));
            }
            _ => {
                let expected = "4 bytes in front of the CDR data";
                return Err(Fault::truncated(Place::Byte(0), expected, format!("{} bytes", message.len())));
            }
        };
        Ok(Self { order, bytes: message.len() })
    }

    fn at(&self) -> usize {
        let read = match &self.order {
            Order::Little(cdr) => cdr.bytes_consumed(),
            Order::Big(cdr) => cdr.bytes_consumed(),
        };
        HEADER.len() + read
    }

    /// The place of the next byte in the message.
    pub(crate) fn place(&self) -> Place {
        Place::Byte(self.at() as u64)
    }

    /// Bytes of the message that are not read yet.
    pub(crate) fn left(&self) -> usize {
        self.bytes - self.at()
    }

    /// Reads `what` comes next: numbers, bytes (`&[u8]`, not copied), and tuples and arrays of these.
    pub(crate) fn read<T: Deserialize<'a>>(&mut self, what: &str) -> Result<T, Fault> {
        let read = match &mut self.order {
            Order::Little(cdr) => T::deserialize(cdr),
            Order::Big(cdr) => T::deserialize(cdr),
        };
        // Of these types nothing else can go wrong.
        read.map_err(|_| Fault::truncated(self.place(), what, format!("{} bytes", self.left())))
    }

    pub(crate) fn string(&mut self, what: &str) -> Result<String, Fault> {
        let place = self.place();
        let bytes: &[u8] = self.read(what)?;
        if bytes.len() > STRING_BYTES_MAX {
            let expected = format!("{what} of at most {STRING_BYTES_MAX} bytes");
            return Err(Fault::damaged(place, expected, format!("{} bytes", bytes.len())));
        }
        // The closing zero counts; some writers leave it out of an empty string.
        let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        Ok(String::from_utf8_lossy(text).into_owned())
    }
}

/// A message of one value, little-endian; `bytes` is about how long it gets.
pub(crate) fn encode(value: &impl Serialize, bytes: usize) -> Vec<u8> {
    let mut message = Vec::with_capacity(HEADER.len() + bytes);
    message.extend(HEADER);
    let written = to_writer::<_, LittleEndian, _>(&mut message, value);
    // Numbers, strings, bytes and sequences of known length go into memory without fail.
    debug_assert!(written.is_ok(), "{written:?}");
    message
}

/// A sequence of bytes to be written as one piece.
pub(crate) struct Octets<'a>(pub(crate) &'a [u8]);

impl Serialize for Octets<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_lie_at_multiples_of_their_size_counted_after_the_header() {
        let message = encode(&(7u8, 1.5f64, "ab", 9u32, Octets(&[5, 6])), 0);
        assert_eq!(&message[..5], &[0, 1, 0, 0, 7]);
        assert_eq!(&message[12..20], &1.5f64.to_le_bytes());
        assert_eq!(&message[20..27], &[3, 0, 0, 0, b'a', b'b', 0]);
        assert_eq!(&message[28..], &[9, 0, 0, 0, 2, 0, 0, 0, 5, 6]);
        let mut reader = CdrReader::new(&message).unwrap();
        assert_eq!(reader.read::<(u8, f64)>("").unwrap(), (7, 1.5));
        assert_eq!(reader.string("").unwrap(), "ab");
        assert_eq!(reader.read::<(u32, &[u8])>("").unwrap(), (9, [5, 6].as_slice()));
        let fault = reader.read::<u8>("the end").unwrap_err();
        assert_eq!(fault, Fault::truncated(Place::Byte(38), "the end", "0 bytes"));
    }

    #[test]
    fn big_endian_is_read_and_other_encapsulations_are_named() {
        let mut reader = CdrReader::new(&[0, 0, 0, 0, 0, 0, 1, 2]).unwrap();
        assert_eq!(reader.read::<u32>("").unwrap(), 0x0102);
        let Err(fault) = CdrReader::new(&[0, 3, 0, 0]) else { panic!("parameter list accepted") };
        assert!(fault.problem.to_string().contains("00 03"), "{}", fault.problem);
        assert!(CdrReader::new(&[0, 1, 0]).is_err());
    }

    #[test]
    fn a_length_beyond_the_message_is_refused_before_anything_is_held() {
        let message = [0, 1, 0, 0, 255, 255, 255, 127, 1, 2];
        assert!(CdrReader::new(&message).unwrap().read::<&[u8]>("points").is_err());
        assert!(CdrReader::new(&message).unwrap().string("frame").is_err());
        let long = encode(&"f".repeat(STRING_BYTES_MAX), 0);
        let fault = CdrReader::new(&long).unwrap().string("the frame").unwrap_err();
        assert!(fault.problem.to_string().contains("at most 4096 bytes, found 4097"), "{}", fault.problem);
    }

    #[test]
    fn a_string_may_lack_its_closing_zero_and_need_not_be_utf_8() {
        for (bytes, text) in [(&b""[..], ""), (b"\0", ""), (b"ab", "ab"), (b"a\xff\0", "a\u{fffd}")] {
            let message = encode(&Octets(bytes), 0);
            assert_eq!(CdrReader::new(&message).unwrap().string("").unwrap(), text);
        }
    }
}
