//! Many durations in little memory.

/// Each power of two is cut into this many steps: a value read back is off by at most 1.6 %.
const STEPS: usize = 32;

/// Values of 2³⁵ µs (9 hours) and more count as that.
const POWERS: usize = 31;

/// Durations in microseconds, with mean and percentiles. 8 kB, however many there are.
#[derive(Clone, Debug)]
pub struct Histogram {
    counts: Vec<u64>,
    count: u64,
    sum: u128,
    max: u64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: vec![0; STEPS * POWERS], count: 0, sum: 0, max: 0 }
    }
}

impl Histogram {
    /// Adds a duration.
    pub fn add(&mut self, micros: u64) {
        let slot = Self::slot(micros);
        if let Some(count) = self.counts.get_mut(slot) {
            *count += 1;
        }
        self.count += 1;
        self.sum += u128::from(micros);
        self.max = self.max.max(micros);
    }

    /// Takes in all that another histogram holds.
    pub fn merge(&mut self, other: &Self) {
        if self.counts.len() < other.counts.len() {
            self.counts.resize(other.counts.len(), 0);
        }
        for (sum, count) in self.counts.iter_mut().zip(&other.counts) {
            *sum += count;
        }
        self.count += other.count;
        self.sum += other.sum;
        self.max = self.max.max(other.max);
    }

    /// How many were added.
    pub const fn count(&self) -> u64 {
        self.count
    }

    /// Their mean in microseconds, exact; 0 if there are none.
    pub fn mean(&self) -> f64 {
        if self.count == 0 { 0.0 } else { self.sum as f64 / self.count as f64 }
    }

    /// The longest, exact.
    pub const fn max(&self) -> u64 {
        self.max
    }

    /// The duration in microseconds that a share of `quantile` (0 … 1) of them does not exceed; 0.5 is the median.
    pub fn quantile(&self, quantile: f64) -> u64 {
        let rank = (quantile.clamp(0.0, 1.0) * self.count as f64).ceil().max(1.0) as u64;
        let mut seen = 0;
        for (slot, count) in self.counts.iter().enumerate() {
            seen += count;
            if seen >= rank {
                return Self::value(slot).min(self.max);
            }
        }
        self.max
    }

    /// Below `STEPS` each value has its own slot; above, the top bits choose it.
    fn slot(micros: u64) -> usize {
        if micros < STEPS as u64 {
            return micros as usize;
        }
        let power = micros.ilog2() as usize - STEPS.ilog2() as usize;
        let step = (micros >> power) as usize - STEPS;
        ((power + 1) * STEPS + step).min(STEPS * POWERS - 1)
    }

    /// The middle of a slot.
    const fn value(slot: usize) -> u64 {
        let (power, step) = (slot / STEPS, (slot % STEPS) as u64);
        if power == 0 {
            return step;
        }
        let width = 1u64 << (power - 1);
        (STEPS as u64 + step) * width + width / 2
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn an_empty_histogram_reads_as_zero() {
        let empty = Histogram::default();
        assert_eq!((empty.count(), empty.max(), empty.quantile(0.5)), (0, 0, 0));
        assert_eq!(empty.mean(), 0.0);
    }

    proptest! {
        #[test]
        fn quantiles_are_near_those_of_the_sorted_list(
            mut values in prop::collection::vec(0u64..10_000_000_000, 1..200), quantile in 0.0f64..=1.0,
        ) {
            let mut histogram = Histogram::default();
            for &value in &values {
                histogram.add(value);
            }
            values.sort_unstable();
            let rank = (quantile * values.len() as f64).ceil().max(1.0) as usize;
            let exact = values[rank - 1] as f64;
            let got = histogram.quantile(quantile) as f64;
            prop_assert!((got - exact).abs() <= exact * 0.016 + 0.5, "{got} for {exact}");
            prop_assert_eq!(histogram.max(), values[values.len() - 1]);
        }
    }

    #[test]
    fn the_largest_duration_is_held() {
        let mut histogram = Histogram::default();
        histogram.add(u64::MAX);
        assert_eq!(histogram.max(), u64::MAX);
        assert!(histogram.quantile(1.0) > 1 << 34);
    }
}
