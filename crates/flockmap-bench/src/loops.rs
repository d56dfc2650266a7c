//! `flockmap-bench loops`: what a closed loop puts right and costs, beside a map that is sent again.

mod compare;
mod drift;
mod flown;

use std::path::PathBuf;

use anyhow::ensure;
use clap::Args;
use flockmap::{Codec, RobotConfig};
use flockmap_cli::document::DataTable;
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::{MapArgs, SourceArgs, delay_micros, share};
use flockmap_cli::{json_file, outputs};
use flockmap_netsim::{Link, RadioConfig};
use serde::Serialize;

use compare::{Likeness, Obstacles};
use drift::Drift;
use flown::{Flown, Plan};

/// What a closed loop puts right and costs, beside a map that is sent again
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench loops forest --seconds 140 --closures 4
  flockmap-bench loops forest --seconds 140 --closures 4 --loss 0.3
  flockmap-bench loops hku_mb/robot1.mcap --resolution 0.2 --range 30 --steps 10

One robot maps, and --listeners get its map. It flies three times: with the poses as they are; with poses that drift; and with poses that
drift, in submaps. A closure puts right every submap since the one before, by the drift of its middle: --closures at even distances, the last one
at the end, in --steps steps. Compared is the map of a listener with that of the flight without drift. To send the map again would take
what the flight without drift took. Exit code 1 if a submap lies elsewhere than it was put on any robot at the end.")]
pub struct LoopsArgs {
    /// A record; or a world: forest, indoor, or a .bt .pcd .ply .las .laz file. Of several robots the first one
    #[arg(value_name = "RECORD")]
    pub record: PathBuf,
    /// Drift of the position in per cent of the way
    #[arg(long, value_name = "P", default_value_t = 1.0)]
    pub drift: f64,
    /// Drift of the yaw in degrees for each metre of way
    #[arg(long, value_name = "D", default_value_t = 0.02)]
    pub drift_yaw: f64,
    /// Times that a loop is closed, 1 or more
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub closures: u32,
    /// Steps in which the last closure is taken back, 1 or more
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub steps: u32,
    /// Robots that get the map
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub listeners: u16,
    /// Share of datagrams that the radio loses, 0 to less than 1
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    pub loss: f64,
    /// Delay of the radio in milliseconds
    #[arg(long, value_name = "D", default_value_t = 20.0)]
    pub delay_ms: f64,
    /// Write what the table shows as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// Length of a submap where none is given.
const LENGTH_M: f64 = 12.0;

/// What the JSON holds.
#[derive(Serialize, Debug)]
struct Output {
    title: String,
    way_m: f64,
    submaps: usize,
    submap_length_m: f64,
    loss: f64,
    maps: Vec<Row>,
    /// Packages of the flight without drift.
    map_bytes: u64,
    /// Packages of the flight in submaps, and of them what was said of submaps: that they begin, and where they lie.
    submaps_map_bytes: u64,
    submaps_bytes: u64,
    /// Of them those of the last closure; and everything on the wire meanwhile, requests and headers too.
    closure_bytes: u64,
    closure_wire_bytes: u64,
    /// The slowest step until it was shown everywhere.
    step_s_max: f64,
    /// The longest call of a robot while something was put right.
    longest_call_ms: f64,
    /// The longest that a scan took to be mapped while something was put right.
    longest_scan_ms: f64,
    is_right: bool,
}

/// A map beside that of the flight without drift.
#[derive(Serialize, Debug)]
struct Row {
    name: &'static str,
    /// Packages of its flight so far.
    package_bytes: u64,
    #[serde(flatten)]
    likeness: Likeness,
}

/// Runs the command. Whether every robot has every submap where it was put.
pub fn run(args: &LoopsArgs) -> anyhow::Result<bool> {
    let loss = share("--loss", args.loss)?;
    ensure!(args.steps > 0, "--steps is 0, expected at least 1");
    ensure!(args.closures > 0, "--closures is 0, expected at least 1");
    ensure!(args.listeners > 0, "--listeners is 0, expected at least 1");
    let config = args.map.robot(Codec::Flock, args.source.seed)?;
    let length_m = config.submap_length_m.unwrap_or(LENGTH_M);
    let drift = Drift { per_metre: args.drift / 100.0, yaw_per_metre: args.drift_yaw.to_radians() };
    let link = Link { loss, delay_micros: delay_micros("--delay-ms", args.delay_ms)?, ..Link::default() };
    let plan = Plan {
        record: &args.record,
        source: &args.source,
        range_m: args.map.range,
        // This command begins them, so that it knows where.
        config: RobotConfig { submap_length_m: None, ..config },
        listeners: args.listeners,
        radio: RadioConfig { seed: args.source.seed, link, ..RadioConfig::default() },
    };

    let right = Flown::fly(&plan, Drift::NONE, None)?;
    let (way_m, map_bytes) = (right.way_m, right.first().counters().package_bytes);
    let truth = Obstacles::of(right.listener().map());
    let row = |name, flown: &Flown| Row {
        name,
        package_bytes: flown.first().counters().package_bytes,
        likeness: truth.likeness(flown.listener().map()),
    };
    let mut maps = vec![row("without drift", &right)];
    drop(right);
    maps.push(row("with drift", &Flown::fly(&plan, drift, None)?));
    let closures = flown::Closures {
        length_m,
        closures: args.closures,
        every_m: way_m / f64::from(args.closures),
        steps: args.steps,
    };
    let mut flown = Flown::fly(&plan, drift, Some(closures))?;
    maps.push(row("in submaps, before the last closure", &flown));
    let last = flown.close_last()?;
    maps.push(row("in submaps, put right", &flown));

    let counters = flown.first().counters();
    let output = Output {
        title: format!(
            "{}, drift of {} % and {}° a metre",
            args.record.display(),
            args.drift,
            args.drift_yaw
        ),
        way_m,
        submaps: flown.submaps(),
        submap_length_m: length_m,
        loss,
        maps,
        map_bytes,
        submaps_map_bytes: counters.package_bytes,
        submaps_bytes: counters.submap_package_bytes,
        closure_bytes: last.package_bytes,
        closure_wire_bytes: last.wire_bytes,
        step_s_max: flown.step_s_max(),
        longest_call_ms: flown.longest_call_s() * 1e3,
        longest_scan_ms: flown.longest_scan_s() * 1e3,
        is_right: flown.is_right(),
    };
    output.print(args);
    json_file::write_asked(args.json.as_deref(), &output)?;
    Ok(output.is_right)
}

impl Output {
    fn print(&self, args: &LoopsArgs) {
        println!(
            "\n{}: {:.0} m in {} submaps of {} m, {:.0} % of datagrams lost",
            self.title,
            self.way_m,
            self.submaps,
            self.submap_length_m,
            self.loss * 100.0
        );
        let percent = |share: f64| format!("{:.1} %", share * 100.0);
        let rows = self.maps.iter().map(|Row { name, package_bytes, likeness }| {
            [
                (*name).to_owned(),
                thousands(*package_bytes),
                thousands(likeness.known),
                percent(likeness.same),
                thousands(likeness.occupied),
                percent(likeness.near),
                percent(likeness.found),
                format!("{:.3}", likeness.thickness_m),
            ]
        });
        let headings = ["", "bytes sent", "voxels", "same", "obstacles", "right", "found", "thick m"];
        println!("{}", DataTable::unnamed(headings, rows));
        println!(
            "  bytes sent: packages so far. same: share of the voxels known in both maps. right: obstacles within a voxel of one of the map without drift; found: its \
             obstacles within a voxel of one here.\n  thick: how far an obstacle goes on along the axis on which that is least, the mean.\n"
        );
        let of_map = |bytes: u64| bytes as f64 / self.map_bytes.max(1) as f64 * 100.0;
        println!("  sent again the map takes       {:>11} bytes of packages", thousands(self.map_bytes));
        println!(
            "  in submaps it took             {:>11} ({:+.1} %), of them {} to say that they begin and where they lie",
            thousands(self.submaps_map_bytes),
            of_map(self.submaps_map_bytes) - 100.0,
            thousands(self.submaps_bytes)
        );
        println!(
            "  the last closure, in {} steps:  {:>11} ({:.2} %), and {} on the wire meanwhile, requests and headers of all robots too",
            args.steps,
            thousands(self.closure_bytes),
            of_map(self.closure_bytes),
            thousands(self.closure_wire_bytes)
        );
        println!(
            "  a step was shown on every robot after {:.2} s at the latest; longest call while one was put right {:.1} ms, longest scan \
             {:.1} ms",
            self.step_s_max, self.longest_call_ms, self.longest_scan_ms
        );
        println!(
            "  submaps at the end: {}",
            if self.is_right { "all where they were put" } else { "NOT ALL ARE" }
        );
    }
}
