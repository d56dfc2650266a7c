//! What went out to everyone: who hears this robot may have it, and it is repaired rather than sent anew. And what others
//! sent to everyone.

use crate::IntervalSet;
use crate::crowd::SMALL_SWARM;
use crate::item::Item;
use core::time::Duration;
use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::{BTreeMap, VecDeque};

/// Items remembered with the time at which they went out.
const RECENT_MAX: usize = 256;
/// Intervals of what went out, of each stream.
const SENT_INTERVALS_MAX: usize = 256;
/// Beyond a small swarm a repair waits for what others lack: so long times the square of the number of peers …
const GATHERING: Duration = Duration::from_micros(100);
const GATHERING_MAX: Duration = Duration::from_secs(1);
/// … and on a thin radio for as long as so many bytes take at this robot's rate.
const GATHERING_BYTES: u64 = 614;
const GATHERING_THIN_MAX: Duration = Duration::from_secs(5);

/// Packages and chunks that went out to everyone. Memory: 24 KiB, and 4 KiB for each stream.
#[derive(Debug)]
pub(crate) struct Broadcasts {
    /// The last ones, oldest first.
    recent: VecDeque<(Stamp, Item)>,
    /// And the last ones that others sent, with who did.
    heard: VecDeque<(Stamp, RobotId, Item)>,
    sent: BTreeMap<Stream, IntervalSet>,
    repairs_at: Stamp,
}

impl Broadcasts {
    pub(crate) const fn new() -> Self {
        Self {
            recent: VecDeque::new(),
            heard: VecDeque::new(),
            sent: BTreeMap::new(),
            repairs_at: Stamp(i64::MIN),
        }
    }

    /// Notes what goes out.
    pub(crate) fn note(&mut self, now: Stamp, items: &[Item]) {
        for item in items {
            if let Item::Package { stream, index } = *item {
                // One that has no place in the list counts as not sent yet, and goes out plain.
                let sent = self.sent.entry(stream).or_insert_with(|| IntervalSet::new(SENT_INTERVALS_MAX));
                let _ = sent.insert(index);
            }
            push_recent(&mut self.recent, (now, *item));
        }
    }

    /// Notes what another robot sent.
    pub(crate) fn note_heard(&mut self, now: Stamp, from: RobotId, item: Item) {
        push_recent(&mut self.heard, (now, from, item));
    }

    /// What others sent of a stream since a time: who hears them has heard it too.
    pub(crate) fn heard(&self, stream: Stream, since: Stamp) -> impl Iterator<Item = (RobotId, Item)> + '_ {
        let heard = self.heard.iter().rev().take_while(move |(at, ..)| *at > since);
        heard.map(|(_, from, item)| (*from, *item)).filter(move |(_, item)| item.stream() == stream)
    }

    /// The last ones: who is met now may have heard them.
    pub(crate) fn recent(&self) -> impl Iterator<Item = (Stamp, Item)> + '_ {
        self.recent.iter().copied()
    }

    /// Which packages of a stream went out.
    pub(crate) fn sent(&self, stream: Stream) -> Option<&IntervalSet> {
        self.sent.get(&stream)
    }

    /// Whether a package went out before.
    pub(crate) fn was_sent(&self, item: Item) -> bool {
        let Item::Package { stream, index } = item else { return false };
        self.sent(stream).is_some_and(|sent| sent.contains(index))
    }

    /// Something got lost: a crowd may lack other packages too, which the same datagram can repair.
    pub(crate) fn note_loss(&mut self, now: Stamp, peers: usize, bytes_per_s: Option<u32>) {
        if peers > SMALL_SWARM && self.repairs_at <= now {
            let gathering = (GATHERING * (peers * peers) as u32).min(GATHERING_MAX);
            let micros = bytes_per_s.map_or(0, |rate| GATHERING_BYTES * 1_000_000 / u64::from(rate.max(1)));
            let thin = Duration::from_micros(micros).min(GATHERING_THIN_MAX);
            self.repairs_at = now.plus(gathering.max(thin));
        }
    }

    /// Until when a package waits that was sent before.
    pub(crate) fn repairs_wait_until(&self, now: Stamp) -> Option<Stamp> {
        Some(self.repairs_at).filter(|at| *at > now)
    }

    pub(crate) fn forget(&mut self, stream: Stream) {
        self.sent.remove(&stream);
        self.recent.retain(|(_, item)| item.stream() != stream);
        self.heard.retain(|(.., item)| item.stream() != stream);
    }
}

/// Of more than are remembered the oldest goes first, so that the list never takes more room.
fn push_recent<T>(list: &mut VecDeque<T>, newest: T) {
    if list.len() >= RECENT_MAX {
        list.pop_front();
    }
    list.push_back(newest);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn in_a_crowd_a_repair_waits_for_other_losses_and_longer_on_a_thin_radio() {
        let gathered = |peers, bytes_per_s| {
            let mut broadcasts = Broadcasts::new();
            broadcasts.note_loss(Stamp(0), peers, bytes_per_s);
            broadcasts.repairs_wait_until(Stamp(0)).map(|at| at.0)
        };
        assert_eq!(gathered(SMALL_SWARM, Some(100)), None);
        assert_eq!(gathered(20, None), Some(40_000));
        assert_eq!(gathered(20, Some(100_000)), Some(40_000));
        assert_eq!(gathered(20, Some(307)), Some(2_000_000));
        assert_eq!(gathered(20, Some(20)), Some(5_000_000));
    }
}
