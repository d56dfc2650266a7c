//! What was missed is asked for: holders are found by their tokens, say what they hold, and are asked for what is
//! lacking. What is put is the fast way, and this the sure one.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use flockmap::sync::{IntervalSet, RECEIVED_INTERVALS_MAX};
use flockmap::{Resolution, RobotId, Stamp, Stream};
use flockmap_node::{Log, NodeHandle};
use zenoh::query::{ConsolidationMode, QueryTarget, ReplyKeyExpr};
use zenoh::sample::Locality;
use zenoh::{Session, Wait};

use crate::asked::{Ask, Asked, Outcome};
use crate::claims::{Answer, Claim, Claims};
use crate::clocks::Clocks;
use crate::counters::Counters;
use crate::held::{HELD_BYTES_MAX, Held, intervals_text, parse_intervals};
use crate::holders::Holders;
use crate::keys::{Keys, parse_holder};
use crate::takes::{By, Intake};

/// What an answer takes beside its bytes.
const ANSWER_OVERHEAD_BYTES: usize = 1_000;
/// An answer of what is held that takes longer is not waited for.
const HELD_TIMEOUT: Duration = Duration::from_secs(5);
/// An answer of what is lacking that takes longer comes to an end.
const GET_TIMEOUT: Duration = Duration::from_secs(120);
/// It is not waited for any more if nothing of it comes for so long; what comes later is taken as well. And a holder
/// whose answers took longer and brought nothing has had its turn.
const QUIET_MAX: Duration = Duration::from_secs(30);
/// While an answer is waited for, it is looked so often whether the node has ended.
const LOOK_PERIOD: Duration = Duration::from_millis(500);
/// Look again so soon where something may be on its way.
const SOON: Duration = Duration::from_secs(1);

/// Asks for what a swarm's robot here lacks.
pub(crate) struct CatchUp<'a> {
    pub(crate) session: &'a Session,
    pub(crate) keys: Keys,
    pub(crate) name: &'a str,
    /// Whether clocks are measured here, and not taken from holders.
    pub(crate) on_radio: bool,
    pub(crate) period: Duration,
    pub(crate) node: &'a NodeHandle,
    /// Answers that are not waited for any more do not keep it there.
    pub(crate) intake: &'a Arc<Intake>,
    pub(crate) holders: Holders,
    pub(crate) counters: &'a Counters,
    pub(crate) log: &'a Log,
}

/// What is remembered between two looks. All of it is bounded by the holders that may be known and the runs that have a
/// place here, whatever is claimed.
#[derive(Default)]
struct Memory {
    claims: Claims,
    asked: Asked,
    clocks: Clocks,
    said_resolution: bool,
}

/// What of the node matters here.
struct Own {
    resolution: Resolution,
    /// Runs of others that have a place.
    runs_max: usize,
    /// The robots of which something is known.
    robots: BTreeSet<RobotId>,
}

/// An answer that has come, and may still be merged.
struct Answered {
    stream: Stream,
    /// What the holder has of the run, and how much of it was lacking here when it was asked.
    theirs: IntervalSet,
    lacked: u64,
    began: Instant,
    has_answered: bool,
    merged: Receiver<()>,
}

impl CatchUp<'_> {
    /// Until the node has ended, or nobody can wake it any more.
    pub(crate) fn run(&self, wake: &Receiver<()>) {
        let mut memory = Memory::default();
        let mut wait = Duration::ZERO;
        loop {
            match wake.recv_timeout(wait) {
                Ok(()) | Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
            // Several at once are as good as one.
            while wake.try_recv().is_ok() {}
            wait = self.period;
            if self.node.has_ended() {
                return;
            }
            if self.holders.has_others(self.name) {
                match self.look(&mut memory) {
                    Ok(true) => wait = SOON.min(self.period),
                    Ok(false) => {}
                    Err(error) => self.log.warn(format!("cannot ask who holds what: {error}")),
                }
            }
        }
    }

    /// Whether something may be on its way.
    fn look(&self, memory: &mut Memory) -> Result<bool, String> {
        let Some(own) = self.own() else { return Ok(false) };
        let (there, came) = self.holders.look();
        memory.asked.keep_holders(&there, &came);
        memory.claims.replace(self.ask_all(&memory.claims, &there)?, own.runs_max);
        if !self.on_radio {
            self.set_clocks(memory, &own);
        }
        let Memory { claims, asked, said_resolution, .. } = memory;
        let mut names = claims.names();
        // Who does not answer does not keep those waiting who do.
        names.sort_by_key(|name| asked.silences(name));
        let (mut is_coming, mut lacking) = (false, BTreeSet::new());
        for name in names {
            let Some(claim) = claims.get(&name) else { continue };
            asked.keep_claimed(&name, claim.runs.iter().map(|run| run.stream()));
            if asked.is_given_up(&name, Instant::now()) {
                continue;
            }
            if Resolution::from_micrometres(claim.resolution_um) != Some(own.resolution) {
                if !std::mem::replace(said_resolution, true) {
                    self.warn_resolution(&name, claim, &own);
                }
                continue;
            }
            is_coming |= self.ask_one(asked, &name, claim, &mut lacking)?;
        }
        asked.keep_lacking(&lacking);
        Ok(is_coming)
    }

    /// `None` if the node has ended.
    fn own(&self) -> Option<Own> {
        self.node.with_robot(|robot, _| Own {
            resolution: robot.config().mapper.resolution,
            runs_max: robot.session().config().streams_max,
            robots: robot.session().streams().map(|stream| stream.origin).collect(),
        })
    }

    fn warn_resolution(&self, name: &str, claim: &Claim, own: &Own) {
        let side = f64::from(claim.resolution_um) / 1e6;
        self.log.warn(format!(
            "{name} has voxels of {side} m, expected {:?} as here: nothing is taken from it",
            own.resolution
        ));
    }

    /// Asks all holders what they hold. Who has no token is not heard.
    fn ask_all(&self, claims: &Claims, there: &BTreeSet<String>) -> Result<Vec<Answer>, String> {
        let selector = format!("{}?unless={}", self.keys.held_of_all(), claims.known());
        let asked = self.node.clock().now();
        let (answers, answers_in) = channel();
        let get = self
            .session
            .get(selector)
            .target(QueryTarget::All)
            .consolidation(ConsolidationMode::None)
            .allowed_destination(Locality::Remote)
            .timeout(HELD_TIMEOUT);
        let (clock, bytes) = (self.node.clock(), AtomicUsize::new(0));
        get.callback(move |reply| {
            let Ok(sample) = reply.result() else { return };
            let length = sample.payload().len().saturating_add(ANSWER_OVERHEAD_BYTES);
            if bytes.fetch_add(length, Ordering::Relaxed).saturating_add(length) <= HELD_BYTES_MAX {
                // Nobody waits any more if this fails.
                let _ = answers.send((clock.now(), sample.clone()));
            }
        })
        .wait()
        .map_err(|error| error.to_string())?;
        let mut said = Vec::new();
        for (came, sample) in answers_in {
            let Some((_, _, name)) = parse_holder(sample.key_expr().as_str()) else { continue };
            if !there.contains(name) {
                continue;
            }
            let Ok(held) = serde_json::from_slice::<Held>(&sample.payload().to_bytes()) else {
                self.counters.refused.add(1);
                continue;
            };
            let ahead = clock_ahead(asked, came, held.now_us);
            said.push(Answer { name: name.to_owned(), held, ahead });
        }
        Ok(said)
    }

    /// Takes over the clocks of robots.
    fn set_clocks(&self, memory: &mut Memory, own: &Own) {
        let changes = memory.clocks.change(&memory.claims.clocks(), &own.robots, own.runs_max);
        if !changes.is_empty() {
            // Where the node has ended there is no clock to set.
            let _ = self.node.with_robot(move |robot, _| {
                changes.into_iter().for_each(|(id, micros)| robot.set_clock_offset(id, micros));
            });
        }
    }

    /// Asks a holder for what is lacking, run after run, until it has had its turn. Whether something may be on its
    /// way, so that it was not asked for; notes of which runs a part is lacking.
    fn ask_one(
        &self,
        asked: &mut Asked,
        name: &str,
        claim: &Claim,
        lacking: &mut BTreeSet<Stream>,
    ) -> Result<bool, String> {
        let (mut is_coming, mut in_vain, mut answered) = (false, Duration::ZERO, None);
        for run in claim.runs.iter() {
            let stream = run.stream();
            let Some(theirs) = parse_intervals(&run.held) else { continue };
            let Some(own) = self.received(stream) else { break };
            if theirs.difference(&own).is_empty() {
                asked.note_whole(name, stream);
                continue;
            }
            if !own.is_empty() {
                lacking.insert(stream);
            }
            let began = Instant::now();
            let as_snapshot = match asked.ask(name, stream, !own.is_empty(), began) {
                Ask::Now { as_snapshot } if !self.intake.is_full() => as_snapshot,
                Ask::Soon => {
                    is_coming = true;
                    continue;
                }
                Ask::Now { .. } | Ask::Later => continue,
            };
            // While it answers, what it has answered before is merged.
            let replies = self.ask_for(name, stream, &own, as_snapshot)?;
            if let Some(before) = answered.take()
                && !self.note_answer(asked, name, before, &mut in_vain)
            {
                return Ok(is_coming);
            }
            let has_answered = wait_for(&replies, QUIET_MAX, || self.node.has_ended());
            let merged = self.intake.merged();
            let lacked = theirs.difference(&own).count();
            answered = Some(Answered { stream, theirs, lacked, began, has_answered, merged });
        }
        if let Some(last) = answered {
            self.note_answer(asked, name, last, &mut in_vain);
        }
        Ok(is_coming)
    }

    /// Waits until an answer is merged, and notes what it has brought. Whether the holder is to be asked for more.
    fn note_answer(&self, asked: &mut Asked, name: &str, answered: Answered, in_vain: &mut Duration) -> bool {
        let Answered { stream, theirs, lacked, began, has_answered, merged } = answered;
        // An error means that the node has ended.
        let _ = merged.recv();
        let Some(after) = self.received(stream) else { return false };
        // What came meanwhile without an answer was put, by whoever else.
        let outcome = if !has_answered {
            Outcome::Silence
        } else if theirs.difference(&after).count() < lacked {
            Outcome::Brought
        } else {
            Outcome::Nothing
        };
        let now = Instant::now();
        if asked.note(name, stream, outcome, now) {
            self.log.info(format!("{name} does not answer: others are asked, and it again later"));
        }
        if outcome != Outcome::Brought {
            *in_vain += now.duration_since(began);
        }
        outcome != Outcome::Silence && *in_vain < QUIET_MAX
    }

    /// Asks a holder for what is lacking of a run of which this robot holds `own`. It is told of each reply, and
    /// disconnected at the end.
    fn ask_for(
        &self,
        name: &str,
        stream: Stream,
        own: &IntervalSet,
        as_snapshot: bool,
    ) -> Result<Receiver<()>, String> {
        let form = if as_snapshot { ";as=snapshot" } else { "" };
        let held = intervals_text(own.intervals());
        let selector = format!("{}?held={held}{form}", self.keys.get(name, stream));
        let intake = Arc::downgrade(self.intake);
        let (replies, replies_in) = channel();
        let get = self
            .session
            .get(selector)
            .accept_replies(ReplyKeyExpr::Any)
            .consolidation(ConsolidationMode::None)
            .allowed_destination(Locality::Remote)
            .timeout(GET_TIMEOUT);
        get.callback(move |reply| {
            if let (Ok(sample), Some(intake)) = (reply.result(), intake.upgrade()) {
                intake.take(sample, By::Answer);
            }
            // It may be that nobody waits any more.
            let _ = replies.send(());
        })
        .wait()
        .map_err(|error| error.to_string())?;
        Ok(replies_in)
    }

    /// What is held here of a run; `None` if the node has ended.
    fn received(&self, stream: Stream) -> Option<IntervalSet> {
        self.node.with_robot(move |robot, _| {
            let none = || IntervalSet::new(RECEIVED_INTERVALS_MAX);
            robot.session().received(stream).cloned().unwrap_or_else(none)
        })
    }
}

/// Waits for the end of an answer, or until nothing of it comes for so long, or nobody wants it any more. Whether there
/// was one: a reply, or an end without any.
fn wait_for(replies: &Receiver<()>, quiet_max: Duration, is_unwanted: impl Fn() -> bool) -> bool {
    let (mut has_answered, mut left) = (false, quiet_max);
    loop {
        let step = left.min(LOOK_PERIOD);
        match replies.recv_timeout(step) {
            Ok(()) => (has_answered, left) = (true, quiet_max),
            Err(RecvTimeoutError::Disconnected) => return true,
            Err(RecvTimeoutError::Timeout) => left -= step,
        }
        if left.is_zero() || is_unwanted() {
            return has_answered;
        }
    }
}

/// How far a clock is ahead of the own one that showed a time between these two.
fn clock_ahead(asked: Stamp, came: Stamp, shown_us: i64) -> i64 {
    shown_us.saturating_sub(asked.0 / 2 + came.0 / 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_end_without_packages_is_an_answer_and_silence_is_none() {
        let (replies, replies_in) = channel();
        // Still nothing, and no patience.
        assert!(!wait_for(&replies_in, Duration::ZERO, || false));
        drop(replies);
        assert!(wait_for(&replies_in, QUIET_MAX, || false));
    }

    #[test]
    fn who_has_answered_a_part_has_answered() {
        let (replies, replies_in) = channel();
        replies.send(()).unwrap();
        assert!(wait_for(&replies_in, QUIET_MAX, || true));
    }

    #[test]
    fn an_answer_is_not_waited_for_when_the_node_has_ended() {
        let (_replies, replies_in) = channel();
        // It would be quiet for far longer.
        assert!(!wait_for(&replies_in, Duration::from_secs(86_400), || true));
    }

    #[test]
    fn a_clock_that_shows_the_same_in_the_middle_is_not_ahead() {
        assert_eq!(clock_ahead(Stamp(100), Stamp(300), 200), 0);
        assert_eq!(clock_ahead(Stamp(100), Stamp(300), 1_200), 1_000);
        assert_eq!(clock_ahead(Stamp(i64::MAX), Stamp(i64::MAX), i64::MIN), i64::MIN);
    }
}
