//! What others ask for: what is held, and the packages or the snapshot that they lack. Whoever comes late gets the map,
//! and not its history.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::mpsc::Receiver;

use flockmap::codec::Encoder;
use flockmap::sync::{IntervalSet, RECEIVED_INTERVALS_MAX};
use flockmap::{Package, Robot, Stream};
use flockmap_node::store::{Coded, StreamCopy};
use flockmap_node::{Log, NodeHandle};
use zenoh::key_expr::KeyExpr;

use crate::counters::Counters;
use crate::held::{Held, intervals_text, parse_intervals};
use crate::keys::{Item, Keys, parse_get};
use crate::puts::item_of;
use crate::question::Question;

/// Queries that may wait for their answer; of more, those that come are refused.
pub(crate) const WAITING_MAX: usize = 64;
/// Up to so many bytes packages are sent as they are, without a look at what a snapshot would take.
const PACKAGES_BYTES: usize = 64 << 10;
/// Bytes of snapshots that are kept for whoever else asks.
const KEPT_BYTES_MAX: usize = 64 << 20;
/// A kept snapshot is as good as a new one as long as what came since has not more than this part of its bytes.
const SINCE_SHARE: usize = 16;

const ENDED: &str = "the node has ended";

/// Answers queries about a swarm, one after the other.
pub(crate) struct Answers<'a> {
    pub(crate) keys: Keys,
    pub(crate) name: &'a str,
    pub(crate) on_radio: bool,
    pub(crate) node: &'a NodeHandle,
    pub(crate) counters: &'a Counters,
    pub(crate) encoder: Encoder,
    pub(crate) kept: Kept,
    pub(crate) untold: Untold,
    pub(crate) log: &'a Log,
}

/// Runs that could not be told when all were asked for: each is logged once, until it can be told again.
#[derive(Debug, Default)]
pub(crate) struct Untold(BTreeSet<Stream>);

/// What somebody wants of a stream.
struct Wish<'a> {
    /// He holds these packages.
    held: &'a IntervalSet,
    /// The packages themselves are of no use to him.
    as_snapshot: bool,
}

/// What a robot has for somebody.
enum Found {
    /// What he lacks, as it came.
    Packages(Vec<Package>),
    /// What came after the snapshot that is kept.
    Newer(Vec<Package>),
    /// Of this a snapshot is to be made. Beside it what he lacks, if it is all there as it came; and the newest package
    /// that is held with all before it.
    Layer { copy: StreamCopy, packages: Option<Vec<Package>>, prefix: u32 },
    /// It cannot be told.
    Nothing,
}

impl Answers<'_> {
    /// Answers as long as anybody can ask.
    pub(crate) fn answer_all(mut self, questions: &Receiver<impl Question>) {
        for question in questions {
            let result = self.answer(&question);
            self.counters.answered.add(u64::from(result.is_ok()));
            if let Err(why) = result {
                self.counters.queries_refused.add(1);
                question.refuse(&why);
            }
        }
    }

    fn answer(&mut self, question: &impl Question) -> Result<(), String> {
        let held = question.parameter("held").unwrap_or_default();
        let held =
            parse_intervals(held).ok_or("held is no list of intervals, expected one as 1-120,130-200")?;
        let as_snapshot = match question.parameter("as") {
            None => false,
            Some("snapshot") => true,
            Some(other) => return Err(format!("as={other}, expected as=snapshot, or none")),
        };
        let wish = Wish { held: &held, as_snapshot };
        let key = question.key();
        // A question for several holders: what they hold.
        let holder = self.keys.holder(self.name);
        let held_key = format!("{holder}/held");
        if key.as_str().contains('@') && intersects(key, &held_key) {
            return self.say_held(question, &held_key);
        }
        if let Some(rest) = key.as_str().strip_prefix(&holder).and_then(|rest| rest.strip_prefix('/')) {
            let stream = parse_get(rest).ok_or("expected held, or get/ROBOT-RUN, behind the name")?;
            if !question.takes_any_key() {
                return Err(
                    "replies have the keys of packages, expected a query that accepts replies with any key"
                        .into(),
                );
            }
            return self.say_stream(question, stream, &wish);
        }
        self.say_streams(question, &wish)
    }

    /// All streams that are asked for. One that cannot be told does not keep the others from being told; whoever asked
    /// hears of it.
    fn say_streams(&mut self, question: &impl Question, wish: &Wish<'_>) -> Result<(), String> {
        let streams =
            self.node.with_robot(|robot, _| robot.session().streams().collect::<BTreeSet<Stream>>());
        let streams = streams.ok_or(ENDED)?;
        self.untold.0.retain(|stream| streams.contains(stream));
        for stream in streams {
            if !intersects(question.key(), &format!("{}/**", self.keys.stream(stream))) {
                continue;
            }
            let Err(why) = self.say_stream(question, stream, wish) else {
                self.untold.0.remove(&stream);
                continue;
            };
            if self.node.has_ended() {
                return Err(why);
            }
            let why = format!("{stream:?} cannot be told: {why}");
            self.counters.untold.add(1);
            if self.untold.0.insert(stream) {
                self.log.warn(&why);
            }
            question.refuse(&why);
        }
        Ok(())
    }

    fn say_held(&self, question: &impl Question, key: &str) -> Result<(), String> {
        let on_radio = self.on_radio;
        let held = self.node.with_robot(move |robot, now| Held::of(robot, now, on_radio));
        let held = held.ok_or(ENDED)?;
        let held = held.unless_known(question.parameter("unless").unwrap_or_default());
        let text = serde_json::to_string(&held).map_err(|error| error.to_string())?;
        self.counters.answered_bytes.add(text.len() as u64);
        question.reply(key, text.into_bytes())
    }

    /// What somebody lacks of a stream who holds these packages: the packages, or a snapshot and what is newer,
    /// whichever has fewer bytes.
    fn say_stream(
        &mut self,
        question: &impl Question,
        stream: Stream,
        wish: &Wish<'_>,
    ) -> Result<(), String> {
        let Wish { held, as_snapshot } = *wish;
        let kept = self.kept.get(stream).filter(|_| held.is_empty());
        let (held_there, kept_there) = (held.clone(), kept.as_ref().map(|kept| (kept.upto, kept.bytes)));
        let found = self
            .node
            .with_robot(move |robot, _| Found::of(robot, stream, &held_there, as_snapshot, kept_there));
        match found.ok_or(ENDED)? {
            Found::Packages(packages) => self.say_packages(question, &packages),
            Found::Newer(newer) => {
                if let Some(Snapshot { coded, .. }) = &kept {
                    self.say(question, coded)?;
                }
                self.say_packages(question, &newer)
            }
            Found::Layer { copy, packages, prefix } => {
                self.counters.snapshots.add(1);
                let coded = copy.code(&mut self.encoder)?;
                let bytes = bytes_of(&coded.packages);
                if let Some(packages) =
                    packages.filter(|packages| !as_snapshot && bytes_of(packages) <= bytes)
                {
                    return self.say_packages(question, &packages);
                }
                self.say(question, &coded)?;
                if held.is_empty() && coded.contents.is_none() {
                    self.kept.keep(stream, Snapshot { upto: prefix, bytes, coded: Arc::new(coded) });
                }
                Ok(())
            }
            Found::Nothing => Err("what is lacking is not there as it came, nor is a layer".into()),
        }
    }

    fn say_packages(&self, question: &impl Question, packages: &[Package]) -> Result<(), String> {
        packages
            .iter()
            .try_for_each(|package| self.say_item(question, Item::of(package), package.bytes().to_vec()))
    }

    fn say(&self, question: &impl Question, coded: &Coded) -> Result<(), String> {
        self.say_packages(question, &coded.packages)?;
        let Some(contents) = &coded.contents else { return Ok(()) };
        self.say_item(question, item_of(contents), intervals_text(&contents.intervals).into_bytes())
    }

    /// Replies with this, if that is asked for.
    fn say_item(&self, question: &impl Question, item: Item, bytes: Vec<u8>) -> Result<(), String> {
        let key = self.keys.item(item);
        if !question.takes_any_key() && !intersects(question.key(), &key) {
            return Ok(());
        }
        self.counters.answered_bytes.add(bytes.len() as u64);
        question.reply(&key, bytes)
    }
}

impl Found {
    /// `kept`: a snapshot of packages up to one is there already, with so many bytes.
    fn of(
        robot: &Robot,
        stream: Stream,
        held: &IntervalSet,
        as_snapshot: bool,
        kept: Option<(u32, usize)>,
    ) -> Self {
        let (session, none) = (robot.session(), IntervalSet::new(RECEIVED_INTERVALS_MAX));
        let received = session.received(stream).unwrap_or(&none);
        // All of these, if they are all there as they came.
        let stored = |wanted: &IntervalSet| {
            let intervals = wanted.intervals().iter();
            let stored = intervals.flat_map(|&(low, high)| session.store().range(stream, low, high));
            let packages: Vec<Package> = stored.map(|(_, stored)| stored.package.clone()).collect();
            (packages.len() as u64 == wanted.count()).then_some(packages)
        };
        let packages = stored(&received.difference(held));
        let is_short = |packages: &&Vec<Package>| !as_snapshot && bytes_of(packages) <= PACKAGES_BYTES;
        if let Some(packages) = packages.as_ref().filter(is_short) {
            return Self::Packages(packages.clone());
        }
        if let Some((upto, bytes)) = kept
            && let Some(newer) = stored(&received.within(upto.saturating_add(1), u32::MAX))
            && bytes_of(&newer) <= bytes / SINCE_SHARE
        {
            return Self::Newer(newer);
        }
        match (StreamCopy::of(robot, stream, held.prefix()), packages) {
            (Some(copy), packages) => Self::Layer { copy, packages, prefix: received.prefix() },
            (None, Some(packages)) => Self::Packages(packages),
            (None, None) => Self::Nothing,
        }
    }
}

/// Snapshots that were made for somebody, for whoever else asks: 64 MiB. Those used last stay.
#[derive(Default)]
pub(crate) struct Kept {
    snapshots: BTreeMap<Stream, (u64, Snapshot)>,
    bytes: usize,
    uses: u64,
}

/// A snapshot of packages 1 to `upto`.
#[derive(Clone)]
struct Snapshot {
    upto: u32,
    bytes: usize,
    coded: Arc<Coded>,
}

impl Kept {
    fn get(&mut self, stream: Stream) -> Option<Snapshot> {
        self.uses += 1;
        let (used, snapshot) = self.snapshots.get_mut(&stream)?;
        *used = self.uses;
        Some(snapshot.clone())
    }

    fn keep(&mut self, stream: Stream, snapshot: Snapshot) {
        self.uses += 1;
        self.bytes += snapshot.bytes;
        if let Some((_, before)) = self.snapshots.insert(stream, (self.uses, snapshot)) {
            self.bytes -= before.bytes;
        }
        while self.bytes > KEPT_BYTES_MAX
            && let Some((&oldest, _)) = self.snapshots.iter().min_by_key(|(_, (used, _))| *used)
            && let Some((_, gone)) = self.snapshots.remove(&oldest)
        {
            self.bytes -= gone.bytes;
        }
    }
}

fn bytes_of(packages: &[Package]) -> usize {
    packages.iter().map(|package| package.bytes().len()).sum()
}

fn intersects(key: &KeyExpr<'_>, other: &str) -> bool {
    KeyExpr::new(other).is_ok_and(|other| key.intersects(&other))
}

#[cfg(test)]
mod tests;
