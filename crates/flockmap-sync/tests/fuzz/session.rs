//! A session among hostile peers: any sequence of datagrams, time, verdicts and own packages.

use flockmap_codec::{ContentKind, Package};
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_sync::wire::{DatagramHeader, Kind, PackagesWriter, Received, TransferProgress};
use flockmap_sync::{
    Cast, Counters, Event, InFlight, IntervalSet, Order, Pace, Relay, Session, SessionConfig, Verdict,
};

use super::made::{self, Maker, OWN};
use super::session_checks::{SentPackage, limits};
use super::{Choices, mended, with_check};

/// More is never sent at one time: every package of a full store to every peer, and a request.
const TRANSMITS_MAX: usize = 4_000;
/// Packages that the driver keeps pending.
const KEPT_MAX: usize = 5_000;

/// Input: choices of options, then of events. Returns what the session counted.
pub(crate) fn run(input: &[u8]) -> Counters {
    let mut choices = Choices::new(input);
    let config = config(&mut choices);
    let mut session = Session::new(OWN, config, 7).unwrap();
    let mut run = Run {
        session: &mut session,
        maker: Maker::new(),
        now: Stamp(i64::from(choices.word())),
        sent: SentPackage::default(),
        kept: Vec::new(),
        wanted: Vec::new(),
        given: None,
    };
    while !choices.is_empty() {
        run.step(&mut choices);
        limits(run.session);
        let config = run.session.config();
        let has_budget =
            config.congestion_control || config.radio_bytes_per_s.or(config.link_bytes_per_s).is_some();
        let pace = run.session.pace(run.now);
        assert!(has_budget || pace == Pace::Free, "a pace without a budget");
    }
    // Time goes on, and everybody is gone: no peer, and nothing but requests.
    run.now = run.now.plus_micros(7_200_000_000);
    run.session.handle_timeout(run.now);
    assert_eq!(run.session.peers().count(), 0);
    run.take_events();
    run.transmit();
    *session.counters()
}

struct Run<'a> {
    session: &'a mut Session,
    maker: Maker,
    now: Stamp,
    sent: SentPackage,
    /// Delivered, and without a verdict.
    kept: Vec<Package>,
    /// Snapshots that were asked for.
    wanted: Vec<(Stream, (u32, u32))>,
    /// Set of chunks given last: stream, span, set, number of chunks.
    given: Option<(Stream, (u32, u32), u32, u32)>,
}

impl Run<'_> {
    fn step(&mut self, choices: &mut Choices<'_>) {
        match choices.below(20) {
            0 => self.now = self.now.plus_micros(1_000 * i64::from(choices.byte())),
            1 => {
                // To when it wants to be woken.
                if let Some(at) = self.session.poll_timeout() {
                    self.now = self.now.max(at);
                }
                self.session.handle_timeout(self.now);
            }
            2 => self.now = self.now.plus_micros(i64::from(choices.word())),
            3..=5 => {
                let bytes = made::request(choices, self.now);
                self.datagram(choices, bytes);
            }
            6..=8 => {
                let bytes = made::packages(choices, &mut self.maker, self.now);
                self.datagram(choices, bytes);
            }
            9 => {
                let length = choices.byte();
                let bytes = (0..length).map(|_| choices.byte()).collect();
                let bytes = mended(bytes, 1 + choices.byte() % 3);
                let _ = self.session.handle_datagram(self.now, &bytes);
            }
            10 => self.publish(choices.byte()),
            11 => self.provide(choices),
            12 => {
                self.take_events();
                self.decide(choices);
            }
            13 => self.transmit(),
            14 => self.verdicts_for_all(choices.byte()),
            15 | 16 => self.hear_honest_request(choices),
            17 => self.hear_snapshot(choices),
            _ => self.seldom(choices),
        }
    }

    fn datagram(&mut self, choices: &mut Choices<'_>, mut bytes: Vec<u8>) {
        if choices.below(8) == 7 {
            let at = choices.below(1_200) as usize % bytes.len();
            bytes[at] = choices.byte();
            if choices.below(2) == 0 {
                bytes = with_check(bytes);
            }
        }
        let before = *self.session.counters();
        if self.session.handle_datagram(self.now, &bytes).is_err() {
            assert_ne!(before, *self.session.counters(), "an error that nobody counts");
        }
    }

    fn publish(&mut self, many: u8) {
        for n in 0..1 + many % 32 {
            // The last index there is cannot be followed.
            let newest = self.session.store().newest_known(OWN);
            let package = self.maker.package(OWN, newest.saturating_add(1), n % 3 == 0);
            let published = self.session.publish(self.now, package);
            assert!(published.is_ok() || newest == u32::MAX, "{published:?}");
        }
    }

    /// What was asked for as it was asked for, or something else.
    fn provide(&mut self, choices: &mut Choices<'_>) {
        let Some((stream, span)) = self.wanted.pop() else { return };
        let mut chunks = self.maker.chunks(stream, span, 1 + choices.below(12), choices.byte());
        match choices.below(8) {
            0 => chunks.clear(),
            1 => chunks.reverse(),
            2 => drop(chunks.pop()),
            3 => chunks = self.maker.chunks(made::stream(choices), (span.0, made::index(choices)), 2, 0),
            _ => {}
        }
        if let Some(first) = chunks.first().map(Package::header)
            && let ContentKind::Snapshot { since, id: snapshot_id, chunks, .. } = first.content
        {
            self.given = Some((stream, (since, first.index), snapshot_id, chunks));
        }
        self.session.provide_snapshot(self.now, stream, chunks);
    }

    /// A peer that hears this robot says what it holds: all of each stream up to somewhere, and some chunks.
    fn hear_honest_request(&mut self, choices: &mut Choices<'_>) {
        let peer = made::honest_peer(choices);
        let mut request = made::honest_request(self.now.plus_micros(-i64::from(choices.byte()) * 1_000));
        for stream in self.session.streams() {
            let newest = self.session.store().newest_known(stream);
            let upto = newest.saturating_sub(choices.below(6));
            if stream != peer && upto > 0 {
                let received = IntervalSet::from_intervals(1, vec![(1, upto)]);
                request.received.push(Received {
                    in_part: None,
                    is_oldest_wanted: false,
                    stream,
                    from: 1,
                    received,
                });
            }
        }
        if let Some((stream, (since, upto), snapshot_id, chunks)) = self.given {
            let accepted =
                IntervalSet::from_intervals(1, vec![(1, choices.below(chunks.saturating_add(1).max(1)))]);
            let source = OWN.origin;
            request.transfers.push(TransferProgress {
                source,
                stream,
                since,
                upto,
                snapshot_id,
                chunks,
                from: 1,
                accepted,
            });
        }
        let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender: peer, stamp: self.now };
        let bytes = request.emit(header, 1_200);
        self.datagram(choices, bytes);
    }

    /// A peer sends all chunks of a state, and each is accepted.
    fn hear_snapshot(&mut self, choices: &mut Choices<'_>) {
        let peer = made::honest_peer(choices);
        let (stream, upto) = (made::stream(choices), made::index(choices));
        let since = if choices.below(2) == 0 { 0 } else { choices.below(upto.min(256)) };
        let chunks = self.maker.chunks(stream, (since, upto), 1 + choices.below(9), 3);
        let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender: peer, stamp: self.now };
        for chunk in chunks {
            let mut writer = PackagesWriter::new(header, 1_200);
            writer.push(&chunk);
            let _ = self.session.handle_datagram(self.now, &writer.finish());
        }
        self.verdicts_for_all(7);
    }

    fn take_events(&mut self) {
        for _ in 0..10_000 {
            match self.session.poll_event() {
                None => return,
                Some(Event::Received(package)) => {
                    assert_ne!(package.header().stream, OWN, "an own package came as news");
                    self.kept.push(package);
                    assert!(self.kept.len() <= KEPT_MAX);
                }
                Some(Event::SnapshotWanted { stream, since, upto, .. }) => {
                    assert!(since < upto, "the state of {stream:?} before its first package");
                    self.wanted.push((stream, (since, upto)));
                }
                Some(Event::CaughtUp { stream, upto }) => {
                    let is_of = |p: &Package| p.header().stream == stream && p.header().index <= upto;
                    self.kept.retain(|package| !is_of(package));
                }
                Some(Event::StreamForgotten(stream)) => self.kept.retain(|p| p.header().stream != stream),
                Some(_) => {}
            }
        }
        panic!("events without end");
    }

    /// A verdict on one package.
    fn decide(&mut self, choices: &mut Choices<'_>) {
        if self.kept.is_empty() {
            return;
        }
        let package = self.kept.swap_remove(choices.below(256) as usize % self.kept.len());
        self.verdict(choices.byte(), &package);
    }

    fn verdicts_for_all(&mut self, which: u8) {
        self.take_events();
        for package in std::mem::take(&mut self.kept) {
            self.verdict(which, &package);
        }
    }

    fn verdict(&mut self, which: u8, package: &Package) {
        match which % 8 {
            0 => self.session.verdict(self.now, package, Verdict::Damaged),
            1 => self.session.verdict(self.now, package, Verdict::Undecodable),
            _ => self.session.verdict(self.now, package, Verdict::Merged),
        }
    }

    fn transmit(&mut self) {
        for _ in 0..TRANSMITS_MAX {
            let Some(transmit) = self.session.poll_transmit(self.now) else { return };
            self.sent.take(self.session, self.now, &transmit);
        }
        panic!("datagrams without end");
    }

    fn seldom(&mut self, choices: &mut Choices<'_>) {
        match choices.below(5) {
            0 => {
                let micros = i64::from(choices.word()) << choices.below(33);
                self.session.set_clock_offset(RobotId(choices.below(8) as u16), Some(micros));
            }
            1 => self.session.set_clock_offset(RobotId(choices.below(8) as u16), None),
            2 => {
                let (stream, snapshot_id) = (made::stream(choices), choices.word());
                self.session.restart_snapshot(self.now, stream, snapshot_id);
            }
            3 => {
                let (stream, index) = (made::stream(choices), made::index(choices));
                let package = self.maker.package(stream, index, choices.below(2) == 0);
                self.session.deliver_package(self.now, package);
            }
            // A clock that is set back.
            _ => self.session.handle_timeout(Stamp(i64::from(choices.byte()))),
        }
    }
}

fn config(choices: &mut Choices<'_>) -> SessionConfig {
    let switches = choices.byte();
    let is_on = |bit: u8| switches >> bit & 1 == 0;
    SessionConfig {
        cast: if is_on(0) { Cast::Unicast } else { Cast::Broadcast },
        order: if is_on(1) { Order::NewestFirst } else { Order::OldestFirst },
        in_flight: if is_on(2) { InFlight::RoundTrip } else { InFlight::PreviousRequest },
        push: is_on(3),
        gap_requests: is_on(4),
        relay: if is_on(5) { Relay::Ranked } else { Relay::Always },
        snapshot_bytes_min: is_on(6).then_some(200),
        snapshot_range_max: (!is_on(7)).then_some(5),
        radio_bytes_per_s: match choices.below(4) {
            0 => None,
            1 => Some(500),
            2 => Some(2_000),
            _ => Some(20_000),
        },
        link_bytes_per_s: (choices.below(4) == 3).then_some(3_000),
        peers_max: 1 + choices.below(4) as usize,
        streams_max: 1 + choices.below(8) as usize,
        epochs_max: 1 + choices.below(3) as usize,
        store_bytes_max: 500 * choices.below(64) as usize,
        in_flight_max: 1 + choices.below(64) as usize,
        transfers_max: 1 + choices.below(4) as usize,
        snapshot_bytes_max: 500 * choices.below(32) as usize,
        ..SessionConfig::default()
    }
}
