//! Submaps of the own run: when they begin, how they lie, and when that is said.

use flockmap_codec::Batch;
use flockmap_grid::{Pose, Stamp, SubmapId, SubmapRecord};
use flockmap_sync::Pace;

use super::Robot;
use crate::SubmapError;

impl Robot {
    /// Begins the next submap of this run: what scans see from now on moves with it, and what they saw before stays with
    /// the former ones. It lies as the one before does until [`set_submap_pose`](Self::set_submap_pose) says otherwise,
    /// and goes on in the same grid, so that what is around the robot is not sent again.
    ///
    /// What of the map was seen neither in this submap nor in the one before, and is seen again and looks otherwise than
    /// it did, is kept beside what is seen now, each in its own submap; so it is sent anew. How much that costs
    /// is in `docs/submaps.md`: a few per cent where submaps are as long as the range of the sensor.
    ///
    /// # Errors
    /// [`SubmapError::Full`] after [`SubmapId::COUNT`] submaps.
    pub fn begin_submap(&mut self, now: Stamp) -> Result<SubmapId, SubmapError> {
        self.advance(now);
        let submap = self.mapper.begin_submap().ok_or(SubmapError::Full)?;
        self.submaps.say(submap).begins = true;
        self.submaps.travelled = 0.0;
        self.counters.submaps_begun += 1;
        Ok(submap)
    }

    /// Says how a submap of this run lies in the map now: what all robots know of it moves there, as after
    /// [`set_alignment`](Self::set_alignment), and nothing of it is sent again. `T_map_submap` takes what was given as
    /// `T_map_sensor` while the submap was written, with the pose that it had then taken off, to where it is in the map:
    /// it is the correction of a drift, ROS's `map` to `odom` at that time. Scans are taken in by the pose of the submap in
    /// which they are written, so their `T_map_sensor` is to be one after the correction.
    ///
    /// It is rounded to a tenth of a millimetre and 2⁻²² of a quaternion, here too. To others it goes at most once in a
    /// publish period, the newest of each submap, 20 to 50 bytes for each; the newest one wins, whatever is lost or late.
    /// O(log submaps).
    ///
    /// # Errors
    /// [`SubmapError`] if the submap has not begun or the pose is none, or farther out than ±214 km.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn set_submap_pose(
        &mut self,
        now: Stamp,
        submap: SubmapId,
        T_map_submap: &Pose,
    ) -> Result<(), SubmapError> {
        let newest = self.mapper.submap();
        if submap > newest {
            return Err(SubmapError::NotBegun { wanted: submap.number(), newest: newest.number() });
        }
        T_map_submap.check(self.config.mapper.resolution)?;
        let pose = T_map_submap.rounded()?;
        self.advance(now);
        if pose == self.submaps.pose(submap) {
            return Ok(());
        }
        // The next one lay as this one did, and stays there.
        if let Some(next) = submap.next().filter(|next| *next <= newest)
            && !self.submaps.poses.contains_key(&next)
        {
            let before = self.submaps.pose(next);
            self.submaps.set(next, before);
            self.fusion.set_submap_pose(self.own_stream(), next, before);
        }
        self.submaps.set(submap, pose);
        self.fusion.set_submap_pose(self.own_stream(), submap, pose);
        self.counters.submap_poses += 1;
        Ok(())
    }

    /// The submap in which scans are written.
    pub const fn submap(&self) -> SubmapId {
        self.mapper.submap()
    }

    /// `T_map_submap` of a submap of this run, as it was set, rounded.
    pub fn submap_pose(&self, submap: SubmapId) -> Pose {
        self.submaps.pose(submap)
    }

    /// When something is to be said of submaps.
    pub(super) fn submaps_due(&self) -> Option<Stamp> {
        if self.submaps.unsaid.is_empty() || self.republishing.is_some() {
            return None;
        }
        let said = self.submaps.said.filter(|_| !self.submaps.is_begin_unsaid());
        Some(said.map_or(self.now, |said| said.plus(self.publisher.period())))
    }

    /// Says what is to be said of submaps, if it is time: before any batch, so that what is seen in a submap has a newer
    /// stamp than its beginning. Poses wait while packages do.
    pub(super) fn say_submaps(&mut self, now: Stamp) {
        if self.submaps_due().is_none_or(|due| due > now) {
            return;
        }
        if !self.submaps.is_begin_unsaid() && matches!(self.session.pace(now), Pace::Waiting { .. }) {
            self.submaps.said = Some(now);
            return;
        }
        let records: Vec<SubmapRecord> = core::mem::take(&mut self.submaps.unsaid).into_values().collect();
        self.submaps.said = Some(now);
        // They were checked when they were set.
        let Ok(changes) = SubmapRecord::changes(&records) else { return };
        let batch: Batch = self.publisher.batch_of_records();
        let before = self.counters.package_bytes;
        self.publish(now, batch, changes);
        self.counters.submap_package_bytes += self.counters.package_bytes - before;
    }
}
