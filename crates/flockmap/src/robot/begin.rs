//! A new run while flying: where the own id was used with a higher epoch.

use flockmap_codec::Batch;
use flockmap_grid::{Stamp, Stream, epoch, seconds_of_epoch};

use super::Robot;
use crate::Event;
use crate::republishing::{Former, Republishing};

impl Robot {
    /// Begins a run above an epoch, and begins to publish in it what the one before had published, with the same
    /// stamps: so nothing old looks new, and what nobody had taken any more is there again. O(cubes of 4³ blocks of
    /// the own layer).
    pub(super) fn begin_anew(&mut self, now: Stamp, used: u64) {
        let Some(above) = self.epoch_above(used) else {
            // The last one of all: nothing is above it.
            return self.push_event(Event::SameIdentity);
        };
        // What is still to be published of an earlier run is all that this one has published.
        let published = self.fusion.layer(self.own_stream()).filter(|_| self.republishing.is_none());
        let published = published.filter(|layer| !layer.is_empty()).map(Republishing::new);
        if !self.session.begin_run(now, above) {
            return;
        }
        let own = Stream { epoch: above, ..self.own_stream() };
        self.fusion.begin_run(own);
        self.publisher.begin_run(own);
        self.counters.runs_begun += 1;
        self.push_event(Event::RunBegun(own));
        match &mut self.republishing {
            Some(republishing) => republishing.begin_again(),
            None => self.republishing = published,
        }
    }

    /// Publishes some more of what the former run had published; then what has changed since, if somebody wants that.
    pub(super) fn go_on_with_republishing(&mut self, now: Stamp) {
        let Some(mut republishing) = self.republishing.take() else { return };
        let (stream, resolution) = (self.own_stream(), self.config.mapper.resolution);
        match republishing.step() {
            Some(former) => {
                self.republishing = Some(republishing);
                for Former { start, end, sensor, changes } in former {
                    self.publish(now, Batch { stream, start, end, resolution, sensor }, changes);
                }
            }
            None if republishing.is_flush_wanted => self.flush(now),
            None => {}
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
