//! Datagrams as the simulator reads them, with the key of the swarm if there is one.

use flockmap::Package;
use flockmap::sync::SwarmKey;
use flockmap::sync::wire::{
    Datagram, DatagramHeader, Kind, Request, SealedDatagram, is_sealed, parse_packages,
};

/// Intervals taken of each list of a request.
const INTERVALS_MAX: usize = 256;

/// What a datagram says.
pub(super) enum Content {
    Request(Box<Request>),
    Packages(Vec<Package>),
}

/// Reads a datagram; `None` if it is damaged, or sealed with another key.
pub(super) fn read(bytes: &[u8], key: Option<&SwarmKey>) -> Option<(DatagramHeader, Content)> {
    if is_sealed(bytes) {
        let opened = SealedDatagram::new_checked(bytes).ok()?.open(key?).ok()?;
        return content(&opened.datagram().ok()?);
    }
    content(&Datagram::new_checked(bytes).ok()?)
}

fn content(datagram: &Datagram<'_>) -> Option<(DatagramHeader, Content)> {
    let content = match datagram.header().kind {
        Kind::Request => Content::Request(Box::new(Request::parse(datagram, INTERVALS_MAX).ok()?)),
        Kind::Packages => Content::Packages(parse_packages(datagram).ok()?),
    };
    Some((*datagram.header(), content))
}
