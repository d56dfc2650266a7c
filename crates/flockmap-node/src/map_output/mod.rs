//! The fused map for planners of other processes: sockets from which it is read, as `docs/map-output.md` says.
//!
//! Readers of the same process come through [`MapReaders`]. The driver hands out a view, which costs nothing; a thread of its own serves the readers. Each of them gets
//! what changed since its last frame, so no queue builds up for a slow one, and none waits for another.

mod giver;
mod outlet;
mod said;
mod server;
mod submaps;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

pub use outlet::MapReaders;
pub(crate) use outlet::Outlet;
pub use said::{links_of, poses_of, submaps_of};

/// Where planners of other processes read the fused map. Whoever can connect can read it all.
///
/// A reader takes up to 400 kB here, and as much again in buffers of the system: 13 MB for 16 of them. While
/// there are readers, the newest view is kept, so that each region of the map that changes is copied once.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct MapOutput {
    /// A Unix socket: its file, and the permissions of that, such as `0o600`.
    pub unix: Option<(PathBuf, u32)>,
    /// An address to listen at.
    pub tcp: Option<SocketAddr>,
    /// Most readers at once; a further one is refused with a word.
    pub readers_max: usize,
    /// A new view is given out so often at most.
    pub period: Duration,
    /// Name of the frame of the map, for people.
    pub frame: String,
}

impl Default for MapOutput {
    /// Nowhere; 16 readers, 20 ms.
    fn default() -> Self {
        Self {
            unix: None,
            tcp: None,
            readers_max: 16,
            period: Duration::from_millis(20),
            frame: "map".into(),
        }
    }
}
