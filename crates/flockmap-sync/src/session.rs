//! The request–response session of one robot (Sec. IV-B of the paper), as a state machine without sockets,
//! threads or clocks.

mod answer;
mod coded;
mod datagram;
mod fast_repair;
mod pace;
mod paths;
mod pieces;
mod plan;
mod receive;
mod request;
mod rest;
mod same_id;
mod sealing;
mod send;
mod snapshot;
mod streams;
mod timing;
mod transfers;

pub use pieces::Cuts;

use crate::clocks::Clocks;
use crate::coded::Mender;
use crate::event::{Destination, Event, PublishError, Transmit};
use crate::identity::Identity;
use crate::inbox::{Inbox, PENDING_MAX};
use crate::lacks::Lacks;
use crate::outbox::{Outbox, SilentPeer};
use crate::peer::Peer;
use crate::report::{Load, PeerInfo, Report};
use crate::schedule::Schedule;
use crate::timers::Timer;
use crate::wire::{Contents, DatagramHeader, Kind};
use crate::{Cast, ConfigError, Counters, IntervalSet, SessionConfig, Store};
use flockmap_codec::{ContentKind, Package};
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};
use std::collections::BTreeMap;

/// Events that wait for the driver; more are dropped, counted, and come again by a later request.
const EVENTS_MAX: usize = PENDING_MAX;

/// Keeps the packages of all robots of a swarm in sync.
///
/// Methods are of four kinds: inputs (`handle_*`, `publish`, `verdict`, `provide_snapshot`,
/// `set_clock_offset`, `restore*`), outputs (`poll_*`), and queries. After every input, drain
/// [`poll_event`](Self::poll_event), giving each event its answer, then [`poll_transmit`](Self::poll_transmit);
/// then wait for a datagram or for [`poll_timeout`](Self::poll_timeout), whichever is first.
///
/// Time is the robot's own clock, given with every input; if it runs backwards it is taken to stand still. The
/// same inputs and seed give the same outputs on every machine.
///
/// ```
/// use flockmap_grid::{RobotId, Stamp, Stream};
/// use flockmap_sync::{Event, Session, SessionConfig, Verdict};
///
/// let own = Stream { origin: RobotId(1), epoch: 1 };
/// let mut session = Session::new(own, SessionConfig::default(), 42)?;
/// let mut now = Stamp(0);
/// session.handle_timeout(now);
/// while let Some(event) = session.poll_event() {
///     if let Event::Received(package) = event {
///         match package.decode() {
///             Ok(_content) => session.verdict(now, &package, Verdict::Merged), // after merging it
///             Err(_) => session.verdict(now, &package, Verdict::Damaged),
///         }
///     }
/// }
/// let first = session.poll_transmit(now).expect("a request to everyone comes first");
/// assert!(first.bytes.len() < 100);
/// assert!(session.poll_transmit(now).is_none());
/// now = session.poll_timeout().expect("the next request is due some time");
/// assert!(now > Stamp(0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Session {
    config: SessionConfig,
    identity: Identity,
    clocks: Clocks,
    store: Store,
    peers: BTreeMap<RobotId, Peer>,
    inbox: Inbox,
    mender: Mender,
    outbox: Outbox,
    schedule: Schedule,
    lacks: Lacks,
    report: Report,
}

impl Session {
    /// A session of the own stream. `seed` moves requests of different robots apart; give each its own.
    pub fn new(own: Stream, config: SessionConfig, seed: u64) -> Result<Self, ConfigError> {
        config.validate()?;
        Ok(Self {
            identity: Identity::new(own),
            clocks: Clocks::new(),
            store: Store::new(own, config.store_limits()),
            peers: BTreeMap::new(),
            inbox: Inbox::new(config.transfers_max),
            mender: Mender::default(),
            outbox: Outbox::new(&config),
            schedule: Schedule::new(seed ^ (u64::from(own.origin.0) << 32) ^ own.epoch),
            lacks: Lacks::new(),
            report: Report::default(),
            config,
        })
    }

    // Inputs.

    /// Lets time pass. Call it when [`poll_timeout`](Self::poll_timeout) is reached.
    pub fn handle_timeout(&mut self, now: Stamp) {
        self.advance(now);
    }

    /// Takes in the next own package; index 1 first, then each one more than the last.
    pub fn publish(&mut self, now: Stamp, package: Package) -> Result<(), PublishError> {
        let now = self.advance(now);
        let header = package.header();
        if header.stream != self.identity.own {
            return Err(PublishError::Stream { got: header.stream, own: self.identity.own });
        }
        if header.content != ContentKind::Changes {
            return Err(PublishError::Content);
        }
        let expected = self.store.newest_known(self.identity.own).saturating_add(1);
        if header.index != expected {
            return Err(PublishError::Index { got: header.index, expected });
        }
        let bytes_max = self.package_bytes_max();
        if package.bytes().len() > bytes_max {
            return Err(PublishError::Bytes { got: package.bytes().len(), expected: bytes_max });
        }
        // The own index list is one interval, so it never lacks room.
        let _ = self.store.insert(&package, now, now);
        self.report.counters.published += 1;
        self.note_activity(now);
        self.mark_queues_stale();
        Ok(())
    }

    /// Delivers a package, or a chunk of a snapshot, that came by another way than a datagram: a former run stored it on
    /// disk, or it came over another network. As if it had just come from a peer: it is decoded and merged like any other
    /// ([`Event::Received`]), asked for only if that fails, and offered to peers. `false`: it is of the own stream, or there
    /// is no room for its stream.
    pub fn deliver_package(&mut self, now: Stamp, package: Package) -> bool {
        let now = self.advance(now);
        let stream = package.header().stream;
        if stream == self.identity.own || !self.open_stream(stream) {
            return false;
        }
        self.receive_packages(now, self.identity.own, vec![package], Vec::new());
        true
    }

    /// Says which packages a snapshot contains whose chunks were just [delivered](Self::deliver_package), one
    /// of a history with gaps. Whether they are held now: if all its chunks are accepted. Else they count
    /// when the rest of them is.
    pub fn deliver_contents(
        &mut self,
        now: Stamp,
        stream: Stream,
        snapshot_id: u32,
        received: IntervalSet,
    ) -> bool {
        let now = self.advance(now);
        let contents = Contents { stream, snapshot_id, received: received.clone() };
        self.receive_packages(now, self.identity.own, Vec::new(), vec![contents]);
        self.finish_transfers(now);
        self.store.received(stream).is_some_and(|all| received.difference(all).is_empty())
    }

    /// Sets a robot's clock minus the own clock, in microseconds, known from elsewhere; it is used in place of
    /// what is measured. `None`: measure again. Its own id stands for its former runs.
    pub fn set_clock_offset(&mut self, robot: RobotId, micros: Option<i64>) {
        self.clocks.set_given(robot, micros);
    }

    // Outputs.

    /// The next datagram to send now, until `None`. Call it when the datagram can really go out: its send stamp
    /// is `now`.
    pub fn poll_transmit(&mut self, now: Stamp) -> Option<Transmit> {
        let now = self.advance(now);
        self.schedule.timers.stop(Timer::Budget);
        if self.check_exhausted() {
            return None;
        }
        let transmit = if !self.outbox.path_waiting.is_empty() {
            self.transmit_path(now)
        } else if self.is_superseded()
            && let packages @ Some(_) = self.transmit_packages(now)
        {
            packages
        } else if self.is_superseded() {
            // Requests wait with them.
            None
        } else if let Some(until) = self.schedule.blocked_until.filter(|until| *until > now) {
            self.schedule.timers.set_sooner(Timer::Budget, until);
            None
        } else if self.schedule.timers.is_due(Timer::FastRepair, now)
            && let probe @ Some(_) = self.transmit_fast_repair(now)
        {
            probe
        } else if self.request_due(now) {
            self.transmit_request(now)
        } else {
            self.transmit_packages(now)
        };
        transmit.and_then(|transmit| self.seal(transmit))
    }

    /// When to call [`handle_timeout`](Self::handle_timeout) and poll again, if no datagram comes before.
    /// Correct after `poll_transmit` returned `None`.
    pub fn poll_timeout(&self) -> Option<Stamp> {
        if mutation::is(Mutation::TimeStandsStill) {
            return Some(self.clocks.now());
        }
        let lost = self.schedule.timers.get(Timer::Silence);
        // A request that is due already waits for the budget, like everything else: the timer of that says
        // until when.
        let budget = self.schedule.timers.get(Timer::Budget);
        let repair = self.schedule.timers.get(Timer::FastRepair);
        let request = self.schedule.timers.next(&Timer::REQUESTS).into_iter().chain(repair).min();
        let request =
            request.filter(|&at| !self.is_exhausted() && (at > self.clocks.now() || budget.is_none()));
        [lost, budget, request].into_iter().flatten().min().map(|at| at.max(self.clocks.now()))
    }

    // Queries.

    /// The own stream.
    pub const fn own(&self) -> Stream {
        self.identity.own
    }

    /// The options.
    pub const fn config(&self) -> &SessionConfig {
        &self.config
    }

    /// Indices held of a stream; `None` for an unknown stream.
    pub fn received(&self, stream: Stream) -> Option<&IntervalSet> {
        self.store.received(stream)
    }

    /// The streams of which something is known; the own one is always among them.
    pub fn streams(&self) -> impl Iterator<Item = Stream> + '_ {
        self.store.streams()
    }

    /// All packages held.
    pub const fn store(&self) -> &Store {
        &self.store
    }

    /// The peers heard, in ascending order of their ids.
    pub fn peers(&self) -> impl Iterator<Item = PeerInfo> + '_ {
        self.peers.values().map(|peer| PeerInfo {
            stream: peer.stream,
            last_heard: peer.last_heard,
            hears_us: peer.hears(self.identity.own.origin),
            round_trip: peer.round_trip.mean(),
            clock_offset_micros: self.clock_offset_micros(peer.stream),
            in_flight: peer.in_flight.len(),
            loss: peer.loss.share(),
            traffic_in: peer.traffic_in,
            traffic_out: peer.traffic_out,
        })
    }

    /// What each peer that hears this robot holds of the own stream, by its last request: the peer and its
    /// run, when the request came, and the highest index up to which nothing is missing. What a peer keeps
    /// pending counts as held.
    pub fn own_received_by_peers(&self) -> impl Iterator<Item = (Stream, Stamp, u32)> + '_ {
        self.peers.values().filter(|peer| peer.hears(self.identity.own.origin)).filter_map(|peer| {
            let (_, at) = peer.request?;
            let prefix = match peer.streams.get(&self.identity.own) {
                // What lies below the list that it states, it does not ask for either.
                Some(theirs) => match theirs.received.first() {
                    Some(first) if first <= theirs.from.max(1) => theirs.received.intervals().first()?.1,
                    _ => theirs.from.saturating_sub(1),
                },
                None => 0,
            };
            Some((peer.stream, at, prefix))
        })
    }

    /// The clock of a stream's robot minus the own clock, in microseconds: as given, else as measured with that
    /// robot, else through a peer that hears it, else as last measured.
    pub fn clock_offset_micros(&self, stream: Stream) -> Option<i64> {
        if stream == self.identity.own {
            return Some(0);
        }
        self.clocks.of_run(stream, &self.peers)
    }

    /// What it holds at the moment. O(peers).
    pub fn load(&self) -> Load {
        let ((pending, backed_off), (waiting, waiting_bytes)) = (self.inbox.load(), self.inbox.waiting());
        Load {
            peers: self.peers.len(),
            streams: self.store.streams().count().saturating_sub(1),
            pending,
            backed_off,
            waiting,
            waiting_bytes,
            transfers: self.inbox.transfers.len(),
            in_flight_most: self.peers.values().map(|peer| peer.in_flight.len()).max().unwrap_or(0),
        }
    }

    /// What was counted so far.
    pub const fn counters(&self) -> &Counters {
        &self.report.counters
    }

    // Helpers.

    /// Moves the own clock on and forgets peers that fell silent.
    fn advance(&mut self, now: Stamp) -> Stamp {
        let now = self.clocks.advance(now);
        if self.schedule.timers.is_due(Timer::Silence, now) {
            let lost = self.peers.values().filter(|peer| peer.lost_at(&self.config) <= now);
            let lost: Vec<Stream> = lost.map(|peer| peer.stream).collect();
            for lost in lost {
                self.silence(lost.origin);
                self.identity.replays.forget_window(lost.origin);
                self.push_event(Event::PeerLost(lost));
            }
            self.schedule.timers.stop(Timer::Silence);
            for peer in self.peers.values() {
                self.schedule.timers.set_sooner(Timer::Silence, peer.lost_at(&self.config));
            }
        }
        now
    }

    /// Forgets a peer, but not what its link's budget has seen and where it was reached.
    fn silence(&mut self, id: RobotId) {
        let peer = self.peers.remove(&id).map(SilentPeer::of);
        if self.outbox.silent.len() >= self.config.peers_max {
            self.outbox.silent.pop_first();
        }
        let is_kept = |peer: &SilentPeer| peer.pacer.is_some() || peer.path.is_heard();
        self.outbox.silent.extend(peer.filter(is_kept).map(|peer| (id, peer)));
        self.count_relays(None);
    }

    /// What may be sent in a second, in all.
    fn radio_bytes_per_s(&self) -> Option<u32> {
        let found = self.outbox.rate.as_ref().map(crate::rate::Rate::bytes_per_s);
        self.config.radio_bytes_per_s.into_iter().chain(found).min()
    }

    fn push_event(&mut self, event: Event) {
        if self.report.events.len() < EVENTS_MAX {
            self.report.events.push_back(event);
        } else {
            self.report.counters.events_overflowed += 1;
        }
    }

    fn mark_queues_stale(&mut self) {
        for peer in self.peers.values_mut() {
            peer.queue_stale = true;
        }
    }

    /// Bytes counted for each datagram of a kind beside what it has before it is sealed.
    const fn overhead(&self, kind: Kind) -> usize {
        self.config.datagram_overhead_bytes as usize + self.seal_bytes(kind)
    }

    /// Longest package that fits into a datagram: header, record type and length go off.
    const fn package_bytes_max(&self) -> usize {
        self.plain_bytes_max(Kind::Packages) - crate::wire::HEADER_BYTES - 3
    }

    const fn header(&self, now: Stamp, kind: Kind) -> DatagramHeader {
        DatagramHeader { kind, swarm: self.config.swarm, sender: self.identity.own, stamp: now }
    }

    /// How often a datagram to everyone is counted.
    fn copies(&self, to: Destination) -> u64 {
        match (to, self.config.cast) {
            (Destination::Everyone, Cast::Unicast) => self.peers.len().max(1) as u64,
            _ => 1,
        }
    }
}
