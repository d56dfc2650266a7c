//! What was missed is asked for: holders are found by their tokens, say what they hold, and are asked for what is lacking.
//! What is put is the fast way, and this the sure one.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use flockmap::sync::{IntervalSet, RECEIVED_INTERVALS_MAX};
use flockmap::{RobotId, Stamp, Stream};
use flockmap_node::{Log, NodeHandle};
use zenoh::query::{ConsolidationMode, QueryTarget, ReplyKeyExpr};
use zenoh::sample::Locality;
use zenoh::{Session, Wait};

use crate::counters::Counters;
use crate::held::{HELD_BYTES_MAX, Held, HeldStream, intervals_text, parse_intervals};
use crate::keys::{Keys, parse_holder};
use crate::takes::{By, Intake};

/// Holders that are known at once; of more, those that come are not asked.
const HOLDERS_MAX: usize = 64;
/// What an answer takes beside its bytes.
const ANSWER_OVERHEAD_BYTES: usize = 1_000;
/// An answer that takes longer is not waited for.
const HELD_TIMEOUT: Duration = Duration::from_secs(5);
const GET_TIMEOUT: Duration = Duration::from_secs(120);
/// What is lacking for no longer may be on its way.
const PATIENCE: Duration = Duration::from_millis(900);
/// Look again so soon where something may be on its way.
const SOON: Duration = Duration::from_secs(1);
/// A stream of which a holder brought nothing is asked for again after so long, twice as long each time.
const FRUITLESS: Duration = Duration::from_secs(10);
const FRUITLESS_MAX: Duration = Duration::from_secs(600);
/// Clocks that differ from what is set by less stay as they are: each change makes the map anew where it matters.
const CLOCK_CHANGE_MICROS: u64 = 50_000;

/// The holders of which there is a sign of life.
#[derive(Clone, Debug, Default)]
pub(crate) struct Holders(Arc<Mutex<BTreeSet<String>>>);

impl Holders {
    /// Whether it is new, or gone.
    pub(crate) fn set(&self, name: &str, is_there: bool) -> bool {
        let mut names = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if is_there { names.len() < HOLDERS_MAX && names.insert(name.to_owned()) } else { names.remove(name) }
    }

    fn has_others(&self, own: &str) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).iter().any(|name| name != own)
    }
}

/// Asks for what a swarm's robot here lacks.
pub(crate) struct CatchUp<'a> {
    pub(crate) session: &'a Session,
    pub(crate) keys: Keys,
    pub(crate) name: &'a str,
    /// Whether clocks are measured here, and not taken from holders.
    pub(crate) on_radio: bool,
    pub(crate) period: Duration,
    pub(crate) node: &'a NodeHandle,
    pub(crate) intake: &'a Intake,
    pub(crate) holders: Holders,
    pub(crate) counters: &'a Counters,
    pub(crate) log: &'a Log,
}

/// What is remembered between two looks.
#[derive(Default)]
struct Memory {
    /// What each holder said last.
    held: BTreeMap<String, Held>,
    /// Since when something of a stream is lacking that somebody holds.
    lacking_since: BTreeMap<Stream, Instant>,
    /// Where a holder brought nothing of a stream: how often, and when to try again.
    fruitless: BTreeMap<(String, Stream), (u32, Instant)>,
    /// The clocks that were set.
    clocks: BTreeMap<RobotId, i64>,
    said_resolution: bool,
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
        self.ask_all(memory)?;
        let mut is_coming = false;
        let mut names: Vec<String> = memory.held.keys().cloned().collect();
        // Who is on the radio has measured clocks.
        names.sort_by_key(|name| memory.held.get(name).is_some_and(|held| !held.on_radio));
        for name in names {
            let Some(held) = memory.held.get(&name).cloned() else { continue };
            let Some(own) = self.node.with_robot(|robot, _| robot.config().mapper.resolution) else { break };
            if held.resolution() != Some(own) {
                if !memory.said_resolution {
                    memory.said_resolution = true;
                    let side = f64::from(held.resolution_um) / 1e6;
                    self.log.warn(format!(
                        "{name} has voxels of {side} m, expected {own:?} as here: nothing is taken from it"
                    ));
                }
                continue;
            }
            for stream in &held.streams {
                let Some(theirs) = parse_intervals(&stream.held) else { continue };
                is_coming |= self.fetch(memory, &name, stream.stream(), &theirs)?;
            }
        }
        Ok(is_coming)
    }

    /// Asks all holders what they hold, and takes their clocks over.
    fn ask_all(&self, memory: &mut Memory) -> Result<(), String> {
        let known: Vec<&str> = memory.held.values().map(|held| held.digest.as_str()).collect();
        let selector = format!("{}?unless={}", self.keys.held_of_all(), known.join(","));
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
            let length = sample.payload().len() + ANSWER_OVERHEAD_BYTES;
            if bytes.fetch_add(length, Ordering::Relaxed) + length <= HELD_BYTES_MAX {
                // Nobody waits any more if this fails.
                let _ = answers.send((clock.now(), sample.clone()));
            }
        })
        .wait()
        .map_err(|error| error.to_string())?;
        // What was told to one under a digest need not be told to another under the same.
        let streams = memory.held.values().map(|held| (held.digest.clone(), held.streams.clone()));
        let known: BTreeMap<String, Vec<HeldStream>> = streams.collect();
        let mut held = BTreeMap::new();
        for (came, sample) in answers_in {
            let Some((_, _, name)) = parse_holder(sample.key_expr().as_str()) else { continue };
            let Ok(mut said) = serde_json::from_slice::<Held>(&sample.payload().to_bytes()) else {
                self.counters.refused.add(1);
                continue;
            };
            if said.streams.is_empty()
                && let Some(streams) = known.get(&said.digest)
            {
                said.streams.clone_from(streams);
            }
            if !self.on_radio {
                self.take_clocks(memory, &said, clock_ahead(asked, came, said.now_us));
            }
            held.insert(name.to_owned(), said);
        }
        memory.held = held;
        Ok(())
    }

    /// The clocks of robots, as somebody knows them whose own clock is so far ahead of the one here.
    fn take_clocks(&self, memory: &mut Memory, held: &Held, ahead: i64) {
        let mut changed = Vec::new();
        for (robot, micros) in held.streams.iter().filter_map(|s| Some((RobotId(s.origin), s.clock_us?))) {
            let micros = micros.saturating_add(ahead);
            let set = memory.clocks.get(&robot).copied();
            if set.is_none_or(|set| set.abs_diff(micros) > CLOCK_CHANGE_MICROS) {
                memory.clocks.insert(robot, micros);
                changed.push((robot, micros));
            }
        }
        if !changed.is_empty() {
            // Where the node has ended there is no clock to set.
            let _ = self.node.with_robot(move |robot, _| {
                changed.into_iter().for_each(|(id, micros)| robot.set_clock_offset(id, Some(micros)));
            });
        }
    }

    /// Asks a holder for what is lacking of a stream, and waits until it is merged. Whether something may be on its way,
    /// so that it was not asked for.
    fn fetch(
        &self,
        memory: &mut Memory,
        name: &str,
        stream: Stream,
        theirs: &IntervalSet,
    ) -> Result<bool, String> {
        let Some(own) = self.received(stream) else { return Ok(false) };
        let lacking = theirs.difference(&own).count();
        if lacking == 0 {
            memory.lacking_since.remove(&stream);
            memory.fruitless.retain(|(_, other), _| *other != stream);
            return Ok(false);
        }
        let now = Instant::now();
        let since = *memory.lacking_since.entry(stream).or_insert(now);
        if !own.is_empty() && now.duration_since(since) < PATIENCE {
            return Ok(true);
        }
        let key = (name.to_owned(), stream);
        if memory.fruitless.get(&key).is_some_and(|(_, again)| *again > now) || self.intake.is_full() {
            return Ok(false);
        }
        // What could not be decoded may be told by a snapshot.
        let form = if memory.fruitless.contains_key(&key) { ";as=snapshot" } else { "" };
        let selector =
            format!("{}?held={}{form}", self.keys.get(name, stream), intervals_text(own.intervals()));
        let intake = self.intake.clone();
        let (done, is_done) = channel::<()>();
        let get = self
            .session
            .get(selector)
            .accept_replies(ReplyKeyExpr::Any)
            .consolidation(ConsolidationMode::None)
            .allowed_destination(Locality::Remote)
            .timeout(GET_TIMEOUT);
        get.callback(move |reply| {
            let _held_until_the_last_reply = &done;
            if let Ok(sample) = reply.result() {
                intake.take(sample, By::Answer);
            }
        })
        .wait()
        .map_err(|error| error.to_string())?;
        // Nothing is ever sent: it ends with the callback.
        let _ = is_done.recv();
        self.intake.wait_merged();
        let Some(after) = self.received(stream) else { return Ok(false) };
        if theirs.difference(&after).count() < lacking {
            memory.fruitless.remove(&key);
        } else {
            let (times, again) = memory.fruitless.entry(key).or_insert((0, now));
            // The first time, at once.
            let pause = if *times == 0 { Duration::ZERO } else { FRUITLESS * (1 << (*times).min(6)) };
            *again = Instant::now() + pause.min(FRUITLESS_MAX);
            *times += 1;
        }
        Ok(false)
    }

    /// What is held here of a stream; `None` if the node has ended.
    fn received(&self, stream: Stream) -> Option<IntervalSet> {
        self.node.with_robot(move |robot, _| {
            let none = || IntervalSet::new(RECEIVED_INTERVALS_MAX);
            robot.session().received(stream).cloned().unwrap_or_else(none)
        })
    }
}

/// How far a clock is ahead of the own one that showed a time between these two.
fn clock_ahead(asked: Stamp, came: Stamp, shown_us: i64) -> i64 {
    shown_us.saturating_sub(asked.0 / 2 + came.0 / 2)
}
