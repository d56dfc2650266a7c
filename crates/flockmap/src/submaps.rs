//! What is known of the submaps of the own run.

use std::collections::BTreeMap;

use flockmap_grid::{Pose, PoseError, Stamp, SubmapId, SubmapRecord};

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
pub(crate) struct Submaps {
    /// `T_map_submap`, rounded as it is sent. A submap without one lies as the one before it, the first one as the map.
    pub(crate) poses: BTreeMap<SubmapId, Pose>,
    /// Still to be said, the newest of each.
    pub(crate) unsaid: BTreeMap<SubmapId, SubmapRecord>,
    /// When poses were said last.
    pub(crate) said: Option<Stamp>,
    /// How far the sensor has come since the submap began, in metres, and where it was last.
    pub(crate) travelled: f64,
    place: Option<[f64; 3]>,
}

impl Submaps {
    /// How a submap lies in the map.
    pub(crate) fn pose(&self, submap: SubmapId) -> Pose {
        let newest = self.poses.range(..=submap).next_back();
        newest.map_or(Pose::IDENTITY, |(_, pose)| *pose)
    }

    /// Whether one has begun of which nobody knows.
    pub(crate) fn is_begin_unsaid(&self) -> bool {
        self.unsaid.values().any(|record| record.begins)
    }

    pub(crate) fn say(&mut self, submap: SubmapId) -> &mut SubmapRecord {
        self.unsaid.entry(submap).or_insert(SubmapRecord { submap, begins: false, pose: None })
    }

    pub(crate) fn set(&mut self, submap: SubmapId, pose: Pose) {
        self.poses.insert(submap, pose);
        self.say(submap).pose = Some(pose);
    }

    /// Notes where a scan was made; whether the way since the submap began is as long as this.
    pub(crate) fn note_place(&mut self, place: [f64; 3], length_m: f64) -> bool {
        let before = self.place.replace(place).unwrap_or(place);
        self.travelled += before.iter().zip(place).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        self.travelled >= length_m
    }
}
