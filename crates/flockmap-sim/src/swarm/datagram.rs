//! Datagrams as the simulator reads them, with the key of the swarm if there is one.

use flockmap::sync::SwarmKey;
use flockmap::sync::wire::{
    Datagram, DatagramHeader, Kind, Request, Salt, SealedDatagram, is_sealed, parse_packages,
};
use flockmap::{Package, RobotId, Stream};

/// Intervals taken of each list of a request.
const INTERVALS_MAX: usize = 256;

/// What a datagram says.
pub(super) enum Content {
    Request(Box<Request>),
    Packages(Vec<Package>),
    Path,
}

/// The salt of a run: in a swarm that is simulated it follows from the run, so that whoever looks on can open what is sealed.
pub(super) fn salt_of(run: Stream) -> Salt {
    let mut salt = [0x5a; 16];
    salt[..8].copy_from_slice(&run.epoch.to_le_bytes());
    salt[8..10].copy_from_slice(&run.origin.0.to_le_bytes());
    salt
}

/// Reads a datagram as `reader` does; `None` if it is damaged, sealed with another key, or for another robot.
pub(super) fn read(
    bytes: &[u8],
    key: Option<&SwarmKey>,
    reader: RobotId,
) -> Option<(DatagramHeader, Content)> {
    if is_sealed(bytes) {
        let sealed = SealedDatagram::new_checked(bytes).ok()?;
        let opened = sealed.open(key?, &salt_of(sealed.sender()), reader).ok()?;
        return content(&opened.datagram().ok()?);
    }
    content(&Datagram::new_checked(bytes).ok()?)
}

fn content(datagram: &Datagram<'_>) -> Option<(DatagramHeader, Content)> {
    let content = match datagram.header().kind {
        Kind::Request => Content::Request(Box::new(Request::parse(datagram, INTERVALS_MAX).ok()?)),
        Kind::Packages => Content::Packages(parse_packages(datagram).ok()?),
        Kind::Path => Content::Path,
    };
    Some((*datagram.header(), content))
}
