//! Reading and writing bytes: little-endian integers, and whole numbers in as few bytes as they need (LEB128,
//! zigzag for signed ones).
//!
//! One reader and writer for packages, for the datagrams that carry them, and for the messages that they are
//! measured against. Nothing here panics, whatever the bytes.

/// Reads from the front. Every read is `None` once too few bytes are left.
#[derive(Clone, Copy, Debug)]
pub struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    /// A reader of all of `bytes`.
    pub const fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    /// Whether all has been read.
    pub const fn is_empty(&self) -> bool {
        self.rest.is_empty()
    }

    /// What has not been read.
    pub const fn rest(&self) -> &'a [u8] {
        self.rest
    }

    /// So many bytes.
    pub fn bytes(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.rest.split_at_checked(count)?;
        self.rest = rest;
        Some(taken)
    }

    /// As many bytes as the array has.
    pub fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (taken, rest) = self.rest.split_first_chunk()?;
        self.rest = rest;
        Some(*taken)
    }

    /// One byte.
    pub fn u8(&mut self) -> Option<u8> {
        self.array().map(|[byte]| byte)
    }

    /// Two bytes, the lowest first.
    pub fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    /// Four bytes, the lowest first.
    pub fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    /// Eight bytes, the lowest first.
    pub fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    /// Eight bytes, the lowest first, in two's complement.
    pub fn i64(&mut self) -> Option<i64> {
        self.array().map(i64::from_le_bytes)
    }

    /// What [`put_varint`] wrote. Only the shortest form is taken, so that equal numbers are equal bytes.
    pub fn varint(&mut self) -> Option<u64> {
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.u8()?;
            let part = u64::from(byte & 0x7f);
            if part << shift >> shift != part || (byte == 0 && shift > 0) {
                return None;
            }
            value |= part << shift;
            if byte & 0x80 == 0 {
                return Some(value);
            }
        }
        None
    }

    /// A varint of at most 32 bits.
    pub fn varint_u32(&mut self) -> Option<u32> {
        self.varint()?.try_into().ok()
    }

    /// A varint of at most 16 bits.
    pub fn varint_u16(&mut self) -> Option<u16> {
        self.varint()?.try_into().ok()
    }

    /// What [`put_zigzag`] wrote.
    pub fn zigzag(&mut self) -> Option<i64> {
        self.varint().map(of_zigzag)
    }
}

/// Most bytes of a varint.
pub(crate) const VARINT_BYTES_MAX: usize = 10;

/// Appends a number, seven bits a byte, lowest first; every byte but the last has its highest bit set.
pub fn put_varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// How many bytes [`put_varint`] writes.
pub const fn varint_len(value: u64) -> usize {
    (64 - (value | 1).leading_zeros() as usize).div_ceil(7)
}

/// Appends a signed number as a varint: 0, −1, 1, −2 … as 0, 1, 2, 3 …
pub fn put_zigzag(out: &mut Vec<u8>, value: i64) {
    put_varint(out, ((value << 1) ^ (value >> 63)) as u64);
}

/// From 0, 1, 2, 3 … back to 0, −1, 1, −2 …
pub(crate) const fn of_zigzag(value: u64) -> i64 {
    (value >> 1) as i64 ^ -((value & 1) as i64)
}

/// Most that each of three numbers in one varint can be.
pub(crate) const THREE_MAX: u32 = (1 << 21) - 1;

/// Appends three numbers, [`THREE_MAX`] at most, as one varint: bit by bit in turns, so that numbers alike in size
/// take as few bytes as together they need.
pub(crate) fn put_three(out: &mut Vec<u8>, numbers: [u32; 3]) {
    let bit = |at: usize| u64::from(numbers[at % 3] >> (at / 3) & 1) << at;
    put_varint(out, (0..63).map(bit).sum());
}

/// The three numbers in a varint, which has 63 bits.
pub(crate) fn of_three(value: u64) -> [u32; 3] {
    core::array::from_fn(|axis| (0..21).map(|at| ((value >> (3 * at + axis) & 1) as u32) << at).sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn numbers_come_back(value: u64, shift in 0..64u32, signed: i64) {
            let (value, signed) = (value >> shift, signed >> shift);
            let mut out = Vec::new();
            put_varint(&mut out, value);
            prop_assert_eq!(out.len(), varint_len(value));
            prop_assert!(out.len() <= VARINT_BYTES_MAX);
            put_zigzag(&mut out, signed);
            let mut reader = Reader::new(&out);
            prop_assert_eq!(reader.varint(), Some(value));
            prop_assert_eq!(reader.zigzag(), Some(signed));
            prop_assert!(reader.is_empty());
        }

        #[test]
        fn three_numbers_come_back_and_take_no_more_than_the_largest_asks_for(
            numbers in prop::array::uniform3(0..=THREE_MAX),
            shift in 0..21u32,
        ) {
            let numbers = numbers.map(|number| number >> shift);
            let mut out = Vec::new();
            put_three(&mut out, numbers);
            prop_assert_eq!(Reader::new(&out).varint().map(of_three), Some(numbers));
            let bits = numbers.map(|number| 32 - number.leading_zeros()).into_iter().max().unwrap_or(0);
            prop_assert!(out.len() <= (3 * bits as usize).div_ceil(7).max(1));
        }

        #[test]
        fn a_varint_has_one_form(bytes in prop::collection::vec(any::<u8>(), 0..12)) {
            if let Some(value) = Reader::new(&bytes).varint() {
                let mut out = Vec::new();
                put_varint(&mut out, value);
                prop_assert_eq!(&out[..], &bytes[..out.len()]);
            }
        }
    }

    #[test]
    fn the_ends_of_the_range_come_back_and_no_other_form_does() {
        for value in (0..64).flat_map(|bit| [(1u64 << bit) - 1, 1 << bit, (1 << bit) + 1]).chain([u64::MAX]) {
            let mut out = Vec::new();
            put_varint(&mut out, value);
            put_zigzag(&mut out, value as i64);
            let mut reader = Reader::new(&out);
            assert_eq!((reader.varint(), reader.zigzag()), (Some(value), Some(value as i64)));
        }
        for bad in [&[0x80, 0x00][..], &[0xff; 10], &[0x80; 9], &[]] {
            assert_eq!(Reader::new(bad).varint(), None, "{bad:?}");
        }
    }
}
