//! What is sent, and asked for, one by one.

use flockmap_codec::{ContentKind, Package};
use flockmap_grid::Stream;

/// One package, or one chunk of a snapshot.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(crate) enum Item {
    Package { stream: Stream, index: u32 },
    Chunk { stream: Stream, snapshot_id: u32, chunk: u32 },
}

impl Item {
    pub(crate) fn of(package: &Package) -> Self {
        let header = package.header();
        match header.content {
            ContentKind::Changes => Self::Package { stream: header.stream, index: header.index },
            ContentKind::Snapshot { id: snapshot_id, chunk, .. } => {
                Self::Chunk { stream: header.stream, snapshot_id, chunk }
            }
        }
    }

    pub(crate) const fn stream(self) -> Stream {
        match self {
            Self::Package { stream, .. } | Self::Chunk { stream, .. } => stream,
        }
    }
}
