//! No two runs of a flight have the same robot and epoch, and no two starts the same salt, whatever clocks
//! and disks do. A run that is begun anew while flying has an epoch of its own, and goes on with the salt and
//! the counters of the one before.

use super::Finding;
use flockmap::Stream;
use flockmap::sync::wire::Salt;
use std::collections::BTreeSet;

const NAME: &str = "identity";

/// All runs of a flight so far.
#[derive(Default)]
pub(in crate::swarm) struct Identities {
    runs: BTreeSet<Stream>,
    salts: BTreeSet<Salt>,
}

impl Identities {
    /// A robot starts.
    pub(in crate::swarm) fn started(&mut self, run: Stream, salt: Salt) -> Option<Finding> {
        let is_new = self.salts.insert(salt);
        let salt = (!is_new).then(|| {
            Finding::new(NAME, "a salt that no run had before", format!("{salt:02x?} again, of {run:?}"))
        });
        self.begun(run).or(salt)
    }

    /// A run begins, at a start or while flying.
    pub(in crate::swarm) fn begun(&mut self, run: Stream) -> Option<Finding> {
        (!self.runs.insert(run)).then(|| {
            let expected = format!("an epoch that no run of {:?} had before", run.origin);
            Finding::new(NAME, expected, format!("{} again", run.epoch))
        })
    }
}
