//! Two opinions on one decision become one probability: that of an adaptive probability, and a sum of trained
//! tables. Weights say how far each is to be trusted; they learn within the package.

use super::odds::{Odds, odds_of, probability_of};
use flockmap_coder::{CodeBit, Probability};

/// Whether an adaptive probability is below `sure`, or as near to one: it is right nearly always, most are such, and
/// nothing else is asked.
#[inline(always)]
pub(crate) fn is_sure(probability: Probability, sure: Probability) -> bool {
    probability.wrapping_sub(sure) > 0u16.wrapping_sub(2 * sure)
}

/// Sums of trained tables are in eighths of a bit.
pub(crate) const ODDS_OF_SUM: Odds = 32;

/// Weights of both and a bias, in 2⁻¹⁴. What is learned of them wraps round where only a package made for it could
/// bring it: reader and writer agree all the same.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Weights {
    adaptive: i32,
    sum: i32,
    bias: i32,
}

/// 0.7 and 1: the tables are trained to add to 0.7 of what the probabilities say at the start.
pub(crate) const START: Weights = Weights { adaptive: TRUST, sum: 1 << 14, bias: 0 };
pub(crate) const TRUST: i32 = 11_469;

impl Weights {
    /// What two log-odds become.
    #[inline(always)]
    fn mixed(&self, own: Odds, other: Odds) -> Probability {
        let odds = self.adaptive.wrapping_mul(own).wrapping_add(self.sum.wrapping_mul(other));
        probability_of(odds.wrapping_add(self.bias) >> 14)
    }

    /// Takes in what was learned.
    #[inline(always)]
    pub(crate) fn learn(&mut self, lesson: Lesson) {
        self.adaptive = self.adaptive.wrapping_add(lesson.adaptive);
        self.sum = self.sum.wrapping_add(lesson.sum);
        self.bias = self.bias.wrapping_add(lesson.bias);
    }

    /// Goes a quarter of the way to others.
    pub(crate) fn approach(&mut self, other: &Self) {
        let nearer = |from: i32, to: i32| from - (from >> 2) + (to >> 2);
        self.adaptive = nearer(self.adaptive, other.adaptive);
        self.sum = nearer(self.sum, other.sum);
        self.bias = nearer(self.bias, other.bias);
    }
}

/// A probability that packages begin with, mixed with a sum as they begin.
#[inline(always)]
pub(crate) fn at_start(probability: Probability, sum: i32) -> Probability {
    START.mixed(odds_of(probability), sum * ODDS_OF_SUM)
}

/// What some decisions say of their weights, which do not change meanwhile: so the next decision need not wait
/// for the last one.
#[derive(Clone, Copy, Default)]
pub(crate) struct Lesson {
    adaptive: i32,
    sum: i32,
    bias: i32,
}

/// Passes a bit with the mixed probability. The adaptive one learns at once.
#[inline(always)]
pub(crate) fn code<B: CodeBit>(
    bits: &mut B,
    probability: &mut Probability,
    sum: i32,
    weights: &Weights,
    lesson: &mut Lesson,
    truth: bool,
    rate: u32,
) -> bool {
    let (own, other) = (odds_of(*probability), sum * ODDS_OF_SUM);
    let mixed = weights.mixed(own, other);
    let bit = bits.code_as(mixed, probability, truth, rate);
    let error = (i32::from(bit) << 16) - i32::from(mixed);
    lesson.adaptive = lesson.adaptive.wrapping_add((error * own) >> 16);
    lesson.sum = lesson.sum.wrapping_add((error * other) >> 16);
    lesson.bias = lesson.bias.wrapping_add(error >> 3);
    bit
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_coder::BitWriter;
    use proptest::prelude::*;

    #[test]
    fn sure_is_below_and_above() {
        for (probability, sure) in
            (1..=u16::MAX).flat_map(|probability| [1, 300, 2_000].map(|sure| (probability, sure)))
        {
            let expected = probability < sure || probability > u16::MAX - sure + 1;
            assert_eq!(is_sure(probability, sure), expected, "{probability}");
        }
    }

    proptest! {
        #[test]
        fn weights_go_a_quarter_of_the_way_whatever_they_are(from in any::<i32>(), to in any::<i32>()) {
            let weights = |weight| Weights { adaptive: weight, sum: weight, bias: weight };
            for (from, to) in [(from, to), (i32::MIN, to), (i32::MAX, to), (from, i32::MIN), (from, i32::MAX)] {
                let mut nearer = weights(from);
                nearer.approach(&weights(to));
                let exact = (3 * i64::from(from) + i64::from(to)) / 4;
                prop_assert!(i64::from(nearer.sum).abs_diff(exact) <= 1, "{from} and {to}: {nearer:?}");
                prop_assert_eq!(nearer, weights(nearer.sum));
            }
        }

        #[test]
        fn nothing_overflows_whatever_comes(
            decisions in prop::collection::vec((1u16.., -1_016i32..=1_016, any::<bool>(), 1usize..16), 0..2_000),
        ) {
            let (mut bytes, mut weights) = (Vec::new(), START);
            let mut bits = BitWriter::new(&mut bytes);
            for (mut probability, sum, truth, count) in decisions {
                let mut lesson = Lesson::default();
                for _ in 0..count {
                    code(&mut bits, &mut probability, sum, &weights, &mut lesson, truth, 4);
                }
                weights.learn(lesson);
            }
        }
    }
}
