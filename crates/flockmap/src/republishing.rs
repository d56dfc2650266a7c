//! What a former run published goes out again in the run that takes its place, a slice at a time.

use flockmap_grid::{Changes, Layer, SnapshotReader, SnapshotVoxels, Stamp};

/// Blocks that are read in one slice, some 20 µs each.
const READ_BLOCKS: usize = 256;
/// Blocks that are published in one slice. A batch is not cut: it goes beyond.
const PUBLISHED_BLOCKS: usize = 64;

/// What the former run published as one batch, as far as nothing newer took its place.
pub(crate) struct Former {
    pub(crate) start: Stamp,
    pub(crate) end: Stamp,
    pub(crate) sensor: [i32; 3],
    pub(crate) changes: Changes,
}

/// The layer of a former run as it was when it ended. Meanwhile nothing else is published: batches go out in the order
/// of their stamps.
pub(crate) struct Republishing {
    stage: Stage,
    voxels: usize,
    voxels_left: usize,
    /// Somebody wants what has changed to go out when it is its turn.
    pub(crate) is_flush_wanted: bool,
}

enum Stage {
    Reading(Box<SnapshotReader>),
    /// All up to this stamp is published.
    Publishing(Box<SnapshotVoxels>, Option<Stamp>),
    Done,
}

impl Republishing {
    /// O(cubes + sensors).
    pub(crate) fn new(layer: &Layer) -> Self {
        let stage = Stage::Reading(Box::new(layer.read_snapshot(None)));
        let voxels = layer.len();
        Self { stage, voxels, voxels_left: voxels, is_flush_wanted: false }
    }

    /// Yet another run takes the place of that in which it was published: all of it goes out again.
    pub(crate) fn begin_again(&mut self) {
        self.voxels_left = self.voxels;
        if let Stage::Publishing(_, upto) = &mut self.stage {
            *upto = None;
        }
    }

    /// Voxels that are still to be published.
    pub(crate) const fn voxels_left(&self) -> usize {
        self.voxels_left
    }

    /// Does a slice of it. Returns what is to be published now, nothing while it is read; `None` when all is done.
    pub(crate) fn step(&mut self) -> Option<Vec<Former>> {
        match &mut self.stage {
            Stage::Reading(reader) => {
                if reader.step(READ_BLOCKS) == 0 {
                    let read = core::mem::take(&mut **reader).finish();
                    self.stage = read.map_or(Stage::Done, |read| Stage::Publishing(Box::new(read), None));
                }
                Some(Vec::new())
            }
            Stage::Publishing(read, upto) => {
                let (mut now, mut blocks) = (Vec::new(), 0);
                while blocks < PUBLISHED_BLOCKS
                    && let Some((end, changes)) = read.part_after(*upto)
                {
                    let sensors = read.sensors();
                    let sensor = sensors.binary_search_by_key(&end, |(stamp, _)| *stamp);
                    let sensor = sensor.map_or([0; 3], |at| sensors[at].1);
                    let start = upto.replace(end).unwrap_or(end);
                    blocks += changes.blocks().len();
                    self.voxels_left -= changes.len();
                    now.push(Former { start, end, sensor, changes });
                }
                (!now.is_empty()).then_some(now)
            }
            Stage::Done => None,
        }
    }
}
