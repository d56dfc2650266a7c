//! A layer is gone through for sensors of batches of which nothing stands any more, a part at a time.

use super::sensors::{SENSORS_NOTED_MIN, Sensors, Sweep};
use super::{Layer, Place};
use crate::Stamp;

/// Blocks that are looked at in one call, some 2 µs each, and those of a cube more.
const SWEPT_AT_ONCE: usize = 1_024;

impl Layer {
    /// Notes where the sensor was in the batch that ended at `stamp`, in sixteenths of a voxel; to be called
    /// after its voxels were taken over. Of at most 2¹⁶ batches, 48 bytes each; batches of which no voxel
    /// stands any more are forgotten now and then, for which the layer is gone through a part at a time. O(log n).
    pub fn note_sensor(&mut self, stamp: Stamp, sensor: [i32; 3]) {
        if self.sensors.note(stamp, sensor) {
            self.sweep_sensors(SWEPT_AT_ONCE);
        }
    }

    /// The same for many, with one step of going through the layer.
    pub(super) fn note_sensors(&mut self, sensors: &[(Stamp, [i32; 3])]) {
        let is_new =
            sensors.iter().fold(false, |is_new, (at, sensor)| self.sensors.note(*at, *sensor) | is_new);
        if is_new {
            self.sweep_sensors(SWEPT_AT_ONCE);
        }
    }

    /// Where the sensor was in the newest batch of which that is known, in sixteenths of a voxel. O(log n).
    pub fn newest_sensor(&self) -> Option<(Stamp, [i32; 3])> {
        self.sensors.by_stamp.last_key_value().map(|(stamp, sensor)| (*stamp, *sensor))
    }

    /// Goes on with forgetting the sensors of batches of which no voxel stands; begins with it so rarely that it
    /// costs little for each. Returns how many blocks it looked at.
    pub(super) fn sweep_sensors(&mut self, blocks_max: usize) -> usize {
        let Sensors { by_stamp, noted, sweep } = &mut self.sensors;
        if sweep.is_none() {
            if *noted < SENSORS_NOTED_MIN.max(self.blocks / 4).max(by_stamp.len() / 2) {
                return 0;
            }
            *noted = 0;
            let (unseen, cubes) = (by_stamp.keys().copied().collect(), self.cubes.keys().copied().collect());
            *sweep = Some(Box::new(Sweep { unseen, cubes }));
        }
        let Some(sweeping) = sweep else { return 0 };
        let Sweep { unseen, cubes } = &mut **sweeping;
        let mut looked = 0;
        while looked < blocks_max
            && let Some(at) = cubes.pop()
        {
            let mut found = |stamp| {
                unseen.remove(&stamp);
            };
            match self.cubes.get(&at) {
                Some(Place::Open(open)) => {
                    looked += open.cube.len();
                    open.cube.parts().iter().for_each(|block| {
                        block.stamps.for_each_in_use(&block.states.known(), &mut found);
                    });
                }
                Some(Place::Packed(packed)) => {
                    looked += packed.len();
                    packed.for_each_stamp(found);
                }
                None => {}
            }
        }
        if cubes.is_empty() {
            by_stamp.retain(|stamp, _| !unseen.contains(stamp));
            *sweep = None;
        }
        looked
    }

    /// Forgets them now, where else it would be done in time.
    #[cfg(test)]
    pub(super) fn forget_sensors(&mut self) {
        self.sweep_sensors(usize::MAX);
        self.sensors.noted = usize::MAX;
        self.sweep_sensors(usize::MAX);
    }
}
