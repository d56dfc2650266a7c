//! PACKAGES datagrams: one or several whole map packages.

use super::{
    DATAGRAM_BYTES_MAX, Datagram, DatagramError, DatagramHeader, Kind, put_record, record_len, seal,
};
use flockmap_codec::Package;

const PACKAGE: u8 = 16;

/// All packages of a datagram; records of unknown types are skipped. Holds at most as many bytes as the
/// datagram has.
pub fn parse_packages(datagram: &Datagram<'_>) -> Result<Vec<Package>, DatagramError> {
    let sender = datagram.header().sender.origin;
    datagram
        .records()
        .filter(|(id, _)| *id == PACKAGE)
        .map(|(_, bytes)| Package::parse(bytes).map_err(|error| DatagramError::Package { sender, error }))
        .collect()
}

/// Collects packages into one datagram for as long as they fit.
#[derive(Clone, Debug)]
pub struct PackagesWriter {
    bytes: Vec<u8>,
    bytes_max: usize,
}

impl PackagesWriter {
    /// An empty datagram that never grows beyond `bytes_max` (at most [`DATAGRAM_BYTES_MAX`]).
    pub fn new(header: DatagramHeader, bytes_max: usize) -> Self {
        let header = DatagramHeader { kind: Kind::Packages, ..header };
        Self { bytes: header.emit(), bytes_max: bytes_max.min(DATAGRAM_BYTES_MAX) }
    }

    /// Adds a package; `false`, with nothing changed, if it does not fit any more.
    pub fn push(&mut self, package: &Package) -> bool {
        let fits = self.bytes.len() + record_len(package.bytes().len()) <= self.bytes_max;
        if fits {
            put_record(&mut self.bytes, PACKAGE, package.bytes());
        }
        fits
    }

    /// Bytes of the datagram so far.
    pub fn bytes(&self) -> usize {
        self.bytes.len()
    }

    /// The complete datagram.
    pub fn finish(self) -> Vec<u8> {
        seal(self.bytes)
    }
}
