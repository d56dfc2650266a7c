//! Reads the fields of a package, with errors that name them.

use crate::bytes::{Reader, VARINT_BYTES_MAX, of_zigzag};
use crate::error::PackageError;

/// A [`Reader`] that knows where it is.
pub(crate) struct Fields<'a> {
    reader: Reader<'a>,
    length: usize,
}

impl<'a> Fields<'a> {
    pub(crate) const fn new(bytes: &'a [u8]) -> Self {
        Self { reader: Reader::new(bytes), length: bytes.len() }
    }

    /// Bytes read so far.
    pub(crate) const fn offset(&self) -> usize {
        self.length - self.reader.rest().len()
    }

    /// What has not been read.
    pub(crate) const fn rest(&self) -> &'a [u8] {
        self.reader.rest()
    }

    pub(crate) fn byte(&mut self, field: &'static str) -> Result<u8, PackageError> {
        self.reader.u8().ok_or_else(|| PackageError::Truncated { field, offset: self.offset() })
    }

    pub(crate) fn u32_le(&mut self, field: &'static str) -> Result<u32, PackageError> {
        self.reader.u32().ok_or_else(|| PackageError::Truncated { field, offset: self.offset() })
    }

    /// A number of at most `max` in its shortest form.
    pub(crate) fn number(&mut self, field: &'static str, max: u64) -> Result<u64, PackageError> {
        let (offset, rest) = (self.offset(), self.rest());
        match self.reader.varint() {
            Some(value) if value <= max => Ok(value),
            None if rest.len() < VARINT_BYTES_MAX && rest.iter().all(|byte| byte & 0x80 != 0) => {
                Err(PackageError::Truncated { field, offset: self.length })
            }
            _ => Err(PackageError::Number { field, offset, max }),
        }
    }

    /// A signed number in zigzag form.
    pub(crate) fn signed(&mut self, field: &'static str) -> Result<i64, PackageError> {
        self.number(field, u64::MAX).map(of_zigzag)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_says_whether_the_bytes_end_or_are_no_such_number() {
        let number = |bytes: &[u8], max| Fields::new(bytes).number("n", max);
        let wrong = |max| Err(PackageError::Number { field: "n", offset: 0, max });
        let ends = |offset| Err(PackageError::Truncated { field: "n", offset });
        assert_eq!(number(&[0x80, 0x01], 128), Ok(128));
        assert_eq!(number(&[0x80, 0x01], 127), wrong(127));
        assert_eq!(number(&[], 127), ends(0));
        assert_eq!(number(&[0x80; 9], 127), ends(9));
        for bad in [&[0x80, 0x00][..], &[0xff; 10], &[0x80; 10], &[0x80; 12]] {
            assert_eq!(number(bad, u64::MAX), wrong(u64::MAX), "{bad:?}");
        }
    }
}
