//! How strings, flags and pieces of bytes lie in a message.

use core::fmt;

use serde::de::{Deserialize, Deserializer, Error, SeqAccess, Visitor};
use serde::ser::{Serialize, Serializer};

/// Longest string that is read from a message, in bytes, with its closing zero.
pub const STRING_BYTES_MAX: usize = 4096;
/// Most elements of a list whose elements take more memory than bytes in the message.
const FEW_MAX: usize = 1024;

/// Bytes that a message owns, read and written as one piece.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Bytes(pub Vec<u8>);

impl AsRef<[u8]> for Bytes {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

impl From<Vec<u8>> for Bytes {
    fn from(bytes: Vec<u8>) -> Self {
        Self(bytes)
    }
}

impl Serialize for Bytes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(&self.0)
    }
}

impl<'de> Deserialize<'de> for Bytes {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Owned;

        impl Visitor<'_> for Owned {
            type Value = Bytes;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("bytes")
            }

            fn visit_byte_buf<E: Error>(self, bytes: Vec<u8>) -> Result<Bytes, E> {
                Ok(Bytes(bytes))
            }

            fn visit_bytes<E: Error>(self, bytes: &[u8]) -> Result<Bytes, E> {
                Ok(Bytes(bytes.to_vec()))
            }
        }

        deserializer.deserialize_byte_buf(Owned)
    }
}

/// Any bytes, written as one piece: serde would write a slice number by number.
pub(super) fn one_piece<S: Serializer>(bytes: &impl AsRef<[u8]>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_bytes(bytes.as_ref())
}

/// `int8[]` as one piece of bytes.
pub(super) mod signed {
    use super::{Bytes, Deserialize, Deserializer, Serializer};

    pub(in super::super) fn serialize<S: Serializer>(
        values: &[i8],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        let bytes: Vec<u8> = values.iter().map(|value| value.cast_unsigned()).collect();
        serializer.serialize_bytes(&bytes)
    }

    pub(in super::super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Vec<i8>, D::Error> {
        // From one vector into the other without another piece of memory.
        Ok(Bytes::deserialize(deserializer)?.0.into_iter().map(u8::cast_signed).collect())
    }
}

/// Text as writers of ROS 2 send it, and not only as they should.
pub(super) mod text {
    use core::fmt;

    use super::{Deserializer, Error, STRING_BYTES_MAX, Serializer, Visitor};

    pub(in super::super) fn serialize<S: Serializer>(text: &str, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(text)
    }

    pub(in super::super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<String, D::Error> {
        // A decoder's own strings would refuse what is no UTF-8.
        deserializer.deserialize_bytes(Text)
    }

    struct Text;

    impl Visitor<'_> for Text {
        type Value = String;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            write!(f, "a string of at most {STRING_BYTES_MAX} bytes")
        }

        fn visit_bytes<E: Error>(self, bytes: &[u8]) -> Result<String, E> {
            if bytes.len() > STRING_BYTES_MAX {
                return Err(E::invalid_length(bytes.len(), &self));
            }
            // The closing zero counts; some writers leave it out of an empty string.
            let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
            Ok(String::from_utf8_lossy(text).into_owned())
        }
    }
}

/// The name of a frame: the same with and without the slash in front that ROS 1 used to put there.
pub(super) mod frame {
    pub(in super::super) use super::text::serialize;
    use super::{Deserializer, text};

    pub(in super::super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<String, D::Error> {
        let name = text::deserialize(deserializer)?;
        Ok(name.strip_prefix('/').map(str::to_owned).unwrap_or(name))
    }
}

/// A flag: any byte but 0 says yes.
pub(super) mod flag {
    use super::{Deserialize, Deserializer, Serializer};

    pub(in super::super) fn serialize<S: Serializer>(flag: &bool, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bool(*flag)
    }

    pub(in super::super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<bool, D::Error> {
        Ok(u8::deserialize(deserializer)? != 0)
    }
}

/// Reads a list of at most 1,024 elements.
pub(super) fn few<'de, T: Deserialize<'de>, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Vec<T>, D::Error> {
    struct Few<T>(Vec<T>);

    impl<'de, T: Deserialize<'de>> Visitor<'de> for Few<T> {
        type Value = Vec<T>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            write!(f, "a list of at most {FEW_MAX} elements")
        }

        fn visit_seq<A: SeqAccess<'de>>(mut self, mut list: A) -> Result<Vec<T>, A::Error> {
            while let Some(element) = list.next_element()? {
                if self.0.len() == FEW_MAX {
                    return Err(A::Error::invalid_length(FEW_MAX + 1, &self));
                }
                self.0.push(element);
            }
            Ok(self.0)
        }
    }

    deserializer.deserialize_seq(Few(Vec::new()))
}
