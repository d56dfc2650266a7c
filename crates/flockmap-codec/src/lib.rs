//! Map packages: how the changes of an occupancy map, or its state as it is, become bytes and come back.
//!
//! A [`Package`] is a small header and a payload in one of the [`Codec`]s. It stands for itself: it names its
//! stream, index, time, resolution and box, and carries a check of its *decoded* content, so that a damaged
//! header or a wrong decode is always an error and never a wrong voxel. The bytes are specified in `WIRE.md`,
//! section "Map packages".
//!
//! The modules, each of which knows only those above it:
//!
//! | module | what it holds |
//! |---|---|
//! | [`bytes`] | little-endian integers and varints, read and written |
//! | `limits`, `codec`, `error` | bounds of a package, the codecs by number, what can be wrong |
//! | `fields`, `work` | bytes as fields with errors that name them; the steps that a payload may ask for |
//! | `priority`, `header`, `check`, `package` | the parts of a package, and the whole |
//! | `source`, `base` | what is encoded: a batch or a span, and what it builds on |
//! | `piece`, `draft`, `deflate` | changes cut in two; what has no header yet; zlib |
//! | `paper/` | two bits for each voxel along a Hilbert walk, then zlib; and what the paper compares with |
//! | `flock/` | decisions of an arithmetic coder with trained contexts |
//! | `snapshot_coding` | a snapshot on its way to chunks, coded in pieces |
//! | `encoder`, `decoder` | both codecs behind one face |
//!
//! `paper/` and `flock/` have the same shape: encode a batch, decode a batch, encode a snapshot,
//! decode a chunk of one. They know payloads and no headers.
//!
//! ```
//! use flockmap_codec::{Codec, Content, Batch, Encoder, PACKAGE_BYTES_MAX, Package};
//! use flockmap_grid::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
//!
//! let changes = Changes::from_voxels([
//!     (Voxel::new(3, -1, 0), State::Occupied),
//!     (Voxel::new(2, -1, 0), State::Free),
//! ]);
//! let batch = Batch {
//!     stream: Stream { origin: RobotId(7), epoch: 1 },
//!     start: Stamp(0),
//!     end: Stamp(500_000),
//!     resolution: Resolution::from_metres(0.1).unwrap(),
//!     sensor: [0, 0, 16],
//! };
//! let mut encoder = Encoder::new();
//! let packages = encoder.encode_batch(Codec::Paper, &batch, 1, &changes, PACKAGE_BYTES_MAX)?;
//! assert_eq!(packages.len(), 1);
//!
//! let received = Package::parse(packages[0].bytes())?;
//! assert_eq!(received.header().batch_end, Stamp(500_000));
//! assert_eq!(received.decode()?, Content::Changes(changes));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

mod base;
mod check;
mod codec;
mod decoder;
mod deflate;
mod draft;
mod encoder;
mod error;
mod fields;
mod flock;
mod header;
mod limits;
mod package;
mod paper;
mod piece;
mod priority;
mod snapshot_coding;
mod source;
mod work;

pub mod bytes;

#[cfg(feature = "training")]
pub use flock::training;

pub use base::Base;
pub use codec::{Codec, UnknownCodec};
pub use decoder::{ChunksRead, Decoder};
pub use encoder::Encoder;
pub use error::{EncodeError, PackageError};
pub use header::{ContentKind, Header};
pub use limits::{BOX_VOXELS_MAX, FORMAT_VERSION, PACKAGE_BYTES_MAX, PACKAGE_BYTES_MIN};
pub use package::{Content, Package};
pub use paper::hilbert_order;
pub use priority::{FAR_METRES, Priority};
pub use snapshot_coding::SnapshotCoding;
pub use source::{Batch, Span};
