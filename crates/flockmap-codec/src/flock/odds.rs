//! Probabilities as log-odds and back, in integers: log₂(p / (1 − p)) in 256ths of a bit.

use super::log2::log2;
use flockmap_coder::Probability;

/// Log-odds in 256ths of a bit, −[`ODDS_MAX`] … [`ODDS_MAX`].
pub(crate) type Odds = i32;

/// 11 bits: probabilities of one in two thousand.
pub(crate) const ODDS_MAX: Odds = 11 * 256;

/// The log-odds of a probability, by its ten highest bits.
#[inline(always)]
pub(crate) fn odds_of(probability: Probability) -> Odds {
    Odds::from(ODDS[usize::from(probability >> 6)])
}

/// The probability of log-odds; those beyond the limits count as the limits.
#[inline(always)]
pub(crate) fn probability_of(odds: Odds) -> Probability {
    let odds = odds.clamp(-ODDS_MAX, ODDS_MAX - 1);
    PROBABILITIES[(odds + ODDS_MAX) as usize / 4 % PROBABILITIES.len()]
}

static ODDS: [i16; 1_024] = {
    let mut table = [0; 1_024];
    let mut n = 0;
    while n < 1_024 {
        let set = 64 * n as u64 + 32;
        // In 2⁻³² of a bit, to the nearest 256th.
        let odds = (log2(set) as i64 - log2(65_536 - set) as i64 + (1 << 23)) >> 24;
        table[n] = odds as i16;
        n += 1;
    }
    table
};

/// By four steps of log-odds from the lowest on, each for the middle of its four.
static PROBABILITIES: [Probability; ODDS_MAX as usize / 2] = {
    // 2^(n / 256) in 2⁻³², each from the one before: 2^(1 / 256) in 2⁻⁶⁰.
    const STEP: u128 = 1_156_047_391_917_129_430;
    let mut powers = [0u64; 256];
    let (mut power, mut n) = (1u128 << 60, 0);
    while n < 256 {
        powers[n] = (power >> 28) as u64;
        power = (power * STEP) >> 60;
        n += 1;
    }
    let mut table = [0; ODDS_MAX as usize / 2];
    let mut n = 0;
    while n < table.len() {
        let odds = 4 * n as i64 + 2 - ODDS_MAX as i64;
        // 2^odds in 2⁻⁴⁰, from 2⁻¹¹ to 2¹¹.
        let ratio = (powers[(odds & 255) as usize] as u128) << 20 >> (12 - (odds >> 8));
        let share = (ratio << 16) / (ratio + (1 << 40));
        table[n] = share as Probability;
        n += 1;
    }
    table
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn odds_and_probabilities_are_those_of_floats() {
        for probability in 64..=65_471u16 {
            let share = f64::from(probability / 64 * 64 + 32) / 65_536.0;
            let exact = (share / (1.0 - share)).log2() * 256.0;
            let odds = odds_of(probability);
            assert!((f64::from(odds) - exact).abs() <= 0.51, "{probability}: {odds} and {exact}");
        }
        for odds in -ODDS_MAX..ODDS_MAX {
            let ratio = (f64::from(odds.div_euclid(4) * 4 + 2) / 256.0).exp2();
            let exact = ratio / (1.0 + ratio) * 65_536.0;
            let probability = probability_of(odds);
            assert!((f64::from(probability) - exact).abs() <= 1.1, "{odds}: {probability} and {exact}");
        }
        assert_eq!(probability_of(Odds::MAX), probability_of(ODDS_MAX - 1));
        assert_eq!(probability_of(Odds::MIN), probability_of(-ODDS_MAX));
    }
}
