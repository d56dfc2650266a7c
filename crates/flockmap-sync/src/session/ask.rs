//! Requests: when they go out and what they say.

use super::{Destination, Event, Session, Transmit};
use crate::session::peer::{Item, Peer, is_heard};
use crate::store::Opened;
use crate::wire::{ClockReport, Covered, Echo, Held, Kind, Request, StateWanted, TransferProgress};
use crate::{Cast, IntervalSet};
use flockmap_grid::mutation::{self, Mutation};
use flockmap_grid::{RobotId, Stamp, Stream};

/// When requests are due.
#[derive(Clone, Copy, Debug)]
pub(super) struct Schedule {
    /// The periodic one.
    periodic: Stamp,
    /// A greeting to a new peer.
    greeting: Option<Stamp>,
    /// One because of a gap.
    gap: Option<Stamp>,
    /// Requests for gaps since one was filled last, or a new one was seen.
    gap_tries: u32,
    /// Whether what was sent last has arrived, where the radio loses much: when to make the peers look, and how often still.
    probe: Option<(Stamp, u8)>,
    last: Stamp,
    /// Least pause after the last request, so that requests leave most of a small budget to packages.
    budget_pause: i64,
    last_activity: Stamp,
    /// Requests made: lists that do not fit begin at another place each time.
    count: usize,
    /// The first origin that the next request covers; and how often all were.
    cursor: RobotId,
    rounds: u32,
    /// A run of a robot that was heard in an earlier one: it should learn of it soon.
    superseded: Option<Stream>,
    superseded_told: Option<Stamp>,
}

impl Default for Schedule {
    fn default() -> Self {
        let never = Stamp(i64::MIN);
        Self {
            periodic: never,
            greeting: None,
            gap: None,
            gap_tries: 0,
            probe: None,
            last: never,
            budget_pause: 0,
            last_activity: never,
            count: 0,
            cursor: RobotId(0),
            rounds: 0,
            superseded: None,
            superseded_told: None,
        }
    }
}

/// New peers are greeted after at most so long, each robot at another time.
const GREETING_JITTER: u64 = 20_000;
/// Least pause before a greeting, so that ever new runs of a faulty peer do not make us talk without end.
const GREETING_PAUSE: i64 = 50_000;
/// Least pause between requests that go out because a robot was heard in a former run: replays must not make us talk.
const SUPERSEDED_PAUSE: i64 = 1_000_000;
/// So many requests for gaps go out at the shortest pause; after that the pause doubles each time. Over a radio that loses every
/// second datagram, one round of request and answer in four succeeds.
const GAP_TRIES: u32 = 10;
/// In a swarm larger than [`SMALL_SWARM`], whose requests add up on the radio.
const GAP_TRIES_OF_MANY: u32 = 3;
/// Peers of a small swarm.
const SMALL_SWARM: usize = 8;
/// After so many requests that brought nothing, a gap does not count as something that flows.
const ACTIVE_TRIES: u32 = 64;
/// Longest pause between requests for gaps that stay; periodic ones go on beside them.
const GAP_PAUSE_MAX: i64 = 60_000_000;
/// Requests in which the peers are made to look whether the end of a burst is lost.
const PROBES: u8 = 2;
/// Packages that follow this soon make a probe needless.
const PROBE_AFTER: i64 = 120_000;
/// Share of losses above which that is worth a datagram; below, the next packages tell soon enough.
const PROBE_LOSS_MIN: u32 = crate::link::LOSS_ONE / 6;
/// Requests take at most one part in so many of a budget over time …
const BUDGET_SHARE_OVER_TIME: i64 = 8;
/// … and one request to all at most one part in so many of a second's worth …
const BUDGET_SHARE_AT_ONCE: usize = 2;
/// Lists of held indices that come before the origins in turn.
const URGENT_MAX: usize = 64;
/// … but a request is never cut below so many bytes: it has to say something of each transfer and stream in turn.
const REQUEST_BYTES_MIN: usize = 280;
/// Nor below so many when it is sealed, which is less before: all peers at once are to get one out of a thin budget.
const SEALED_REQUEST_BYTES_MIN: usize = 299;

impl Session {
    /// Packages flow: the next periodic request is due sooner.
    pub(super) fn note_activity(&mut self, now: Stamp) {
        let period = i64::from(self.config.request_period_active_ms) * 1_000;
        let soon = now.plus_micros(period).max(self.schedule.last.plus_micros(self.schedule.budget_pause));
        self.schedule.last_activity = now;
        self.schedule.periodic = self.schedule.periodic.min(soon);
    }

    /// A new peer: it should learn soon that it is heard.
    pub(super) fn greet(&mut self, now: Stamp) {
        let pause = GREETING_PAUSE.max(self.schedule.budget_pause);
        let at = now.max(self.schedule.last.plus_micros(pause));
        let at = at.plus_micros(self.random(GREETING_JITTER) as i64);
        self.schedule.greeting = Some(self.schedule.greeting.map_or(at, |earlier| earlier.min(at)));
    }

    /// A robot was heard in a run before the newest one that is known of it: it should learn of that one, and begin anew above it.
    pub(super) fn tell_superseded(&mut self, now: Stamp, newest: Stream) {
        if self.schedule.superseded_told.is_none_or(|told| now.micros_since(told) >= SUPERSEDED_PAUSE) {
            self.schedule.superseded_told = Some(now);
            self.schedule.superseded = Some(newest);
            self.greet(now);
        }
    }

    /// Something may be missing. `certain`: a later package has arrived, so it is late or lost.
    pub(super) fn note_gap(&mut self, now: Stamp, certain: bool) {
        if !self.config.gap_requests {
            return;
        }
        if certain {
            self.schedule.gap_tries = 0;
        }
        let variation = self.peers.values().map(|peer| peer.round_trip.variation()).max().unwrap_or(0);
        let patience = self.config.patience(variation);
        let at = now.plus_micros(patience).max(self.schedule.last.plus_micros(self.gap_pause()));
        self.schedule.gap = Some(self.schedule.gap.map_or(at, |earlier| earlier.min(at)));
    }

    /// Pause between two requests for gaps: an answer needs the round trip at least.
    fn gap_pause(&self) -> i64 {
        let round_trip = self.peers.values().map(|peer| peer.round_trip.timeout()).max().unwrap_or(0);
        let shortest = (i64::from(self.config.gap_request_pause_ms) * 1_000).max(round_trip);
        let tries = if self.peers.len() > SMALL_SWARM { GAP_TRIES_OF_MANY } else { GAP_TRIES };
        let doublings = self.schedule.gap_tries.saturating_sub(tries).min(16);
        (shortest << doublings).min(GAP_PAUSE_MAX).max(self.schedule.budget_pause)
    }

    /// A gap was filled: answers come, so what is still missing is worth asking for soon.
    pub(super) const fn note_gap_filled(&mut self) {
        self.schedule.gap_tries = 0;
    }

    /// Packages went out. If their end gets lost, nothing that follows tells the peers: make them look.
    pub(super) fn note_sent(&mut self, now: Stamp) {
        let is_lossy = |peer: &&Peer| peer.loss.share() > PROBE_LOSS_MIN;
        let timeout = self.peers.values().filter(is_lossy).map(|peer| peer.round_trip.timeout()).max();
        self.schedule.probe = timeout.map(|timeout| (now.plus_micros(timeout.max(PROBE_AFTER)), PROBES));
    }

    /// Whether something sent before is neither confirmed nor known to be lost.
    fn is_waiting_for_word(&self, now: Stamp) -> bool {
        self.peers.values().any(|peer| {
            let timeout = peer.round_trip.timeout();
            peer.in_flight.back().is_some_and(|sent| now.micros_since(sent.at) >= timeout / 2)
        })
    }

    /// When the next request is due.
    pub(super) fn next_request(&self) -> Option<Stamp> {
        let probe = self.schedule.probe.map(|(at, _)| at);
        [Some(self.schedule.periodic), self.schedule.greeting, self.schedule.gap, probe]
            .into_iter()
            .flatten()
            .min()
    }

    pub(super) fn request_due(&mut self, now: Stamp) -> bool {
        if self.schedule.gap.is_some_and(|at| at <= now) && !self.has_gap(now) {
            self.schedule.gap = None;
            self.schedule.gap_tries = 0;
        }
        if self.schedule.probe.is_some_and(|(at, _)| at <= now) && !self.is_waiting_for_word(now) {
            self.schedule.probe = None;
        }
        self.next_request().is_some_and(|at| at <= now)
    }

    fn has_gap(&self, now: Stamp) -> bool {
        self.gaps(now).next().is_some()
    }

    /// The streams with gaps that somebody may fill now, by packages or by a present state.
    fn gaps(&self, now: Stamp) -> impl Iterator<Item = Stream> + '_ {
        self.store.streams().filter(move |&stream| {
            let newest = self.store.newest_known(stream);
            stream != self.own
                && (self.given_up.contains_key(&stream)
                    || self.stated_as_held(stream, now).missing(1, newest).next().is_some())
        })
    }

    pub(super) fn transmit_request(&mut self, now: Stamp) -> Option<Transmit> {
        self.finish_transfers(now);
        let for_gap = self.schedule.gap.is_some_and(|at| at <= now);
        let for_all = [self.schedule.greeting, self.schedule.probe.map(|(at, _)| at)];
        let periodic = self.schedule.periodic <= now || for_all.into_iter().flatten().any(|at| at <= now);
        let to = if for_gap && !periodic { self.whom_to_ask(now) } else { Destination::Everyone };
        let copies = self.copies(to);
        let header = self.header(now, Kind::Request);
        let (request, urgent) = self.request(now);
        let (bytes, covered) = request.emit_in_turn(header, self.request_bytes_max(copies as usize), urgent);
        let each = bytes.len() + self.overhead(Kind::Request);
        let total = each * copies as usize;
        let radio = self.radio.iter_mut().map(|radio| (radio, total));
        let links = self.peers.iter_mut().filter(|(id, _)| to.includes(**id));
        let links = links.filter_map(|(_, peer)| Some((peer.pacer.as_mut()?, each)));
        let mut pacers: Vec<_> = radio.chain(links).collect();
        if let Some(ready) = pacers.iter_mut().filter_map(|(pacer, bytes)| pacer.wait(now, *bytes)).max() {
            self.wake = Some(ready);
            self.counters.delayed_by_budget += 1;
            return None;
        }
        for (pacer, bytes) in pacers {
            pacer.spend(now, bytes);
        }
        self.schedule.budget_pause = self.budget_pause(each, copies as usize);
        self.counters.requests_out.add(copies, each);
        if let Destination::Peer(id) = to
            && let Some(peer) = self.peers.get_mut(&id)
        {
            peer.traffic_out.add(1, each);
        }
        if to == Destination::Everyone {
            self.move_cursor(covered);
            self.note_overtaken();
            self.schedule.superseded = None;
        }
        self.schedule_next(now, for_gap, to);
        let path = match to {
            Destination::Peer(id) => self.peers.get(&id).and_then(|peer| peer.path.valid()),
            Destination::Everyone => None,
        };
        Some(Transmit { to, path, bytes })
    }

    /// Longest request that leaves most of a second's worth of a small budget to packages.
    fn request_bytes_max(&self, copies: usize) -> usize {
        let link = self.config.link_bytes_per_s.map(|rate| rate as usize);
        let radio = self.config.radio_bytes_per_s.map(|rate| rate as usize / copies.max(1));
        let rate = link.into_iter().chain(radio).min().unwrap_or(usize::MAX);
        let least = REQUEST_BYTES_MIN.min(SEALED_REQUEST_BYTES_MIN - self.seal_bytes(Kind::Request));
        (rate / BUDGET_SHARE_AT_ONCE)
            .saturating_sub(self.overhead(Kind::Request))
            .clamp(least, self.plain_bytes_max(Kind::Request))
    }

    /// Pause after a request of so many bytes, so that requests take no more than their share of the budget; short
    /// enough that the peers do not lose sight of this robot.
    fn budget_pause(&self, each: usize, copies: usize) -> i64 {
        let pause = |bytes: usize, rate: Option<u32>| {
            rate.map_or(0, |rate| bytes as i64 * BUDGET_SHARE_OVER_TIME * 1_000_000 / i64::from(rate.max(1)))
        };
        pause(each * copies, self.config.radio_bytes_per_s)
            .max(pause(each, self.config.link_bytes_per_s))
            .min(self.peer_timeout() / 3)
    }

    fn schedule_next(&mut self, now: Stamp, for_gap: bool, to: Destination) {
        if to == Destination::Everyone {
            let flows =
                now.micros_since(self.schedule.last_activity) < i64::from(self.config.active_for_ms) * 1_000;
            let active = flows || (self.schedule.gap_tries < ACTIVE_TRIES && self.has_gap(now));
            let period = match active {
                true => self.config.request_period_active_ms,
                false => self.config.request_period_idle_ms,
            };
            let period = u64::from(period) * 1_000;
            let period = period.max(self.schedule.budget_pause as u64);
            let jittered = period - period / 10 + self.random(period / 5);
            self.schedule.periodic = now.plus_micros(jittered as i64);
            self.schedule.greeting = None;
            let timeout = self.peers.values().map(|peer| peer.round_trip.timeout()).max().unwrap_or(0);
            self.schedule.probe = self.schedule.probe.and_then(|(_, left)| {
                (left > 1).then(|| (now.plus_micros(timeout.max(self.schedule.budget_pause)), left - 1))
            });
        }
        self.schedule.last = now;
        self.schedule.count = self.schedule.count.wrapping_add(1);
        if for_gap {
            self.counters.gap_requests += 1;
        }
        self.schedule.gap_tries =
            if self.has_gap(now) { self.schedule.gap_tries.saturating_add(1) } else { 0 };
        if self.schedule.gap.is_some() {
            // The request has just said all that is missing; say it again after a pause that grows.
            let pause = self.gap_pause();
            let periodic = i64::from(self.config.request_period_active_ms) * 1_000;
            let periodic = periodic.max(self.schedule.budget_pause);
            self.schedule.gap = (pause < periodic).then(|| now.plus_micros(pause));
        }
    }

    /// By unicast the first request for a gap goes to the origin alone if it is heard; later ones go to everyone.
    fn whom_to_ask(&self, now: Stamp) -> Destination {
        if self.config.cast == Cast::Unicast && self.schedule.gap_tries == 0 {
            let mut streams = self.gaps(now);
            if let (Some(stream), None) = (streams.next(), streams.next())
                && self
                    .peers
                    .get(&stream.origin)
                    .is_some_and(|peer| peer.stream == stream && peer.path.is_open())
            {
                return Destination::Peer(stream.origin);
            }
        }
        Destination::Everyone
    }

    /// What there is to say; and how many of the lists of held indices are urgent: the own one, and those with gaps.
    fn request(&self, now: Stamp) -> (Request, usize) {
        let count = self.schedule.count;
        let mut echoes: Vec<Echo> = self
            .peers
            .values()
            .map(|peer| Echo {
                robot: peer.stream.origin,
                epoch_low: peer.stream.epoch as u16,
                stamp_low: peer.newest_stamp.0 as u32,
                age_micros: now.micros_since(peer.newest_stamp_at).clamp(0, i64::from(u32::MAX)) as u32,
            })
            .collect();
        if !echoes.is_empty() {
            let start = count * 8 % echoes.len();
            echoes.rotate_left(start);
        }
        let (held, urgent) = self.held_lists(now);
        let transfers = self.incoming.iter().map(|incoming| {
            let number = |item: Item| match item {
                Item::Tile { stream, set, tile } if stream == incoming.stream && set == incoming.set => {
                    Some((tile + 1, tile + 1))
                }
                _ => None,
            };
            let refused = self.refused.iter().filter(|(_, until)| **until > now);
            let refused = refused.filter_map(|(item, _)| number(*item));
            // The driver has it, and lets it wait.
            let undecided = self.undecided.iter().filter(|(_, source)| *source == incoming.source);
            let undecided = undecided.filter_map(|(item, _)| number(*item));
            TransferProgress {
                source: incoming.source,
                stream: incoming.stream,
                since: incoming.since,
                upto: incoming.upto,
                set: incoming.set,
                tiles: incoming.tiles,
                from: 1,
                accepted: union_with(&incoming.accepted, refused.chain(undecided).collect()),
            }
        });
        let mut transfers: Vec<TransferProgress> = transfers.collect();
        if !transfers.is_empty() {
            let start = count % transfers.len();
            transfers.rotate_left(start);
        }
        let request = Request {
            covered: Some(Covered::all_from(self.schedule.cursor)),
            all_echoes: true,
            no_new_streams: self.store.is_full(),
            echoes,
            held,
            transfers,
            clocks: self.clock_reports(),
            states_wanted: self.states_wanted(now),
        };
        (request, urgent)
    }

    /// The lists of held indices in the order in which they are to be written, and how many of them are urgent. Urgent are: the own run; the
    /// run that a robot heard in a former one has to learn of; runs with gaps, in turn. Then come all runs, origin by origin from the cursor on.
    fn held_lists(&self, now: Stamp) -> (Vec<Held>, usize) {
        let list = |stream: Stream| Held {
            stream,
            is_oldest_wanted: self.store.is_oldest_wanted(stream),
            from: 1,
            held: self.stated_as_held(stream, now),
        };
        let mut urgent: Vec<Stream> = self.gaps(now).collect();
        if !urgent.is_empty() {
            let start = self.schedule.count % urgent.len();
            urgent.rotate_left(start);
        }
        urgent.truncate(URGENT_MAX);
        let own = Some(self.own).filter(|own| self.store.newest_known(*own) > 0);
        let first = own.into_iter().chain(self.schedule.superseded);
        let mut lists: Vec<Held> = first.chain(urgent).map(list).collect();
        let urgent = lists.len();

        let from_cursor = |stream: &Stream| stream.origin.0.wrapping_sub(self.schedule.cursor.0);
        let mut streams: Vec<Stream> = self.store.streams().collect();
        streams.sort_by_key(|stream| (from_cursor(stream), core::cmp::Reverse(stream.epoch)));
        // Of a robot with more runs than fit into a request each comes first in turn.
        if let Some(first) = streams.first().map(|stream| stream.origin) {
            let runs = streams.iter().take_while(|stream| stream.origin == first).count();
            streams[..runs].rotate_left(self.schedule.rounds as usize % runs);
        }
        // The newest run of a robot is named also where nothing of it is held: the robot may fly in a former one, out of earshot.
        let is_newest = |stream: Stream| stream != self.own && !self.store.is_superseded(stream);
        let named = streams.into_iter().map(list);
        lists.extend(
            named.filter(|held| held.is_oldest_wanted || !held.held.is_empty() || is_newest(held.stream)),
        );
        (lists, urgent)
    }

    /// A present state of each stream of which something can only be had that way.
    fn states_wanted(&self, now: Stamp) -> Vec<StateWanted> {
        let mut wanted: Vec<StateWanted> = self
            .given_up
            .iter()
            .filter_map(|(&stream, given_up)| {
                // What waits for a verdict, or was rejected, may never be held either.
                let unheld = self.stated_as_held(stream, now).difference(self.store.held(stream)?);
                let since = unheld.first()? - 1;
                let undecodable = given_up.within(since + 1, u32::MAX);
                (!undecodable.is_empty()).then_some(StateWanted { stream, since, from: 1, undecodable })
            })
            .collect();
        if !wanted.is_empty() {
            let start = self.schedule.count % wanted.len();
            wanted.rotate_left(start);
        }
        wanted
    }

    /// A request to everyone went out: the next one begins with the first origin that this one did not cover.
    fn move_cursor(&mut self, covered: Option<Covered>) {
        let cursor = self.schedule.cursor;
        if mutation::is(Mutation::OriginsNotInTurn) {
            return;
        }
        let next = match covered {
            Some(covered) if covered.is_all() => cursor,
            Some(covered) => RobotId(covered.last.0.wrapping_add(1)),
            // Not all runs of one robot fit: the others are not to wait for them.
            None => {
                let after = self.store.streams().map(|stream| stream.origin).find(|origin| *origin > cursor);
                after.unwrap_or(RobotId(0))
            }
        };
        self.schedule.rounds = self.schedule.rounds.wrapping_add(u32::from(next <= cursor));
        self.schedule.cursor = next;
    }

    /// What is held, and what nobody shall send just now: what waits for a verdict, what was rejected a moment ago, and what
    /// only a present state can bring.
    fn stated_as_held(&self, stream: Stream, now: Stamp) -> IntervalSet {
        let Some(held) = self.store.held(stream) else { return IntervalSet::new(0) };
        if mutation::is(Mutation::GapNeverAsked) {
            return IntervalSet::from_intervals(0, vec![(1, self.store.newest_known(stream))]);
        }
        let of_stream = |index| Item::Package { stream, index };
        let index = |item: Item| match item {
            Item::Package { index, .. } => Some((index, index)),
            Item::Tile { .. } => None,
        };
        let refused = self.refused.range(of_stream(0)..=of_stream(u32::MAX));
        let refused = refused.filter(|(_, until)| **until > now).filter_map(|(item, _)| index(*item));
        let ends = (of_stream(0), RobotId(0))..=(of_stream(u32::MAX), RobotId(u16::MAX));
        let undecided = self.undecided.range(ends).filter_map(|(item, _)| index(*item));
        let given_up = self.given_up.get(&stream).map(IntervalSet::intervals).unwrap_or_default();
        union_with(held, refused.chain(undecided).chain(given_up.iter().copied()).collect())
    }

    /// Clocks of peers that somebody else here cannot hear.
    fn clock_reports(&self) -> Vec<ClockReport> {
        let unheard_by_somebody = |robot: RobotId| {
            self.peers.values().any(|peer| {
                peer.stream.origin != robot
                    && peer.request.is_some()
                    && peer.hears_all_listed
                    && !peer.hears(robot)
            })
        };
        self.peers
            .values()
            .filter(|peer| unheard_by_somebody(peer.stream.origin))
            .filter_map(|peer| {
                let given = self.given_offsets.get(&peer.stream.origin).copied();
                Some(ClockReport {
                    robot: peer.stream.origin,
                    epoch_low: peer.stream.epoch as u16,
                    offset_micros: given.or_else(|| peer.clock.offset())?,
                })
            })
            .collect()
    }

    pub(super) fn is_refused(&self, item: Item, now: Stamp) -> bool {
        self.refused.get(&item).is_some_and(|&until| until > now)
    }

    /// Opens a place for a stream and tells the driver; whether there is one.
    pub(super) fn open_stream(&mut self, stream: Stream) -> bool {
        match self.store.open(stream, self.now, |robot| is_heard(&self.peers, robot)) {
            Ok(Opened { is_new, forgotten }) => {
                if let Some(forgotten) = forgotten {
                    self.counters.streams_forgotten += 1;
                    self.forget_stream(forgotten);
                }
                if is_new {
                    self.push_event(Event::StreamSeen(stream));
                }
                true
            }
            Err(_) => {
                self.counters.too_many_streams += 1;
                false
            }
        }
    }

    pub(super) fn forget_stream(&mut self, stream: Stream) {
        for peer in self.peers.values_mut() {
            peer.forget(stream);
            peer.queue_stale = true;
        }
        self.incoming.retain(|incoming| incoming.stream != stream);
        self.outgoing.retain(|outgoing| outgoing.stream != stream);
        self.undecided.retain(|(item, _)| item.stream() != stream);
        self.given_up.remove(&stream);
        self.present_asked.remove(&stream);
        self.measured_offsets.remove(&stream);
        self.push_event(Event::StreamForgotten(stream));
    }
}

fn union_with(set: &IntervalSet, intervals: Vec<(u32, u32)>) -> IntervalSet {
    if intervals.is_empty() { set.clone() } else { set.union(&IntervalSet::from_intervals(0, intervals)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{SessionConfig, SwarmKey};

    #[test]
    fn the_longest_request_of_a_thin_budget_is_as_long_as_its_option_says() {
        let key = Some(SwarmKey::from_bytes([7; 32]));
        for (swarm_key, longest) in [(None, 308), (key, 327)] {
            let config = SessionConfig {
                swarm_key,
                salt: [9; 16],
                radio_bytes_per_s: Some(600),
                ..SessionConfig::default()
            };
            let session = Session::new(Stream { origin: RobotId(1), epoch: 1 }, config, 1).unwrap();
            assert_eq!(session.request_bytes_max(5) + session.overhead(Kind::Request), longest);
        }
    }
}
