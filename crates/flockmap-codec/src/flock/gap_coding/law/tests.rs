//! What gaps cost.

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
