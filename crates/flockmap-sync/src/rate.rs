//! What the radio carries, found by the robot itself: congestion control.
//!
//! Loss says little on a radio, so it goes by queueing delay, as LEDBAT (RFC 6817) and CoDel (RFC 8289) do. Of
//! all datagrams sent and heard within half a second or more the least delay counts. If even that is above the
//! target, a queue stands: the rate goes down to this robot's share of what the radio carries. Else it goes up,
//! as long as it is used.
//!
//! The clocks need not agree: a queueing delay is measured against the base delay, the least one of the last one
//! to two minutes.

use crate::pacer::{TokenBucket, burst_bytes};
use core::time::Duration;
use flockmap_grid::Stamp;
use std::collections::VecDeque;

/// The rate before anything is known of the radio.
const INITIAL: u32 = 250_000;
/// Least rate: a full datagram in a minute.
const MIN: u32 = 20;
const MAX: u32 = 1 << 30;
/// Target: a queue stands if no datagram queued for less than this …
const TARGET: i64 = 100_000;
/// … and the time of two full datagrams, at most this.
const TARGET_MAX: i64 = 2_000_000;
const FULL_DATAGRAM: i64 = 1_228;
/// Bytes of packages that may be out of which no peer has said yet that they have arrived: at first; later as many as in
/// two seconds. As long as no queue stood, it grows by what has arrived.
const UNECHOED_MIN: u64 = 8_000;
/// Beyond that, so many for each second since the newest that has arrived was sent, so that nothing ends where no peer says
/// anything, or late.
const UNHEARD_BYTES_PER_S: u64 = 1_300;
/// Looked at again after so long.
const ECHO_PAUSE: Duration = Duration::from_millis(20);
const SECOND: i64 = 1_000_000;
/// The rate is set anew after so many samples, over so long …
const OWN_SAMPLES: u32 = 3;
const HEARD_SAMPLES: u32 = 8;
const WINDOW_MIN: i64 = 500_000;
/// … or fewer over so long.
const WINDOW_LONG: i64 = 2_000_000;
/// Samples that are too few are forgotten after so long.
const WINDOW_MAX: i64 = 20_000_000;

/// How long datagrams in one direction queue: the delay of each against the base delay.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct QueueingDelay {
    /// The least delay of this minute and of the one before, in microseconds, between two clocks.
    least: Option<[i64; 2]>,
    since: Option<Stamp>,
}

const SPAN: Duration = Duration::from_secs(60);
const NOISE: i64 = 20_000;
/// A datagram that seems to have queued for longer comes of a clock that was set.
const QUEUED_MAX: i64 = 300_000_000;

impl QueueingDelay {
    /// Microseconds that a datagram queued, from its delay between two clocks that need not agree. `None`: not
    /// known, since it is the first one, or lowers the base delay, or a clock was set.
    pub(crate) fn sample(&mut self, now: Stamp, delay: i64) -> Option<i64> {
        let is_first = self.least.is_none();
        let [mut this, mut before] = self.least.unwrap_or([delay; 2]);
        let is_less = delay < this.min(before).saturating_sub(NOISE);
        if now.since(*self.since.get_or_insert(now)) >= SPAN {
            (this, before, self.since) = (delay, this, Some(now));
        }
        this = this.min(delay);
        self.least = Some([this, before]);
        let queued = delay.saturating_sub(this.min(before));
        (!is_first && !is_less && queued < QUEUED_MAX).then_some(queued)
    }
}

/// Bytes sent so far, by the time at which they were.
#[derive(Clone, Debug, Default)]
struct SentLog {
    bytes: u64,
    /// At most [`LOG_MAX`], not nearer to each other than [`LOG_GRAIN`], and the farther apart the older they are: of a
    /// day some 400.
    points: VecDeque<(Stamp, u64)>,
}

const LOG_MAX: usize = 512;
const LOG_GRAIN: i64 = 50_000;
/// Nor than their age by this.
const LOG_PRECISION: i64 = 32;

impl SentLog {
    fn add(&mut self, now: Stamp, bytes: u64) {
        self.bytes += bytes;
        match self.points.back_mut() {
            Some(last) if now.micros_since(last.0) < LOG_GRAIN => last.1 = self.bytes,
            _ => self.points.push_back((now, self.bytes)),
        }
        if self.points.len() > LOG_MAX {
            let mut kept = Stamp(i64::MIN);
            self.points.retain(|(at, _)| {
                let is_kept = at.micros_since(kept) >= now.micros_since(*at) / LOG_PRECISION;
                kept = if is_kept { *at } else { kept };
                is_kept
            });
            // Of days.
            self.points.drain(..self.points.len().saturating_sub(LOG_MAX));
        }
    }

    /// Bytes sent up to a time.
    fn upto(&self, at: Stamp) -> Option<u64> {
        let after = self.points.partition_point(|(sent, _)| *sent <= at);
        self.points.get(after.checked_sub(1)?).map(|(_, bytes)| *bytes)
    }
}

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

/// The rate of one robot. Memory: 8 KiB.
#[derive(Clone, Debug)]
pub(crate) struct Rate {
    bytes_per_s: u32,
    bucket: TokenBucket,
    /// When it went down last: what was sent before says nothing of the rate since.
    changed_at: Stamp,
    /// No queue stood yet: the rate may double.
    in_slow_start: bool,
    log: SentLog,
    window: Option<Window>,
    newest_own: Stamp,
    /// What all robots together sent when a queue stood last, as far as it is heard.
    capacity: i64,
    /// Own bytes a second that arrived, by the last echoes.
    delivery_rate: Option<u32>,
    /// Bytes sent up to the newest own datagram of which a peer said that it has arrived, and when that one was sent.
    echoed: u64,
    echoed_upto: Option<Stamp>,
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
            changed_at: Stamp(i64::MIN),
            in_slow_start: true,
            log: SentLog::default(),
            window: None,
            newest_own: Stamp(i64::MIN),
            capacity: 0,
            delivery_rate: None,
            echoed: 0,
            echoed_upto: None,
            window_bytes: UNECHOED_MIN,
        }
    }

    /// `None` if a datagram of packages may be sent as far as it is known what has arrived of those before, else when that
    /// is to be looked at again.
    pub(crate) fn wait_for_echo(&self, now: Stamp, bytes: usize) -> Option<Stamp> {
        let out = self.log.bytes - self.echoed + bytes as u64;
        let since = self.echoed_upto.map_or(0, |upto| now.micros_since(upto).clamp(0, 1 << 40) as u64);
        let beyond = UNHEARD_BYTES_PER_S * since / SECOND as u64;
        (out > self.unechoed_max() + beyond).then(|| now.plus(ECHO_PAUSE))
    }

    /// Whether it is time to ask what has arrived, with so many bytes more.
    pub(crate) fn is_echo_wanted(&self, bytes: usize) -> bool {
        self.log.bytes - self.echoed + 2 * bytes as u64 > self.unechoed_max()
    }

    fn unechoed_max(&self) -> u64 {
        if self.in_slow_start { self.window_bytes } else { UNECHOED_MIN.max(2 * u64::from(self.bytes_per_s)) }
    }

    /// No queue stood yet.
    pub(crate) const fn in_slow_start(&self) -> bool {
        self.in_slow_start
    }

    pub(crate) const fn bytes_per_s(&self) -> u32 {
        self.bytes_per_s
    }

    /// `None` if `bytes` may be sent now, else the earliest time at which they may.
    pub(crate) fn wait(&mut self, now: Stamp, bytes: usize) -> Option<Stamp> {
        self.bucket.wait(now, bytes)
    }

    /// Bytes go out, all copies of them.
    pub(crate) fn spend(&mut self, now: Stamp, bytes: usize) {
        self.bucket.spend(now, bytes);
        self.log.add(now, bytes as u64);
        self.echoed_upto.get_or_insert(now);
    }

    /// A datagram of another robot was heard, which had queued for so long; `None`: not known.
    pub(crate) fn note_heard(&mut self, now: Stamp, bytes: usize, queued: Option<i64>) {
        let (changed_at, window) = (self.changed_at, self.window(now));
        window.heard += bytes as u64;
        if let Some(queued) = queued.filter(|&queued| now.plus_micros(-queued) >= changed_at) {
            window.others = (window.others.0 + 1, window.others.1.min(queued));
        }
    }

    /// A peer says when an own datagram arrived, which had queued for so long; `before` is what it said last.
    pub(crate) fn note_arrival(
        &mut self,
        now: Stamp,
        arrival: Arrival,
        before: Option<Arrival>,
        queued: Option<i64>,
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
            self.delivery_rate = Some(rate.min(MAX.into()) as u32);
        }
        if let Some(queued) = queued.filter(|_| arrival.sent >= self.changed_at) {
            let is_new = arrival.sent > self.newest_own;
            self.newest_own = self.newest_own.max(arrival.sent);
            let window = self.window(now);
            window.own = (window.own.0 + u32::from(is_new), window.own.1.min(queued));
        }
    }

    fn window(&mut self, now: Stamp) -> &mut Window {
        let sent = self.log.bytes;
        if self.window.as_ref().is_some_and(|window| now.micros_since(window.since) > WINDOW_MAX) {
            self.window = None;
        }
        self.window.get_or_insert_with(|| Window::new(now, sent))
    }

    /// Sets the rate anew if enough was seen; whether it is another one now. `peers`: how many share the radio,
    /// where all that they send is heard.
    pub(crate) fn review(&mut self, now: Stamp, peers: Option<usize>) -> bool {
        let Some(window) = &self.window else { return false };
        let passed = now.micros_since(window.since);
        let Some(least) = window.least_delay(passed, peers.is_some()) else { return false };
        let per_second = |bytes: u64| (bytes.min(1 << 40) as i64 * SECOND / passed).min(MAX.into());
        let sent = per_second(self.log.bytes - window.sent);
        let own = self.delivery_rate.map_or(sent, |delivery_rate| sent.min(delivery_rate.into()));
        let carried = own + per_second(window.heard);
        let robots = peers.map_or(1, |peers| peers as i64 + 1);
        let share = if peers.is_some() { carried / robots } else { 0 };
        let two_datagrams = 2 * FULL_DATAGRAM * SECOND / if peers.is_some() { carried } else { own }.max(1);
        let limit = TARGET + two_datagrams.min(TARGET_MAX);
        let before = i64::from(self.bytes_per_s);
        let to = if least > limit {
            let (part, of) = match least {
                least if least > 16 * limit => (4, 10),
                least if self.in_slow_start || least > 4 * limit => (6, 10),
                _ => (85, 100),
            };
            // As long as no echo says what arrived, who hears all others counts on its share alone.
            let own = match (self.delivery_rate, peers) {
                (Some(_), _) => own,
                (None, Some(_)) => 0,
                (None, None) => own / 2,
            };
            (self.in_slow_start, self.capacity, self.changed_at) = (false, carried, now);
            (own.max(share) * part / of).min(before)
        } else if before < 2 * sent.max(share) {
            let more = if self.in_slow_start { before } else { before / 8 + 4 };
            // What the radio carried before and does not carry now is shared by those who send.
            let unused = if peers.is_some() { self.capacity * 9 / 10 - carried } else { 0 };
            before + more + 2 * unused.max(0) / robots
        } else {
            before
        };
        self.window = None;
        self.bytes_per_s = to.clamp(MIN.into(), MAX.into()) as u32;
        self.bucket.set(now, self.bytes_per_s, burst(self.bytes_per_s));
        i64::from(self.bytes_per_s) != before
    }
}

#[cfg(test)]
mod tests;
