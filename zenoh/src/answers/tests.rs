use std::cell::RefCell;
use std::sync::Mutex;
use std::sync::atomic::Ordering;

use flockmap::{
    Event, Resolution, RobotConfig, RobotId, Stamp, State, States, StatesUpdate, Voxel, VoxelBox,
};
use flockmap_node::{NoRadio, Node, NodeOptions};

use super::*;

const KEYS: Keys = Keys { swarm: 7 };

/// Somebody who asks, and what he was told.
struct Asker {
    key: KeyExpr<'static>,
    parameters: Vec<(String, String)>,
    takes_any_key: bool,
    /// He cannot be told what lies under keys that begin so.
    deaf_to: Option<String>,
    replies: RefCell<Vec<(String, Vec<u8>)>>,
    refusals: RefCell<Vec<String>>,
}

impl Asker {
    fn new(key: &str, parameters: &[(&str, &str)]) -> Self {
        let parameters = parameters.iter().map(|(name, value)| ((*name).into(), (*value).into()));
        Self {
            key: KeyExpr::new(key.to_owned()).unwrap(),
            parameters: parameters.collect(),
            takes_any_key: key.contains('@'),
            deaf_to: None,
            replies: RefCell::default(),
            refusals: RefCell::default(),
        }
    }

    /// What he got, and how many bytes that is.
    fn items(&self) -> (Vec<Item>, usize) {
        let replies = self.replies.borrow();
        let items = replies.iter().map(|(key, _)| Item::parse(key).expect("the key of an item").1);
        (items.collect(), replies.iter().map(|(_, value)| value.len()).sum())
    }

    /// The packages that he got; nothing else came.
    fn packages(&self) -> Vec<u32> {
        let index = |item| match item {
            Item::Package { index, .. } => index,
            other => panic!("{other:?}"),
        };
        self.items().0.into_iter().map(index).collect()
    }
}

impl Question for Asker {
    fn key(&self) -> &KeyExpr<'_> {
        &self.key
    }

    fn parameter(&self, name: &str) -> Option<&str> {
        self.parameters.iter().find(|(of, _)| of == name).map(|(_, value)| value.as_str())
    }

    fn takes_any_key(&self) -> bool {
        self.takes_any_key
    }

    fn reply(&self, key: &str, value: Vec<u8>) -> Result<(), String> {
        if self.deaf_to.as_ref().is_some_and(|deaf_to| key.starts_with(deaf_to)) {
            return Err("not this one".into());
        }
        self.replies.borrow_mut().push((key.to_owned(), value));
        Ok(())
    }

    fn refuse(&self, why: &str) {
        self.refusals.borrow_mut().push(why.to_owned());
    }
}

/// A node that holds packages.
struct Holder {
    node: NodeHandle,
    counters: Counters,
    log: Log,
    logged: Arc<Mutex<Vec<String>>>,
}

impl Holder {
    fn of(packages: &[Package]) -> Self {
        let node = Node::start(NodeOptions::new(config(9)), || Ok(NoRadio)).unwrap();
        let logged = Arc::<Mutex<Vec<String>>>::default();
        let lines = Arc::clone(&logged);
        let log = Log::new(move |_, text| lines.lock().unwrap().push(text.to_owned()));
        let holder = Self { node, counters: Counters::default(), log, logged };
        holder.take(packages);
        holder
    }

    fn take(&self, packages: &[Package]) {
        let packages = packages.to_vec();
        let has_all = self.node.with_robot(move |robot, now| {
            for package in packages {
                robot.receive_package(now, package).unwrap();
                for _ in 0..1_000 {
                    if robot.session().has_events() {
                        robot.handle_timeout(now);
                    }
                }
            }
            !robot.session().has_events()
        });
        assert_eq!(has_all, Some(true));
    }

    fn answers(&self) -> Answers<'_> {
        Answers {
            keys: KEYS,
            name: "me",
            on_radio: false,
            node: &self.node,
            counters: &self.counters,
            encoder: Encoder::new(),
            kept: Kept::default(),
            untold: Untold::default(),
            log: &self.log,
        }
    }

    fn count(&self, name: &str) -> u64 {
        let counters = self.counters.for_node();
        counters.iter().find(|(of, _)| *of == name).map(|(_, count)| count.load(Ordering::Relaxed)).unwrap()
    }
}

fn config(id: u16) -> RobotConfig {
    RobotConfig::new(RobotId(id), Resolution::from_metres(0.1).unwrap(), 7.0)
}

fn run(id: u16) -> Stream {
    Stream { origin: RobotId(id), epoch: 1 }
}

/// The packages of a robot that has looked so often at a place where things move, each time so many voxels further on.
fn flown(id: u16, looks: i64, further: i32) -> Vec<Package> {
    let mut robot = Robot::new(config(id), Stamp(0)).unwrap();
    let resolution = robot.config().mapper.resolution;
    let (mut random, mut made) = (u64::from(id) + 1, Vec::new());
    for look in 1..=looks {
        let now = Stamp(look * 500_000);
        let region = VoxelBox::new(Voxel::new(further * look as i32, 0, 0), [24, 24, 8]).unwrap();
        let state = |_| {
            random ^= random << 13;
            random ^= random >> 7;
            random ^= random << 17;
            if random.is_multiple_of(4) { State::Occupied } else { State::Free }
        };
        let states: Vec<State> = (0..24 * 24 * 8).map(state).collect();
        let states = States::Box { region, states: &states, clear_unknown: false };
        robot.insert_states(now, &StatesUpdate { stamp: now, resolution, sensor: None, states }).unwrap();
        let end = now.plus_micros(499_999);
        robot.handle_timeout(end);
        while robot.poll_transmit(end).is_some() {}
        while let Some(event) = robot.poll_event() {
            if let Event::BatchClosed { packages, .. } = event {
                made.extend(packages);
            }
        }
    }
    made
}

fn get(id: u16) -> String {
    KEYS.get("me", run(id))
}

#[test]
fn what_is_short_comes_as_it_was_made_and_only_what_is_lacking() {
    let packages = flown(1, 6, 24);
    let holder = Holder::of(&packages);
    let (mut answers, last) = (holder.answers(), packages.len() as u32);
    assert!(last >= 6 && bytes_of(&packages) < PACKAGES_BYTES);
    for (held, expected) in [
        (String::new(), (1..=last).collect::<Vec<_>>()),
        ("1-4".into(), (5..=last).collect()),
        (format!("2,4-{last}"), vec![1, 3]),
        (format!("1-{last}"), vec![]),
        // He holds more than there is.
        ("1-4294967295".into(), vec![]),
    ] {
        let asker = Asker::new(&get(1), &[("held", &held)]);
        answers.answer(&asker).unwrap();
        assert_eq!(asker.packages(), expected, "held={held}");
        for (key, value) in asker.replies.borrow().iter() {
            assert!(packages.iter().any(|p| KEYS.item(Item::of(p)) == *key && p.bytes()[..] == value[..]));
        }
    }
    assert_eq!(holder.count("zenoh_snapshots"), 0);
}

#[test]
fn of_a_run_that_is_not_here_nothing_is_told_and_that_is_no_error() {
    let holder = Holder::of(&flown(1, 2, 24));
    for parameters in [&[][..], &[("held", "1-5")], &[("as", "snapshot")]] {
        let asker = Asker::new(&get(2), parameters);
        assert_eq!(holder.answers().answer(&asker), Ok(()));
        assert!(asker.packages().is_empty());
    }
}

#[test]
fn to_whom_packages_are_of_no_use_a_snapshot_is_told() {
    let holder = Holder::of(&flown(1, 3, 24));
    let asker = Asker::new(&get(1), &[("as", "snapshot")]);
    holder.answers().answer(&asker).unwrap();
    let (items, _) = asker.items();
    assert!(!items.is_empty() && items.iter().all(|item| matches!(item, Item::Chunk { .. })), "{items:?}");
}

#[test]
fn a_long_history_of_a_small_place_comes_as_a_snapshot_which_is_kept_for_the_next_one() {
    let packages = flown(1, 200, 0);
    assert!(bytes_of(&packages) > PACKAGES_BYTES);
    let (first, later) = packages.split_at(packages.len() - 1);
    let holder = Holder::of(first);
    let mut answers = holder.answers();
    let asker = Asker::new(&get(1), &[]);
    answers.answer(&asker).unwrap();
    let (chunks, bytes) = asker.items();
    assert!(chunks.iter().all(|item| matches!(item, Item::Chunk { .. })), "{chunks:?}");
    assert!(bytes < bytes_of(first));
    let next = Asker::new(&get(1), &[]);
    answers.answer(&next).unwrap();
    assert_eq!((next.items().0, holder.count("zenoh_snapshots")), (chunks, 1));
    // Something came since, which is too much to be told beside it.
    holder.take(later);
    assert!(bytes_of(later) > bytes / SINCE_SHARE);
    answers.answer(&Asker::new(&get(1), &[])).unwrap();
    assert_eq!(holder.count("zenoh_snapshots"), 2);
}

#[test]
fn with_a_kept_snapshot_comes_what_is_newer() {
    let packages = flown(1, 200, 3);
    let (first, later) = packages.split_at(packages.len() - 1);
    let holder = Holder::of(first);
    let mut answers = holder.answers();
    let asker = Asker::new(&get(1), &[("as", "snapshot")]);
    answers.answer(&asker).unwrap();
    let (mut expected, bytes) = asker.items();
    holder.take(later);
    assert!(bytes_of(later) <= bytes / SINCE_SHARE);
    let next = Asker::new(&get(1), &[("as", "snapshot")]);
    answers.answer(&next).unwrap();
    expected.extend(later.iter().map(Item::of));
    assert_eq!((next.items().0, holder.count("zenoh_snapshots")), (expected, 1));
}

#[test]
fn whichever_has_fewer_bytes_is_told() {
    for further in [0, 24] {
        let packages = flown(1, 200, further);
        let holder = Holder::of(&packages);
        let [any, snapshot] = [&[][..], &[("as", "snapshot")]].map(|parameters| {
            let asker = Asker::new(&get(1), parameters);
            holder.answers().answer(&asker).unwrap();
            asker.items()
        });
        assert_eq!(any.1, snapshot.1.min(bytes_of(&packages)), "{further}");
        let is_snapshot = any.0.iter().all(|item| matches!(item, Item::Chunk { .. }));
        assert_eq!(is_snapshot, snapshot.1 < bytes_of(&packages), "{further}");
    }
}

#[test]
fn a_run_that_cannot_be_told_does_not_hide_those_after_it() {
    let robots = [1, 2, 3].map(|id| flown(id, 3, 24));
    let holder = Holder::of(&robots.concat());
    let mut answers = holder.answers();
    for times in 1..=2 {
        let mut asker = Asker::new(&KEYS.all(), &[]);
        asker.deaf_to = Some(KEYS.stream(run(2)));
        answers.answer(&asker).unwrap();
        let expected: Vec<Item> = [&robots[0], &robots[2]].into_iter().flatten().map(Item::of).collect();
        assert_eq!(asker.items().0, expected);
        // Who asked hears that something is lacking; the log hears of it once.
        assert_eq!(asker.refusals.borrow().len(), 1);
        assert_eq!((holder.count("zenoh_untold"), holder.logged.lock().unwrap().len()), (times, 1));
    }
    let asker = Asker::new(&KEYS.all(), &[]);
    answers.answer(&asker).unwrap();
    assert_eq!(asker.packages().len(), robots.concat().len());
    assert!(answers.untold.0.is_empty());
}

#[test]
fn who_asks_for_one_run_or_one_package_is_told_that() {
    let robots = [1, 2].map(|id| flown(id, 3, 24));
    let holder = Holder::of(&robots.concat());
    let stream = KEYS.stream(run(2));
    for (key, expected) in [(format!("{stream}/**"), robots[1].len()), (format!("{stream}/2"), 1)] {
        let asker = Asker::new(&key, &[]);
        holder.answers().answer(&asker).unwrap();
        assert_eq!(asker.packages().len(), expected, "{key}");
        assert!(asker.replies.borrow().iter().all(|(key, _)| key.starts_with(&stream)));
    }
}

#[test]
fn what_is_held_is_told_unless_it_is_known() {
    let holder = Holder::of(&flown(1, 3, 24));
    let say = |unless: &str| {
        let asker = Asker::new(&KEYS.held_of_all(), &[("unless", unless)]);
        holder.answers().answer(&asker).unwrap();
        let replies = asker.replies.take();
        assert_eq!(replies[0].0, format!("{}/held", KEYS.holder("me")));
        serde_json::from_slice::<Held>(&replies[0].1).unwrap()
    };
    let all = say("");
    assert_eq!(all.streams.iter().map(|run| run.stream()).collect::<Vec<_>>(), [run(1)]);
    assert!(all.has_true_digest());
    let short = say(&format!("1,{}", all.digest));
    assert_eq!((short.digest, short.streams), (all.digest, vec![]));
}

#[test]
fn what_is_no_question_is_refused_and_the_next_one_is_answered() {
    let holder = Holder::of(&flown(1, 2, 24));
    for (key, parameters) in [
        (get(1), &[("held", "5-4")]),
        (get(1), &[("as", "picture")]),
        (format!("{}/get/1", KEYS.holder("me")), &[("held", "")]),
        (format!("{}/give/1-1", KEYS.holder("me")), &[("held", "")]),
    ] {
        let asker = Asker::new(&key, parameters);
        assert!(holder.answers().answer(&asker).is_err(), "{key} {parameters:?}");
        assert!(asker.replies.borrow().is_empty());
    }
    let keys_of_packages = Asker { takes_any_key: false, ..Asker::new(&get(1), &[]) };
    assert!(holder.answers().answer(&keys_of_packages).unwrap_err().contains("any key"));
    let (askers, askers_in) = std::sync::mpsc::channel();
    for held in ["x", ""] {
        askers.send(Asker::new(&get(1), &[("held", held)])).unwrap();
    }
    drop(askers);
    holder.answers().answer_all(&askers_in);
    assert_eq!((holder.count("zenoh_queries_refused"), holder.count("zenoh_answered")), (1, 1));
}

#[test]
fn snapshots_that_are_kept_are_bounded_and_those_used_last_stay() {
    let mut kept = Kept::default();
    let half = |upto| Snapshot { upto, bytes: KEPT_BYTES_MAX / 2, coded: Arc::default() };
    kept.keep(run(1), half(5));
    kept.keep(run(2), half(6));
    assert!(kept.get(run(1)).is_some());
    kept.keep(run(3), half(7));
    assert!(kept.get(run(1)).is_some() && kept.get(run(2)).is_none() && kept.get(run(3)).is_some());
    // A newer one takes the place of an older one.
    kept.keep(run(3), half(8));
    assert!(kept.get(run(1)).is_some_and(|snapshot| snapshot.upto == 5));
    assert_eq!(kept.bytes, KEPT_BYTES_MAX);
}
