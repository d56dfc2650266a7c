//! Two opinions on one decision become one probability: that of an adaptive probability, and a sum of trained
//! tables. Weights say how far each is to be trusted; they learn within the package.

use super::odds::{ODDS_MAX, Odds, odds_of, probability_of};
use flockmap_coder::{CodeBit, Probability, learn};

/// An adaptive probability that is lower, or as near to one, is left alone: it is right nearly always, and
/// most are such.
const SURE: Probability = 656;

/// Whether an adaptive probability is so sure that nothing else is asked.
#[inline(always)]
pub(crate) fn is_sure(probability: Probability) -> bool {
    probability.wrapping_sub(SURE) > 0u16.wrapping_sub(2 * SURE)
}

/// Sums of trained tables are in sixteenths of a bit.
pub(crate) const ODDS_OF_SUM: Odds = 16;

/// Weights of both and a bias, in 2⁻¹⁶.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Weights {
    adaptive: i32,
    sum: i32,
    bias: i32,
}

/// 0.7 and 1: the tables are trained to add to 0.7 of what the probabilities say at the start.
pub(crate) const START: Weights = Weights { adaptive: TRUST, sum: 1 << 16, bias: 0 };
pub(crate) const TRUST: i32 = 45_875;

impl Weights {
    const ONE_MAX: i32 = 4 << 16;
    const BIAS_MAX: i32 = ODDS_MAX << 16;

    /// Takes in what was learned. Weights stay so small that no sum overflows.
    #[inline(always)]
    pub(crate) fn learn(&mut self, lesson: Lesson) {
        let limited = |weight: i32, by: i32, most: i32| weight.saturating_add(by).clamp(-most, most);
        self.adaptive = limited(self.adaptive, lesson.adaptive, Self::ONE_MAX);
        self.sum = limited(self.sum, lesson.sum, Self::ONE_MAX);
        self.bias = limited(self.bias, lesson.bias, Self::BIAS_MAX);
    }
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
    let (own, other) = (odds_of(*probability), (sum * ODDS_OF_SUM).clamp(-ODDS_MAX, ODDS_MAX));
    let odds = (weights.adaptive * own + weights.sum * other + weights.bias) >> 16;
    let mixed = probability_of(odds);
    let bit = bits.pass(mixed, truth);
    learn(probability, bit, rate);
    let error = if bit { 65_536 - i32::from(mixed) } else { -i32::from(mixed) };
    lesson.adaptive += (error * own) >> 14;
    lesson.sum += (error * other) >> 14;
    lesson.bias += error >> 1;
    bit
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_coder::BitWriter;
    use proptest::prelude::*;

    #[test]
    fn sure_is_below_and_above() {
        for probability in 1..=u16::MAX {
            let expected = probability < SURE || probability > u16::MAX - SURE + 1;
            assert_eq!(is_sure(probability), expected, "{probability}");
        }
    }

    proptest! {
        #[test]
        fn nothing_overflows_whatever_comes(
            decisions in prop::collection::vec((1u16.., any::<i16>(), any::<bool>(), 1usize..16), 0..2_000),
        ) {
            let (mut bytes, mut weights) = (Vec::new(), START);
            let mut bits = BitWriter::new(&mut bytes);
            for (mut probability, sum, truth, count) in decisions {
                let mut lesson = Lesson::default();
                for _ in 0..count {
                    code(&mut bits, &mut probability, sum.into(), &weights, &mut lesson, truth, 4);
                }
                weights.learn(lesson);
            }
        }
    }
}
