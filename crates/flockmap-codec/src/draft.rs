//! What the codecs make: packages but for their headers.

use crc32fast::Hasher;
use flockmap_grid::{Changes, Stamp, VoxelBox};

/// What will be a package of changes.
pub(crate) struct BatchDraft {
    pub(crate) changes: Changes,
    /// The box that the payload speaks of.
    pub(crate) region: VoxelBox,
    pub(crate) payload: Vec<u8>,
    /// The newest stamp in the blocks that it was coded against; `None` if it was coded against nothing.
    pub(crate) base: Option<Stamp>,
}

/// What will be a chunk of a snapshot when the number of chunks is known.
pub(crate) struct ChunkDraft {
    pub(crate) region: VoxelBox,
    /// Oldest and newest stamp; zero where nothing is known.
    pub(crate) ends: [Stamp; 2],
    pub(crate) payload: Vec<u8>,
    /// What it decodes to, for the check: the content itself takes a hundred times as much.
    pub(crate) content: Hasher,
}
