//! What one call of a robot has time for.

/// Steps of work on packages in one call, as the codec counts them: some 15 ms on the machine of `BENCHMARK.md`. The
/// last one may go beyond. What is left of many that waited for one waits for the next call.
pub(crate) const MERGE_STEPS_MAX: u64 = 1_500_000;
/// To merge a block of a package, in steps of the codec.
pub(crate) const MERGE_BLOCK_STEPS: u64 = 8_000;

/// What takes long, each in its turn.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub(crate) enum Work {
    /// The fused map by what was set, and layers that were forgotten.
    #[default]
    Rebuild,
    /// Snapshots for peers.
    Snapshots,
    /// What a former run published.
    Republish,
}

impl Work {
    pub(crate) const fn next(self) -> Self {
        match self {
            Self::Rebuild => Self::Snapshots,
            Self::Snapshots => Self::Republish,
            Self::Republish => Self::Rebuild,
        }
    }
}
