//! What came of a run.

use flockmap::Changes;
use flockmap_cli::measure::Times;

/// A map, and how it was made.
pub(super) struct Mapped {
    /// Of each scan.
    pub(super) times: Times,
    pub(super) map: Changes,
    pub(super) memory_bytes: usize,
}
