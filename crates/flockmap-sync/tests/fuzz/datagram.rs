//! Any bytes as a datagram: as they came, and with the header put right.

use flockmap_sync::wire::{Datagram, DatagramError, Kind, Request, parse_packages};

use super::{mended, with_check};

const INTERVALS_MAX: usize = 256;

pub(crate) fn run(input: &[u8]) {
    let _ = read(input);
    let _ = read(&with_check(input.to_vec()));
    for kind in 1..=3 {
        let bytes = mended(input.to_vec(), kind);
        let result = read(&bytes);
        let is_known = !matches!(
            result,
            Err(DatagramError::Check { .. } | DatagramError::Magic { .. } | DatagramError::Version { .. })
        );
        assert!(is_known, "{result:?}");
    }
}

/// Reads all of a datagram. What it gives is no more than what the bytes can say.
fn read(bytes: &[u8]) -> Result<(), DatagramError> {
    let result = Datagram::new_checked(bytes);
    // Every error has words.
    let datagram = result.inspect_err(|error| assert!(!error.to_string().is_empty()))?;
    match datagram.header().kind {
        Kind::Path => {
            flockmap_sync::wire::PathMessage::parse(&datagram)?;
        }
        Kind::Request => {
            Request::parse(&datagram, INTERVALS_MAX)?;
        }
        Kind::Packages => {
            let packages = parse_packages(&datagram)?;
            let sum: usize = packages.iter().map(|package| package.bytes().len()).sum();
            // The stream of an own package is that of the datagram: at most 13 bytes.
            let most = bytes.len() + 13 * packages.len();
            assert!(sum < most, "packages of {sum} bytes in a datagram of {}", bytes.len());
            flockmap_sync::wire::parse_contents(&datagram, INTERVALS_MAX)?;
        }
    }
    Ok(())
}
