//! A swarm in virtual time: robots, their scans, and an emulated radio between them. The same input gives the same bytes.

use std::time::Instant;

use anyhow::Context;
use flockmap::{Event, PoseError, Robot, RobotConfig, RobotId, Stamp};
use flockmap_netsim::{Datagram, Delivery, Network, RadioConfig, Watch};

use crate::measure::Times;
use crate::member::Measures;
use crate::picture::MapPicture;
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
    pub snapshots: Vec<MapPicture>,
    pub frames_damaged: u64,
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
    let mut upcoming = moments(&sources).into_iter().peekable();
    let (mut robots, mut inputs) = (Vec::new(), Vec::new());
    for (number, source) in sources.into_iter().enumerate() {
        robots.push(Robot::new(config(RobotId(number as u16 + 1)), Stamp(0))?);
        inputs.push(Input { name: source.name, frames: source.frames, pictures: Vec::new() });
    }
    let mut meters = Meters::new(robots.len());
    let mut network = Network::new(robots, radio, Stamp(0));
    let mut last_scan = Stamp(0);
    while let Some(next) = inputs.iter_mut().filter_map(|input| input.frames.next_stamp()).min() {
        if stop::requested() {
            break;
        }
        network.step(Some(next), &mut meters);
        let now = network.now();
        if next <= now {
            last_scan = now;
            for (number, input) in inputs.iter_mut().enumerate() {
                while input.frames.next_stamp().is_some_and(|at| at <= now) {
                    let scan = input.insert_scan(&mut network, number, &mut meters.measures[number]);
                    scan.with_context(|| format!("a scan of robot {}", number + 1))?;
                    progress.step();
                }
            }
        }
        if upcoming.next_if(|moment| *moment <= now).is_some() {
            for (input, robot) in inputs.iter_mut().zip(network.nodes()) {
                input.pictures.push(MapPicture::take(robot, next));
            }
        }
    }
    for number in 0..inputs.len() {
        network.call(number, &mut meters, Robot::flush);
    }
    progress.say("repairs".to_owned());
    let until = last_scan.plus_micros((SETTLE_SECONDS_MAX * 1e6) as i64);
    let arrived = loop {
        if has_everything(network.nodes()) {
            break Some(network.now());
        }
        if network.now() > until || stop::requested() {
            break None;
        }
        network.step(None, &mut meters);
    };
    let now = network.now();
    let members = network.into_nodes().into_iter().zip(inputs).zip(meters.measures);
    let members = members.map(|((robot, mut input), measures)| {
        input.pictures.push(MapPicture::take(&robot, now));
        let (name, snapshots, frames_damaged) = (input.name, input.pictures, input.frames.damaged);
        Member { name, robot, measures, snapshots, frames_damaged }
    });
    Ok(Run { members: members.collect(), last_scan, arrived })
}

/// When pictures are taken: after one and two thirds of the longest source. The end is taken in any case.
fn moments(sources: &[Source]) -> [Stamp; 2] {
    let seconds = sources.iter().map(|source| source.seconds_expected).fold(0.0, f64::max);
    [Stamp::from_seconds(seconds / 3.0), Stamp::from_seconds(seconds * 2.0 / 3.0)]
}

/// What a robot sees.
struct Input {
    name: String,
    frames: Frames,
    pictures: Vec<MapPicture>,
}

impl Input {
    fn insert_scan(
        &mut self,
        network: &mut Network<Robot>,
        number: usize,
        measures: &mut Measures,
    ) -> Result<(), PoseError> {
        let (now, ids) = (network.now(), network.ids().to_vec());
        let robot = &mut network.nodes_mut()[number];
        if let Some(frame) = self.frames.next() {
            for mate in &frame.team_mates {
                if let Some(id) = ids.get(mate.number) {
                    robot.set_teammate(*id, mate.position, now)?;
                }
            }
            let started = Instant::now();
            let report = robot.insert_scan(now, &frame.scan, &frame.pose)?;
            measures.scan(Some(started.elapsed()), &report, frame.scan.stamp);
        }
        Ok(())
    }
}

/// Measures what robots do. Robot `i` has the number `i` + 1.
struct Meters {
    measures: Vec<Measures>,
    is_datagram: bool,
    started: Instant,
}

impl Meters {
    fn new(robots: usize) -> Self {
        let measures = (0..robots).map(|_| Measures::default()).collect();
        Self { measures, is_datagram: false, started: Instant::now() }
    }
}

impl Watch<Robot> for Meters {
    fn begins(&mut self, now: Stamp, number: usize, _robot: &mut Robot, delivery: Option<&Delivery>) {
        if let Some(delivery) = delivery {
            self.measures[number].datagram_received(now, delivery.bytes.len());
        }
        self.is_datagram = delivery.is_some();
        self.started = Instant::now();
    }

    fn called(&mut self, now: Stamp, number: usize, robot: &mut Robot) {
        let took = self.started.elapsed();
        match self.is_datagram {
            true => self.measures[number].datagram_input(took),
            false => self.measures[number].own_input(took),
        }
        while let Some(event) = robot.poll_event() {
            if let Event::Merged { stream, changes, .. } = &event
                && let sender = usize::from(stream.origin.0).wrapping_sub(1)
                && let Ok([receiver, sender]) = self.measures.get_disjoint_mut([number, sender])
            {
                // The age counts from the scan that the sender made the voxel of.
                receiver.ages.add(now, changes, &sender.onset);
            }
            self.measures[number].event(now, &event);
        }
    }

    fn sent(&mut self, now: Stamp, number: usize, _: &mut Robot, datagram: &mut Datagram, copies: usize) {
        self.measures[number].datagram_sent(now, datagram.bytes.len(), copies as u64);
    }
}

/// Whether every robot holds all packages of every other.
fn has_everything(robots: &[Robot]) -> bool {
    robots.iter().all(|receiver| {
        robots.iter().all(|sender| {
            let packages = sender.counters().packages;
            let held = receiver.session().received(sender.own_stream());
            packages == 0 || held.is_some_and(|held| u64::from(held.prefix()) >= packages)
        })
    })
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
