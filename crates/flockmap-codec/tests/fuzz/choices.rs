//! Input of the fuzzer as a row of choices.

/// Reads choices from bytes; after the last byte every choice is 0. Each takes whole bytes, so that a changed
/// byte changes one choice.
pub(crate) struct Choices<'a>(&'a [u8]);

impl<'a> Choices<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(crate) fn byte(&mut self) -> u8 {
        let Some((first, rest)) = self.0.split_first() else { return 0 };
        self.0 = rest;
        *first
    }

    /// A number from 0 to `end`, which is left out.
    pub(crate) fn below(&mut self, end: u32) -> u32 {
        let number = if end <= 256 { self.byte().into() } else { self.word() };
        number % end
    }

    pub(crate) fn word(&mut self) -> u32 {
        u32::from_le_bytes(core::array::from_fn(|_| self.byte()))
    }
}
