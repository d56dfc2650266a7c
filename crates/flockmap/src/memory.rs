//! The most that others can make a robot hold, reckoned from its options.

use crate::RobotConfig;
use crate::events::{EVENTS_BYTES_MAX, EVENTS_MAX};
use crate::tiles::{SETS_MAX, WAITING_MAX as TILES_WAITING_MAX};
use crate::waiting::{WAITING_BYTES_MAX, WAITING_MAX};

/// A block of a layer in which each of 512 voxels changed last in another cycle, with what it was before, its place in half-full maps,
/// and its part of the fused map.
const LAYER_BLOCK: usize = 20_000;
/// Where the sensor was in a cycle: of 65,536 of each stream.
const SENSORS: usize = 65_536 * 48;
/// A package in memory: its bytes, its header, its place in a map.
const PACKAGE: usize = 1_150 + 400;
/// An event, beside its changes.
const EVENT: usize = 256;
/// Decoding a present state of the largest box that a datagram can tell, the tables of the codecs, and lists of changes on their way
/// into a layer.
const WORK: usize = 32 << 20;

impl RobotConfig {
    /// The most bytes that others can make a robot with these options hold on the heap, whatever they send, as asked of the
    /// allocator: the session ([`memory_max`](flockmap_sync::SessionConfig::memory_max)), the layers and the fused map, packages and
    /// tiles that wait, present states that are being read, events that nobody takes. The own map has
    /// `mapper.memory_bytes_max` beside that.
    ///
    /// By far the largest part is `fusion.layer_blocks_max`, where the worst case (20 kB a block) is 28 times what honest flights
    /// take: 8 GB by default, and four times that while four present states are being read that tell as much. Where others are
    /// not trusted, make it smaller.
    pub const fn memory_of_others_max(&self) -> usize {
        let layers = self.fusion.layer_blocks_max * LAYER_BLOCK;
        self.session.memory_max()
            + layers * (1 + SETS_MAX)
            + (self.session.streams_max + 1) * SENSORS
            + WAITING_BYTES_MAX
            + WAITING_MAX * 400
            + SETS_MAX * TILES_WAITING_MAX * PACKAGE
            + EVENTS_BYTES_MAX
            + EVENTS_MAX * EVENT
            + WORK
    }
}
