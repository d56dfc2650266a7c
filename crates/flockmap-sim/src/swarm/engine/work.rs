//! A robot is called; what it says and sends goes past the checkers.

use super::{Engine, Input, Phase};
use crate::swarm::check::{self, Finding, names};
use crate::swarm::datagram::Content;
use crate::swarm::member::{Member, NEVER};
use crate::{IP_UDP_BYTES, To};
use flockmap::{Cast, Destination, Event, Robot, RobotId, Stamp, Stream, Transmit};

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
            Input::Datagram { bytes, path: Some(path), .. } => {
                robot.handle_datagram_from(now, path, bytes).is_ok()
            }
            Input::Datagram { bytes, path: None, .. } => robot.handle_datagram(now, bytes).is_ok(),
            Input::Time => {
                robot.handle_timeout(now);
                false
            }
            Input::Scan => false,
        };
        if let Input::Datagram { bytes, is_genuine, .. } = input {
            let read = if is_taken { self.keys.read(bytes, id) } else { None };
            let packages = match &read {
                Some((_, Content::Packages(packages))) => packages.len(),
                _ => 0,
            };
            let found = self.members[number].work.taken(&robot, bytes.len(), packages);
            self.found(id, found);
            if is_taken && self.settings.key.is_some() {
                let found = self.sealed.taken(robot.own_stream(), bytes, is_genuine);
                self.found(id, found);
            }
            match read {
                Some((header, Content::Request(request))) => {
                    self.members[number].twice.arrived(&robot, now, &header, *request);
                }
                Some((_, Content::Path(message))) => self.members[number].paths.arrived(&message),
                _ => {}
            }
        }
        self.drain(number, &mut robot, now);
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
    pub(super) fn drain(&mut self, number: usize, robot: &mut Robot, now: Stamp) {
        let id = self.members[number].id();
        while let Some(event) = robot.poll_event() {
            if let Some(disk) = &mut self.members[number].disk {
                disk.note(now, &event);
            }
            match event {
                Event::CycleClosed { changes, packages, .. } => {
                    if let Err(found) = self.truth.note_cycle(&changes, &packages) {
                        let expected = "packages that say what their cycle changed".to_owned();
                        self.found(id, Some(Finding { checker: names::PACKED, expected, found }));
                    }
                }
                Event::Merged { stream, index, cycle_end, changes, .. } => {
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
                Event::RunBegun(run) => {
                    let found = self.identities.begun(run);
                    self.found(id, found);
                    let member = &mut self.members[number];
                    member.replaced = member.run.replace(run);
                    self.keys.salts.insert(run, robot.session().config().salt);
                    self.clocks.insert(run, self.members[number].settings.clock);
                    self.events.push((self.now as f64 / 1e6, format!("{run:?} begins while flying")));
                    *self.seen.entry("run begun while flying").or_default() += 1;
                }
                Event::RunForgotten(run) => {
                    // The own run that another one replaces while flying: older ones are wanted as before.
                    let member = &mut self.members[number];
                    let is_replaced = member.replaced.take_if(|replaced| *replaced == run).is_some();
                    member.forgotten.insert(run, !is_replaced);
                    member.twice.forget_run(run);
                    *self.seen.entry("run forgotten").or_default() += 1;
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
        if let Some(disk) = &mut self.members[number].disk {
            disk.go_on(robot);
        }
    }

    fn note_age(&mut self, number: usize, stream: Stream, cycle_end: Stamp, now: Stamp) {
        let own = self.members[number].settings.clock;
        if let Some(clock) = self.clocks.get(&stream) {
            let age = own.when(now) - clock.when(cycle_end);
            self.members[number].ages.push(age.max(0));
        }
    }

    pub(super) fn transmit(&mut self, number: usize, robot: &Robot, transmit: &Transmit, now: Stamp) {
        let id = self.members[number].id();
        let reader = match transmit.to {
            Destination::Peer(peer) => peer,
            Destination::Everyone => id,
        };
        let (packages, message) = match self.keys.read(&transmit.bytes, reader) {
            Some((_, Content::Packages(packages))) => (Some(packages), None),
            Some((_, Content::Path(message))) => (None, Some(message)),
            _ => (None, None),
        };
        let is_request = packages.is_none();
        if !is_request {
            self.last_packages = self.now;
        }
        if self.settings.key.is_some() {
            let found = self.sealed.sent(transmit.to, robot.session().config().salt, &transmit.bytes);
            self.found(id, found);
        }
        if let Some(outsider) = &mut self.outsider {
            outsider.hear(self.now + self.settings.radio.delay_micros.max(0), &transmit.bytes);
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
        // Those about paths have a checker of their own.
        if message.is_none() {
            found = found.or_else(|| member.quiet.sent(config, self.now, transmit.to, packages.as_deref()));
        }
        if let Some(packages) = &packages {
            let to = match transmit.to {
                Destination::Peer(peer) => Some(peer),
                Destination::Everyone => None,
            };
            // There and back, at the least.
            let round_trip = 2 * self.settings.radio.delay_micros.max(0);
            found = found.or_else(|| member.twice.sent(robot, (self.now, now), to, packages, round_trip));
        }
        if self.settings.has_paths {
            let paths = &mut self.members[number].paths;
            let used = match (transmit.to, transmit.path) {
                (Destination::Everyone, _) => robot.session().paths().find_map(|(_, path)| paths.used(path)),
                (Destination::Peer(to), Some(path)) => {
                    let run = robot.session().peers().find(|peer| peer.stream.origin == to);
                    let run = run.map_or(Stream { origin: to, epoch: 0 }, |peer| peer.stream);
                    paths.sent(self.now, run, path, message.as_ref())
                }
                (_, None) => None,
            };
            found = found.or(used);
        }
        self.found(id, found);
        let at = Stamp(self.now);
        let damaged = match packages.iter().flatten().last() {
            Some(last) if self.phase == Phase::Mapping => {
                self.broken.damage(self.settings.broken, &transmit.bytes, &counted, last.header().stream)
            }
            _ => None,
        };
        let bytes = damaged.as_ref().unwrap_or(&transmit.bytes);
        match transmit.to {
            Destination::Peer(peer) => {
                // What goes to a path arrives there, whoever it is meant for.
                let there =
                    transmit.path.map_or(peer, |path| RobotId(u16::try_from(path.0).unwrap_or(u16::MAX)));
                self.radio.send(at, id, To::Node(there), bytes);
            }
            Destination::Everyone if is_broadcast => self.radio.send(at, id, To::All, bytes),
            Destination::Everyone => {
                for other in self.members.iter().map(Member::id).filter(|other| *other != id) {
                    self.radio.send(at, id, To::Node(other), &transmit.bytes);
                }
            }
        }
    }
}
