//! What others ask for: what is held, and the packages or the snapshot that they lack. Whoever comes late gets the map, and
//! not its history.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::Receiver;

use flockmap::codec::Encoder;
use flockmap::sync::{IntervalSet, RECEIVED_INTERVALS_MAX};
use flockmap::{Package, Robot, Stream};
use flockmap_node::NodeHandle;
use flockmap_node::store::{Coded, StreamCopy};
use zenoh::Wait;
use zenoh::key_expr::KeyExpr;
use zenoh::query::{Query, ReplyKeyExpr};

use crate::counters::Counters;
use crate::held::{Held, intervals_text, parse_intervals};
use crate::keys::{Item, Keys, parse_get};
use crate::puts::item_of;

/// Queries that may wait for their answer; of more, those that come are refused.
pub(crate) const WAITING_MAX: usize = 64;
/// Up to so many bytes packages are sent as they are, without a look at what a snapshot would take.
const PACKAGES_BYTES: usize = 64 << 10;
/// Bytes of snapshots that are kept for whoever else asks.
const KEPT_BYTES_MAX: usize = 64 << 20;
/// A kept snapshot is as good as a new one as long as what came since has not more than this part of its bytes.
const SINCE_SHARE: usize = 16;

/// Answers queries about a swarm, one after the other.
pub(crate) struct Answers<'a> {
    pub(crate) keys: Keys,
    pub(crate) name: &'a str,
    pub(crate) on_radio: bool,
    pub(crate) node: &'a NodeHandle,
    pub(crate) counters: &'a Counters,
    pub(crate) encoder: Encoder,
    pub(crate) kept: Kept,
}

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
    /// Answers until the node has ended, or nobody can ask any more.
    pub(crate) fn answer_all(mut self, queries: &Receiver<Query>) {
        for query in queries {
            let result = self.answer(&query);
            self.counters.answered.add(u64::from(result.is_ok()));
            if let Err(why) = result {
                self.counters.queries_refused.add(1);
                // Who asked may be gone.
                let _ = query.reply_err(why).wait();
            }
        }
    }

    fn answer(&mut self, query: &Query) -> Result<(), String> {
        let held = query.parameters().get("held").unwrap_or_default();
        let held =
            parse_intervals(held).ok_or("held is no list of intervals, expected one as 1-120,130-200")?;
        let as_snapshot = match query.parameters().get("as") {
            None => false,
            Some("snapshot") => true,
            Some(other) => return Err(format!("as={other}, expected as=snapshot, or none")),
        };
        let wish = Wish { held: &held, as_snapshot };
        let key = query.key_expr();
        // A question for several holders: what they hold.
        let holder = self.keys.holder(self.name);
        let held_key = format!("{holder}/held");
        if key.as_str().contains('@') && intersects(key, &held_key) {
            return self.say_held(query, held_key);
        }
        if let Some(rest) = key.as_str().strip_prefix(&holder).and_then(|rest| rest.strip_prefix('/')) {
            let stream = parse_get(rest).ok_or("expected held, or get/ROBOT-RUN, behind the name")?;
            return self.say_stream(query, stream, &wish);
        }
        let streams = self.node.with_robot(|robot, _| robot.session().streams().collect::<Vec<Stream>>());
        for stream in streams.ok_or("the node has ended")? {
            if intersects(key, &format!("{}/**", self.keys.stream(stream))) {
                self.say_stream(query, stream, &wish)?;
            }
        }
        Ok(())
    }

    fn say_held(&self, query: &Query, key: String) -> Result<(), String> {
        let on_radio = self.on_radio;
        let held = self.node.with_robot(move |robot, now| Held::of(robot, now, on_radio));
        let held = held.ok_or("the node has ended")?;
        let held = held.unless_known(query.parameters().get("unless").unwrap_or_default());
        let text = serde_json::to_string(&held).map_err(|error| error.to_string())?;
        self.counters.answered_bytes.add(text.len() as u64);
        query.reply(key, text).wait().map_err(|error| error.to_string())
    }

    /// What somebody lacks of a stream who holds these packages: the packages, or a snapshot and what is newer, whichever
    /// has fewer bytes.
    fn say_stream(&mut self, query: &Query, stream: Stream, wish: &Wish<'_>) -> Result<(), String> {
        let Wish { held, as_snapshot } = *wish;
        let kept = self.kept.get(stream).filter(|_| held.is_empty());
        let (held_there, kept_there) = (held.clone(), kept.as_ref().map(|kept| (kept.upto, kept.bytes)));
        let found = self
            .node
            .with_robot(move |robot, _| Found::of(robot, stream, &held_there, as_snapshot, kept_there));
        match found.ok_or("the node has ended")? {
            Found::Packages(packages) => self.say_packages(query, &packages),
            Found::Newer(newer) => {
                if let Some(Snapshot { coded, .. }) = &kept {
                    self.say(query, coded)?;
                }
                self.say_packages(query, &newer)
            }
            Found::Layer { copy, packages, prefix } => {
                self.counters.snapshots.add(1);
                let coded = copy.code(&mut self.encoder)?;
                let bytes = bytes_of(&coded.packages);
                if let Some(packages) =
                    packages.filter(|packages| !as_snapshot && bytes_of(packages) <= bytes)
                {
                    return self.say_packages(query, &packages);
                }
                self.say(query, &coded)?;
                if held.is_empty() && coded.contents.is_none() {
                    self.kept.keep(stream, Snapshot { upto: prefix, bytes, coded: Arc::new(coded) });
                }
                Ok(())
            }
            Found::Nothing => Err("what is lacking is not there as it came, nor is a layer".into()),
        }
    }

    fn say_packages(&self, query: &Query, packages: &[Package]) -> Result<(), String> {
        packages
            .iter()
            .try_for_each(|package| self.say_item(query, Item::of(package), package.bytes().to_vec()))
    }

    fn say(&self, query: &Query, coded: &Coded) -> Result<(), String> {
        self.say_packages(query, &coded.packages)?;
        let Some(contents) = &coded.contents else { return Ok(()) };
        self.say_item(query, item_of(contents), intervals_text(&contents.intervals).into_bytes())
    }

    /// Replies with this, if the query asks for it.
    fn say_item(&self, query: &Query, item: Item, bytes: Vec<u8>) -> Result<(), String> {
        let key = self.keys.item(item);
        if query.accepts_replies() != ReplyKeyExpr::Any && !intersects(query.key_expr(), &key) {
            return Ok(());
        }
        self.counters.answered_bytes.add(bytes.len() as u64);
        query.reply(key, bytes).wait().map_err(|error| error.to_string())
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
