//! What adapts while decisions are coded: the probabilities, and the weights with which they are mixed with the trained
//! sums.
//!
//! A package of changes begins as its tables say, so that it needs no other. The sections of a snapshot are read in
//! order, so each begins nearer to where those before it ended.

use super::flag_contexts::MIXED_FLAGS;
use super::mixing::{START, Weights};
use super::tables::{Probabilities, TableSet};
use fearless_simd::{Level, dispatch};
use flockmap_coder::Probability;

/// 39 KB.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub(crate) struct AdaptiveState {
    pub(crate) probabilities: Probabilities,
    pub(crate) weights: AllWeights,
}

/// The weights of each sort of decision that is mixed.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct AllWeights {
    pub(crate) voxel: Weights,
    pub(crate) kind: Weights,
    pub(crate) flags: [Weights; MIXED_FLAGS],
}

impl Default for AllWeights {
    fn default() -> Self {
        Self { voxel: START, kind: START, flags: [START; MIXED_FLAGS] }
    }
}

impl AdaptiveState {
    /// What a package of changes begins with, or a section of a snapshot after others; those count if they were coded with
    /// the same set of tables.
    pub(crate) fn begin(&mut self, set: TableSet, carried: Option<&CarriedState>) {
        match carried.and_then(|carried| carried.0.as_ref()) {
            Some((of_set, state)) if *of_set == set => self.copy_from(state),
            _ => {
                self.probabilities.copy_from(&set.tables().start);
                self.weights = AllWeights::default();
            }
        }
    }

    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.probabilities.copy_from(&other.probabilities);
        self.weights = other.weights.clone();
    }

    /// Goes a quarter of the way to another one. All of it would be too much: the end of a section is not like its
    /// beginning.
    fn approach(&mut self, other: &Self) {
        let (own, others) = (&mut self.probabilities, &other.probabilities);
        dispatch!(Level::new(), _simd => {
            approach(&mut own.voxel, &others.voxel);
            approach(&mut own.kind, &others.kind);
            approach(&mut own.flag, &others.flag);
        });
        let (own, others) = (&mut self.weights, &other.weights);
        own.voxel.approach(&others.voxel);
        own.kind.approach(&others.kind);
        own.flags.iter_mut().zip(&others.flags).for_each(|(own, other)| own.approach(other));
    }
}

/// A quarter of the way to others: never below the least of both, nor beyond.
#[inline(always)]
fn approach(own: &mut [Probability], others: &[Probability]) {
    own.iter_mut().zip(others).for_each(|(own, other)| *own = *own - (*own >> 2) + (*other >> 2));
}

/// What the next section of a snapshot begins with, and for which set of tables.
#[derive(Clone, Debug, Default)]
pub(crate) struct CarriedState(Option<(TableSet, Box<AdaptiveState>)>);

impl CarriedState {
    /// Bytes that it holds at most.
    pub(crate) const MEMORY_MAX: usize = size_of::<AdaptiveState>();

    /// Takes in how a section ended.
    pub(crate) fn note(&mut self, set: TableSet, at_end: &AdaptiveState) {
        if self.0.as_ref().is_none_or(|(of_set, _)| *of_set != set) {
            let mut state = Box::<AdaptiveState>::default();
            state.begin(set, None);
            self.0 = Some((set, state));
        }
        if let Some((_, state)) = &mut self.0 {
            state.approach(at_end);
        }
    }

    /// Bytes that it holds.
    pub(crate) fn memory_bytes(&self) -> usize {
        self.0.as_ref().map_or(0, |_| Self::MEMORY_MAX)
    }
}

/// What a writer of sections carries from one to the next.
#[derive(Default)]
pub(crate) struct Carry {
    pub(crate) state: CarriedState,
    /// At the end of the section that was written last.
    pub(crate) at_end: Box<AdaptiveState>,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every probability of voxels is this.
    fn all(set: TableSet, probability: Probability) -> AdaptiveState {
        let mut state = next(&CarriedState::default(), set);
        state.probabilities.voxel.fill(probability);
        state
    }

    fn next(carried: &CarriedState, set: TableSet) -> AdaptiveState {
        let mut state = AdaptiveState::default();
        state.begin(set, Some(carried));
        state
    }

    #[test]
    fn each_section_begins_a_quarter_nearer_to_where_the_one_before_it_ended() {
        let set = TableSet::Sparse;
        let mut carried = CarriedState::default();
        let begun = next(&carried, set);
        assert_eq!((&begun.probabilities, &begun.weights), (&*set.tables().start, &AllWeights::default()));
        for probability in [1, u16::MAX, 77] {
            let (from, at_end) = (next(&carried, set), all(set, probability));
            carried.note(set, &at_end);
            let to = next(&carried, set);
            for (from, to) in from.probabilities.voxel.iter().zip(&to.probabilities.voxel) {
                let quarter = (f64::from(*from) * 3.0 + f64::from(probability)) / 4.0;
                assert!((f64::from(*to) - quarter).abs() < 1.0, "{from} and {probability}: {to}");
            }
            assert_eq!(to.probabilities.kind, begun.probabilities.kind, "these had not changed");
        }
        // However often, a probability is never nothing.
        (0..50).for_each(|_| carried.note(set, &all(set, 1)));
        assert!(
            next(&carried, set).probabilities.voxel.iter().all(|probability| (1..8).contains(probability))
        );
        (0..50).for_each(|_| carried.note(set, &all(set, u16::MAX)));
        let highest = u16::MAX - 7..=u16::MAX;
        assert!(
            next(&carried, set).probabilities.voxel.iter().all(|probability| highest.contains(probability))
        );
    }

    #[test]
    fn another_set_of_tables_begins_anew() {
        let mut carried = CarriedState::default();
        carried.note(TableSet::Dense, &all(TableSet::Dense, 1));
        assert_eq!(next(&carried, TableSet::Free), next(&CarriedState::default(), TableSet::Free));
        carried.note(TableSet::Free, &all(TableSet::Free, 1));
        assert_eq!(next(&carried, TableSet::Dense), next(&CarriedState::default(), TableSet::Dense));
        assert_ne!(next(&carried, TableSet::Free), next(&CarriedState::default(), TableSet::Free));
    }
}
