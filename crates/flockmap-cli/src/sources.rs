//! Where scans come from: records of robots, or simulated robots that fly through a world.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};

use anyhow::{Context, bail, ensure};
use flockmap::{Pose, Scan, Sphere, Stamp};
use flockmap_io::{Record, SubmapPoses};
use flockmap_worlds::{
    Flight, ObstacleOptions, ScanOptions, Shape, Tracks, Trajectory, TrajectoryOptions, World,
};

use crate::options::{OF_FLIGHTS, OF_RECORDS, SourceArgs, as_given, resolution};
use crate::records::{self, RobotRecord};
use crate::team::{Team, TeamMate};

/// A scan and `T_map_sensor`, the pose that it was taken at.
pub struct Frame {
    pub scan: Scan,
    pub pose: Pose,
    /// Team-mates that may be seen in the scan and do not belong into the map. None if they are not to be seen.
    pub team_mates: Vec<TeamMate>,
}

impl Frame {
    /// The spheres around team-mates in which returns are no obstacles.
    pub fn masks(&self) -> Vec<Sphere> {
        self.team_mates.iter().map(TeamMate::mask).collect()
    }
}

/// What one robot sees.
pub struct Source {
    pub name: String,
    /// Number of frames as far as it is known beforehand.
    pub frames_expected: u64,
    /// From the first to the last frame as far as it is known beforehand, in seconds.
    pub seconds_expected: f64,
    pub frames: Frames,
}

/// The frames of a source, prepared ahead of use by a thread of its own.
pub struct Frames {
    receiver: Receiver<anyhow::Result<Frame>>,
    next: Option<Frame>,
    /// How submaps lie, as far as it is to be said yet.
    pub submaps: SubmapPoses,
    /// Scans that could not be read. They are left out.
    pub damaged: u64,
}

/// Frames that a thread may prepare ahead of use; so many wait at most.
const FRAMES_AHEAD: usize = 4;

impl Frames {
    /// Frames in the order of time.
    pub fn new(mut frames: impl Iterator<Item = anyhow::Result<Frame>> + Send + 'static) -> Self {
        let (sender, receiver) = sync_channel(FRAMES_AHEAD);
        // Until nobody wants one more.
        std::thread::spawn(move || frames.all(|frame| sender.send(frame).is_ok()));
        Self { receiver, next: None, submaps: SubmapPoses::default(), damaged: 0 }
    }

    /// Stamp of the next frame, `None` at the end.
    pub fn next_stamp(&mut self) -> Option<Stamp> {
        self.next = self.next.take().or_else(|| self.receive());
        self.next.as_ref().map(|frame| frame.scan.stamp)
    }

    fn receive(&mut self) -> Option<Frame> {
        loop {
            match self.receiver.recv().ok()? {
                Ok(frame) => return Some(frame),
                Err(error) => {
                    self.damaged += 1;
                    if self.damaged <= 3 {
                        eprintln!("warning: a scan is left out: {error:#}");
                    }
                }
            }
        }
    }
}

impl Iterator for Frames {
    type Item = Frame;

    fn next(&mut self) -> Option<Frame> {
        self.next.take().or_else(|| self.receive())
    }
}

/// All robots of a run.
pub struct Sources {
    pub robots: Vec<Source>,
    /// What this is, for titles: names of the records, or the world that is flown through.
    pub title: String,
}

/// How long simulated flights last, if nothing else is said.
const FLIGHT_SECONDS: f64 = 60.0;

/// Opens the records, or the one world, that the command line names. Stamps begin at 0 for each record; with
/// `real_stamps`, at 0 for the earliest. A simulated LiDAR sees `range_m` far, if nothing else is said.
pub fn open(
    paths: &[PathBuf],
    source: &SourceArgs,
    range_m: f64,
    real_stamps: bool,
) -> anyhow::Result<Sources> {
    ensure!(
        source.seconds.is_none_or(|s| s > 0.0 && s <= 86_400.0),
        "--seconds must be more than 0 and at most 86,400"
    );
    match paths.iter().find(|path| is_world(path)) {
        Some(world) if paths.len() == 1 => {
            source
                .given
                .refuse(&OF_RECORDS, &format!("is for records, and {} is a world", world.display()))?;
            fly(world, source, range_m)
        }
        Some(world) => bail!(
            "{} is a world, not a record: name one world (with --robots N), or records only",
            world.display()
        ),
        None => {
            check_records(paths, source)?;
            open_records(paths, source, real_stamps)
        }
    }
}

/// Whether these are records, and the options fit them.
fn check_records(paths: &[PathBuf], source: &SourceArgs) -> anyhow::Result<()> {
    if let Some(path) = paths.iter().find(|path| !path.exists()) {
        bail!("there is no {}{}", path.display(), did_you_mean(path));
    }
    source
        .given
        .refuse(&OF_FLIGHTS, "is for simulated robots, and records are named: they hold what was seen")?;
    if paths.len().max(source.points_topic.len()) > 1 {
        source.given.refuse(
            &["robots"],
            "cuts a single record into robots, and several records or topics are named: each is one robot",
        )?;
    }
    Ok(())
}

/// Simulated robots that fly through the world that `--scene` names.
pub fn open_scene(scene: &Path, source: &SourceArgs, range_m: f64) -> anyhow::Result<Sources> {
    check_scene(scene)?;
    eprintln!("making the world and planning the flights ...");
    open(&[scene.to_owned()], source, range_m, false)
}

/// Whether `--scene` names a world.
pub fn check_scene(scene: &Path) -> anyhow::Result<()> {
    ensure!(
        is_world(scene),
        "--scene {}: expected forest, indoor, or a .bt, .pcd, .ply, .las or .laz file{}",
        scene.display(),
        did_you_mean(scene)
    );
    Ok(())
}

/// The ending of a file's name, in small letters.
pub fn ending(path: &Path) -> Option<String> {
    path.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase())
}

/// Worlds that are generated.
const WORLDS: [&str; 2] = ["forest", "indoor"];

/// The generated world whose name is nearly this, as a question.
fn did_you_mean(path: &Path) -> String {
    let name = path.to_string_lossy().to_lowercase();
    let near = WORLDS.into_iter().find(|world| strsim::damerau_levenshtein(world, &name) <= 2);
    near.map(|world| format!(" (did you mean {world}?)")).unwrap_or_default()
}

/// Whether this names a world to fly through.
pub fn is_world(path: &Path) -> bool {
    path.to_str().is_some_and(|name| WORLDS.contains(&name))
        || matches!(ending(path).as_deref(), Some("bt" | "pcd" | "ply" | "las" | "laz"))
}

fn open_records(paths: &[PathBuf], source: &SourceArgs, real_stamps: bool) -> anyhow::Result<Sources> {
    let opened = records::records(paths, source)?;
    let opened: Vec<(Record, [Stamp; 2])> =
        opened.iter().map(|record| open_spanned(record, source)).collect::<anyhow::Result<_>>()?;
    let (records, spans): (Vec<Record>, Vec<[Stamp; 2]>) = opened.into_iter().unzip();
    records::refuse_twice(&records)?;
    records.iter().for_each(warn_of_damages);
    if let Some(frames) = records::several_frames(&records) {
        eprintln!(
            "warning: the poses are in several frames ({frames}), and maps are merged as if these were one; \
             --map-frame names one that all robots have"
        );
    }
    let names = records::names(&records);
    let earliest = spans.iter().map(|[first, _]| *first).min().unwrap_or_default();
    let title = names.join(" + ");
    let zero = |first: Stamp| if real_stamps { earliest } else { first };
    let seen = records.iter().zip(&spans).filter(|_| source.see_team_mates);
    let team = Team::new(seen.map(|(record, [first, _])| (record.poses.as_slice(), zero(*first))));
    let robots = records.into_iter().zip(names).zip(spans).enumerate();
    let robots = robots.map(|(number, ((record, name), [first, last]))| {
        part(record, name, [first, last], zero(first), (team.clone(), number))
    });
    Ok(Sources { robots: robots.collect(), title })
}

/// One record as `--robots` robots: cut into as many parts of equal time, which all begin at 0. A swarm on a
/// single recording.
pub fn open_parts(path: &Path, source: &SourceArgs) -> anyhow::Result<Sources> {
    let parts = source.robots as i64;
    ensure!((1..=100).contains(&parts), "--robots is {parts}, expected 1 to 100");
    ensure!(
        !source.see_team_mates,
        "--see-team-mates: one record cut into robots shows none of them; name one record for each robot"
    );
    check_records(&[path.to_owned()], source)?;
    let records = records::records(std::slice::from_ref(&path.to_owned()), source)?;
    let [whole] = records.as_slice() else { bail!("a record is cut by time, or has a robot for each topic") };
    let mut robots = Vec::new();
    for number in 0..parts {
        // Each part reads the file for itself: only what is flown is in memory.
        let (record, [first, last]) = open_spanned(whole, source)?;
        if number == 0 {
            warn_of_damages(&record);
        }
        let micros = last.micros_since(first) + 1;
        let from = first.plus_micros(micros * number / parts);
        let until = first.plus_micros(micros * (number + 1) / parts - 1);
        let name = format!("{}, part {}", record.name, number + 1);
        robots.push(part(record, name, [from, until], from, (Team::default(), 0)));
    }
    let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy();
    Ok(Sources { robots, title: format!("{name}, cut by time into {parts} robots") })
}

/// A record, and the stamps of its first scan and of the last one that is wanted.
fn open_spanned(from: &RobotRecord, source: &SourceArgs) -> anyhow::Result<(Record, [Stamp; 2])> {
    let record = records::open(from)?;
    let Some((first, last)) = record.summary.span else {
        bail!("{}: no scan with a pose", from.path.display())
    };
    let Some(seconds) = source.seconds else { return Ok((record, [first, last])) };
    let last = last.min(first.plus_micros((seconds * 1e6) as i64));
    let submaps = record.submaps.until(last);
    Ok((Record { submaps, ..record }, [first, last]))
}

/// Says what of a record cannot be read.
fn warn_of_damages(record: &Record) {
    for damage in &record.summary.damages {
        eprintln!("warning: {damage}");
    }
}

/// The frames of a record from one time to another, both included, with stamps that count from `zero`. The
/// robot is one of a team. What the record says of its submaps later is said at the end.
pub fn part(
    record: Record,
    name: String,
    [from, until]: [Stamp; 2],
    zero: Stamp,
    (team, number): (Team, usize),
) -> Source {
    let (first, last) = record.summary.span.unwrap_or((from, until));
    let share = until.micros_since(from) as f64 / last.micros_since(first).max(1) as f64;
    // Whoever begins between two scans begins with the second.
    let begins = record.poses.iter().map(|(stamp, _)| *stamp).find(|stamp| *stamp >= from);
    let submaps = record.submaps.ended_at(until).begun_at(begins.unwrap_or(from));
    let submaps = submaps.at(|stamp| Stamp(stamp.micros_since(zero)));
    let frames = record
        .frames
        // A damaged scan belongs to the part that is being read, so it is counted once.
        .skip_while(move |frame| frame.as_ref().map_or(from > first, |f| f.scan.stamp < from))
        .take_while(move |frame| frame.as_ref().map_or(true, |f| f.scan.stamp <= until))
        .map(move |frame| {
            let mut frame = frame?;
            frame.scan.stamp = Stamp(frame.scan.stamp.micros_since(zero));
            let team_mates = team.mates(number, frame.scan.stamp);
            Ok(Frame { scan: frame.scan, pose: frame.t_map_sensor, team_mates })
        });
    Source {
        name,
        frames_expected: (record.summary.frames as f64 * share).ceil() as u64,
        seconds_expected: until.micros_since(from) as f64 / 1e6,
        frames: Frames { submaps, ..Frames::new(frames) },
    }
}

fn fly(path: &Path, source: &SourceArgs, range_m: f64) -> anyhow::Result<Sources> {
    let scan = scan_options(source, range_m)?;
    let seconds = source.seconds.unwrap_or(FLIGHT_SECONDS);
    let mut options = TrajectoryOptions { duration_s: seconds, ..TrajectoryOptions::default() };
    options.speed_m_s = source.speed.unwrap_or(options.speed_m_s);
    options.check(source.robots).map_err(as_given)?;
    let world = Arc::new(open_world(path, source)?);
    let trajectories = Trajectory::plan(&world, source.robots, source.seed, &options)
        .with_context(|| format!("no flight for {} robots through {}", source.robots, path.display()))?;
    let seen = || trajectories.iter().filter(|_| source.see_team_mates).map(Trajectory::poses);
    let team = Team::new(seen().map(|poses| (poses, Stamp(0))));
    let obstacles =
        ObstacleOptions { count: source.moving_obstacles, duration_s: seconds, ..ObstacleOptions::default() };
    let mut tracks = Tracks::obstacles(&world, source.seed, &obstacles).context("--moving-obstacles")?;
    let mut own = vec![None; trajectories.len()];
    for (own, poses) in own.iter_mut().zip(seen()) {
        *own = Some(tracks.push(Shape::ROBOT, poses)?);
    }
    let tracks = Arc::new(tracks);
    let robots = trajectories.into_iter().zip(own).enumerate().map(|(number, (trajectory, own))| {
        let team = team.clone();
        let flight = Flight::new(Arc::clone(&world), source.lidar, scan_options_of(number, scan), trajectory)
            .among(Arc::clone(&tracks), own);
        let frames_expected = flight.len() as u64;
        let frames = flight.map(move |frame| {
            let team_mates = team.mates(number, frame.scan.stamp);
            Ok(Frame { scan: frame.scan, pose: frame.t_map_sensor, team_mates })
        });
        Source {
            name: format!("robot{}", number + 1),
            frames_expected,
            seconds_expected: seconds,
            frames: Frames::new(frames),
        }
    });
    let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy();
    Ok(Sources {
        robots: robots.collect(),
        title: format!("{name}, {} simulated robots with {}", source.robots, source.lidar),
    })
}

/// How simulated robots scan. Each needs a seed of its own: see `scan_options_of`.
pub fn scan_options(source: &SourceArgs, range_m: f64) -> anyhow::Result<ScanOptions> {
    let lidar_range_m = source.lidar_range.unwrap_or(range_m);
    ensure!(
        lidar_range_m > 0.0 && lidar_range_m <= 1_000.0,
        "the LiDAR sees {lidar_range_m} m far, expected more than 0 and at most 1,000 m (--lidar-range, else --range)"
    );
    let options = ScanOptions {
        range_m: lidar_range_m,
        no_returns: source.no_returns,
        range_noise_m: source.range_noise,
        drop_out: source.drop_out,
        motion: source.scan_motion,
        rendering: source.rendering,
        seed: source.seed,
        ..ScanOptions::default()
    };
    options.check().map_err(as_given)?;
    Ok(options)
}

/// The same for one robot of a swarm: noise and drop-out of its own.
const fn scan_options_of(robot: usize, options: ScanOptions) -> ScanOptions {
    let seed = options.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(robot as u64);
    ScanOptions { seed, ..options }
}

/// The world that a name or file stands for.
pub fn open_world(path: &Path, source: &SourceArgs) -> anyhow::Result<World> {
    if path.to_str().is_some_and(|name| WORLDS.contains(&name)) {
        source.given.refuse(&["world_resolution"], "is for point clouds, and this world is generated")?;
    }
    match path.to_str() {
        Some("forest") => return Ok(World::forest(source.seed)),
        Some("indoor") => return Ok(World::indoor(source.seed)),
        _ => {}
    }
    if ending(path).as_deref() == Some("bt") {
        source.given.refuse(&["world_resolution"], "is for point clouds: an OctoMap says its own")?;
    }
    let side = source.world_resolution.map(|side| resolution("--world-resolution", side));
    Ok(World::open(path, side.transpose()?)?)
}
