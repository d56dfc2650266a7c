//! What is set for the layers of an origin comes into force when the map is made by it.

use super::Fusion;
use super::align::Alignment;
use super::settings::{Origin, Settings};
use crate::{Pose, PoseError, RobotId, Stream};

impl Fusion {
    /// Says how an origin's frame lies in this robot's frame. Nothing has to be sent again: the fused map is made
    /// anew from the layers, by [`Self::work`], and stays as it is until then. What comes to lie beyond the end of the
    /// grid is left out. O(streams).
    ///
    /// # Errors
    /// [`PoseError`] if it is no pose, or brings the origin of the frame beyond the grid; nothing is changed
    /// then.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn set_alignment(&mut self, origin: RobotId, T_own_origin: &Pose) -> Result<(), PoseError> {
        T_own_origin.check(self.resolution)?;
        if self.wanted.origin(origin).pose() != T_own_origin {
            let alignment = Alignment::new(T_own_origin, self.resolution);
            self.set(origin, |set| set.align(T_own_origin, &alignment));
        }
        Ok(())
    }

    /// Says how far this robot's clock is ahead of an origin's: own time = origin's time + offset. Microseconds.
    /// Only what is fused from now on is compared with it, until the map is made anew. Where another offset was set
    /// by [`Self::apply_clock_offset`] and did not come into force yet, this one comes into force in its place.
    pub fn set_clock_offset(&mut self, origin: RobotId, micros: i64) {
        let before = self.wanted.origin(origin).clock_offset_micros;
        if before == micros {
            return;
        }
        self.wanted.origin_mut(origin).clock_offset_micros = micros;
        let is_there = self.sources.has_of(origin);
        for fused in self.maps_mut() {
            // Else another one is still in force there.
            if fused.settings.origin(origin).clock_offset_micros == before {
                fused.settings.origin_mut(origin).clock_offset_micros = micros;
                if is_there {
                    fused.outdated.insert(origin);
                }
            }
        }
    }

    /// The same for what is fused already too: where something was fused with another offset, the map is made anew,
    /// by [`Self::work`], and stays as it is until then. O(streams).
    pub fn apply_clock_offset(&mut self, origin: RobotId, micros: i64) {
        if self.wanted.origin(origin).clock_offset_micros != micros {
            self.set(origin, |set| set.clock_offset_micros = micros);
        } else if self.maps().last().is_some_and(|newest| newest.outdated.contains(&origin)) {
            self.due.insert(origin);
        }
    }

    /// Leaves an origin's layers out of the fused map, or takes them in again; the layers are kept in any case. The
    /// map is made anew by [`Self::work`], and stays as it is until then. O(streams).
    pub fn set_muted(&mut self, origin: RobotId, is_muted: bool) {
        if self.wanted.origin(origin).is_muted != is_muted {
            self.set(origin, |set| set.is_muted = is_muted);
        }
    }

    /// Forgets the layer of a stream, which is gone from the map, and from memory, when that is made anew by
    /// [`Self::work`]; and with the last one of an origin how far its clock is off, unless it has an alignment or
    /// is muted. O(streams).
    pub fn forget(&mut self, stream: Stream) {
        let origin = stream.origin;
        self.sources.forget(stream);
        if self.wanted.is_plain(origin) && !self.sources.iter().any(|(stream, _)| stream.origin == origin) {
            // What comes of the origin from now on is not of the clock that was known; the map says otherwise until it
            // is made anew.
            self.wanted.forget(origin);
            self.due.insert(origin);
        }
        self.forget_plain(origin);
    }

    /// Forgets what is set for an origin of which there is nothing. Else the list would grow with every robot that
    /// ever came by.
    pub(super) fn forget_plain(&mut self, origin: RobotId) {
        let is_there = || self.sources.iter().any(|(stream, _)| stream.origin == origin);
        if self.wanted.is_plain(origin) && !self.sources.has_of(origin) && !is_there() {
            self.settings_mut().for_each(|settings| settings.forget(origin));
            self.maps_mut().for_each(|fused| {
                fused.outdated.remove(&origin);
            });
        }
    }

    /// Where there is nothing of an origin, it is so at once.
    fn set(&mut self, id: RobotId, change: impl Fn(&mut Origin)) {
        if self.sources.has_of(id) {
            change(self.wanted.origin_mut(id));
            self.due.insert(id);
        } else {
            self.settings_mut().for_each(|settings| change(settings.origin_mut(id)));
        }
    }

    pub(super) fn settings_mut(&mut self) -> impl Iterator<Item = &mut Settings> {
        let next = self.next.as_mut().map(|next| &mut next.fused.settings);
        [&mut self.shown.settings, &mut self.wanted].into_iter().chain(next)
    }
}
