//! The events of a robot, for its driver.

use flockmap_codec::{Batch, Package};
use flockmap_grid::{Changes, FusionError, Stamp, Stream};
use flockmap_sync::IntervalSet;

/// Something worth knowing. Need not be polled: what is not read is dropped, oldest first; 1,024 are kept,
/// and of them so many that they hold at most 16 MiB.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Event {
    /// An own batch was closed and its packages are going out.
    BatchClosed {
        /// Its time.
        batch: Batch,
        /// What changed.
        changes: Changes,
        /// The packages made of it.
        packages: Vec<Package>,
    },
    /// A package of another robot, or of a former run of this one, is in its layer and in the fused map.
    Merged {
        /// Whose observations these are.
        stream: Stream,
        /// Number of the package.
        index: u32,
        /// Oldest time of what it says, on the origin's clock.
        batch_start: Stamp,
        /// Newest time of what it says, on the origin's clock.
        batch_end: Stamp,
        /// What it says. Empty for a chunk of a snapshot.
        changes: Changes,
        /// Voxels of the layer that were taken over; the others were known to be newer.
        taken: usize,
        /// The package itself. Who stores these, and the own ones of [`Self::BatchClosed`], in the order of
        /// the events can give them back to [`Robot::restore`](crate::Robot::restore).
        package: Package,
    },
    /// A package was not taken in. It is counted, and asked for again unless that is useless.
    Refused {
        /// Its stream.
        stream: Stream,
        /// Its index.
        index: u32,
        /// What was wrong.
        reason: Refusal,
    },
    /// All chunks of a snapshot of a history with gaps were merged, and so these packages are held, though
    /// they never came. Who stores the chunks stores this behind them, for
    /// [`Robot::restore_contents`](crate::Robot::restore_contents).
    SnapshotContains {
        /// The stream.
        stream: Stream,
        /// The snapshot, as its chunks say.
        snapshot_id: u32,
        /// The packages that it contains.
        received: IntervalSet,
    },
    /// All packages up to this one are held now, by a snapshot.
    CaughtUp {
        /// The stream.
        stream: Stream,
        /// The newest package contained.
        upto: u32,
    },
    /// For want of room something was dropped from a layer, or did not come in: the own one (`own_layer_bytes_max`),
    /// or that of another (`layer_bytes_max`). What is far and old goes first. Its packages count as held, and are
    /// passed on as long as they are stored.
    Dropped {
        /// The stream.
        stream: Stream,
        /// Blocks of 8³ voxels.
        blocks: usize,
        /// None of it is newer, on the origin's clock.
        newest: Stamp,
    },
    /// Of a stream of which something was lacking all has come: nothing is lacking any more.
    Complete {
        /// The stream.
        stream: Stream,
    },
    /// A robot was heard for the first time, or again, or in a new run.
    PeerSeen(Stream),
    /// A robot has not been heard for a while.
    PeerLost(Stream),
    /// An ended run of a robot was forgotten, since there were too many streams or too many runs of one
    /// robot: its layer is gone here, and the fused map is made without it.
    RunForgotten(Stream),
    /// The own id was used with a higher epoch, by an earlier run whose clock was ahead or by another robot:
    /// so this one has begun anew above that, with what it had published until then. A driver that keeps
    /// epochs on disk stores this one.
    RunBegun(Stream),
    /// Another robot uses the own id. Give one of them another.
    SameIdentity,
    /// With a swarm key: this run has sealed all the datagrams that it can (2⁴⁷) and sends no more. Start again.
    NoncesExhausted,
    /// Own changes could not be coded, and are lost to the others. Please report it: this should not happen.
    EncodeFailed(flockmap_codec::EncodeError),
}

/// Why a package was not taken in.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Refusal {
    /// It is damaged, or of a version that is not known; or what it builds on is gone, then a snapshot is
    /// asked for.
    #[error(transparent)]
    Package(#[from] flockmap_codec::PackageError),
    /// There is no room for it.
    #[error(transparent)]
    Fusion(#[from] FusionError),
    /// It is a chunk of a snapshot that takes more than may be held of snapshots while they are read. It is
    /// asked for again.
    #[error(
        "of its snapshot {received} bytes are received, and with it there may be more than half of layer_bytes_max ({max})"
    )]
    Chunks {
        /// Bytes held of the snapshot.
        received: usize,
        /// The limit.
        max: usize,
    },
    /// It waited for the packages that it builds on, and there was no room for it any more. It is asked for
    /// again.
    #[error("it waited for package {base}, or one before that, and there is no room for more that wait")]
    Waiting {
        /// The newest package that it builds on.
        base: u32,
    },
    /// Its voxels have another size. It is held and passed on, but not merged.
    #[error("voxels of {got:?}, this robot has {own:?}: give all robots the same resolution")]
    Resolution {
        /// Of the package.
        got: flockmap_grid::Resolution,
        /// Of this robot.
        own: flockmap_grid::Resolution,
    },
}
