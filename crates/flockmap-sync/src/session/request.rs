//! Requests: what they say.

use super::Session;
use crate::crowd::SMALL_SWARM;
use crate::event::{Destination, Transmit};
use crate::timers::Timer;
use crate::wire::{
    ClockReport, Echo, Kind, OriginRange, Received, Request, SnapshotRequest, TransferProgress,
};
use crate::{Cast, IntervalSet};
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};

/// A request to all takes at most one part in so many of a second's worth of a budget …
const BUDGET_SHARE_AT_ONCE: usize = 2;
/// Lists of held indices that come before the origins in turn.
const URGENT_MAX: usize = 64;
/// … but a request is never cut below so many bytes: it has to say something of each transfer and stream in turn.
const REQUEST_BYTES_MIN: usize = 280;
/// Nor below so many when it is sealed, which is less before: all peers at once are to get one out of a thin
/// budget.
const SEALED_REQUEST_BYTES_MIN: usize = 299;

/// Peers that are echoed in a whole request of a crowd, in turn, and in a short one.
const ECHOES_OF_MANY: usize = 16;
const ECHOES_OF_MANY_SHORT: usize = 4;
/// Of so many whole requests of a robot in a crowd one names runs in full.
const WHOLES_IN_FULL: u32 = 8;

impl Session {
    pub(super) fn transmit_request(&mut self, now: Stamp) -> Option<Transmit> {
        self.finish_transfers(now);
        self.choose_who_is_asked(now);
        let timers = &self.schedule.timers;
        let for_gap = timers.is_due(Timer::Gap, now);
        let for_all = [Timer::Request, Timer::Greeting, Timer::Probe].iter().any(|t| timers.is_due(*t, now));
        let is_small = self.peers.len() <= SMALL_SWARM;
        let is_fast_repair = for_gap && !for_all && self.repairs_fast(now);
        let is_short =
            !timers.is_due(Timer::Request, now) && (!is_small || is_fast_repair) && self.schedule.count > 0;
        let to = if for_gap && !for_all { self.whom_to_ask(now) } else { Destination::Everyone };
        let copies = self.copies(to);
        let header = self.header(now, Kind::Request);
        let (request, urgent) = match is_short {
            true => self.short_request(now, for_all),
            false => self.whole_request(now),
        };
        let (bytes, origins) = request.emit_in_order(header, self.request_bytes_max(copies as usize), urgent);
        let each = bytes.len() + self.overhead(Kind::Request);
        if !self.spend(now, to, each, copies as usize) {
            return None;
        }
        if is_short || is_small {
            self.schedule.short_bytes = (each, copies as usize);
        }
        if !is_short {
            self.schedule.whole_bytes = (each, copies as usize);
        }
        self.report.counters.requests_out.add(copies, each);
        if let Destination::Peer(id) = to
            && let Some(peer) = self.peers.get_mut(&id)
        {
            peer.traffic_out.add(1, each);
        }
        if to == Destination::Everyone && !is_short {
            self.schedule.wholes = self.schedule.wholes.wrapping_add(1);
            self.move_cursor(origins);
        }
        if to == Destination::Everyone {
            self.peers.values_mut().for_each(|peer| peer.is_greeted = true);
            self.note_superseded();
            self.schedule.superseded = None;
        }
        self.schedule_next(now, for_gap, is_short, to);
        let path = match to {
            Destination::Peer(id) => self.peers.get(&id).and_then(|peer| peer.path.valid()),
            Destination::Everyone => None,
        };
        Some(Transmit { to, path, bytes })
    }

    /// Takes bytes from the budgets of the radio and of the links. `false`, with nothing taken: one of them
    /// has no room, and a timer says when it has.
    pub(super) fn spend(&mut self, now: Stamp, to: Destination, each: usize, copies: usize) -> bool {
        let links = self.peers.iter_mut().filter(|(id, _)| to.includes(**id));
        let mut links: Vec<_> = links.filter_map(|(_, peer)| peer.pacer.as_mut()).collect();
        let radio = self.outbox.wait(now, each * copies);
        if let Some(ready) = links.iter_mut().filter_map(|link| link.wait(now, each)).max().max(radio) {
            self.schedule.timers.set(Timer::Budget, ready);
            self.schedule.blocked_until = Some(ready);
            self.report.counters.delayed_by_budget += 1;
            return false;
        }
        links.into_iter().for_each(|link| link.spend(now, each));
        self.outbox.spend(now, each * copies);
        true
    }

    /// Longest request that leaves most of a second's worth of a small budget to packages.
    fn request_bytes_max(&self, copies: usize) -> usize {
        let link = self.config.link_bytes_per_s.map(|rate| rate as usize);
        let radio = self.request_bytes_per_s().map(|rate| rate as usize / copies.max(1));
        let rate = link.into_iter().chain(radio).min().unwrap_or(usize::MAX);
        let least = REQUEST_BYTES_MIN.min(SEALED_REQUEST_BYTES_MIN - self.seal_bytes(Kind::Request));
        (rate / BUDGET_SHARE_AT_ONCE)
            .saturating_sub(self.overhead(Kind::Request))
            .clamp(least, self.plain_bytes_max(Kind::Request))
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

    /// Milliseconds within which this robot will be heard again, where a thin radio makes that long.
    pub(super) fn next_within_ms(&self, now: Stamp) -> u32 {
        let copies = self.copies(Destination::Everyone) as usize;
        let longest = self.request_bytes_max(copies) + self.overhead(Kind::Request);
        let pause = self.budget_pause(now, (longest, copies), false);
        let ms = u32::try_from(pause.as_millis()).unwrap_or(u32::MAX);
        if ms > self.config.request_period_idle_ms { ms.saturating_add(ms / 4) } else { 0 }
    }

    /// All that there is to say. In a crowd the stamps of a few peers are echoed, in turn.
    fn whole_request(&self, now: Stamp) -> (Request, usize) {
        let (mut request, urgent) = self.request(now);
        if self.peers.len() > SMALL_SWARM {
            request.echoes.truncate(ECHOES_OF_MANY);
            request.hears = self.peers.values().map(|peer| peer.stream).collect();
            if self.schedule.wholes % WHOLES_IN_FULL != WHOLES_IN_FULL - 1 {
                request.newest_runs = self.newest_runs();
            }
        }
        (request, urgent)
    }

    /// What is missing, and whom it may be had from; `is_greeting`: the newest own package and who is met, too.
    fn short_request(&self, now: Stamp, is_greeting: bool) -> (Request, usize) {
        let (mut request, urgent) = self.request(now);
        request.received.truncate(urgent);
        let is_asked = |robot| request.received.iter().any(|received| received.stream.origin == robot);
        let met = self.peers.values().filter(|peer| is_greeting && !peer.is_greeted);
        let met: Vec<Stream> = met.map(|peer| peer.stream).collect();
        let is_met = |robot| met.iter().any(|run| run.origin == robot);
        request.echoes.retain(|echo| is_asked(echo.robot) || is_met(echo.robot));
        if self.peers.len() > SMALL_SWARM {
            request.echoes.truncate(ECHOES_OF_MANY_SHORT);
            request.hears = met;
        }
        let (urgent, newest_runs) = (request.received.len(), self.newest_runs());
        let short = Request {
            is_short: true,
            origins: None,
            all_echoes: false,
            newest_runs,
            clocks: Vec::new(),
            ..request
        };
        (short, urgent)
    }

    /// What there is to say; and how many of the lists of held indices are urgent: the own one, and those
    /// with gaps.
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
        rotate(&mut echoes, count.wrapping_mul(ECHOES_OF_MANY));
        let (received, urgent) = self.received_lists(now);
        let transfers = self.inbox.transfers.iter().map(|transfer| TransferProgress {
            source: transfer.source,
            stream: transfer.stream,
            since: transfer.since,
            upto: transfer.upto,
            snapshot_id: transfer.snapshot_id,
            chunks: transfer.chunks,
            from: 1,
            accepted: union_with(&transfer.accepted, self.inbox.unwanted_chunks(transfer, now)),
        });
        let mut transfers: Vec<TransferProgress> = transfers.collect();
        rotate(&mut transfers, count);
        let request = Request {
            origins: Some(OriginRange::all_from(self.schedule.cursor)),
            all_echoes: true,
            no_new_streams: self.store.is_full(),
            is_short: false,
            next_within_ms: self.next_within_ms(now),
            echoes,
            received,
            transfers,
            clocks: self.clock_reports(now),
            snapshot_requests: self.snapshot_requests(now),
            ..Request::default()
        };
        (request, urgent)
    }

    /// The newest runs of all robots of which lists may go by digests; none while one is to be told of its newest.
    fn newest_runs(&self) -> Vec<Stream> {
        if self.schedule.superseded.is_some() {
            return Vec::new();
        }
        let mut runs: Vec<Stream> = Vec::new();
        for stream in self.store.streams() {
            runs.pop_if(|before| before.origin == stream.origin);
            runs.push(stream);
        }
        // Whoever hears a robot in a later run, of which there are no packages yet, takes that one for its newest.
        runs.retain(|run| self.peers.get(&run.origin).is_none_or(|peer| peer.stream <= *run));
        runs
    }

    /// The lists of held indices in the order in which they are to be written, and how many of them are
    /// urgent. Urgent are: the own run; the run that a robot heard in a former one has to learn of; runs with
    /// gaps, in turn. Then come all runs, origin by origin from the cursor on.
    fn received_lists(&self, now: Stamp) -> (Vec<Received>, usize) {
        let list = |stream| self.list_of(stream, now);
        let mut urgent: Vec<Stream> = self.gaps(now).collect();
        rotate(&mut urgent, self.schedule.count);
        urgent.truncate(URGENT_MAX);
        let own = Some(self.identity.own).filter(|own| self.store.newest_known(*own) > 0);
        let first = own.into_iter().chain(self.schedule.superseded);
        let mut lists: Vec<Received> = first.chain(urgent).map(list).collect();
        let urgent = lists.len();

        let from_cursor = |stream: &Stream| stream.origin.0.wrapping_sub(self.schedule.cursor.0);
        let mut streams: Vec<Stream> = self.store.streams().collect();
        streams.sort_by_key(|stream| (from_cursor(stream), core::cmp::Reverse(stream.epoch)));
        // Of a robot with more runs than fit into a request each comes first in turn.
        if let Some(first) = streams.first().map(|stream| stream.origin) {
            let runs = streams.iter().take_while(|stream| stream.origin == first).count();
            streams[..runs].rotate_left(self.schedule.rounds as usize % runs);
        }
        // The newest run of a robot is named also where nothing of it is held: the robot may fly in a former
        // one, out of earshot.
        let is_newest = |stream: Stream| stream != self.identity.own && !self.store.is_superseded(stream);
        let named = streams.into_iter().map(list);
        lists.extend(named.filter(|received| {
            received.is_oldest_wanted || !received.received.is_empty() || is_newest(received.stream)
        }));
        (lists, urgent)
    }

    pub(super) fn list_of(&self, stream: Stream, now: Stamp) -> Received {
        Received {
            stream,
            is_oldest_wanted: self.store.is_oldest_wanted(stream),
            in_part: self.in_part(stream),
            from: 1,
            received: self.stated_as_received(stream, now),
        }
    }

    /// A snapshot of each stream of which something can only be had like that.
    fn snapshot_requests(&self, now: Stamp) -> Vec<SnapshotRequest> {
        let mut wanted: Vec<SnapshotRequest> = self
            .inbox
            .undecodable()
            .iter()
            .filter_map(|(&stream, undecodable)| {
                // What waits for a verdict, or was rejected, may never be held either.
                let unheld = self.stated_as_received(stream, now).difference(self.store.received(stream)?);
                let since = unheld.first()? - 1;
                let undecodable = undecodable.within(since + 1, u32::MAX);
                (!undecodable.is_empty()).then_some(SnapshotRequest { stream, since, from: 1, undecodable })
            })
            .collect();
        rotate(&mut wanted, self.schedule.count);
        wanted
    }

    /// A request to everyone went out: the next one begins with the first origin that this one did not cover.
    fn move_cursor(&mut self, origins: Option<OriginRange>) {
        let cursor = self.schedule.cursor;
        if mutation::is(Mutation::OriginsNotInOrder) {
            return;
        }
        let next = match origins {
            Some(origins) if origins.is_all() => cursor,
            Some(origins) => RobotId(origins.last.0.wrapping_add(1)),
            // Not all runs of one robot fit: the others are not to wait for them.
            None => {
                let after = self.store.streams().map(|stream| stream.origin).find(|origin| *origin > cursor);
                after.unwrap_or(RobotId(0))
            }
        };
        self.schedule.rounds = self.schedule.rounds.wrapping_add(u32::from(next <= cursor));
        self.schedule.cursor = next;
    }

    /// What is held, and what nobody shall send just now: what waits for a verdict, what was rejected a
    /// moment ago, and what only a snapshot can bring.
    pub(super) fn stated_as_received(&self, stream: Stream, now: Stamp) -> IntervalSet {
        let Some(received) = self.store.received(stream) else { return IntervalSet::new(0) };
        if mutation::is(Mutation::GapNeverAsked) {
            return IntervalSet::from_intervals(0, vec![(1, self.store.newest_known(stream))]);
        }
        union_with(received, self.inbox.unwanted_packages(stream, now))
    }

    /// Clocks of peers that somebody else here cannot hear.
    fn clock_reports(&self, now: Stamp) -> Vec<ClockReport> {
        let unheard_by_somebody = |robot: RobotId| {
            self.peers.values().any(|peer| {
                peer.stream.origin != robot
                    && peer.request.is_some()
                    && peer.hears_all_listed
                    && !peer.is_new(now, self.peers.len())
                    && !peer.hears(robot)
            })
        };
        self.peers
            .values()
            .filter(|peer| unheard_by_somebody(peer.stream.origin))
            .filter_map(|peer| {
                Some(ClockReport {
                    robot: peer.stream.origin,
                    epoch_low: peer.stream.epoch as u16,
                    offset_micros: self.clocks.of_peer(peer)?,
                })
            })
            .collect()
    }
}

/// A list that may be cut begins at another place each time.
fn rotate<T>(list: &mut [T], start: usize) {
    if !list.is_empty() {
        list.rotate_left(start % list.len());
    }
}

fn union_with(set: &IntervalSet, intervals: Vec<(u32, u32)>) -> IntervalSet {
    if intervals.is_empty() { set.clone() } else { set.union(&IntervalSet::from_intervals(0, intervals)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::DatagramHeader;
    use crate::{SessionConfig, SwarmKey};

    const fn run(id: u16, epoch: u64) -> Stream {
        Stream { origin: RobotId(id), epoch }
    }

    /// A session of robot 1 hears that a robot holds packages 1 to 5 of a run, which may go by a digest.
    fn hear(session: &mut Session, sender: Stream, held: Option<Stream>, newest_runs: Vec<Stream>) {
        let list = |stream| Received {
            stream,
            is_oldest_wanted: false,
            in_part: None,
            from: 1,
            received: IntervalSet::from_intervals(1, vec![(1, 5)]),
        };
        let request = Request {
            origins: Some(OriginRange::all_from(RobotId(0))),
            received: held.map(list).into_iter().collect(),
            newest_runs,
            ..Request::default()
        };
        let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender, stamp: Stamp(1_000) };
        session.handle_datagram(Stamp(2_000), &request.emit(header, 1_200)).unwrap();
    }

    /// Once nobody who heard the robot could read the digests, and all were taken to lack its former run for ever.
    #[test]
    fn a_former_run_of_a_robot_that_has_published_nothing_since_is_named_in_full_by_who_hears_it() {
        let mut session = Session::new(run(1, 1), SessionConfig::default(), 1).unwrap();
        hear(&mut session, run(4, 1), Some(run(3, 1)), Vec::new());
        assert_eq!(session.newest_runs(), [run(1, 1), run(3, 1)]);
        hear(&mut session, run(3, 2), None, Vec::new());
        assert_eq!(session.newest_runs(), [run(1, 1)]);
        hear(&mut session, run(5, 1), Some(run(3, 2)), Vec::new());
        assert_eq!(session.newest_runs(), [run(1, 1), run(3, 2)]);
    }

    #[test]
    fn a_digest_of_who_does_not_hear_that_a_robot_has_restarted_is_read_by_who_does() {
        // Robot 3, and the robot itself.
        for restarted in [3, 1] {
            let mut session = Session::new(run(1, 2), SessionConfig::default(), 1).unwrap();
            let former = run(restarted, 1);
            hear(&mut session, run(4, 1), Some(former), Vec::new());
            hear(&mut session, run(3, 2), None, Vec::new());
            hear(&mut session, run(2, 1), Some(former), vec![former]);
            let peer = &session.peers[&RobotId(2)];
            assert!(peer.streams.get(&former).is_some_and(|theirs| theirs.received.contains(5)));
            assert!(peer.takes_unnamed(run(9, 1)), "the request covers all origins");
        }
    }

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
