//! A binary arithmetic coder: 64-bit range with carry, chances of 16 bits, and of 32 where that is too coarse.
//!
//! The writer keeps an interval of numbers, `low` and `range`. Each bit takes a share of it that is as large as the bit is
//! likely; when the range falls below 2³², the four leading bytes go out. Integers only, so that every machine agrees.

/// How likely a bit is set, in 65,536ths: 1 … 65,535.
pub(crate) type Chance = u16;

const REFILL_BELOW: u64 = 1 << 32;

/// Moves a chance towards what has happened, by one in 2ʳᵃᵗᵉ. It stays in 1 … 65,535.
#[inline(always)]
fn learn(chance: &mut Chance, bit: bool, rate: u32) {
    if bit {
        *chance += (65_535 - *chance) >> rate;
    } else {
        *chance -= *chance >> rate;
    }
    debug_assert!(*chance > 0);
}

/// A way that bits go: to bytes or from bytes.
pub(crate) trait CodeBit {
    /// Whether it looks at `truth`: it writes.
    const KNOWS: bool;

    /// Passes a bit, which is set with this chance; the chance learns by one in 2ʳᵃᵗᵉ.
    fn code(&mut self, chance: &mut Chance, truth: bool, rate: u32) -> bool;

    /// The same way.
    type Own<'b>: CodeBit
    where
        Self: 'b;

    /// Lets many bits pass in a variable of their own, which can stay in registers.
    fn in_registers<R>(&mut self, pass: impl FnOnce(&mut Self::Own<'_>) -> R) -> R;
}

/// Appends bits to some bytes.
#[derive(Debug)]
pub(crate) struct BitWriter<'a> {
    low: u64,
    range: u64,
    out: &'a mut Vec<u8>,
    start: usize,
}

impl<'a> BitWriter<'a> {
    pub(crate) fn new(out: &'a mut Vec<u8>) -> Self {
        Self { low: 0, range: u64::MAX, start: out.len(), out }
    }

    /// Writes a bit that is set with this chance.
    #[cfg(test)]
    pub(crate) fn put(&mut self, chance: Chance, bit: bool) {
        self.take((self.range >> 16) * u64::from(chance), bit);
    }

    /// As [`Self::put`], the chance in 2⁻³²: 1 … 2³² − 1.
    #[inline]
    pub(crate) fn put_fine(&mut self, chance: u32, bit: bool) {
        self.take(fine_share(self.range, chance), bit);
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
    pub(crate) fn mark(&self) -> Mark {
        Mark { low: self.low, range: self.range, length: self.out.len(), last: self.out.last().copied() }
    }

    /// Takes back what was written after a mark, the newest.
    pub(crate) fn back_to(&mut self, mark: &Mark) {
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

    /// The last bytes: a number in the interval with as few as possible, and how many. What a reader finds beyond the end is zeros.
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
    pub(crate) fn finished_len(&self) -> usize {
        self.out.len() + self.end().1
    }

    /// The last bytes. As few as tell the interval: what a reader finds beyond the end is zeros.
    pub(crate) fn finish(self) {
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
    fn code(&mut self, chance: &mut Chance, truth: bool, rate: u32) -> bool {
        let share = (self.range >> 16) * u64::from(*chance);
        // Two ways, as in reading.
        if truth {
            learn(chance, true, rate);
            self.take(share, true);
        } else {
            learn(chance, false, rate);
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

/// Carries into the bytes that are out. They never overflow: the number that they tell is below 1.
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
pub(crate) struct Mark {
    low: u64,
    range: u64,
    length: usize,
    last: Option<u8>,
}

/// Reads what a [`BitWriter`] wrote, with the same chances. Any bytes give some bits; no bytes give bits too.
#[derive(Clone, Debug)]
pub(crate) struct BitReader<'a> {
    range: u64,
    /// What is read ahead, less what the bits so far have taken. Always below `range` for bytes of a writer.
    code: u64,
    bytes: &'a [u8],
}

impl<'a> BitReader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        let (high, rest) = next_four(bytes);
        let (low, rest) = next_four(rest);
        Self { range: u64::MAX, code: u64::from(high) << 32 | u64::from(low), bytes: rest }
    }

    /// The next bit, which was written with this chance.
    #[cfg(test)]
    pub(crate) fn get(&mut self, chance: Chance) -> bool {
        self.take((self.range >> 16) * u64::from(chance))
    }

    /// The next bit, which was written by [`BitWriter::put_fine`] with this chance.
    #[inline]
    pub(crate) fn get_fine(&mut self, chance: u32) -> bool {
        self.take(fine_share(self.range, chance))
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

    /// Two ways for the two bits, which leaves it to the processor to guess the bit and go on; choosing values by the bit would have
    /// to wait for it.
    #[inline(always)]
    fn code(&mut self, chance: &mut Chance, _: bool, rate: u32) -> bool {
        let share = (self.range >> 16) * u64::from(*chance);
        if self.code < share {
            self.range = share;
            learn(chance, true, rate);
            self.refill();
            true
        } else {
            self.code -= share;
            self.range -= share;
            learn(chance, false, rate);
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

/// The part of a range of at least 2³² that belongs to a chance in 2⁻³².
#[inline]
const fn fine_share(range: u64, chance: u32) -> u64 {
    ((range as u128 * chance as u128) >> 32) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn chance() -> impl Strategy<Value = Chance> {
        prop_oneof![1..=65_535u16, Just(1), Just(65_535), 1..=40u16, 65_500..=65_535u16]
    }

    fn written(bits: &[(Chance, bool)]) -> Vec<u8> {
        let mut out = vec![0xff, 0xff];
        let mut writer = BitWriter::new(&mut out);
        for (chance, bit) in bits {
            writer.put(*chance, *bit);
        }
        writer.finish();
        assert_eq!(out[..2], [0xff, 0xff], "what stood before is left alone");
        out.split_off(2)
    }

    fn read_back(bits: &[(Chance, bool)]) -> bool {
        let bytes = written(bits);
        let mut reader = BitReader::new(&bytes);
        bits.iter().all(|(chance, bit)| reader.get(*chance) == *bit)
    }

    proptest! {
        #[test]
        fn what_was_written_is_read(bits in prop::collection::vec((chance(), any::<bool>()), 0..3000)) {
            prop_assert!(read_back(&bits));
        }

        #[test]
        fn unlikely_bits_carry_far(head in prop::collection::vec((chance(), any::<bool>()), 0..40), length in 0..2_000usize) {
            // The lowest bit of the interval over and over makes bytes of 255, then one step more carries.
            let mut bits = head;
            bits.extend(core::iter::repeat_n((1, false), length));
            bits.push((65_535, false));
            prop_assert!(read_back(&bits));
        }

        #[test]
        fn likely_bits_cost_what_they_must(
            seeds in prop::collection::vec((chance(), any::<u16>()), 2_000..4_000),
        ) {
            // Bits drawn with the chances that they are coded with.
            let bits: Vec<_> = seeds.iter().map(|(chance, draw)| (*chance, draw < chance)).collect();
            let cost = |(chance, bit): &(Chance, bool)| {
                let set = f64::from(*chance) / 65_536.0;
                -(if *bit { set } else { 1.0 - set }).log2()
            };
            let limit = bits.iter().map(cost).sum::<f64>() / 8.0;
            let bytes = written(&bits).len() as f64;
            prop_assert!(bytes <= limit * 1.0002 + 1.01, "{} bytes, {:.1} at best", bytes, limit);
        }

        #[test]
        fn what_is_taken_back_leaves_no_trace(
            bits in prop::collection::vec((chance(), any::<bool>()), 0..300),
            more in prop::collection::vec((chance(), any::<bool>()), 0..300),
            carries in 0..40usize,
        ) {
            let mut out = vec![0xff, 0xff];
            let mut writer = BitWriter::new(&mut out);
            bits.iter().for_each(|(chance, bit)| writer.put(*chance, *bit));
            // Up to the highest number in the interval, so that a step further carries.
            (0..carries).for_each(|_| writer.put(1, false));
            let mark = writer.mark();
            let length = writer.finished_len();
            (0..carries).for_each(|_| writer.put(65_535, false));
            more.iter().for_each(|(chance, bit)| writer.put(*chance, *bit));
            writer.back_to(&mark);
            writer.finish();
            let mut straight = bits;
            straight.extend(core::iter::repeat_n((1, false), carries));
            prop_assert_eq!(&out[2..], written(&straight));
            prop_assert!(out.len() <= length);
        }

        #[test]
        fn any_bytes_can_be_read(bytes in prop::collection::vec(any::<u8>(), 0..40), chance in chance()) {
            let mut reader = BitReader::new(&bytes);
            for _ in 0..2_000 {
                reader.get(chance);
            }
        }
    }

    #[test]
    fn the_end_is_right_wherever_the_interval_lies() {
        let chances = [1, 255, 256, 32_767, 32_768, 65_280, 65_535];
        for length in 0..5usize {
            for case in 0..(2 * chances.len()).pow(length as u32) {
                let mut rest = case;
                let bits: Vec<(Chance, bool)> = (0..length)
                    .map(|_| {
                        let choice = rest % (2 * chances.len());
                        rest /= 2 * chances.len();
                        (chances[choice / 2], choice % 2 == 1)
                    })
                    .collect();
                assert!(read_back(&bits), "{bits:?}");
            }
        }
    }

    #[test]
    fn chances_never_leave_their_range() {
        for rate in [5, 6] {
            for bit in [false, true] {
                let mut chance = 1 << 15;
                for _ in 0..1_000 {
                    learn(&mut chance, bit, rate);
                    assert!(chance > 0);
                }
                let mut least = 1;
                learn(&mut least, false, rate);
                assert_eq!(least, 1);
            }
        }
    }

    fn fine_chance() -> impl Strategy<Value = u32> {
        prop_oneof![1..=u32::MAX, Just(1), Just(u32::MAX), 1..=40u32, u32::MAX - 40..=u32::MAX]
    }

    fn written_fine(bits: &[(u32, bool)]) -> Vec<u8> {
        let mut out = Vec::new();
        let mut writer = BitWriter::new(&mut out);
        for (chance, bit) in bits {
            writer.put_fine(*chance, *bit);
        }
        writer.finish();
        out
    }

    proptest! {
        #[test]
        fn fine_bits_are_read_and_cost_what_they_must(seeds in prop::collection::vec((fine_chance(), any::<u32>()), 0..3_000)) {
            // Bits drawn with the chances that they are coded with.
            let bits: Vec<_> = seeds.iter().map(|(chance, draw)| (*chance, draw < chance)).collect();
            let cost = |(chance, bit): &(u32, bool)| {
                let set = f64::from(*chance) / 4_294_967_296.0;
                -(if *bit { set } else { 1.0 - set }).log2()
            };
            let limit = bits.iter().map(cost).sum::<f64>() / 8.0;
            let bytes = written_fine(&bits);
            prop_assert!(bytes.len() as f64 <= limit * 1.0001 + 1.01, "{} bytes, {:.1} at best", bytes.len(), limit);
            let mut reader = BitReader::new(&bytes);
            prop_assert!(bits.iter().all(|(chance, bit)| reader.get_fine(*chance) == *bit));
        }

        #[test]
        fn unlikely_fine_bits_are_read(bits in prop::collection::vec((fine_chance(), any::<bool>()), 0..3_000)) {
            let bytes = written_fine(&bits);
            let mut reader = BitReader::new(&bytes);
            prop_assert!(bits.iter().all(|(chance, bit)| reader.get_fine(*chance) == *bit));
        }
    }

    #[test]
    fn bytes_are_the_same_on_every_machine() {
        let bits = [(40_000, true), (1, false), (65_535, true), (100, true), (32_768, false), (9_000, true)];
        let many: Vec<_> = bits.iter().cycle().take(60).copied().collect();
        assert_eq!(crc32fast::hash(&written(&many)), GOLDEN);
    }
    const GOLDEN: u32 = 791_726_009;
}
