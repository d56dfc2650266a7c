//! Nothing is sent twice to a peer within a round trip, and nothing that the peer has reported as received.
//!
//! Within the shortest time in which a report of the peer can have come back, nobody can know of a loss: a
//! copy sent in that time is one too many, lost or not. (Until a session has measured a round trip, it goes
//! by the one it was configured with, on its own clock; what it has found lost by then stays lost.) By
//! broadcast a datagram is right if any one peer lacks an item. Copies that *different* robots send are
//! allowed, and counted as relayed. A chunk that is broadcast for one peer while another one begins the same
//! snapshot may go out again, and so may what a broadcast brings to a peer whose ledger is full. Sessions
//! that compare successive requests (the paper's) measure no round trip and are asked the second thing only.
//! A robot that was lost from sight, or began anew, may be sent everything again. With fast repair and a third of losses
//! a package with obstacles may go out a second time after 20 ms.

use super::Finding;
use flockmap::codec::{ContentKind, Priority};
use flockmap::sync::InFlight;
use flockmap::sync::wire::{DatagramHeader, Request};
use flockmap::{Package, Robot, RobotId, Stamp, Stream};
use rustc_hash::{FxHashMap, FxHashSet};

const NAME: &str = "twice";

/// Microseconds, on the robot's clock, after which fast repair may send a package again …
const REPEATED_AFTER: i64 = 20_000;
/// … and for how long after losses were last high: what is due waits for its budget, while losses change.
const LOSSY_FOR: i64 = 2_000_000;

/// A package by its index, or a chunk by its snapshot and number.
type Item = (Stream, u32, Option<(u32, u32)>);

/// What one robot knows of another, as the simulator sees it.
#[derive(Default)]
struct Pair {
    /// When each item was sent last: in the time of the flight, and on the robot's clock.
    sent: FxHashMap<Item, (i64, Stamp)>,
    /// What fast repair sent a second time, until it is sent again for another reason.
    repeated: FxHashSet<Item>,
    /// The peer's newest request that arrived.
    request: Option<(Stamp, Request)>,
    /// When a round trip to it was first measured, on the robot's clock.
    measured: Option<Stamp>,
}

/// All that one run of a robot sent, and what the others reported to it.
#[derive(Default)]
pub(in crate::swarm) struct Twice {
    peers: FxHashMap<RobotId, Pair>,
    /// When a datagram last went out while a third of what is sent got lost, in the time of the flight.
    lossy: Option<i64>,
}

impl Twice {
    /// The robot has lost sight of a peer, or has met it (again): what was before counts no more.
    pub(in crate::swarm) fn forget(&mut self, peer: RobotId) {
        self.peers.remove(&peer);
    }

    /// The robot has forgotten a run, and with it what it knew of others' share in it.
    pub(in crate::swarm) fn forget_run(&mut self, run: Stream) {
        for pair in self.peers.values_mut() {
            pair.sent.retain(|(stream, ..), _| *stream != run);
            if let Some((_, request)) = &mut pair.request {
                request.received.retain(|received| received.stream != run);
            }
        }
    }

    /// A request has arrived at the robot, when its clock showed `now`, and was accepted.
    pub(in crate::swarm) fn arrived(
        &mut self,
        robot: &Robot,
        now: Stamp,
        header: &DatagramHeader,
        request: Request,
    ) {
        let pair = self.peers.entry(header.sender.origin).or_default();
        let mut peers = robot.session().peers();
        if peers.any(|peer| peer.stream == header.sender && peer.round_trip.is_some()) {
            pair.measured.get_or_insert(now);
        }
        if pair.request.as_ref().is_none_or(|(stamp, _)| *stamp < header.stamp) {
            pair.request = Some((header.stamp, request));
        }
    }

    /// A datagram of packages goes out, to one or (`to` is `None`) to all peers of the robot. `now`: the time
    /// of the flight, and what the robot's clock shows.
    pub(in crate::swarm) fn sent(
        &mut self,
        robot: &Robot,
        now: (i64, Stamp),
        to: Option<RobotId>,
        packages: &[Package],
        round_trip: i64,
    ) -> Option<Finding> {
        let config = robot.session().config();
        let ledger = config.in_flight == InFlight::RoundTrip;
        // Until a round trip is measured, the configured one is all that is known: on the robot's clock, like
        // all its times.
        let initial = 1_000 * i64::from(config.round_trip_initial_ms);
        if robot.session().peers().any(|peer| peer.loss >= (1 << 16) / 3) {
            self.lossy = Some(now.0);
        }
        let is_lossy = self.lossy.is_some_and(|at| now.0 - at < LOSSY_FOR);
        let peers = robot.session().peers();
        let peers = peers.filter(|peer| to.map_or(peer.hears_us, |to| to == peer.stream.origin));
        // As the robot knows them: a robot that began anew is sent its former run.
        let peers: Vec<(Stream, bool)> = peers
            .map(|peer| {
                // What finds no room in the ledger of one that it is not meant for is not noted.
                let is_full = to.is_none() && peer.in_flight >= 2 * config.in_flight_max;
                (peer.stream, is_full)
            })
            .collect();
        for package in packages {
            let header = package.header();
            let chunk = match header.content {
                ContentKind::Snapshot { id, chunk, .. } => Some((id, chunk)),
                ContentKind::Changes => None,
            };
            let item = (header.stream, header.index, chunk);
            let is_noted = ledger && (chunk.is_none() || to.is_some());
            let may_repeat = config.fast_repair && is_lossy && header.priority == Priority::Obstacles;
            let mut reasons = Vec::new();
            for (stream, is_full) in &peers {
                let peer = stream.origin;
                if *stream == header.stream {
                    reasons.push(format!("it is {peer:?}'s own"));
                    continue;
                }
                let pair = self.peers.entry(peer).or_default();
                let says_received = chunk.is_none()
                    && pair.request.as_ref().is_some_and(|(_, request)| {
                        let mut of = request.received.iter().filter(|of| of.stream == item.0);
                        of.any(|of| of.received.contains(item.1))
                    });
                // To one that reports it as received nothing is sent, even if it hears it: it may take that back.
                let before = if says_received || *is_full { None } else { pair.sent.insert(item, now) };
                if says_received {
                    reasons.push(format!("{peer:?} has reported it as received"));
                } else if let Some((before, shown)) = before
                    && is_noted
                    && now.0 - before < round_trip
                    // What was found lost until a round trip was measured stays lost.
                    && pair.measured.unwrap_or(now.1).micros_since(shown) < initial
                    && !(may_repeat && now.1.micros_since(shown) >= REPEATED_AFTER && pair.repeated.insert(item))
                {
                    let least = if pair.measured.is_some() { round_trip } else { round_trip.min(initial) };
                    let (ago, least) = ((now.0 - before) as f64 / 1e3, least as f64 / 1e3);
                    reasons.push(format!(
                        "sent to {peer:?} {ago:.3} ms ago, and a round trip takes {least:.3} ms"
                    ));
                } else if before.is_none_or(|(before, _)| now.0 - before >= round_trip) {
                    pair.repeated.remove(&item);
                }
            }
            if reasons.len() == peers.len() {
                let what = match chunk {
                    Some((id, chunk)) => format!("chunk {chunk} of snapshot {id:08x} of {:?}", item.0),
                    None => format!("package {} of {:?}", item.1, item.0),
                };
                let found = if reasons.is_empty() { "no peer that hears" } else { &reasons.join("; ") };
                return Some(Finding::new(NAME, format!("a reason to send {what}"), found));
            }
        }
        None
    }
}
