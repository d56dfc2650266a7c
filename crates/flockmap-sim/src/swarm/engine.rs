//! The queue of events of a flight, and what each does to a robot.

use super::check::{self, Failure, Finding, names};
use super::datagram::{self, Content};
use super::member::{Member, NEVER};
use super::outsider::Outsider;
use super::plan::Action;
use super::preset::Topology;
use super::report::Report;
use super::settings::{Settings, purpose};
use super::truth::Truth;
use super::world::SmallWorld;
use super::{SwarmOptions, broken, seen};
use crate::random::Random;
use crate::{Faults, IP_UDP_BYTES, Link, RadioConfig, RadioEmulator, To};
use flockmap::{Cast, Destination, Event, Robot, RobotId, Stream, Transmit};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// How often it is looked whether all agree, and what is wrong in whole layers, in microseconds.
const LOOK_EVERY: i64 = 50_000;
const LOOK_WHOLE_EVERY: i64 = 1_000_000;
/// Quiet is watched for so many idle periods.
const QUIET_PERIODS: i64 = 3;

/// Flies a swarm. The same options give the same report on every machine.
pub fn fly(options: &SwarmOptions) -> Report {
    let mut engine = Engine::new(Settings::draw(options));
    let flown = catch_unwind(AssertUnwindSafe(|| engine.run()));
    if let Err(panic) = flown {
        let words = panic.downcast_ref::<&str>().map(|words| (*words).to_owned());
        let words = words.or_else(|| panic.downcast_ref::<String>().cloned());
        engine.failure = Some(Failure {
            checker: names::CRASH,
            robot: engine.at_work,
            at_s: engine.now as f64 / 1e6,
            expected: "no panic".to_owned(),
            found: words.unwrap_or_else(|| "a panic".to_owned()),
        });
    }
    engine.report()
}

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Phase {
    Mapping,
    /// Links are healed; until then all have to agree.
    Healing {
        until: i64,
    },
    /// All agree; quiet from then, to the end.
    Grace {
        until: i64,
    },
    Quiet {
        until: i64,
    },
    Over,
}

/// What a robot is called with.
#[derive(Clone, Copy)]
enum Input<'a> {
    Datagram(&'a [u8]),
    /// One that no robot sent.
    Forged(&'a [u8]),
    Time,
    /// It has taken a scan in already.
    Scan,
}

struct Engine {
    settings: Settings,
    world: SmallWorld,
    now: i64,
    phase: Phase,
    members: Vec<Member>,
    radio: RadioEmulator,
    broken: Random,
    outsider: Option<Outsider>,
    sealed: check::Sealed,
    next_action: usize,
    /// How often each directed link is closed.
    closed: BTreeMap<(usize, usize), u32>,
    next_look: i64,
    next_whole_look: i64,
    truth: Truth,
    /// Layers with tiles of a present state in them, since they were looked at as a whole.
    dirty: Vec<(usize, Stream)>,
    at_work: Option<RobotId>,
    failure: Option<Failure>,
    events: Vec<(f64, String)>,
    seen: BTreeMap<&'static str, u64>,
    steps: u64,
    agreement: Option<i64>,
    agreement_within: i64,
}

impl Engine {
    fn new(settings: Settings) -> Self {
        let seed = settings.options.seed;
        // Where figures are asked for, more robots have more to see.
        let is_table = settings.options.until_agreement_s.is_some();
        let scale = if is_table { (settings.members.len() as f64 / 2.0).sqrt() } else { 1.0 };
        let world = SmallWorld::draw(&mut Random::new(seed, purpose::WORLD), scale);
        let members: Vec<Member> =
            (0..settings.members.len()).map(|number| Member::new(number, &settings, &world)).collect();
        let numbers = settings.radio;
        let link = Link {
            loss: numbers.loss,
            delay_micros: numbers.delay_micros,
            jitter_micros: numbers.jitter_micros,
            duplication: numbers.duplication,
        };
        let config = RadioConfig {
            seed,
            link,
            rate_bytes_per_s: numbers.rate_bytes_per_s,
            queue_bytes_max: numbers.queue_bytes_max,
            overhead_bytes: IP_UDP_BYTES,
            is_shared: numbers.is_shared,
            airtime_overhead_micros: numbers.airtime_overhead_micros,
            ..RadioConfig::default()
        };
        let mut radio = RadioEmulator::new(members.iter().map(Member::id), config);
        let faults = Faults { burst: numbers.burst, damage: numbers.damage };
        let mut closed = BTreeMap::new();
        for (a, from) in members.iter().enumerate() {
            for (b, to) in members.iter().enumerate().filter(|(b, _)| a != *b) {
                radio.set_faults(from.id(), to.id(), faults);
                if !numbers.is_linked(a, b, members.len()) {
                    radio.set_open(from.id(), to.id(), false);
                    closed.insert((a, b), u32::MAX / 2);
                }
            }
        }
        let outsider = settings.key.is_some().then(|| Outsider::new(Random::new(seed, purpose::OUTSIDER)));
        Self {
            settings,
            world,
            now: 0,
            phase: Phase::Mapping,
            members,
            radio,
            broken: Random::new(seed, purpose::BROKEN),
            outsider,
            sealed: check::Sealed::default(),
            next_action: 0,
            closed,
            next_look: 0,
            next_whole_look: LOOK_WHOLE_EVERY,
            truth: Truth::default(),
            dirty: Vec::new(),
            at_work: None,
            failure: None,
            events: Vec::new(),
            seen: BTreeMap::new(),
            steps: 0,
            agreement: None,
            agreement_within: 0,
        }
    }

    fn run(&mut self) {
        for number in 0..self.members.len() {
            self.start(number);
        }
        while self.phase != Phase::Over && self.failure.is_none() {
            self.now = self.next_time();
            self.act();
            while self.failure.is_none()
                && let Some(delivery) = self.radio.deliver_due(flockmap::Stamp(self.now))
            {
                self.deliver(delivery.to, &delivery.bytes);
            }
            self.attack();
            for number in 0..self.members.len() {
                if self.phase == Phase::Mapping && self.members[number].next_scan <= self.now {
                    self.members[number].scan(&self.world, self.now);
                    self.work(number, Input::Scan);
                }
                if self.members[number].wake <= self.now && self.failure.is_none() {
                    self.work(number, Input::Time);
                }
            }
            if self.next_look <= self.now {
                self.look();
            }
        }
    }

    fn next_time(&self) -> i64 {
        let radio = self.radio.next_due().map_or(NEVER, |at| at.0);
        let action = self.settings.plan.get(self.next_action).map_or(NEVER, |(at, _)| *at);
        let outsider = self.outsider.as_ref().map_or(NEVER, |outsider| outsider.next);
        let mut next = radio.min(action).min(self.next_look).min(outsider);
        for member in &self.members {
            next = next.min(member.wake);
            if self.phase == Phase::Mapping {
                next = next.min(member.next_scan);
            }
        }
        next.max(self.now)
    }

    /// Does what the plan says for now.
    fn act(&mut self) {
        while let Some(&(at, action)) = self.settings.plan.get(self.next_action)
            && at <= self.now
        {
            self.next_action += 1;
            *self.seen.entry(action.name()).or_default() += 1;
            let words = match action {
                Action::Crash(n) | Action::Restart(n) => {
                    format!("{} of {:?}", action.name(), self.members[n].id())
                }
                Action::Close { from, to } | Action::Open { from, to } => {
                    format!("{}: {:?} to {:?}", action.name(), self.members[from].id(), self.members[to].id())
                }
                Action::Part(_) | Action::Join(_) => action.name().to_owned(),
            };
            self.events.push((self.now as f64 / 1e6, words));
            match action {
                Action::Crash(number) => {
                    let seen = &mut self.seen;
                    self.members[number].crash(&mut |robot| seen::add_counters(seen, robot));
                }
                Action::Restart(number) if self.members[number].robot.is_none() => self.start(number),
                Action::Restart(_) => {}
                Action::Close { from, to } => self.close(from, to, true),
                Action::Open { from, to } => self.close(from, to, false),
                Action::Part(parts) => self.part(parts, true),
                Action::Join(parts) => self.part(parts, false),
            }
        }
    }

    fn part(&mut self, parts: u64, is_closed: bool) {
        let side = |number: usize| parts >> (number % 64) & 1;
        for a in 0..self.members.len() {
            for b in 0..self.members.len() {
                if side(a) != side(b) {
                    self.close(a, b, is_closed);
                }
            }
        }
    }

    fn close(&mut self, from: usize, to: usize, is_closed: bool) {
        let count = self.closed.entry((from, to)).or_default();
        *count = if is_closed { count.saturating_add(1) } else { count.saturating_sub(1) };
        let is_open = *count == 0;
        self.radio.set_open(self.members[from].id(), self.members[to].id(), is_open);
    }

    fn start(&mut self, number: usize) {
        let others: Vec<_> = match self.settings.clocks_given {
            true => self.members.iter().map(|other| (other.id(), other.settings.clock)).collect(),
            false => Vec::new(),
        };
        let own = self.members[number].id();
        let others: Vec<_> = others.into_iter().filter(|(id, _)| *id != own).collect();
        if let Err(error) = self.members[number].start(self.now, &others) {
            let expected = "settings that a robot takes".to_owned();
            self.fail(Some(own), Finding { checker: names::SETTINGS, expected, found: error.to_string() });
            return;
        }
        self.work(number, Input::Time);
    }

    fn deliver(&mut self, to: RobotId, bytes: &[u8]) {
        if let Some(number) = self.members.iter().position(|member| member.id() == to) {
            self.work(number, Input::Datagram(bytes));
        }
    }

    /// Lets the outsider send what is due.
    fn attack(&mut self) {
        let Some(outsider) = self.outsider.as_mut().filter(|outsider| outsider.next <= self.now) else {
            return;
        };
        if self.phase != Phase::Mapping {
            outsider.next = NEVER;
            return;
        }
        if let Some((number, attack)) = outsider.attack(self.now, self.members.len()) {
            let input =
                if attack.is_genuine { Input::Datagram(&attack.bytes) } else { Input::Forged(&attack.bytes) };
            self.work(number, input);
        }
    }

    /// Gives a robot an input, then takes what it says and sends, under the eyes of the checkers.
    fn work(&mut self, number: usize, input: Input<'_>) {
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
            let read = datagram::read(bytes, self.settings.key.as_ref());
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
    fn drain(&mut self, number: usize, robot: &mut Robot, now: flockmap::Stamp) {
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

    fn note_age(&mut self, number: usize, stream: Stream, cycle_end: flockmap::Stamp, now: flockmap::Stamp) {
        let origin = self.members.iter().find(|member| member.id() == stream.origin);
        let own = self.members[number].settings.clock;
        if let Some(origin) = origin {
            let age = own.when(now) - origin.settings.clock.when(cycle_end);
            self.members[number].ages.push(age.max(0));
        }
    }

    fn transmit(&mut self, number: usize, robot: &Robot, transmit: &Transmit, now: flockmap::Stamp) {
        let id = self.members[number].id();
        let read = datagram::read(&transmit.bytes, self.settings.key.as_ref());
        let packages = match read {
            Some((_, Content::Packages(packages))) => Some(packages),
            _ => None,
        };
        let is_request = packages.is_none();
        if self.settings.key.is_some() {
            let found = self.sealed.sent(&transmit.bytes);
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

    /// What is done now and then.
    fn look(&mut self) {
        self.next_look = self.now + LOOK_EVERY;
        if self.next_whole_look <= self.now {
            self.next_whole_look = self.now + LOOK_WHOLE_EVERY;
            self.look_at_dirty_layers();
        }
        match self.phase {
            Phase::Mapping if self.now >= self.settings.mapping => self.heal(),
            Phase::Mapping | Phase::Over => {
                self.next_look = self.next_look.min(self.settings.mapping.max(self.now + 1))
            }
            Phase::Healing { until } => self.look_for_agreement(until),
            Phase::Grace { until } if self.now >= until => {
                let longest =
                    self.members.iter().map(|m| check::period_micros(&m.settings.config.session)).max();
                let until = self.now + QUIET_PERIODS * longest.unwrap_or(0);
                self.members.iter_mut().for_each(|member| member.quiet.begin(self.now));
                self.phase = Phase::Quiet { until };
                self.next_look = until;
            }
            Phase::Grace { until } => self.next_look = until,
            Phase::Quiet { until } if self.now >= until => {
                self.look_at_everything();
                self.phase = Phase::Over;
            }
            Phase::Quiet { until } => self.next_look = until,
        }
    }

    /// Mapping ends, links heal.
    fn heal(&mut self) {
        let numbers = self.settings.radio;
        let link = Link {
            delay_micros: numbers.delay_micros,
            jitter_micros: numbers.jitter_micros,
            ..Link::default()
        };
        for a in 0..self.members.len() {
            for b in (0..self.members.len()).filter(|b| a != *b) {
                let (from, to) = (self.members[a].id(), self.members[b].id());
                self.radio.set_link(from, to, link);
                self.radio.set_faults(from, to, Faults::default());
                self.radio.set_open(from, to, numbers.is_linked(a, b, self.members.len()));
            }
        }
        self.next_action = self.settings.plan.len();
        // Who is gone stays gone only where nobody is heard by way of it.
        if numbers.topology != Topology::Full {
            for number in 0..self.members.len() {
                if self.members[number].robot.is_none() {
                    self.events
                        .push((self.now as f64 / 1e6, format!("restart of {:?}", self.members[number].id())));
                    self.start(number);
                }
            }
        }
        let told: Vec<(u64, u64)> = self
            .truth
            .streams()
            .map(|(stream, told)| (told.bytes, u64::from(self.truth.last(stream))))
            .collect();
        let bytes: u64 = told.iter().map(|(bytes, _)| bytes).sum();
        let packages: u64 = told.iter().map(|(_, packages)| packages).sum();
        let robots: Vec<&Robot> = self.members.iter().filter_map(|member| member.robot.as_ref()).collect();
        let hops = numbers.hops(self.members.len());
        // What is not packed yet is as much again at the most.
        self.agreement_within = check::bound(&robots, hops, 2 * bytes + 10_000, 2 * packages + 10);
        if let Some(seconds) = self.settings.options.until_agreement_s {
            self.agreement_within = i64::from(seconds) * 1_000_000;
        }
        self.phase = Phase::Healing { until: self.now + self.agreement_within };
        self.events.push((self.now as f64 / 1e6, "mapping ends, links heal".to_owned()));
    }

    fn robots(&self) -> Vec<&Robot> {
        self.members.iter().filter_map(|member| member.robot.as_ref()).collect()
    }

    fn look_for_agreement(&mut self, until: i64) {
        let robots = self.robots();
        // Not everything is packed yet.
        let pending = robots.iter().find(|robot| robot.mapper().pending() > 0);
        let pending = pending.map(|robot| (robot.own_stream().origin, "its own newest cycle".to_owned()));
        let lacks = pending.or_else(|| check::disagreement(&self.truth, &robots));
        if let Some((robot, lacks)) = lacks {
            if self.now >= until && self.settings.options.until_agreement_s.is_some() {
                self.phase = Phase::Over;
            } else if self.now >= until {
                let within = self.agreement_within as f64 / 1e6;
                let expected = format!("all packages everywhere {within:.1} s after links healed");
                let found = format!("it lacks {lacks}");
                self.found(robot, Some(Finding { checker: names::AGREEMENT, expected, found }));
            }
            return;
        }
        self.agreement = Some(self.now - self.settings.mapping);
        self.events.push((self.now as f64 / 1e6, "all agree".to_owned()));
        self.look_at_everything();
        if self.settings.options.until_agreement_s.is_some() {
            self.phase = Phase::Over;
            return;
        }
        let grace = self.members.iter().map(|m| check::Quiet::grace_micros(&m.settings.config.session)).max();
        // What waits at the radio is sent first.
        let grace =
            grace.unwrap_or(0) + 4 * (self.settings.radio.delay_micros + self.settings.radio.jitter_micros);
        self.phase = Phase::Grace { until: self.now + grace };
    }

    fn look_at_dirty_layers(&mut self) {
        for (number, stream) in core::mem::take(&mut self.dirty) {
            let Some(robot) = &self.members[number].robot else { continue };
            let found = check::whole_voxels(&self.truth, robot, stream)
                .or_else(|| check::whole_layer(&self.truth, robot, stream));
            let id = robot.own_stream().origin;
            self.found(id, found);
        }
    }

    /// All layers as a whole, and the fused maps.
    fn look_at_everything(&mut self) {
        let robots = self.robots();
        let mut findings = Vec::new();
        let clocks: BTreeMap<RobotId, i64> =
            self.members.iter().map(|member| (member.id(), member.settings.clock.offset)).collect();
        for robot in &robots {
            let own = robot.own_stream();
            for (stream, _) in robot.fusion().layers() {
                let found = check::whole_voxels(&self.truth, robot, stream)
                    .or_else(|| check::whole_layer(&self.truth, robot, stream));
                findings.extend(found.map(|found| (own.origin, found)));
            }
            let ahead = |other: RobotId| {
                let known = if self.settings.clocks_given { clocks.get(&other) } else { None };
                // A former run of its own has the same clock, but nobody says so.
                known.map(|theirs| clocks[&own.origin] - theirs)
            };
            findings.extend(check::wrong_fused(robot, ahead).map(|found| (own.origin, found)));
        }
        if let Some((robot, found)) = check::unequal_layer(&robots) {
            let expected = "equal layers, since all packages are held".to_owned();
            findings.push((robot, Finding { checker: names::AGREEMENT, expected, found }));
        }
        for (robot, found) in findings {
            self.found(robot, Some(found));
        }
    }

    fn found(&mut self, robot: RobotId, found: Option<Finding>) {
        if let Some(found) = found {
            self.fail(Some(robot), found);
        }
    }

    /// The first finding counts.
    fn fail(&mut self, robot: Option<RobotId>, found: Finding) {
        let Finding { checker, expected, found } = found;
        let at_s = self.now as f64 / 1e6;
        self.failure.get_or_insert(Failure { checker, robot, at_s, expected, found });
    }

    fn report(mut self) -> Report {
        let mut seen = core::mem::take(&mut self.seen);
        let radio = self.radio.traffic_total();
        for (name, count) in [
            ("lost on the way", radio.lost),
            ("damaged on the way", radio.damaged),
            ("radio queue full", radio.dropped),
        ] {
            *seen.entry(name).or_default() += count;
        }
        let robots = self.members.iter_mut().map(|member| {
            let airtime = self.radio.traffic(member.id()).airtime_micros;
            member.take_figures(airtime, &mut |robot| seen::add_counters(&mut seen, robot))
        });
        Report {
            robots: robots.collect(),
            command: self.settings.options.command(),
            settings: seen::settings(&self.settings),
            events: self.events,
            mapping_s: self.settings.mapping as f64 / 1e6,
            agreement_s: self.agreement.map(|micros| micros as f64 / 1e6),
            agreement_within_s: self.agreement_within as f64 / 1e6,
            seen,
            flown_s: self.now as f64 / 1e6,
            steps: self.steps,
            failure: self.failure,
        }
    }
}
