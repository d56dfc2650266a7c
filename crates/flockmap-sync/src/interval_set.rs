//! Sets of package indices as sorted closed intervals: the paper's index lists.

use core::fmt;

/// A set of `u32` indices, held as ascending closed intervals that neither overlap nor touch.
///
/// Memory: 8 bytes an interval. Inserting never makes more than [`intervals_max`](Self::new) intervals; the
/// set operations make at most as many as their two inputs have together.
///
/// ```
/// use flockmap_sync::IntervalSet;
/// let mut held = IntervalSet::new(16);
/// held.insert_range(1, 4)?;
/// held.insert(7)?;
/// assert_eq!(held.missing(1, 9).collect::<Vec<_>>(), [(5, 6), (8, 9)]);
/// assert_eq!(held.prefix(), 4);
/// # Ok::<(), flockmap_sync::TooFragmented>(())
/// ```
#[derive(Clone)]
pub struct IntervalSet {
    intervals: Vec<(u32, u32)>,
    intervals_max: usize,
}

/// An insertion was refused because the set would have needed more intervals than it may have.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error("the set would need more than {intervals_max} intervals; fill some of its gaps first")]
pub struct TooFragmented {
    /// The bound of the set.
    pub intervals_max: usize,
}

impl IntervalSet {
    /// An empty set that never grows beyond `intervals_max` intervals by insertion.
    pub const fn new(intervals_max: usize) -> Self {
        Self { intervals: Vec::new(), intervals_max }
    }

    /// The set of all indices of these closed intervals, which may come in any order, overlap and touch.
    /// Intervals with their ends swapped are empty. O(n log n).
    pub fn from_intervals(intervals_max: usize, mut intervals: Vec<(u32, u32)>) -> Self {
        intervals.retain(|(low, high)| low <= high);
        intervals.sort_unstable();
        let mut merged: Vec<(u32, u32)> = Vec::with_capacity(intervals.len());
        for (low, high) in intervals {
            match merged.last_mut() {
                Some(last) if low <= last.1.saturating_add(1) => last.1 = last.1.max(high),
                _ => merged.push((low, high)),
            }
        }
        Self { intervals: merged, intervals_max }
    }

    /// The same set with another bound. More intervals than that it keeps, and takes no further ones.
    pub fn with_room(&self, intervals_max: usize) -> Self {
        Self { intervals: self.intervals.clone(), intervals_max }
    }

    /// Adds one index; whether it was new. O(log n) to find the place, O(n) to make room for an interval.
    pub fn insert(&mut self, index: u32) -> Result<bool, TooFragmented> {
        self.insert_range(index, index)
    }

    /// Adds every index from `low` to `high`, both included; whether any of them was new.
    /// Refused, with nothing changed, if the set would then have too many intervals. O(n).
    pub fn insert_range(&mut self, low: u32, high: u32) -> Result<bool, TooFragmented> {
        if low > high || self.contains_range(low, high) {
            return Ok(false);
        }
        // Every interval that overlaps or touches low..=high melts into one.
        let start = self.intervals.partition_point(|&(_, h)| h.saturating_add(1) < low);
        let end = self.intervals.partition_point(|&(l, _)| l <= high.saturating_add(1));
        if start == end && self.intervals.len() >= self.intervals_max {
            return Err(TooFragmented { intervals_max: self.intervals_max });
        }
        let melted = self.intervals[start..end]
            .iter()
            .fold((low, high), |melted, &(l, h)| (melted.0.min(l), melted.1.max(h)));
        self.intervals.splice(start..end, [melted]);
        Ok(true)
    }

    /// Whether [`insert`](Self::insert) of this index would not be refused. O(log n).
    pub fn has_room_for(&self, index: u32) -> bool {
        let (low, high) = (index.saturating_sub(1), index.saturating_add(1));
        self.intervals.len() < self.intervals_max || self.missing(low, high).ne([(low, high)])
    }

    /// Whether the index is in the set. O(log n).
    pub fn contains(&self, index: u32) -> bool {
        self.contains_range(index, index)
    }

    /// Whether every index from `low` to `high` is in the set; true for an empty range. O(log n).
    pub fn contains_range(&self, low: u32, high: u32) -> bool {
        if low > high {
            return true;
        }
        let at = self.intervals.partition_point(|&(_, h)| h < low);
        self.intervals.get(at).is_some_and(|&(l, h)| l <= low && high <= h)
    }

    /// Number of indices in the set. O(n).
    pub fn count(&self) -> u64 {
        self.intervals.iter().map(|&(low, high)| u64::from(high - low) + 1).sum()
    }

    /// Whether the set is empty.
    pub fn is_empty(&self) -> bool {
        self.intervals.is_empty()
    }

    /// The lowest index.
    pub fn first(&self) -> Option<u32> {
        self.intervals.first().map(|i| i.0)
    }

    /// The highest index.
    pub fn last(&self) -> Option<u32> {
        self.intervals.last().map(|i| i.1)
    }

    /// The highest `n` such that 1, 2 … `n` are all in the set; 0 if 1 is not.
    pub fn prefix(&self) -> u32 {
        self.intervals
            .iter()
            .find(|&&(_, high)| high >= 1)
            .map_or(0, |&(low, high)| if low <= 1 { high } else { 0 })
    }

    /// The intervals in ascending order, ends included.
    pub fn intervals(&self) -> &[(u32, u32)] {
        &self.intervals
    }

    /// What is not in the set of the indices `low` to `high`, as ascending closed intervals.
    pub fn missing(&self, low: u32, high: u32) -> impl DoubleEndedIterator<Item = (u32, u32)> + '_ {
        let start = self.intervals.partition_point(|&(_, h)| h < low);
        let end = self.intervals.partition_point(|&(l, _)| l <= high).max(start);
        // The gap before interval i, for i in start..=end; the one before `end` reaches up to `high`.
        (start..=end).filter_map(move |i| {
            let gap_low = if i == start { low } else { self.intervals[i - 1].1.checked_add(1)?.max(low) };
            let gap_high = if i == end { high } else { self.intervals[i].0.checked_sub(1)? };
            (gap_low <= gap_high).then_some((gap_low, gap_high))
        })
    }

    /// The indices of this set that are not in `other`. O(n).
    pub fn difference(&self, other: &Self) -> Self {
        let intervals = self.intervals.iter().flat_map(|&(low, high)| other.missing(low, high)).collect();
        Self { intervals, intervals_max: self.intervals_max }
    }

    /// The indices that are in both sets. O(n).
    pub fn intersection(&self, other: &Self) -> Self {
        let (mut a, mut b) = (self.intervals.iter().peekable(), other.intervals.iter().peekable());
        let mut intervals = Vec::new();
        while let (Some(&&(a_low, a_high)), Some(&&(b_low, b_high))) = (a.peek(), b.peek()) {
            let (low, high) = (a_low.max(b_low), a_high.min(b_high));
            if low <= high {
                intervals.push((low, high));
            }
            if a_high < b_high {
                a.next()
            } else {
                b.next()
            };
        }
        Self { intervals, intervals_max: self.intervals_max }
    }

    /// The indices that are in either set. O(n log n).
    pub fn union(&self, other: &Self) -> Self {
        Self::from_intervals(self.intervals_max, [&self.intervals[..], &other.intervals[..]].concat())
    }

    /// The indices of this set from `low` to `high`.
    pub fn within(&self, low: u32, high: u32) -> Self {
        self.intersection(&Self { intervals: vec![(low, high)], intervals_max: 1 }.sane())
    }

    /// Keeps only the `count` highest intervals; the lowest index about which the set still speaks
    /// (0 if nothing was cut).
    pub fn keep_newest(&mut self, count: usize) -> u32 {
        let Some(cut) = self.intervals.len().checked_sub(count).filter(|&cut| cut > 0) else { return 0 };
        let last_cut = self.intervals[cut - 1].1;
        self.intervals.drain(..cut);
        last_cut.saturating_add(1)
    }

    fn sane(mut self) -> Self {
        self.intervals.retain(|(low, high)| low <= high);
        self
    }
}

/// Two sets are equal if they hold the same indices, whatever their bounds.
impl PartialEq for IntervalSet {
    fn eq(&self, other: &Self) -> bool {
        self.intervals == other.intervals
    }
}

impl Eq for IntervalSet {}

impl fmt::Debug for IntervalSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("{")?;
        for (i, (low, high)) in self.intervals.iter().enumerate() {
            let comma = if i == 0 { "" } else { ", " };
            if low == high { write!(f, "{comma}{low}")? } else { write!(f, "{comma}{low}–{high}")? }
        }
        f.write_str("}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    fn ranges() -> impl Strategy<Value = Vec<(u32, u32)>> {
        prop::collection::vec((0..120u32, 0..9u32).prop_map(|(low, len)| (low, low + len)), 0..25)
    }

    fn both(ranges: &[(u32, u32)]) -> (IntervalSet, BTreeSet<u32>) {
        let mut set = IntervalSet::new(1000);
        let mut model = BTreeSet::new();
        for &(low, high) in ranges {
            let is_new = set.insert_range(low, high).unwrap();
            let before = model.len();
            model.extend(low..=high);
            assert_eq!(is_new, model.len() > before);
        }
        (set, model)
    }

    fn members(set: &IntervalSet) -> BTreeSet<u32> {
        assert!(set.intervals().windows(2).all(|w| u64::from(w[0].1) + 1 < u64::from(w[1].0)), "{set:?}");
        set.intervals().iter().flat_map(|&(low, high)| low..=high).collect()
    }

    proptest! {
        #[test]
        fn agrees_with_a_set_of_integers(ranges in ranges(), low in 0..130u32, len in 0..40u32) {
            let (set, model) = both(&ranges);
            prop_assert_eq!(&members(&set), &model);
            prop_assert_eq!(set.count(), model.len() as u64);
            prop_assert_eq!(set.first(), model.first().copied());
            prop_assert_eq!(set.last(), model.last().copied());
            prop_assert_eq!(set.prefix(), (1..).take_while(|i| model.contains(i)).last().unwrap_or(0));
            let high = low + len;
            prop_assert_eq!(set.contains(low), model.contains(&low));
            prop_assert_eq!(set.contains_range(low, high), (low..=high).all(|i| model.contains(&i)));
            let missing: BTreeSet<u32> = set.missing(low, high).flat_map(|(l, h)| l..=h).collect();
            prop_assert_eq!(missing, (low..=high).filter(|i| !model.contains(i)).collect::<BTreeSet<_>>());
            prop_assert_eq!(members(&set.within(low, high)), model.range(low..=high).copied().collect());
            prop_assert_eq!(&IntervalSet::from_intervals(1000, ranges), &set);
        }

        #[test]
        fn set_operations_agree_with_sets_of_integers(a in ranges(), b in ranges()) {
            let ((set_a, model_a), (set_b, model_b)) = (both(&a), both(&b));
            prop_assert_eq!(members(&set_a.difference(&set_b)), &model_a - &model_b);
            prop_assert_eq!(members(&set_a.intersection(&set_b)), &model_a & &model_b);
            prop_assert_eq!(members(&set_a.union(&set_b)), &model_a | &model_b);
        }

        #[test]
        fn never_has_more_intervals_than_allowed(ranges in ranges(), intervals_max in 1..6usize) {
            let mut set = IntervalSet::new(intervals_max);
            for (low, high) in ranges {
                let before = set.clone();
                prop_assert_eq!(set.has_room_for(low), set.clone().insert(low).is_ok());
                if set.insert_range(low, high).is_err() {
                    prop_assert_eq!(&set, &before);
                }
                prop_assert!(set.intervals().len() <= intervals_max);
            }
        }

        #[test]
        fn keeps_the_newest(ranges in ranges(), count in 0..6usize) {
            let (set, model) = both(&ranges);
            let mut cut = set;
            let from = cut.keep_newest(count);
            prop_assert!(cut.intervals().len() <= count);
            prop_assert_eq!(members(&cut), model.into_iter().filter(|&i| i >= from).collect());
        }
    }

    #[test]
    fn works_at_both_ends_of_the_range() {
        let mut set = IntervalSet::new(4);
        set.insert(u32::MAX).unwrap();
        set.insert(0).unwrap();
        set.insert_range(u32::MAX - 2, u32::MAX - 1).unwrap();
        assert_eq!(set.intervals(), [(0, 0), (u32::MAX - 2, u32::MAX)]);
        assert_eq!(set.missing(0, u32::MAX).collect::<Vec<_>>(), [(1, u32::MAX - 3)]);
        set.insert_range(0, u32::MAX).unwrap();
        assert_eq!(set.count(), 1 << 32);
        assert_eq!(set.missing(0, u32::MAX).count(), 0);
    }
}
