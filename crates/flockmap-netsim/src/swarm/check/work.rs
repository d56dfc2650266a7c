//! What one datagram makes a robot do, in the steps that `WIRE.md` counts: at most 224 for each of its bytes,
//! and 6,144 for each package in it.
//!
//! A package that waits is read later, once, when another datagram has brought what it waits for: its steps
//! are carried over.

use super::Finding;
use flockmap::Robot;
use flockmap::codec::PACKAGE_BYTES_MAX;

const NAME: &str = "work";
const STEPS_PER_BYTE: u64 = 224;
const STEPS_PER_PACKAGE: u64 = 6_144;

/// What one run of a robot has done, and may do yet.
#[derive(Default)]
pub(in crate::swarm) struct Work {
    steps: u64,
    waited: u64,
    /// Steps of packages that came and wait.
    carried: u64,
}

impl Work {
    /// What a robot did before anything came, such as reading its store, counts for no datagram. Packages
    /// from there may wait too; each is taken for one of the longest.
    pub(in crate::swarm) fn begin(&mut self, robot: &Robot) {
        self.note(robot);
        self.carried = self.waited * (PACKAGE_BYTES_MAX as u64 * STEPS_PER_BYTE + STEPS_PER_PACKAGE);
    }

    fn note(&mut self, robot: &Robot) {
        (self.steps, self.waited) = (robot.counters().steps, robot.session().counters().waited);
    }

    /// A robot has dealt with a datagram of so many bytes with so many packages.
    pub(in crate::swarm) fn taken(
        &mut self,
        robot: &Robot,
        bytes: usize,
        packages: usize,
    ) -> Option<Finding> {
        let has_waited = robot.session().counters().waited > self.waited;
        let steps = robot.counters().steps - self.steps;
        self.note(robot);
        let allowed = bytes as u64 * STEPS_PER_BYTE + packages as u64 * STEPS_PER_PACKAGE;
        if has_waited {
            self.carried += allowed;
        }
        let Some(rest) = self.carried.checked_sub(steps.saturating_sub(allowed)) else {
            let expected = format!(
                "at most {allowed} steps for {bytes} bytes with {packages} packages, and {} for packages that waited",
                self.carried
            );
            return Some(Finding::new(NAME, expected, format!("{steps} steps")));
        };
        self.carried = rest;
        None
    }
}
