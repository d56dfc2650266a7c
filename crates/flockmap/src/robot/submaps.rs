//! Submaps of the own run: when they begin, how they lie, and when that is said.

use std::collections::BTreeMap;

use flockmap_codec::Batch;
use flockmap_grid::{Pose, PoseError, Stamp, SubmapId, SubmapRecord};
use flockmap_sync::Pace;

use super::Robot;

/// Why a submap does not begin, or is not moved. Nothing is changed then.
#[derive(Clone, Copy, PartialEq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SubmapError {
    /// There are as many as there may be.
    #[error("this run has {} submaps already: begin them less often, or a new run", SubmapId::COUNT)]
    Full,
    /// It has not begun.
    #[error("submap {wanted} has not begun: the newest of this run is {newest}")]
    NotBegun {
        /// What was asked for.
        wanted: u16,
        /// The newest one.
        newest: u16,
    },
    /// It cannot lie so.
    #[error(transparent)]
    Pose(#[from] PoseError),
}

/// What is known of the own submaps.
#[derive(Default)]
pub(super) struct Submaps {
    /// `T_map_submap`, rounded as it is sent. A submap without one lies as the one before it, the first one as the map.
    poses: BTreeMap<SubmapId, Pose>,
    /// Still to be said, the newest of each.
    unsaid: BTreeMap<SubmapId, SubmapRecord>,
    /// When poses were said last.
    said: Option<Stamp>,
    /// How far the sensor has come since the submap began, in metres, and where it was last.
    travelled: f64,
    place: Option<[f64; 3]>,
}

impl Submaps {
    /// How a submap lies in the map.
    pub(super) fn pose(&self, submap: SubmapId) -> Pose {
        let newest = self.poses.range(..=submap).next_back();
        newest.map_or(Pose::IDENTITY, |(_, pose)| *pose)
    }

    /// Whether one has begun of which nobody knows.
    fn is_begin_unsaid(&self) -> bool {
        self.unsaid.values().any(|record| record.begins)
    }

    fn say(&mut self, submap: SubmapId) -> &mut SubmapRecord {
        self.unsaid.entry(submap).or_insert(SubmapRecord { submap, begins: false, pose: None })
    }

    fn set(&mut self, submap: SubmapId, pose: Pose) {
        self.poses.insert(submap, pose);
        self.say(submap).pose = Some(pose);
    }

    /// Notes where a scan was made; whether the way since the submap began is as long as this.
    pub(super) fn note_place(&mut self, place: [f64; 3], length_m: f64) -> bool {
        let before = self.place.replace(place).unwrap_or(place);
        self.travelled += before.iter().zip(place).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        self.travelled >= length_m
    }
}

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
    /// publish period, the newest of each submap, some 30 bytes for each; the newest one wins, whatever is lost or late.
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
        self.publish(now, batch, changes);
    }
}
