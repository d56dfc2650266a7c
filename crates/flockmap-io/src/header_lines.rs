//! Text headers in front of data: the lines of one, counted.

use crate::error::{Fault, Place, excerpt};

/// Longest header.
const HEADER_BYTES_MAX: usize = 64 * 1024;

/// Goes through the first 64 KiB of a file line by line.
pub(crate) struct HeaderLines<'a> {
    bytes: &'a [u8],
    at: usize,
    line: u64,
}

impl<'a> HeaderLines<'a> {
    pub(crate) const fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0, line: 0 }
    }

    /// The next line without its end. `header` is what has to follow where there is none.
    pub(crate) fn next(&mut self, header: &str) -> Result<&'a [u8], Fault> {
        self.line += 1;
        let rest = self.rest();
        let window = rest.get(..HEADER_BYTES_MAX.saturating_sub(self.at)).unwrap_or(rest);
        let Some(end) = window.iter().position(|&b| b == b'\n') else {
            let fault = if self.line == 1 { Fault::foreign } else { Fault::truncated };
            return Err(fault(self.place(), header, excerpt(window)));
        };
        self.at += end + 1;
        Ok(window.get(..end).unwrap_or_default())
    }

    /// The line that was returned last.
    pub(crate) const fn place(&self) -> Place {
        Place::Line(self.line)
    }

    /// Number of the line that was returned last, from 1.
    pub(crate) const fn line(&self) -> u64 {
        self.line
    }

    /// Where the next line begins.
    pub(crate) const fn at(&self) -> usize {
        self.at
    }

    /// All that follows the lines returned so far.
    pub(crate) fn rest(&self) -> &'a [u8] {
        self.bytes.get(self.at..).unwrap_or_default()
    }
}
