//! What the radio carries, found by the robot itself: congestion control.
//!
//! Loss says little on a radio, so it goes by queueing delay, as LEDBAT (RFC 6817) and CoDel (RFC 8289) do. Of
//! all datagrams sent and heard within half a second or more the least delay counts. If even that is above the
//! target, a queue stands: the rate goes down to this robot's share of what the radio carries. Else it goes up,
//! as long as it is used.
//!
//! A queue may stand whatever this robot does, filled by cross traffic (TCP, a video). So the rate does not go below this
//! robot's share of 39 % of what the radio is known to carry, and does not rise above it until that traffic yields.
//!
//! A short queue overflows before its delay shows. So losses count as a queue too, where they are more than usual.

mod capacity;
mod losses;
mod queueing;
mod sent_log;

pub(crate) use queueing::{Queued, QueueingDelays};

use crate::config::BYTES_PER_S_MIN;
use crate::crowd::SMALL_SWARM;
use crate::pacer::{TokenBucket, burst_bytes};
use capacity::{Arrived, BYTES_PER_S_MAX, Capacity, FULL_DATAGRAM, SECOND, per_second};
use core::time::Duration;
use flockmap_grid::Stamp;
use losses::Losses;
use sent_log::SentLog;

/// The rate before anything is known of the radio.
const INITIAL: u32 = 250_000;
/// Target: a queue stands if no datagram queued for less than this …
const TARGET: i64 = 100_000;
/// … and the time of two full datagrams, at most this.
const TARGET_MAX: i64 = 2_000_000;
/// Bytes of packages that may be out of which no peer has said yet that they have arrived: at first; later as many as in
/// two seconds. As long as no queue stood, it grows by what has arrived.
const UNECHOED_MIN: u64 = 8_000;
/// Beyond that, so many for each second since the newest that has arrived was sent, so that nothing ends where no peer says
/// anything, or late.
const UNHEARD_BYTES_PER_S: u64 = 1_300;
/// Of a crowd each gets a part of both unless others' datagrams are heard that hardly queued: of so many robots.
const UNECHOED_ROBOTS: u64 = 4;
const UNECHOED_LEAST: u64 = 1_300;
/// The radio may be full if nothing that was sent within so long is known to have arrived …
const ECHO_PATIENCE: i64 = 2 * SECOND;
/// … and more than this is out without an echo: a few requests always are.
const UNECHOED_FEW: u64 = 2_000;
/// Looked at again after so long.
const ECHO_PAUSE: Duration = Duration::from_millis(20);
/// The rate is set anew after so many samples, over so long …
const OWN_SAMPLES: u32 = 3;
const HEARD_SAMPLES: u32 = 8;
const WINDOW_MIN: i64 = 500_000;
/// … or fewer over so long.
const WINDOW_LONG: i64 = 2_000_000;
/// Samples that are too few are forgotten after so long.
const WINDOW_MAX: i64 = 120_000_000;
/// Share of the radio that the robots keep beside cross traffic, in per cent …
const SHARE_KEPT: i64 = 39;
/// … which there may be if a queue stands while they take less than this themselves …
const SHARE_ALONE: i64 = 70;
/// … and there is if it stands for so long, for three times its own delay, and for the time of four full datagrams of each
/// robot.
const PATIENCE: i64 = 4 * SECOND;
/// For so long the rate does not rise then.
const CROSS_TRAFFIC_FOR: i64 = 30 * SECOND;
/// At most so many pairs are sent on purpose.
const PAIRS_SENT_MAX: u32 = 16;
/// Datagrams sent within so long are sent at once.
const AT_ONCE: i64 = 1_000;

/// What was seen since the rate was set last.
#[derive(Clone, Debug)]
struct Window {
    since: Stamp,
    sent: u64,
    heard: u64,
    /// Samples, and the least queueing delay of them: of own datagrams, each counted once, and of others'.
    own: (u32, i64),
    others: (u32, i64),
}

impl Window {
    const fn new(since: Stamp, sent: u64) -> Self {
        Self { since, sent, heard: 0, own: (0, i64::MAX), others: (0, i64::MAX) }
    }

    /// The least queueing delay, if enough was seen in the time that passed.
    fn least_delay(&self, passed: i64, is_heard_by_all: bool) -> Option<i64> {
        if passed < WINDOW_MIN {
            return None;
        }
        let is_long = passed >= WINDOW_LONG;
        let enough = if is_long && is_heard_by_all { HEARD_SAMPLES / 2 } else { HEARD_SAMPLES };
        match (self.own, self.others) {
            ((count, least), _) if count >= OWN_SAMPLES => Some(least),
            // By unicast the queues of others say little of the own one.
            ((count, least), _) if count > 0 && is_long && !is_heard_by_all => Some(least),
            (_, (count, least)) if count >= enough => Some(least),
            ((count, least), _) if count > 0 && is_long => Some(least),
            _ => None,
        }
    }
}

/// The last datagram of which a peer said that it has arrived: when it was sent, and when it came, by its clock.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Arrival {
    pub(crate) sent: Stamp,
    pub(crate) arrived: Stamp,
}

/// A datagram of another robot.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Heard {
    pub(crate) bytes: usize,
    /// Its send stamp.
    pub(crate) sent: Stamp,
    /// Send stamp and time of arrival of the datagram of that robot before it.
    pub(crate) before: Option<(Stamp, Stamp)>,
    /// For how long it queued; `None`: not known.
    pub(crate) queued: Option<Queued>,
}

/// The rate of one robot. Memory: 8 KiB.
#[derive(Clone, Debug)]
pub(crate) struct Rate {
    bytes_per_s: u32,
    bucket: TokenBucket,
    /// When a queue stood last: what was sent before says nothing of the rate since.
    stood_at: Stamp,
    /// When the rate went down last.
    went_down_at: Stamp,
    /// When a queue stood for the first time. Before that the rate may double.
    began_at: Option<Stamp>,
    queue_stands: bool,
    /// When a datagram came last that had hardly queued.
    free_at: Stamp,
    log: SentLog,
    sent_at: Stamp,
    /// Pairs begun on purpose.
    pairs_sent: u32,
    window: Option<Window>,
    newest_own: Stamp,
    /// What was carried for all robots when a queue stood last, as far as it is heard.
    carried_when_full: i64,
    capacity: Capacity,
    losses: Losses,
    /// Until then cross traffic is taken to fill the queue.
    cross_traffic_until: Stamp,
    /// Own bytes a second that arrived, by the last echoes.
    delivery_rate: Option<u32>,
    /// Bytes sent up to the newest own datagram of which a peer said that it has arrived, and when that one was sent.
    echoed: u64,
    echoed_upto: Option<Stamp>,
    /// For how long datagrams of other robots queued lately, in microseconds, smoothed over eight of them.
    queued: Option<i64>,
    /// Not a third of what the radio carried when a queue stood last is on the air.
    is_idle: bool,
    /// Bytes of other robots heard: one of so many that they send.
    heard: u64,
    heard_of: i64,
    /// Most bytes that may be out without such a word, as long as no queue stood.
    window_bytes: u64,
}

/// What may go out at once.
fn burst(bytes_per_s: u32) -> u32 {
    burst_bytes(bytes_per_s, 50).max(1_300)
}

impl Rate {
    pub(crate) fn new() -> Self {
        Self {
            bytes_per_s: INITIAL,
            bucket: TokenBucket::new(INITIAL, burst(INITIAL)),
            stood_at: Stamp(i64::MIN),
            went_down_at: Stamp(i64::MIN),
            began_at: None,
            queue_stands: false,
            free_at: Stamp(i64::MIN),
            log: SentLog::default(),
            sent_at: Stamp(i64::MIN),
            pairs_sent: 0,
            window: None,
            newest_own: Stamp(i64::MIN),
            carried_when_full: 0,
            capacity: Capacity::new(),
            losses: Losses::new(),
            cross_traffic_until: Stamp(i64::MIN),
            delivery_rate: None,
            echoed: 0,
            echoed_upto: None,
            queued: None,
            is_idle: false,
            heard: 0,
            heard_of: 1,
            window_bytes: UNECHOED_MIN,
        }
    }

    /// `None` if a datagram of packages may be sent as far as it is known what has arrived of those before, else when that
    /// is to be looked at again.
    pub(crate) fn wait_for_echo(&self, now: Stamp, bytes: usize, peers: usize) -> Option<Stamp> {
        let out = self.log.bytes - self.echoed + bytes as u64;
        let since = self.echoed_upto.map_or(0, |upto| now.micros_since(upto).clamp(0, 1 << 40) as u64);
        let is_free = self.queued.is_some_and(|queued| queued < TARGET);
        let (least, beyond) = match peers as u64 {
            peers if self.in_slow_start() && peers > SMALL_SWARM as u64 && !is_free => (
                (UNECHOED_MIN * UNECHOED_ROBOTS / peers).max(UNECHOED_LEAST),
                UNHEARD_BYTES_PER_S * UNECHOED_ROBOTS / peers,
            ),
            _ => (UNECHOED_MIN, UNHEARD_BYTES_PER_S),
        };
        let out_max = self.unechoed_max() - UNECHOED_MIN + least + beyond * since / SECOND as u64;
        (out > out_max).then(|| now.plus(ECHO_PAUSE))
    }

    /// Whether it is time to ask what has arrived, with so many bytes more.
    pub(crate) fn is_echo_wanted(&self, bytes: usize) -> bool {
        self.log.bytes - self.echoed + 2 * bytes as u64 > self.unechoed_max()
    }

    fn unechoed_max(&self) -> u64 {
        if self.in_slow_start() {
            self.window_bytes
        } else {
            UNECHOED_MIN.max(2 * u64::from(self.bytes_per_s))
        }
    }

    /// No queue stood yet.
    pub(crate) const fn in_slow_start(&self) -> bool {
        self.began_at.is_none()
    }

    /// When the newest own datagram was sent of which a peer said that it has arrived, or the first one; and for how long
    /// datagrams of others queued lately.
    pub(crate) fn queue(&self) -> (Option<Stamp>, Duration) {
        (self.echoed_upto, Duration::from_micros(self.queued.unwrap_or(0) as u64))
    }

    /// Whether hardly anything is on the air.
    pub(crate) const fn is_idle(&self) -> bool {
        self.is_idle
    }

    /// Whether nothing says that a queue stands: a peer has said of nearly all that was sent that it has arrived, or of
    /// something that was sent lately, or a datagram came lately that had hardly queued.
    pub(crate) fn seems_free(&self, now: Stamp) -> bool {
        let is_recent = |stamp| now.micros_since(stamp) < ECHO_PATIENCE;
        self.log.bytes - self.echoed <= UNECHOED_FEW
            || self.echoed_upto.is_none_or(is_recent)
            || is_recent(self.free_at)
    }

    pub(crate) const fn bytes_per_s(&self) -> u32 {
        self.bytes_per_s
    }

    /// `None` if `bytes` may be sent now, else the earliest time at which they may. Where a queue stands, two at once: from
    /// such pairs the others learn what the radio carries.
    pub(crate) fn wait(&mut self, now: Stamp, bytes: usize) -> Option<Stamp> {
        let begins_pair = self.queue_stands
            && self.pairs_sent < PAIRS_SENT_MAX
            && !self.capacity.is_known_by_pairs()
            && now.micros_since(self.sent_at) > AT_ONCE
            && 2 * bytes <= burst(self.bytes_per_s) as usize;
        let wait = self.bucket.wait(now, if begins_pair { 2 * bytes } else { bytes });
        self.pairs_sent += u32::from(begins_pair && wait.is_none());
        wait
    }

    /// Bytes go out, all copies of them.
    pub(crate) fn spend(&mut self, now: Stamp, bytes: usize) {
        self.bucket.spend(now, bytes);
        self.log.add(now, bytes as u64);
        self.sent_at = now;
        self.echoed_upto.get_or_insert(now);
    }

    /// A datagram of another robot was heard.
    pub(crate) fn note_heard(&mut self, now: Stamp, heard: Heard) {
        self.heard += heard.bytes as u64;
        if let Some(queued) = heard.queued {
            let queued = queued.beyond_base.max(0);
            self.queued = Some(self.queued.map_or(queued, |mean| mean + (queued - mean) / 8));
        }
        if heard.queued.is_some_and(|queued| queued.all < 2 * TARGET) {
            self.free_at = now;
        }
        if let (Some(queued), Some((sent, arrived))) = (heard.queued, heard.before)
            && queued.all > TARGET
            && (0..AT_ONCE).contains(&heard.sent.micros_since(sent))
        {
            self.capacity.note_pair(heard.bytes, now.micros_since(arrived));
        }
        let (stood_at, window) = (self.stood_at, self.window(now));
        window.heard += heard.bytes as u64;
        if let Some(queued) = heard.queued.filter(|queued| now.plus_micros(-queued.beyond_base) >= stood_at) {
            window.others = (window.others.0 + 1, window.others.1.min(queued.all));
        }
    }

    /// Whether an own datagram arrived.
    pub(crate) fn note_outcome(&mut self, now: Stamp, sent: Stamp, is_lost: bool) {
        self.capacity.note_outcome(sent, is_lost);
        if sent >= self.stood_at {
            self.losses.note(now, is_lost);
        }
    }

    /// A peer says when an own datagram arrived, which had queued for so long; `before` is what it said last.
    pub(crate) fn note_arrival(
        &mut self,
        now: Stamp,
        arrival: Arrival,
        before: Option<Arrival>,
        queued: Option<Queued>,
    ) {
        if let Some(echoed) = self.log.upto(arrival.sent).filter(|echoed| *echoed > self.echoed) {
            self.window_bytes = (self.window_bytes + echoed - self.echoed).min(1 << 30);
            (self.echoed, self.echoed_upto) = (echoed, Some(arrival.sent));
        }
        let passed = before.map(|before| (before, arrival.arrived.micros_since(before.arrived)));
        if let Some((before, passed)) =
            passed.filter(|(_, passed)| (SECOND / 4..60 * SECOND).contains(passed))
            && let (Some(then), Some(now)) = (self.log.upto(before.sent), self.log.upto(arrival.sent))
        {
            let rate = now.saturating_sub(then) * SECOND as u64 / passed as u64;
            self.delivery_rate = Some(rate.min(BYTES_PER_S_MAX.into()) as u32);
        }
        if let Some(queued) = queued.filter(|_| self.began_at.is_some_and(|began| arrival.sent >= began)) {
            let own_at = arrival.sent.plus_micros(queued.beyond_base);
            let arrived =
                Arrived { sent: arrival.sent, own: self.echoed, own_at, heard: self.heard, heard_at: now };
            self.capacity.note_arrived(now, arrived, self.heard_of);
        }
        if let Some(queued) = queued.filter(|_| arrival.sent >= self.stood_at) {
            let is_new = arrival.sent > self.newest_own;
            self.newest_own = self.newest_own.max(arrival.sent);
            let window = self.window(now);
            window.own = (window.own.0 + u32::from(is_new), window.own.1.min(queued.all));
        }
    }

    fn window(&mut self, now: Stamp) -> &mut Window {
        let sent = self.log.bytes;
        if self.window.as_ref().is_some_and(|window| now.micros_since(window.since) > WINDOW_MAX) {
            self.window = None;
        }
        self.window.get_or_insert_with(|| Window::new(now, sent))
    }

    /// Sets the rate anew if enough was seen; whether it is another one now. `peers`: how many share the radio;
    /// `is_heard_by_all`: all that they send is heard.
    pub(crate) fn review(&mut self, now: Stamp, peers: usize, is_heard_by_all: bool) -> bool {
        let Some(window) = &self.window else { return false };
        let passed = now.micros_since(window.since);
        let Some(least) = window.least_delay(passed, is_heard_by_all) else { return false };
        let sent = per_second(self.log.bytes - window.sent, passed);
        let own = self.delivery_rate.map_or(sent, |delivery_rate| sent.min(delivery_rate.into()));
        let is_lossy = self.losses.is_unusual();
        let own = if is_lossy { self.losses.arriving(own) } else { own };
        let peers = peers.min(1 << 16) as i64;
        let robots = peers + 1;
        // By unicast the other robots are taken to send each other as much as they send here.
        self.heard_of = if is_heard_by_all { 1 } else { peers };
        let carried = own + per_second(window.heard, passed) * self.heard_of;
        let capacity = self.capacity.bytes_per_s();
        // Robots that fill the queue alone get all that the radio carries.
        let is_shared = carried < capacity * SHARE_ALONE / 100;
        let two_datagrams = 2 * FULL_DATAGRAM * SECOND / if is_shared { capacity } else { carried }.max(1);
        let limit = TARGET + two_datagrams.min(TARGET_MAX);
        let share = if is_heard_by_all || capacity == 0 { carried } else { carried.min(capacity) } / robots;
        let before = i64::from(self.bytes_per_s);
        let is_used = before < 2 * sent.max(share);
        self.queue_stands = least > limit || (is_used && is_lossy);
        let to = if self.queue_stands {
            let part = match least {
                least if least > 16 * limit => 40,
                least if self.in_slow_start() || least > 4 * limit => 60,
                least if least > limit => 85,
                _ => 70,
            };
            // As long as no echo says what arrived, who hears all others counts on its share alone.
            let own = match (self.delivery_rate, is_heard_by_all) {
                (Some(_), _) => own,
                (None, true) => 0,
                (None, false) => own / 2,
            };
            let least_share = match capacity * SHARE_KEPT / 100 {
                _ if !is_shared => 0,
                kept if is_heard_by_all => kept / robots,
                kept => kept * own.max(carried / robots) / carried.max(1),
            };
            (own.max(share) * part / 100).min(before).max(least_share.min(2 * before))
        } else if (is_used || before < self.carried_when_full / robots) && now >= self.cross_traffic_until {
            let more = if self.in_slow_start() { before } else { before / 8 + 4 };
            // What the radio carried before and does not carry now is shared by those who send: in a crowd by few.
            let unused = self.carried_when_full * 9 / 10 - carried;
            let part = if peers > SMALL_SWARM as i64 { 4 } else { 2 };
            before + more + part * unused.max(0) / robots
        } else {
            before
        };
        self.is_idle = !self.queue_stands && 3 * carried < self.carried_when_full;
        if self.queue_stands {
            self.carried_when_full = carried;
            self.began_at.get_or_insert(now);
            self.stood_at = now;
            let stood_for = now.micros_since(self.went_down_at);
            if to < before {
                self.went_down_at = now;
                self.losses.begin_anew();
            } else if is_shared && stood_for > PATIENCE.max(3 * least).max(2 * two_datagrams * robots) {
                self.cross_traffic_until = now.plus_micros(CROSS_TRAFFIC_FOR);
            }
        }
        self.window = None;
        self.bytes_per_s = to.clamp(BYTES_PER_S_MIN.into(), BYTES_PER_S_MAX.into()) as u32;
        self.bucket.set(now, self.bytes_per_s, burst(self.bytes_per_s));
        i64::from(self.bytes_per_s) != before
    }
}

#[cfg(test)]
mod cross_traffic;
#[cfg(test)]
mod model;
#[cfg(test)]
mod tests;
