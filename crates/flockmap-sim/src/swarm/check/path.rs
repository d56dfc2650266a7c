//! By unicast, where robots hear by path, nothing but a PATH datagram goes to a path through which no answer to a challenge came back.

use super::Finding;
use flockmap::Path;
use flockmap::sync::wire::PathMessage;
use std::collections::{BTreeMap, BTreeSet};

const NAME: &str = "path";

/// What one run of a robot asked and was answered.
#[derive(Default)]
pub(in crate::swarm) struct Paths {
    /// Where each challenge went. Whoever answers it was there, whichever way the answer takes.
    asked: BTreeMap<u64, Path>,
    answered: BTreeSet<Path>,
}

impl Paths {
    /// A PATH datagram has come and was taken.
    pub(in crate::swarm) fn arrived(&mut self, message: &PathMessage) {
        self.answered.extend(message.answer.and_then(|number| self.asked.get(&number)));
    }

    /// A datagram goes to a path; `message`: what it says, if it is one about paths.
    pub(in crate::swarm) fn sent(&mut self, path: Path, message: Option<&PathMessage>) -> Option<Finding> {
        match message {
            Some(message) => {
                self.asked.extend(message.challenge.map(|number| (number, path)));
                None
            }
            None => self.used(path),
        }
    }

    /// A path is one of those where what is for everyone goes.
    pub(in crate::swarm) fn used(&self, path: Path) -> Option<Finding> {
        (!self.answered.contains(&path)).then(|| Finding {
            checker: NAME,
            expected: format!("nothing but PATH datagrams to {path:?}: no answer came back through it"),
            found: "a datagram of another kind".to_owned(),
        })
    }
}
