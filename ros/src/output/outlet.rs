//! When and what is published: the map at one moment, and a topic that it goes out on.

use std::time::{Duration, Instant};

use flockmap::{KnownPose, MapView, Voxel};
use flockmap_io::ros::{Header, RosMessage};
use ros2_client::Publisher;
use serde::Serialize;

use crate::links::Links;

/// Whether the map has changed is looked at this often.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// The map at one moment.
pub(crate) struct Shot {
    pub(crate) view: MapView,
    /// Stamp of the newest own scan in it, else the time now; frame of the map.
    pub(crate) header: Header,
    /// Where the robots are.
    pub(crate) poses: Vec<KnownPose>,
    /// Where the own sensor is.
    pub(crate) position: Option<[f64; 3]>,
}

impl Shot {
    /// The voxel that the own sensor is in.
    pub(crate) fn voxel(&self) -> Option<Voxel> {
        self.view.resolution().voxel_at(self.position?)
    }
}

/// Something that is published.
pub(crate) trait Output: Send {
    /// Publishes what is due. An error is a line for people.
    fn publish(&mut self, shot: &Shot, now: Instant) -> Result<(), String>;
    /// When to be asked again at the earliest.
    fn due(&self) -> Instant;
}

/// A topic on which something is published at most so often, and only where somebody listens.
pub(crate) struct Outlet<M: Serialize> {
    name: String,
    publisher: Publisher<M>,
    links: Links,
    period: Duration,
    due: Instant,
    /// Who listened when it was published last.
    listeners: usize,
    /// What was published last: a version of the map, and the voxel that the robot was in.
    last: Option<(u64, Option<Voxel>)>,
}

impl<M: RosMessage + Serialize> Outlet<M> {
    pub(crate) fn new(name: String, publisher: Publisher<M>, links: Links, period_s: f64) -> Self {
        let period = Duration::from_secs_f64(period_s);
        Self { name, publisher, links, period, due: Instant::now(), listeners: 0, last: None }
    }

    pub(crate) const fn due(&self) -> Instant {
        self.due
    }

    /// Whether something is to be published now: somebody listens who has not seen it. `place`: what it depends on
    /// beside the map, such as where the robot is.
    pub(crate) fn wants(&mut self, version: u64, place: Option<Voxel>, now: Instant) -> bool {
        if now < self.due {
            return false;
        }
        let listeners = self.links.count(self.publisher.guid());
        let is_new = listeners > self.listeners || self.last != Some((version, place));
        self.listeners = listeners;
        if listeners == 0 || !is_new {
            self.due = now + LOOK_PERIOD.min(self.period);
            return false;
        }
        self.due = now + self.period;
        self.last = Some((version, place));
        true
    }

    /// How many listened when [`Self::wants`] was asked last.
    pub(crate) const fn listeners(&self) -> usize {
        self.listeners
    }

    /// Nothing was published, as far as [`Self::wants`] knows.
    pub(crate) const fn forget(&mut self) {
        self.last = None;
    }

    /// Publishes. What could not be published is wanted again.
    pub(crate) fn send(&mut self, message: M) -> Result<(), String> {
        self.publisher.publish(message).map_err(|error| {
            self.forget();
            format!("{} was not published: {error}", self.name)
        })
    }
}
