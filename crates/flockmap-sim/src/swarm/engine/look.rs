//! What is done now and then: links heal, all have to agree, it has to be quiet, and whole layers are looked at.

use super::{Engine, LOOK_EVERY, LOOK_WHOLE_EVERY, Phase, QUIET_PERIODS};
use crate::swarm::check::{self, Finding, names};
use crate::swarm::preset::Topology;
use crate::{Faults, Link};
use flockmap::{Robot, RobotId};
use std::collections::BTreeMap;

impl Engine {
    /// What is done now and then.
    pub(super) fn look(&mut self) {
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
            Phase::Grace { until, grace, latest }
                if self.now >= until && self.last_packages + grace > self.now && self.now < latest =>
            {
                let until = (self.last_packages + grace).min(latest);
                self.phase = Phase::Grace { until, grace, latest };
                self.next_look = until;
            }
            Phase::Grace { until, .. } if self.now >= until => {
                let longest =
                    self.members.iter().map(|m| check::period_micros(&m.settings.config.session)).max();
                let until = self.now + QUIET_PERIODS * longest.unwrap_or(0);
                self.members.iter_mut().for_each(|member| member.quiet.begin(self.now));
                self.phase = Phase::Quiet { until };
                self.next_look = until;
            }
            Phase::Grace { until, .. } => self.next_look = until,
            Phase::Quiet { until } if self.now >= until => {
                self.look_at_everything();
                self.phase = Phase::Over;
            }
            Phase::Quiet { until } => self.next_look = until,
        }
    }

    /// Mapping ends, links heal.
    pub(super) fn heal(&mut self) {
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
        if numbers.topology != Topology::Full || self.settings.trouble.restarts > 0 {
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
        let may_begin_anew = self.settings.trouble.has_epochs_of_clocks();
        // What is not packed yet is as much again at the most.
        let told = (2 * bytes + 10_000, 2 * packages + 10);
        self.agreement_within = check::bound(&robots, hops, told, may_begin_anew, self.broken.packages_max());
        if let Some(seconds) = self.settings.options.until_agreement_s {
            self.agreement_within = i64::from(seconds) * 1_000_000;
        }
        self.phase = Phase::Healing { until: self.now + self.agreement_within };
        self.events.push((self.now as f64 / 1e6, "mapping ends, links heal".to_owned()));
    }

    pub(super) fn robots(&self) -> Vec<&Robot> {
        self.members.iter().filter_map(|member| member.robot.as_ref()).collect()
    }

    /// The runs that robots which fly have forgotten.
    fn forgotten(&self) -> check::Forgotten {
        let members = self.members.iter().filter(|member| member.robot.is_some());
        members.flat_map(|member| member.forgotten.iter().map(|(run, is_cut)| (*run, *is_cut))).collect()
    }

    pub(super) fn look_for_agreement(&mut self, until: i64) {
        let robots = self.robots();
        // Not everything is packed yet.
        let pending = robots.iter().find(|robot| robot.untold() > 0);
        let pending = pending.map(|robot| (robot.own_stream().origin, "its own newest cycle".to_owned()));
        let lacks = pending
            .or_else(|| check::superseded(&robots))
            .or_else(|| check::disagreement(&self.truth, &robots, &self.forgotten()));
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
        // What waits at the radio is sent first: who hears an old request answers it.
        let waiting = self.radio.last_due().map_or(0, |last| (last.0 - self.now).max(0));
        let travel = self.settings.radio.delay_micros + self.settings.radio.jitter_micros;
        let grace = grace.unwrap_or(0) + waiting + 4 * travel;
        let leaves_out = check::leaves_out(&self.truth, &self.robots(), &self.forgotten());
        let more = if leaves_out { self.agreement_within } else { 0 };
        let grace = if leaves_out { grace + check::pause_of_relays(&self.robots()) } else { grace };
        self.phase = Phase::Grace { until: self.now + grace, grace, latest: self.now + grace + more };
    }

    pub(super) fn look_at_dirty_layers(&mut self) {
        for (number, stream) in core::mem::take(&mut self.dirty) {
            let Some(robot) = &self.members[number].robot else { continue };
            let found = check::whole_voxels(&self.truth, robot, stream)
                .or_else(|| check::whole_layer(&self.truth, robot, stream));
            let id = robot.own_stream().origin;
            self.found(id, found);
        }
    }

    /// All layers as a whole, and the fused maps.
    pub(super) fn look_at_everything(&mut self) {
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
}
