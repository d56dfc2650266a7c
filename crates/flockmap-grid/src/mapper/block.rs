//! One block of the map, and what the counts of one scan do to it.

use super::config::Rules;
use super::tally::Tally;
use crate::{BLOCK_VOXELS, Plane, Sheet, State, StateBlock, SubmapId, set_bits};
use fearless_simd::prelude::*;
use fearless_simd::{Level, dispatch, i16x16, u16x16};

/// Log-odds of a voxel that no ray has touched.
pub(super) const UNOBSERVED: i16 = i16::MIN;

/// 512 voxels of the map: 2,312 bytes.
#[derive(Clone)]
pub(super) struct MapBlock {
    log_odds: [i16; BLOCK_VOXELS],
    /// Number of the scan or update that touched the voxel last; 0 = none, or one too long ago.
    seen: [u16; BLOCK_VOXELS],
    states: StateBlock,
    /// The states that were published last.
    packed: StateBlock,
    /// Where what is published of it goes.
    pub(super) sheet: Sheet,
    /// The submap in which it was touched last.
    pub(super) submap: SubmapId,
}

impl MapBlock {
    /// Nothing of it is known.
    pub(super) fn new(sheet: Sheet, submap: SubmapId) -> Self {
        Self {
            log_odds: [UNOBSERVED; BLOCK_VOXELS],
            seen: [0; BLOCK_VOXELS],
            states: StateBlock::default(),
            packed: StateBlock::default(),
            sheet,
            submap,
        }
    }

    pub(super) fn states(&self) -> &StateBlock {
        &self.states
    }

    pub(super) fn seen(&self, bit: usize) -> u16 {
        self.seen[bit]
    }

    /// Log-odds of a voxel, `None` if no ray has touched it.
    pub(super) fn log_odds(&self, bit: usize) -> Option<i16> {
        Some(self.log_odds[bit]).filter(|value| *value != UNOBSERVED)
    }

    /// Voxels whose state differs from what was packed last, with the state now. A voxel that has become Unknown
    /// is none of them.
    pub(super) fn changes(&self) -> StateBlock {
        self.states.minus(&self.packed)
    }

    pub(super) fn mark_packed(&mut self, changes: &StateBlock) {
        self.packed.overlay(changes);
    }

    /// Forgets which scan touched what before scan number `by`, and counts from there.
    pub(super) fn rebase_seen(&mut self, by: u16) {
        for seen in &mut self.seen {
            *seen = seen.saturating_sub(by);
        }
    }

    /// Sets the voxels of `mask` to these states, as if they had been seen so often that more would change
    /// nothing; the Unknown ones as if never.
    pub(super) fn set(&mut self, rules: &Rules, number: u16, states: &StateBlock, mask: &Plane) {
        for bit in set_bits(mask) {
            let state = states.get(bit);
            self.log_odds[bit] = match state {
                State::Unknown => UNOBSERVED,
                State::Free => rules.min.min(rules.free_below - 1),
                State::Occupied => rules.max.max(rules.occupied_from),
            };
            self.seen[bit] = number;
            self.states.set(bit, state);
        }
    }

    /// Takes in the counts of one scan. Returns the voxels that were touched.
    pub(super) fn update<T: Tally>(
        &mut self,
        rules: &Rules,
        scan: u16,
        misses: &T,
        hits: Option<&T>,
    ) -> Plane {
        dispatch!(Level::new(), simd => self.update_by(simd, rules, scan, misses, hits))
    }

    #[inline(always)]
    fn update_by<S: Simd, T: Tally>(
        &mut self,
        simd: S,
        rules: &Rules,
        scan: u16,
        misses: &T,
        hits: Option<&T>,
    ) -> Plane {
        let all = |value: i16| i16x16::splat(simd, value);
        let mut touched = [0u64; 8];
        let mut states_free = *self.states.free();
        let mut states_occupied = *self.states.occupied();
        let (log_odds, _) = self.log_odds.as_chunks_mut::<16>();
        let (seen, _) = self.seen.as_chunks_mut::<16>();
        for (n, (log_odds, seen)) in log_odds.iter_mut().zip(seen).enumerate() {
            let passed = misses.sixteen(simd, n, rules.rays_max);
            let ended = hits.map_or_else(|| all(0), |hits| hits.sixteen(simd, n, rules.hits_max));
            let (is_passed, is_ended) = (passed.simd_gt(all(0)), ended.simd_gt(all(0)));
            let is_touched = is_passed | is_ended;
            let bits = is_touched.to_bitmask();
            if bits == 0 {
                continue;
            }
            let before = i16x16::from_slice(simd, log_odds);
            let value = before.simd_eq(all(UNOBSERVED)).select(all(rules.start), before);
            // No overflow: the product is at most the width of the range of values and one miss, or one hit.
            let missed = (value + passed * all(rules.miss)).max(all(rules.min));
            let hit = (value + ended * all(rules.hit)).min(all(rules.max));
            // Hits win: the misses of the same scan do not count.
            let after = is_ended.select(hit, is_passed.select(missed, before));
            after.store_slice(log_odds);
            let seen_before = u16x16::from_slice(simd, seen);
            is_touched.select(u16x16::splat(simd, scan), seen_before).store_slice(seen);
            let occupied = after.simd_ge(all(rules.occupied_from)).to_bitmask();
            let is_free = after.simd_lt(all(rules.free_below)) & after.simd_gt(all(UNOBSERVED));
            let (word, shift) = (n / 4, n % 4 * 16);
            let keep = !(0xffff << shift);
            states_free[word] = states_free[word] & keep | is_free.to_bitmask() << shift;
            states_occupied[word] = states_occupied[word] & keep | occupied << shift;
            touched[word] |= bits << shift;
        }
        self.states = StateBlock::new(states_free, states_occupied);
        touched
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Resolution;
    use crate::mapper::config::{MapperConfig, Preset};
    use proptest::prelude::*;

    fn rules(preset: Preset) -> Rules {
        MapperConfig::preset(preset, Resolution::from_metres(0.1).unwrap(), 7.0).rules().unwrap()
    }

    /// The rules of `bases`, one voxel, in plain words.
    fn naive(preset: Preset, value: Option<f64>, misses: u16, hits: u16) -> Option<f64> {
        let log = |p: f64| (p / (1.0 - p)).ln();
        let (hit, miss, min, max, start) = match preset {
            Preset::RogMap => (log(0.9), log(0.49), log(0.12), log(0.98), 0.0),
            Preset::Racer => (log(0.9), log(0.48), log(0.1), log(0.98), log(0.8)),
            Preset::OctoMap => (log(0.7), log(0.4), log(0.1192), log(0.971), 0.0),
        };
        let (hits, misses) =
            if preset == Preset::RogMap { (hits, misses) } else { (hits.min(1), misses.min(1)) };
        if hits > 0 {
            Some((value.unwrap_or(start) + hit * f64::from(hits)).min(max))
        } else if misses > 0 {
            Some((value.unwrap_or(start) + miss * f64::from(misses)).max(min))
        } else {
            value
        }
    }

    proptest! {
        #[test]
        fn a_voxel_follows_the_rules_of_its_preset(
            preset in prop_oneof![Just(Preset::RogMap), Just(Preset::Racer), Just(Preset::OctoMap)],
            scans in prop::collection::vec((0u16..200, prop_oneof![4 => Just(0u16), 1 => 1u16..5]), 1..40),
            bit in 0..BLOCK_VOXELS,
        ) {
            let rules = rules(preset);
            let mut block = MapBlock::new(Sheet::FIRST, SubmapId::FIRST);
            let mut value = None;
            for (number, (misses, hits)) in scans.into_iter().enumerate() {
                let mut miss_counts = [0u16; BLOCK_VOXELS];
                let mut hit_counts = [0u16; BLOCK_VOXELS];
                miss_counts[bit] = misses;
                hit_counts[bit] = hits;
                let touched = block.update(&rules, number as u16 + 1, &miss_counts, Some(&hit_counts));
                prop_assert_eq!(touched.iter().map(|w| w.count_ones()).sum::<u32>(), u32::from(misses + hits != 0));
                value = naive(preset, value, misses, hits);
                match (block.log_odds(bit), value) {
                    (Some(units), Some(nats)) => {
                        // Every scan may round once for each ray; saturation forgets it.
                        let error = (f64::from(units) / 1024.0 - nats).abs();
                        prop_assert!(error < 0.2, "{preset}: {units} units, expected {nats} nats");
                    }
                    (None, None) => {}
                    other => prop_assert!(false, "{other:?}"),
                }
            }
        }
    }

    #[test]
    fn one_hit_occupies_and_one_miss_frees_as_in_rog_map() {
        let rules = rules(Preset::RogMap);
        let apply = |block: &mut MapBlock, misses: u16, hits: u16| {
            let (mut m, mut h) = ([0u16; BLOCK_VOXELS], [0; BLOCK_VOXELS]);
            (m[77], h[77]) = (misses, hits);
            block.update(&rules, 1, &m, Some(&h));
            block.states().get(77)
        };
        let mut block = MapBlock::new(Sheet::FIRST, SubmapId::FIRST);
        assert_eq!(apply(&mut block, 1, 0), State::Free);
        assert_eq!(apply(&mut block, 60, 1), State::Occupied);
        assert_eq!(apply(&mut block, 0, 9), State::Occupied);
        // From the top at 0.98, 54 misses clear it, and 44 more free it.
        assert_eq!(apply(&mut block, 53, 0), State::Occupied);
        assert_eq!(apply(&mut block, 1, 0), State::Unknown);
        assert_eq!(apply(&mut block, 43, 0), State::Unknown);
        assert_eq!(apply(&mut block, 1, 0), State::Free);
    }

    #[test]
    fn only_what_differs_from_what_was_packed_is_a_change() {
        let rules = rules(Preset::OctoMap);
        let mut block = MapBlock::new(Sheet::FIRST, SubmapId::FIRST);
        let apply = |block: &mut MapBlock, misses: u16, hits: u16| {
            let (mut m, mut h) = ([0u16; BLOCK_VOXELS], [0; BLOCK_VOXELS]);
            (m[0], h[0]) = (misses, hits);
            block.update(&rules, 1, &m, Some(&h));
        };
        apply(&mut block, 1, 0);
        let changes = block.changes();
        assert_eq!(changes.get(0), State::Free);
        block.mark_packed(&changes);
        assert!(block.changes().is_empty());
        for _ in 0..3 {
            apply(&mut block, 0, 1);
        }
        assert_eq!(block.changes().get(0), State::Occupied);
        for _ in 0..10 {
            apply(&mut block, 1, 0);
        }
        assert!(block.changes().is_empty(), "it flipped back: nothing to send");
    }
}
