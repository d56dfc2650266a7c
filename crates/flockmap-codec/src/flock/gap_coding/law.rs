//! How many unchanged voxels lie between two changes.
//!
//! If `left` of the `rest` voxels to come are changes, in no order, then each is one with probability p =
//! left / rest, and a gap of g or more has the probability (1 − p)^g. Powers of 1 − p by squaring give the
//! probabilities of the bits of g: first, in groups of 2ⁿ voxels, whether the gap goes beyond the next group,
//! then the place in the group from the highest bit to the lowest.

use crate::flock::coder::FineBits;

/// Groups of so many voxels, as a power of two, are enough for one change in 2²⁷ voxels: (1 − 2⁻²⁷)^(2²⁷) <
/// ½.
const GROUP_LOG_MAX: usize = 27;

/// The law of one gap.
pub(crate) struct Gaps {
    /// The largest gap there can be.
    most: u32,
    /// Number `i` is (1 − p)^(2ⁱ) in 2⁻³².
    beyond: [u32; GROUP_LOG_MAX + 1],
    group_log: usize,
}

impl Gaps {
    /// The gap before the next of `left` changes among `rest` voxels; 1 ≤ `left` ≤ `rest` ≤ 2²⁷.
    #[inline]
    pub(crate) fn new(left: u32, rest: u32) -> Self {
        let most = rest - left;
        let mut gaps = Self { most, beyond: [0; GROUP_LOG_MAX + 1], group_log: 0 };
        // At least 2⁵, unless `most` is 0, where nothing is told; below 2³².
        let mut power = (u64::from(most) << 32) / u64::from(rest);
        gaps.beyond[0] = power as u32;
        // The smallest groups that a gap goes beyond in less than half of the cases. A power is then at least
        // 2³⁰.
        while power >= 1 << 31 && gaps.group_log < GROUP_LOG_MAX {
            power = (power * power) >> 32;
            gaps.group_log += 1;
            gaps.beyond[gaps.group_log] = power as u32;
        }
        gaps
    }

    /// Writes or reads the gap, at most `rest - left`. What follows from that is not told. A reader's `gap`
    /// means nothing.
    #[inline]
    pub(crate) fn code(&self, bits: &mut impl FineBits, gap: u32) -> u32 {
        let group = 1u32 << self.group_log;
        let mut base = 0;
        while base + group <= self.most && bits.bit(self.beyond[self.group_log], gap >= base + group) {
            base += group;
        }
        for log in (0..self.group_log).rev() {
            let half = 1u32 << log;
            if base + half <= self.most {
                // Of a group of 2·half voxels: with q = (1 − p)^half the first half has 1 parts and the
                // second q.
                let q = u64::from(self.beyond[log]);
                let probability = (q << 31) / ((1 << 31) + (q >> 1));
                if bits.bit(probability as u32, gap >= base + half) {
                    base += half;
                }
            }
        }
        base
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Adds up what bits cost.
    #[derive(Default)]
    struct Cost(f64);

    impl FineBits for Cost {
        fn bit(&mut self, probability: u32, truth: bool) -> bool {
            assert!(probability > 0);
            let set = f64::from(probability) / 4_294_967_296.0;
            self.0 -= (if truth { set } else { 1.0 - set }).log2();
            truth
        }
    }

    #[test]
    fn a_gap_costs_what_its_probability_says() {
        for (left, rest) in
            [(1, 1 << 27), (7, 1 << 20), (900, 100_000), (3, 10), (1, 2), (999, 1000), (500, 1000)]
        {
            let share = f64::from(left) / f64::from(rest);
            for gap in [0, 1, 2, 5, 30, 100, 1_000, 50_000, 1 << 20, 1 << 26] {
                if gap < (rest - left) / 2 {
                    let mut cost = Cost::default();
                    assert_eq!(Gaps::new(left, rest).code(&mut cost, gap), gap);
                    let expected = -(share.log2() + f64::from(gap) * (1.0 - share).log2());
                    // Less where the end of the box cuts the last group.
                    assert!(
                        cost.0 <= expected * 1.000_1 + 0.01,
                        "{left} of {rest}, {gap}: {} for {expected}",
                        cost.0
                    );
                    assert!(cost.0 >= expected - 3.0, "{left} of {rest}, {gap}: {} for {expected}", cost.0);
                }
            }
        }
    }

    #[test]
    fn every_gap_comes_back_and_where_there_is_no_choice_nothing_is_told() {
        for (left, rest) in [(1, 1), (5, 5), (1, 2), (1, 9), (4, 9), (8, 9), (2, 700)] {
            for gap in 0..=rest - left {
                let mut cost = Cost::default();
                assert_eq!(Gaps::new(left, rest).code(&mut cost, gap), gap);
                assert!((cost.0 == 0.0) == (left == rest));
            }
        }
    }
}
