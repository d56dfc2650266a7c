//! What decisions teach: the adaptive probabilities, and the weights with which they are mixed with the trained sums.
//!
//! A package of changes begins as its tables say, so that it needs no other. The sections of a snapshot are read in
//! order, so each begins nearer to where those before it ended.

use super::flag_contexts::MIXED_FLAGS;
use super::mixing::{START, Weights};
use super::tables::{Probabilities, TableSet, Tables};
use fearless_simd::{Level, dispatch};
use flockmap_coder::Probability;

/// 39 KB.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub(crate) struct Learned {
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

impl Learned {
    /// What a package of changes begins with.
    pub(crate) fn begin(&mut self, tables: &Tables) {
        self.probabilities.copy(&tables.start);
        self.weights = AllWeights::default();
    }

    /// As another one.
    pub(crate) fn copy(&mut self, other: &Self) {
        self.probabilities.copy(&other.probabilities);
        self.weights = other.weights.clone();
    }

    /// Goes a quarter of the way to another one. All of it would be too much: the end of a section is not like its
    /// beginning.
    fn approach(&mut self, other: &Self) {
        let (own, other_of) = (&mut self.probabilities, &other.probabilities);
        dispatch!(Level::new(), _simd => {
            nearer(&mut own.voxel, &other_of.voxel);
            nearer(&mut own.kind, &other_of.kind);
            nearer(&mut own.flag, &other_of.flag);
        });
        let (own, other_of) = (&mut self.weights, &other.weights);
        own.voxel.approach(&other_of.voxel);
        own.kind.approach(&other_of.kind);
        own.flags.iter_mut().zip(&other_of.flags).for_each(|(own, other)| own.approach(other));
    }
}

/// A quarter of the way to others: never below the least of both, nor beyond.
#[inline(always)]
fn nearer(own: &mut [Probability], others: &[Probability]) {
    own.iter_mut().zip(others).for_each(|(own, other)| *own = *own - (*own >> 2) + (*other >> 2));
}

fn begun(set: TableSet) -> Box<Learned> {
    let mut learned = Box::<Learned>::default();
    learned.begin(set.tables());
    learned
}

/// What the sections of a snapshot so far have taught, and for which set of tables.
#[derive(Clone, Debug, Default)]
pub(crate) struct Taught(Option<(TableSet, Box<Learned>)>);

impl Taught {
    /// What the next section begins with if it uses this set: nothing was learned if the last one used another.
    pub(crate) fn begin(&self, set: TableSet, learned: &mut Learned) {
        match &self.0 {
            Some((of_set, taught)) if *of_set == set => learned.copy(taught),
            _ => learned.begin(set.tables()),
        }
    }

    /// Takes in what a section had learned at its end.
    pub(crate) fn learn(&mut self, set: TableSet, at_end: &Learned) {
        let (of_set, taught) = self.0.get_or_insert_with(|| (set, begun(set)));
        if *of_set != set {
            (*of_set, *taught) = (set, begun(set));
        }
        taught.approach(at_end);
    }

    /// Bytes that it holds: those of a [`Learned`] at most.
    pub(crate) fn memory_bytes(&self) -> usize {
        self.0.as_ref().map_or(0, |_| size_of::<Learned>())
    }
}

/// What a writer knows of it.
#[derive(Default)]
pub(crate) struct Teaching {
    pub(crate) taught: Taught,
    /// At the end of the section that was written last.
    pub(crate) at_end: Box<Learned>,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every probability of voxels is this.
    fn all(set: TableSet, probability: Probability) -> Learned {
        let mut learned = *begun(set);
        learned.probabilities.voxel.fill(probability);
        learned
    }

    fn next(taught: &Taught, set: TableSet) -> Learned {
        let mut learned = Learned::default();
        taught.begin(set, &mut learned);
        learned
    }

    #[test]
    fn each_section_begins_a_quarter_nearer_to_where_the_one_before_it_ended() {
        let set = TableSet::Sparse;
        let mut taught = Taught::default();
        let begun = next(&taught, set);
        assert_eq!(begun, *super::begun(set));
        for probability in [1, u16::MAX, 77] {
            let (from, at_end) = (next(&taught, set), all(set, probability));
            taught.learn(set, &at_end);
            let to = next(&taught, set);
            for (from, to) in from.probabilities.voxel.iter().zip(&to.probabilities.voxel) {
                let quarter = (f64::from(*from) * 3.0 + f64::from(probability)) / 4.0;
                assert!((f64::from(*to) - quarter).abs() < 1.0, "{from} and {probability}: {to}");
            }
            assert_eq!(to.probabilities.kind, begun.probabilities.kind, "these had not changed");
        }
        // However often, a probability is never nothing.
        (0..50).for_each(|_| taught.learn(set, &all(set, 1)));
        assert!(
            next(&taught, set).probabilities.voxel.iter().all(|probability| (1..8).contains(probability))
        );
        (0..50).for_each(|_| taught.learn(set, &all(set, u16::MAX)));
        let highest = u16::MAX - 7..=u16::MAX;
        assert!(
            next(&taught, set).probabilities.voxel.iter().all(|probability| highest.contains(probability))
        );
    }

    #[test]
    fn another_set_of_tables_begins_anew() {
        let mut taught = Taught::default();
        taught.learn(TableSet::Dense, &all(TableSet::Dense, 1));
        assert_eq!(next(&taught, TableSet::Free), *begun(TableSet::Free));
        taught.learn(TableSet::Free, &all(TableSet::Free, 1));
        assert_eq!(next(&taught, TableSet::Dense), *begun(TableSet::Dense));
        assert_ne!(next(&taught, TableSet::Free), *begun(TableSet::Free));
    }
}
