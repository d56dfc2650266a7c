//! A new run while flying: where the own id was used with a higher epoch.

use flockmap_codec::Batch;
use flockmap_grid::{Stamp, Stream, epoch, seconds_of_epoch};

use super::Robot;
use crate::Event;

impl Robot {
    /// Begins a run above an epoch, and publishes in it what the one before had published, with the same
    /// stamps: so nothing old looks new, and what nobody had taken any more is there again. O(voxels
    /// published).
    pub(super) fn begin_anew(&mut self, now: Stamp, used: u64) {
        let Some(above) = self.epoch_above(used) else {
            // The last one of all: nothing is above it.
            return self.push_event(Event::SameIdentity);
        };
        let published = self.fusion.layer(self.own_stream()).and_then(|layer| layer.snapshot());
        if !self.session.begin_run(now, above) {
            return;
        }
        let own = Stream { epoch: above, ..self.own_stream() };
        self.fusion.begin_run(own);
        self.publisher.begin_run(own);
        self.counters.runs_begun += 1;
        self.push_event(Event::RunBegun(own));
        let Some(published) = published else { return };
        let mut start = published.parts.first().map_or(now, |(stamp, _)| *stamp);
        for (end, changes) in published.parts {
            let sensor =
                published.sensors.iter().find(|(stamp, _)| *stamp == end).map_or([0; 3], |(_, at)| *at);
            let resolution = self.config.mapper.resolution;
            self.publish(now, Batch { stream: own, start, end, resolution, sensor }, changes);
            start = end;
        }
    }

    /// An epoch above another one: of the next second, with bits that follow from what was handed in as seed
    /// and salt.
    fn epoch_above(&self, used: u64) -> Option<u64> {
        let salt =
            self.config.session.salt.chunks(8).fold(0, |all, part| {
                all ^ part.iter().fold(0u64, |number, byte| number << 8 | u64::from(*byte))
            });
        let mut mixed =
            self.config.seed ^ salt ^ self.own_stream().epoch.rotate_left(17) ^ used.rotate_left(43);
        // The last steps of SplitMix64.
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        match seconds_of_epoch(used).checked_add(1) {
            Some(seconds) => Some(epoch(seconds, (mixed ^ (mixed >> 31)) as u32)),
            None => used.checked_add(1),
        }
    }
}
