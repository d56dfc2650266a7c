//! How many voxels a batch may publish where the radio takes less than the map changes.

use core::time::Duration;
use flockmap_codec::Package;
use flockmap_grid::Changes;

/// A part of a batch is sent in about so many milliseconds: so long the next obstacles wait for it.
const PART_MS: u64 = 250;
/// And has at least so many bytes: of a smaller one too much would be header.
const PART_BYTES_MIN: u64 = 600;
/// What a package costs beside its voxels, about.
const PACKAGE_HEADER_BYTES: u64 = 40;
/// A batch that is deferred is published after the time of so many parts, whatever waits.
const DEFER_PARTS: u64 = 8;
/// Batches over which the cost of a voxel is smoothed.
const SMOOTHING: u64 = 4;
/// What a voxel is taken to cost before the first batch, in millionths of a byte.
const COST_INITIAL: u64 = 200_000;

/// Bytes that voxels cost, as far as measured: so that a part of a batch can be cut to what the radio takes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cost {
    /// Of batches of obstacles, in millionths of a byte for a voxel.
    obstacle: u64,
    /// Of all others.
    voxel: u64,
}

/// Voxels that a batch may publish.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Room {
    /// If it is one of obstacles.
    pub(crate) obstacles: usize,
    /// If it is any other.
    pub(crate) voxels: usize,
    /// How long packages that wait can defer it.
    pub(crate) defer_max: Duration,
}

impl Room {
    /// Of a radio without a budget.
    pub(crate) const UNLIMITED: Self =
        Self { obstacles: usize::MAX, voxels: usize::MAX, defer_max: Duration::ZERO };
}

impl Default for Cost {
    fn default() -> Self {
        Self { obstacle: COST_INITIAL, voxel: COST_INITIAL }
    }
}

impl Cost {
    /// Notes what a batch cost.
    pub(crate) fn note_batch(&mut self, changes: &Changes, packages: &[Package]) {
        let voxels = changes.len() as u64;
        let bytes = packages.iter().map(|package| package.bytes().len() as u64);
        let bytes: u64 = bytes.map(|bytes| bytes.saturating_sub(PACKAGE_HEADER_BYTES)).sum();
        let is_occupied = changes.blocks().iter().all(|(_, block)| block.free() == &[0; 8]);
        let cost = if is_occupied { &mut self.obstacle } else { &mut self.voxel };
        if let Some(now) = (bytes * 1_000_000).checked_div(voxels) {
            *cost = (*cost * (SMOOTHING - 1) + now) / SMOOTHING;
        }
    }

    /// What the radio takes in one part, at so many bytes a second.
    pub(crate) fn room(&self, bytes_per_s: u32) -> Room {
        let bytes = (u64::from(bytes_per_s) * PART_MS / 1_000).max(PART_BYTES_MIN);
        let voxels = |cost: u64| (bytes * 1_000_000 / cost.max(1)).clamp(1, 1 << 40) as usize;
        let micros = bytes * 1_000_000 / u64::from(bytes_per_s.max(1));
        Room {
            obstacles: voxels(self.obstacle),
            voxels: voxels(self.voxel),
            defer_max: Duration::from_micros(DEFER_PARTS * micros),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_codec::{Batch, Codec, Encoder};
    use flockmap_grid::{Resolution, RobotId, Stamp, State, Stream, Voxel};

    fn note(cost: &mut Cost, voxels: impl Iterator<Item = (i32, State)>) -> u64 {
        let changes = Changes::from_voxels(voxels.map(|(x, state)| (Voxel::new(x, 0, 0), state)));
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        let resolution = Resolution::from_metres(0.1).unwrap();
        let batch = Batch { stream, start: Stamp(0), end: Stamp(1), resolution, sensor: [0; 3] };
        let packages = Encoder::new().encode_batch(Codec::Raw, &batch, 1, &changes, 1150).unwrap();
        cost.note_batch(&changes, &packages);
        packages.iter().map(|package| package.bytes().len() as u64 - PACKAGE_HEADER_BYTES).sum()
    }

    #[test]
    fn the_room_is_what_batches_of_late_would_take_in_a_part() {
        let mut cost = Cost::default();
        let mut bytes = (0, 0);
        for _ in 0..20 {
            bytes.0 = note(&mut cost, (0..1_000).map(|x| (x, State::Occupied)));
            bytes.1 = note(&mut cost, (0..4_000).map(|x| (x, State::Free)));
        }
        let room = cost.room(8_000);
        let near = |voxels: usize, bytes: u64, of: u64| (voxels as u64 * bytes / of).abs_diff(2_000) <= 100;
        assert!(near(room.obstacles, bytes.0, 1_000), "{room:?}, {bytes:?}");
        assert!(near(room.voxels, bytes.1, 4_000), "{room:?}, {bytes:?}");
        assert_eq!(room.defer_max, Duration::from_secs(2));
        // Of a thin radio, a part takes longer.
        assert_eq!(cost.room(500).defer_max, Duration::from_millis(8 * 1_200));
        // Nothing was learnt from a batch without voxels, and no rate is too small.
        cost.note_batch(&Changes::default(), &[]);
        assert_eq!(cost.room(8_000), room);
        assert!(cost.room(0).voxels > 0);
    }
}
