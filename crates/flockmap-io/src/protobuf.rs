//! The few parts of protobuf that are written here, and the descriptions that a file carries of them.
//!
//! Messages for Foxglove and Rerun have a dozen fields between them; a generator of code for those is a hundred
//! times the code here.

/// A message that is being written: proto3, so that numbers that are 0 and texts that are empty are left out.
#[derive(Clone, Debug, Default)]
pub(crate) struct Message(Vec<u8>);

const VARINT: u32 = 0;
const FIXED64: u32 = 1;
const BYTES: u32 = 2;
const FIXED32: u32 = 5;

impl Message {
    pub(crate) fn integer(&mut self, field: u32, value: u64) {
        if value != 0 {
            self.key(field, VARINT);
            self.varint(value);
        }
    }

    pub(crate) fn fixed32(&mut self, field: u32, value: u32) {
        if value != 0 {
            self.key(field, FIXED32);
            self.0.extend_from_slice(&value.to_le_bytes());
        }
    }

    pub(crate) fn double(&mut self, field: u32, value: f64) {
        if value != 0.0 {
            self.key(field, FIXED64);
            self.0.extend_from_slice(&value.to_le_bytes());
        }
    }

    pub(crate) fn text(&mut self, field: u32, value: &str) {
        self.bytes(field, value.as_bytes());
    }

    pub(crate) fn bytes(&mut self, field: u32, value: &[u8]) {
        if !value.is_empty() {
            self.piece(field, value);
        }
    }

    /// A message within this one. It is there even if nothing is in it.
    pub(crate) fn message(&mut self, field: u32, write: impl FnOnce(&mut Self)) {
        let mut inner = Self::default();
        write(&mut inner);
        self.piece(field, &inner.0);
    }

    pub(crate) fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    fn piece(&mut self, field: u32, value: &[u8]) {
        self.key(field, BYTES);
        self.varint(value.len() as u64);
        self.0.extend_from_slice(value);
    }

    fn key(&mut self, field: u32, wire: u32) {
        self.varint((field << 3 | wire).into());
    }

    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }
}

/// The bytes of a field, the last one of that number; `None` where the message is none, or has no such field.
pub(crate) fn bytes_of(message: &[u8], field: u32) -> Option<&[u8]> {
    let (mut rest, mut found) = (message, None);
    while !rest.is_empty() {
        let key = take_varint(&mut rest)?;
        let taken = match key as u32 & 7 {
            VARINT => take_varint(&mut rest).map(|_| None),
            FIXED64 => take(&mut rest, 8).map(|_| None),
            FIXED32 => take(&mut rest, 4).map(|_| None),
            BYTES => take_varint(&mut rest).and_then(|length| take(&mut rest, length)).map(Some),
            _ => None,
        }?;
        if key >> 3 == u64::from(field) {
            found = taken;
        }
    }
    found
}

fn take<'a>(rest: &mut &'a [u8], count: u64) -> Option<&'a [u8]> {
    let (taken, left) = rest.split_at_checked(usize::try_from(count).ok()?)?;
    *rest = left;
    Some(taken)
}

fn take_varint(rest: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for place in 0..10 {
        let (&byte, left) = rest.split_first()?;
        *rest = left;
        value |= u64::from(byte & 0x7f).checked_shl(7 * place)?;
        if byte < 0x80 {
            return Some(value);
        }
    }
    None
}

/// What a field of a message is.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Kind {
    Double,
    Int64,
    Int32,
    Fixed32,
    Text,
    Bytes,
    /// A message of this name, with its package: `.foxglove.Pose`.
    Message(&'static str),
    /// Several of them.
    Messages(&'static str),
    /// A number that stands for one of several names.
    Enum(&'static str),
}

/// A field as a `.proto` file has it: name, number, type.
pub(crate) type Field<'a> = (&'a str, u32, Kind);

/// Messages of one package, as a `.proto` file has them. What a schema of an MCAP file consists of.
#[derive(Clone, Debug, Default)]
pub(crate) struct Schema(Message);

/// A file of messages.
#[derive(Clone, Debug)]
pub(crate) struct ProtoFile(Message);

impl Schema {
    pub(crate) fn file(mut self, file: ProtoFile) -> Self {
        self.0.piece(1, &file.0.0);
        self
    }

    /// A `FileDescriptorSet`.
    pub(crate) fn into_bytes(self) -> Vec<u8> {
        self.0.into_bytes()
    }
}

impl ProtoFile {
    /// `imports` are names of files that stand before it in the schema.
    pub(crate) fn new(name: &str, package: &str, imports: &[&str]) -> Self {
        let mut file = Message::default();
        file.text(1, name);
        file.text(2, package);
        imports.iter().for_each(|import| file.text(3, import));
        file.text(12, "proto3");
        Self(file)
    }

    pub(crate) fn message(self, name: &str, fields: &[Field<'_>]) -> Self {
        self.message_with_enum(name, fields, "", &[])
    }

    /// A message in which an enum is declared: its name, and those of its numbers from 0 on.
    pub(crate) fn message_with_enum(
        mut self,
        name: &str,
        fields: &[Field<'_>],
        enum_name: &str,
        names: &[&str],
    ) -> Self {
        self.0.message(4, |message| {
            message.text(1, name);
            for (name, number, kind) in fields {
                message.message(2, |field| {
                    let (code, of) = kind.code();
                    field.text(1, name);
                    field.integer(3, u64::from(*number));
                    // 1: at most once; 3: any number of times.
                    field.integer(4, if matches!(kind, Kind::Messages(_)) { 3 } else { 1 });
                    field.integer(5, code);
                    field.text(6, of);
                });
            }
            if !names.is_empty() {
                message.message(4, |description| {
                    description.text(1, enum_name);
                    for (number, name) in (0..).zip(names) {
                        description.message(2, |value| {
                            value.text(1, name);
                            value.integer(2, number);
                        });
                    }
                });
            }
        });
        self
    }
}

impl Kind {
    /// The number of the type in a description, and the name of what it is of.
    const fn code(self) -> (u64, &'static str) {
        match self {
            Self::Double => (1, ""),
            Self::Int64 => (3, ""),
            Self::Int32 => (5, ""),
            Self::Fixed32 => (7, ""),
            Self::Text => (9, ""),
            Self::Message(of) | Self::Messages(of) => (11, of),
            Self::Bytes => (12, ""),
            Self::Enum(of) => (14, of),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_has_the_bytes_of_the_protobuf_guide() {
        let mut message = Message::default();
        message.integer(1, 150);
        message.text(2, "testing");
        message.message(3, |inner| inner.integer(1, 150));
        message.double(4, 0.0);
        message.fixed32(5, 1);
        let bytes = message.into_bytes();
        let expected =
            [&[0x08, 0x96, 0x01, 0x12, 7][..], b"testing", &[0x1a, 3, 8, 0x96, 1, 0x2d, 1, 0, 0, 0]];
        assert_eq!(bytes, expected.concat());
        assert_eq!(bytes_of(&bytes, 2), Some(&b"testing"[..]));
        assert_eq!(bytes_of(&bytes, 7), None);
    }

    #[test]
    fn damaged_messages_have_no_fields_and_never_panic() {
        let mut message = Message::default();
        message.integer(1, u64::MAX);
        message.bytes(2, &[7; 300]);
        message.double(3, 1.5);
        let bytes = message.into_bytes();
        for end in 0..bytes.len() {
            let found = bytes_of(&bytes[..end], 2);
            assert!(found.is_none_or(|found| found == [7; 300]), "cut at {end}");
            for byte in [0, 0x7f, 0x80, 0xff] {
                let mut bent = bytes.clone();
                bent[end] = byte;
                let _ = bytes_of(&bent, 2);
            }
        }
        assert_eq!(bytes_of(&[0xff; 32], 1), None);
        assert_eq!(bytes_of(&[0x12, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 1], 2), None);
    }
}
