//! How many unchanged voxels lie between two changes.
//!
//! If `left` of the `rest` voxels to come are changes, in no order, then each is one with probability p =
//! left / rest, and a gap of g or more has the probability (1 − p)^g. Powers of 1 − p by squaring give the
//! probabilities of the bits of g: first, in groups of 2ⁿ voxels, whether the gap goes beyond the next group,
//! then the place in the group from the highest bit to the lowest.

use flockmap_coder::FineBits;

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
        // At least 2⁵, unless `most` is 0, where nothing is coded; below 2³².
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

    /// Writes or reads the gap, at most `rest - left`. What follows from that is not coded. A reader's `gap`
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
mod tests;
