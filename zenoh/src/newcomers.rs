//! Swarms of which holders were found and that are not here yet: their voxels are asked for, until somebody says them
//! or nobody is left who could.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use crate::holders::HOLDERS_MAX;

/// A question that nobody answered is asked again after so long, and after twice as long each time.
const PAUSE: Duration = Duration::from_secs(5);
const PAUSE_MAX: Duration = Duration::from_secs(80);
/// Questions that wait for their answers at once.
const ASKED_MAX: usize = 4;
/// Swarms at once that are not here yet; of more, those that were asked most often in vain are forgotten.
const NEWCOMERS_MAX: usize = 64;

/// A holder of a swarm that has come, or gone.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Sighting {
    pub(crate) swarm: u16,
    pub(crate) name: String,
    pub(crate) is_there: bool,
}

/// The swarms.
#[derive(Debug, Default)]
pub(crate) struct Newcomers(BTreeMap<u16, Newcomer>);

#[derive(Debug, Default)]
struct Newcomer {
    holders: BTreeSet<String>,
    is_asked: bool,
    /// How often it was asked in vain, and when it is asked again.
    silences: u32,
    again: Option<Instant>,
}

impl Newcomers {
    /// Notes a holder. With one that is new its swarm is asked at once.
    pub(crate) fn note(&mut self, sighting: Sighting) {
        let Sighting { swarm, name, is_there } = sighting;
        if !is_there {
            if let Some(newcomer) = self.0.get_mut(&swarm) {
                newcomer.holders.remove(&name);
                // Of one that is being asked, when the question is over.
                if newcomer.holders.is_empty() && !newcomer.is_asked {
                    self.0.remove(&swarm);
                }
            }
            return;
        }
        if !self.0.contains_key(&swarm) && self.0.len() >= NEWCOMERS_MAX {
            let idle = self.0.iter().filter(|(_, newcomer)| !newcomer.is_asked);
            let most = idle.max_by_key(|(_, newcomer)| newcomer.silences).map(|(swarm, _)| *swarm);
            most.and_then(|most| self.0.remove(&most));
        }
        let newcomer = self.0.entry(swarm).or_default();
        if newcomer.holders.len() < HOLDERS_MAX && newcomer.holders.insert(name) {
            (newcomer.silences, newcomer.again) = (0, None);
        }
    }

    /// The next swarm that is to be asked for its voxels now; it counts as asked. After that come [`Self::forget`] or
    /// [`Self::note_silence`].
    pub(crate) fn due(&mut self, now: Instant) -> Option<u16> {
        if self.0.values().filter(|newcomer| newcomer.is_asked).count() >= ASKED_MAX {
            return None;
        }
        let is_due =
            |newcomer: &Newcomer| !newcomer.is_asked && newcomer.again.is_none_or(|again| again <= now);
        let due = self.0.iter_mut().filter(|(_, newcomer)| is_due(newcomer));
        // Those that were never asked before those that were.
        let (swarm, newcomer) = due.min_by_key(|(_, newcomer)| newcomer.again)?;
        newcomer.is_asked = true;
        Some(*swarm)
    }

    /// Notes that nobody answered.
    pub(crate) fn note_silence(&mut self, swarm: u16, now: Instant) {
        let Some(newcomer) = self.0.get_mut(&swarm) else { return };
        if newcomer.holders.is_empty() {
            self.0.remove(&swarm);
            return;
        }
        newcomer.is_asked = false;
        newcomer.again = Some(now + (PAUSE * (1 << newcomer.silences.min(6))).min(PAUSE_MAX));
        newcomer.silences = newcomer.silences.saturating_add(1);
    }

    /// Forgets a swarm, until another holder of it comes.
    pub(crate) fn forget(&mut self, swarm: u16) {
        self.0.remove(&swarm);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sighting(swarm: u16, name: &str, is_there: bool) -> Sighting {
        Sighting { swarm, name: name.into(), is_there }
    }

    #[test]
    fn a_swarm_whose_one_holder_did_not_answer_is_asked_again_until_he_does() {
        let (mut newcomers, mut now) = (Newcomers::default(), Instant::now());
        newcomers.note(sighting(7, "a", true));
        assert_eq!((newcomers.due(now), newcomers.due(now)), (Some(7), None));
        for pause in [5, 10, 20, 40, 80, 80, 80].map(Duration::from_secs) {
            newcomers.note_silence(7, now);
            assert_eq!(newcomers.due(now + pause - Duration::from_millis(1)), None, "{pause:?}");
            now += pause;
            assert_eq!((newcomers.due(now), newcomers.due(now)), (Some(7), None), "{pause:?}");
        }
        // It is answered.
        newcomers.forget(7);
        assert_eq!(newcomers.due(now + 2 * PAUSE_MAX), None);
    }

    #[test]
    fn a_swarm_is_not_asked_any_more_when_its_holders_are_gone() {
        let (mut newcomers, now) = (Newcomers::default(), Instant::now());
        for name in ["a", "b"] {
            newcomers.note(sighting(7, name, true));
        }
        assert_eq!(newcomers.due(now), Some(7));
        newcomers.note_silence(7, now);
        newcomers.note(sighting(7, "a", false));
        assert_eq!(newcomers.due(now + PAUSE), Some(7));
        // The last one goes while it is asked.
        newcomers.note(sighting(7, "b", false));
        newcomers.note_silence(7, now);
        assert_eq!(newcomers.due(now + 2 * PAUSE_MAX), None);
        assert!(newcomers.0.is_empty());
    }

    #[test]
    fn with_another_holder_a_swarm_is_asked_at_once() {
        let (mut newcomers, now) = (Newcomers::default(), Instant::now());
        newcomers.note(sighting(7, "a", true));
        newcomers.due(now);
        newcomers.note_silence(7, now);
        // That is no news.
        newcomers.note(sighting(7, "a", true));
        assert_eq!(newcomers.due(now), None);
        newcomers.note(sighting(7, "b", true));
        assert_eq!(newcomers.due(now), Some(7));
    }

    #[test]
    fn swarms_that_do_not_answer_keep_no_other_waiting() {
        let (mut newcomers, now) = (Newcomers::default(), Instant::now());
        for swarm in 0..1_000 {
            newcomers.note(sighting(swarm, "flood", true));
            while let Some(swarm) = newcomers.due(now) {
                newcomers.note_silence(swarm, now);
            }
            assert!(newcomers.0.len() <= NEWCOMERS_MAX);
        }
        newcomers.note(sighting(2_000, "a", true));
        // Others are due as well, and it comes first.
        assert_eq!(newcomers.due(now + PAUSE_MAX), Some(2_000));
        // So many are asked at once, and no more.
        let asked = std::iter::from_fn(|| newcomers.due(now + PAUSE_MAX)).count();
        assert_eq!(asked, ASKED_MAX - 1);
    }

    #[test]
    fn a_flood_of_holders_is_not_remembered() {
        let mut newcomers = Newcomers::default();
        for number in 0..1_000 {
            newcomers.note(sighting(7, &format!("flood{number}"), true));
        }
        assert_eq!(newcomers.0[&7].holders.len(), HOLDERS_MAX);
    }
}
