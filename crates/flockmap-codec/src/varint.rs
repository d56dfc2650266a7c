//! Whole numbers in as few bytes as they need: LEB128, and zigzag for signed ones.

use crate::PackageError;

/// Appends `value`, seven bits a byte, lowest first; every byte but the last has its top bit set.
pub(crate) fn write(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// How many bytes a number takes.
pub(crate) fn length(value: u64) -> usize {
    (64 - value.leading_zeros()).div_ceil(7).max(1) as usize
}

/// Appends a signed value as 0, −1, 1, −2, … → 0, 1, 2, 3, …
pub(crate) fn write_signed(out: &mut Vec<u8>, value: i64) {
    write(out, ((value << 1) ^ (value >> 63)) as u64);
}

/// Reads bytes from the front and knows where it is, for errors.
pub(crate) struct Reader<'a> {
    bytes: &'a [u8],
    offset: usize,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, offset: 0 }
    }

    /// Bytes read so far.
    pub(crate) fn offset(&self) -> usize {
        self.offset
    }

    /// What has not been read.
    pub(crate) fn rest(&self) -> &'a [u8] {
        self.bytes.get(self.offset..).unwrap_or_default()
    }

    pub(crate) fn byte(&mut self, field: &'static str) -> Result<u8, PackageError> {
        let byte = self.rest().first().ok_or(PackageError::Truncated { field, offset: self.offset })?;
        self.offset += 1;
        Ok(*byte)
    }

    pub(crate) fn u32_le(&mut self, field: &'static str) -> Result<u32, PackageError> {
        let bytes =
            self.rest().first_chunk::<4>().ok_or(PackageError::Truncated { field, offset: self.offset })?;
        self.offset += 4;
        Ok(u32::from_le_bytes(*bytes))
    }

    /// A number of at most `max`. There is one way to write each number: needless zero bytes are an error.
    pub(crate) fn number(&mut self, field: &'static str, max: u64) -> Result<u64, PackageError> {
        let offset = self.offset;
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.byte(field)?;
            let bits = u64::from(byte & 0x7f);
            if bits << shift >> shift != bits {
                break;
            }
            value |= bits << shift;
            if byte & 0x80 == 0 {
                if (byte == 0 && shift > 0) || value > max {
                    break;
                }
                return Ok(value);
            }
        }
        Err(PackageError::Number { field, offset, max })
    }

    /// A signed number in zigzag form.
    pub(crate) fn signed(&mut self, field: &'static str) -> Result<i64, PackageError> {
        let value = self.number(field, u64::MAX)?;
        Ok((value >> 1) as i64 ^ -((value & 1) as i64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_comes_back_and_has_one_form() {
        let edges = (0..64).flat_map(|bit| [(1u64 << bit) - 1, 1 << bit, (1 << bit) + 1]).chain([u64::MAX]);
        for value in edges {
            let mut bytes = Vec::new();
            write(&mut bytes, value);
            let mut reader = Reader::new(&bytes);
            assert_eq!(reader.number("n", u64::MAX).unwrap(), value);
            assert!(reader.rest().is_empty());
            assert!(value == 0 || Reader::new(&bytes).number("n", value - 1).is_err());
            let signed = value as i64;
            let mut bytes = Vec::new();
            write_signed(&mut bytes, signed);
            assert_eq!(Reader::new(&bytes).signed("n").unwrap(), signed);
        }
        for bad in [&[0x80, 0x00][..], &[0xff; 10], &[0x80; 9], &[]] {
            assert!(Reader::new(bad).number("n", u64::MAX).is_err(), "{bad:?}");
        }
    }
}
