//! A swarm of RACER's robots in virtual time, beside [`flockmap_cli::swarm`]: the same frames, the same radio.

use std::collections::BTreeMap;

use flockmap::grid::{BlockIndex, Changes, Layer, StateBlock};
use flockmap::{RobotId, Stamp};
use flockmap_cli::measure::{AgesByState, Comparison, SentBytes};
use flockmap_cli::progress::Progress;
use flockmap_cli::sources::{Frames, Source};
use flockmap_cli::stop;
use flockmap_netsim::{Addressees, Datagram, Delivery, Network, Node, RadioConfig, Watch};

use crate::baselines::racer_code::{RacerCast, RacerConfig, RacerEvent, RacerRobot, Topic};

/// After the last scan, virtual time runs on for at most this long until everything that is ever sent has arrived.
const SETTLE_SECONDS_MAX: f64 = 600.0;

/// One robot with what is measured of it.
pub struct RivalMember {
    pub robot: RacerRobot,
    /// Messages that went out; a copy to each of several robots counts each.
    pub sent: SentBytes,
    /// Of these, announcements of what is held.
    #[cfg_attr(not(test), expect(dead_code, reason = "tests look at it"))]
    pub announced: SentBytes,
    pub datagrams: u64,
    /// Ages of what was taken in of others.
    #[cfg_attr(not(test), expect(dead_code, reason = "tests look at it"))]
    pub ages: AgesByState,
    /// State and stamp of the scan that set it, of every voxel that the own sensor has seen.
    pub onset: Layer,
}

/// How a run went.
pub struct RivalRun {
    pub members: Vec<RivalMember>,
    /// Time of the last scan.
    pub last_scan: Stamp,
    /// When every chunk had arrived everywhere; `None` if it has not.
    #[cfg_attr(not(test), expect(dead_code, reason = "tests look at it"))]
    pub arrived: Option<Stamp>,
}

/// How far what others know of what a robot saw is what it knows, over all pairs of robots.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RivalAgreement {
    /// Voxels known to the one who saw them, or told.
    pub compared: Comparison,
    /// Of these, unknown to the other.
    pub missing: u64,
    /// Of these, known to both with another state.
    pub stale: u64,
}

/// Runs all robots through their scans, and on until every chunk has arrived everywhere. `config` gives the robot with an id
/// of 1 to the number of sources.
pub fn run(
    sources: Vec<Source>,
    config: impl Fn(RobotId) -> RacerConfig,
    radio: RadioConfig,
) -> anyhow::Result<RivalRun> {
    let progress =
        Progress::new("scans of racer-code", sources.iter().map(|source| source.frames_expected).sum());
    let (mut robots, mut frames) = (Vec::new(), Vec::new());
    for (number, source) in sources.into_iter().enumerate() {
        robots.push(RacerRobot::new(config(RobotId(number as u16 + 1)), Stamp(0))?);
        frames.push(source.frames);
    }
    let mut meters = Meters((0..robots.len()).map(|_| Meter::default()).collect());
    let mut network = Network::new(robots, radio, Stamp(0));
    let mut last_scan = Stamp(0);
    while let Some(next) = frames.iter_mut().filter_map(Frames::next_stamp).min() {
        if stop::requested() {
            break;
        }
        network.step(Some(next), &mut meters);
        let now = network.now();
        if next <= now {
            last_scan = now;
            for (number, frames) in frames.iter_mut().enumerate() {
                while frames.next_stamp().is_some_and(|at| at <= now) {
                    if let Some(frame) = frames.next() {
                        let robot = &mut network.nodes_mut()[number];
                        let report = robot.insert_scan(&frame.scan, &frame.pose, &frame.masks());
                        meters.0[number].onset.apply(&Changes::from_blocks(report.changed), frame.scan.stamp);
                    }
                    progress.step();
                }
            }
        }
    }
    let until = last_scan.plus_micros((SETTLE_SECONDS_MAX * 1e6) as i64);
    let arrived = loop {
        if has_every_chunk(network.nodes()) {
            break Some(network.now());
        }
        if network.now() > until || stop::requested() {
            break None;
        }
        network.step(None, &mut meters);
    };
    let members = network.into_nodes().into_iter().zip(meters.0);
    let members = members.map(|(robot, meter)| {
        let Meter { sent, announced, datagrams, ages, onset } = meter;
        RivalMember { robot, sent, announced, datagrams, ages, onset }
    });
    Ok(RivalRun { members: members.collect(), last_scan, arrived })
}

impl RivalRun {
    /// Compares what each robot saw with what each other one was told of it; what was not told, as it was known already, with
    /// what the other one knows.
    pub fn agreement(&self) -> RivalAgreement {
        let mut sum = RivalAgreement::default();
        for (number, saw) in self.members.iter().enumerate() {
            for (_, other) in self.members.iter().enumerate().filter(|(other, _)| *other != number) {
                sum.add(saw, other);
            }
        }
        sum
    }
}

impl RivalAgreement {
    fn add(&mut self, saw: &RivalMember, other: &RivalMember) {
        let published = other.robot.observed_by(saw.robot.config().id);
        let mut blocks: BTreeMap<BlockIndex, [StateBlock; 2]> = BTreeMap::new();
        for (index, block) in saw.onset.blocks() {
            blocks.entry(index).or_default()[0] = *block;
        }
        for (index, block) in published.blocks() {
            blocks.entry(*index).or_default()[1] = *block;
        }
        for (index, [saw, published]) in blocks {
            let (a, b) = (saw.known(), published.known());
            let either = core::array::from_fn(|z| a[z] | b[z]);
            let mut theirs = other.robot.map().block(index);
            theirs.overlay(&published);
            let theirs = theirs.masked(&either);
            let mut here = Comparison::default();
            here.add(Some(&saw), Some(&theirs));
            let missing = here.known - u64::from(theirs.known_count());
            self.compared.known += here.known;
            self.compared.equal += here.equal;
            self.missing += missing;
            self.stale += here.known - missing - here.equal;
        }
    }
}

/// What is measured of a robot on the way.
#[derive(Default)]
struct Meter {
    sent: SentBytes,
    announced: SentBytes,
    datagrams: u64,
    ages: AgesByState,
    onset: Layer,
}

/// Robot `i` has the number `i` + 1.
struct Meters(Vec<Meter>);

impl Watch<RacerRobot> for Meters {
    fn called(&mut self, now: Stamp, number: usize, robot: &mut RacerRobot) {
        while let Some(event) = robot.poll_event() {
            let RacerEvent::Inserted { owner, changes } = event;
            let saw = usize::from(owner.0).wrapping_sub(1);
            if let Ok([receiver, saw]) = self.0.get_disjoint_mut([number, saw]) {
                receiver.ages.add(now, &changes, &saw.onset);
            }
        }
    }

    fn sent(
        &mut self,
        now: Stamp,
        number: usize,
        _: &mut RacerRobot,
        datagram: &mut Datagram,
        copies: usize,
    ) {
        let Meter { sent, announced, datagrams, .. } = &mut self.0[number];
        // The byte of the topic is not counted.
        let counted = ((datagram.bytes.len() - 1) * copies) as u64;
        sent.add(now, counted);
        *datagrams += copies as u64;
        if datagram.bytes.first() == Some(&STAMPS) {
            announced.add(now, counted);
        }
    }
}

/// In ROS the connection tells the topic; here the first byte does.
const STAMPS: u8 = 0;
const CHUNK: u8 = 1;

impl Node for RacerRobot {
    fn id(&self) -> RobotId {
        self.config().id
    }

    fn handle_datagram(&mut self, _now: Stamp, delivery: &Delivery) {
        if let Some((topic, bytes)) = delivery.bytes.split_first() {
            let topic = if *topic == STAMPS { Topic::Stamps } else { Topic::Chunk };
            // Errors are counted by the robot.
            let _ = Self::handle_datagram(self, topic, bytes);
        }
    }

    fn handle_timeout(&mut self, now: Stamp) {
        Self::handle_timeout(self, now);
    }

    fn poll_timeout(&self) -> Option<Stamp> {
        Some(Self::poll_timeout(self))
    }

    fn poll_transmit(&mut self, _now: Stamp) -> Option<Datagram> {
        let transmit = Self::poll_transmit(self)?;
        let mut bytes = vec![if transmit.topic == Topic::Stamps { STAMPS } else { CHUNK }];
        bytes.extend_from_slice(&transmit.bytes);
        let to = match (transmit.to, self.config().cast) {
            (Some(peer), _) => Addressees::One(peer),
            (None, RacerCast::Broadcast) => Addressees::All,
            (None, RacerCast::Unicast) => Addressees::Each,
        };
        Some(Datagram { to, bytes })
    }
}

/// Whether every robot holds all chunks of every other.
fn has_every_chunk(robots: &[RacerRobot]) -> bool {
    robots.iter().all(|receiver| {
        robots.iter().all(|saw| {
            let id = saw.config().id;
            receiver.held(id).map(|held| held.intervals()) == saw.held(id).map(|held| held.intervals())
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::grid::{MapperConfig, Preset};
    use flockmap::{Pose, Resolution, Scan};
    use flockmap_cli::sources::Frame;
    use flockmap_netsim::Link;
    use flockmap_worlds::Random;

    /// Robots that fly side by side through ever changing bushes: what is hit differs from scan to scan.
    fn bushes(robots: u64, scans: i64) -> Vec<Source> {
        let robot = |number: u64| {
            let frames = (1..=scans).map(move |scan| {
                let mut random = Random::new(3, number * 1_000 + scan as u64);
                let mut points = Vec::new();
                for _ in 0..300 {
                    let mut between = |from: f64, to: f64| (from + (to - from) * random.unit()) as f32;
                    points.push([between(1.0, 4.0), between(-3.0, 3.0), between(-1.0, 1.0)]);
                }
                let scan_of = Scan { stamp: Stamp(scan * 100_000), points, no_returns: Vec::new() };
                let at = [scan as f64 * 0.15, number as f64 * 4.0, 1.0];
                Ok(Frame { scan: scan_of, pose: Pose::from_yaw(at, 0.0), team_mates: Vec::new() })
            });
            Source {
                name: format!("robot{}", number + 1),
                frames_expected: scans as u64,
                seconds_expected: scans as f64 / 10.0,
                frames: Frames::new(frames),
            }
        };
        (0..robots).map(robot).collect()
    }

    fn mapper() -> MapperConfig {
        MapperConfig::preset(Preset::RogMap, Resolution::from_metres(0.2).unwrap(), 7.0)
    }

    fn racer(robots: u16, cast: RacerCast) -> impl Fn(RobotId) -> RacerConfig {
        move |id| RacerConfig { cast, ..RacerConfig::new(id, robots, mapper()) }
    }

    #[test]
    fn racers_robots_end_with_stale_voxels_and_without_the_tail() {
        let run = run(bushes(2, 40), racer(2, RacerCast::Unicast), RadioConfig::default()).unwrap();
        assert!(run.arrived.is_some());
        let agreement = run.agreement();
        println!("{agreement:?}: {:.2} %", agreement.compared.share() * 100.0);
        assert!(agreement.stale > 0, "states are frozen at the first transmission");
        let behind: u64 = run.members.iter().map(|m| m.robot.left_behind() as u64).sum();
        assert!((2..=400).contains(&behind) && agreement.missing >= behind / 2, "{agreement:?}");
        assert!((0.5..1.0).contains(&agreement.compared.share()));
        for member in &run.members {
            let counters = member.robot.counters();
            assert_eq!((counters.chunks_sent, counters.chunks_resent), (counters.chunks, 0));
            // Once to its only team-mate; announcements of at most 16 + 3 lists with one interval each.
            assert_eq!(member.sent.total() - member.announced.total(), counters.chunks * 1_052);
            assert!(member.announced.total() <= counters.stamps_sent * (16 + 3 * 12));
            assert!(member.ages.free.summary().voxels > 0 && member.ages.occupied.summary().voxels > 0);
        }
    }

    #[test]
    fn over_a_slow_and_lossy_radio_chunks_are_sent_several_times() {
        let link = Link { loss: 0.2, delay_micros: 300_000, ..Link::default() };
        let radio = RadioConfig { seed: 5, link, ..RadioConfig::default() };
        let run = run(bushes(3, 20), racer(3, RacerCast::Broadcast), radio).unwrap();
        assert!(run.arrived.is_some());
        let sum = |of: fn(&RivalMember) -> u64| run.members.iter().map(of).sum::<u64>();
        let (chunks, sent) = (sum(|m| m.robot.counters().chunks), sum(|m| m.robot.counters().chunks_sent));
        assert!(sent > 2 * chunks, "{sent} sent of {chunks}");
        assert!(sum(|m| m.robot.counters().chunks_relayed) > 0);
        assert!(run.agreement().compared.share() < 1.0);
    }

    #[test]
    fn the_same_run_twice_gives_the_same_bytes_and_the_sessions_of_flockmap_end_equal() {
        let link = Link { loss: 0.1, delay_micros: 20_000, ..Link::default() };
        let radio = RadioConfig { seed: 5, link, ..RadioConfig::default() };
        let bytes = || {
            let run = run(bushes(2, 20), racer(2, RacerCast::Unicast), radio).unwrap();
            run.members.iter().map(|m| (m.sent.per_second(), m.datagrams)).collect::<Vec<_>>()
        };
        assert_eq!(bytes(), bytes());
        // On the very frames that racer-code leaves stale.
        let config = |id| flockmap::RobotConfig {
            mapper: mapper(),
            ..flockmap::RobotConfig::new(id, mapper().resolution, 7.0)
        };
        let run = flockmap_cli::swarm::run(bushes(2, 20), config, radio).unwrap();
        let [a, b] = run.members.as_slice() else { unreachable!() };
        for (owner, other) in [(a, b), (b, a)] {
            let stream = owner.robot.own_stream();
            let layer = |of: &flockmap_cli::swarm::Member| of.robot.fusion().layer(stream).map(Layer::digest);
            assert_eq!(layer(owner), layer(other));
        }
    }
}
