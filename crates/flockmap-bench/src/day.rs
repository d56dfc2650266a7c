//! `flockmap-bench day`: robots that fly all day, each its own way, and one that joins when all is seen.

mod compare;
mod outcome;
mod resident;
mod same;
mod swarm;

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use clap::Args;
use flockmap::{Pose, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp};
use flockmap_cli::measure::Times;
use flockmap_cli::progress::Progress;
use flockmap_cli::{json_file, outputs, stop};

use crate::calls::meter::Call;
use crate::corridor;
use outcome::{CallsRow, JoinerRow, Outcome, RobotRow, StageRow, TimesRow};
use resident::resident;
use swarm::{Member, Swarm, Waited};

/// What robots hold and take that fly many kilometres, and whether one that joins late gets all of it
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench day --metres 100                         a quarter of a minute: 3 robots, 10 million voxels
  flockmap-bench day --json day.json                      30 km together, a billion voxels: an hour, and some GB
  flockmap-bench day --robots 2 --metres 1000 --no-joiner
  flockmap-bench day --robots 1 --metres 5000 --own-layer-mb 64
                                                          it drops what is far and old: the late joiner gets what is left

Each robot flies a straight corridor of its own, 100 m beside the next one, of which every metre is new and nothing is
seen twice, as `flockmap-bench layers corridor` has it: 2 m/s, five scans a second. All robots are of default options,
with their default caps of memory and of 2 MB/s, and hear each other all the time; the radio loses nothing and carries
everything at once. When all agree, a robot without scans joins, and time goes on until it holds all packages, or for
three hours nothing new has come. Time is virtual; where nothing is to be done it is left out.

What the tables say:
  robots   what each holds when all agree, and the late joiner at the end: own layer; layers of others with what they
           add to the fused map, as their cap counts them; blocks dropped for want of room; whether its layers are those
           of their origins, by a digest of all voxels and stamps
  times    processor time on the first and the last kilometre, or on the first and the last half of a shorter flight.
           t_pack: a call of handle_timeout that closes a batch, coding and own layer included. t_recv2insert: a call of
           handle_datagram that merges what it brings
  calls    the longest single call of each kind, in processor time
  stages   virtual time and time gone by until then, and memory of the process that is resident
  joiner   what it received, and each of its layers beside that of the origin, voxel by voxel with the stamps; its fused
           map beside that of robot 1, if all layers are whole. No change to Unknown is sent: what robot 1 has published
           and then taken back, or forgotten where its own map is full (512 MiB), the joiner keeps

Of what a robot has dropped of its own layer for want of room, the others may still hold all; then all is wanted, and
else what is left.

Exit code 1 if anything is lacking or not the same.")]
pub struct DayArgs {
    /// Robots that fly
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u16).range(1..=30))]
    pub robots: u16,
    /// Way that each of them flies: 33,500 voxels a metre
    #[arg(long, value_name = "M", default_value_t = 10_000, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub metres: u32,
    /// Most memory of a robot's own layer [default: that of every robot, 256 MiB, which is 17 km]
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u16).range(1..=4_096))]
    pub own_layer_mb: Option<u16>,
    /// Nobody joins late
    #[arg(long)]
    pub no_joiner: bool,
    /// Write the tables as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

/// Virtual time between two scans.
const SCAN_MICROS: i64 = 200_000;
/// Metres between two corridors: no ray reaches the next one.
const LANE_M: f64 = 100.0;
/// The scans of two robots are so many steps apart, so that they are not the same.
const STEPS_APART: u32 = 1_009;
/// The part at the begin and at the end of a flight of which times are said.
const PART_METRES: u32 = 1_000;

/// Runs the command. Whether nothing is lacking and all is the same.
pub fn run(args: &DayArgs) -> anyhow::Result<bool> {
    let mut day = Day::new(args)?;
    day.fly()?;
    day.agree()?;
    if !args.no_joiner && !stop::requested() {
        day.join_late()?;
    }
    day.outcome.is_interrupted = stop::requested();
    day.outcome.print();
    json_file::write_asked(args.json.as_deref(), &day.outcome)?;
    Ok(day.outcome.is_good())
}

struct Day {
    swarm: Swarm,
    scans: u32,
    began: Instant,
    outcome: Outcome,
}

impl Day {
    fn new(args: &DayArgs) -> anyhow::Result<Self> {
        let own_layer_bytes = args.own_layer_mb.map(|mib| usize::from(mib) << 20);
        let robots = (1..=args.robots).map(|id| robot(id, Stamp(0), own_layer_bytes).map(Member::new));
        Ok(Self {
            swarm: Swarm::new(robots.collect::<anyhow::Result<_>>()?),
            scans: corridor::scans(args.metres),
            began: Instant::now(),
            outcome: Outcome { metres: args.metres, ..Outcome::default() },
        })
    }

    fn fly(&mut self) -> anyhow::Result<()> {
        let part = corridor::scans(PART_METRES).min(self.scans / 2);
        let is_short = part < corridor::scans(PART_METRES);
        let progress = Progress::new("scans of each robot", self.scans.into());
        for step in 0..self.scans {
            if stop::requested() {
                break;
            }
            if step == part {
                self.note_times(if is_short { "first half" } else { "first km" });
            } else if step == self.scans - part {
                self.take_times();
            }
            let now = self.swarm.now;
            for (number, member) in (0u32..).zip(&mut self.swarm.members) {
                let scan = Scan { stamp: now, ..corridor::scan(step + number * STEPS_APART) };
                let [x, ..] = corridor::pose(step).translation();
                let pose = Pose::from_translation([x, f64::from(number) * LANE_M, 0.0]);
                let Member { robot, meter, .. } = member;
                meter.time(Call::InsertScan, || robot.insert_scan(now, &scan, &pose))?;
            }
            self.swarm.pass(SCAN_MICROS)?;
            progress.step();
        }
        let part = match is_short {
            _ if stop::requested() => "what was flown",
            true => "last half",
            false => "last km",
        };
        self.note_times(part);
        self.note_stage("end of the flight");
        Ok(())
    }

    /// The times of batches and datagrams since this was asked last, of all robots together.
    fn take_times(&mut self) -> [Times; 2] {
        let mut all = [Times::default(), Times::default()];
        for Member { packing, inserting, .. } in &mut self.swarm.members {
            all[0].0.append(&mut packing.0);
            all[1].0.append(&mut inserting.0);
        }
        all
    }

    fn note_times(&mut self, part: &'static str) {
        let [packing, inserting] = self.take_times().map(|times| times.summary());
        self.outcome.times.push(TimesRow { part, packing, inserting });
    }

    fn agree(&mut self) -> anyhow::Result<()> {
        self.outcome.is_agreed = self.wait("until all agree", Swarm::is_agreed)?.is_done;
        self.note_stage(if self.outcome.is_agreed { "all agree" } else { "waited for all to agree" });
        self.note_calls("flight");
        self.outcome.robots = compare::flown(&self.swarm);
        self.note_stage("layers compared");
        Ok(())
    }

    fn join_late(&mut self) -> anyhow::Result<()> {
        let (flown, began) = (self.swarm.members.len(), self.swarm.now);
        let snapshots_before = self.swarm.snapshots();
        self.swarm.members.push(Member::new(robot(flown as u16 + 1, began, None)?));
        let waited = self.wait("late joiner", |swarm| {
            swarm.members.last().is_some_and(|joiner| swarm.is_served(joiner))
        })?;
        self.note_stage("the late joiner is done");
        let snapshots = self.swarm.snapshots() - snapshots_before;
        let (flown, joiner) = self.swarm.members.split_at(flown);
        let joiner = joiner.first().context("nobody has joined")?;
        let processor_s = joiner.meter.sum().as_secs_f64();
        let (streams, map) = compare::joined(joiner, flown);
        let row = JoinerRow {
            holds_all: waited.is_done,
            virtual_s: waited.newest.since(began).as_secs_f64(),
            processor_s,
            bytes: joiner.bytes,
            datagrams: joiner.datagrams,
            snapshots,
            streams,
            map,
        };
        self.outcome.robots.push(RobotRow { is_same: row.has_same_layers(), ..RobotRow::of(joiner) });
        self.outcome.joiner = Some(row);
        self.note_stage("the late joiner compared");
        self.note_calls("late joiner");
        Ok(())
    }

    /// Lets time pass until it is so, or nothing more comes.
    fn wait(&mut self, what: &str, is_done: impl Fn(&Swarm) -> bool) -> anyhow::Result<Waited> {
        let (progress, began) = (Progress::new(what, 0), self.swarm.now);
        self.swarm.until(is_done, |swarm| {
            let voxels = swarm.members.last().map_or(0, Member::voxels_of_others) / 1_000_000;
            progress.say(format!("{what}: {voxels} million voxels of others, seconds of virtual time"));
            progress.set(swarm.now.since(began).as_secs());
        })
    }

    /// The longest calls since this was asked last.
    fn note_calls(&mut self, work: &'static str) {
        for member in &mut self.swarm.members {
            let meter = core::mem::take(&mut member.meter);
            self.outcome.calls.push(CallsRow::of(work, member.id(), &meter));
        }
    }

    fn note_stage(&mut self, stage: &'static str) {
        self.outcome.stages.push(StageRow {
            stage,
            virtual_s: self.swarm.now.seconds(),
            wall_s: self.began.elapsed().as_secs_f64(),
            resident: resident(),
        });
    }
}

fn robot(id: u16, now: Stamp, own_layer_bytes: Option<usize>) -> anyhow::Result<Robot> {
    let resolution = Resolution::from_micrometres(100_000).context("no resolution")?;
    let mut config = RobotConfig { seed: id.into(), ..RobotConfig::new(RobotId(id), resolution, 7.0) };
    config.fusion.own_layer_bytes_max = own_layer_bytes.unwrap_or(config.fusion.own_layer_bytes_max);
    Ok(Robot::new(config, now)?)
}
