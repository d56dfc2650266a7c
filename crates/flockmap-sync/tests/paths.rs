//! An address is used only after a round trip through it.

use flockmap_codec::{Batch, Codec, Encoder, Package};
use flockmap_grid::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
use flockmap_sync::wire::{Datagram, Kind, PathMessage};
use flockmap_sync::{Cast, Destination, Path, Session, SessionConfig, Transmit};

fn session(id: u16, config: &SessionConfig) -> Session {
    let own = Stream { origin: RobotId(id), epoch: 7 };
    Session::new(own, SessionConfig { salt: [id as u8; 16], ..config.clone() }, id.into()).unwrap()
}

fn package(stream: Stream, index: u32) -> Package {
    let resolution = Resolution::from_metres(0.1).unwrap();
    let end = Stamp(i64::from(index));
    let batch = Batch { stream, start: end, end, resolution, sensor: [0; 3] };
    let changes = Changes::from_voxels([(Voxel::new(1, 2, index as i32), State::Free)]);
    Encoder::new().encode_whole(Codec::Raw, &batch, index, &changes).unwrap()
}

/// Robots 1 and 2, each at the address of its number; what a robot sends and where to.
struct Pair {
    one: Session,
    two: Session,
    now: Stamp,
    /// Robot 2 knows the address of robot 1, and not the reverse.
    only_two_is_sent: bool,
    /// Everything that robot 1 sent.
    sent: Vec<Transmit>,
}

impl Pair {
    fn new(config: &SessionConfig) -> Self {
        let (one, two) = (session(1, config), session(2, config));
        Self { one, two, now: Stamp(0), only_two_is_sent: false, sent: Vec::new() }
    }

    fn run(&mut self, seconds: f64, from: [Path; 2]) {
        let end = self.now.plus_micros((seconds * 1e6) as i64);
        while self.now < end {
            self.now = self.now.plus_micros(10_000);
            let now = self.now;
            for session in [&mut self.one, &mut self.two] {
                session.handle_timeout(now);
                while session.poll_event().is_some() {}
            }
            while let Some(transmit) = self.one.poll_transmit(now) {
                let is_known = self.one.paths().any(|(_, path)| path == from[1]);
                let is_everyone = transmit.to == Destination::Everyone;
                let is_there = match transmit.path {
                    Some(path) => path == from[1],
                    None => is_everyone && (!self.only_two_is_sent || is_known),
                };
                if is_there {
                    let _ = self.two.handle_datagram_from(now, from[0], &transmit.bytes);
                }
                self.sent.push(transmit);
            }
            while let Some(transmit) = self.two.poll_transmit(now) {
                if transmit.path.is_none_or(|path| path == from[0]) {
                    let _ = self.one.handle_datagram_from(now, from[1], &transmit.bytes);
                }
            }
        }
    }

    fn is_in_sync(&self) -> bool {
        let own = self.one.own();
        let newest = self.one.store().newest_known(own);
        newest > 0 && self.two.store().newest_known(own) == newest
    }
}

const ONE: Path = Path(1);
const TWO: Path = Path(2);
const ELSEWHERE: Path = Path(99);

fn kind(transmit: &Transmit) -> Kind {
    Datagram::new_checked(&transmit.bytes).unwrap().header().kind
}

#[test]
fn two_of_whom_one_is_told_where_the_other_is_find_each_other() {
    let mut pair = Pair::new(&SessionConfig::default());
    pair.only_two_is_sent = true;
    let own = pair.one.own();
    pair.one.publish(Stamp(0), package(own, 1)).unwrap();
    pair.run(3.0, [ONE, TWO]);
    assert!(pair.is_in_sync());
    assert_eq!(pair.one.paths().collect::<Vec<_>>(), [(RobotId(2), TWO)]);
    assert_eq!(pair.one.counters().paths_validated, 1);
    // A challenge and an answer, and then it is known.
    assert!(pair.one.counters().paths_out.datagrams <= 4, "{:?}", pair.one.counters().paths_out);
    assert_eq!(pair.sent.iter().filter(|sent| kind(sent) == Kind::Packages).count(), 1);
}

#[test]
fn whoever_copies_a_robots_datagrams_draws_nothing_but_challenges() {
    let mut pair = Pair::new(&SessionConfig::default());
    pair.run(3.0, [ONE, TWO]);
    let own = pair.one.own();
    for index in 1..=20 {
        pair.one.publish(pair.now, package(own, index)).unwrap();
        // A copy of each datagram of robot 2 comes first, from elsewhere.
        pair.now = pair.now.plus_micros(100_000);
        while let Some(transmit) = pair.two.poll_transmit(pair.now) {
            pair.one.handle_datagram_from(pair.now, ELSEWHERE, &transmit.bytes).unwrap();
            // What goes out between the two is lost.
            pair.sent.extend(sent(&mut pair.one, pair.now));
            let _ = pair.one.handle_datagram_from(pair.now, TWO, &transmit.bytes);
        }
        pair.run(0.5, [ONE, TWO]);
    }
    pair.run(3.0, [ONE, TWO]);
    assert!(pair.is_in_sync());
    let elsewhere: Vec<&Transmit> = pair.sent.iter().filter(|sent| sent.path == Some(ELSEWHERE)).collect();
    assert!(!elsewhere.is_empty() && elsewhere.iter().all(|sent| kind(sent) == Kind::Path));
    assert!(pair.one.paths().all(|(_, path)| path == TWO));
}

#[test]
fn a_robot_that_moved_to_another_address_is_followed() {
    let mut pair = Pair::new(&SessionConfig::default());
    let own = pair.one.own();
    pair.one.publish(Stamp(0), package(own, 1)).unwrap();
    pair.run(3.0, [ONE, TWO]);
    pair.one.publish(pair.now, package(own, 2)).unwrap();
    pair.run(5.0, [ONE, ELSEWHERE]);
    assert!(pair.is_in_sync());
    assert!(pair.one.paths().all(|(_, path)| path == ELSEWHERE));
}

/// What a datagram says of paths.
fn message(transmit: &Transmit) -> Option<PathMessage> {
    PathMessage::parse(&Datagram::new_checked(&transmit.bytes).unwrap()).ok()
}

/// What a session sends now.
fn sent(session: &mut Session, now: Stamp) -> Vec<Transmit> {
    std::iter::from_fn(|| session.poll_transmit(now)).collect()
}

#[test]
fn an_answer_counts_that_takes_longer_than_it_takes_to_forget_a_peer() {
    let slow = SessionConfig { peer_timeout_ms: 1_000, ..SessionConfig::default() };
    let (mut one, mut two) = (session(1, &slow), session(2, &slow));
    let mut now = Stamp(0);
    let is_answer = |sent: &Transmit| message(sent).is_some_and(|message| message.answer.is_some());
    let mut answers = Vec::new();
    for _ in 0..3 {
        // Each time robot 2 was forgotten before.
        now = now.plus_micros(3_000_000);
        two.handle_timeout(now);
        let hello = sent(&mut two, now).remove(0);
        one.handle_datagram_from(now, TWO, &hello.bytes).unwrap();
        for asked in sent(&mut one, now).iter().filter(|sent| sent.path == Some(TWO)) {
            two.handle_datagram_from(now, ONE, &asked.bytes).unwrap();
        }
        answers.extend(sent(&mut two, now).into_iter().filter(is_answer));
        one.handle_timeout(now.plus_micros(2_000_000));
        assert_eq!(one.peers().count(), 0);
    }
    // The answer to the first challenge, while the third is on its way.
    one.handle_datagram_from(now.plus_micros(2_500_000), TWO, &answers[0].bytes).unwrap();
    assert_eq!(one.counters().paths_validated, 1);
    assert_eq!(one.paths().collect::<Vec<_>>(), [(RobotId(2), TWO)]);
    // It is not tried again when it is heard from there later.
    now = now.plus_micros(9_000_000);
    one.handle_timeout(now);
    assert_eq!(one.peers().count(), 0);
    two.handle_timeout(now);
    one.handle_datagram_from(now, TWO, &sent(&mut two, now).remove(0).bytes).unwrap();
    assert!(sent(&mut one, now).iter().filter_map(message).all(|message| message.challenge.is_none()));
}

#[test]
fn of_the_challenges_to_a_peer_that_wait_only_the_latest_goes_out() {
    let (mut one, mut two) = (session(1, &SessionConfig::default()), session(2, &SessionConfig::default()));
    let mut heard = 0;
    for step in 1..=300 {
        let now = Stamp(step * 100_000);
        two.handle_timeout(now);
        for datagram in sent(&mut two, now) {
            one.handle_datagram_from(now, Path(heard), &datagram.bytes).unwrap();
            heard += 1;
        }
    }
    assert!(heard > 2, "{heard}");
    let now = Stamp(30_000_000);
    let asked: Vec<Transmit> =
        sent(&mut one, now).into_iter().filter(|sent| kind(sent) == Kind::Path).collect();
    assert_eq!(asked.iter().map(|sent| sent.path).collect::<Vec<_>>(), [Some(Path(heard - 1))]);
}

#[test]
fn by_broadcast_no_address_is_tried() {
    let mut pair = Pair::new(&SessionConfig { cast: Cast::Broadcast, ..SessionConfig::default() });
    let own = pair.one.own();
    pair.one.publish(Stamp(0), package(own, 1)).unwrap();
    pair.run(3.0, [ONE, TWO]);
    assert_eq!(pair.one.counters().paths_out.datagrams + pair.two.counters().paths_out.datagrams, 0);
    assert!(pair.sent.iter().all(|sent| sent.to == Destination::Everyone));
}
