//! A swarm in virtual time: robots, their scans, and an emulated radio between them. The same input gives the same bytes.

use std::time::Instant;

use anyhow::Context;
use flockmap::{Cast, Destination, Event, PoseError, Robot, RobotConfig, RobotId, Stamp};
use flockmap_netsim::{RadioConfig, RadioEmulator, To};

use crate::measure::Times;
use crate::member::Measures;
use crate::picture::Snapshot;
use crate::program::command_line;
use crate::progress::Progress;
use crate::report::{Course, Finished, Report, Settings};
use crate::sources::{Frames, Source};
use crate::stop;

/// After the last scan, virtual time runs on for at most this long until everything has arrived.
const SETTLE_SECONDS_MAX: f64 = 600.0;

/// One robot of the swarm with what is measured of it.
pub struct Member {
    pub name: String,
    pub robot: Robot,
    pub measures: Measures,
    /// Its map at three moments.
    pub snapshots: Vec<Snapshot>,
    pub frames_damaged: u64,
    frames: Frames,
    next_scan: Option<Stamp>,
}

/// How a run went.
pub struct Run {
    pub members: Vec<Member>,
    /// Time of the last scan.
    pub last_scan: Stamp,
    /// When everything had arrived everywhere; `None` if it has not.
    pub arrived: Option<Stamp>,
}

impl Run {
    /// What it comes to.
    pub fn report(&self, title: String, settings: Settings) -> anyhow::Result<Report> {
        let times = |of: fn(&Measures) -> &Times| {
            Times::together(self.members.iter().map(|m| of(&m.measures))).summary()
        };
        let course = Course {
            command: command_line(),
            title,
            record_s: self.last_scan.seconds(),
            settle_s: self.arrived.map(|at| at.micros_since(self.last_scan).max(0) as f64 / 1e6),
            interrupted: stop::requested(),
            t_map: times(|m| &m.map),
            t_pack: times(|m| &m.pack),
            t_recv2insert: times(|m| &m.insert),
        };
        let finished: Vec<Finished<'_>> = self
            .members
            .iter()
            .map(|m| Finished {
                name: &m.name,
                robot: &m.robot,
                measures: &m.measures,
                snapshots: &m.snapshots,
                scans_damaged: m.frames_damaged,
            })
            .collect();
        Report::new(course, settings, &finished)
    }
}

/// Runs all robots through their scans, and on until everything has arrived everywhere.
pub fn run(
    sources: Vec<Source>,
    config: impl Fn(RobotId) -> RobotConfig,
    radio: RadioConfig,
) -> anyhow::Result<Run> {
    let expected = sources.iter().map(|source| source.frames_expected).sum();
    let progress = Progress::new("scans", expected);
    let moments = moments(&sources);
    let mut members = Vec::new();
    for (number, source) in sources.into_iter().enumerate() {
        let config = config(RobotId(number as u16 + 1));
        let mut frames = source.frames;
        members.push(Member {
            name: source.name,
            robot: Robot::new(config, Stamp(0))?,
            measures: Measures::default(),
            snapshots: Vec::new(),
            frames_damaged: 0,
            next_scan: frames.next_stamp(),
            frames,
        });
    }
    let radio = RadioEmulator::new(members.iter().map(|m| m.robot.own_stream().origin), radio);
    let mut swarm = Swarm { members, radio, now: Stamp(0), stuck: 0 };
    let mut last_scan = Stamp(0);
    let mut upcoming = moments.into_iter().peekable();
    while let Some(next) = swarm.members.iter().filter_map(|m| m.next_scan).min() {
        if stop::requested() {
            break;
        }
        swarm.advance(Some(next));
        if next <= swarm.now {
            last_scan = swarm.now;
            for number in 0..swarm.members.len() {
                while swarm.members[number].next_scan.is_some_and(|at| at <= swarm.now) {
                    swarm.insert_scan(number).with_context(|| format!("a scan of robot {}", number + 1))?;
                    progress.step();
                }
            }
        }
        if upcoming.next_if(|moment| *moment <= swarm.now).is_some() {
            swarm.members.iter_mut().for_each(|m| m.snapshots.push(Snapshot::take(&m.robot, next)));
        }
    }
    for member in &mut swarm.members {
        member.frames_damaged = member.frames.damaged;
        let started = Instant::now();
        member.robot.flush(swarm.now);
        member.measures.own_input(started.elapsed());
        member.drain_events(swarm.now);
    }
    progress.say("repairs".to_owned());
    let until = last_scan.plus_micros((SETTLE_SECONDS_MAX * 1e6) as i64);
    let arrived = loop {
        swarm.transmit();
        if swarm.has_everything() {
            break Some(swarm.now);
        }
        if swarm.now > until || stop::requested() {
            break None;
        }
        swarm.advance(None);
    };
    swarm.members.iter_mut().for_each(|m| m.snapshots.push(Snapshot::take(&m.robot, swarm.now)));
    Ok(Run { members: swarm.members, last_scan, arrived })
}

/// When pictures are taken: after one and two thirds of the longest source. The end is taken in any case.
fn moments(sources: &[Source]) -> [Stamp; 2] {
    let seconds = sources.iter().map(|source| source.seconds_expected).fold(0.0, f64::max);
    [Stamp::from_seconds(seconds / 3.0), Stamp::from_seconds(seconds * 2.0 / 3.0)]
}

struct Swarm {
    members: Vec<Member>,
    radio: RadioEmulator,
    now: Stamp,
    /// How often nothing was due later than now.
    stuck: u32,
}

impl Swarm {
    /// Goes on to the next thing that is due, but not beyond `until`, and lets everything happen that is due then.
    fn advance(&mut self, until: Option<Stamp>) {
        let timeout = self.members.iter().filter_map(|m| m.robot.poll_timeout()).min();
        let next = [until, timeout, self.radio.next_due()].into_iter().flatten().min();
        let next = next.unwrap_or_else(|| self.now.plus_micros(100_000));
        if next > self.now {
            self.now = next;
            self.stuck = 0;
        } else {
            // Due now again and again: let a millisecond pass, as a real clock would.
            self.stuck += 1;
            if self.stuck > 100 {
                self.now = self.now.plus_micros(1_000);
            }
        }
        while let Some(delivery) = self.radio.deliver_due(self.now) {
            let to = delivery.to;
            if let Some(member) = self.members.iter_mut().find(|m| m.robot.own_stream().origin == to) {
                member.measures.datagram_received(self.now, delivery.bytes.len());
                let started = Instant::now();
                // Errors are counted by the session.
                let _ = member.robot.handle_datagram(self.now, &delivery.bytes);
                member.measures.datagram_input(started.elapsed());
            }
            self.drain_events();
        }
        for member in &mut self.members {
            if member.robot.poll_timeout().is_some_and(|at| at <= self.now) {
                let started = Instant::now();
                member.robot.handle_timeout(self.now);
                member.measures.own_input(started.elapsed());
            }
        }
        self.drain_events();
        self.transmit();
    }

    fn insert_scan(&mut self, number: usize) -> Result<(), PoseError> {
        let ids: Vec<RobotId> = self.members.iter().map(|m| m.robot.own_stream().origin).collect();
        let member = &mut self.members[number];
        if let Some(frame) = member.frames.next() {
            for mate in &frame.team_mates {
                if let Some(id) = ids.get(mate.number) {
                    member.robot.set_teammate(*id, mate.position, self.now)?;
                }
            }
            let started = Instant::now();
            let report = member.robot.insert_scan(self.now, &frame.scan, &frame.pose)?;
            member.measures.scan(Some(started.elapsed()), &report, frame.scan.stamp);
        }
        member.next_scan = member.frames.next_stamp();
        Ok(())
    }

    fn transmit(&mut self) {
        let ids: Vec<RobotId> = self.members.iter().map(|m| m.robot.own_stream().origin).collect();
        for member in &mut self.members {
            let own = member.robot.own_stream().origin;
            while let Some(transmit) = member.robot.poll_transmit(self.now) {
                let broadcast = member.robot.config().session.cast == Cast::Broadcast;
                match transmit.to {
                    Destination::Peer(peer) => {
                        member.measures.datagram_sent(self.now, transmit.bytes.len(), 1);
                        self.radio.send(self.now, own, To::Node(peer), &transmit.bytes);
                    }
                    Destination::Everyone if broadcast => {
                        member.measures.datagram_sent(self.now, transmit.bytes.len(), 1);
                        self.radio.send(self.now, own, To::All, &transmit.bytes);
                    }
                    Destination::Everyone => {
                        member.measures.datagram_sent(self.now, transmit.bytes.len(), ids.len() as u64 - 1);
                        for peer in ids.iter().filter(|id| **id != own) {
                            self.radio.send(self.now, own, To::Node(*peer), &transmit.bytes);
                        }
                    }
                }
            }
        }
    }

    /// Lets each member note its own cycles and what it merged of the others'.
    fn drain_events(&mut self) {
        for number in 0..self.members.len() {
            while let Some(event) = self.members[number].robot.poll_event() {
                if let Event::Merged { stream, changes, .. } = &event {
                    // The age counts from the scan that the sender made the voxel of.
                    let sender = self.members.iter().position(|m| m.robot.own_stream() == *stream);
                    if let Some(sender) = sender
                        && sender != number
                        && let Ok([receiver, sender]) = self.members.get_disjoint_mut([number, sender])
                    {
                        receiver.measures.ages.add(self.now, changes, &sender.measures.onset);
                    }
                }
                self.members[number].measures.event(self.now, &event);
            }
        }
    }

    /// Whether every robot holds all packages of every other.
    fn has_everything(&self) -> bool {
        self.members.iter().all(|receiver| {
            self.members.iter().all(|sender| {
                let packages = sender.robot.counters().packages;
                let held = receiver.robot.session().held(sender.robot.own_stream());
                packages == 0 || held.is_some_and(|held| u64::from(held.prefix()) >= packages)
            })
        })
    }
}

impl Member {
    fn drain_events(&mut self, now: Stamp) {
        while let Some(event) = self.robot.poll_event() {
            self.measures.event(now, &event);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sources::Frame;
    use crate::team::TeamMate;
    use flockmap::{Pose, Resolution, Scan, State, Voxel};

    /// Two robots that hover 3 m apart and have each other in every scan, half a metre above the ground.
    fn hovering(masked: bool) -> Vec<Source> {
        let robot = |number: i64| {
            let (x, other) = (3.0 * number as f64, if number == 0 { 2.95 } else { -2.85 });
            let frames = (1..=5).map(move |scan| {
                let points = vec![[other, 0.05, 0.0], [0.05, 0.05, -0.55]];
                let scan = Scan { stamp: Stamp(scan * 100_000), points, no_returns: Vec::new() };
                let mate = TeamMate { number: 1 - number as usize, position: [3.0 - x, 0.0, 0.5] };
                let team_mates = if masked { vec![mate] } else { Vec::new() };
                Ok(Frame { scan, pose: Pose::from_yaw([x, 0.0, 0.5], 0.0), team_mates })
            });
            Source {
                name: format!("robot{}", number + 1),
                frames_expected: 5,
                seconds_expected: 0.5,
                frames: Frames::new(frames),
            }
        };
        (0..2).map(robot).collect()
    }

    #[test]
    fn robots_that_are_told_of_each_other_do_not_map_each_other() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let config = |id| RobotConfig::new(id, resolution, 7.0);
        for (masked, seen) in [(true, State::Unknown), (false, State::Occupied)] {
            let run = run(hovering(masked), config, RadioConfig::default()).unwrap();
            assert!(run.arrived.is_some());
            for (member, other) in run.members.iter().zip([29, 1]) {
                let own = member.robot.mapper();
                assert_eq!(own.state(Voxel::new(other, 0, 5)), seen, "{}", member.name);
                let ground = member.robot.map().state_at([0.05, 0.05, -0.05]);
                assert_eq!(ground, State::Occupied, "the ground is there for everyone");
                assert_eq!(member.robot.counters().points_masked, if masked { 5 } else { 0 });
            }
        }
    }
}
