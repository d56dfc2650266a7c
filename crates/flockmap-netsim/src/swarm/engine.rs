//! The queue of events of a flight, and what each does to a robot.

mod eyes;
mod look;

use super::check::{Finding, names};
use super::clock::Clock;
use super::costly::Costly;
use super::crowd::{NewBytes, Share};
use super::member::{Member, NEVER};
use super::outsider;
use super::plan::Action;
use super::purpose;
use super::report::Report;
use super::settings::Settings;
use super::world::SmallWorld;
use super::{SwarmOptions, seen};
use crate::{Network, Node, RadioConfig};
use eyes::Eyes;
use flockmap::{RobotId, Stamp};
use flockmap_worlds::random::Random;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// How often it is looked whether all agree, and what is wrong in whole layers, in microseconds.
const LOOK_EVERY: i64 = 50_000;
const LOOK_WHOLE_EVERY: i64 = 1_000_000;
/// Quiet is watched for so many idle periods.
const QUIET_PERIODS: i64 = 3;

/// What a seed decides before the flight begins, as text.
pub fn describe(options: &SwarmOptions) -> Vec<String> {
    seen::settings(&Settings::draw(options))
}

/// Flies a swarm. The same options give the same report on every machine.
pub fn fly(options: &SwarmOptions) -> Report {
    let mut engine = Engine::new(Settings::draw(options));
    let flown = catch_unwind(AssertUnwindSafe(|| engine.run()));
    if let Err(panic) = flown {
        let text = panic.downcast_ref::<&str>().copied();
        let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("a panic");
        let eyes = &mut engine.eyes;
        eyes.failure = None;
        eyes.fail(eyes.at_work, Finding::new(names::CRASH, "no panic", text));
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
        grace: i64,
        /// When it has to be quiet at the latest.
        latest: i64,
    },
    Quiet {
        until: i64,
    },
    Over,
}

/// The ends of all directed links between so many robots.
fn pairs(robots: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..robots).flat_map(move |a| (0..robots).filter(move |b| a != *b).map(move |b| (a, b)))
}

struct Engine {
    eyes: Eyes,
    world: SmallWorld,
    network: Network<Member>,
    phase: Phase,
    costly: Option<Costly>,
    next_action: usize,
    /// How often each directed link is closed.
    closed: BTreeMap<(usize, usize), u32>,
    next_look: i64,
    next_whole_look: i64,
    /// When cross traffic comes next.
    next_cross_traffic: i64,
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
        let mut network = Network::new(members, RadioConfig { seed, ..numbers.config }, Stamp(0));
        let mut closed = BTreeMap::new();
        for (a, b) in pairs(network.ids().len()) {
            if !numbers.is_linked(a, b, network.ids().len()) {
                let (from, to) = (network.ids()[a], network.ids()[b]);
                network.radio_mut().set_open(from, to, false);
                closed.insert((a, b), u32::MAX / 2);
            }
        }
        // Where there is a key, nobody takes it for a robot.
        let is_costly = settings.trouble.is_costly && settings.key.is_none();
        let costly = is_costly.then(|| Costly::new(Random::new(seed, purpose::COSTLY)));
        Self {
            eyes: Eyes::new(settings),
            world,
            network,
            phase: Phase::Mapping,
            costly,
            next_action: 0,
            closed,
            next_look: 0,
            next_whole_look: LOOK_WHOLE_EVERY,
            next_cross_traffic: 0,
            agreement: None,
            agreement_within: 0,
        }
    }

    fn run(&mut self) {
        for number in 0..self.network.nodes().len() {
            self.start(number);
        }
        while self.phase != Phase::Over && self.eyes.failure.is_none() {
            let now = self.next_time();
            self.network.skip_to(Stamp(now));
            self.eyes.now = now;
            self.act();
            self.network.deliver_due(&mut self.eyes);
            self.attack();
            self.burden();
            self.send_cross_traffic();
            for number in 0..self.network.nodes().len() {
                if self.phase == Phase::Mapping && self.network.nodes()[number].next_scan <= now {
                    let world = &self.world;
                    self.network.call(number, &mut self.eyes, |member, now| member.scan(world, now.0));
                }
                if self.eyes.failure.is_none() {
                    self.network.call_if_due(number, &mut self.eyes);
                }
            }
            if self.next_look <= now {
                self.look();
            }
        }
    }

    fn next_time(&self) -> i64 {
        let network = self.network.next_due().map_or(NEVER, |at| at.0);
        let action = self.eyes.settings.plan.get(self.next_action).map_or(NEVER, |(at, _)| *at);
        let outsider = self.eyes.outsider.as_ref().map_or(NEVER, |outsider| outsider.next);
        let costly = self.costly.as_ref().map_or(NEVER, |costly| costly.next);
        let cross_traffic = if self.cross_traffic().is_some() { self.next_cross_traffic } else { NEVER };
        let mut next = network.min(action).min(self.next_look).min(outsider).min(costly).min(cross_traffic);
        if self.phase == Phase::Mapping {
            next = self.network.nodes().iter().map(|member| member.next_scan).fold(next, i64::min);
        }
        next.max(self.eyes.now)
    }

    /// Does what the plan says for now.
    fn act(&mut self) {
        while let Some(&(at, action)) = self.eyes.settings.plan.get(self.next_action)
            && at <= self.eyes.now
        {
            self.next_action += 1;
            *self.eyes.seen.entry(action.name()).or_default() += 1;
            let (name, ids) = (action.name(), self.network.ids());
            self.eyes.say(match action {
                Action::Crash(n) | Action::Restart(n) => format!("{name} of {:?}", ids[n]),
                Action::Close { from, to } | Action::Open { from, to } => {
                    format!("{name}: {:?} to {:?}", ids[from], ids[to])
                }
                Action::Part(_) | Action::Join(_) => name.to_owned(),
            });
            match action {
                Action::Crash(number) => self.network.nodes_mut()[number].crash(&mut self.eyes.seen),
                Action::Restart(number) if self.network.nodes()[number].robot.is_none() => self.start(number),
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
        for (a, b) in pairs(self.network.ids().len()).filter(|(a, b)| side(*a) != side(*b)) {
            self.close(a, b, is_closed);
        }
    }

    fn close(&mut self, from: usize, to: usize, is_closed: bool) {
        let count = self.closed.entry((from, to)).or_default();
        *count = if is_closed { count.saturating_add(1) } else { count.saturating_sub(1) };
        let is_open = *count == 0;
        let (from, to) = (self.network.ids()[from], self.network.ids()[to]);
        self.network.radio_mut().set_open(from, to, is_open);
    }

    fn start(&mut self, number: usize) {
        // Its own among them: a former run of its own had the same clock, which would be measured through others.
        let known = self.network.nodes().iter().filter(|_| self.eyes.settings.clocks_given);
        let clocks: Vec<_> = known.map(|member| (member.id(), member.settings.clock)).collect();
        let own = self.network.nodes()[number].id();
        if let Err(error) = self.boot(number, &clocks) {
            let found = Finding::new(names::SETTINGS, "settings that a robot takes", error);
            return self.eyes.fail(Some(own), found);
        }
        self.network.call(number, &mut self.eyes, Member::handle_timeout);
    }

    fn boot(&mut self, number: usize, clocks: &[(RobotId, Clock)]) -> Result<(), String> {
        let member = &mut self.network.nodes_mut()[number];
        let run = member.boot(self.eyes.now)?;
        let (stream, salt) = (run.stream, run.salt);
        let clock = member.settings.clock;
        let found = self.eyes.identities.started(stream, salt);
        self.eyes.found(stream.origin, found);
        self.eyes.keys.salts.insert(stream, salt);
        self.eyes.clocks.insert(stream, clock);
        if self.eyes.failure.is_some() {
            return Ok(());
        }
        let member = &mut self.network.nodes_mut()[number];
        member.start(self.eyes.now, run, clocks)?;
        if let Some(robot) = &member.robot {
            member.work.begin(robot);
            // What came from a disk went past no checker yet.
            self.eyes.dirty.extend(robot.fusion().layers().map(|(stream, _)| (number, stream)));
        }
        Ok(())
    }

    /// Lets the outsider send what is due.
    fn attack(&mut self) {
        let Some(outsider) = self.eyes.outsider.as_mut().filter(|outsider| outsider.next <= self.eyes.now)
        else {
            return;
        };
        if let Some((number, attack)) = outsider.attack(self.eyes.now, self.network.nodes().len()) {
            let path = self.eyes.settings.has_paths.then_some(outsider::PATH);
            self.network.call(number, &mut self.eyes, |member, now| {
                member.receive(now, attack.bytes.into(), path, attack.is_genuine);
            });
        }
    }

    /// Cross traffic on a crowded radio, until all agree.
    fn cross_traffic(&self) -> Option<(usize, i64)> {
        let is_over = !matches!(self.phase, Phase::Mapping | Phase::Healing { .. });
        self.eyes.settings.trouble.crowd.filter(|_| !is_over)?.cross_traffic()
    }

    fn send_cross_traffic(&mut self) {
        while let Some((bytes, pause)) =
            self.cross_traffic().filter(|_| self.next_cross_traffic <= self.eyes.now)
        {
            self.network.radio_mut().send_cross_traffic(Stamp(self.next_cross_traffic), bytes);
            self.next_cross_traffic += pause.max(1);
        }
    }

    /// Lets the faulty robot send what is due: in place of a package that the receiver lacks.
    fn burden(&mut self) {
        let Some(costly) = self.costly.as_mut().filter(|costly| costly.next <= self.eyes.now) else { return };
        let (to, from) = costly.pair(self.eyes.now, self.network.nodes().len());
        let nodes = self.network.nodes();
        let (Some(receiver), Some(sender)) = (&nodes[to].robot, &nodes[from].robot) else { return };
        let stream = sender.own_stream();
        let Some(received) = receiver.session().received(stream) else { return };
        let missing = received.missing(1, self.eyes.truth.last(stream)).next();
        let is_peer = receiver.session().peers().any(|peer| peer.stream == stream);
        let Some((index, _)) = missing.filter(|_| is_peer) else { return };
        // It took as long as any other: from the stamps of what comes at once a round trip of half the time
        // would follow.
        let sent_at = self.eyes.now - self.eyes.settings.radio.config.link.delay_micros.max(0);
        let stamp = nodes[from].settings.clock.shows(sent_at);
        let resolution = sender.config().mapper.resolution;
        if let Some(bytes) = costly.datagram(stream, index, stamp, resolution) {
            *self.eyes.seen.entry("packages that cost too much").or_default() += 1;
            let receive = |member: &mut Member, now| member.receive(now, bytes.into(), None, true);
            self.network.call(to, &mut self.eyes, receive);
        }
    }

    fn report(mut self) -> Report {
        let mut seen = core::mem::take(&mut self.eyes.seen);
        if let Some(NewBytes { all, while_much, .. }) = self.eyes.new_bytes {
            let is_flight = |share: Share| u64::from(share.could > 0);
            for (name, count) in [
                ("crowded: bytes that could go out", all.could),
                ("crowded: new bytes", all.new),
                ("crowded: new bytes took 60 %", all.is_enough().into()),
                ("crowded: bytes that could go out while much was missing", while_much.could),
                ("crowded: new bytes while much was missing", while_much.new),
                ("crowded: much was missing", is_flight(while_much)),
                (
                    "crowded: much was missing, and new bytes took 60 %",
                    is_flight(while_much) * u64::from(while_much.is_enough()),
                ),
            ] {
                *seen.entry(name).or_default() += count;
            }
        }
        let mut robots = Vec::new();
        for number in 0..self.network.nodes().len() {
            let traffic = self.network.radio().traffic(self.network.ids()[number]);
            for (name, count) in [
                ("lost by the radio", traffic.lost),
                ("damaged by the radio", traffic.damaged),
                ("radio queue full", traffic.dropped),
            ] {
                *seen.entry(name).or_default() += count;
            }
            let member = &mut self.network.nodes_mut()[number];
            robots.push(member.take_figures(traffic.airtime_micros, &mut seen));
        }
        Report {
            robots,
            command: self.eyes.settings.options.command(),
            settings: seen::settings(&self.eyes.settings),
            events: self.eyes.events,
            mapping_s: self.eyes.settings.mapping as f64 / 1e6,
            agreement_s: self.agreement.map(|micros| micros as f64 / 1e6),
            agreement_within_s: self.agreement_within as f64 / 1e6,
            seen,
            flown_s: self.eyes.now as f64 / 1e6,
            steps: self.eyes.steps,
            failure: self.eyes.failure,
        }
    }
}
