//! Map packages: how the changes of an occupancy map, or its state as it is, become bytes and come back.
//!
//! A [`Package`] is a small header and a payload in one of the [`Codec`]s. It stands for itself: it names its
//! stream, index, time, resolution and box, and carries a check of its *decoded* content, so that a damaged
//! header or a wrong decode is always an error and never a wrong voxel. The bytes are specified in `WIRE.md`,
//! section "Map packages".
//!
//! ```
//! use flockmap_codec::{Codec, Content, Cycle, Encoder, PACKAGE_BYTES_MAX, Package};
//! use flockmap_grid::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
//!
//! let changes = Changes::from_voxels([
//!     (Voxel::new(3, -1, 0), State::Occupied),
//!     (Voxel::new(2, -1, 0), State::Free),
//! ]);
//! let cycle = Cycle {
//!     stream: Stream { origin: RobotId(7), epoch: 1 },
//!     start: Stamp(0),
//!     end: Stamp(500_000),
//!     resolution: Resolution::from_metres(0.1).unwrap(),
//!     sensor: [0, 0, 16],
//! };
//! let mut encoder = Encoder::new();
//! let packages = encoder.encode_cycle(Codec::Paper, &cycle, 1, &changes, PACKAGE_BYTES_MAX)?;
//! assert_eq!(packages.len(), 1);
//!
//! let received = Package::parse(packages[0].bytes())?;
//! assert_eq!(received.header().cycle_end, Stamp(500_000));
//! assert_eq!(received.decode()?, Content::Changes(changes));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

mod check;
mod code_grid;
mod codec;
mod decoder;
mod deflate;
mod encoder;
mod error;
mod flock;
mod header;
mod hilbert;
mod pack;
mod package;
mod piece;
mod reference;
mod stamps;
mod states;
mod tiles;
mod told;
mod varint;
mod work;

#[cfg(feature = "training")]
pub use flock::training;

pub use codec::{Codec, UnknownCodec};
pub use decoder::Decoder;
pub use encoder::{Cycle, Encoder, Span};
pub use error::{EncodeError, PackageError};
pub use header::{ContentKind, FAR_METRES, FORMAT_VERSION, Header, Priority};
pub use hilbert::hilbert_order;
pub use package::{Content, Package};
pub use reference::Reference;
pub use tiles::TilesRead;

/// Largest package that goes into one datagram: a datagram header and an authentication tag still fit beside it
/// in 1,200 bytes of UDP payload, which no ordinary link fragments.
pub const PACKAGE_BYTES_MAX: usize = 1150;

/// Smallest size limit that [`Encoder`] takes: one voxel fits in it whatever the header holds.
pub const PACKAGE_BYTES_MIN: usize = 192;

/// Most voxels in the box of one package, 2²⁷. A larger box is refused before memory is taken for it, and so is one
/// that the payload could not fill: under 2²³ voxels for a package of [`PACKAGE_BYTES_MAX`] bytes. ([`Codec::Racer`]
/// takes memory for the voxels it lists, not for its box.)
pub const BOX_VOXELS_MAX: u64 = 1 << 27;
