//! What a store counts.

/// What came back from a store.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Restored {
    /// Packages, and chunks of snapshots, that were read.
    #[cfg_attr(feature = "serde", serde(rename = "restored"))]
    pub packages: u64,
    /// Of these: merged. The others wait for packages that are gone, say what is known already, or have no
    /// room: see the robot's counters.
    #[cfg_attr(feature = "serde", serde(rename = "restored_merged"))]
    pub merged: u64,
    /// Records that are whole and cannot be used: of another version of the packages.
    pub unreadable: u64,
    /// Bytes between sound records that are none: damage on the disk.
    pub skipped_bytes: u64,
    /// Bytes behind the last sound record of a segment, cut off: what was being written when a run ended.
    pub torn_bytes: u64,
    /// Segments whose header is damaged, or that could not be read to their end.
    pub damaged_segments: u64,
}

/// What a store did in this run.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct StoreCounters {
    /// What came back at the start.
    #[cfg_attr(feature = "serde", serde(flatten))]
    pub restored: Restored,
    /// Packages written in this run.
    pub written: u64,
    /// Bytes of these with their frames.
    pub written_bytes: u64,
    /// Packages that were not written: after a failure, or since the disk did not keep up.
    pub left_out: u64,
    /// Times that what was written was made safe.
    pub syncs: u64,
    /// Times that writing has failed: nothing is stored until it goes on.
    pub failures: u64,
    /// Whether nothing is stored now.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub is_off: bool,
    /// Times that the log was replaced by snapshots.
    pub compactions: u64,
    /// Times that this failed; the log went on.
    pub compactions_failed: u64,
    /// Bytes on disk now.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub disk_bytes: u64,
}
