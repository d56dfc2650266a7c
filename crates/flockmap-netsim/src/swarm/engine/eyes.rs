//! What a robot reports and sends goes past the checkers.

use crate::swarm::broken::Broken;
use crate::swarm::check::{self, Failure, Finding, names};
use crate::swarm::clock::Clock;
use crate::swarm::crowd::NewBytes;
use crate::swarm::datagram::{Content, Keys};
use crate::swarm::member::{Input, Member};
use crate::swarm::outsider::Outsider;
use crate::swarm::purpose;
use crate::swarm::report::Seen;
use crate::swarm::settings::Settings;
use crate::swarm::truth::Truth;
use crate::{Addressees, Datagram, Delivery, IP_UDP_BYTES, Watch};
use flockmap::{Cast, Event, Robot, RobotId, Stamp, Stream};
use flockmap_worlds::random::Random;
use std::collections::BTreeMap;

/// What the simulator knows of a flight, and what it has found.
pub(super) struct Eyes {
    pub(super) settings: Settings,
    pub(super) is_mapping: bool,
    pub(super) broken: Broken,
    pub(super) outsider: Option<Outsider>,
    pub(super) keys: Keys,
    /// What the clock of each run shows.
    pub(super) clocks: BTreeMap<Stream, Clock>,
    sealed: check::Sealed,
    pub(super) identities: check::Identities,
    pub(super) truth: Truth,
    /// Layers with chunks of a snapshot in them, since they were looked at as a whole.
    pub(super) dirty: Vec<(usize, Stream)>,
    pub(super) at_work: Option<RobotId>,
    pub(super) failure: Option<Failure>,
    pub(super) events: Vec<(f64, String)>,
    pub(super) seen: Seen,
    pub(super) steps: u64,
    /// When packages were sent last.
    pub(super) last_packages: i64,
    /// The time.
    pub(super) now: i64,
    /// On a crowded radio.
    pub(super) new_bytes: Option<NewBytes>,
    /// What a robot has been given, and how much it had accepted before.
    given: Option<(Delivery, u64)>,
}

impl Eyes {
    pub(super) fn new(settings: Settings) -> Self {
        let seed = settings.options.seed;
        let outsider = settings.key.is_some().then(|| Outsider::new(Random::new(seed, purpose::OUTSIDER)));
        Self {
            is_mapping: true,
            broken: Broken::new(seed),
            outsider,
            keys: Keys { key: settings.key.clone(), ..Keys::default() },
            clocks: BTreeMap::new(),
            sealed: check::Sealed::default(),
            identities: check::Identities::default(),
            truth: Truth::default(),
            dirty: Vec::new(),
            at_work: None,
            failure: None,
            events: Vec::new(),
            seen: Seen::new(),
            steps: 0,
            last_packages: 0,
            now: 0,
            new_bytes: settings.trouble.crowd.map(|_| NewBytes::default()),
            given: None,
            settings,
        }
    }

    pub(super) fn say(&mut self, what: String) {
        self.events.push((self.now as f64 / 1e6, what));
    }

    pub(super) fn found(&mut self, robot: RobotId, found: Option<Finding>) {
        if let Some(found) = found {
            self.fail(Some(robot), found);
        }
    }

    /// The first finding counts.
    pub(super) fn fail(&mut self, robot: Option<RobotId>, found: Finding) {
        let Finding { checker, expected, found } = found;
        let at_s = self.now as f64 / 1e6;
        self.failure.get_or_insert(Failure { checker, robot, at_s, expected, found });
    }

    /// Takes the events of a robot.
    fn drain(&mut self, number: usize, member: &mut Member) {
        let id = member.settings.config.id;
        let now = member.settings.clock.shows(self.now);
        let Some(mut robot) = member.robot.take() else { return };
        while let Some(event) = robot.poll_event() {
            if let Some(disk) = &mut member.disk {
                disk.note(now, &event);
            }
            match event {
                Event::BatchClosed { changes, packages, .. } => {
                    if let Err(found) = self.truth.note_batch(&changes, &packages) {
                        let expected = "packages that say what their batch changed";
                        self.fail(Some(id), Finding::new(names::PACKED, expected, found));
                    }
                }
                Event::Merged { stream, index, batch_end, changes, .. } => {
                    if let Some(clock) = self.clocks.get(&stream) {
                        let age = member.settings.clock.when(now) - clock.when(batch_end);
                        member.ages.push(age.max(0));
                    }
                    if changes.is_empty() {
                        if !self.dirty.contains(&(number, stream)) {
                            self.dirty.push((number, stream));
                        }
                        continue;
                    }
                    let found = check::voxels_of_merge(&self.truth, stream, index, &changes, batch_end);
                    let found = found.or_else(|| check::layer_after(&self.truth, &robot, stream, &changes));
                    self.found(id, found);
                }
                Event::CaughtUp { stream, .. } => {
                    self.found(id, check::whole(&self.truth, &robot, stream));
                }
                Event::RunBegun(run) => {
                    let found = self.identities.begun(run);
                    self.found(id, found);
                    member.replaced = member.run.replace(run);
                    self.keys.salts.insert(run, robot.session().config().salt);
                    self.clocks.insert(run, member.settings.clock);
                    self.say(format!("{run:?} begins while flying"));
                    *self.seen.entry("run begun while flying").or_default() += 1;
                }
                Event::Dropped { .. } => *self.seen.entry("dropped for want of room").or_default() += 1,
                Event::Complete { stream } => {
                    *self.seen.entry("what was dropped has come back").or_default() += 1;
                    self.found(id, check::whole(&self.truth, &robot, stream));
                }
                Event::RunForgotten(run) => {
                    // The own run that another one replaces while flying: older ones are wanted as before.
                    let is_replaced = member.replaced.take_if(|replaced| *replaced == run).is_some();
                    member.forgotten.insert(run, !is_replaced);
                    member.twice.forget_run(run);
                    *self.seen.entry("run forgotten").or_default() += 1;
                }
                Event::PeerSeen(peer) | Event::PeerLost(peer) => member.twice.forget(peer.origin),
                Event::EncodeFailed(error) => {
                    let found = Finding::new(names::PACKED, "changes that can be coded", error.to_string());
                    self.fail(Some(id), found);
                }
                _ => {}
            }
        }
        if let Some(disk) = &mut member.disk {
            disk.go_on(&robot);
        }
        member.robot = Some(robot);
    }
}

/// Packages and chunks.
fn accepted(robot: &Robot) -> u64 {
    let counters = robot.session().counters();
    counters.accepted + counters.chunks_accepted
}

impl Watch<Member> for Eyes {
    fn begins(&mut self, now: Stamp, _number: usize, member: &mut Member, delivery: Option<&Delivery>) {
        self.now = now.0;
        if let (Some(_), Some(robot), Some(delivery)) = (&self.new_bytes, &member.robot, delivery) {
            self.given = Some((delivery.clone(), accepted(robot)));
        }
        if member.robot.is_some() {
            let id = member.settings.config.id;
            self.at_work = Some(id);
            self.steps += 1;
            self.found(id, member.still.called(self.now));
        }
    }

    fn called(&mut self, _now: Stamp, number: usize, member: &mut Member) {
        let id = member.settings.config.id;
        let now = member.settings.clock.shows(self.now);
        let (Some(robot), input) = (&member.robot, member.input.take()) else { return };
        if let Some(Input { bytes, is_genuine, is_taken }) = input {
            let read = if is_taken { self.keys.read(&bytes, id) } else { None };
            let packages = match &read {
                Some((_, Content::Packages(packages))) => packages.len(),
                _ => 0,
            };
            self.found(id, member.work.taken(robot, bytes.len(), packages));
            if is_taken && self.settings.key.is_some() {
                let found = self.sealed.taken(robot.own_stream(), &bytes, is_genuine);
                self.found(id, found);
            }
            match read {
                Some((header, Content::Request(request))) => {
                    member.twice.arrived(robot, now, &header, *request);
                }
                Some((_, Content::Path(message))) => member.paths.arrived(&message),
                _ => {}
            }
        }
        self.drain(number, member);
    }

    fn sent(
        &mut self,
        _now: Stamp,
        _number: usize,
        member: &mut Member,
        datagram: &mut Datagram,
        _copies: usize,
    ) {
        let id = member.settings.config.id;
        let now = member.settings.clock.shows(self.now);
        let (to, path) = member.sent;
        let Some(robot) = &member.robot else { return };
        let (packages, message) = match self.keys.read(&datagram.bytes, to.unwrap_or(id)) {
            Some((_, Content::Packages(packages))) => (Some(packages), None),
            Some((_, Content::Path(message))) => (None, Some(message)),
            _ => (None, None),
        };
        let is_request = packages.is_none();
        if !is_request {
            self.last_packages = self.now;
        }
        if self.settings.key.is_some() {
            let found = self.sealed.sent(to, robot.session().config().salt, &datagram.bytes);
            self.found(id, found);
        }
        if let Some(outsider) = &mut self.outsider {
            outsider.hear(self.now + self.settings.radio.config.link.delay_micros.max(0), &datagram.bytes);
        }
        let config = robot.session().config();
        let peers = || robot.session().peers().map(|peer| peer.stream.origin);
        let counted: Vec<RobotId> = match (config.cast, to) {
            // One datagram, whoever hears it.
            (Cast::Broadcast, _) => Vec::new(),
            (Cast::Unicast, Some(peer)) => vec![peer],
            (Cast::Unicast, None) => peers().collect(),
        };
        let bytes = datagram.bytes.len() + IP_UDP_BYTES;
        let mut found = member.budget.sent(config, now, bytes, &counted);
        // Those about paths have a checker of their own.
        if message.is_none() {
            found = found.or_else(|| member.quiet.sent(config, self.now, to, packages.as_deref()));
        }
        if let Some(packages) = &packages {
            // There and back, at the least.
            let round_trip = 2 * self.settings.radio.config.link.delay_micros.max(0);
            found = found.or_else(|| member.twice.sent(robot, (self.now, now), to, packages, round_trip));
        }
        if self.settings.has_paths {
            let paths = &mut member.paths;
            let used = match (to, path) {
                (None, _) => robot.session().paths().find_map(|(_, path)| paths.used(path)),
                (Some(to), Some(path)) => {
                    let run = robot.session().peers().find(|peer| peer.stream.origin == to);
                    let run = run.map_or(Stream { origin: to, epoch: 0 }, |peer| peer.stream);
                    paths.sent(self.now, run, path, message.as_ref())
                }
                (Some(_), None) => None,
            };
            found = found.or(used);
        }
        self.found(id, found);
        if let Some(last) = packages.iter().flatten().last()
            && self.is_mapping
            && datagram.to != Addressees::Each
        {
            let hearers = peers().filter(|peer| to.is_none_or(|to| to == *peer));
            let (probability, of) = (self.settings.broken, last.header().stream);
            if let Some(damaged) = self.broken.damage(probability, &datagram.bytes, hearers, of) {
                datagram.bytes = damaged;
            }
        }
        self.found(id, member.still.called(self.now));
    }

    fn settled(&mut self, _now: Stamp, number: usize, member: &mut Member) {
        self.drain(number, member);
        if let Some(robot) = &member.robot
            && (self.settings.members.len() <= 8 || self.steps.is_multiple_of(16))
        {
            self.found(member.settings.config.id, check::limits(robot));
        }
        if let (Some(new_bytes), Some((delivery, before))) = (&mut self.new_bytes, self.given.take())
            && !self.is_mapping
            && member.robot.as_ref().is_some_and(|robot| accepted(robot) > before)
        {
            let to = (self.settings.cast == Cast::Unicast).then_some(delivery.to);
            new_bytes.brought(delivery.from, to, &delivery.bytes);
        }
        member.note_wake(self.now);
        self.at_work = None;
    }
}
