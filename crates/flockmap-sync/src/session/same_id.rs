//! What to do where another run, or another robot, has the same id.

use super::Session;
use crate::event::Event;
use crate::identity::Anew;
use crate::wire::Request;
use core::time::Duration;
use flockmap_grid::{Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};

/// After beginning anew, it is done again not before this time; each time twice as long, up to the longest.
/// Two robots with the same id would else outdo each other without end.
const ANEW_PAUSE: Duration = Duration::from_secs(10);
const ANEW_PAUSE_MAX: Duration = Duration::from_secs(3_600);
/// Least pause between two reports that another robot has the same id.
const SAME_IDENTITY_PAUSE: Duration = Duration::from_secs(10);

impl Session {
    /// Looks at a stream that somebody named. One of the own id with an epoch that is not below the own one:
    /// a run before this one had a clock that was ahead, or another robot has the same id. Whoever knows that
    /// run takes this one for a former one.
    pub(super) fn note_own_id(&mut self, now: Stamp, run: Stream) {
        if run.origin == self.identity.own.origin && run.epoch > self.identity.own.epoch {
            self.ask_for_a_new_run(now, run.epoch);
        }
    }

    /// Looks at the runs of the own id in a request of which nothing else counts, as that of a run that this
    /// robot takes for a former one: the sender may take this one for a former run too, and else neither
    /// would ever hear the other.
    pub(super) fn note_own_runs(&mut self, now: Stamp, request: &Request) {
        request.received.iter().for_each(|received| self.note_own_id(now, received.stream));
    }

    /// Somebody holds packages of this very run that it never made.
    pub(super) fn note_own_run_used(&mut self, now: Stamp) {
        self.send_same_identity(now);
        self.ask_for_a_new_run(now, self.identity.own.epoch);
    }

    fn ask_for_a_new_run(&mut self, now: Stamp, used: u64) {
        if self.identity.anew.not_before.is_none_or(|at| at <= now)
            && !mutation::is(Mutation::BeginAnewIgnored)
        {
            let pause = (ANEW_PAUSE * (1 << self.identity.anew.times.min(16))).min(ANEW_PAUSE_MAX);
            self.identity.anew =
                Anew { times: self.identity.anew.times.saturating_add(1), not_before: Some(now.plus(pause)) };
            self.report.counters.epoch_too_low += 1;
            self.push_event(Event::EpochTooLow { used });
        }
    }

    /// Begins a new run while flying: with this epoch and an empty stream. What the former one published is
    /// forgotten here; others may hold it, as that of any run that has ended. The answer to
    /// [`Event::EpochTooLow`]. `false`, with nothing changed: the epoch is not above that of the run so far.
    pub fn begin_run(&mut self, now: Stamp, epoch: u64) -> bool {
        let now = self.advance(now);
        let former = self.identity.own;
        if epoch <= former.epoch {
            return false;
        }
        self.identity.own = Stream { epoch, ..former };
        self.store.begin_run(self.identity.own);
        self.forget_stream(former);
        self.greet(now);
        true
    }

    pub(super) fn send_same_identity(&mut self, now: Stamp) {
        self.report.counters.same_identity += 1;
        if self.identity.same_identity_sent.is_none_or(|sent| now.since(sent) >= SAME_IDENTITY_PAUSE) {
            self.identity.same_identity_sent = Some(now);
            self.push_event(Event::SameIdentity);
        }
    }
}
