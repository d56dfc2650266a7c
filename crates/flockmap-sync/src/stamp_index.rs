//! When packages of a stream were made, for as long as it lasts and in little memory.

use flockmap_grid::Stamp;
use std::collections::BTreeMap;

/// Packages of one stream whose stamps are remembered; of more, one is forgotten whose neighbours are nearest to each
/// other, so that they lie evenly over the whole stream. Worst case 16 KiB.
const STAMPS_MAX: usize = 512;

/// Stamps of some packages of a stream. Stamps do not descend from one package to the next, so the one of an
/// earlier package is a lower bound.
#[derive(Debug, Default)]
pub(crate) struct StampIndex(BTreeMap<u32, Stamp>);

impl StampIndex {
    pub(crate) const fn new() -> Self {
        Self(BTreeMap::new())
    }

    /// Notes the stamp of a package.
    pub(crate) fn note(&mut self, index: u32, stamp: Stamp) {
        // Of one batch the first package is enough.
        if self.0.range(..=index).next_back().is_some_and(|(_, known)| *known == stamp) {
            return;
        }
        if let Some((&later, &known)) = self.0.range(index..).next()
            && known == stamp
        {
            self.0.remove(&later);
        }
        self.0.insert(index, stamp);
        if self.0.len() > STAMPS_MAX {
            self.forget_one();
        }
    }

    fn forget_one(&mut self) {
        let indices = self.0.keys();
        let between = indices.clone().zip(indices.clone().skip(1)).zip(indices.skip(2));
        let nearest = between.min_by_key(|((before, _), after)| **after - **before);
        if let Some(((_, &index), _)) = nearest {
            self.0.remove(&index);
        }
    }

    /// The first package that is known to be newer than a stamp, with all after it. O(stamps).
    pub(crate) fn first_after(&self, stamp: Stamp) -> Option<u32> {
        self.0.iter().find(|(_, known)| **known > stamp).map(|(index, _)| *index)
    }

    /// The packages that are known, with their stamps, as far as these do not descend. O(stamps).
    pub(crate) fn points(&self) -> impl Iterator<Item = (u32, Stamp)> + '_ {
        self.0.iter().map(|(index, stamp)| (*index, *stamp))
    }

    /// A stamp that no package from `index` on is older than, as late as is known. `None` if nothing is known
    /// of any up to that one.
    pub(crate) fn not_after(&self, index: u32) -> Option<Stamp> {
        self.0.range(..=index).next_back().map(|(_, stamp)| *stamp)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_a_long_stream_they_lie_evenly() {
        let mut stamp_index = StampIndex::new();
        for index in 1..=100_000u32 {
            stamp_index.note(index, Stamp(i64::from(index)));
        }
        let points: Vec<u32> = stamp_index.points().map(|(index, _)| index).collect();
        assert_eq!((points.len(), points[0], points[STAMPS_MAX - 1]), (STAMPS_MAX, 1, 100_000));
        let widest = points.windows(2).map(|pair| pair[1] - pair[0]).max();
        assert!(widest <= Some(2 * 100_000 / STAMPS_MAX as u32 + 2), "{widest:?}");
    }

    #[test]
    fn the_stamp_is_never_after_that_of_the_package_and_the_first_ones_stay() {
        // Three packages a batch, every fifth package never seen, in an order of its own.
        let stamp = |index: u32| Stamp(i64::from(index / 3) * 500_000);
        let mut stamp_index = StampIndex::new();
        for step in 0..10_007u32 {
            let index = step * 4_001 % 10_007 + 1;
            if index % 5 != 0 {
                stamp_index.note(index, stamp(index));
            }
            assert!(stamp_index.0.len() <= STAMPS_MAX);
        }
        for index in 1..20_000 {
            let found = stamp_index.not_after(index).unwrap();
            assert!(found <= stamp(index), "{index}");
            // Even after thinning it is near.
            assert!(index > 10_007 || found.0 + 500_000 * 40 > stamp(index).0, "{index}: {found:?}");
        }
        assert_eq!(stamp_index.not_after(0), None);
    }
}
