//! The queue of events of a flight, and what each does to a robot.

mod look;
mod work;

use super::broken::Broken;
use super::check::{self, Failure, Finding, names};
use super::clock::Clock;
use super::costly::Costly;
use super::datagram::Keys;
use super::member::{Member, NEVER};
use super::outsider::{self, Outsider};
use super::plan::Action;
use super::report::Report;
use super::settings::{Settings, purpose};
use super::truth::Truth;
use super::world::SmallWorld;
use super::{SwarmOptions, seen};
use crate::random::Random;
use crate::{Faults, IP_UDP_BYTES, Link, RadioConfig, RadioEmulator};
use flockmap::{Path, RobotId, Stream};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// How often it is looked whether all agree, and what is wrong in whole layers, in microseconds.
const LOOK_EVERY: i64 = 50_000;
const LOOK_WHOLE_EVERY: i64 = 1_000_000;
/// Quiet is watched for so many idle periods.
const QUIET_PERIODS: i64 = 3;

/// What a seed decides before the flight begins, in words.
pub fn describe(options: &SwarmOptions) -> Vec<String> {
    seen::settings(&Settings::draw(options))
}

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
        grace: i64,
        /// When it has to be quiet at the latest.
        latest: i64,
    },
    Quiet {
        until: i64,
    },
    Over,
}

/// What a robot is called with.
#[derive(Clone, Copy)]
enum Input<'a> {
    Datagram {
        bytes: &'a [u8],
        path: Option<Path>,
        /// A robot sent it, as it is.
        is_genuine: bool,
    },
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
    broken: Broken,
    outsider: Option<Outsider>,
    costly: Option<Costly>,
    keys: Keys,
    /// What the clock of each run shows.
    clocks: BTreeMap<Stream, Clock>,
    sealed: check::Sealed,
    identities: check::Identities,
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
    /// When packages were sent last.
    last_packages: i64,
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
        // Where there is a key, nobody takes it for a robot.
        let is_costly = settings.trouble.is_costly && settings.key.is_none();
        let costly = is_costly.then(|| Costly::new(Random::new(seed, purpose::COSTLY)));
        let keys = Keys { key: settings.key.clone(), ..Keys::default() };
        Self {
            settings,
            world,
            now: 0,
            phase: Phase::Mapping,
            members,
            radio,
            broken: Broken::new(seed),
            outsider,
            costly,
            keys,
            clocks: BTreeMap::new(),
            sealed: check::Sealed::default(),
            identities: check::Identities::default(),
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
            last_packages: 0,
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
                self.deliver(delivery.from, delivery.to, &delivery.bytes);
            }
            self.attack();
            self.burden();
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
        let costly = self.costly.as_ref().map_or(NEVER, |costly| costly.next);
        let mut next = radio.min(action).min(self.next_look).min(outsider).min(costly);
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
        // Its own among them: a former run of its own had the same clock, and would be measured by way of others.
        let clocks: Vec<_> = match self.settings.clocks_given {
            true => self.members.iter().map(|member| (member.id(), member.settings.clock)).collect(),
            false => Vec::new(),
        };
        let own = self.members[number].id();
        if let Err(error) = self.boot(number, &clocks) {
            let expected = "settings that a robot takes".to_owned();
            return self.fail(Some(own), Finding { checker: names::SETTINGS, expected, found: error });
        }
        self.work(number, Input::Time);
    }

    fn boot(&mut self, number: usize, clocks: &[(RobotId, Clock)]) -> Result<(), String> {
        let member = &mut self.members[number];
        let run = member.boot(self.now)?;
        let (stream, salt) = (run.stream, run.salt);
        let clock = member.settings.clock;
        let found = self.identities.started(stream, salt);
        self.found(stream.origin, found);
        self.keys.salts.insert(stream, salt);
        self.clocks.insert(stream, clock);
        if self.failure.is_some() {
            return Ok(());
        }
        let member = &mut self.members[number];
        member.start(self.now, run, clocks)?;
        if let Some(robot) = &member.robot {
            member.work.begin(robot);
            // What came from a disk went past no checker yet.
            self.dirty.extend(robot.fusion().layers().map(|(stream, _)| (number, stream)));
        }
        Ok(())
    }

    fn deliver(&mut self, from: RobotId, to: RobotId, bytes: &[u8]) {
        if let Some(number) = self.members.iter().position(|member| member.id() == to) {
            let path = self.settings.has_paths.then_some(Path(from.0.into()));
            self.work(number, Input::Datagram { bytes, path, is_genuine: true });
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
            let path = self.settings.has_paths.then_some(outsider::PATH);
            self.work(number, Input::Datagram { bytes: &attack.bytes, path, is_genuine: attack.is_genuine });
        }
    }

    /// Lets the faulty robot send what is due: in place of a package that the receiver lacks.
    fn burden(&mut self) {
        let Some(costly) = self.costly.as_mut().filter(|costly| costly.next <= self.now) else { return };
        if self.phase != Phase::Mapping {
            costly.next = NEVER;
            return;
        }
        let (to, from) = costly.pair(self.now, self.members.len());
        let (Some(receiver), Some(sender)) = (&self.members[to].robot, &self.members[from].robot) else {
            return;
        };
        let stream = sender.own_stream();
        let Some(held) = receiver.session().held(stream) else { return };
        let missing = held.missing(1, self.truth.last(stream)).next();
        let (Some((index, _)), true) =
            (missing, receiver.session().peers().any(|peer| peer.stream == stream))
        else {
            return;
        };
        // It took as long on the way as any other: from the stamps of what comes at once a round trip of half the time would follow.
        let sent_at = self.now - self.settings.radio.delay_micros.max(0);
        let stamp = self.members[from].settings.clock.shows(sent_at);
        let resolution = sender.config().mapper.resolution;
        if let Some(bytes) = costly.datagram(stream, index, stamp, resolution) {
            *self.seen.entry("packages that cost too much").or_default() += 1;
            self.work(to, Input::Datagram { bytes: &bytes, path: None, is_genuine: true });
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
