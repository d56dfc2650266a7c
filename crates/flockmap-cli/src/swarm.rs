//! A swarm in virtual time: robots, their scans, and an emulated radio between them. The same input gives the
//! same bytes.

use std::collections::BTreeMap;
use std::time::Instant;

use anyhow::Context;
use flockmap::{Event, Robot, RobotConfig, RobotId, Stamp, Stream, SubmapId};
use flockmap_io::SubmapPose;
use flockmap_netsim::{Datagram, Delivery, Network, RadioConfig, Watch};

use crate::flight::Flight;
use crate::measure::Times;
use crate::member::Measures;
use crate::picture::MapPicture;
use crate::report::{Member, Run};
use crate::sources::{Frame, Source};
use crate::view::Recorder;

/// After the last scan, virtual time runs on for at most this long until everything has arrived.
pub const SETTLE_MICROS_MAX: i64 = 600_000_000;

/// Runs all robots through their scans, and on until everything has arrived everywhere.
pub fn run(
    sources: Vec<Source>,
    config: impl Fn(RobotId) -> RobotConfig,
    radio: RadioConfig,
) -> anyhow::Result<Run> {
    run_recorded(sources, config, radio, Vec::new())
}

/// The same, seen by recorders: one for each robot, or none.
pub fn run_recorded(
    sources: Vec<Source>,
    config: impl Fn(RobotId) -> RobotConfig,
    radio: RadioConfig,
    mut recorders: Vec<Recorder>,
) -> anyhow::Result<Run> {
    let names: Vec<String> = sources.iter().map(|source| source.name.clone()).collect();
    let mut pictures: Vec<Vec<MapPicture>> = names.iter().map(|_| Vec::new()).collect();
    let mut upcoming = moments(&sources).into_iter().peekable();
    let mut meters = Meters::new(names.len());
    let mut flight = Flight::new(sources, radio, "scans", |id| Ok(Robot::new(config(id), Stamp(0))?))?;
    let ids = flight.network.ids().to_vec();
    while let Some(next) = flight.next_scan() {
        flight.network.step(Some(next), &mut meters);
        flight.take_due(set_submap, |robot, number, now, frame| {
            let inserted = meters.scan(robot, number, &ids, now, &frame);
            inserted.with_context(|| format!("a scan of robot {}", number + 1))
        })?;
        record(&mut recorders, &flight.network, &meters);
        if upcoming.next_if(|moment| *moment <= flight.network.now()).is_some() {
            for (pictures, robot) in pictures.iter_mut().zip(flight.network.nodes()) {
                pictures.push(MapPicture::take(robot, next));
            }
        }
    }
    for number in 0..ids.len() {
        flight.network.call(number, &mut meters, Robot::flush);
    }
    flight.progress.say("repairs".to_owned());
    let last_scan = flight.last_scan;
    let arrived = flight.settle(last_scan.plus_micros(SETTLE_MICROS_MAX), &mut meters, |robots| {
        has_everything(robots) && shows_submaps(robots)
    });
    let Flight { network, frames, .. } = flight;
    for (number, recorder) in recorders.into_iter().enumerate() {
        recorder.finish(network.now(), &network.nodes()[number], &meters.measures[number]);
    }
    let (now, times) = (network.now(), meters.times.map(|times| times.summary()));
    let inputs = names.into_iter().zip(frames).zip(pictures);
    let members = network.into_nodes().into_iter().zip(inputs).zip(meters.measures);
    let members = members.map(|((robot, ((name, frames), mut pictures)), measures)| {
        pictures.push(MapPicture::take(&robot, now));
        Member { name, robot, measures, pictures, scans_damaged: frames.damaged }
    });
    Ok(Run { members: members.collect(), last_scan, arrived, times })
}

fn record(recorders: &mut [Recorder], network: &Network<Robot>, meters: &Meters) {
    for ((recorder, robot), measures) in recorders.iter_mut().zip(network.nodes()).zip(&meters.measures) {
        recorder.note(network.now(), robot, measures);
    }
}

/// Begins a submap if it is a new one, and puts it where it lies.
fn set_submap(robot: &mut Robot, now: Stamp, pose: SubmapPose) -> anyhow::Result<()> {
    let SubmapPose { submap, t_map_submap, .. } = pose;
    let set = |robot: &mut Robot| {
        if robot.submap() < submap {
            robot.begin_submap(now)?;
        }
        robot.set_submap_pose(now, submap, &t_map_submap)
    };
    set(robot).with_context(|| format!("submap {}", submap.number()))
}

/// When pictures are taken: after one and two thirds of the longest source. The end is taken in any case.
fn moments(sources: &[Source]) -> [Stamp; 2] {
    let seconds = sources.iter().map(|source| source.seconds_expected).fold(0.0, f64::max);
    [Stamp::from_seconds(seconds / 3.0), Stamp::from_seconds(seconds * 2.0 / 3.0)]
}

/// Measures what robots do. Robot `i` has the number `i` + 1.
struct Meters {
    measures: Vec<Measures>,
    /// To map a scan, to make packages of a batch, to take in a datagram with packages.
    times: [Times; 3],
    is_datagram: bool,
    started: Instant,
}

impl Meters {
    fn new(robots: usize) -> Self {
        let measures = (0..robots).map(|_| Measures::default()).collect();
        Self { measures, times: Default::default(), is_datagram: false, started: Instant::now() }
    }

    /// Gives a robot what it sees.
    fn scan(
        &mut self,
        robot: &mut Robot,
        number: usize,
        ids: &[RobotId],
        now: Stamp,
        frame: &Frame,
    ) -> anyhow::Result<()> {
        for mate in &frame.team_mates {
            if let Some(id) = ids.get(mate.number) {
                robot.set_teammate(*id, mate.position, now)?;
            }
        }
        let started = Instant::now();
        let report = robot.insert_scan(now, &frame.scan, &frame.pose)?;
        self.times[0].add(started.elapsed());
        self.measures[number].scan(&report, frame.scan.stamp);
        self.measures[number].path.push((frame.scan.stamp, frame.pose.translation()));
        Ok(())
    }
}

impl Watch<Robot> for Meters {
    fn begins(&mut self, now: Stamp, number: usize, _robot: &mut Robot, delivery: Option<&Delivery>) {
        if let Some(delivery) = delivery {
            self.measures[number].received.add(now, delivery.bytes.len() as u64);
        }
        self.is_datagram = delivery.is_some();
        self.started = Instant::now();
    }

    fn called(&mut self, now: Stamp, number: usize, robot: &mut Robot) {
        // Time is counted once for each call.
        let mut took = Some(self.started.elapsed());
        while let Some(event) = robot.poll_event() {
            let times = match &event {
                Event::BatchClosed { .. } if !self.is_datagram => Some(&mut self.times[1]),
                Event::Merged { .. } if self.is_datagram => Some(&mut self.times[2]),
                _ => None,
            };
            if let Some(times) = times
                && let Some(took) = took.take()
            {
                times.add(took);
            }
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

/// The newest package of each robot.
pub fn newest(robots: &[Robot]) -> BTreeMap<Stream, u32> {
    let newest = |robot: &Robot| robot.session().store().newest_known(robot.own_stream());
    robots.iter().map(|robot| (robot.own_stream(), newest(robot))).collect()
}

/// Whether every robot has received all packages up to these.
pub fn have_all(robots: &[Robot], newest: &BTreeMap<Stream, u32>) -> bool {
    let has = |robot: &Robot, (stream, newest): (&Stream, &u32)| {
        let received = robot.session().received(*stream);
        *newest == 0 || received.is_some_and(|received| received.prefix() >= *newest)
    };
    robots.iter().all(|robot| newest.iter().all(|newest| has(robot, newest)))
}

/// Whether every robot has received all packages of every other.
pub fn has_everything(robots: &[Robot]) -> bool {
    have_all(robots, &newest(robots))
}

/// Whether every robot has the submaps of all where these have put them, and shows them so.
pub fn shows_submaps(robots: &[Robot]) -> bool {
    let are_moved = robots.iter().any(|robot| robot.counters().submap_poses > 0);
    let has_all_of = |robot: &Robot, other: &Robot| {
        let mut submaps = (0..=other.submap().number()).filter_map(SubmapId::new);
        let stream = other.own_stream();
        submaps.all(|id| robot.fusion().submap_pose(stream, id) == other.submap_pose(id))
    };
    let shows_all =
        |robot: &Robot| !robot.is_rebuilding() && robots.iter().all(|other| has_all_of(robot, other));
    !are_moved || robots.iter().all(shows_all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sources::Frames;
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
    fn robots_that_know_of_each_other_do_not_map_each_other() {
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
