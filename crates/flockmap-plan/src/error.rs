//! Why a question about a map has no answer.

/// Blocks that one question may look at: 0.1 s or so, whatever is in them, and 24 bytes meanwhile for each that a sweep
/// comes near: 50 MB at most.
pub const QUESTION_BLOCKS_MAX: u64 = 1 << 20;

/// Why a question about a map has no answer.
#[derive(Clone, Copy, PartialEq, Debug, thiserror::Error)]
pub enum QuestionError {
    /// A number that is not finite, a length below 0, or a place beyond [`flockmap_grid::VOXEL_LIMIT`].
    #[error("a position or a size is not finite, negative, or outside of the map's grid: {0}")]
    NotInGrid(f64),
    /// It would look at more than [`QUESTION_BLOCKS_MAX`] blocks of 8³ voxels.
    #[error(
        "this looks at {blocks} blocks of 8³ voxels, and at most {QUESTION_BLOCKS_MAX} are allowed: ask for less at a time"
    )]
    TooLarge {
        /// How many it would look at.
        blocks: f64,
    },
    /// Slices that belong together are not of the same length.
    #[error("slices of {0} and of {1} elements, which must be of the same length")]
    Lengths(usize, usize),
}
