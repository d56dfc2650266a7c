//! Two swarms far apart: the whole repair protocol over Zenoh, one datagram a message. Zenoh keeps no order of its own
//! here and repairs nothing: what finds no place is dropped, as on a radio, and the session paces itself.

use std::collections::BTreeMap;
use std::io;

use flockmap::{Destination, Path, Transmit};
use flockmap_node::{SendResult, Transport};
use tokio::sync::mpsc::{Receiver, Sender, channel};
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::sample::{Locality, Sample};
use zenoh::{Session, Wait};

use crate::keys::is_name;

/// Datagrams that wait for the node; of more, those that come are lost.
const WAITING_MAX: usize = 256;
/// Longest datagram.
const DATAGRAM_BYTES_MAX: usize = 1_200;
/// Others that are known beside those that are reached.
const OTHERS_MAX: usize = 64;

/// A link by a name: all that have it hear each other.
pub(crate) struct Link {
    session: Session,
    prefix: String,
    own: String,
    datagrams: Receiver<(String, Vec<u8>)>,
    _subscribers: [Subscriber<()>; 2],
    others: Others,
}

impl Link {
    /// Joins the link.
    ///
    /// # Errors
    /// What Zenoh says.
    pub(crate) fn open(session: &Session, link: &str) -> io::Result<Self> {
        let prefix = format!("flockmap/@link/{link}");
        let own = session.zid().to_string();
        let (datagrams, datagrams_in) = channel(WAITING_MAX);
        let subscribe = |to: &str| {
            let (prefix, datagrams) = (prefix.clone(), datagrams.clone());
            let subscriber = session.declare_subscriber(format!("{prefix}/*/{to}"));
            let subscriber = subscriber.allowed_origin(Locality::Remote);
            let subscriber = subscriber.callback(move |sample| take(&prefix, &sample, &datagrams));
            subscriber.wait().map_err(|error| io::Error::other(error.to_string()))
        };
        let subscribers = [subscribe("all")?, subscribe(&own)?];
        Ok(Self {
            session: session.clone(),
            prefix,
            own,
            datagrams: datagrams_in,
            _subscribers: subscribers,
            others: Others::default(),
        })
    }
}

fn take(prefix: &str, sample: &Sample, datagrams: &Sender<(String, Vec<u8>)>) {
    let key = sample.key_expr().as_str();
    let from = key.strip_prefix(prefix).and_then(|rest| rest.strip_prefix('/')?.split('/').next());
    if let Some(from) = from.filter(|from| is_name(from))
        && sample.payload().len() <= DATAGRAM_BYTES_MAX
    {
        // What finds no place is lost, and repaired.
        let _ = datagrams.try_send((from.to_owned(), sample.payload().to_bytes().into_owned()));
    }
}

impl Transport for Link {
    /// What Zenoh and TCP add, about: the key, headers, a part of an acknowledgement.
    const OVERHEAD_BYTES: u32 = 200;

    async fn receive(&mut self, buffer: &mut [u8]) -> io::Result<(usize, Path)> {
        match self.datagrams.recv().await {
            Some((from, bytes)) => {
                let length = bytes.len().min(buffer.len());
                buffer[..length].copy_from_slice(&bytes[..length]);
                Ok((length, self.others.note(from)))
            }
            // The subscribers are there for as long as this is.
            None => std::future::pending().await,
        }
    }

    fn set_paths(&mut self, paths: &[Path]) {
        self.others.used = paths.to_vec();
    }

    async fn send(&mut self, transmit: &Transmit) -> SendResult {
        let to = match transmit.to {
            Destination::Peer(_) => transmit.path.and_then(|path| self.others.name(path)),
            Destination::Everyone => Some("all"),
        };
        let Some(to) = to else { return SendResult { copies: 0, failed: 1 } };
        let key = format!("{}/{}/{to}", self.prefix, self.own);
        // What waits longer than it is worth is better lost.
        let put = self.session.put(key, transmit.bytes.to_vec()).congestion_control(CongestionControl::Drop);
        match put.express(true).wait() {
            Ok(()) => SendResult { copies: 1, failed: 0 },
            Err(_) => SendResult { copies: 0, failed: 1 },
        }
    }
}

/// The numbers by which a session knows others.
#[derive(Debug, Default)]
struct Others {
    by_name: BTreeMap<String, (Path, u64)>,
    used: Vec<Path>,
    heard: u64,
}

impl Others {
    fn note(&mut self, name: String) -> Path {
        self.heard += 1;
        let heard = self.heard;
        if let Some((path, last)) = self.by_name.get_mut(&name) {
            *last = heard;
            return *path;
        }
        if self.by_name.len() >= OTHERS_MAX + self.used.len() {
            let unused = self.by_name.iter().filter(|(_, (path, _))| !self.used.contains(path));
            let oldest = unused.min_by_key(|(_, (_, last))| *last).map(|(name, _)| name.clone());
            oldest.and_then(|oldest| self.by_name.remove(&oldest));
        }
        // Never used before: who was forgotten and comes again has to be tried again.
        let path = Path(heard);
        self.by_name.insert(name, (path, heard));
        path
    }

    fn name(&self, path: Path) -> Option<&str> {
        self.by_name.iter().find(|(_, (of, _))| *of == path).map(|(name, _)| name.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_flood_of_names_forgets_who_is_reached() {
        let mut others = Others::default();
        let used: Vec<Path> = (0..3).map(|number| others.note(format!("site{number}"))).collect();
        others.used.clone_from(&used);
        for number in 0..1_000 {
            others.note(format!("flood{number}"));
            assert!(others.by_name.len() <= OTHERS_MAX + used.len());
        }
        for (number, path) in used.iter().enumerate() {
            assert_eq!(others.name(*path), Some(format!("site{number}").as_str()));
            assert_eq!(others.note(format!("site{number}")), *path);
        }
        // Who comes again after he was forgotten has another number.
        assert!(others.note("flood0".into()) > Path(1_000));
    }
}
