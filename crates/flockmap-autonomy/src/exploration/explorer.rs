//! The exploration itself, in virtual time.

use super::mates::{Mate, are_apart};
use super::pilot::{Pilot, PilotConfig};
use super::regions::{self, Regions};
use super::seeable::{Eyes, Seeable};
use super::setup::{default_region, heights, navigation};
use super::sight::Sight;
use super::{ExploreError, ExploreOptions, start};
use crate::Motion;
use crate::threads::in_parallel;
use flockmap::{Robot, RobotConfig};
use flockmap_grid::{RobotId, Stamp};
use flockmap_io::Frame;
use flockmap_netsim::{Network, RadioConfig, RadioEmulator};
use flockmap_worlds::curve::distance;
use flockmap_worlds::random::mix;
use flockmap_worlds::{Body, IN_THE_WORLD, SCAN_PERIOD_MICROS, ScanOptions, Scanner, World};
use std::sync::Arc;

/// Robots look for a partner to divide regions with this often, in scans.
const MEETING_SCANS: u64 = 5;

/// When all have been idle for so long, and all maps agree, it is over.
const IDLE_MICROS: i64 = 3_000_000;

/// When all have been idle for so long it is over in any case.
const IDLE_MAX_MICROS: i64 = 20_000_000;

/// A robot that was not heard for so long takes all regions for its own.
const UNHEARD_MICROS: i64 = 8_000_000;

/// Metres from a robot's centre to the corners of its body (0.4 × 0.4 × 0.3 m).
const BODY_RADIUS_M: f64 = 0.33;

/// How an exploration ended.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Ended {
    /// Nobody has anything left to look at.
    Done,
    /// The time was over.
    TimeOut,
}

/// What came of an exploration.
#[derive(Clone, PartialEq, Debug)]
pub struct Outcome {
    /// How long it took, in seconds.
    pub seconds: f64,
    /// Share of the voxels that can be seen in the region that at least one robot mapped itself, 0 … 1. What
    /// can be seen is worked out from the world: every voxel whose centre a ray from one of many places, one
    /// for each 1.2 × 1.2 × 0.6 m in which a robot can be, reaches within the mapper's range and the LiDAR's
    /// elevations.
    pub seen_share: f64,
    /// Number of those voxels.
    pub seeable_voxels: u64,
    /// Metres flown by each robot.
    pub path_m: Vec<f64>,
    /// Voxels that each robot mapped itself, divided by those that at least one of them did, added up: 1 if
    /// no voxel was mapped twice, the number of robots if all mapped everything.
    pub overlap: f64,
    /// How it ended.
    pub ended: Ended,
}

/// How far an exploration has come.
#[derive(Clone, PartialEq, Debug)]
pub struct Progress {
    /// Virtual time in seconds.
    pub seconds: f64,
    /// As in [`Outcome::seen_share`].
    pub seen_share: f64,
    /// The robots.
    pub robots: Vec<RobotProgress>,
}

/// How one robot is doing.
#[derive(Clone, PartialEq, Debug)]
pub struct RobotProgress {
    /// Where it is, in metres.
    pub position: [f64; 3],
    /// Metres flown.
    pub path_m: f64,
    /// Regions that are its own and in which it knows of something to do.
    pub regions: usize,
    /// Frontiers that it could look at.
    pub frontiers: usize,
    /// Whether it has nothing to do.
    pub is_idle: bool,
}

/// An exploration, step by step. The same world and options give the same frames on every machine, with any
/// number of threads.
///
/// ```no_run
/// use flockmap_autonomy::{ExploreOptions, Explorer};
/// use flockmap_worlds::World;
/// use std::sync::Arc;
///
/// let mut explorer = Explorer::new(Arc::new(World::forest(1)), ExploreOptions::default())?;
/// while let Some(frames) = explorer.step() {
///     assert_eq!(frames.len(), 2);
/// }
/// println!("{:?}", explorer.outcome());
/// # Ok::<(), flockmap_autonomy::ExploreError>(())
/// ```
pub struct Explorer {
    options: ExploreOptions,
    network: Network<Member>,
    seeable: Seeable,
    /// When two robots last divided their regions.
    met: Vec<Vec<Option<Stamp>>>,
    steps: u64,
    ended: Option<Ended>,
}

struct Member {
    robot: Robot,
    pilot: Pilot,
    scanner: Scanner,
    frame: Option<Frame>,
}

impl AsRef<Robot> for Member {
    fn as_ref(&self) -> &Robot {
        &self.robot
    }
}

impl AsMut<Robot> for Member {
    fn as_mut(&mut self) -> &mut Robot {
        &mut self.robot
    }
}

impl Explorer {
    /// Robots on their spots, nothing seen yet. Takes some seconds for a large world: what can be seen of it
    /// is worked out first.
    ///
    /// Memory: some 30 bytes for each navigation cell (20 cm, larger in worlds beyond 4 million of them) and
    /// robot, the robots' maps, and a byte for each voxel of the region while it is made.
    ///
    /// # Errors
    /// [`ExploreError`] says which option cannot work, or why there is no place to start.
    pub fn new(world: Arc<World>, options: ExploreOptions) -> Result<Self, ExploreError> {
        Self::new_watched(world, options, &|_, _| true)
    }

    /// The same; while it works out what can be seen, `goes_on` is called with how many of how many parts are
    /// done, and says whether to go on. It is called from any of the threads.
    ///
    /// # Errors
    /// As [`Self::new`], and [`ExploreError::Stopped`] once `goes_on` has said no.
    pub fn new_watched(
        world: Arc<World>,
        options: ExploreOptions,
        goes_on: &(dyn Fn(usize, usize) -> bool + Sync),
    ) -> Result<Self, ExploreError> {
        options.check()?;
        let region_m = options.region_m.unwrap_or_else(|| default_region(&world));
        let navigation = navigation(region_m, &options)?;
        let truth = start::truth(&world, &navigation)?;
        let heights_m = heights(region_m, &options);
        let may_fly = |cell: usize| {
            let z = truth.cells.centre(cell)[2];
            heights_m[0] <= z && z <= heights_m[1]
        };
        let places = start::places(&truth, options.robots, options.separation_m, may_fly);
        if places.len() < options.robots {
            return Err(ExploreError::NoStart {
                robot: places.len() + 1,
                robots: options.robots,
                clearance_m: options.clearance_m,
                heights_m,
                separation_m: options.separation_m,
            });
        }
        let sight = Sight::new(options.lidar, options.range_m);
        let eyes = Eyes { world: &world, sight: &sight, scan: options.scan, resolution: options.resolution };
        let seeable = Seeable::new(&eyes, &truth, places[0], may_fly, options.threads, goes_on)
            .ok_or(ExploreError::Stopped)?;
        let mut members = Vec::new();
        for (number, &place) in places.iter().enumerate() {
            let mut config =
                RobotConfig::new(RobotId(number as u16 + 1), options.resolution, options.range_m);
            config.seed = options.seed;
            config.batch = options.batch;
            config.codec = options.codec;
            config.session = options.session.clone();
            config.mapper.range_min_m = options.scan.min_range_m;
            config.teammate_radius_m = BODY_RADIUS_M + 2.0 * options.resolution.metres();
            let pilot = Pilot::new(PilotConfig {
                number,
                start: place,
                navigation,
                sight: sight.clone(),
                regions: Regions::new(region_m),
                limits: options.limits,
                heights_m,
                separation_m: options.separation_m,
            })?;
            let scan = ScanOptions { seed: mix(options.scan.seed ^ mix(number as u64 + 1)), ..options.scan };
            let scanner = Scanner::new(Arc::clone(&world), options.lidar, scan);
            members.push(Member { robot: Robot::new(config, Stamp(0))?, pilot, scanner, frame: None });
        }
        let radio = RadioConfig { seed: mix(options.seed) ^ options.radio.seed, ..options.radio };
        let network = Network::new(members, radio, Stamp(0));
        let met = vec![vec![None; options.robots]; options.robots];
        Ok(Self { options, network, seeable, met, steps: 0, ended: None })
    }

    /// Lets a tenth of a second pass: plans, flies, scans, maps, and carries what robots send. Gives the
    /// frame of each robot, all with the same stamp; `None` once it has ended.
    pub fn step(&mut self) -> Option<Vec<Frame>> {
        if self.ended.is_some() {
            return None;
        }
        let mates: Vec<Mate> = self.pilots().map(Pilot::mate).collect();
        if self.steps.is_multiple_of(MEETING_SCANS) {
            self.meet();
        }
        let now = self.network.now();
        in_parallel(self.options.threads, self.network.nodes_mut(), |number, member| {
            let others: Vec<Mate> = mates.iter().filter(|mate| mate.number != number).cloned().collect();
            member.pilot.plan(now, member.robot.map(), &others);
        });
        if let Some(ended) = self.has_ended() {
            self.ended = Some(ended);
            return None;
        }
        if self.steps > 0 {
            self.fly();
        }
        let places: Vec<[f64; 3]> = self.pilots().map(|pilot| pilot.motion.position()).collect();
        let ids = self.network.ids().to_vec();
        let limits = self.options.limits;
        in_parallel(self.options.threads, self.network.nodes_mut(), |number, member| {
            let pose = member.pilot.motion.pose();
            // Where it will be when the scan ends, if nothing makes it brake meanwhile.
            let mut end = member.pilot.motion.clone();
            end.step(SCAN_PERIOD_MICROS as f64 * 1e-6, member.pilot.yaw_target(), &limits);
            let others = || places.iter().enumerate().filter(|(other, _)| *other != number);
            let bodies: Vec<Body> = others().map(|(_, place)| Body::robot(*place)).collect();
            let scan = member.scanner.scan(now, &pose, Some(&end.pose()), &bodies);
            for (other, place) in others() {
                member.robot.set_teammate(ids[other], *place, now).expect(IN_THE_WORLD);
            }
            member.robot.insert_scan(now, &scan, &pose).expect(IN_THE_WORLD);
            member.frame = Some(Frame { scan, t_map_sensor: pose, points_dropped: 0 });
        });
        let next = now.plus_micros(SCAN_PERIOD_MICROS);
        self.network.run_before(next, &mut ());
        self.steps += 1;
        Some(self.network.nodes_mut().iter_mut().filter_map(|member| member.frame.take()).collect())
    }

    /// How far it has come. Costs a walk over what can be seen, about a millisecond for a forest.
    pub fn progress(&self) -> Progress {
        let robots = self.pilots().map(|pilot| RobotProgress {
            position: pilot.motion.position(),
            path_m: pilot.path_m,
            regions: (0..pilot.own.len()).filter(|r| pilot.own[*r] && pilot.work[*r] > 0.0).count(),
            frontiers: pilot.frontier_count(),
            is_idle: pilot.idle_since.is_some(),
        });
        let seconds = self.network.now().seconds();
        Progress { seconds, seen_share: self.seen_share(), robots: robots.collect() }
    }

    /// What came of it so far.
    pub fn outcome(&self) -> Outcome {
        let mut each = 0u64;
        let mut union = std::collections::BTreeMap::new();
        for robot in self.robots() {
            for (index, block) in robot.mapper().blocks() {
                let known = block.known();
                each += u64::from(block.known_count());
                let all = union.entry(index).or_insert([0u64; 8]);
                *all = core::array::from_fn(|z| all[z] | known[z]);
            }
        }
        let once: u64 = union.values().flatten().map(|word| u64::from(word.count_ones())).sum();
        Outcome {
            seconds: self.network.now().seconds(),
            seen_share: self.seen_share(),
            seeable_voxels: self.seeable.count(),
            path_m: self.pilots().map(|pilot| pilot.path_m).collect(),
            overlap: each as f64 / once.max(1) as f64,
            ended: self.ended.unwrap_or(Ended::TimeOut),
        }
    }

    /// The robots, in the order of the frames.
    pub fn robots(&self) -> impl Iterator<Item = &Robot> {
        self.network.nodes().iter().map(|member| &member.robot)
    }

    fn pilots(&self) -> impl Iterator<Item = &Pilot> {
        self.network.nodes().iter().map(|member| &member.pilot)
    }

    /// The radio, with what it has carried.
    pub const fn radio(&self) -> &RadioEmulator {
        self.network.radio()
    }

    /// Its options.
    pub const fn options(&self) -> &ExploreOptions {
        &self.options
    }

    fn seen_share(&self) -> f64 {
        self.seeable.share(self.network.nodes().iter().map(|member| member.robot.mapper()))
    }

    /// Moves all robots on, one after the other. A robot stops where the path on which it could still come to
    /// rest would come too near to that of another, so all can always stop without coming near each other.
    fn fly(&mut self) {
        let limits = self.options.limits;
        let dt = SCAN_PERIOD_MICROS as f64 * 1e-6;
        for number in 0..self.network.nodes().len() {
            let pilot = &self.network.nodes()[number].pilot;
            let yaw = pilot.yaw_target();
            let mut next: Motion = pilot.motion.clone();
            next.step(dt, yaw, &limits);
            let path = next.stopping_path(&limits);
            let free = self.pilots().all(|other| {
                other.config.number == number
                    || are_apart(&path, &other.motion.stopping_path(&limits), self.options.separation_m)
            });
            let pilot = &mut self.network.nodes_mut()[number].pilot;
            if !free {
                pilot.motion.brake(&limits);
                next = pilot.motion.clone();
                next.step(dt, yaw, &limits);
            }
            pilot.path_m += distance(pilot.motion.position(), next.position());
            pilot.motion = next;
        }
    }

    /// Robots that hear each other divide the regions that they have between them.
    fn meet(&mut self) {
        let now = self.network.now();
        for first in 0..self.network.nodes().len() {
            if !self.hears_anybody(first) {
                self.network.nodes_mut()[first].pilot.own.fill(true);
            }
            for second in first + 1..self.network.nodes().len() {
                let rested = self.met[first][second].is_none_or(|at| now.micros_since(at) >= 1_000_000);
                if !(rested && self.hears(first, second) && self.hears(second, first)) {
                    continue;
                }
                self.met[first][second] = Some(now);
                let Ok([a, b]) = self.network.nodes_mut().get_disjoint_mut([first, second]) else { continue };
                divide(&mut a.pilot, &mut b.pilot);
            }
        }
    }

    fn hears(&self, robot: usize, other: usize) -> bool {
        let (id, now) = (self.network.ids()[other], self.network.now());
        self.network.nodes()[robot]
            .robot
            .session()
            .peers()
            .any(|peer| peer.stream.origin == id && now.micros_since(peer.last_heard) < UNHEARD_MICROS)
    }

    fn hears_anybody(&self, robot: usize) -> bool {
        (0..self.network.nodes().len()).any(|other| other != robot && self.hears(robot, other))
    }

    fn has_ended(&self) -> Option<Ended> {
        let now = self.network.now();
        if now.seconds() >= self.options.seconds_max {
            return Some(Ended::TimeOut);
        }
        let idle = self.pilots().map(|pilot| pilot.idle_since.map(|since| now.micros_since(since)));
        let idle = idle.min().flatten()?;
        (idle >= IDLE_MAX_MICROS || (idle >= IDLE_MICROS && self.maps_agree())).then_some(Ended::Done)
    }

    /// Whether every robot has all packages of all robots that it hears.
    fn maps_agree(&self) -> bool {
        let count = self.network.nodes().len();
        (0..count).all(|receiver| {
            (0..count).filter(|sender| *sender != receiver && self.hears(receiver, *sender)).all(|sender| {
                let sender = &self.network.nodes()[sender].robot;
                let packages = sender.counters().packages;
                let received = self.network.nodes()[receiver].robot.session().received(sender.own_stream());
                packages == 0 || received.is_some_and(|received| u64::from(received.prefix()) >= packages)
            })
        })
    }
}

/// Divides the regions of two robots between them, by what the first knows of the work in them.
fn divide(a: &mut Pilot, b: &mut Pilot) {
    let pool: Vec<usize> = (0..a.own.len()).filter(|region| a.own[*region] || b.own[*region]).collect();
    let places = [a.motion.position(), b.motion.position()];
    let work: Vec<f64> = a.work.iter().zip(&b.work).map(|(a, b)| a.max(*b)).collect();
    let away = |place: [f64; 3], region: usize| {
        let centre = a.config.regions.centre(region);
        distance([place[0], place[1], 0.0], centre)
    };
    let was_second: Vec<bool> = pool
        .iter()
        .map(|&region| match (a.own[region], b.own[region]) {
            (true, false) => false,
            (false, true) => true,
            _ => away(places[1], region) < away(places[0], region),
        })
        .collect();
    let second = regions::divide(&a.config.regions, &pool, &work, places, &was_second);
    for (&region, is_second) in pool.iter().zip(second) {
        a.own[region] = !is_second;
        b.own[region] = is_second;
    }
}
