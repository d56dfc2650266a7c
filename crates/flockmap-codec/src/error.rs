//! What can be wrong with a package, and with a call to make one.

use flockmap_grid::BaseSuperseded;

use crate::codec::Codec;
use crate::limits::{BOX_VOXELS_MAX, FORMAT_VERSION, PACKAGE_BYTES_MIN};

/// Bytes that are no package, or a package that does not decode to what was encoded. Its sender or the link is
/// at fault, or it is of a newer Flockmap; nothing of it may be used. Ask for it again.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PackageError {
    /// The bytes end inside a field of the header.
    #[error("package ends at byte {offset}, inside {field}")]
    Truncated {
        /// The field that is cut.
        field: &'static str,
        /// Where the bytes end.
        offset: usize,
    },
    /// Another version of the format.
    #[error("package format version {found}, this program reads version {FORMAT_VERSION}")]
    Version {
        /// The first byte of the package.
        found: u8,
    },
    /// A codec that this version does not know.
    #[error("package codec {found} is not known; the sender may be newer")]
    Codec {
        /// The number of the codec.
        found: u8,
    },
    /// A number that is too large, or written longer than needed.
    #[error("package field {field} at byte {offset} is no number of at most {max} in its shortest form")]
    Number {
        /// The field.
        field: &'static str,
        /// Where it begins.
        offset: usize,
        /// The largest value that it may have.
        max: u64,
    },
    /// Fields that contradict a rule of the format.
    #[error("package header: {rule}")]
    Header {
        /// The rule that is broken.
        rule: &'static str,
    },
    /// A box too large for its payload or for any package.
    #[error(
        "package box has {voxels} voxels, its {payload} bytes of {codec} payload can hold {limit} at most"
    )]
    BoxTooLarge {
        /// Voxels in the box.
        voxels: u128,
        /// Bytes of payload.
        payload: usize,
        /// The codec of the payload.
        codec: Codec,
        /// Most voxels for a payload of this length.
        limit: u64,
    },
    /// A payload that would take long to read for its length. What had been read of it is dropped.
    #[error(
        "package payload ({codec}) of {payload} bytes asks for more than {limit} steps of work, the most for that length"
    )]
    Work {
        /// The codec of the payload.
        codec: Codec,
        /// Bytes of payload.
        payload: usize,
        /// Most steps for a payload of this length, as `WIRE.md` counts them.
        limit: u64,
    },
    /// The package was coded against what earlier packages said, and was to be decoded without that.
    #[error("package was coded against the packages up to {base}, which are needed to decode it")]
    BaseMissing {
        /// The newest package that is needed.
        base: u32,
    },
    /// A chunk that is coded against the chunks of its snapshot before it, and is not the next of them.
    #[error("chunks of this snapshot are coded one against the other; chunk {chunk} comes next")]
    ChunkMissing {
        /// The number of the chunk that comes next.
        chunk: u32,
    },
    /// What the package was coded against is gone: something newer has been applied. Only a snapshot can
    /// bring what it says.
    #[error(transparent)]
    BaseSuperseded(#[from] BaseSuperseded),
    /// The payload breaks a rule of its codec.
    #[error("package payload ({codec}): {rule}")]
    Payload {
        /// The codec of the payload.
        codec: Codec,
        /// The rule that is broken.
        rule: &'static str,
    },
    /// Header and content do not match the check, so one of them is damaged.
    #[error("package check is {stated:#010x}, header and decoded content give {found:#010x}")]
    Check {
        /// The check in the package.
        stated: u32,
        /// The check of what was read.
        found: u32,
    },
}

/// A package that cannot be made. The caller is at fault.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// There is nothing to say.
    #[error("no voxel changed: there is nothing to encode")]
    Empty,
    /// The box around the changes is too large for one package.
    #[error(
        "the box around the changes has {voxels} voxels, a package holds {BOX_VOXELS_MAX} at most; use encode_batch, which splits"
    )]
    BoxTooLarge {
        /// Voxels in the box.
        voxels: u128,
    },
    /// The changes say so much in so few bytes that no reader takes them in one package.
    #[error(
        "the changes as one package would ask for more work than a reader takes; use encode_batch, which splits"
    )]
    TooMuchWork,
    /// A voxel outside of the limits of the grid.
    #[error("a voxel lies outside of ±{}", flockmap_grid::VOXEL_LIMIT)]
    OutsideGrid,
    /// The size limit is too small for anything.
    #[error("packages of at most {bytes_max} bytes are too small, at least {PACKAGE_BYTES_MIN} are needed")]
    BytesMaxTooSmall {
        /// The limit that was asked for.
        bytes_max: usize,
    },
    /// A batch that ends before it starts.
    #[error("the batch ends before it starts")]
    BatchEndsBeforeStart,
    /// The layer to code against holds something as new as the batch.
    #[error(transparent)]
    BaseSuperseded(#[from] BaseSuperseded),
    /// Index 0, or past the last index.
    #[error("package indices run from 1 to {}; {first} with {count} packages does not fit", u32::MAX)]
    IndexOutOfRange {
        /// The first index.
        first: u32,
        /// Number of packages.
        count: usize,
    },
    /// A snapshot that breaks a rule of [`flockmap_grid::Snapshot`].
    #[error("snapshot: {rule}")]
    Snapshot {
        /// The rule that is broken.
        rule: &'static str,
    },
}
