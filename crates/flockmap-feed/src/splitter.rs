//! Frames out of a stream of bytes, wherever it is cut.

use crate::FeedError;
use crate::message::LENGTH_BYTES;

/// Finds the frames in a stream of bytes that comes in parts. Holds one frame at most.
#[derive(Clone, Debug)]
pub struct Splitter {
    bytes_max: usize,
    /// Of the frame that comes, or that was handed out last: its length, and what of it has come.
    frame: Vec<u8>,
    is_whole: bool,
}

impl Splitter {
    /// For frames of at most so many bytes behind their length.
    pub const fn new(bytes_max: usize) -> Self {
        Self { bytes_max, frame: Vec::new(), is_whole: false }
    }

    /// Takes bytes from the front of `bytes` up to the end of a frame. Kind and body of that, or `None` where
    /// all was taken and more is needed. Room grows with what comes, not with what a length promises.
    ///
    /// # Errors
    /// [`FeedError::Length`]; nothing that follows can be understood then.
    pub fn next(&mut self, bytes: &mut &[u8]) -> Result<Option<(u8, &[u8])>, FeedError> {
        if core::mem::take(&mut self.is_whole) {
            self.frame.clear();
        }
        self.take(bytes, LENGTH_BYTES);
        let Some(length) = self.frame.first_chunk::<LENGTH_BYTES>() else { return Ok(None) };
        let length = u32::from_le_bytes(*length) as usize;
        if !(1..=self.bytes_max).contains(&length) {
            return Err(FeedError::Length { got: length, min: 1, max: self.bytes_max });
        }
        self.take(bytes, LENGTH_BYTES + length);
        if self.frame.len() < LENGTH_BYTES + length {
            return Ok(None);
        }
        self.is_whole = true;
        Ok(self.frame[LENGTH_BYTES..].split_first().map(|(kind, body)| (*kind, body)))
    }

    /// Takes over bytes until there are so many of the frame.
    fn take(&mut self, bytes: &mut &[u8], upto: usize) {
        let count = upto.saturating_sub(self.frame.len()).min(bytes.len());
        let (taken, rest) = bytes.split_at(count);
        self.frame.extend_from_slice(taken);
        *bytes = rest;
    }
}
