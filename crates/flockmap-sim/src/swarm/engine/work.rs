//! A robot is called; what it says and sends goes past the checkers.

use super::{Engine, Input, Phase};
use crate::swarm::broken;
use crate::swarm::check::{self, Finding, names};
use crate::swarm::datagram::{self, Content};
use crate::swarm::member::{Member, NEVER};
use crate::{IP_UDP_BYTES, To};
use flockmap::{Cast, Destination, Event, Robot, RobotId, Stream, Transmit};

impl Engine {
    /// Gives a robot an input, then takes what it says and sends, under the eyes of the checkers.
    pub(super) fn work(&mut self, number: usize, input: Input<'_>) {
        let Some(mut robot) = self.members[number].robot.take() else { return };
        let id = self.members[number].id();
        let now = self.members[number].settings.clock.shows(self.now);
        self.at_work = Some(id);
        self.steps += 1;
        let found = self.members[number].still.called(self.now);
        self.found(id, found);
        let is_taken = match input {
            Input::Datagram(bytes) | Input::Forged(bytes) => robot.handle_datagram(now, bytes).is_ok(),
            Input::Time => {
                robot.handle_timeout(now);
                false
            }
            Input::Scan => false,
        };
        self.drain(number, &mut robot, now);
        if let Input::Datagram(bytes) | Input::Forged(bytes) = input
            && is_taken
        {
            if self.settings.key.is_some() {
                let is_genuine = matches!(input, Input::Datagram(_));
                let found = self.sealed.taken(robot.own_stream(), bytes, is_genuine);
                self.found(id, found);
            }
            let read = datagram::read(bytes, self.settings.key.as_ref(), id);
            if let Some((header, Content::Request(request))) = read {
                self.members[number].twice.arrived(&header, *request);
            }
        }
        while self.failure.is_none()
            && let Some(transmit) = robot.poll_transmit(now)
        {
            self.transmit(number, &robot, &transmit, now);
            let found = self.members[number].still.called(self.now);
            self.found(id, found);
        }
        self.drain(number, &mut robot, now);
        if self.members.len() <= 8 || self.steps.is_multiple_of(16) {
            self.found(id, check::limits(&robot));
        }
        let member = &mut self.members[number];
        member.wake = robot.poll_timeout().map_or(NEVER, |at| member.settings.clock.when(at).max(self.now));
        member.robot = Some(robot);
        self.at_work = None;
    }

    /// Takes what a robot tells.
    pub(super) fn drain(&mut self, number: usize, robot: &mut Robot, now: flockmap::Stamp) {
        let id = self.members[number].id();
        while let Some(event) = robot.poll_event() {
            match event {
                Event::CycleClosed { changes, packages, .. } => {
                    self.members[number].keep(&packages);
                    let layer = robot.fusion().layer(robot.own_stream());
                    if let Err(found) = self.truth.note_cycle(&changes, &packages, layer) {
                        let expected = "packages that say what their cycle changed".to_owned();
                        self.found(id, Some(Finding { checker: names::PACKED, expected, found }));
                    }
                }
                Event::Merged { stream, index, cycle_end, changes, package, .. } => {
                    self.members[number].keep(&[package]);
                    self.note_age(number, stream, cycle_end, now);
                    if changes.is_empty() {
                        if !self.dirty.contains(&(number, stream)) {
                            self.dirty.push((number, stream));
                        }
                        continue;
                    }
                    let found = check::voxels_of_merge(&self.truth, stream, index, &changes, cycle_end);
                    self.found(id, found);
                    let found = check::layer_after(&self.truth, robot, stream, &changes);
                    self.found(id, found);
                }
                Event::CaughtUp { stream, .. } => {
                    self.found(id, check::whole_voxels(&self.truth, robot, stream));
                    self.found(id, check::whole_layer(&self.truth, robot, stream));
                }
                Event::PeerSeen(peer) | Event::PeerLost(peer) => {
                    self.members[number].twice.forget(peer.origin)
                }
                Event::EncodeFailed(error) => {
                    let expected = "changes that can be coded".to_owned();
                    let found = error.to_string();
                    self.found(id, Some(Finding { checker: names::PACKED, expected, found }));
                }
                _ => {}
            }
        }
    }

    pub(super) fn note_age(
        &mut self,
        number: usize,
        stream: Stream,
        cycle_end: flockmap::Stamp,
        now: flockmap::Stamp,
    ) {
        let origin = self.members.iter().find(|member| member.id() == stream.origin);
        let own = self.members[number].settings.clock;
        if let Some(origin) = origin {
            let age = own.when(now) - origin.settings.clock.when(cycle_end);
            self.members[number].ages.push(age.max(0));
        }
    }

    pub(super) fn transmit(
        &mut self,
        number: usize,
        robot: &Robot,
        transmit: &Transmit,
        now: flockmap::Stamp,
    ) {
        let id = self.members[number].id();
        let reader = match transmit.to {
            Destination::Peer(peer) => peer,
            Destination::Everyone => id,
        };
        let read = datagram::read(&transmit.bytes, self.settings.key.as_ref(), reader);
        let packages = match read {
            Some((_, Content::Packages(packages))) => Some(packages),
            _ => None,
        };
        let is_request = packages.is_none();
        if self.settings.key.is_some() {
            let found = self.sealed.sent(transmit.to, robot.session().config().salt, &transmit.bytes);
            self.found(id, found);
        }
        if let Some(outsider) = &mut self.outsider {
            outsider.hear(&transmit.bytes);
        }
        let config = robot.session().config();
        let is_broadcast = config.cast == Cast::Broadcast;
        let peers = || robot.session().peers().map(|peer| peer.stream.origin);
        let counted: Vec<RobotId> = match transmit.to {
            Destination::Peer(peer) => vec![peer],
            Destination::Everyone => peers().collect(),
        };
        let bytes = transmit.bytes.len() + IP_UDP_BYTES;
        let member = &mut self.members[number];
        let mut found = if is_broadcast {
            // One datagram, whoever hears it.
            member.budget.sent(config, now, 1, bytes, &[])
        } else {
            member.budget.sent(config, now, counted.len(), bytes, &counted)
        };
        found = found.or_else(|| member.quiet.sent(config, self.now, is_request));
        if let Some(packages) = &packages {
            let to = match transmit.to {
                Destination::Peer(peer) => Some(peer),
                Destination::Everyone => None,
            };
            // There and back, at the least.
            let round_trip = 2 * self.settings.radio.delay_micros.max(0);
            found = found.or_else(|| member.twice.sent(robot, self.now, to, packages, round_trip));
        }
        self.found(id, found);
        let at = flockmap::Stamp(self.now);
        let damaged = match self.settings.broken {
            share
                if !is_request
                    && self.phase == Phase::Mapping
                    && share > 0.0
                    && self.broken.chance(share) =>
            {
                broken::damaged_inside(&transmit.bytes, &mut self.broken)
            }
            _ => None,
        };
        let bytes = damaged.as_ref().unwrap_or(&transmit.bytes);
        match transmit.to {
            Destination::Peer(peer) => self.radio.send(at, id, To::Node(peer), bytes),
            Destination::Everyone if is_broadcast => self.radio.send(at, id, To::All, bytes),
            Destination::Everyone => {
                for other in self.members.iter().map(Member::id).filter(|other| *other != id) {
                    self.radio.send(at, id, To::Node(other), &transmit.bytes);
                }
            }
        }
    }
}
