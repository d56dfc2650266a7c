//! Fields of frames: little-endian numbers, texts with a length.

use flockmap_grid::Plane;

use crate::FeedError;

/// Reads the fields of a frame's body, one after the other.
pub(crate) struct Fields<'a> {
    kind: &'static str,
    rest: &'a [u8],
}

impl<'a> Fields<'a> {
    pub(crate) const fn new(kind: &'static str, body: &'a [u8]) -> Self {
        Self { kind, rest: body }
    }

    /// The next so many bytes.
    pub(crate) fn bytes(&mut self, field: &'static str, count: usize) -> Result<&'a [u8], FeedError> {
        let (bytes, rest) =
            self.rest.split_at_checked(count).ok_or(FeedError::Truncated { kind: self.kind, field })?;
        self.rest = rest;
        Ok(bytes)
    }

    fn array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N], FeedError> {
        let fail = FeedError::Truncated { kind: self.kind, field };
        self.bytes(field, N)?.first_chunk().copied().ok_or(fail)
    }

    pub(crate) fn u8(&mut self, field: &'static str) -> Result<u8, FeedError> {
        self.array(field).map(u8::from_le_bytes)
    }

    pub(crate) fn u16(&mut self, field: &'static str) -> Result<u16, FeedError> {
        self.array(field).map(u16::from_le_bytes)
    }

    pub(crate) fn u32(&mut self, field: &'static str) -> Result<u32, FeedError> {
        self.array(field).map(u32::from_le_bytes)
    }

    pub(crate) fn i32(&mut self, field: &'static str) -> Result<i32, FeedError> {
        self.array(field).map(i32::from_le_bytes)
    }

    pub(crate) fn u64(&mut self, field: &'static str) -> Result<u64, FeedError> {
        self.array(field).map(u64::from_le_bytes)
    }

    pub(crate) fn i64(&mut self, field: &'static str) -> Result<i64, FeedError> {
        self.array(field).map(i64::from_le_bytes)
    }

    pub(crate) fn f64(&mut self, field: &'static str) -> Result<f64, FeedError> {
        self.array(field).map(f64::from_le_bytes)
    }

    pub(crate) fn f32(&mut self, field: &'static str) -> Result<f32, FeedError> {
        self.array(field).map(f32::from_le_bytes)
    }

    /// Numbers each of which must be finite.
    pub(crate) fn finite<const N: usize>(&mut self, field: &'static str) -> Result<[f64; N], FeedError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.f64(field)?;
            if !number.is_finite() {
                let (kind, got) = (self.kind, number.to_bits());
                return Err(FeedError::Field { kind, field, got, expected: "finite numbers" });
            }
        }
        Ok(numbers)
    }

    pub(crate) fn plane(&mut self, field: &'static str) -> Result<Plane, FeedError> {
        let mut plane = [0; 8];
        for word in &mut plane {
            *word = self.u64(field)?;
        }
        Ok(plane)
    }

    /// A text behind a byte with its length.
    pub(crate) fn text(&mut self, field: &'static str) -> Result<String, FeedError> {
        let length = self.u8(field)?;
        let bytes = self.bytes(field, length.into())?;
        self.utf8(field, bytes)
    }

    /// A text that reaches to the end.
    pub(crate) fn text_to_end(&mut self, field: &'static str) -> Result<String, FeedError> {
        let bytes = core::mem::take(&mut self.rest);
        self.utf8(field, bytes)
    }

    fn utf8(&self, field: &'static str, bytes: &[u8]) -> Result<String, FeedError> {
        let text = core::str::from_utf8(bytes).map_err(|_| FeedError::Text { kind: self.kind, field })?;
        Ok(text.to_owned())
    }

    /// A count of things that take so many bytes each at least: never more than can be there.
    pub(crate) fn check_count(
        &self,
        field: &'static str,
        count: usize,
        bytes_each: usize,
    ) -> Result<usize, FeedError> {
        let is_there = count <= self.rest.len() / bytes_each;
        is_there.then_some(count).ok_or(FeedError::Truncated { kind: self.kind, field })
    }
}

/// Writes a text behind a byte with its length; what is longer than 255 bytes is cut between two characters.
pub(crate) fn put_text(bytes: &mut Vec<u8>, text: &str) {
    let text = &text[..text.floor_char_boundary(255)];
    bytes.push(text.len() as u8);
    bytes.extend_from_slice(text.as_bytes());
}

pub(crate) fn put_plane(bytes: &mut Vec<u8>, plane: &Plane) {
    plane.iter().for_each(|word| bytes.extend_from_slice(&word.to_le_bytes()));
}
