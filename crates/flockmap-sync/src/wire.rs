//! Datagrams as bytes: a header, then length-prefixed records. The layout, byte by byte, is in `WIRE.md`,
//! section "Datagrams".
//!
//! Two levels: [`Datagram`] is a checked view of received bytes; [`Request`] and [`parse_packages`] give what
//! the records of the two kinds of datagram say. A reader skips records of types that it does not know. Where
//! the swarm has a key, datagrams travel sealed: [`seal_datagram`] on the one side, [`SealedDatagram`] on the
//! other.

mod coded;
mod datagram;
mod newest;
mod packages;
mod path;
mod received;
mod request;
mod sealed;

pub(crate) use coded::{Coded, parse_coded};
pub use datagram::{
    DATAGRAM_BYTES_MAX, Datagram, DatagramError, DatagramHeader, HEADER_BYTES, Kind, LAYOUT, WIRE_VERSION,
};
pub use newest::{Heard, ReceivedNewest};
pub use packages::{
    CONTENTS_BYTES_MAX, Contents, PackagesWriter, asks_for_request, parse_contents, parse_packages,
};
pub use path::PathMessage;
pub use received::{InPart, Received, RestRequest};
pub use request::{ClockReport, Echo, OriginRange, Request, SnapshotRequest, TransferProgress};
pub use sealed::{
    COUNTER_MAX, OpenedDatagram, SALT_BYTES, SEAL_BYTES, Salt, SealedDatagram, is_sealed, seal_bytes,
    seal_datagram,
};

#[cfg(test)]
mod tests;
