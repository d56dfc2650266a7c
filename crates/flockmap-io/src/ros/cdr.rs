//! CDR, the encoding of ROS 2 messages (OMG DDS-RTPS 10.5, "plain CDR" of XCDR version 1).
//!
//! A message is read as a whole or piece by piece, so that a limit is checked before what follows it is read.
//! An error names its byte. Point data is forwarded without copying.

use byteorder::{BigEndian, LittleEndian};
use cdr_encoding::{CdrDeserializer, Error, to_writer};
use serde::de::Deserialize;
use serde::ser::Serialize;

use super::message::RosMessage;
use crate::error::{Fault, Place};

/// What is in front of little-endian data. Numbers are aligned as counted from behind it.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Reads a message, in either byte order, with the four bytes in front that tell the order. Bytes that follow
/// the message are left alone. A message may borrow from the bytes: `PointCloud2<&[u8]>`.
///
/// # Errors
/// Bytes that are no plain CDR, or end within the message; a string or a list that is too long. The place is
/// the byte of the message where reading stopped.
pub fn decode<'a, T: RosMessage + Deserialize<'a>>(message: &'a [u8]) -> Result<T, Fault> {
    CdrReader::new(message)?.read(T::SCHEMA)
}

/// A message as little-endian CDR with the four bytes in front that tell so. Of a list or a piece of bytes,
/// the length is written as 32 bits.
pub fn encode<T: RosMessage + Serialize>(message: &T) -> Vec<u8> {
    let mut bytes = HEADER.to_vec();
    let written = to_writer::<_, LittleEndian, _>(&mut bytes, message);
    // Numbers, strings, bytes and sequences of known length go into memory without fail.
    debug_assert!(written.is_ok(), "{written:?}");
    bytes
}

/// Reads a message in either byte order.
pub(super) struct CdrReader<'a> {
    order: Order<'a>,
    bytes: usize,
}

enum Order<'a> {
    Little(CdrDeserializer<'a, LittleEndian>),
    Big(CdrDeserializer<'a, BigEndian>),
}

impl<'a> CdrReader<'a> {
    pub(super) fn new(message: &'a [u8]) -> Result<Self, Fault> {
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
    pub(super) fn place(&self) -> Place {
        Place::Byte(self.at() as u64)
    }

    /// Bytes of the message that are not read yet.
    pub(super) fn left(&self) -> usize {
        self.bytes - self.at()
    }

    /// Reads `what` comes next: anything of numbers, strings, bytes (`&[u8]`, not copied) and lists.
    pub(super) fn read<T: Deserialize<'a>>(&mut self, what: &str) -> Result<T, Fault> {
        let read = match &mut self.order {
            Order::Little(cdr) => T::deserialize(cdr),
            Order::Big(cdr) => T::deserialize(cdr),
        };
        read.map_err(|error| {
            let place = self.place();
            match error {
                Error::Eof => Fault::truncated(place, what, format!("{} bytes", self.left())),
                error => refused(place, what, &error.to_string()),
            }
        })
    }
}

/// The fault of a part of `what` that a visitor refused, in serde's words: `invalid FOUND, expected EXPECTED`.
fn refused(place: Place, what: &str, words: &str) -> Fault {
    let (found, expected) = words.split_once(", expected ").unwrap_or((words, "what can be read"));
    let found = found.strip_prefix("invalid ").unwrap_or(found);
    Fault::damaged(place, format!("{expected} in {what}"), found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::{Bytes, Header, KeyValue, PointCloud2};

    /// A message of any value.
    fn message_of(value: &impl Serialize) -> Vec<u8> {
        let mut message = HEADER.to_vec();
        to_writer::<_, LittleEndian, _>(&mut message, value).unwrap();
        message
    }

    fn bytes(bytes: &[u8]) -> Bytes {
        Bytes(bytes.to_vec())
    }

    #[test]
    fn numbers_lie_at_multiples_of_their_size_counted_after_the_header() {
        let message = message_of(&(7u8, 1.5f64, "ab", 9u32, bytes(&[5, 6])));
        assert_eq!(&message[..5], &[0, 1, 0, 0, 7]);
        assert_eq!(&message[12..20], &1.5f64.to_le_bytes());
        assert_eq!(&message[20..27], &[3, 0, 0, 0, b'a', b'b', 0]);
        assert_eq!(&message[28..], &[9, 0, 0, 0, 2, 0, 0, 0, 5, 6]);
        let mut reader = CdrReader::new(&message).unwrap();
        assert_eq!(reader.read::<(u8, f64)>("").unwrap(), (7, 1.5));
        assert_eq!(reader.read::<&[u8]>("").unwrap(), b"ab\0");
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
        assert!(CdrReader::new(&message).unwrap().read::<Bytes>("points").is_err());
        assert!(CdrReader::new(&message).unwrap().read::<KeyValue>("a figure").is_err());
    }

    #[test]
    fn a_string_or_a_list_that_is_too_long_is_told_with_its_length() {
        let header = Header { frame_id: "f".repeat(crate::ros::STRING_BYTES_MAX), ..Header::default() };
        let fault = decode::<Header>(&encode(&header)).unwrap_err();
        let expected = "byte 4113: damaged: expected a string of at most 4096 bytes in std_msgs/msg/Header, \
                        found length 4097";
        assert_eq!(fault.to_string(), expected);
        let cloud = PointCloud2 { fields: vec![Default::default(); 1025], ..PointCloud2::<Bytes>::default() };
        let fault = decode::<PointCloud2<Bytes>>(&encode(&cloud)).unwrap_err().to_string();
        assert!(fault.contains("a list of at most 1024 elements in sensor_msgs/msg/PointCloud2"), "{fault}");
    }

    #[test]
    fn a_string_may_lack_its_closing_zero_and_need_not_be_utf_8() {
        for (of, text) in [(&b""[..], ""), (b"\0", ""), (b"ab", "ab"), (b"a\xff\0", "a\u{fffd}")] {
            let message = message_of(&(bytes(of), bytes(b"/f\0")));
            let read: KeyValue = CdrReader::new(&message).unwrap().read("").unwrap();
            assert_eq!(read, KeyValue { key: text.into(), value: "/f".into() });
            let message = message_of(&(0i32, 0u32, bytes(of)));
            assert_eq!(decode::<Header>(&message).unwrap().frame_id, text);
        }
        let slashed = Header { frame_id: "//map".into(), ..Header::default() };
        assert_eq!(decode::<Header>(&encode(&slashed)).unwrap().frame_id, "/map");
    }
}
