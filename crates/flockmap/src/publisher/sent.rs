//! The own packages that later batches may refer to.

use flockmap_codec::Package;
use flockmap_grid::{Stamp, VoxelBox};

/// Batches and packages kept; of more, the oldest are forgotten.
const KEPT_MAX: usize = 1_024;

/// End and last package of the newest batches, and the newest packages that were coded against a layer with
/// their boxes. At most 60 KB.
#[derive(Default)]
pub(crate) struct SentHistory {
    batches: Vec<(Stamp, u32)>,
    readers: Vec<(u32, VoxelBox)>,
}

impl SentHistory {
    /// Notes the packages of a batch, later than all before.
    pub(crate) fn note_batch(&mut self, packages: &[Package]) {
        let headers = || packages.iter().map(Package::header);
        self.batches.extend(headers().next_back().map(|last| (last.batch_end, last.index)));
        self.readers.extend(headers().filter(|header| !header.is_independent).map(|h| (h.index, h.region)));
        forget_oldest(&mut self.batches);
        forget_oldest(&mut self.readers);
    }

    /// End and last package of each batch, ascending.
    pub(crate) fn batches(&self) -> &[(Stamp, u32)] {
        &self.batches
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
    use flockmap_codec::{Batch, Codec, Encoder};
    use flockmap_grid::{Changes, Resolution, RobotId, State, Stream, Voxel};

    #[test]
    fn the_oldest_batches_are_forgotten() {
        let (mut sent, mut encoder) = (SentHistory::default(), Encoder::new());
        let changes = Changes::from_voxels([(Voxel::new(1, 2, 3), State::Free)]);
        for index in 1..=KEPT_MAX as u32 + 10 {
            let end = Stamp(i64::from(index));
            let stream = Stream { origin: RobotId(1), epoch: 1 };
            let resolution = Resolution::from_metres(0.1).unwrap();
            let batch = Batch { stream, start: end, end, resolution, sensor: [0; 3] };
            sent.note_batch(&encoder.encode_batch(Codec::Paper, &batch, index, &changes, 1150).unwrap());
        }
        assert_eq!(sent.batches().len(), KEPT_MAX);
        assert_eq!(sent.batches()[0], (Stamp(11), 11));
        assert_eq!(sent.batches().last(), Some(&(Stamp(KEPT_MAX as i64 + 10), KEPT_MAX as u32 + 10)));
        // The paper's packages need nothing.
        assert!(sent.readers().is_empty());
    }
}
