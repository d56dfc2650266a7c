//! What is sent, and asked for, one by one.

use flockmap_codec::{ContentKind, Package};
use flockmap_grid::Stream;

/// One package, or one tile of a present state.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(crate) enum Item {
    Package { stream: Stream, index: u32 },
    Tile { stream: Stream, set: u32, tile: u32 },
}

impl Item {
    pub(crate) fn of(package: &Package) -> Self {
        let header = package.header();
        match header.content {
            ContentKind::Changes => Self::Package { stream: header.stream, index: header.index },
            ContentKind::Present { set, tile, .. } => Self::Tile { stream: header.stream, set, tile },
        }
    }

    pub(crate) const fn stream(self) -> Stream {
        match self {
            Self::Package { stream, .. } | Self::Tile { stream, .. } => stream,
        }
    }
}
