//! What a former run stored comes back: its own packages as a stream of the own id with a lower epoch, those
//! of others as they were.

use flockmap_codec::Package;
use flockmap_grid::{Stamp, Stream};
use flockmap_sync::{IntervalSet, RECEIVED_INTERVALS_MAX};

use super::Robot;

/// A stored package that cannot be taken back.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RestoreError {
    /// It is of the own id, and not of a former run.
    #[error(
        "a stored package of {got:?}, but this run is {own:?}: give each run a higher epoch than all before it"
    )]
    NotFormer {
        /// Of the package.
        got: Stream,
        /// Of this run.
        own: Stream,
    },
    /// Its stream has no place: there are too many, or newer runs of the same robot.
    #[error("no room for {0:?}: streams_max or epochs_max is reached")]
    NoRoom(Stream),
}

impl Robot {
    /// Takes back a package, or a chunk of a snapshot, that a former run merged or made; to be called after
    /// [`Robot::new`] and before the first datagram, in the order in which the packages were stored
    /// ([`Event::BatchClosed`](crate::Event::BatchClosed), [`Event::Merged`](crate::Event::Merged); beside
    /// them [`Robot::restore_contents`]).
    ///
    /// It is treated as one that has just been received: it is decoded and checked, merged into the layer of
    /// its stream and into the fused map, held, and offered to others. What builds on a package that is gone
    /// waits for it, and that one is asked for. So whatever is lost or damaged in a store, no voxel comes out
    /// wrong. Packages of a former run of this robot become a layer like a team-mate's, in the own clock and,
    /// unless the alignment of the own id says otherwise, in the own frame.
    ///
    /// # Errors
    /// [`RestoreError`]; nothing is changed then. That one does not decode is an event, as for every package.
    pub fn restore(&mut self, now: Stamp, package: Package) -> Result<(), RestoreError> {
        let (got, own) = (package.header().stream, self.own_stream());
        if got.origin == own.origin && got.epoch >= own.epoch {
            return Err(RestoreError::NotFormer { got, own });
        }
        let now = self.advance(now);
        // What waited for it is merged with it: what comes next from the store may need all of that.
        self.merge_steps_left = u64::MAX;
        let is_taken = self.session.deliver_package(now, package);
        self.answer_session(now);
        if is_taken { Ok(()) } else { Err(RestoreError::NoRoom(got)) }
    }

    /// Takes back which packages a snapshot of a history with gaps contains
    /// ([`Event::SnapshotContains`](crate::Event::SnapshotContains)), behind its chunks. Whether they are
    /// held now: `false` if some chunk of it is gone or damaged, or for the own stream. At most
    /// [`RECEIVED_INTERVALS_MAX`] intervals count.
    pub fn restore_contents(
        &mut self,
        now: Stamp,
        stream: Stream,
        snapshot_id: u32,
        received: &[(u32, u32)],
    ) -> bool {
        let is_sound = received.iter().all(|&(low, high)| 0 < low && low <= high);
        if stream == self.own_stream() || received.len() > RECEIVED_INTERVALS_MAX || !is_sound {
            return false;
        }
        let now = self.advance(now);
        let received = IntervalSet::from_intervals(RECEIVED_INTERVALS_MAX, received.to_vec());
        let is_received = self.session.deliver_contents(now, stream, snapshot_id, received);
        self.answer_session(now);
        is_received
    }
}
