//! RACER's map sharing as its code does it, in place of how papers describe it: a session of its own, with every habit kept.
//!
//! Facts from reading the public code (SYSU-STAR/RACER, `plan_env`); nothing of it is used here. What is kept:
//!
//! - A voxel is listed **once, ever**: when this robot's own ray touches it while it is unknown. Flips between Free and
//!   Occupied are never told, and nothing is listed that a team-mate's chunk made known before.
//! - Lists are cut to chunks of 200 voxels, and only while **more than** 200 are pending: 1 to 200 always stay behind.
//! - The states of a chunk are taken when it is **first sent**, and frozen: later sends and relays repeat them.
//! - Everyone announces the chunks it holds every 0.1 s, also when idle. Who hears that, and has not answered the same robot in
//!   the last 0.3 s of that robot's clock, sends **all** that is missing back to back: no budget, no order by age, and what is still
//!   under way is sent again.
//! - Everyone holds the chunks of all robots for ever and answers for all of them, but not for the requester's own.
//! - The receiver overwrites what it had. There are no stamps, and no runs: a robot that starts again begins at chunk 1, and its
//!   new chunks are taken for known.
//!
//! What is not kept: a datagram that is damaged is refused, where the code would write outside of its arrays.

mod message;
mod robot;
#[cfg(test)]
mod tests;

pub use message::{ChunkData, ChunkStamps, Topic};
pub use robot::{RacerEvent, RacerRobot, RacerTransmit};

use flockmap::grid::{MapperConfig, Resolution, RobotId, Voxel, VoxelBox};

/// Voxels of a chunk. The code's default, which none of its launch files changes.
pub const CHUNK_VOXELS: usize = 200;
/// What a robot holds is announced so often, in microseconds. Received chunks wait for the same beat to be taken in.
pub const BEAT_MICROS: i64 = 100_000;
/// A robot is answered again when its own stamps are so much later than at the last answer, in seconds.
pub const ANSWER_PAUSE_S: f64 = 0.3;
/// Chunks that wait in a queue; of more, the oldest are dropped.
pub const QUEUE_CHUNKS_MAX: usize = 5_000;

/// Who hears a chunk, and how it is counted.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum RacerCast {
    /// A shared medium: one datagram, everyone hears it and takes it in, whomever it is meant for. As in RACER's own simulation.
    #[default]
    Broadcast,
    /// A chunk goes to the robot that it is meant for; an announcement goes to each robot on its own.
    Unicast,
}

/// What a [`RacerRobot`] is told.
#[derive(Clone, Debug)]
pub struct RacerConfig {
    /// Its id, 1 to `robots`.
    pub id: RobotId,
    /// Robots of the swarm; 1 to 1,000. Known beforehand to all of them.
    pub robots: u16,
    /// How it maps. RACER has a map of its own; any will do, as only the first touch and the state are used.
    pub mapper: MapperConfig,
    /// The grid, known beforehand to all robots: addresses count its voxels, z fastest. At most 2³² voxels. What lies
    /// outside is not told.
    pub region: VoxelBox,
    /// Who hears a chunk.
    pub cast: RacerCast,
}

impl RacerConfig {
    /// Robot `id` of `robots` with the largest grid that has addresses: 2,048 × 2,048 × 1,024 voxels round the origin.
    pub fn new(id: RobotId, robots: u16, mapper: MapperConfig) -> Self {
        let (low, high) = (Voxel::new(-1_024, -1_024, -512), Voxel::new(1_023, 1_023, 511));
        // Both corners are within the limits of voxels.
        let region = VoxelBox::spanning(low, high).unwrap_or_else(|| Voxel::new(0, 0, 0).block().voxel_box());
        Self { id, robots, mapper, region, cast: RacerCast::Broadcast }
    }

    /// The side of a voxel.
    pub const fn resolution(&self) -> Resolution {
        self.mapper.resolution
    }
}
