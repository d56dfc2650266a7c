//! When requests go out.

use super::Session;
use crate::Cast;
use crate::config::ms;
use crate::crowd::SMALL_SWARM;
use crate::event::Destination;
use crate::peer::Peer;
use crate::rate::Rate;
use crate::schedule::Schedule;
use crate::timers::Timer;
use core::time::Duration;
use flockmap_grid::{RobotId, Stamp, Stream};

/// New peers are greeted after at most so long, each robot at another time.
const GREETING_JITTER: Duration = Duration::from_millis(20);
/// Least pause before a greeting, so that ever new runs of a faulty peer do not make us talk without end.
const GREETING_PAUSE: Duration = Duration::from_millis(50);
/// Least pause between requests that go out because a robot was heard in a former run: replays must not make
/// us talk.
const SUPERSEDED_PAUSE: Duration = Duration::from_secs(1);
/// So many requests for gaps go out at the shortest pause; after that the pause doubles each time. Over a
/// radio that loses every second datagram, one round of request and answer in four succeeds.
const GAP_TRIES: u32 = 10;
/// In a swarm larger than [`SMALL_SWARM`], whose requests add up on the radio.
const GAP_TRIES_OF_MANY: u32 = 3;
/// After so many requests that brought nothing, a gap does not count as something that flows.
const ACTIVE_TRIES: u32 = 64;
/// Longest pause between requests for gaps that stay; periodic ones go on beside them.
const GAP_PAUSE_MAX: Duration = Duration::from_secs(60);
/// Requests in which the peers are made to look whether the end of a burst is lost.
const PROBES: u8 = 2;
/// Others' requests take the place of so many of this robot's in turn.
const ASKED_BY_OTHERS_MAX: u32 = 1;
/// Within which those who lack the same ask one after the other.
const GAP_DELAY_MAX: Duration = Duration::from_millis(100);
/// Where an answer takes longer, a request left to others could be late by far more than it spares.
const ASKING_IN_TURN_MAX: Duration = Duration::from_millis(500);
/// Packages that follow this soon make a probe needless.
const PROBE_AFTER: Duration = Duration::from_millis(120);
/// Share of losses above which that is worth a datagram; below, the next packages show it soon enough.
const PROBE_LOSS_MIN: u32 = crate::link::LOSS_ONE / 6;
/// However thin the radio, peers do not lose sight of this robot for longer.
const BUDGET_PAUSE_MAX: Duration = Duration::from_secs(300);
/// Short requests take at most one part in so many of what may be sent, and whole ones; in a swarm larger than
/// [`SMALL_SWARM`], where many hear each request, short ones take less.
const SHORT_SHARE: u64 = 8;
const SHORT_SHARE_OF_MANY: u64 = 16;
const WHOLE_SHARE: u64 = 12;
/// As long as one comes within this time whole ones take less: one part in so many.
const RARE_WHOLE_SHARE: u64 = 24;
const RARE_WHOLE_MAX: Duration = Duration::from_secs(5);
const RARE_WHOLE_MAX_OF_MANY: Duration = Duration::from_secs(30);
/// Where hardly anything else is on the air, what is missing is not known to be: then requests of a crowd take so many times
/// their share.
const IDLE_TIMES: u64 = 3;
/// In a crowd so many requests go out before somebody says that it hears this robot; then one in each idle period.
const UNHEARD_REQUESTS: usize = 2;
/// As long as nobody knows what the radio carries, requests of all robots together keep to their share of so many bytes a
/// second …
const STARTING_BYTES_PER_S: u32 = 100_000;
/// … and of so many where it may be full: requests alone would fill a thin radio.
const FULL_BYTES_PER_S: u32 = 3_000;

impl Session {
    /// Packages flow: the next periodic request is due sooner.
    pub(super) fn note_activity(&mut self, now: Stamp) {
        let period = ms(self.config.request_period_active_ms);
        let soon = now.plus(period).max(self.schedule.last_whole.plus(self.whole_pause(now)));
        self.schedule.last_activity = now;
        self.schedule.timers.set_sooner(Timer::Request, soon);
    }

    /// A new peer: it should learn soon that it is heard.
    pub(super) fn greet(&mut self, now: Stamp) {
        // Where many meet at once, each greeting greets all who were met since the last.
        let doublings = 2 * self.schedule.greetings.min(4);
        let pause = (GREETING_PAUSE * (1 << doublings)).max(self.short_pause(now));
        let at = now.max(self.schedule.last.plus(pause));
        let at = at.plus(self.schedule.jitter(GREETING_JITTER));
        self.schedule.timers.set_sooner(Timer::Greeting, at);
    }

    /// A robot was heard in a run before the newest one that is known of it: it should learn of that one, and
    /// begin anew above it.
    pub(super) fn send_superseded(&mut self, now: Stamp, newest: Stream) {
        if self.schedule.superseded_sent.is_none_or(|sent| now.since(sent) >= SUPERSEDED_PAUSE) {
            self.schedule.superseded_sent = Some(now);
            self.schedule.superseded = Some(newest);
            self.greet(now);
        }
    }

    /// Something may be missing. `certain`: a later package has arrived, so it is late or lost.
    pub(super) fn note_gap(&mut self, now: Stamp, certain: bool) {
        if certain && self.config.gap_requests {
            self.schedule.gap_tries = 0;
        }
        self.expect_missing(now, None);
    }

    /// A request names packages that are missing here. They may be on their way from others.
    pub(super) fn note_gap_told_by(&mut self, now: Stamp, asking: RobotId) {
        self.expect_missing(now, Some(asking));
    }

    fn expect_missing(&mut self, now: Stamp, except: Option<RobotId>) {
        if !self.config.gap_requests {
            return;
        }
        let others = self.peers.values().filter(|peer| Some(peer.stream.origin) != except);
        let variation = others.map(|peer| peer.round_trip.variation()).max().unwrap_or_default();
        let patience = self.gap_patience(now, variation);
        let at = now.plus(patience).max(self.schedule.last.plus(self.gap_pause(now, except)));
        self.schedule.timers.set_sooner(Timer::Gap, at.plus(self.gap_delay()));
    }

    /// Pause between two requests for gaps: an answer needs the round trip at least.
    fn gap_pause(&self, now: Stamp, except: Option<RobotId>) -> Duration {
        let others = self.peers.values().filter(|peer| Some(peer.stream.origin) != except);
        let count = others.clone().count();
        let round_trip = others.map(|peer| peer.round_trip.timeout()).max().unwrap_or_default();
        // Where their own bytes set the pause, not even two go out in a round trip.
        let has_several_tries = self.repairs_fast(now) && self.short_pause(now) < round_trip;
        let tries = match count {
            0..=SMALL_SWARM if has_several_tries => GAP_TRIES * self.requests_per_round_trip(),
            0..=SMALL_SWARM => GAP_TRIES,
            _ => GAP_TRIES_OF_MANY,
        };
        let shortest = self.gap_pause_shortest(now, round_trip);
        let doublings = self.schedule.gap_tries.saturating_sub(tries).min(16);
        shortest.saturating_mul(1 << doublings).min(GAP_PAUSE_MAX).max(self.short_pause(now))
    }

    /// How much later than it could this robot asks for what is missing, since others of a crowd may lack the same and ask
    /// first (as in SRM, Floyd et al. 1997).
    fn gap_delay(&self) -> Duration {
        if !self.asks_in_turn() {
            return Duration::ZERO;
        }
        self.gap_pause_least().min(GAP_DELAY_MAX) * self.schedule.gap_slot as u32 / Schedule::GAP_SLOTS as u32
    }

    /// Whether those who lack the same ask one after the other: many who hear each other, on a radio fast enough that one
    /// hears another's request before its own is on the air.
    fn asks_in_turn(&self) -> bool {
        self.config.cast == Cast::Broadcast
            && self.peers.len() > SMALL_SWARM
            && self.gap_pause_least() <= ASKING_IN_TURN_MAX
    }

    fn gap_pause_least(&self) -> Duration {
        let round_trip = self.peers.values().map(|peer| peer.round_trip.timeout()).max().unwrap_or_default();
        ms(self.config.gap_request_pause_ms).max(round_trip)
    }

    /// Whether others have just asked for all that is missing here: the answer is for everyone.
    fn is_asked_by_others(&self, now: Stamp) -> bool {
        if !self.asks_in_turn() || self.schedule.gaps_asked_by_others >= ASKED_BY_OTHERS_MAX {
            return false;
        }
        let since = now.plus_micros(-(self.gap_pause_least().min(GAP_DELAY_MAX).as_micros() as i64));
        self.gaps(now).all(|stream| {
            let is_asked = |(low, high): (u32, u32)| {
                self.peers.values().any(|peer| {
                    let theirs = peer.streams.get(&stream).filter(|theirs| theirs.stated_at >= since);
                    theirs.is_some_and(|theirs| theirs.received.within(low, high).is_empty())
                        && peer.hears(stream.origin)
                })
            };
            let received = self.stated_as_received(stream, now);
            !self.inbox.undecodable().contains_key(&stream)
                && !self.inbox.transfers.iter().any(|transfer| transfer.stream == stream)
                && received.missing(1, self.store.newest_known(stream)).all(is_asked)
        })
    }

    /// A gap was filled: answers come, so what is still missing is worth asking for soon.
    pub(super) const fn note_gap_filled(&mut self) {
        self.schedule.gap_tries = 0;
    }

    /// Packages went out. If their end gets lost, nothing that follows shows the peers: make them look.
    pub(super) fn note_sent(&mut self, now: Stamp) {
        let is_lossy = |peer: &&Peer| peer.loss.share() > PROBE_LOSS_MIN;
        let timeout = self.peers.values().filter(is_lossy).map(|peer| peer.round_trip.timeout()).max();
        match timeout {
            Some(timeout) => {
                self.schedule.timers.set(Timer::Probe, now.plus(timeout.max(PROBE_AFTER)));
                self.schedule.probes_left = PROBES;
            }
            None => self.schedule.timers.stop(Timer::Probe),
        }
    }

    /// Whether something sent before is neither confirmed nor known to be lost.
    fn is_waiting_for_request(&self, now: Stamp) -> bool {
        self.peers.values().any(|peer| {
            let timeout = peer.round_trip.timeout();
            peer.in_flight.back().is_some_and(|sent| now.since(sent.at) >= timeout / 2)
        })
    }

    pub(super) fn request_due(&mut self, now: Stamp) -> bool {
        self.wait_until_heard(now);
        if self.schedule.timers.is_due(Timer::Gap, now) && !self.has_gap(now) {
            self.schedule.timers.stop(Timer::Gap);
            self.schedule.gap_tries = 0;
        }
        if self.schedule.timers.is_due(Timer::Gap, now) && self.is_asked_by_others(now) {
            self.schedule.gaps_asked_by_others += 1;
            self.schedule.draw_gap_slot();
            self.report.counters.gaps_asked_by_others += 1;
            let at = now.plus(self.gap_pause(now, None)).plus(self.gap_delay());
            self.schedule.timers.set(Timer::Gap, at);
        }
        if self.schedule.timers.is_due(Timer::Probe, now) && !self.is_waiting_for_request(now) {
            self.schedule.timers.stop(Timer::Probe);
        }
        Timer::REQUESTS.into_iter().any(|timer| self.schedule.timers.is_due(timer, now))
    }

    /// Puts off what is due while nobody of a crowd hears this robot.
    fn wait_until_heard(&mut self, now: Stamp) {
        let until = self.schedule.last.plus(ms(self.config.request_period_idle_ms));
        if self.schedule.count < UNHEARD_REQUESTS || until <= now || !self.is_unheard() {
            return;
        }
        for timer in Timer::REQUESTS {
            if self.schedule.timers.is_due(timer, now) {
                self.schedule.timers.set(timer, until);
            }
        }
    }

    fn has_gap(&self, now: Stamp) -> bool {
        self.gaps(now).next().is_some()
    }

    /// The streams with gaps that somebody may fill now, by packages or by a snapshot, or whose rest is coming.
    pub(super) fn gaps(&self, now: Stamp) -> impl Iterator<Item = Stream> + '_ {
        self.store.streams().filter(move |&stream| {
            let newest = self.store.newest_known(stream);
            stream != self.identity.own
                && (self.inbox.undecodable().contains_key(&stream)
                    || self
                        .inbox
                        .transfers
                        .iter()
                        .any(|transfer| transfer.is_rest && transfer.stream == stream)
                    || self.stated_as_received(stream, now).missing(1, newest).next().is_some())
        })
    }

    /// Pause after a request of so many bytes, so that requests take no more than their share of the budget.
    pub(super) fn budget_pause(
        &self,
        now: Stamp,
        (each, copies): (usize, usize),
        is_short: bool,
    ) -> Duration {
        let pause = |bytes: usize, rate: Option<u32>| {
            let is_idle = |rate: &Rate| self.peers.len() > SMALL_SWARM && rate.is_idle();
            let times = if self.outbox.rate.as_ref().is_some_and(is_idle) { IDLE_TIMES } else { 1 };
            let of_share = |share: u64| {
                let share = share / times;
                Duration::from_micros(
                    rate.map_or(0, |rate| bytes as u64 * share * 1_000_000 / u64::from(rate.max(1))),
                )
            };
            let (short_share, rare_max) = match self.peers.len() {
                0..=SMALL_SWARM => (SHORT_SHARE, RARE_WHOLE_MAX),
                _ => (SHORT_SHARE_OF_MANY, RARE_WHOLE_MAX_OF_MANY),
            };
            match is_short {
                true => of_share(short_share),
                false => of_share(WHOLE_SHARE).max(of_share(RARE_WHOLE_SHARE).min(rare_max)),
            }
        };
        let copied = each * copies;
        let starting = |of_all: u32| pause(copied, self.starting_bytes_per_s(of_all));
        let radio = pause(copied, self.radio_bytes_per_s()).max(starting(STARTING_BYTES_PER_S));
        // Not more rarely than where nothing flows, so that nobody takes this robot for silent.
        let idle = ms(self.config.request_period_idle_ms);
        let full = if self.may_be_full(now) { starting(FULL_BYTES_PER_S).min(idle) } else { Duration::ZERO };
        radio.max(full).max(pause(each, self.config.link_bytes_per_s)).min(BUDGET_PAUSE_MAX)
    }

    /// Whether nobody of a crowd has said yet that it hears this robot, and nothing is known of the radio: what is said
    /// again and again may fill it.
    pub(super) fn is_unheard(&self) -> bool {
        let own = self.identity.own.origin;
        self.peers.len() > SMALL_SWARM
            && self.outbox.rate.as_ref().is_some_and(Rate::in_slow_start)
            && !self.peers.values().any(|peer| peer.hears(own))
    }

    /// Whether nothing is known of the radio, and it may be full.
    fn may_be_full(&self, now: Stamp) -> bool {
        self.outbox.rate.as_ref().is_some_and(|rate| rate.in_slow_start() && !rate.seems_free(now))
    }

    /// Least pause after the last whole request, at the rate of now.
    fn whole_pause(&self, now: Stamp) -> Duration {
        self.budget_pause(now, self.schedule.whole_bytes, false)
    }

    /// The same after the last short one; in a small swarm, after the last one.
    pub(super) fn short_pause(&self, now: Stamp) -> Duration {
        self.budget_pause(now, self.schedule.short_bytes, true)
    }

    /// The rate is another one: if it rose, the next whole request is due sooner.
    pub(super) fn hasten_request(&mut self, now: Stamp) {
        let pause = self.whole_pause(now).max(ms(self.config.request_period_idle_ms));
        self.schedule.timers.set_sooner(Timer::Request, self.schedule.last_whole.plus(pause).max(now));
    }

    /// The rate of which whole requests take their share.
    pub(super) fn request_bytes_per_s(&self) -> Option<u32> {
        self.radio_bytes_per_s().into_iter().chain(self.starting_bytes_per_s(STARTING_BYTES_PER_S)).min()
    }

    /// This robot's share as long as nobody knows what the radio carries.
    fn starting_bytes_per_s(&self, of_all: u32) -> Option<u32> {
        let is_starting = self.outbox.rate.as_ref().is_some_and(Rate::in_slow_start);
        is_starting.then(|| of_all / (self.peers.len() as u32 + 1))
    }

    pub(super) fn schedule_next(&mut self, now: Stamp, for_gap: bool, is_short: bool, to: Destination) {
        if to == Destination::Everyone && !is_short {
            self.schedule.last_whole = now;
            let flows = now.since(self.schedule.last_activity) < ms(self.config.active_for_ms);
            let active = flows || (self.schedule.gap_tries < ACTIVE_TRIES && self.has_gap(now));
            let period = match active {
                true => self.config.request_period_active_ms,
                false => self.config.request_period_idle_ms,
            };
            let period = ms(period).max(self.whole_pause(now));
            let jittered = period - period / 10 + self.schedule.jitter(period / 5);
            self.schedule.timers.set(Timer::Request, now.plus(jittered));
        }
        if to == Destination::Everyone {
            let is_greeting = self.schedule.timers.get(Timer::Greeting).is_some();
            self.schedule.greetings = if is_greeting { self.schedule.greetings.saturating_add(1) } else { 0 };
            self.schedule.timers.stop(Timer::Greeting);
            let timeouts = self.peers.values().map(|peer| peer.round_trip.timeout());
            self.schedule.probes_left = self.schedule.probes_left.saturating_sub(1);
            if self.schedule.probes_left == 0 {
                self.schedule.timers.stop(Timer::Probe);
            } else if self.schedule.timers.get(Timer::Probe).is_some() {
                let pause = timeouts.fold(self.short_pause(now), Duration::max);
                self.schedule.timers.set(Timer::Probe, now.plus(pause));
            }
        }
        self.schedule.last = now;
        if self.peers.len() > SMALL_SWARM {
            self.schedule.gaps_asked_by_others = 0;
            self.schedule.draw_gap_slot();
        }
        self.schedule.count = self.schedule.count.wrapping_add(1);
        if for_gap {
            self.report.counters.gap_requests += 1;
        }
        self.schedule.gap_tries =
            if self.has_gap(now) { self.schedule.gap_tries.saturating_add(1) } else { 0 };
        if self.schedule.timers.get(Timer::Gap).is_some() {
            // The request has just said all that is missing; say it again after a pause that grows.
            let pause = self.gap_pause(now, None);
            let periodic = ms(self.config.request_period_active_ms).max(self.whole_pause(now));
            match pause < periodic {
                true => self.schedule.timers.set(Timer::Gap, now.plus(pause).plus(self.gap_delay())),
                false => self.schedule.timers.stop(Timer::Gap),
            }
        }
    }
}
