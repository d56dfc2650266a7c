//! What is measured while a swarm runs: bytes over time, ages, times.

use std::collections::BTreeMap;

use flockmap::grid::{BlockIndex, Changes, Layer, StateBlock};
use flockmap::{Stamp, State};
use flockmap_node::Histogram;
use serde::Serialize;

/// KB are 1,024 bytes.
pub const KB: f64 = 1024.0;

/// Bytes that a sender put out, when.
#[derive(Clone, Debug, Default)]
pub struct SentBytes {
    events: Vec<(i64, u64)>,
}

impl SentBytes {
    /// Bytes that went out now. Times must not run backwards.
    pub fn add(&mut self, now: Stamp, bytes: u64) {
        match self.events.last_mut() {
            Some(last) if last.0 >= now.0 => last.1 += bytes,
            _ => self.events.push((now.0, bytes)),
        }
    }

    /// All bytes.
    pub fn total(&self) -> u64 {
        self.events.iter().map(|(_, bytes)| bytes).sum()
    }

    /// Most bytes in any window of one second.
    pub fn largest_second(&self) -> u64 {
        let (mut first, mut sum, mut largest) = (0, 0, 0);
        for (at, bytes) in &self.events {
            sum += bytes;
            while let Some((old, bytes)) = self.events.get(first)
                && at - old >= 1_000_000
            {
                sum -= bytes;
                first += 1;
            }
            largest = largest.max(sum);
        }
        largest
    }

    /// Bytes in each second from 0 on.
    pub fn per_second(&self) -> Vec<u64> {
        let mut seconds = Vec::new();
        for (at, bytes) in &self.events {
            let second = (at.max(&0) / 1_000_000) as usize;
            if seconds.len() <= second {
                seconds.resize(second + 1, 0);
            }
            seconds[second] += bytes;
        }
        seconds
    }

    /// The sums of several senders together.
    pub fn together<'a>(senders: impl IntoIterator<Item = &'a Self>) -> Self {
        let mut events: Vec<_> = senders.into_iter().flat_map(|sent| sent.events.iter().copied()).collect();
        events.sort_unstable();
        let mut sum = Self::default();
        for (at, bytes) in events {
            sum.add(Stamp(at), bytes);
        }
        sum
    }
}

/// Bytes of IPv4 and UDP before each datagram.
pub const IP_UDP_BYTES: u64 = flockmap_netsim::IP_UDP_BYTES as u64;

/// Datagrams that a sender put out: what is in them, and what they are on the wire with IP and UDP headers.
#[derive(Clone, Debug, Default)]
pub struct SentDatagrams {
    /// UDP payload.
    pub payload: SentBytes,
    /// The same with IP and UDP headers.
    pub wire: SentBytes,
    pub datagrams: u64,
}

impl SentDatagrams {
    /// Payload that went out now in so many datagrams. Times must not run backwards.
    pub fn add(&mut self, now: Stamp, payload: u64, datagrams: u64) {
        self.payload.add(now, payload);
        self.wire.add(now, payload + datagrams * IP_UDP_BYTES);
        self.datagrams += datagrams;
    }

    /// The sums of several senders together.
    pub fn together<'a>(senders: impl IntoIterator<Item = &'a Self> + Clone) -> Self {
        Self {
            payload: SentBytes::together(senders.clone().into_iter().map(|sent| &sent.payload)),
            wire: SentBytes::together(senders.clone().into_iter().map(|sent| &sent.wire)),
            datagrams: senders.into_iter().map(|sent| sent.datagrams).sum(),
        }
    }
}

/// Durations in milliseconds, measured by the clock of this machine.
#[derive(Clone, Debug, Default)]
pub struct Times(pub Vec<f64>);

/// Mean and 99 % of durations.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct TimeSummary {
    pub count: usize,
    pub mean_ms: f64,
    pub median_ms: f64,
    pub p99_ms: f64,
}

impl TimeSummary {
    /// Of all that these hold together; they count microseconds.
    pub fn of_histograms<'a>(histograms: impl IntoIterator<Item = &'a Histogram>) -> Self {
        let mut histograms = histograms.into_iter();
        let Some(mut all) = histograms.next().cloned() else { return Self::default() };
        histograms.for_each(|histogram| all += histogram);
        Self {
            count: all.len() as usize,
            mean_ms: all.mean() / 1e3,
            median_ms: all.value_at_quantile(0.5) as f64 / 1e3,
            p99_ms: all.value_at_quantile(0.99) as f64 / 1e3,
        }
    }
}

impl Times {
    pub fn add(&mut self, duration: std::time::Duration) {
        self.0.push(duration.as_secs_f64() * 1e3);
    }

    pub fn summary(&self) -> TimeSummary {
        let mut sorted = self.0.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| {
            let rank = (share * sorted.len() as f64).ceil() as usize;
            sorted.get(rank.max(1) - 1).copied().unwrap_or_default()
        };
        TimeSummary {
            count: sorted.len(),
            mean_ms: sorted.iter().sum::<f64>() / sorted.len().max(1) as f64,
            median_ms: at(0.5),
            p99_ms: at(0.99),
        }
    }
}

/// Ages of voxels in whole milliseconds; one of more than ten minutes counts as ten minutes.
#[derive(Clone, Debug, Default)]
pub struct Ages {
    counts: Vec<u64>,
}

const AGE_MS_MAX: i64 = 600_000;

/// Median and 99 % of ages.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct AgeSummary {
    pub voxels: u64,
    pub median_s: f64,
    pub p99_s: f64,
    pub max_s: f64,
}

impl Ages {
    fn add(&mut self, micros: i64) {
        let ms = (micros / 1_000).clamp(0, AGE_MS_MAX) as usize;
        if self.counts.len() <= ms {
            self.counts.resize(ms + 1, 0);
        }
        self.counts[ms] += 1;
    }

    pub fn merge(&mut self, other: &Self) {
        if self.counts.len() < other.counts.len() {
            self.counts.resize(other.counts.len(), 0);
        }
        for (sum, count) in self.counts.iter_mut().zip(&other.counts) {
            *sum += count;
        }
    }

    pub fn summary(&self) -> AgeSummary {
        let voxels: u64 = self.counts.iter().sum();
        let at = |share: f64| {
            let rank = (share * voxels as f64).ceil().max(1.0) as u64;
            let mut seen = 0;
            let ms = self.counts.iter().position(|count| {
                seen += count;
                seen >= rank
            });
            ms.unwrap_or(0) as f64 / 1e3
        };
        AgeSummary { voxels, median_s: at(0.5), p99_s: at(0.99), max_s: at(1.0) }
    }
}

/// Ages of obstacles and of free space.
#[derive(Clone, Debug, Default)]
pub struct AgesByState {
    pub occupied: Ages,
    pub free: Ages,
}

impl AgesByState {
    /// Counts the age of each voxel of a package that was merged now: time since the scan that gave the voxel
    /// the state that it still has in its robot's map. `onset` holds when that was.
    pub fn add(&mut self, now: Stamp, merged: &Changes, onset: &Layer) {
        for (voxel, state) in merged.voxels() {
            if let Some((still, since)) = onset.get(voxel)
                && still == state
            {
                let ages = if state == State::Occupied { &mut self.occupied } else { &mut self.free };
                ages.add(now.micros_since(since));
            }
        }
    }

    pub fn merge(&mut self, other: &Self) {
        self.occupied.merge(&other.occupied);
        self.free.merge(&other.free);
    }
}

/// How far two maps are the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Comparison {
    /// Voxels that are known in either.
    pub known: u64,
    /// Voxels that have the same state in both.
    pub equal: u64,
}

impl Comparison {
    /// Counts the voxels of two blocks at the same place.
    pub fn add(&mut self, ours: &StateBlock, theirs: &StateBlock) {
        let (a, b) = (ours.known(), theirs.known());
        for z in 0..8 {
            self.known += u64::from((a[z] | b[z]).count_ones());
            let equal = ours.free()[z] & theirs.free()[z] | ours.occupied()[z] & theirs.occupied()[z];
            self.equal += u64::from(equal.count_ones());
        }
    }

    /// Takes in what was counted elsewhere.
    pub const fn merge(&mut self, other: Self) {
        self.known += other.known;
        self.equal += other.equal;
    }

    /// Two maps, voxel by voxel.
    pub fn of(ours: impl IntoIterator<Item = Block>, theirs: impl IntoIterator<Item = Block>) -> Self {
        let mut comparison = Self::default();
        side_by_side(ours, theirs).values().for_each(|[ours, theirs]| comparison.add(ours, theirs));
        comparison
    }

    /// Two layers, voxel by voxel.
    pub fn of_layers(ours: &Layer, theirs: &Layer) -> Self {
        Self::of(blocks_of(ours), blocks_of(theirs))
    }

    /// Share of equal voxels, 0 to 1; 1 if nothing is known.
    pub fn share(&self) -> f64 {
        if self.known == 0 { 1.0 } else { self.equal as f64 / self.known as f64 }
    }
}

/// A block of a map and its place.
pub type Block = (BlockIndex, StateBlock);

/// The blocks of a layer.
pub fn blocks_of(layer: &Layer) -> impl Iterator<Item = Block> {
    layer.blocks()
}

/// The blocks of two maps by place; where one has none, nothing is known.
pub fn side_by_side(
    ours: impl IntoIterator<Item = Block>,
    theirs: impl IntoIterator<Item = Block>,
) -> BTreeMap<BlockIndex, [StateBlock; 2]> {
    let mut blocks = BTreeMap::<_, [StateBlock; 2]>::new();
    ours.into_iter().for_each(|(index, block)| blocks.entry(index).or_default()[0] = block);
    theirs.into_iter().for_each(|(index, block)| blocks.entry(index).or_default()[1] = block);
    blocks
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::Voxel;

    #[test]
    fn the_largest_second_slides() {
        let mut sent = SentBytes::default();
        for (ms, bytes) in [(0, 10), (900, 20), (1_100, 30), (1_899, 40), (1_900, 5), (5_000, 60)] {
            sent.add(Stamp(ms * 1_000), bytes);
        }
        assert_eq!(sent.total(), 165);
        assert_eq!(sent.largest_second(), 20 + 30 + 40);
        assert_eq!(sent.per_second(), [30, 75, 0, 0, 0, 60]);
        assert_eq!(SentBytes::together([&sent, &sent]).largest_second(), 180);
    }

    #[test]
    fn percentiles_are_of_the_values() {
        let times = Times((1..=100).map(f64::from).collect());
        let summary = times.summary();
        assert_eq!((summary.count, summary.median_ms, summary.p99_ms), (100, 50.0, 99.0));
        assert_eq!(summary.mean_ms, 50.5);
        assert_eq!(Times::default().summary().p99_ms, 0.0);
    }

    #[test]
    fn the_age_of_a_voxel_counts_from_the_scan_that_set_it() {
        let voxel = Voxel::new(1, 2, 3);
        let changes = Changes::from_voxels([(voxel, State::Occupied)]);
        let mut onset = Layer::default();
        onset.apply(&changes, Stamp(1_000_000));
        let mut ages = AgesByState::default();
        ages.add(Stamp(1_250_000), &changes, &onset);
        assert_eq!(ages.occupied.summary().median_s, 0.25);
        // Its robot has seen it free since: the age of "occupied" is no use to anybody.
        onset.apply(&Changes::from_voxels([(voxel, State::Free)]), Stamp(1_100_000));
        ages.add(Stamp(1_250_000), &changes, &onset);
        assert_eq!((ages.occupied.summary().voxels, ages.free.summary().voxels), (1, 0));
    }

    #[test]
    fn one_wrong_voxel_is_seen() {
        let layer = |state| {
            let mut layer = Layer::default();
            layer.apply(&Changes::from_voxels([(Voxel::new(9, 9, 9), state)]), Stamp(1));
            layer.apply(&Changes::from_voxels([(Voxel::new(-9, 9, 9), State::Free)]), Stamp(1));
            layer
        };
        assert_eq!(Comparison::of_layers(&layer(State::Free), &layer(State::Free)).share(), 1.0);
        assert_eq!(Comparison::of_layers(&layer(State::Free), &layer(State::Occupied)).share(), 0.5);
        assert_eq!(Comparison::of_layers(&layer(State::Free), &Layer::default()).share(), 0.0);
    }
}
