//! Which sealed datagrams were there already: for each robot a window over its counters, as in RFC 6479.

use crate::wire::Salt;
use flockmap_grid::{RobotId, Stream};
use std::collections::BTreeMap;

/// Counters that a window covers: so far a datagram may be superseded by later ones and still count.
pub(crate) const WINDOW: u64 = BITS - 64;
/// One word more than the window, so that the words which the window leaves behind are cleared whole.
const BITS: u64 = 2_048;
const WORDS: usize = (BITS / 64) as usize;

/// Why a genuine datagram does not count.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum NotFresh {
    /// It was there already, or so many later ones were that nobody can know.
    Replayed,
    /// It is from a run before this one.
    Stale(u64),
}

/// What was heard of every robot. Only genuine datagrams get here, so only holders of the key fill it: at
/// most 120 bytes for each robot id ever heard (for all 65,536 of them 8 MiB), and 512 bytes more for those
/// that are peers.
#[derive(Clone, Debug, Default)]
pub(crate) struct Replays {
    robots: BTreeMap<RobotId, Heard>,
}

/// The newest run of a robot.
#[derive(Clone, Debug)]
struct Heard {
    epoch: u64,
    salt: Salt,
    for_all: Window,
    for_one: Window,
}

/// The counters of one run that were there, of datagrams for all or of those for this robot alone.
#[derive(Clone, Debug, Default)]
struct Window {
    /// The highest one, once there was one.
    newest: Option<u64>,
    /// Bit `counter % BITS`: it was there. Without these, all up to the newest count as having been there.
    seen: Option<Box<[u64; WORDS]>>,
}

impl Replays {
    /// The salt of a run, if it is the newest of its robot that was heard.
    pub(crate) fn salt(&self, sender: Stream) -> Option<Salt> {
        self.robots.get(&sender.origin).filter(|heard| heard.epoch == sender.epoch).map(|heard| heard.salt)
    }

    /// Whether a genuine datagram counts; changes nothing.
    pub(crate) fn check(&self, sender: Stream, is_for_one: bool, counter: u64) -> Result<(), NotFresh> {
        match self.robots.get(&sender.origin) {
            Some(heard) if sender.epoch < heard.epoch => Err(NotFresh::Stale(heard.epoch)),
            Some(heard) if sender.epoch == heard.epoch && heard.window(is_for_one).has(counter) => {
                Err(NotFresh::Replayed)
            }
            _ => Ok(()),
        }
    }

    /// Notes a genuine datagram that passed the check. `is_peer`: keep what came of this robot one by one, so
    /// that datagrams that come out of order count. All counters below the first one noted of a run count as
    /// having been there.
    pub(crate) fn note(&mut self, sender: Stream, salt: Salt, is_for_one: bool, counter: u64, is_peer: bool) {
        let first =
            || Heard { epoch: sender.epoch, salt, for_all: Window::default(), for_one: Window::default() };
        let heard = self.robots.entry(sender.origin).or_insert_with(first);
        if heard.epoch != sender.epoch {
            *heard = first();
        }
        let window = if is_for_one { &mut heard.for_one } else { &mut heard.for_all };
        window.note(counter, is_peer);
    }

    /// The robot is no peer any more: all of its datagrams up to the newest count as having been there from
    /// now on.
    pub(crate) fn forget_window(&mut self, robot: RobotId) {
        if let Some(heard) = self.robots.get_mut(&robot) {
            (heard.for_all.seen, heard.for_one.seen) = (None, None);
        }
    }

    #[cfg(test)]
    pub(crate) fn windows(&self) -> usize {
        let of = |heard: &Heard| {
            usize::from(heard.for_all.seen.is_some()) + usize::from(heard.for_one.seen.is_some())
        };
        self.robots.values().map(of).sum()
    }
}

impl Heard {
    const fn window(&self, is_for_one: bool) -> &Window {
        if is_for_one { &self.for_one } else { &self.for_all }
    }
}

impl Window {
    fn has(&self, counter: u64) -> bool {
        let Some(newest) = self.newest.filter(|newest| counter <= *newest) else { return false };
        match &self.seen {
            Some(seen) if newest - counter < WINDOW => seen[word(counter)] & (1 << (counter % 64)) != 0,
            _ => true,
        }
    }

    fn note(&mut self, counter: u64, is_peer: bool) {
        let newest = self.newest.unwrap_or(counter);
        if is_peer && self.seen.is_none() {
            let mut seen = Box::new([u64::MAX; WORDS]);
            seen[word(newest)] >>= 63 - newest % 64;
            self.seen = Some(seen);
        }
        self.newest = Some(newest.max(counter));
        let Some(seen) = &mut self.seen else { return };
        // The words between the newest and this one come into the window empty; of a far jump, all of them.
        let from = newest / 64 + 1;
        for at in (from..=counter / 64).take(WORDS) {
            seen[word(at * 64)] = 0;
        }
        seen[word(counter)] |= 1 << (counter % 64);
    }
}

const fn word(counter: u64) -> usize {
    (counter / 64) as usize % WORDS
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    const SALT: Salt = [1; 16];

    fn stream(epoch: u64) -> Stream {
        Stream { origin: RobotId(7), epoch }
    }

    fn take(replays: &mut Replays, counter: u64) -> bool {
        let fresh = replays.check(stream(1), false, counter).is_ok();
        if fresh {
            replays.note(stream(1), SALT, false, counter, true);
        }
        fresh
    }

    #[test]
    fn reordered_datagrams_count_once_within_the_window_and_not_beyond() {
        let mut replays = Replays::default();
        assert!(take(&mut replays, 10));
        assert!(!take(&mut replays, 10) && !take(&mut replays, 9), "what was before the first is not known");
        let newest = 10_000;
        assert!(take(&mut replays, newest));
        assert!(take(&mut replays, newest - WINDOW + 1) && !take(&mut replays, newest - WINDOW + 1));
        assert!(!take(&mut replays, newest - WINDOW));
        assert!(take(&mut replays, newest - 1) && !take(&mut replays, newest));
    }

    #[test]
    fn a_new_run_begins_anew_and_the_former_one_is_stale() {
        let mut replays = Replays::default();
        replays.note(stream(5), SALT, false, 100, true);
        assert_eq!(replays.check(stream(6), false, 1), Ok(()));
        replays.note(stream(6), [2; 16], false, 1, true);
        assert_eq!(replays.check(stream(6), false, 1), Err(NotFresh::Replayed));
        assert_eq!(replays.check(stream(5), false, 101), Err(NotFresh::Stale(6)));
        assert_eq!((replays.salt(stream(6)), replays.salt(stream(5))), (Some([2; 16]), None));
    }

    #[test]
    fn datagrams_for_all_and_for_one_are_counted_apart() {
        let mut replays = Replays::default();
        replays.note(stream(1), SALT, false, 900, true);
        assert_eq!(replays.check(stream(1), true, 5), Ok(()));
        replays.note(stream(1), SALT, true, 5, true);
        assert_eq!(replays.check(stream(1), true, 5), Err(NotFresh::Replayed));
        assert_eq!(
            replays.check(stream(1), true, 4),
            Err(NotFresh::Replayed),
            "it was before the first one heard"
        );
        assert_eq!(replays.check(stream(1), false, 5), Err(NotFresh::Replayed));
        assert_eq!(replays.check(stream(1), false, 901), Ok(()));
    }

    #[test]
    fn of_a_robot_that_went_nothing_old_counts_when_it_comes_back() {
        let mut replays = Replays::default();
        for counter in (1..100).filter(|c| c % 3 == 0) {
            assert!(take(&mut replays, counter));
        }
        replays.forget_window(RobotId(7));
        for counter in 1..=99 {
            assert_eq!(replays.check(stream(1), false, counter), Err(NotFresh::Replayed));
        }
        assert!(take(&mut replays, 105));
        assert!(!take(&mut replays, 98) && take(&mut replays, 104) && take(&mut replays, 100));
    }

    #[test]
    fn who_is_no_peer_has_no_window() {
        let mut replays = Replays::default();
        for robot in 0..1_000 {
            replays.note(Stream { origin: RobotId(robot), epoch: 1 }, SALT, false, 5, false);
        }
        assert!(replays.windows() == 0);
    }

    proptest! {
        /// Against a set of all counters that were ever there.
        #[test]
        fn a_window_lets_each_counter_through_once(
            first in 1..1u64 << 47,
            steps in prop::collection::vec((0..6u8, 0..5_000u64), 1..400),
        ) {
            let mut replays = Replays::default();
            prop_assert!(take(&mut replays, first));
            let (mut seen, mut newest) = (BTreeSet::from([first]), first);
            for (how, by) in steps {
                let counter = match how {
                    0 => newest + by,
                    1 => newest + by % 70,
                    2 => newest + 1,
                    3 => newest.saturating_sub(by),
                    4 => newest.saturating_sub(by % 200),
                    _ => newest.saturating_sub(WINDOW - 5 + by % 10),
                };
                let fresh = counter > newest
                    || (counter > first && newest - counter < WINDOW && !seen.contains(&counter));
                prop_assert_eq!(take(&mut replays, counter), fresh, "{} of newest {}", counter, newest);
                if fresh {
                    seen.insert(counter);
                    newest = newest.max(counter);
                }
            }
        }
    }
}
