//! `flockmap-bench calls`: the longest single call of a robot that holds a large map.

pub mod meter;
mod pair;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, ensure};
use clap::Args;
use flockmap::grid::Layer;
use flockmap::{MapView, Pose, Resolution, Robot, RobotConfig, RobotId, Stamp, Stream, epoch};
use flockmap_cli::document::DataTable;
use flockmap_cli::numbers::thousands;
use flockmap_cli::progress::{Progress, line, within};
use flockmap_cli::{json_file, outputs, stop};
use serde::Serialize;

use crate::corridor;
use meter::{Call, Meter, Taken};
use pair::{Measured, step};

/// The longest single call of robots that hold a large map, and how long each piece of long work takes in all
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench calls --metres 230             7.7 million voxels
  flockmap-bench calls --metres 900 --runs 3    30 million; of three runs the shortest times

Robot 1 flies a corridor of which every metre is new, as `flockmap-bench layers corridor` has it. Robot 2 joins when all
is seen and gets a snapshot. Then robot 2 is told other alignments and a clock offset, and mutes robot 1; a robot comes
back from what each of the two would have stored; and robot 1 begins a new run, so that robot 2 forgets the one before.
A row is one kind of call during one piece of work: how many there were, the longest one, and all of them together.
Times are of the processor, so that other programs on it do not count.
Exit code 1 if a map is not the one that is made in one step.")]
pub struct CallsArgs {
    /// Length of the corridor: 33,500 voxels a metre
    #[arg(long, value_name = "M", default_value_t = 230, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub metres: u32,
    /// Times that all is done; of each figure the least counts
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub runs: u32,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

/// One kind of call during one piece of work.
#[derive(Clone, Serialize, Debug)]
struct Row {
    work: &'static str,
    robot: &'static str,
    call: Call,
    calls: u64,
    longest_ms: f64,
    sum_ms: f64,
    /// Whether the map is that of one step when the work is done.
    is_same: bool,
}

/// Runs the command. Whether all maps were those of one step.
pub fn run(args: &CallsArgs) -> anyhow::Result<bool> {
    let mut rows: Vec<Row> = Vec::new();
    for number in 1..=args.runs {
        let all = within(&format!("run {number} of {}", args.runs), || Run::new(args.metres)?.all())?;
        if stop::requested() {
            break;
        }
        if rows.is_empty() {
            rows = all;
            continue;
        }
        for (row, again) in rows.iter_mut().zip(all) {
            row.longest_ms = row.longest_ms.min(again.longest_ms);
            row.sum_ms = row.sum_ms.min(again.sum_ms);
            row.is_same &= again.is_same;
        }
    }
    print(&rows);
    json_file::write_asked(args.json.as_deref(), &rows)?;
    Ok(rows.iter().all(|row| row.is_same))
}

/// Simulated time after which work that is not done has failed.
const GIVE_UP: Duration = Duration::from_secs(600);

struct Run {
    metres: u32,
    pair: [Measured; 2],
    now: Stamp,
    rows: Vec<Row>,
}

impl Run {
    fn new(metres: u32) -> anyhow::Result<Self> {
        let now = Stamp(0);
        let first = Measured::new(robot(1, 1, now)?);
        let second = Measured::new(robot(2, 1, now)?);
        Ok(Self { metres, pair: [first, second], now, rows: Vec::new() })
    }

    fn all(mut self) -> anyhow::Result<Vec<Row>> {
        self.fly()?;
        self.join_late()?;
        self.set()?;
        self.restore("restored from packages", 0)?;
        self.restore("restored from chunks", 1)?;
        self.begin_anew()?;
        Ok(self.rows)
    }

    fn fly(&mut self) -> anyhow::Result<()> {
        let scans = corridor::scans(self.metres);
        let progress = Progress::new("scans", scans.into());
        let [first, _] = &mut self.pair;
        for step in 0..scans {
            if stop::requested() {
                break;
            }
            first.robot.insert_scan(self.now, &corridor::scan(step), &corridor::pose(step))?;
            for _ in 0..10 {
                self.now = self.now.plus_micros(20_000);
                first.pass(self.now);
                while first.robot.poll_transmit(self.now).is_some() {}
            }
            progress.step();
        }
        let Measured { robot, meter, .. } = first;
        meter.time(Call::Flush, || robot.flush(self.now));
        first.take_events();
        let layer = first.robot.fusion().layer(first.robot.own_stream()).context("nothing was published")?;
        line(&format!("{} voxels", thousands(layer.len() as u64)));
        self.look_at_status();
        self.note("flight", true);
        Ok(())
    }

    /// What a driver asks for now and then.
    fn look_at_status(&mut self) {
        for Measured { robot, meter, .. } in &mut self.pair {
            meter.time(Call::Status, || {
                let voxels: usize = robot.fusion().layers().map(|(_, layer)| layer.len()).sum();
                (voxels, robot.unpublished(), robot.fusion().memory_bytes_of_others(robot.mapper()))
            });
        }
    }

    fn join_late(&mut self) -> anyhow::Result<()> {
        self.until("one joins late", |[first, second]| second.holds_all_of(&first.robot))?;
        self.look_at_status();
        let is_same = self.is_copied();
        self.note("one joins late", is_same);
        Ok(())
    }

    /// Goes on until it is so.
    fn until(&mut self, what: &str, is_done: impl Fn(&[Measured; 2]) -> bool) -> anyhow::Result<()> {
        let (began, progress) = (self.now, Progress::new(&format!("{what}: steps of 20 ms"), 0));
        while !is_done(&self.pair) && !stop::requested() {
            ensure!(self.now.since(began) < GIVE_UP, "{what}: not done after {} s", GIVE_UP.as_secs());
            step(&mut self.pair, &mut self.now);
            progress.step();
        }
        Ok(())
    }

    /// Whether robot 2 has what robot 1 has published, to the stamp.
    fn is_copied(&self) -> bool {
        let [first, second] = &self.pair;
        let stream = first.robot.own_stream();
        digest(&first.robot, stream) == digest(&second.robot, stream)
    }

    /// What is set for robot 1 at robot 2.
    fn set(&mut self) -> anyhow::Result<()> {
        let other = RobotId(1);
        let mut in_one_step = robot(3, 1, self.now)?;
        for package in &self.pair[0].stored {
            in_one_step.restore(self.now, package.clone())?;
            while in_one_step.poll_event().is_some() {}
        }
        // These are poses.
        let align = |pose: Pose| {
            move |robot: &mut Robot| {
                let _ = robot.set_alignment(other, &pose);
            }
        };
        let mute = |is_muted: bool| move |robot: &mut Robot| robot.set_muted(other, is_muted);
        type Set<'a> = (&'static str, Call, Box<dyn Fn(&mut Robot) + 'a>);
        let all: [Set<'_>; 6] = [
            ("moved", Call::SetAlignment, Box::new(align(Pose::from_translation([0.05, 0.0, 0.0])))),
            ("turned", Call::SetAlignment, Box::new(align(Pose::from_yaw([0.05, 0.02, 0.0], 0.3)))),
            ("moved back", Call::SetAlignment, Box::new(align(Pose::IDENTITY))),
            (
                "another clock offset",
                Call::SetClockOffset,
                Box::new(|robot| robot.set_clock_offset(other, Some(5))),
            ),
            ("muted", Call::SetMuted, Box::new(mute(true))),
            ("taken in again", Call::SetMuted, Box::new(mute(false))),
        ];
        for (work, call, set) in all {
            let second = &mut self.pair[1];
            second.meter.time(call, || set(&mut second.robot));
            self.until(work, |[_, second]| !second.robot.is_rebuilding())?;
            set(&mut in_one_step);
            in_one_step.finish_rebuild();
            let is_same = is_same(self.pair[1].robot.map(), in_one_step.map());
            self.note(work, is_same);
        }
        Ok(())
    }

    /// A robot comes back from what one of the two would have on disk.
    fn restore(&mut self, work: &'static str, of: usize) -> anyhow::Result<()> {
        let mut robot = robot(4, 1, self.now)?;
        let mut meter = Meter::default();
        let progress = Progress::new(work, self.pair[of].stored.len() as u64);
        for package in &self.pair[of].stored {
            // As the node sees it: those of the own id have no place in the same run.
            let package = package.clone();
            meter.time(Call::Restore, || robot.restore(self.now, package))?;
            while robot.poll_event().is_some() {}
            progress.step();
        }
        let mut slices = Measured::new(robot);
        slices.meter = meter;
        while slices.robot.is_rebuilding() {
            slices.pass(self.now);
        }
        let is_same = is_same(slices.robot.map(), self.pair[1].robot.map());
        self.note_of(work, "4", &slices.meter, is_same);
        Ok(())
    }

    /// A robot with the id of robot 1 and a higher epoch is heard: robot 1 begins anew, and robot 2 keeps one run.
    fn begin_anew(&mut self) -> anyhow::Result<()> {
        let published = self.pair[0].robot.own_stream();
        let before = digest(&self.pair[0].robot, published);
        let mut other = robot(1, epoch(1_000, 1), self.now)?;
        let greeting = other.poll_transmit(self.now).context("a robot greets when it starts")?;
        let _ = self.pair[1].robot.handle_datagram(self.now, &greeting.bytes);
        self.until("begun anew", |[first, second]| {
            let own = first.robot.own_stream();
            own != published
                && first.robot.unpublished() == 0
                && !second.robot.is_rebuilding()
                && second.holds_all_of(&first.robot)
        })?;
        self.look_at_status();
        let own = self.pair[0].robot.own_stream();
        let after = digest(&self.pair[0].robot, own);
        let is_same = before == after && self.is_copied();
        self.note("begun anew", is_same);
        Ok(())
    }

    /// Notes what both have taken for a piece of work.
    fn note(&mut self, work: &'static str, is_same: bool) {
        let meters = self.pair.each_mut().map(|measured| core::mem::take(&mut measured.meter));
        for (robot, meter) in ["1", "2"].into_iter().zip(meters) {
            self.note_of(work, robot, &meter, is_same);
        }
    }

    fn note_of(&mut self, work: &'static str, robot: &'static str, meter: &Meter, is_same: bool) {
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        self.rows.extend(meter.0.iter().map(|(call, Taken { calls, longest, sum })| Row {
            work,
            robot,
            call: *call,
            calls: *calls,
            longest_ms: ms(*longest),
            sum_ms: ms(*sum),
            is_same,
        }));
    }
}

fn robot(id: u16, epoch: u64, now: Stamp) -> anyhow::Result<Robot> {
    let resolution = Resolution::from_micrometres(100_000).context("no resolution")?;
    let mut config = RobotConfig::new(RobotId(id), resolution, 7.0);
    (config.epoch, config.seed) = (epoch, id.into());
    // All of the flight stays in the own map; and one run of another robot takes the place of the one before.
    config.mapper.memory_bytes_max = 8 << 30;
    config.session.epochs_max = 1;
    // Who joins late gets a snapshot: most packages are gone.
    config.session.store_bytes_max = 1 << 20;
    Ok(Robot::new(config, now)?)
}

/// What is known of a stream, to the stamp.
fn digest(robot: &Robot, stream: Stream) -> Option<u64> {
    robot.fusion().layer(stream).map(Layer::digest)
}

fn is_same(map: &MapView, other: &MapView) -> bool {
    map.block_count() == other.block_count()
        && map.blocks().all(|(index, states)| other.block(index) == Some(states))
}

fn print(rows: &[Row]) {
    let table = DataTable::of_text(
        rows,
        &[
            ("work", &|row| row.work.to_owned()),
            ("robot", &|row| row.robot.to_owned()),
            ("call", &|row| row.call.name().to_owned()),
            ("calls", &|row| thousands(row.calls)),
            ("longest ms", &|row| format!("{:.1}", row.longest_ms)),
            ("all ms", &|row| format!("{:.0}", row.sum_ms)),
            ("same", &|row| if row.is_same { "yes" } else { "no" }.to_owned()),
        ],
    );
    if stop::requested() {
        println!("partial: ended by Ctrl-C\n");
    }
    print!("{table}");
}
