//! A binary arithmetic coder: 64-bit range with carry, probabilities of 16 bits, and of 32 where that is too
//! coarse.
//!
//! The writer keeps an interval of numbers, `low` and `range`. Each bit takes a share of it that is as large
//! as the bit is likely; when the range falls below 2³², the four leading bytes go out. Integers only, so
//! that every machine agrees.
//!
//! ```
//! use flockmap_coder::{BitReader, BitWriter, CodeBit};
//!
//! let bits = [true, true, false, true, true, true, true];
//! let mut bytes = Vec::new();
//! let (mut writer, mut probability) = (BitWriter::new(&mut bytes), 1 << 15);
//! bits.iter().for_each(|bit| {
//!     writer.code(&mut probability, *bit, 4);
//! });
//! writer.finish();
//! let (mut reader, mut probability) = (BitReader::new(&bytes), 1 << 15);
//! assert!(bits.iter().all(|bit| reader.code(&mut probability, false, 4) == *bit));
//! ```
#![forbid(unsafe_code)]

/// How likely a bit is set, in 65,536ths: 1 … 65,535.
pub type Probability = u16;

const REFILL_BELOW: u64 = 1 << 32;

/// Moves a probability towards what has happened, by one in 2ʳᵃᵗᵉ. It stays in 1 … 65,535.
#[inline(always)]
fn learn(probability: &mut Probability, bit: bool, rate: u32) {
    if bit {
        *probability += (65_535 - *probability) >> rate;
    } else {
        *probability -= *probability >> rate;
    }
    debug_assert!(*probability > 0);
}

/// A direction in which bits go: to bytes or from bytes.
pub trait CodeBit {
    /// Whether it looks at `truth`: it writes.
    const KNOWS: bool;

    /// Passes a bit, which is set with this probability; the probability learns by one in 2ʳᵃᵗᵉ.
    #[inline(always)]
    fn code(&mut self, probability: &mut Probability, truth: bool, rate: u32) -> bool {
        self.code_as(*probability, probability, truth, rate)
    }

    /// The same, where the bit is set with another probability than the one that learns.
    fn code_as(&mut self, likely: Probability, learns: &mut Probability, truth: bool, rate: u32) -> bool;

    /// The same direction.
    type Own<'b>: CodeBit
    where
        Self: 'b;

    /// Lets many bits pass in a variable of their own, which can stay in registers.
    fn in_registers<R>(&mut self, pass: impl FnOnce(&mut Self::Own<'_>) -> R) -> R;
}

/// The same for probabilities of 32 bits: one change among 100 million voxels is too unlikely for 16.
pub trait FineBits {
    /// A bit that is set with this probability, in 2⁻³²: 1 … 2³² − 1. A reader does not look at `truth`.
    /// Returns the bit.
    fn bit(&mut self, probability: u32, truth: bool) -> bool;
}

/// Appends bits to some bytes.
#[derive(Debug)]
pub struct BitWriter<'a> {
    low: u64,
    range: u64,
    out: &'a mut Vec<u8>,
    start: usize,
}

impl<'a> BitWriter<'a> {
    /// Appends to these bytes.
    pub fn new(out: &'a mut Vec<u8>) -> Self {
        Self { low: 0, range: u64::MAX, start: out.len(), out }
    }

    /// Writes a bit that is set with this probability.
    #[inline(always)]
    pub fn put(&mut self, probability: Probability, bit: bool) {
        self.take((self.range >> 16) * u64::from(probability), bit);
    }

    /// `share` of the range is for a bit that is set; something is left for either.
    #[inline(always)]
    fn take(&mut self, share: u64, bit: bool) {
        if bit {
            self.range = share;
        } else {
            let (low, carry) = self.low.overflowing_add(share);
            if carry {
                add_one(self.out, self.start);
            }
            self.low = low;
            self.range -= share;
        }
        if self.range < REFILL_BELOW {
            put_four(self.out, (self.low >> 32) as u32);
            self.low <<= 32;
            self.range <<= 32;
        }
    }

    /// Where the writer stands.
    pub fn mark(&self) -> Mark {
        Mark { low: self.low, range: self.range, length: self.out.len(), last: self.out.last().copied() }
    }

    /// Takes back what was written after a mark, the newest.
    pub fn back_to(&mut self, mark: &Mark) {
        self.out.truncate(mark.length);
        (self.low, self.range) = (mark.low, mark.range);
        // A carry changes the last byte, and only one can have come so far.
        if self.out.last().copied() != mark.last {
            for byte in self.out.get_mut(self.start..).unwrap_or_default().iter_mut().rev() {
                let borrows = *byte == 0;
                *byte = byte.wrapping_sub(1);
                if !borrows {
                    break;
                }
            }
        }
    }

    /// The last bytes: a number in the interval with as few as possible, and how many. What a reader finds
    /// beyond the end is zeros.
    fn end(&self) -> (u128, usize) {
        let (low, end) = (u128::from(self.low), u128::from(self.low) + u128::from(self.range));
        let mut numbers = (0..=8usize).map(|length| {
            // The first number in the interval whose bytes after these are zeros, if there is one.
            let unit = 1u128 << (64 - 8 * length);
            ((low + (unit - 1)) & !(unit - 1), length)
        });
        numbers.find(|(number, _)| *number < end).unwrap_or((low, 8))
    }

    /// At most so many bytes if it were finished now, what stood before included.
    pub fn finished_len(&self) -> usize {
        self.out.len() + self.end().1
    }

    /// The last bytes. As few as name the interval: what a reader finds beyond the end is zeros.
    pub fn finish(self) {
        let (number, length) = self.end();
        if number >> 64 != 0 {
            add_one(self.out, self.start);
        }
        self.out.extend_from_slice((number as u64).to_be_bytes().get(..length).unwrap_or_default());
        while self.out.len() > self.start && self.out.last() == Some(&0) {
            self.out.pop();
        }
    }
}

impl CodeBit for BitWriter<'_> {
    const KNOWS: bool = true;

    #[inline(always)]
    fn code_as(&mut self, likely: Probability, learns: &mut Probability, truth: bool, rate: u32) -> bool {
        let share = (self.range >> 16) * u64::from(likely);
        // Two branches, as in reading.
        if truth {
            learn(learns, true, rate);
            self.take(share, true);
        } else {
            learn(learns, false, rate);
            self.take(share, false);
        }
        truth
    }

    type Own<'b>
        = BitWriter<'b>
    where
        Self: 'b;

    #[inline(always)]
    fn in_registers<R>(&mut self, pass: impl FnOnce(&mut BitWriter<'_>) -> R) -> R {
        let mut own = BitWriter { low: self.low, range: self.range, out: self.out, start: self.start };
        let result = pass(&mut own);
        (self.low, self.range) = (own.low, own.range);
        result
    }
}

/// Carries into the bytes that are out. They never overflow: the number that they make is below 1.
#[cold]
#[inline(never)]
fn add_one(out: &mut [u8], start: usize) {
    for byte in out.get_mut(start..).unwrap_or_default().iter_mut().rev() {
        *byte = byte.wrapping_add(1);
        if *byte != 0 {
            break;
        }
    }
}

#[cold]
#[inline(never)]
fn put_four(out: &mut Vec<u8>, four: u32) {
    out.extend_from_slice(&four.to_be_bytes());
}

/// Where a [`BitWriter`] stood.
#[derive(Clone, Copy, Debug)]
pub struct Mark {
    low: u64,
    range: u64,
    length: usize,
    last: Option<u8>,
}

/// Reads what a [`BitWriter`] wrote, with the same probabilities. Any bytes give some bits; no bytes give
/// bits too.
#[derive(Clone, Debug)]
pub struct BitReader<'a> {
    range: u64,
    /// What is read ahead, less what the bits so far have taken. Always below `range` for bytes of a writer.
    code: u64,
    bytes: &'a [u8],
}

impl<'a> BitReader<'a> {
    /// Reads these bytes.
    pub fn new(bytes: &'a [u8]) -> Self {
        let (high, rest) = next_four(bytes);
        let (low, rest) = next_four(rest);
        Self { range: u64::MAX, code: u64::from(high) << 32 | u64::from(low), bytes: rest }
    }

    /// The next bit, which was written with this probability.
    #[inline(always)]
    pub fn get(&mut self, probability: Probability) -> bool {
        self.take((self.range >> 16) * u64::from(probability))
    }

    #[inline(always)]
    fn take(&mut self, share: u64) -> bool {
        let bit = self.code < share;
        if bit {
            self.range = share;
        } else {
            self.code -= share;
            self.range -= share;
        }
        self.refill();
        bit
    }

    #[inline(always)]
    fn refill(&mut self) {
        if self.range < REFILL_BELOW {
            self.range <<= 32;
            let (four, rest) = next_four(self.bytes);
            self.code = self.code << 32 | u64::from(four);
            self.bytes = rest;
        }
    }
}

impl<'a> CodeBit for BitReader<'a> {
    const KNOWS: bool = false;

    /// Two branches for the two bits, which leaves it to the processor to guess the bit and go on; choosing
    /// values by the bit would have to wait for it.
    #[inline(always)]
    fn code_as(&mut self, likely: Probability, learns: &mut Probability, _: bool, rate: u32) -> bool {
        let share = (self.range >> 16) * u64::from(likely);
        if self.code < share {
            self.range = share;
            learn(learns, true, rate);
            self.refill();
            true
        } else {
            self.code -= share;
            self.range -= share;
            learn(learns, false, rate);
            self.refill();
            false
        }
    }

    type Own<'b>
        = Self
    where
        Self: 'b;

    #[inline(always)]
    fn in_registers<R>(&mut self, pass: impl FnOnce(&mut Self) -> R) -> R {
        let mut own = self.clone();
        let result = pass(&mut own);
        *self = own;
        result
    }
}

/// Four bytes as a number, zeros beyond the end, and the bytes after them.
#[cold]
#[inline(never)]
fn next_four(bytes: &[u8]) -> (u32, &[u8]) {
    if let Some((four, rest)) = bytes.split_first_chunk::<4>() {
        (u32::from_be_bytes(*four), rest)
    } else {
        let mut four = [0; 4];
        four.iter_mut().zip(bytes).for_each(|(to, byte)| *to = *byte);
        (u32::from_be_bytes(four), &[])
    }
}

/// The part of a range of at least 2³² that belongs to a probability in 2⁻³².
#[inline]
const fn fine_share(range: u64, probability: u32) -> u64 {
    ((range as u128 * probability as u128) >> 32) as u64
}

impl FineBits for BitWriter<'_> {
    #[inline]
    fn bit(&mut self, probability: u32, truth: bool) -> bool {
        self.take(fine_share(self.range, probability), truth);
        truth
    }
}

impl FineBits for BitReader<'_> {
    #[inline]
    fn bit(&mut self, probability: u32, _: bool) -> bool {
        self.take(fine_share(self.range, probability))
    }
}

#[cfg(test)]
mod tests;
