//! What is written is read, and costs what it must.

use super::*;
use proptest::prelude::*;

fn probability() -> impl Strategy<Value = Probability> {
    prop_oneof![1..=65_535u16, Just(1), Just(65_535), 1..=40u16, 65_500..=65_535u16]
}

fn written(bits: &[(Probability, bool)]) -> Vec<u8> {
    let mut out = vec![0xff, 0xff];
    let mut writer = BitWriter::new(&mut out);
    for (probability, bit) in bits {
        writer.put(*probability, *bit);
    }
    writer.finish();
    assert_eq!(out[..2], [0xff, 0xff], "what stood before stays");
    out.split_off(2)
}

fn read_back(bits: &[(Probability, bool)]) -> bool {
    let bytes = written(bits);
    let mut reader = BitReader::new(&bytes);
    bits.iter().all(|(probability, bit)| reader.get(*probability) == *bit)
}

proptest! {
    #[test]
    fn what_was_written_is_read(bits in prop::collection::vec((probability(), any::<bool>()), 0..3000)) {
        prop_assert!(read_back(&bits));
    }

    #[test]
    fn unlikely_bits_carry_far(head in prop::collection::vec((probability(), any::<bool>()), 0..40), length in 0..2_000usize) {
        // The lowest bit of the interval over and over makes bytes of 255, then one step more carries.
        let mut bits = head;
        bits.extend(core::iter::repeat_n((1, false), length));
        bits.push((65_535, false));
        prop_assert!(read_back(&bits));
    }

    #[test]
    fn likely_bits_cost_what_they_must(
        seeds in prop::collection::vec((probability(), any::<u16>()), 2_000..4_000),
    ) {
        // Bits drawn with the probabilities that they are coded with.
        let bits: Vec<_> = seeds.iter().map(|(probability, draw)| (*probability, draw < probability)).collect();
        let cost = |(probability, bit): &(Probability, bool)| {
            let set = f64::from(*probability) / 65_536.0;
            -(if *bit { set } else { 1.0 - set }).log2()
        };
        let limit = bits.iter().map(cost).sum::<f64>() / 8.0;
        let bytes = written(&bits).len() as f64;
        prop_assert!(bytes <= limit * 1.0002 + 1.01, "{} bytes, {:.1} at best", bytes, limit);
    }

    #[test]
    fn what_is_taken_back_leaves_no_trace(
        bits in prop::collection::vec((probability(), any::<bool>()), 0..300),
        more in prop::collection::vec((probability(), any::<bool>()), 0..300),
        carries in 0..40usize,
    ) {
        let mut out = vec![0xff, 0xff];
        let mut writer = BitWriter::new(&mut out);
        bits.iter().for_each(|(probability, bit)| writer.put(*probability, *bit));
        // Up to the highest number in the interval, so that a step further carries.
        (0..carries).for_each(|_| writer.put(1, false));
        let mark = writer.mark();
        let length = writer.finished_len();
        (0..carries).for_each(|_| writer.put(65_535, false));
        more.iter().for_each(|(probability, bit)| writer.put(*probability, *bit));
        writer.back_to(&mark);
        writer.finish();
        let mut straight = bits;
        straight.extend(core::iter::repeat_n((1, false), carries));
        prop_assert_eq!(&out[2..], written(&straight));
        prop_assert!(out.len() <= length);
    }

    #[test]
    fn any_bytes_can_be_read(bytes in prop::collection::vec(any::<u8>(), 0..40), probability in probability()) {
        let mut reader = BitReader::new(&bytes);
        for _ in 0..2_000 {
            reader.get(probability);
        }
    }
}

#[test]
fn the_end_is_right_wherever_the_interval_lies() {
    let probabilities = [1, 255, 256, 32_767, 32_768, 65_280, 65_535];
    for length in 0..5usize {
        for case in 0..(2 * probabilities.len()).pow(length as u32) {
            let mut rest = case;
            let bits: Vec<(Probability, bool)> = (0..length)
                .map(|_| {
                    let choice = rest % (2 * probabilities.len());
                    rest /= 2 * probabilities.len();
                    (probabilities[choice / 2], choice % 2 == 1)
                })
                .collect();
            assert!(read_back(&bits), "{bits:?}");
        }
    }
}

#[test]
fn probabilities_never_leave_their_range() {
    for rate in [5, 6] {
        for bit in [false, true] {
            let mut probability = 1 << 15;
            for _ in 0..1_000 {
                learn(&mut probability, bit, rate);
                assert!(probability > 0);
            }
            let mut least = 1;
            learn(&mut least, false, rate);
            assert_eq!(least, 1);
        }
    }
}

fn fine_probability() -> impl Strategy<Value = u32> {
    prop_oneof![1..=u32::MAX, Just(1), Just(u32::MAX), 1..=40u32, u32::MAX - 40..=u32::MAX]
}

fn written_fine(bits: &[(u32, bool)]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut writer = BitWriter::new(&mut out);
    for (probability, bit) in bits {
        writer.bit(*probability, *bit);
    }
    writer.finish();
    out
}

proptest! {
    #[test]
    fn fine_bits_are_read_and_cost_what_they_must(seeds in prop::collection::vec((fine_probability(), any::<u32>()), 0..3_000)) {
        // Bits drawn with the probabilities that they are coded with.
        let bits: Vec<_> = seeds.iter().map(|(probability, draw)| (*probability, draw < probability)).collect();
        let cost = |(probability, bit): &(u32, bool)| {
            let set = f64::from(*probability) / 4_294_967_296.0;
            -(if *bit { set } else { 1.0 - set }).log2()
        };
        let limit = bits.iter().map(cost).sum::<f64>() / 8.0;
        let bytes = written_fine(&bits);
        prop_assert!(bytes.len() as f64 <= limit * 1.0001 + 1.01, "{} bytes, {:.1} at best", bytes.len(), limit);
        let mut reader = BitReader::new(&bytes);
        prop_assert!(bits.iter().all(|(probability, bit)| reader.bit(*probability, false) == *bit));
    }

    #[test]
    fn unlikely_fine_bits_are_read(bits in prop::collection::vec((fine_probability(), any::<bool>()), 0..3_000)) {
        let bytes = written_fine(&bits);
        let mut reader = BitReader::new(&bytes);
        prop_assert!(bits.iter().all(|(probability, bit)| reader.bit(*probability, false) == *bit));
    }
}

#[test]
fn bytes_are_the_same_on_every_machine() {
    let bits = [(40_000, true), (1, false), (65_535, true), (100, true), (32_768, false), (9_000, true)];
    let many: Vec<_> = bits.iter().cycle().take(60).copied().collect();
    assert_eq!(crc32fast::hash(&written(&many)), GOLDEN);
}
const GOLDEN: u32 = 791_726_009;
