//! What a robot counts.

/// What a robot counted, beside its session's counters.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct RobotCounters {
    /// Scans taken in.
    pub scans: u64,
    /// Of these: with a stamp ahead of the robot's clock. They count as made when they came. If there are
    /// many, the clock of the sensor is not the robot's.
    pub scans_ahead: u64,
    /// Updates with states of voxels taken in.
    pub states: u64,
    /// Of these: with a stamp ahead of the robot's clock, as for scans.
    pub states_ahead: u64,
    /// Points that were ignored: not finite, too near or too far out.
    pub points_ignored: u64,
    /// Points that were taken for team-mates.
    pub points_masked: u64,
    /// Blocks of the own map that were forgotten under the byte cap.
    pub blocks_forgotten: u64,
    /// Batches closed.
    pub batches: u64,
    /// Batches that were due and were published later, since own packages still waited for the radio's budget.
    pub batches_deferred: u64,
    /// Batches that published only a part of what had changed, the nearest first, since the budget has no
    /// room for more. What was left out is in [`Robot::unpublished`](crate::Robot::unpublished) until it is
    /// published.
    pub batches_in_parts: u64,
    /// Own voxels that changed, added up over batches.
    pub changes: u64,
    /// Own packages made.
    pub packages: u64,
    /// Bytes of these.
    pub package_bytes: u64,
    /// Packages of others merged, chunks of snapshots among them.
    pub merged: u64,
    /// Packages of others that could not be decoded any more, since a later batch or a snapshot had come
    /// before: a present state was asked for in their place.
    pub superseded: u64,
    /// Packages of others that were damaged: not taken in, and asked for again; the second time, if they
    /// build on others, a present state is asked for in their place.
    pub damaged: u64,
    /// Steps of work that packages of others took to read, as `WIRE.md` counts them, refused ones too.
    pub steps: u64,
    /// Packages of others for which there was no room.
    pub no_room: u64,
    /// Blocks of layers that were dropped for want of room, or did not come in ([`Event::Dropped`]).
    ///
    /// [`Event::Dropped`]: crate::Event::Dropped
    pub blocks_dropped: u64,
    /// Packages of others with voxels of another size.
    pub foreign_resolution: u64,
    /// Snapshots made for others.
    pub snapshots: u64,
    /// Of these, pieces of a state that was too large for one.
    pub snapshot_pieces: u64,
    /// Most steps of work that one call took for these; a step is some 10 ns.
    pub snapshot_steps_most: u64,
    /// Runs begun while flying, since the own id was used with a higher epoch.
    pub runs_begun: u64,
    /// Submaps begun in this run, beside the first.
    pub submaps_begun: u64,
    /// How often a submap of this run was moved.
    pub submap_poses: u64,
    /// Bytes of own packages that say when submaps begin and how they lie; they are in `package_bytes` too.
    pub submap_package_bytes: u64,
    /// Own batches that were coded independently, since repair was slow, or something was dropped here or elsewhere.
    pub batches_independent: u64,
    /// Events dropped since nobody polled them.
    pub events_dropped: u64,
}
