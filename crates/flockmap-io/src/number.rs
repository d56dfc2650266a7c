//! Numbers as binary formats store them.

/// The type of a stored number.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Number {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Number {
    /// Its size in bytes.
    pub(crate) const fn size(self) -> u64 {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// The number at the start of `bytes`; not a number if they end within it.
    #[inline]
    pub(crate) fn read(self, bytes: &[u8], big_endian: bool) -> f64 {
        macro_rules! read {
            ($number:ty) => {
                bytes.first_chunk().map_or(f64::NAN, |&b| {
                    (if big_endian { <$number>::from_be_bytes(b) } else { <$number>::from_le_bytes(b) })
                        as f64
                })
            };
        }
        match self {
            Self::I8 => read!(i8),
            Self::U8 => read!(u8),
            Self::I16 => read!(i16),
            Self::U16 => read!(u16),
            Self::I32 => read!(i32),
            Self::U32 => read!(u32),
            Self::I64 => read!(i64),
            Self::U64 => read!(u64),
            Self::F32 => read!(f32),
            Self::F64 => read!(f64),
        }
    }
}
