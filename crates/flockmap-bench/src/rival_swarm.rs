//! A swarm of RACER's robots in virtual time, beside [`flockmap_cli::swarm`]: the same frames, the same radio.

use flockmap::grid::Layer;
use flockmap::{RobotId, Stamp};
use flockmap_cli::flight::Flight;
use flockmap_cli::measure::{Comparison, blocks_of, side_by_side};
use flockmap_cli::member::Measures;
use flockmap_cli::sources::Source;
use flockmap_cli::swarm::SETTLE_MICROS_MAX;
use flockmap_netsim::{Datagram, RadioConfig, Watch};

use crate::baselines::racer_code::{RacerConfig, RacerRobot};

/// How a run went.
pub struct RivalRun {
    pub robots: Vec<RacerRobot>,
    /// Of each robot. The byte that says the topic is not counted.
    pub measures: Vec<Measures>,
    /// Time of the last scan.
    pub last_scan: Stamp,
}

/// How far what others know of what a robot saw is what it knows, over all pairs of robots.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RivalAgreement {
    /// Voxels known to the one who saw them, or received of it.
    pub compared: Comparison,
    /// Of these, unknown to the other.
    pub missing: u64,
    /// Of these, known to both with another state.
    pub stale: u64,
}

/// Runs all robots through their scans, and on until every chunk has arrived everywhere. `config` gives the
/// robot with an id of 1 to the number of sources.
pub fn run(
    sources: Vec<Source>,
    config: impl Fn(RobotId) -> RacerConfig,
    radio: RadioConfig,
) -> anyhow::Result<RivalRun> {
    let mut meters = Meters(sources.iter().map(|_| Measures::default()).collect());
    let robot = |id| RacerRobot::new(config(id), Stamp(0));
    let mut flight = Flight::new(sources, radio, "scans of racer-code", robot)?;
    while let Some(next) = flight.next_scan() {
        flight.network.step(Some(next), &mut meters);
        flight.scan_due(|robot, number, _, frame| {
            let report = robot.insert_scan(&frame.scan, &frame.pose, &frame.masks());
            meters.0[number].scan(&report, frame.scan.stamp);
            Ok(())
        })?;
    }
    let last_scan = flight.last_scan;
    flight.settle(last_scan.plus_micros(SETTLE_MICROS_MAX), &mut meters, has_every_chunk);
    Ok(RivalRun { robots: flight.network.into_nodes(), measures: meters.0, last_scan })
}

impl RivalRun {
    /// Compares what each robot saw with what each other one received of it; what was not sent, as it was
    /// known already, with what the other one knows.
    pub fn agreement(&self) -> RivalAgreement {
        let mut sum = RivalAgreement::default();
        for (saw, Measures { onset, .. }) in self.robots.iter().zip(&self.measures) {
            let id = saw.config().id;
            for other in self.robots.iter().filter(|other| other.config().id != id) {
                sum.add(id, onset, other);
            }
        }
        sum
    }
}

impl RivalAgreement {
    /// What a robot saw, and what another one knows of it.
    fn add(&mut self, saw: RobotId, onset: &Layer, other: &RacerRobot) {
        let published = other.observed_by(saw);
        let pairs = side_by_side(blocks_of(onset), published.blocks().iter().copied());
        for (index, [saw, published]) in pairs {
            let (a, b) = (saw.known(), published.known());
            let either = core::array::from_fn(|z| a[z] | b[z]);
            let mut theirs = other.map().block(index);
            theirs.overlay(&published);
            let theirs = theirs.masked(&either);
            let mut here = Comparison::default();
            here.add(&saw, &theirs);
            let missing = here.known - u64::from(theirs.known_count());
            self.compared.merge(here);
            self.missing += missing;
            self.stale += here.known - missing - here.equal;
        }
    }
}

/// Robot `i` has the number `i` + 1.
struct Meters(Vec<Measures>);

impl Watch<RacerRobot> for Meters {
    fn sent(&mut self, now: Stamp, at: usize, _: &mut RacerRobot, datagram: &mut Datagram, copies: usize) {
        // The byte of the topic is not counted.
        self.0[at].datagram_sent(now, datagram.bytes.len() - 1, copies as u64);
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
    use crate::baselines::racer_code::{RacerCast, RacerCounters};
    use flockmap::grid::{MapperConfig, Preset};
    use flockmap::{Pose, Resolution, Scan};
    use flockmap_cli::report::Member;
    use flockmap_cli::sources::{Frame, Frames};
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
        assert!(has_every_chunk(&run.robots));
        let agreement = run.agreement();
        println!("{agreement:?}: {:.2} %", agreement.compared.share() * 100.0);
        assert!(agreement.stale > 0, "states are frozen at the first transmission");
        let behind: u64 = run.robots.iter().map(|robot| robot.left_behind() as u64).sum();
        assert!((2..=400).contains(&behind) && agreement.missing >= behind / 2, "{agreement:?}");
        assert!((0.5..1.0).contains(&agreement.compared.share()));
        for (robot, measures) in run.robots.iter().zip(&run.measures) {
            let counters = robot.counters();
            assert_eq!((counters.chunks_sent, counters.chunks_resent), (counters.chunks, 0));
            // Once to its only team-mate; announcements of 16 + 3 lists with at most one interval each.
            let announced = measures.sent.payload.total() - counters.chunks * 1_052;
            let lists = counters.stamps_sent * (16 + 3 * 4)..=counters.stamps_sent * (16 + 3 * 12);
            assert!(lists.contains(&announced));
        }
    }

    #[test]
    fn over_a_slow_and_lossy_radio_chunks_are_sent_several_times() {
        let link = Link { loss: 0.2, delay_micros: 300_000, ..Link::default() };
        let radio = RadioConfig { seed: 5, link, ..RadioConfig::default() };
        let run = run(bushes(3, 20), racer(3, RacerCast::Broadcast), radio).unwrap();
        assert!(has_every_chunk(&run.robots));
        let sum =
            |of: fn(&RacerCounters) -> u64| run.robots.iter().map(|robot| of(robot.counters())).sum::<u64>();
        let (chunks, sent) = (sum(|counters| counters.chunks), sum(|counters| counters.chunks_sent));
        assert!(sent > 2 * chunks, "{sent} sent of {chunks}");
        assert!(sum(|counters| counters.chunks_relayed) > 0);
        assert!(run.agreement().compared.share() < 1.0);
    }

    #[test]
    fn the_same_run_twice_gives_the_same_bytes_and_the_sessions_of_flockmap_end_equal() {
        let link = Link { loss: 0.1, delay_micros: 20_000, ..Link::default() };
        let radio = RadioConfig { seed: 5, link, ..RadioConfig::default() };
        let bytes = || {
            let run = run(bushes(2, 20), racer(2, RacerCast::Unicast), radio).unwrap();
            run.measures
                .iter()
                .map(|of| (of.sent.payload.per_second(), of.sent.datagrams))
                .collect::<Vec<_>>()
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
            let layer = |of: &Member| of.robot.fusion().layer(stream).map(Layer::digest);
            assert_eq!(layer(owner), layer(other));
        }
    }
}
