//! Datagrams as the simulator reads them, with the key of the swarm and the salts of all runs if there is one.

use flockmap::sync::SwarmKey;
use flockmap::sync::wire::{
    Datagram, DatagramHeader, Kind, PathMessage, Request, Salt, SealedDatagram, is_sealed, parse_packages,
};
use flockmap::{Package, RobotId, Stream};
use std::collections::BTreeMap;

/// Intervals taken of each list of a request.
const INTERVALS_MAX: usize = 256;

/// What a datagram says.
pub(super) enum Content {
    Request(Box<Request>),
    Packages(Vec<Package>),
    Path(PathMessage),
}

/// What it takes to open whatever is sealed in a swarm.
#[derive(Default)]
pub(super) struct Keys {
    pub(super) key: Option<SwarmKey>,
    pub(super) salts: BTreeMap<Stream, Salt>,
}

impl Keys {
    /// Reads a datagram as `reader` does; `None` if it is damaged, sealed with another key, or for another robot.
    pub(super) fn read(&self, bytes: &[u8], reader: RobotId) -> Option<(DatagramHeader, Content)> {
        if is_sealed(bytes) {
            let sealed = SealedDatagram::new_checked(bytes).ok()?;
            let salt = self.salts.get(&sealed.sender())?;
            let opened = sealed.open(self.key.as_ref()?, salt, reader).ok()?;
            return content(&opened.datagram().ok()?);
        }
        content(&Datagram::new_checked(bytes).ok()?)
    }
}

fn content(datagram: &Datagram<'_>) -> Option<(DatagramHeader, Content)> {
    let content = match datagram.header().kind {
        Kind::Request => Content::Request(Box::new(Request::parse(datagram, INTERVALS_MAX).ok()?)),
        Kind::Packages => Content::Packages(parse_packages(datagram).ok()?),
        Kind::Path => Content::Path(PathMessage::parse(datagram).ok()?),
    };
    Some((*datagram.header(), content))
}
