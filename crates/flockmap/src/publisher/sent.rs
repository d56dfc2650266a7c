//! The own packages that later cycles may refer to.

use flockmap_codec::Package;
use flockmap_grid::{Stamp, VoxelBox};

/// Cycles and packages kept; of more, the oldest are forgotten.
const KEPT_MAX: usize = 1_024;

/// End and last package of the newest cycles, and the newest packages that were told against a layer with their boxes. At most
/// 60 KB.
#[derive(Default)]
pub(crate) struct Sent {
    cycles: Vec<(Stamp, u32)>,
    readers: Vec<(u32, VoxelBox)>,
}

impl Sent {
    /// Notes the packages of a cycle, later than all before.
    pub(crate) fn note_cycle(&mut self, packages: &[Package]) {
        let headers = || packages.iter().map(Package::header);
        self.cycles.extend(headers().next_back().map(|last| (last.cycle_end, last.index)));
        self.readers.extend(headers().filter(|header| !header.is_alone).map(|h| (h.index, h.region)));
        forget_oldest(&mut self.cycles);
        forget_oldest(&mut self.readers);
    }

    /// End and last package of each cycle, ascending.
    pub(crate) fn cycles(&self) -> &[(Stamp, u32)] {
        &self.cycles
    }

    /// The packages that need what was before them, ascending.
    pub(crate) fn readers(&self) -> &[(u32, VoxelBox)] {
        &self.readers
    }
}

fn forget_oldest<T>(list: &mut Vec<T>) {
    list.drain(..list.len().saturating_sub(KEPT_MAX));
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_codec::{Codec, Cycle, Encoder};
    use flockmap_grid::{Changes, Resolution, RobotId, State, Stream, Voxel};

    #[test]
    fn the_oldest_cycles_are_forgotten() {
        let (mut sent, mut encoder) = (Sent::default(), Encoder::new());
        let changes = Changes::from_voxels([(Voxel::new(1, 2, 3), State::Free)]);
        for index in 1..=KEPT_MAX as u32 + 10 {
            let end = Stamp(i64::from(index));
            let stream = Stream { origin: RobotId(1), epoch: 1 };
            let resolution = Resolution::from_metres(0.1).unwrap();
            let cycle = Cycle { stream, start: end, end, resolution, sensor: [0; 3] };
            sent.note_cycle(&encoder.encode_cycle(Codec::Paper, &cycle, index, &changes, 1150).unwrap());
        }
        assert_eq!(sent.cycles().len(), KEPT_MAX);
        assert_eq!(sent.cycles()[0], (Stamp(11), 11));
        assert_eq!(sent.cycles().last(), Some(&(Stamp(KEPT_MAX as i64 + 10), KEPT_MAX as u32 + 10)));
        // The paper's packages need nothing.
        assert!(sent.readers().is_empty());
    }
}
