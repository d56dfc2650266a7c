//! What is done now and then: links heal, all have to agree, it has to be quiet, and whole layers are looked at.

use super::{Engine, LOOK_EVERY, LOOK_WHOLE_EVERY, Phase, QUIET_PERIODS, pairs};
use crate::swarm::check::{self, Finding, names};
use crate::swarm::crowd::missing_bytes;
use crate::swarm::member::NEVER;
use crate::swarm::preset::Topology;
use crate::{Link, Node};
use flockmap::{Robot, RobotId, SessionConfig};
use std::collections::BTreeMap;

impl Engine {
    /// What is done now and then.
    pub(super) fn look(&mut self) {
        self.next_look = self.eyes.now + LOOK_EVERY;
        self.look_for_new_bytes();
        if self.next_whole_look <= self.eyes.now {
            self.next_whole_look = self.eyes.now + LOOK_WHOLE_EVERY;
            self.look_at_dirty_layers();
        }
        match self.phase {
            Phase::Mapping if self.eyes.now >= self.eyes.settings.mapping => self.heal(),
            Phase::Mapping | Phase::Over => {
                self.next_look = self.next_look.min(self.eyes.settings.mapping.max(self.eyes.now + 1))
            }
            Phase::Healing { until } => self.look_for_agreement(until),
            Phase::Grace { until, grace, latest }
                if self.eyes.now >= until
                    && self.eyes.last_packages + grace > self.eyes.now
                    && self.eyes.now < latest =>
            {
                let until = (self.eyes.last_packages + grace).min(latest);
                self.phase = Phase::Grace { until, grace, latest };
                self.next_look = until;
            }
            Phase::Grace { until, .. } if self.eyes.now >= until => {
                let until = self.eyes.now + QUIET_PERIODS * self.longest(check::period_micros);
                self.network.nodes_mut().iter_mut().for_each(|member| member.quiet.begin(self.eyes.now));
                self.phase = Phase::Quiet { until };
                self.next_look = until;
            }
            Phase::Grace { until, .. } => self.next_look = until,
            Phase::Quiet { until } if self.eyes.now >= until => {
                self.look_at_everything();
                self.phase = Phase::Over;
            }
            Phase::Quiet { until } => self.next_look = until,
        }
    }

    /// On a crowded radio: what could have gone out while something was missing.
    fn look_for_new_bytes(&mut self) {
        let Some(crowd) = self.eyes.settings.trouble.crowd else { return };
        // As long as links are closed, nothing may be able to flow.
        if matches!(self.phase, Phase::Healing { .. })
            && check::disagreement(&self.eyes.truth, &self.robots(), &self.forgotten()).is_some()
        {
            let missing = missing_bytes(&self.eyes.truth, &self.robots(), self.eyes.settings.cast);
            let can_send = crowd.can_send(self.network.nodes().len());
            self.eyes.new_bytes.iter_mut().for_each(|new| new.missed(missing, LOOK_EVERY, can_send));
        }
    }

    /// Mapping ends, links heal.
    pub(super) fn heal(&mut self) {
        let numbers = self.eyes.settings.radio;
        let Link { delay_micros, jitter_micros, .. } = numbers.config.link;
        let link = Link { delay_micros, jitter_micros, ..Link::PERFECT };
        let count = self.network.nodes().len();
        for (a, b) in pairs(count) {
            let (from, to) = (self.network.ids()[a], self.network.ids()[b]);
            self.network.radio_mut().set_link(from, to, link);
            self.network.radio_mut().set_open(from, to, numbers.is_linked(a, b, count));
        }
        self.next_action = self.eyes.settings.plan.len();
        self.eyes.outsider.iter_mut().for_each(|outsider| outsider.next = NEVER);
        self.costly.iter_mut().for_each(|costly| costly.next = NEVER);
        // Who is gone stays gone only where nobody is heard through it.
        if numbers.topology != Topology::Full || self.eyes.settings.trouble.restarts > 0 {
            for number in 0..count {
                if self.network.nodes()[number].robot.is_none() {
                    self.eyes.say(format!("restart of {:?}", self.network.ids()[number]));
                    self.start(number);
                }
            }
        }
        let truth = &self.eyes.truth;
        let bytes: u64 = truth.streams().map(|(_, published)| published.bytes).sum();
        let packages: u64 = truth.streams().map(|(stream, _)| u64::from(truth.last(stream))).sum();
        let trouble = &self.eyes.settings.trouble;
        let may = [trouble.has_epochs_of_clocks(), trouble.has_small_layers];
        // What is not packed yet is as much again at the most.
        let published = (2 * bytes + 10_000, 2 * packages + 10);
        let hops = numbers.hops(count);
        let damaged = self.eyes.broken.packages_max();
        let found = self.found().filter(|_| trouble.crowd.is_some());
        let configs: Vec<SessionConfig> =
            self.robots().iter().map(|robot| with_rate(robot.session().config(), found)).collect();
        self.agreement_within = check::bound(&configs, hops, published, may, damaged);
        if let Some(seconds) = self.eyes.settings.options.until_agreement_s {
            self.agreement_within = i64::from(seconds) * 1_000_000;
        }
        self.eyes.is_mapping = false;
        self.phase = Phase::Healing { until: self.eyes.now + self.agreement_within };
        self.eyes.say("mapping ends, links heal".to_owned());
    }

    /// The longest that some time of a session is, of all robots. Who has no budget finds what the radio carries: of one
    /// that is shared at least half of its share.
    fn longest(&self, micros: impl Fn(&SessionConfig) -> i64) -> i64 {
        let nodes = self.network.nodes();
        let longest =
            nodes.iter().map(|member| micros(&with_rate(&member.settings.config.session, self.found())));
        longest.max().unwrap_or(0)
    }

    /// A rate that each robot finds at least.
    fn found(&self) -> Option<u32> {
        let radio = &self.eyes.settings.radio.config;
        let rate = radio.rate_bytes_per_s.filter(|_| radio.is_shared)?;
        let rate = self.eyes.settings.trouble.crowd.map_or(rate, |crowd| crowd.for_robots());
        Some((rate / (2 * self.network.nodes().len() as u32)).max(20))
    }

    pub(super) fn robots(&self) -> Vec<&Robot> {
        self.network.nodes().iter().filter_map(|member| member.robot.as_ref()).collect()
    }

    /// The runs that robots which fly have forgotten.
    fn forgotten(&self) -> check::Forgotten {
        let members = self.network.nodes().iter().filter(|member| member.robot.is_some());
        members.flat_map(|member| member.forgotten.iter().map(|(run, is_cut)| (*run, *is_cut))).collect()
    }

    pub(super) fn look_for_agreement(&mut self, until: i64) {
        let robots = self.robots();
        // Not everything is packed yet.
        let pending = robots.iter().find(|robot| robot.unpublished() > 0);
        let pending = pending.map(|robot| (robot.own_stream().origin, "its own newest batch".to_owned()));
        let lacks = pending
            .or_else(|| check::superseded(&robots))
            .or_else(|| check::disagreement(&self.eyes.truth, &robots, &self.forgotten()));
        if let Some((robot, lacks)) = lacks {
            if self.eyes.now >= until && self.eyes.settings.options.until_agreement_s.is_some() {
                self.phase = Phase::Over;
            } else if self.eyes.now >= until {
                let within = self.agreement_within as f64 / 1e6;
                let expected = format!("all packages everywhere {within:.1} s after links healed");
                let found = Finding::new(names::AGREEMENT, expected, format!("it lacks {lacks}"));
                self.eyes.fail(Some(robot), found);
            }
            return;
        }
        self.agreement = Some(self.eyes.now - self.eyes.settings.mapping);
        self.eyes.say("all agree".to_owned());
        self.look_at_everything();
        if self.eyes.settings.options.until_agreement_s.is_some() {
            self.phase = Phase::Over;
            return;
        }
        // What waits at the radio is sent first: who hears an old request answers it.
        let waiting = self.network.radio().last_due().map_or(0, |last| (last.0 - self.eyes.now).max(0));
        let link = self.eyes.settings.radio.config.link;
        let travel = link.delay_micros + link.jitter_micros;
        let is_crowded = self.eyes.settings.trouble.crowd.is_some();
        let grace = self.longest(check::Quiet::grace_micros) + waiting + 4 * travel;
        let leaves_out = check::leaves_out(&self.eyes.truth, &self.robots(), &self.forgotten());
        let more = if leaves_out { self.agreement_within } else { 0 };
        let grace =
            if leaves_out { grace + check::pause_of_relays(&self.robots(), is_crowded) } else { grace };
        self.phase =
            Phase::Grace { until: self.eyes.now + grace, grace, latest: self.eyes.now + grace + more };
    }

    pub(super) fn look_at_dirty_layers(&mut self) {
        for (number, stream) in core::mem::take(&mut self.eyes.dirty) {
            let Some(robot) = &self.network.nodes()[number].robot else { continue };
            let found = check::whole(&self.eyes.truth, robot, stream);
            self.eyes.found(robot.own_stream().origin, found);
        }
    }

    /// All layers as a whole, and the fused maps.
    pub(super) fn look_at_everything(&mut self) {
        let robots = self.robots();
        let mut findings = Vec::new();
        let clocks: BTreeMap<RobotId, i64> =
            self.network.nodes().iter().map(|member| (member.id(), member.settings.clock.offset)).collect();
        for robot in &robots {
            let own = robot.own_stream();
            for (stream, _) in robot.fusion().layers() {
                let found = check::whole(&self.eyes.truth, robot, stream);
                findings.extend(found.map(|found| (own.origin, found)));
            }
            let ahead = |other: RobotId| {
                let known = if self.eyes.settings.clocks_given { clocks.get(&other) } else { None };
                known.map(|theirs| clocks[&own.origin] - theirs)
            };
            findings.extend(check::wrong_fused(robot, ahead).map(|found| (own.origin, found)));
        }
        for member in self.network.nodes() {
            let (Some(origin), Some(moves)) = (&member.robot, &member.moves) else { continue };
            for robot in &robots {
                let found = check::wrong_poses(robot, origin.own_stream(), moves.poses());
                findings.extend(found.map(|found| (robot.own_stream().origin, found)));
            }
        }
        if let Some((robot, found)) = check::unequal_layer(&robots) {
            let expected = "equal layers, since all packages are received";
            findings.push((robot, Finding::new(names::AGREEMENT, expected, found)));
        }
        findings.into_iter().for_each(|(robot, found)| self.eyes.fail(Some(robot), found));
    }
}

/// The options of a robot that finds this rate, if it finds one.
fn with_rate(session: &SessionConfig, found: Option<u32>) -> SessionConfig {
    let found = found.filter(|_| session.congestion_control);
    let radio_bytes_per_s = session.radio_bytes_per_s.into_iter().chain(found).min();
    SessionConfig { radio_bytes_per_s, ..session.clone() }
}
