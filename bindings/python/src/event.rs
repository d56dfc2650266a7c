//! The events of a robot.

use flockmap::{Event as Happened, Stream};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

/// Something that happened in a robot. What does not belong to its kind is None.
///
/// Kinds: "batch-closed" (own changes go out), "merged" (a package of another robot is in the map), "refused" (a package
/// was not taken in; `text` says why), "snapshot-contains", "caught-up", "peer-seen", "peer-lost", "run-forgotten",
/// "run-begun", "dropped" (for want of room, the farthest and oldest blocks), "complete" (nothing of a stream is lacking any
/// more), "same-identity", "nonces-exhausted", "encode-failed", "other".
#[pyclass(frozen, module = "flockmap", name = "Event")]
#[derive(Default)]
pub(crate) struct Event {
    /// What happened, see above.
    #[pyo3(get)]
    kind: &'static str,
    /// Id of the robot that it is about.
    #[pyo3(get)]
    origin: Option<u16>,
    /// The run of that robot.
    #[pyo3(get)]
    epoch: Option<u64>,
    /// Number of the package.
    #[pyo3(get)]
    index: Option<u32>,
    /// Voxels that the batch or package speaks of.
    #[pyo3(get)]
    voxels: Option<usize>,
    /// Of these: taken over; the others were known to be newer.
    #[pyo3(get)]
    taken: Option<usize>,
    /// Newest time of what it says in seconds, on the clock of that robot.
    #[pyo3(get)]
    stamp: Option<f64>,
    /// What was wrong, if something was.
    #[pyo3(get)]
    text: Option<String>,
    /// Blocks of 8 x 8 x 8 voxels that were dropped.
    #[pyo3(get)]
    blocks: Option<usize>,
    packages: Vec<Vec<u8>>,
}

#[pymethods]
impl Event {
    /// The packages, as they go over the wire.
    #[getter]
    fn packages<'py>(&self, py: Python<'py>) -> Vec<Bound<'py, PyBytes>> {
        self.packages.iter().map(|bytes| PyBytes::new(py, bytes)).collect()
    }

    fn __repr__(&self) -> String {
        let of = |name, value: Option<String>| value.map(|v| format!(", {name}={v}")).unwrap_or_default();
        format!(
            "Event({:?}{}{}{}{})",
            self.kind,
            of("origin", self.origin.map(|id| id.to_string())),
            of("index", self.index.map(|index| index.to_string())),
            of("voxels", self.voxels.map(|voxels| voxels.to_string())),
            of("text", self.text.clone()),
        )
    }
}

impl Event {
    fn of(kind: &'static str, stream: Stream) -> Self {
        Self { kind, origin: Some(stream.origin.0), epoch: Some(stream.epoch), ..Self::default() }
    }
}

impl From<Happened> for Event {
    fn from(event: Happened) -> Self {
        let bare = |kind| Self { kind, ..Self::default() };
        match event {
            Happened::BatchClosed { batch, changes, packages } => Self {
                voxels: Some(changes.len()),
                stamp: Some(batch.end.seconds()),
                packages: packages.iter().map(|package| package.bytes().to_vec()).collect(),
                ..bare("batch-closed")
            },
            Happened::Merged { stream, index, batch_end, changes, taken, package, .. } => Self {
                index: Some(index),
                voxels: Some(changes.len()),
                taken: Some(taken),
                stamp: Some(batch_end.seconds()),
                packages: vec![package.bytes().to_vec()],
                ..Self::of("merged", stream)
            },
            Happened::Refused { stream, index, reason } => {
                Self { index: Some(index), text: Some(reason.to_string()), ..Self::of("refused", stream) }
            }
            Happened::SnapshotContains { stream, .. } => Self::of("snapshot-contains", stream),
            Happened::CaughtUp { stream, upto } => {
                Self { index: Some(upto), ..Self::of("caught-up", stream) }
            }
            Happened::PeerSeen(stream) => Self::of("peer-seen", stream),
            Happened::PeerLost(stream) => Self::of("peer-lost", stream),
            Happened::RunForgotten(stream) => Self::of("run-forgotten", stream),
            Happened::RunBegun(stream) => Self::of("run-begun", stream),
            Happened::Dropped { stream, blocks, .. } => {
                Self { blocks: Some(blocks), ..Self::of("dropped", stream) }
            }
            Happened::Complete { stream } => Self::of("complete", stream),
            Happened::SameIdentity => bare("same-identity"),
            Happened::NoncesExhausted => bare("nonces-exhausted"),
            Happened::EncodeFailed(error) => Self { text: Some(error.to_string()), ..bare("encode-failed") },
            other => Self { text: Some(format!("{other:?}")), ..bare("other") },
        }
    }
}
