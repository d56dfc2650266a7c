//! How a robot of RACER's is set up.

use flockmap::grid::{MapperConfig, RobotId, Voxel, VoxelBox};

/// Voxels of a chunk. The code's default, which none of its launch files changes.
pub const CHUNK_VOXELS: usize = 200;
/// What a robot holds is announced so often, in microseconds. Received chunks wait for the same beat to be
/// taken in.
pub const BEAT_MICROS: i64 = 100_000;
/// A robot is answered again when its own stamps are so much later than at the last answer, in seconds.
pub const ANSWER_PAUSE_S: f64 = 0.3;
/// Chunks that wait in a queue; of more, the oldest are dropped.
pub const QUEUE_CHUNKS_MAX: usize = 5_000;

/// Who hears a chunk, and how it is counted.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum RacerCast {
    /// A shared medium: one datagram, everyone hears it and takes it in, whomever it is meant for. As in
    /// RACER's own simulation.
    #[default]
    Broadcast,
    /// A chunk goes to the robot that it is meant for; an announcement goes to each robot on its own.
    Unicast,
}

/// How a [`RacerRobot`](super::RacerRobot) is set up.
#[derive(Clone, Debug)]
pub struct RacerConfig {
    /// Its id, 1 to `robots`.
    pub id: RobotId,
    /// Robots of the swarm; 1 to 1,000. Known beforehand to all of them.
    pub robots: u16,
    /// How it maps. RACER has a map of its own; any will do, as only the first touch and the state are used.
    pub mapper: MapperConfig,
    /// The grid, known beforehand to all robots: addresses count its voxels, z fastest. At most 2³² voxels.
    /// What lies outside is not sent.
    pub region: VoxelBox,
    /// Who hears a chunk.
    pub cast: RacerCast,
}

impl RacerConfig {
    /// Robot `id` of `robots` with the largest grid that has addresses: 2,048 × 2,048 × 1,024 voxels round
    /// the origin.
    pub fn new(id: RobotId, robots: u16, mapper: MapperConfig) -> Self {
        let (low, high) = (Voxel::new(-1_024, -1_024, -512), Voxel::new(1_023, 1_023, 511));
        // Both corners are within the limits of voxels.
        let region = VoxelBox::spanning(low, high).unwrap_or_else(|| Voxel::new(0, 0, 0).block().voxel_box());
        Self { id, robots, mapper, region, cast: RacerCast::Broadcast }
    }
}
