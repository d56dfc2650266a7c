//! Datagrams that come in: what is wrong with them, and whom they make known.

use super::Session;
use crate::Cast;
use crate::event::Event;
use crate::outbox::SilentPeer;
use crate::path::Path;
use crate::peer::{PEER_INTERVALS_MAX, Peer};
use crate::rate::Heard;
use crate::store::RECEIVED_INTERVALS_MAX;
use crate::timers::Timer;
use crate::wire::{
    Datagram, DatagramError, DatagramHeader, Kind, PathMessage, Request, asks_for_request, is_sealed,
    parse_coded, parse_contents, parse_packages,
};
use core::time::Duration;
use flockmap_grid::{RobotId, Stamp, Stream};

impl Session {
    /// Takes in a received datagram, of a driver that knows no addresses. An error is already counted; it
    /// says what was wrong and needs no action.
    pub fn handle_datagram(&mut self, now: Stamp, bytes: &[u8]) -> Result<(), DatagramError> {
        self.handle_datagram_on(now, None, bytes)
    }

    /// Takes in a datagram received on a path. By unicast nothing but a challenge goes out on it before an
    /// answer came back.
    pub fn handle_datagram_from(
        &mut self,
        now: Stamp,
        path: Path,
        bytes: &[u8],
    ) -> Result<(), DatagramError> {
        self.handle_datagram_on(now, Some(path), bytes)
    }

    fn handle_datagram_on(
        &mut self,
        now: Stamp,
        path: Option<Path>,
        bytes: &[u8],
    ) -> Result<(), DatagramError> {
        let now = self.advance(now);
        let result = self.take_datagram(now, path, bytes);
        let (peers, is_heard_by_all) = (self.peers.len(), self.config.cast == Cast::Broadcast);
        if self.outbox.rate.as_mut().is_some_and(|rate| rate.review(now, peers, is_heard_by_all)) {
            (self.outbox.blocked_until, self.schedule.blocked_until) = (None, None);
            self.hasten_request(now);
        }
        if let Err(error) = &result {
            let counter = match error {
                DatagramError::Length { .. } | DatagramError::Magic { .. } | DatagramError::Check { .. } => {
                    &mut self.report.counters.damaged
                }
                DatagramError::Version { .. } | DatagramError::Kind { .. } => {
                    &mut self.report.counters.foreign_version
                }
                DatagramError::Swarm { .. } => &mut self.report.counters.foreign_swarm,
                DatagramError::Malformed { .. } | DatagramError::Package { .. } => {
                    &mut self.report.counters.malformed
                }
                DatagramError::StaleEpoch { .. } => &mut self.report.counters.stale_epoch,
                DatagramError::TooManyPeers { .. } => &mut self.report.counters.too_many_peers,
                DatagramError::Forged { .. } => &mut self.report.counters.forged,
                DatagramError::Replayed { .. } => &mut self.report.counters.replayed,
                DatagramError::UnknownRun { .. } => &mut self.report.counters.unknown_run,
                DatagramError::Unsealed { .. } => &mut self.report.counters.unsealed,
                DatagramError::SealedWithoutKey { .. } => &mut self.report.counters.sealed_without_key,
                // Counted where it is reported.
                DatagramError::SameIdentity { .. } => return result,
            };
            *counter += 1;
        }
        result
    }

    fn take_datagram(&mut self, now: Stamp, path: Option<Path>, bytes: &[u8]) -> Result<(), DatagramError> {
        let opened;
        let datagram = if is_sealed(bytes) {
            opened = self.open(now, bytes)?;
            opened.datagram()?
        } else {
            let datagram = Datagram::new_checked(bytes)?;
            self.check_swarm(datagram.header().swarm)?;
            if self.config.swarm_key.is_some() {
                return Err(DatagramError::Unsealed { sender: datagram.header().sender.origin });
            }
            datagram
        };
        let header = *datagram.header();
        if header.sender == self.identity.own {
            self.report.counters.own_heard += 1;
            return Ok(());
        }
        if header.sender.origin == self.identity.own.origin {
            let (sender, got, current) =
                (self.identity.own.origin, header.sender.epoch, self.identity.own.epoch);
            if got < current {
                return Err(DatagramError::StaleEpoch { sender, got, current });
            }
            self.send_same_identity(now);
            self.note_own_id(now, header.sender);
            return Err(DatagramError::SameIdentity { id: sender });
        }
        // All of it is read before any of it counts.
        match header.kind {
            Kind::Request => {
                let mut request = Request::parse(&datagram, PEER_INTERVALS_MAX)?;
                request.find_runs(
                    |robot| self.newest_run(robot, header.sender),
                    |robot| self.newest_run_listed(robot, header.sender),
                    PEER_INTERVALS_MAX,
                );
                if let Err(unheard) = self.hear(now, &header, path, bytes.len()) {
                    self.note_own_runs(now, &request);
                    return Err(unheard);
                }
                self.report
                    .counters
                    .requests_in
                    .add(1, bytes.len() + self.config.datagram_overhead_bytes as usize);
                self.handle_request(now, &header, &request);
            }
            Kind::Packages => {
                let packages = parse_packages(&datagram)?;
                let coded = parse_coded(&datagram)?;
                let contents = parse_contents(&datagram, RECEIVED_INTERVALS_MAX)?;
                self.hear(now, &header, path, bytes.len())?;
                self.report
                    .counters
                    .packages_in
                    .add(1, bytes.len() + self.config.datagram_overhead_bytes as usize);
                self.receive_packages(now, header.sender, packages, contents);
                self.receive_coded(now, header.sender, coded);
                if asks_for_request(&datagram) {
                    self.greet(now);
                }
            }
            Kind::Path => {
                let message = PathMessage::parse(&datagram)?;
                self.hear(now, &header, path, bytes.len())?;
                self.handle_path(now, header.sender.origin, path, message);
            }
        }
        Ok(())
    }

    /// The run that a robot flies, as far as it is known, where a datagram of this sender is read.
    fn newest_run(&self, robot: RobotId, sender: Stream) -> Option<Stream> {
        if robot == sender.origin {
            return Some(sender);
        }
        let heard = self.peers.get(&robot).map(|peer| peer.stream);
        heard.max(self.store.newest_run(robot))
    }

    /// The newest run of a robot that has a list in requests: who does not hear that robot takes this one for its newest,
    /// since a run is not in any list before its first package.
    fn newest_run_listed(&self, robot: RobotId, sender: Stream) -> Option<Stream> {
        if robot == sender.origin {
            return Some(sender);
        }
        let own = self.identity.own;
        self.store.runs(robot).rev().find(|run| *run != own || self.store.newest_known(own) > 0)
    }

    /// Notes that a peer was heard; makes its acquaintance if it is new or in a new run.
    fn hear(
        &mut self,
        now: Stamp,
        header: &DatagramHeader,
        path: Option<Path>,
        bytes: usize,
    ) -> Result<(), DatagramError> {
        let (stream, id) = (header.sender, header.sender.origin);
        let known = self.peers.get(&id).map(|peer| peer.stream.epoch);
        let newest = self.store.newest_run(id).map_or(0, |run| run.epoch).max(known.unwrap_or(0));
        if newest > stream.epoch {
            self.send_superseded(now, Stream { epoch: newest, ..stream });
        }
        if let Some(current) = known.filter(|&current| current > stream.epoch) {
            return Err(DatagramError::StaleEpoch { sender: id, got: stream.epoch, current });
        }
        if known.is_none() && self.peers.len() >= self.config.peers_max {
            return Err(DatagramError::TooManyPeers { sender: id, peers_max: self.config.peers_max });
        }
        if known != Some(stream.epoch) {
            let mut peer = Peer::new(stream, now, &self.config);
            let before = self.peers.remove(&id).map(SilentPeer::of);
            if let Some(before) = before.or_else(|| self.outbox.silent.remove(&id)) {
                // A budget is the link's: it does not begin anew with a new run.
                peer.pacer = before.pacer.or(peer.pacer);
                // Where it was reached before is tried again only if it is heard from elsewhere.
                peer.path = before.path;
            }
            for (at, item) in self.outbox.broadcasts.recent() {
                peer.cover(item, at, self.config.in_flight_max);
            }
            self.schedule.timers.set_sooner(Timer::Silence, peer.lost_at(&self.config));
            self.peers.insert(id, peer);
            self.count_relays(None);
            self.push_event(Event::PeerSeen(stream));
            self.greet(now);
        }
        let overhead = self.config.datagram_overhead_bytes as usize;
        let newest_at = self.peers.get(&id).map_or(now, |peer| peer.newest_stamp_at);
        let newest_counts = self.stamp_counts(now.since(newest_at));
        if let Some(peer) = self.peers.get_mut(&id) {
            peer.note_heard(now);
            let queued = peer.queueing.sample_from(now, now.micros_since(header.stamp));
            peer.queued_in =
                Duration::from_micros(queued.map_or(0, |queued| queued.beyond_base.max(0)) as u64);
            if let Some(rate) = &mut self.outbox.rate {
                let before = Some((peer.newest_stamp, peer.newest_stamp_at));
                rate.note_heard(now, Heard { bytes: bytes + overhead, sent: header.stamp, before, queued });
            }
            peer.traffic_in.add(1, bytes + overhead);
            if header.stamp > peer.newest_stamp || !newest_counts {
                peer.newest_stamp = header.stamp;
                peer.newest_stamp_at = now;
            }
        }
        if let Some(path) = path {
            self.note_path(now, id, path);
        }
        Ok(())
    }
}
