//! A swarm in virtual time: sessions with layers behind them, and a seeded radio that loses, delays, reorders
//! and duplicates. No wall time, no sockets: the same seed gives the same run.
#![allow(dead_code, reason = "each test file uses its own part")]

use flockmap_codec::{Batch, Codec, Content, ContentKind, Encoder, PACKAGE_BYTES_MAX, Package, Span};
use flockmap_grid::{Changes, Layer, Resolution, RobotId, Stamp, State, Stream, Voxel};
use flockmap_sync::wire::{
    Datagram, DatagramHeader, Echo, Kind, OriginRange, Request, is_sealed, parse_packages,
};
use flockmap_sync::{Cast, Destination, Event, Session, SessionConfig, Verdict};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

pub(crate) const MS: i64 = 1_000;
pub(crate) const SECOND: i64 = 1_000_000;

/// SplitMix64.
pub(crate) struct Random(pub u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub(crate) fn below(&mut self, below: u64) -> u64 {
        self.next() % below.max(1)
    }

    pub(crate) fn happens(&mut self, probability: f64) -> bool {
        ((self.next() >> 11) as f64) < probability * (1u64 << 53) as f64
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Radio {
    pub(crate) loss: f64,
    pub(crate) duplicate: f64,
    pub(crate) delay: i64,
    pub(crate) jitter: i64,
}

impl Radio {
    pub(crate) const PERFECT: Self = Self { loss: 0.0, duplicate: 0.0, delay: 5 * MS, jitter: 0 };

    pub(crate) const fn lossy(loss: f64) -> Self {
        Self { loss, duplicate: 0.02, delay: 10 * MS, jitter: 20 * MS }
    }
}

pub(crate) struct Robot {
    pub(crate) session: Session,
    pub(crate) layers: BTreeMap<Stream, Layer>,
    /// The robot's clock minus the virtual time.
    pub(crate) clock: i64,
    pub(crate) events: Vec<String>,
    /// Virtual time, bytes on the wire, and to how many, of every datagram.
    pub(crate) sent: Vec<(i64, usize, usize)>,
    /// Decline snapshots.
    pub(crate) no_snapshot: bool,
    /// Packages of this origin with these indices are kept pending, or undecodable.
    pub(crate) keeps: Vec<(RobotId, u32)>,
    pub(crate) gives_up: Vec<(RobotId, u32)>,
    /// Packages that come more than so many indices ahead of all that is held are rejected: no room for them
    /// to wait.
    pub(crate) ahead_max: Option<u32>,
    /// What is kept pending.
    pub(crate) pending: Vec<Package>,
    encoder: Encoder,
    batch_end: Stamp,
}

impl Robot {
    pub(crate) fn layer(&self, stream: Stream) -> u64 {
        self.layers.get(&stream).map_or(0, Layer::digest)
    }

    pub(crate) fn bytes_between(&self, from: i64, to: i64) -> usize {
        self.sent.iter().filter(|s| (from..to).contains(&s.0)).map(|s| s.1 * s.2).sum()
    }
}

/// A datagram in flight: when it arrives, a number that keeps the order, to whom, bytes.
type Flying = (i64, u64, u16, Vec<u8>);

pub(crate) struct Swarm {
    pub(crate) seed: u64,
    pub(crate) now: i64,
    pub(crate) random: Random,
    pub(crate) radio: Radio,
    pub(crate) robots: BTreeMap<u16, Robot>,
    /// Pairs that cannot hear each other.
    pub(crate) cut: BTreeSet<(u16, u16)>,
    /// Every datagram that was sent, and every one that a robot heard, until they are taken.
    sent_bytes: Vec<(Destination, Vec<u8>)>,
    heard_bytes: Vec<(u16, Vec<u8>)>,
    flying: BinaryHeap<Reverse<Flying>>,
    sequence: u64,
}

impl Drop for Swarm {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("the swarm's seed was {}, its time {:.6} s", self.seed, self.now as f64 / 1e6);
        }
    }
}

impl Swarm {
    pub(crate) fn new(seed: u64, radio: Radio) -> Self {
        Self {
            seed,
            now: 0,
            random: Random(seed),
            radio,
            robots: BTreeMap::new(),
            cut: BTreeSet::new(),
            sent_bytes: Vec::new(),
            heard_bytes: Vec::new(),
            flying: BinaryHeap::new(),
            sequence: 0,
        }
    }

    /// Robots 1 to `count`, all hearing each other.
    pub(crate) fn of(count: u16, seed: u64, radio: Radio, config: &SessionConfig) -> Self {
        let mut swarm = Self::new(seed, radio);
        for id in 1..=count {
            swarm.start(id, 1, config.clone());
        }
        swarm
    }

    /// Starts a robot, or starts it again with nothing but its new epoch.
    pub(crate) fn start(&mut self, id: u16, epoch: u64, config: SessionConfig) -> Stream {
        let own = Stream { origin: RobotId(id), epoch };
        let clock = i64::from(id) * 1_000 * SECOND + epoch as i64 * 7 * SECOND;
        let salt =
            core::array::from_fn(|at| (id as u8).wrapping_add((epoch as u8).wrapping_mul(31)) ^ at as u8);
        let session = Session::new(own, SessionConfig { salt, ..config }, self.seed).unwrap();
        let robot = Robot {
            session,
            layers: BTreeMap::new(),
            clock,
            events: Vec::new(),
            sent: Vec::new(),
            no_snapshot: false,
            keeps: Vec::new(),
            gives_up: Vec::new(),
            ahead_max: None,
            pending: Vec::new(),
            encoder: Encoder::new(),
            batch_end: Stamp(i64::MIN),
        };
        self.robots.insert(id, robot);
        self.drive(id);
        own
    }

    pub(crate) fn stop(&mut self, id: u16) {
        self.robots.remove(&id);
    }

    pub(crate) fn cut(&mut self, a: u16, b: u16) {
        self.cut.extend([(a, b), (b, a)]);
    }

    pub(crate) fn join(&mut self, a: u16, b: u16) {
        self.cut.remove(&(a, b));
        self.cut.remove(&(b, a));
    }

    pub(crate) fn stream(&self, id: u16) -> Stream {
        self.robots[&id].session.own()
    }

    /// The robot maps `voxels` random voxels near where it is now and publishes them; the number of packages.
    pub(crate) fn publish(&mut self, id: u16, voxels: usize) -> usize {
        let robot = self.robots.get_mut(&id).unwrap();
        let now = Stamp(self.now + robot.clock);
        let end = now.max(robot.batch_end.plus_micros(1));
        robot.batch_end = end;
        let own = robot.session.own();
        let resolution = Resolution::from_metres(0.1).unwrap();
        let place = (self.now / (SECOND / 4)) as i32;
        let random = &mut self.random;
        let changes = Changes::from_voxels((0..voxels).map(|_| {
            let mut at = |side: u64| random.below(side) as i32;
            let voxel = Voxel::new(place + at(24), at(24), at(12));
            (voxel, if at(4) == 0 { State::Occupied } else { State::Free })
        }));
        let batch = Batch { stream: own, start: end, end, resolution, sensor: [0; 3] };
        let first = robot.session.store().newest_known(own) + 1;
        let packages =
            robot.encoder.encode_batch(Codec::Raw, &batch, first, &changes, PACKAGE_BYTES_MAX).unwrap();
        robot.layers.entry(own).or_default().apply(&changes, end);
        let count = packages.len();
        for package in packages {
            robot.session.publish(now, package).unwrap();
        }
        self.drive(id);
        count
    }

    /// Drains a robot's session as its contract says.
    pub(crate) fn drive(&mut self, id: u16) {
        let Some(robot) = self.robots.get_mut(&id) else { return };
        let now = Stamp(self.now + robot.clock);
        while let Some(event) = robot.session.poll_event() {
            match event {
                Event::Received(package) => {
                    let header = *package.header();
                    let named = (header.stream.origin, header.index);
                    if header.content == ContentKind::Changes && robot.keeps.contains(&named) {
                        robot.pending.push(package);
                        continue;
                    }
                    let prefix =
                        robot.session.received(header.stream).map_or(0, flockmap_sync::IntervalSet::prefix);
                    if header.content == ContentKind::Changes
                        && robot.ahead_max.is_some_and(|ahead| header.index > prefix.saturating_add(ahead))
                    {
                        robot.session.verdict(now, &package, Verdict::Damaged);
                        continue;
                    }
                    if header.content == ContentKind::Changes && robot.gives_up.contains(&named) {
                        robot.session.verdict(now, &package, Verdict::Undecodable);
                        continue;
                    }
                    match package.decode().unwrap() {
                        Content::Changes(changes) => {
                            let received = robot.session.received(header.stream).unwrap();
                            assert!(!received.contains(header.index), "{package:?} delivered twice");
                            robot.layers.entry(header.stream).or_default().apply(&changes, header.batch_end);
                        }
                        Content::Snapshot(state) => {
                            for (stamp, changes) in &state.parts {
                                robot.layers.entry(header.stream).or_default().apply(changes, *stamp);
                            }
                        }
                    }
                    robot.session.verdict(now, &package, Verdict::Merged);
                }
                Event::SnapshotWanted { stream, since, newer_than, upto, .. } => {
                    robot.events.push(format!("wanted {stream:?} since {since} upto {upto}"));
                    let state = robot.layers.get(&stream).and_then(|layer| layer.snapshot_voxels(newer_than));
                    let chunks = state.filter(|_| !robot.no_snapshot).map_or(Vec::new(), |state| {
                        let resolution = Resolution::from_metres(0.1).unwrap();
                        robot
                            .encoder
                            .encode_span(
                                Codec::Paper,
                                Span::new(stream, since, upto),
                                resolution,
                                &state,
                                PACKAGE_BYTES_MAX,
                            )
                            .unwrap()
                    });
                    robot.session.provide_snapshot(now, stream, chunks);
                }
                other => robot.events.push(format!("{other:?}")),
            }
        }
        while let Some(transmit) = self.robots.get_mut(&id).unwrap().session.poll_transmit(now) {
            assert!(transmit.bytes.len() <= 1_200);
            self.send(id, transmit.to, &transmit.bytes);
        }
        let due = self.robots[&id].session.poll_timeout();
        assert!(due.is_none_or(|due| due > now), "drained at {now:?}, and due again at {due:?}");
    }

    fn send(&mut self, from: u16, to: Destination, bytes: &[u8]) {
        let receivers: Vec<u16> = match to {
            Destination::Peer(peer) => vec![peer.0],
            Destination::Everyone => self.robots.keys().copied().filter(|&id| id != from).collect(),
        };
        let robot = self.robots.get_mut(&from).unwrap();
        let broadcast = robot.session.config().cast == Cast::Broadcast;
        let copies = if broadcast { 1 } else { receivers.len() };
        robot.sent.push((self.now, bytes.len() + 28, copies));
        self.sent_bytes.push((to, bytes.to_vec()));
        for to in receivers {
            let copies = 1 + u32::from(self.random.happens(self.radio.duplicate));
            for _ in 0..copies {
                if self.cut.contains(&(from, to)) || self.random.happens(self.radio.loss) {
                    continue;
                }
                let jitter = self.random.below(self.radio.jitter as u64 + 1) as i64;
                self.sequence += 1;
                let at = self.now + self.radio.delay + jitter;
                self.flying.push(Reverse((at, self.sequence, to, bytes.to_vec())));
            }
        }
    }

    /// The datagrams that were sent since this was asked last.
    pub(crate) fn take_sent(&mut self) -> Vec<(Destination, Vec<u8>)> {
        std::mem::take(&mut self.sent_bytes)
    }

    /// The packages that were sent, unsealed, since this or [`Self::take_sent`] was asked last.
    pub(crate) fn take_sent_packages(&mut self) -> Vec<Package> {
        let mut packages = Vec::new();
        for (_, bytes) in self.take_sent() {
            assert!(!is_sealed(&bytes));
            let datagram = Datagram::new_checked(&bytes).unwrap();
            if datagram.header().kind == Kind::Packages {
                packages.extend(parse_packages(&datagram).unwrap());
            }
        }
        packages
    }

    /// A robot hears a request that a test makes up, of a peer that flies its first run and hears the robot,
    /// beside those in the echoes: it left 10 ms ago, when the peer had just heard what the robot had sent 20
    /// ms ago, and names all that the peer holds.
    pub(crate) fn hear_request(&mut self, id: u16, peer: u16, mut request: Request) {
        let robot = self.robots.get_mut(&id).unwrap();
        let (own, now) = (robot.session.own(), self.now + robot.clock);
        let (epoch_low, stamp_low) = (own.epoch as u16, (now - 20 * MS) as u32);
        request.echoes.push(Echo { robot: own.origin, epoch_low, stamp_low, age_micros: 0 });
        (request.origins, request.all_echoes) = (Some(OriginRange::all_from(RobotId(0))), true);
        let sender = Stream { origin: RobotId(peer), epoch: 1 };
        let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender, stamp: Stamp(now - 10 * MS) };
        robot.session.handle_datagram(Stamp(now), &request.emit(header, 1_200)).unwrap();
    }

    /// The datagrams that a robot heard since this was asked last of any robot.
    pub(crate) fn take_heard(&mut self, id: u16) -> Vec<Vec<u8>> {
        let heard = std::mem::take(&mut self.heard_bytes);
        heard.into_iter().filter(|(to, _)| *to == id).map(|(_, bytes)| bytes).collect()
    }

    /// Lets virtual time pass.
    pub(crate) fn run(&mut self, micros: i64) {
        let end = self.now + micros;
        let mut steps_at_once = 0;
        loop {
            let timeout = self
                .robots
                .iter()
                .filter_map(|(&id, robot)| Some((robot.session.poll_timeout()?.0 - robot.clock, id)))
                .min();
            let datagram = self.flying.peek().map(|Reverse((at, ..))| *at);
            let next = [timeout.map(|t| t.0), datagram].into_iter().flatten().min().unwrap_or(end);
            if next > end {
                self.now = end;
                return;
            }
            steps_at_once = if next > self.now { 0 } else { steps_at_once + 1 };
            assert!(steps_at_once < 200_000, "time stands still");
            self.now = self.now.max(next);
            if datagram.is_some_and(|at| at <= next) {
                let Some(Reverse((_, _, to, bytes))) = self.flying.pop() else { return };
                if let Some(robot) = self.robots.get_mut(&to) {
                    let now = Stamp(self.now + robot.clock);
                    let _ = robot.session.handle_datagram(now, &bytes);
                    self.heard_bytes.push((to, bytes));
                    self.drive(to);
                }
            } else if let Some((_, id)) = timeout {
                let robot = self.robots.get_mut(&id).unwrap();
                robot.session.handle_timeout(Stamp(self.now + robot.clock));
                self.drive(id);
            }
        }
    }

    /// Fails unless every robot holds every package of these streams, and has the same layers.
    pub(crate) fn assert_in_sync(&self, streams: &[Stream]) {
        for &stream in streams {
            let digests: BTreeSet<u64> = self.robots.values().map(|robot| robot.layer(stream)).collect();
            for (id, robot) in &self.robots {
                let missing: Vec<_> = robot.session.store().missing(stream).collect();
                let newest = robot.session.store().newest_known(stream);
                assert!(
                    missing.is_empty() && newest > 0,
                    "robot {id} misses {missing:?} of {newest} of {stream:?}"
                );
            }
            assert_eq!(digests.len(), 1, "layers of {stream:?} differ");
            assert!(!digests.contains(&0), "layers of {stream:?} are empty");
        }
    }

    /// All bytes on the wire.
    pub(crate) fn bytes(&self) -> usize {
        self.robots.values().map(|robot| robot.bytes_between(0, i64::MAX)).sum()
    }
}
