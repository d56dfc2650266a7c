//! Where the sensor was in the batches of a layer.

use std::collections::BTreeMap;

use rustc_hash::FxHashSet;

use crate::{BlockIndex, Stamp};

/// By end of batch, in sixteenths of a voxel. Codecs make use of it; it is no part of what is known.
#[derive(Clone, Debug, Default)]
pub(super) struct Sensors {
    pub(super) by_stamp: BTreeMap<Stamp, [i32; 3]>,
    /// How many were noted since the layer was last gone through for those of which nothing stands any more.
    pub(super) noted: usize,
    pub(super) sweep: Option<Box<Sweep>>,
}

/// The layer is being gone through.
#[derive(Clone, Debug)]
pub(super) struct Sweep {
    /// Stamps of which no voxel was found so far.
    pub(super) unseen: FxHashSet<Stamp>,
    /// Cubes that are left to be looked at.
    pub(super) cubes: Vec<BlockIndex>,
}

/// Most batches whose sensor a layer remembers; the oldest are forgotten.
const SENSORS_MAX: usize = 1 << 16;
/// A sensor in its map.
pub(crate) const SENSOR_BYTES: usize = 48;
/// So many sensors are noted at least before the layer is gone through.
pub(super) const SENSORS_NOTED_MIN: usize = 1_024;
impl Sensors {
    pub(super) const fn by_stamp(&self) -> &BTreeMap<Stamp, [i32; 3]> {
        &self.by_stamp
    }

    pub(super) fn memory_bytes(&self) -> usize {
        SENSOR_BYTES * self.by_stamp.len()
    }

    /// Something with this stamp is taken over, perhaps where the sweep was already.
    pub(super) fn note_stamp(&mut self, stamp: Stamp) {
        if let Some(sweep) = &mut self.sweep {
            sweep.unseen.remove(&stamp);
        }
    }

    /// Whether it is another one than those that are known.
    pub(super) fn note(&mut self, stamp: Stamp, sensor: [i32; 3]) -> bool {
        let is_new = self.by_stamp.insert(stamp, sensor).is_none();
        self.noted += usize::from(is_new);
        if self.by_stamp.len() > SENSORS_MAX {
            self.by_stamp.pop_first();
        }
        is_new
    }
}
