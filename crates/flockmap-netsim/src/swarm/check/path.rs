//! By unicast, where robots hear by path, nothing but a PATH datagram goes to a path through which no answer
//! to a challenge came back; and of those there are few.

use super::Finding;
use flockmap::sync::wire::PathMessage;
use flockmap::{Path, Stream};
use std::collections::{BTreeMap, BTreeSet};

const NAME: &str = "path";
/// A run of a robot is sent at most one challenge in this time, and one more where the first waited for the
/// budget.
const CHALLENGE_EVERY: i64 = 200_000;

/// What one run of a robot asked and was answered.
#[derive(Default)]
pub(in crate::swarm) struct Paths {
    /// Where each challenge went. Whoever answers it was there, whichever path the answer takes.
    asked: BTreeMap<u64, Path>,
    answered: BTreeSet<Path>,
    /// Challenges to each run of a robot, and when the first was sent.
    challenges: BTreeMap<Stream, (i64, i64)>,
    /// Challenges that came and have had no answer yet.
    owed: u64,
}

impl Paths {
    /// A PATH datagram has come and was taken.
    pub(in crate::swarm) fn arrived(&mut self, message: &PathMessage) {
        self.answered.extend(message.answer.and_then(|number| self.asked.get(&number)));
        self.owed += u64::from(message.challenge.is_some());
    }

    /// A datagram goes to a robot on a path; `message`: what it says, if it is one about paths.
    pub(in crate::swarm) fn sent(
        &mut self,
        now: i64,
        to: Stream,
        path: Path,
        message: Option<&PathMessage>,
    ) -> Option<Finding> {
        let Some(message) = message else { return self.used(path) };
        if let Some(number) = message.challenge {
            self.asked.insert(number, path);
            let (count, first) = self.challenges.entry(to).or_insert((0, now));
            *count += 1;
            let most = 2 + (now - *first) / CHALLENGE_EVERY;
            if *count > most {
                let expected = format!("at most {most} challenges to {to:?}");
                return Some(Finding::new(NAME, expected, count.to_string()));
            }
        }
        if message.answer.is_some() {
            let Some(rest) = self.owed.checked_sub(1) else {
                let expected = "no more answers than challenges that came";
                return Some(Finding::new(NAME, expected, format!("one more, to {to:?}")));
            };
            self.owed = rest;
        }
        None
    }

    /// A path is one of those where what is for everyone goes.
    pub(in crate::swarm) fn used(&self, path: Path) -> Option<Finding> {
        (!self.answered.contains(&path)).then(|| {
            let expected = format!("nothing but PATH datagrams to {path:?}: no answer came back through it");
            Finding::new(NAME, expected, "a datagram of another kind")
        })
    }
}
