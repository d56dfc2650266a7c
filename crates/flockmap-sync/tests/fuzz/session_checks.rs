//! What must hold of a session after every event, whatever came.

use std::collections::{BTreeMap, VecDeque};

use flockmap_grid::Stamp;
use flockmap_sync::wire::{Datagram, Kind, Request, parse_packages};
use flockmap_sync::{Cast, Destination, RECEIVED_INTERVALS_MAX, Session, Transmit};

/// Below so many bytes a second a budget holds over time, and not in each second.
const THIN: usize = 2_000;
/// What may go out at once under a thin budget.
const ONE_DATAGRAM: usize = 1_300;

/// What went out, for the budgets.
#[derive(Default)]
pub(crate) struct SentPackage {
    /// When, and bytes with overhead over all copies, since the start.
    all: VecDeque<(Stamp, usize)>,
}

impl SentPackage {
    /// Checks a datagram that goes out and counts it.
    pub(crate) fn take(&mut self, session: &Session, now: Stamp, transmit: &Transmit) {
        let config = session.config();
        assert!(transmit.bytes.len() <= config.datagram_bytes_max, "{} bytes", transmit.bytes.len());
        let datagram = Datagram::new_checked(&transmit.bytes).unwrap();
        assert_eq!(datagram.header().sender, session.own());
        match datagram.header().kind {
            Kind::Path => {}
            Kind::Request => drop(Request::parse(&datagram, usize::MAX >> 8).unwrap()),
            Kind::Packages => assert!(!parse_packages(&datagram).unwrap().is_empty(), "nothing was sent"),
        }
        let copies = match (transmit.to, config.cast) {
            // Those that fell silent were forgotten before it was made, and none has come since.
            (Destination::Everyone, Cast::Unicast) => session.peers().count().max(1),
            _ => 1,
        };
        let bytes = (transmit.bytes.len() + config.datagram_overhead_bytes as usize) * copies;
        self.all.push_back((now, bytes));
        if let Some(rate) = config.radio_bytes_per_s {
            self.check_budget(now, rate as usize);
        }
    }

    fn check_budget(&self, now: Stamp, rate: usize) {
        let mut sum = 0;
        for &(at, bytes) in self.all.iter().rev() {
            sum += bytes;
            let micros = now.micros_since(at);
            if rate >= THIN {
                // In any second: the one that ends now.
                if micros >= 1_000_000 {
                    break;
                }
                assert!(sum <= rate, "{sum} bytes in {micros} µs, {rate} in a second are allowed");
            } else {
                let allowed = ONE_DATAGRAM + (rate as u128 * micros as u128 / 1_000_000) as usize;
                assert!(sum <= allowed + 1, "{sum} bytes in {micros} µs, {allowed} are allowed");
            }
        }
    }
}

/// The limits of the options, by what the session reports of itself.
pub(crate) fn limits(session: &Session) {
    let config = session.config();
    assert!(session.peers().count() <= config.peers_max);
    assert!(session.streams().count() <= config.streams_max + 1);
    let mut runs = BTreeMap::new();
    for stream in session.streams().filter(|stream| *stream != session.own()) {
        *runs.entry(stream.origin).or_insert(0) += 1;
        let received = session.received(stream).unwrap();
        assert!(received.intervals().len() <= RECEIVED_INTERVALS_MAX);
        assert!(received.last().is_none_or(|last| last <= session.store().newest_known(stream)));
        assert!(!received.contains(0));
    }
    assert!(runs.values().all(|runs| *runs <= config.epochs_max), "{runs:?}");
    assert!(session.store().bytes() <= config.store_bytes_max, "{} bytes stored", session.store().bytes());
    // What everyone hears is noted for everyone, as far as twice the limit goes.
    let in_flight_max = config.in_flight_max * if config.cast == Cast::Broadcast { 2 } else { 1 };
    for peer in session.peers() {
        assert!(peer.in_flight <= in_flight_max, "{} in flight", peer.in_flight);
    }
}
