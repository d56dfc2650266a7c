//! The same methods on recordings of real sensors.

use std::path::{Path, PathBuf};

use flockmap_cli::document::{Part, Section, Verdict};
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::SourceArgs;
use flockmap_cli::sources::{self, Sources};

use super::args::PaperArgs;
use super::figures::PUBLISH_PERIOD_S;
use super::methods::{self, MethodRows};
use super::settings::mapper;
use super::team::{self, Team};

/// What was measured, or why nothing was.
pub struct Measured {
    pub title: String,
    pub methods: MethodRows,
}

/// The records that the command line names, or those in the data folder.
pub fn records(args: &PaperArgs) -> Vec<PathBuf> {
    if !args.records.is_empty() {
        return args.records.clone();
    }
    let Some(folder) = std::env::var_os("FLOCKMAP_DATA") else { return Vec::new() };
    let files = [1, 2].map(|number| Path::new(&folder).join(format!("hku_mb/robot{number}.mcap")));
    if files.iter().all(|file| file.is_file()) { files.to_vec() } else { Vec::new() }
}

/// All methods, and our own stack, on the records as robots.
pub fn measure(args: &PaperArgs, records: &[PathBuf], threads: usize) -> anyhow::Result<Option<Measured>> {
    let source = SourceArgs { seconds: args.quick.then_some(20.0), ..SourceArgs::default() };
    let open = || -> anyhow::Result<Sources> {
        match records {
            [record] => sources::open_parts(record, &source),
            records => sources::open(records, &source, args.beyond_range, false),
        }
    };
    let Sources { robots, title } = open()?;
    let team = Team {
        name: "recordings".to_owned(),
        title: title.clone(),
        about_stack: "As in Table I.",
        mapper: mapper(args.beyond_resolution, args.beyond_range)?,
        robots: robots.len(),
        open: Box::new(|| Ok(open()?.robots)),
        // A scan of these recordings is a quarter of a simulated one: there is time for more of them.
        relayed_s: 3.0 * methods::relayed_s(args.quick),
        is_within: |_, frame, seconds| frame.scan.stamp.seconds() < seconds,
    };
    drop(robots);
    let measured = team::measure(&[team], args.seed, threads)?.pop().flatten();
    Ok(measured.map(|measured| Measured { title, methods: measured.methods }))
}

/// Whether every lossless method is.
pub fn verdict(measured: &Measured) -> Verdict {
    let broken = measured.methods.rows.iter().filter(|row| !row.is_as_promised);
    let broken: Vec<&str> = broken.map(|row| row.name.as_str()).collect();
    let words = if broken.is_empty() {
        "Every lossless method ends with every voxel right on the recordings.".to_owned()
    } else {
        format!(
            "Recordings: NOT LOSSLESS: {}. This is a fault of flockmap, please report it.",
            broken.join(", ")
        )
    };
    Verdict::good_if(broken.is_empty(), words)
}

pub fn section(args: &PaperArgs, measured: Option<&Measured>) -> Section {
    let parts = match measured {
        Some(Measured { title, methods }) => {
            let note = format!(
                "{title}: {} m voxels, {} m range, publish period {PUBLISH_PERIOD_S} s; {} voxels changed.",
                args.beyond_resolution,
                args.beyond_range,
                thousands(methods.changed_voxels)
            );
            let words = "The paper has no recordings to repeat. These are of a real sensor, and none was used to choose anything.";
            vec![
                Part::Words(words.to_owned()),
                Part::Figure(methods.bars()),
                Part::Table(methods.table("beyond").with_note(note)),
            ]
        }
        None => {
            let words = "Skipped: no recording was named, and there is none in the folder that FLOCKMAP_DATA names (hku_mb/robot1.mcap, robot2.mcap).";
            vec![Part::Words(words.to_owned())]
        }
    };
    Section::new("beyond", "Beyond the paper: recordings", parts)
}
