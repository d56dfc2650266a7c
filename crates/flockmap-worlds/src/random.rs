//! Seeded random numbers that are the same on every machine.

/// SplitMix64 (Steele, Lea, Flood 2014): one addition and three multiply-xor steps a number, period 2⁶⁴.
#[derive(Clone, Debug)]
pub struct Random {
    state: u64,
}

impl Random {
    /// A stream of its own for each pair of seed and purpose.
    pub fn new(seed: u64, purpose: u64) -> Self {
        Self { state: mix(seed ^ mix(purpose.wrapping_add(0x5851_f42d_4c95_7f2d))) }
    }

    /// 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix(self.state)
    }

    /// Uniform in 0 ≤ x < 1, in steps of 2⁻⁵³.
    pub fn unit(&mut self) -> f64 {
        unit(self.next_u64())
    }

    /// Uniform in low ≤ x < high.
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Uniform in 0 ≤ i < n. `n` must not be 0.
    pub fn below(&mut self, n: u64) -> u64 {
        // The high half of a 128-bit product: a bias below n / 2⁶⁴.
        ((u128::from(self.next_u64()) * u128::from(n)) >> 64) as u64
    }

    /// True with this probability.
    pub fn happens(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// About normally distributed, mean 0, deviation 1, never beyond ± 6: the sum of twelve uniforms. Needs
    /// no logarithm.
    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
    }
}

/// A number to 64 bits that look random.
pub const fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// 64 random bits to 0 ≤ x < 1.
pub fn unit(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1u64 << 53) as f64
}

/// Random bits that belong to a place.
pub const fn hash_at(seed: u64, x: i64, y: i64, z: i64) -> u64 {
    mix(seed
        ^ mix((x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
            ^ mix((y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f) ^ mix((z as u64).wrapping_add(0x1656_67b1)))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stream_is_the_published_one() {
        // First outputs of SplitMix64 from state 1234567.
        let mut random = Random { state: 1_234_567 };
        assert_eq!(random.next_u64(), 6_457_827_717_110_365_317);
        assert_eq!(random.next_u64(), 3_203_168_211_198_807_973);
    }

    #[test]
    fn draws_stay_in_their_ranges_and_cover_them() {
        let mut random = Random::new(1, 2);
        let mut seen = [0u32; 7];
        for _ in 0..7_000 {
            seen[random.below(7) as usize] += 1;
            assert!((0.0..1.0).contains(&random.unit()));
            assert!(random.normal().abs() <= 6.0);
        }
        assert!(seen.iter().all(|&n| (850..1_150).contains(&n)), "{seen:?}");
    }
}
