//! Taking numbers off a slice of bytes without ever going past its end.

use crate::error::{Fault, Place};

/// A position in a slice of bytes. `base` is what to add to a position to get the place in the file.
#[derive(Clone, Debug)]
pub(crate) struct Bytes<'a> {
    data: &'a [u8],
    at: usize,
    base: u64,
}

impl<'a> Bytes<'a> {
    pub(crate) const fn new(data: &'a [u8], base: u64) -> Self {
        Self { data, at: 0, base }
    }

    pub(crate) const fn at(&self) -> usize {
        self.at
    }

    pub(crate) const fn place(&self) -> Place {
        Place::Byte(self.base + self.at as u64)
    }

    pub(crate) fn rest(&self) -> &'a [u8] {
        self.data.get(self.at..).unwrap_or_default()
    }

    /// The next `n` bytes, which are `what`.
    pub(crate) fn take(&mut self, n: u64, what: &str) -> Result<&'a [u8], Fault> {
        let rest = self.rest();
        match usize::try_from(n).ok().and_then(|n| rest.get(..n)) {
            Some(taken) => {
                self.at += taken.len();
                Ok(taken)
            }
            None => Err(Fault::truncated(
                self.place(),
                format!("{n} bytes of {what}"),
                format!("{} bytes", rest.len()),
            )),
        }
    }

    pub(crate) fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N], Fault> {
        let taken = self.take(N as u64, what)?;
        let mut array = [0; N];
        array.copy_from_slice(taken);
        Ok(array)
    }

    pub(crate) fn u16(&mut self, what: &str) -> Result<u16, Fault> {
        self.array(what).map(u16::from_le_bytes)
    }

    pub(crate) fn u32(&mut self, what: &str) -> Result<u32, Fault> {
        self.array(what).map(u32::from_le_bytes)
    }

    pub(crate) fn u64(&mut self, what: &str) -> Result<u64, Fault> {
        self.array(what).map(u64::from_le_bytes)
    }

    pub(crate) fn f64(&mut self, what: &str) -> Result<f64, Fault> {
        self.array(what).map(f64::from_le_bytes)
    }
}
