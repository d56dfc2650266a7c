//! An emulated radio in virtual time.

mod faults;
mod link;

pub use link::{Burst, Link};

use core::cmp::Reverse;
use faults::Weather;
use flockmap_grid::{RobotId, Stamp};
use flockmap_worlds::random::{Random, mix};
use std::collections::{BTreeMap, BinaryHeap, VecDeque};
use std::sync::Arc;

/// Bytes that IPv4 and UDP put before each datagram.
pub const IP_UDP_BYTES: usize = 28;

/// How the radio works.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct RadioConfig {
    /// Seed of all random draws.
    pub seed: u64,
    /// All links that [`RadioEmulator::set_link`] does not change.
    pub link: Link,
    /// Bytes a second that each node can send; `None`: as many as it likes. What comes faster waits.
    pub rate_bytes_per_s: Option<u32>,
    /// Most bytes that wait at a node; what comes on top is dropped. Default 256 KiB. Only
    /// with a rate.
    pub queue_bytes_max: usize,
    /// Most bytes in flight in the whole radio, counted once for each receiver; what comes on top is
    /// dropped. Default 64 MiB.
    pub in_flight_bytes_max: usize,
    /// Bytes counted for each datagram besides its payload, such as [`IP_UDP_BYTES`]. Default 0.
    pub overhead_bytes: usize,
    /// All nodes share one medium: while one sends, the others wait, each with its own queue, and who came
    /// first sends first. Default: each node sends on its own. Only with a rate.
    pub is_shared: bool,
    /// Time that each datagram takes on the air beside its bytes: preamble, access to the medium,
    /// acknowledgement. Microseconds, default 0. Only with a rate.
    pub airtime_overhead_micros: i64,
}

impl Default for RadioConfig {
    fn default() -> Self {
        Self {
            seed: 0,
            link: Link::default(),
            rate_bytes_per_s: None,
            queue_bytes_max: 256 << 10,
            in_flight_bytes_max: 64 << 20,
            overhead_bytes: 0,
            is_shared: false,
            airtime_overhead_micros: 0,
        }
    }
}

/// Where a datagram goes.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum To {
    /// To one node.
    Node(RobotId),
    /// To every other node, sent once.
    All,
}

/// A datagram that arrives.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Delivery {
    /// When.
    pub at: Stamp,
    /// Who sent it.
    pub from: RobotId,
    /// Who gets it.
    pub to: RobotId,
    /// Its payload.
    pub bytes: Arc<[u8]>,
}

/// What a node sent and received.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Traffic {
    /// Datagrams put on the air; a broadcast is one.
    pub sent: u64,
    /// Bytes put on the air, with overhead.
    pub sent_bytes: u64,
    /// Datagrams that arrived, copies included.
    pub received: u64,
    /// Bytes that arrived, with overhead.
    pub received_bytes: u64,
    /// Datagrams lost between their sender and this node, by a draw or a closed link.
    pub lost: u64,
    /// Datagrams of this node that found its queue full, or the whole radio.
    pub dropped: u64,
    /// Datagrams that arrived at this node with flipped bits.
    pub damaged: u64,
    /// Time that the datagrams of this node were on the air, in microseconds. Only with a rate.
    pub airtime_micros: u64,
}

/// A radio between nodes that exists in virtual time only: stamps come in as arguments, nothing waits. The
/// same seed and the same calls give the same deliveries on every machine.
///
/// ```
/// use flockmap_grid::{RobotId, Stamp};
/// use flockmap_netsim::{Link, RadioConfig, RadioEmulator, To};
///
/// let link = Link { delay_micros: 50_000, ..Link::default() };
/// let mut radio = RadioEmulator::new([RobotId(1), RobotId(2)], RadioConfig { link, ..RadioConfig::default() });
/// radio.send(Stamp(0), RobotId(1), To::All, b"hello");
/// assert_eq!(radio.next_due(), Some(Stamp(50_000)));
/// assert!(radio.deliver_due(Stamp(49_999)).is_none());
/// assert_eq!(&*radio.deliver_due(Stamp(50_000)).unwrap().bytes, b"hello");
/// ```
#[derive(Clone, Debug)]
pub struct RadioEmulator {
    config: RadioConfig,
    nodes: BTreeMap<RobotId, Node>,
    links: BTreeMap<(RobotId, RobotId), Line>,
    /// By time of arrival, then by order of sending.
    queue: BinaryHeap<Reverse<InFlight>>,
    in_flight_bytes: usize,
    sequence: u64,
    /// When a medium that all share is free.
    medium_busy_until: Stamp,
    /// Cross traffic on it.
    cross_traffic: Node,
}

#[derive(Clone, Debug, Default)]
struct Node {
    traffic: Traffic,
    /// When all that waits at this node will have been sent.
    busy_until: Stamp,
    /// On a shared medium: what waits or is being sent, with the time at which it will have been sent.
    waiting: VecDeque<(Stamp, usize)>,
    waiting_bytes: usize,
}

impl Node {
    /// When a datagram will have been sent; `None`: the queue is full. `medium`: until when a medium that all share is busy.
    fn enqueue(
        &mut self,
        now: Stamp,
        size: usize,
        config: &RadioConfig,
        medium: Option<&mut Stamp>,
    ) -> Option<Stamp> {
        let Some(rate) = config.rate_bytes_per_s else { return Some(now) };
        let rate = i128::from(rate.max(1));
        let takes = (size as i128 * 1_000_000 + rate - 1) / rate;
        let takes = i64::try_from(takes).unwrap_or(i64::MAX);
        let takes = takes.saturating_add(config.airtime_overhead_micros.max(0));
        let is_shared = medium.is_some();
        let busy_until = medium.unwrap_or(&mut self.busy_until);
        let begins = (*busy_until).max(now);
        let waiting = if is_shared {
            while let Some((_, size)) = self.waiting.pop_front_if(|(done, _)| *done <= now) {
                self.waiting_bytes -= size;
            }
            self.waiting_bytes as i128
        } else {
            // Time until the node is free × rate.
            i128::from(begins.micros_since(now)) * rate / 1_000_000
        };
        if waiting + size as i128 > config.queue_bytes_max as i128 {
            self.traffic.dropped += 1;
            return None;
        }
        let on_air = begins.plus_micros(takes);
        *busy_until = on_air;
        self.traffic.airtime_micros += takes as u64;
        if is_shared {
            self.waiting.push_back((on_air, size));
            self.waiting_bytes += size;
        }
        Some(on_air)
    }
}

#[derive(Clone, Debug)]
struct Line {
    link: Link,
    is_open: bool,
    random: Random,
    weather: Weather,
}

/// Ordered by its first two members, which no two share.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Debug)]
struct InFlight {
    due: Stamp,
    sequence: u64,
    from: RobotId,
    to: RobotId,
    bytes: Arc<[u8]>,
}

impl RadioEmulator {
    /// A radio between these nodes. Every node hears every other.
    pub fn new(nodes: impl IntoIterator<Item = RobotId>, config: RadioConfig) -> Self {
        let mut radio = Self {
            config,
            nodes: BTreeMap::new(),
            links: BTreeMap::new(),
            queue: BinaryHeap::new(),
            in_flight_bytes: 0,
            sequence: 0,
            medium_busy_until: Stamp(i64::MIN),
            cross_traffic: Node::default(),
        };
        nodes.into_iter().for_each(|id| radio.add(id));
        radio
    }

    /// One node more, which hears all and is heard by all.
    pub fn add(&mut self, id: RobotId) {
        let RadioConfig { seed, link, .. } = self.config;
        for (from, to) in self.nodes.keys().flat_map(|other| [(*other, id), (id, *other)]) {
            let random = Random::new(seed, mix(u64::from(from.0) << 16 | u64::from(to.0)));
            let weather = Weather::new(seed, from, to);
            self.links.insert((from, to), Line { link, is_open: true, random, weather });
        }
        self.nodes.insert(id, Node::default());
    }

    /// Changes the link in one direction. Does nothing if there is no such link.
    pub fn set_link(&mut self, from: RobotId, to: RobotId, link: Link) {
        if let Some(line) = self.links.get_mut(&(from, to)) {
            line.link = link;
        }
    }

    /// Opens a link, or lets nothing pass on it, in one direction. What is in flight arrives.
    pub fn set_open(&mut self, from: RobotId, to: RobotId, is_open: bool) {
        if let Some(line) = self.links.get_mut(&(from, to)) {
            line.is_open = is_open;
        }
    }

    /// As [`Self::set_open`], in both directions.
    pub fn set_open_both(&mut self, a: RobotId, b: RobotId, is_open: bool) {
        self.set_open(a, b, is_open);
        self.set_open(b, a, is_open);
    }

    /// Sends a datagram. A node that does not exist sends and gets nothing.
    pub fn send(&mut self, now: Stamp, from: RobotId, to: To, bytes: &[u8]) {
        let size = bytes.len() + self.config.overhead_bytes;
        let Some(node) = self.nodes.get_mut(&from) else { return };
        let busy = if self.config.is_shared { Some(&mut self.medium_busy_until) } else { None };
        let Some(on_air) = node.enqueue(now, size, &self.config, busy) else { return };
        node.traffic.sent += 1;
        node.traffic.sent_bytes += size as u64;
        let payload: Arc<[u8]> = Arc::from(bytes);
        let receivers = match to {
            To::Node(to) => vec![to],
            To::All => self.nodes.keys().copied().filter(|id| *id != from).collect(),
        };
        receivers.into_iter().for_each(|to| self.carry(on_air, from, to, &payload));
    }

    /// Cross traffic of so many bytes, which nobody here hears, on a medium that is shared. It has a queue as each
    /// node has. Does nothing if the medium is not shared.
    pub fn send_cross_traffic(&mut self, now: Stamp, bytes: usize) {
        if self.config.is_shared {
            self.cross_traffic.enqueue(now, bytes, &self.config, Some(&mut self.medium_busy_until));
        }
    }

    /// When the next datagram arrives; `None` if none is in flight.
    pub fn next_due(&self) -> Option<Stamp> {
        self.queue.peek().map(|Reverse(next)| next.due)
    }

    /// When all that is in flight now has arrived; `None` if nothing is. O(datagrams in flight).
    pub fn last_due(&self) -> Option<Stamp> {
        self.queue.iter().map(|Reverse(datagram)| datagram.due).max()
    }

    /// The next datagram that has arrived by `now`. Call it until it gives `None`.
    pub fn deliver_due(&mut self, now: Stamp) -> Option<Delivery> {
        if self.next_due()? > now {
            return None;
        }
        let Reverse(InFlight { due, from, to, bytes, .. }) = self.queue.pop()?;
        let size = bytes.len() + self.config.overhead_bytes;
        self.in_flight_bytes -= size;
        self.count(to, |traffic| {
            traffic.received += 1;
            traffic.received_bytes += size as u64;
        });
        Some(Delivery { at: due, from, to, bytes })
    }

    /// What a node sent and received so far; all zero for a node that does not exist.
    pub fn traffic(&self, node: RobotId) -> Traffic {
        self.nodes.get(&node).map_or_else(Traffic::default, |node| node.traffic)
    }

    fn count(&mut self, node: RobotId, count: impl FnOnce(&mut Traffic)) {
        if let Some(node) = self.nodes.get_mut(&node) {
            count(&mut node.traffic);
        }
    }

    fn carry(&mut self, on_air: Stamp, from: RobotId, to: RobotId, bytes: &Arc<[u8]>) {
        let Some(line) = self.links.get_mut(&(from, to)) else { return };
        // Every datagram takes the same draws, so that a change of one rate does not shift the others.
        let lost = line.random.happens(line.link.loss);
        let twice = line.random.happens(line.link.duplication);
        let jitter_max = line.link.jitter_micros.max(0) as u64;
        let jitters = [(); 2].map(|()| line.random.below(jitter_max.saturating_add(1)) as i64);
        let delay = line.link.delay_micros.max(0);
        let (faded, flips) = line.weather.draw(&line.link, on_air);
        if lost || faded || !line.is_open {
            return self.count(to, |traffic| traffic.lost += 1);
        }
        self.count(to, |traffic| traffic.damaged += u64::from(flips.is_some()));
        let bytes = &flips.map_or_else(|| Arc::clone(bytes), |flips| flips.applied_to(bytes));
        let size = bytes.len() + self.config.overhead_bytes;
        for jitter in jitters.into_iter().take(1 + usize::from(twice)) {
            if self.in_flight_bytes + size > self.config.in_flight_bytes_max {
                return self.count(from, |traffic| traffic.dropped += 1);
            }
            self.in_flight_bytes += size;
            let due = on_air.plus_micros(delay).plus_micros(jitter);
            let bytes = Arc::clone(bytes);
            self.queue.push(Reverse(InFlight { due, sequence: self.sequence, from, to, bytes }));
            self.sequence += 1;
        }
    }
}
