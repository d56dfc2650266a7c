//! Packages that wait for the packages that they build on.

use std::collections::BTreeMap;

use flockmap_codec::Package;
use flockmap_grid::Stream;

/// Packages that may wait, of all streams.
pub(crate) const WAITING_MAX: usize = 1_024;
/// Bytes that they may take, with 400 bytes of bookkeeping for each.
pub(crate) const WAITING_BYTES_MAX: usize = 1 << 20;
/// Its header, and its place in a map whose nodes may be half empty.
const OVERHEAD_BYTES: usize = 400;

/// Packages by stream and index, within [`WAITING_MAX`] and [`WAITING_BYTES_MAX`]. Where they do not suffice,
/// the stream of which most is waiting is dropped, so that none can displace another; and of it the highest
/// index, since the low ones are the first that can go, and others wait for them.
#[derive(Debug, Default)]
pub(crate) struct Waiting {
    packages: BTreeMap<(Stream, u32), Package>,
    /// Of each stream with packages.
    bytes: BTreeMap<Stream, usize>,
}

impl Waiting {
    /// Lets a package wait. Returns those that had to go for it, itself perhaps among them.
    pub(crate) fn insert(&mut self, package: Package) -> Vec<Package> {
        let (stream, index) = (package.header().stream, package.header().index);
        *self.bytes.entry(stream).or_default() += bytes_of(&package);
        let mut dropped: Vec<Package> = Vec::new();
        if let Some(same) = self.packages.insert((stream, index), package) {
            self.let_go(stream, &same);
        }
        while self.packages.len() > WAITING_MAX || self.bytes.values().sum::<usize>() > WAITING_BYTES_MAX {
            let Some(stream) = self.bytes.iter().max_by_key(|(_, bytes)| **bytes).map(|(stream, _)| *stream)
            else {
                break;
            };
            let Some((_, highest)) = self.packages.range((stream, 0)..=(stream, u32::MAX)).next_back() else {
                break;
            };
            let highest = highest.header().index;
            dropped.extend(self.take(stream, highest));
        }
        dropped
    }

    /// The first package of a stream after index `after` that needs none above `prefix`.
    pub(crate) fn take_ready(&mut self, stream: Stream, after: u32, prefix: u32) -> Option<Package> {
        let mut later = self.packages.range((stream, after.checked_add(1)?)..=(stream, u32::MAX));
        let ((_, index), _) = later.find(|(_, package)| package.header().base <= prefix)?;
        let index = *index;
        self.take(stream, index)
    }

    /// Lets go of all packages of a stream up to an index.
    pub(crate) fn drop_upto(&mut self, stream: Stream, upto: u32) {
        while let Some((&(_, index), _)) = self.packages.range((stream, 0)..=(stream, upto)).next() {
            self.take(stream, index);
        }
    }

    /// Packages that wait, and their bytes with bookkeeping.
    pub(crate) fn load(&self) -> (usize, usize) {
        (self.packages.len(), self.bytes.values().sum())
    }

    /// A package that waits.
    pub(crate) fn get(&self, stream: Stream, index: u32) -> Option<&Package> {
        self.packages.get(&(stream, index))
    }

    fn take(&mut self, stream: Stream, index: u32) -> Option<Package> {
        let package = self.packages.remove(&(stream, index))?;
        self.let_go(stream, &package);
        Some(package)
    }

    fn let_go(&mut self, stream: Stream, package: &Package) {
        if let Some(bytes) = self.bytes.get_mut(&stream) {
            *bytes -= bytes_of(package);
            if *bytes == 0 {
                self.bytes.remove(&stream);
            }
        }
    }
}

fn bytes_of(package: &Package) -> usize {
    package.bytes().len() + OVERHEAD_BYTES
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_codec::{Base, Batch, Codec, Encoder};
    use flockmap_grid::{Changes, Layer, Resolution, RobotId, Stamp, State, Voxel};
    use proptest::prelude::*;

    fn stream(id: u16) -> Stream {
        Stream { origin: RobotId(id), epoch: 1 }
    }

    /// A package that builds on another.
    fn package(encoder: &mut Encoder, id: u16, index: u32, base: u32) -> Package {
        // A wall: few voxels would not need what was before.
        let wall = |state| (0..320).map(move |at| (Voxel::new(20, at % 16, at / 16), state));
        let sent = |state| Changes::from_voxels(wall(state));
        let mut layer = Layer::default();
        layer.apply(&sent(State::Free), Stamp(1));
        let resolution = Resolution::from_metres(0.1).unwrap();
        let batch = Batch { stream: stream(id), start: Stamp(2), end: Stamp(2), resolution, sensor: [0; 3] };
        let base = Base { layer: Some(&layer), batches: &[(Stamp(1), base)], readers: &[] };
        let changes = sent(State::Occupied);
        let packages = encoder.encode_batch_against(Codec::Flock, &batch, index, &changes, Some(&base), 1150);
        let [package] = packages.unwrap().try_into().unwrap();
        package
    }

    #[derive(Clone, Debug)]
    enum Step {
        Insert { id: u16, index: u32, back: u32 },
        Release { id: u16, prefix: u32 },
        Settle { id: u16, upto: u32 },
    }

    fn step() -> impl Strategy<Value = Step> {
        let id = || 1..4u16;
        prop_oneof![
            6 => (id(), 2..60u32, 1..60u32).prop_map(|(id, index, back)| Step::Insert { id, index, back }),
            2 => (id(), 0..60u32).prop_map(|(id, prefix)| Step::Release { id, prefix }),
            1 => (id(), 0..60u32).prop_map(|(id, upto)| Step::Settle { id, upto }),
        ]
    }

    proptest! {
        #[test]
        fn agrees_with_a_list(steps in prop::collection::vec(step(), 0..60)) {
            let mut encoder = Encoder::new();
            let mut waiting = Waiting::default();
            let mut model: Vec<(u16, u32, u32)> = Vec::new();
            for step in steps {
                match step {
                    Step::Insert { id, index, back } => {
                        let base = index.saturating_sub(back).max(1);
                        prop_assert!(waiting.insert(package(&mut encoder, id, index, base)).is_empty());
                        model.retain(|entry| (entry.0, entry.1) != (id, index));
                        model.push((id, index, base));
                    }
                    Step::Release { id, prefix } => {
                        let mut expected: Vec<u32> =
                            model.iter().filter(|e| e.0 == id && e.2 <= prefix).map(|e| e.1).collect();
                        expected.sort_unstable();
                        model.retain(|e| e.0 != id || e.2 > prefix);
                        let (mut after, mut found) = (0, Vec::new());
                        while let Some(package) = waiting.take_ready(stream(id), after, prefix) {
                            after = package.header().index;
                            found.push(after);
                        }
                        prop_assert_eq!(found, expected);
                    }
                    Step::Settle { id, upto } => {
                        waiting.drop_upto(stream(id), upto);
                        model.retain(|e| e.0 != id || e.1 > upto);
                    }
                }
                prop_assert_eq!(waiting.packages.len(), model.len());
                for id in 1..4 {
                    let of_stream = waiting.packages.values().filter(|p| p.header().stream == stream(id));
                    let bytes: usize = of_stream.map(bytes_of).sum();
                    prop_assert_eq!(waiting.bytes.get(&stream(id)).copied().unwrap_or(0), bytes);
                }
            }
        }
    }

    #[test]
    fn the_loudest_stream_gives_way_from_its_end() {
        let mut encoder = Encoder::new();
        let mut waiting = Waiting::default();
        let mut dropped = Vec::new();
        for index in 2..=WAITING_MAX as u32 {
            dropped.extend(waiting.insert(package(&mut encoder, 1, index, 1)));
        }
        assert!(waiting.insert(package(&mut encoder, 2, 9, 1)).is_empty());
        assert!(dropped.is_empty());
        for index in 3..=12 {
            dropped.extend(waiting.insert(package(&mut encoder, 2, 10 + index, 1)));
        }
        let dropped: Vec<_> = dropped.iter().map(|p| (p.header().stream, p.header().index)).collect();
        let expected: Vec<_> = (0..10).map(|n| (stream(1), WAITING_MAX as u32 - n)).collect();
        assert_eq!(dropped, expected);
        assert!(waiting.bytes.values().sum::<usize>() <= WAITING_BYTES_MAX);
    }
}
