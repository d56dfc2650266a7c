//! The most that others can make a robot hold, reckoned from its options.

use flockmap_grid::UNPACKED_BYTES_MAX;

use crate::RobotConfig;
use crate::events::{EVENTS_BYTES_MAX, EVENTS_MAX};
use crate::readers::bytes_max as readers_bytes_max;
use crate::snapshots::{BYTES_MAX as SNAPSHOT_BYTES_MAX, KEPT_BYTES_MAX};

/// An event, beside its changes.
const EVENT: usize = 256;
/// A chunk that was read and has no place in a layer yet: 144 bytes for each of at most four blocks a byte.
const UNMERGED: usize = 1_150 * 4 * 144;
/// Decoding a package of the largest box that it can hold, the tables of the codecs, lists of changes going
/// into a layer; and what the last merge may add to the fused map, and the last chunk to what was read,
/// beyond their limits.
const WORK: usize = 64 << 20;

impl RobotConfig {
    /// The most bytes that others can make a robot with these options hold on the heap, whatever they send,
    /// as asked of the allocator: the session ([`memory_max`](flockmap_sync::SessionConfig::memory_max)), the
    /// layers and what they add to the fused map (`fusion.layer_bytes_max`), snapshots that are being read (half as
    /// much), parts of layers and of the fused map that were unpacked to be read, events that nobody takes; a snapshot
    /// that is being made, 256 MiB at most, and the layer as it was when that was begun, which is shared with the layer
    /// but for what changes until it is made; and layers as they were of which further pieces are to be made, 32 MiB beside
    /// what they share. By default 2.7 GB, by broadcast 3.0 GB, of which honest
    /// robots make it hold a tenth.
    ///
    /// Beside that there is what the robot itself sees: the own map (`mapper.memory_bytes_max`, and a sixth
    /// of it in the fused map) and the own layer (`fusion.own_layer_bytes_max`; what changes of it while a snapshot of
    /// it is made is there twice). A [`MapView`](flockmap_grid::MapView) that is kept while the map goes on takes once
    /// more what the fused map took when it was made. An alignment that is set when the layers are full already may make
    /// the fused map larger, and until it is in force there are two of them: meanwhile, less is taken into the layers.
    pub const fn memory_of_others_max(&self) -> usize {
        self.session.memory_max()
            + self.fusion.layer_bytes_max
            + readers_bytes_max(self.fusion.layer_bytes_max)
            + self.session.transfers_max * (UNMERGED + UNPACKED_BYTES_MAX)
            // Of layers, and of the fused map.
            + 2 * UNPACKED_BYTES_MAX
            // A copy of a layer; the state that is coded; its chunks, in two codecs.
            + self.fusion.layer_bytes_max
            + SNAPSHOT_BYTES_MAX
            + KEPT_BYTES_MAX
            + 4 * self.session.snapshot_bytes_max
            + EVENTS_BYTES_MAX
            + EVENTS_MAX * EVENT
            + WORK
    }
}
