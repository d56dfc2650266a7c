//! What the fuzzer runs, shared with the test that replays its corpus: `fuzz/README.md` says how to run it.

#[path = "../../../flockmap-codec/tests/fuzz/choices.rs"]
mod choices;
pub(crate) mod datagram;
pub(crate) mod made;
pub(crate) mod package;
pub(crate) mod request;
pub(crate) mod session;
mod session_checks;

pub(crate) use choices::Choices;

use flockmap_sync::wire::{Datagram, DatagramError, HEADER_BYTES, WIRE_VERSION};

/// Where the check of a datagram stands.
const CHECK: core::ops::Range<usize> = 24..28;

/// The datagram with magic and version, kind and check put right, so that what lies behind them is reached too.
pub(crate) fn mended(mut bytes: Vec<u8>, kind: u8) -> Vec<u8> {
    if bytes.len() < HEADER_BYTES {
        bytes.resize(HEADER_BYTES, 0);
    }
    bytes[..4].copy_from_slice(&[b'F', b'M', WIRE_VERSION, kind]);
    with_check(bytes)
}

/// The datagram with the check that fits.
pub(crate) fn with_check(mut bytes: Vec<u8>) -> Vec<u8> {
    if let Err(DatagramError::Check { expected, .. }) = Datagram::new_checked(&bytes) {
        bytes[CHECK].copy_from_slice(&expected.to_le_bytes());
    }
    bytes
}
