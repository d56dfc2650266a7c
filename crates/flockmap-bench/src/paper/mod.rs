//! `flockmap-bench paper`: the paper's Section V, from its explorations to its application, in one report.

mod application;
mod args;
mod beyond;
pub mod figures;
mod flown;
mod jobs;
mod methods;
mod settings;
mod stack;
mod table1;
mod table2;
mod table3;
mod table4;
mod team;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use flockmap_cli::document::{Cell, DataTable, Document, Part, Section, Verdict};
use flockmap_cli::measure::KB;
use flockmap_cli::numbers::percent_short;
use flockmap_cli::parallel::cores;
use flockmap_cli::robot_record::RecordFacts;
use flockmap_cli::{progress, stop};
use serde_json::json;

use crate::place::Place;
use crate::random;
pub use args::PaperArgs;
use args::Stage;
use flown::{Explored, Flown};

/// Of what can be seen an exploration must see this share.
const SEEN_SHARE: f64 = 0.95;

/// In the order in which stages are done, and in which they stand in the report: a name, and the seconds that
/// it took on two cores, as it is and quick. For the time left: only their proportions count.
static STAGES: [(Stage, &str, [f64; 2]); 7] = [
    (Stage::Table1, "Table I, all methods on four explorations", [400.0, 45.0]),
    (Stage::Table2, "Table II, Hilbert walk against nested order", [20.0, 1.0]),
    (Stage::Table3, "Table III, an emulated Wi-Fi", [60.0, 4.0]),
    (Stage::Table4, "Table IV, times, one core", [15.0, 2.0]),
    (Stage::Fig5, "Fig. 5, changes drawn at random", [40.0, 6.0]),
    (Stage::Application, "the application, flying on a team-mate's map", [500.0, 35.0]),
    (Stage::Beyond, "recordings", [60.0, 10.0]),
];

/// A report in the making.
struct Bench<'a> {
    args: &'a PaperArgs,
    threads: usize,
    stages: Vec<Stage>,
    /// Stages begun so far, and the seconds that all are expected to take.
    begun: usize,
    expected_s: Vec<f64>,
    started: Instant,
    sections: Vec<Section>,
    verdicts: Vec<Verdict>,
    skipped: Vec<&'static str>,
    timings: Vec<(String, f64)>,
}

/// Runs the command. Whether every lossless method is lossless.
pub fn run(args: &PaperArgs) -> anyhow::Result<bool> {
    let all = STAGES.iter().map(|(stage, ..)| *stage);
    let stages = if args.only.is_empty() { all.collect() } else { args.only.clone() };
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot make the folder {}", args.out.display()))?;
    let temporary;
    let records: &Path = if args.keep_records {
        &args.out.join("records")
    } else {
        // Beside the report: a folder for temporary files may be in memory, and flights are large.
        temporary = tempfile::Builder::new().prefix(".flights").tempdir_in(&args.out)?;
        temporary.path()
    };
    let mut bench = Bench {
        args,
        threads: args.threads.unwrap_or_else(cores).max(1),
        begun: 0,
        expected_s: Vec::new(),
        started: Instant::now(),
        sections: Vec::new(),
        verdicts: Vec::new(),
        skipped: Vec::new(),
        stages,
        timings: Vec::new(),
    };
    bench.expected_s = bench.expected();
    bench.all(records)?;
    let document = bench.document();
    document.print(false);
    document.write(&args.out, &document.json())?;
    Ok(document.is_good())
}

impl Bench<'_> {
    /// Scenes that the wanted stages need.
    fn scenes(&self) -> Vec<Place> {
        let of_forest = [Stage::Table1, Stage::Table2, Stage::Table3, Stage::Table4];
        let forest = self.stages.iter().any(|stage| of_forest.contains(stage)).then_some(Place::Forest);
        let indoor = self.stages.contains(&Stage::Table1).then_some(Place::Indoor);
        forest.into_iter().chain(indoor).collect()
    }

    /// Seconds that the flights and each stage took on two cores.
    fn expected(&self) -> Vec<f64> {
        let flights = match self.scenes().len() {
            0 => None,
            1 => Some([130.0, 20.0]),
            _ => Some([300.0, 40.0]),
        };
        let wanted = STAGES.iter().filter(|(stage, ..)| self.stages.contains(stage));
        let seconds = flights.into_iter().chain(wanted.map(|(.., seconds)| *seconds));
        seconds.map(|seconds| seconds[usize::from(self.args.quick)]).collect()
    }

    /// About how many seconds are left before the stage that begins now, as text.
    fn left(&self) -> String {
        let done: f64 = self.expected_s.iter().take(self.begun - 1).sum();
        let passed = self.started.elapsed().as_secs_f64();
        // Until something is done, as fast as where the figures are from.
        let pace = if done > 0.0 { passed / done } else { 1.0 };
        let left = self.expected_s.iter().skip(self.begun - 1).sum::<f64>() * pace;
        if left < 90.0 {
            format!("about {left:.0} s left")
        } else {
            format!("about {:.0} min left", left / 60.0)
        }
    }

    /// Does a stage, unless it is not wanted.
    fn stage<T>(
        &mut self,
        stage: Stage,
        work: impl FnOnce(&mut Self) -> anyhow::Result<T>,
    ) -> anyhow::Result<Option<T>> {
        let wanted = STAGES.iter().find(|(other, ..)| *other == stage && self.stages.contains(&stage));
        wanted.map_or(Ok(None), |(_, name, _)| self.part(name, work))
    }

    /// Does a part, unless the user wants an end. `None` if it was not done, or not to its end.
    fn part<T>(
        &mut self,
        name: &'static str,
        work: impl FnOnce(&mut Self) -> anyhow::Result<T>,
    ) -> anyhow::Result<Option<T>> {
        self.begun += 1;
        if stop::requested() {
            self.skipped.push(name);
            return Ok(None);
        }
        progress::line(&format!(
            "stage {} of {}: {name} ({:.0} s so far, {})",
            self.begun,
            self.expected_s.len(),
            self.started.elapsed().as_secs_f64(),
            self.left()
        ));
        let started = Instant::now();
        let done = work(self).with_context(|| name.to_owned())?;
        self.timings.push((name.to_owned(), started.elapsed().as_secs_f64()));
        if stop::requested() {
            self.skipped.push(name);
        }
        Ok(Some(done))
    }

    fn all(&mut self, records: &Path) -> anyhow::Result<()> {
        let flights = self.flights(records)?;
        if !flights.is_empty() {
            self.verdicts.extend(flights.iter().filter_map(seen_verdict));
            self.sections.push(flights_section(&flights));
        }
        self.tables(&flights)?;
        let plan = random::Plan::new(self.args.quick, self.args.seed);
        if let Some(figure) = self.stage(Stage::Fig5, |_| random::measure(&plan))? {
            self.verdicts.push(random::lossless(&figure));
            self.sections.push(random::section(&figure, &plan));
        }
        let (args, threads) = (self.args, self.threads);
        let seeds = u64::from(args.seeds.unwrap_or(if args.quick { 2 } else { 20 }));
        let flown = self.stage(Stage::Application, |_| application::measure(seeds, args.quick, threads))?;
        if let Some(rows) = flown {
            self.verdicts.extend(application::verdict(&rows));
            self.sections.push(application::section(&rows));
        }
        let records: Vec<PathBuf> = beyond::records(self.args);
        if let Some(measured) = self.stage(Stage::Beyond, |bench| {
            if records.is_empty() { Ok(None) } else { beyond::measure(bench.args, &records, bench.threads) }
        })? {
            self.verdicts.extend(measured.as_ref().map(beyond::verdict));
            self.sections.push(beyond::section(self.args, measured.as_ref()));
        }
        Ok(())
    }

    /// The flights that the wanted stages need: opened, or flown and recorded, several at the same time.
    fn flights(&mut self, records: &Path) -> anyhow::Result<Vec<Flown>> {
        let scenes = self.scenes();
        if scenes.is_empty() {
            return Ok(Vec::new());
        }
        if let Some(folder) = &self.args.flights {
            let flown = self.part("opening the flights", |_| {
                scenes.iter().map(|scene| flown::open(*scene, folder)).collect()
            })?;
            return Ok(flown.unwrap_or_default());
        }
        let flown = self.part("exploring", |bench| {
            // What robots do between their scans is done one after the other: two flights side by side leave
            // no core idle.
            let threads = (bench.threads / scenes.len()).max(1);
            let args = bench.args;
            let job = |scene: &Place| {
                (format!("exploring the {} with {} robots", scene.words(), scene.robots()), *scene)
            };
            jobs::run(bench.threads, scenes.iter().map(job).collect(), |scene| {
                flown::fly(scene, scene.world(args.seed), flown::options(scene, args, threads), records)
            })
        })?;
        // Whatever Ctrl-C kept from being flown, in part or at all, is left out.
        Ok(flown.into_iter().flatten().flatten().flatten().collect())
    }

    fn tables(&mut self, flights: &[Flown]) -> anyhow::Result<()> {
        let (seed, quick, threads) = (self.args.seed, self.args.quick, self.threads);
        if let Some(measured) =
            self.stage(Stage::Table1, |_| table1::measure(flights, seed, quick, threads))?
        {
            self.verdicts.extend(table1::verdicts(&measured));
            self.sections.push(table1::section(&measured));
            self.sections.extend(table1::fig6(&measured));
        }
        let Some(forest) = flights.iter().find(|flown| flown.scene == Place::Forest) else { return Ok(()) };
        if let Some(rows) = self.stage(Stage::Table2, |_| table2::measure(forest, threads))?.flatten() {
            self.sections.push(table2::section(&rows));
        }
        if let Some(stacks) = self.stage(Stage::Table3, |_| table3::measure(forest, seed, threads))?.flatten()
        {
            self.verdicts.push(table3::verdict(&stacks));
            self.sections.push(table3::section(&stacks));
        }
        let measured = self.stage(Stage::Table4, |_| table4::measure(forest))?;
        self.sections.extend(measured.filter(|measured| measured.batches > 0).as_ref().map(table4::section));
        Ok(())
    }

    fn document(&mut self) -> Document {
        let mut verdicts = Vec::new();
        if stop::requested() {
            let skipped = self.skipped.join("; ");
            verdicts
                .push(Verdict::Note(format!("Partial: ended by Ctrl-C. Missing or incomplete: {skipped}.")));
        }
        if self.args.quick {
            let words = "A quick run: short flights, few draws and seeds. It shows that everything works; the figures are not the paper's.";
            verdicts.push(Verdict::Note(words.to_owned()));
        }
        verdicts.append(&mut self.verdicts);
        let mut sections = core::mem::take(&mut self.sections);
        sections.push(deviations(self.args));
        sections.push(self.effort());
        let Self { args: PaperArgs { seed, quick, .. }, skipped, .. } = self;
        let facts =
            json!({"seed": seed, "quick": quick, "interrupted": stop::requested(), "missing": skipped});
        let title = "The paper's evaluation, repeated".to_owned();
        Document { title, verdicts, sections, facts, ..Document::default() }
    }

    /// How long it took.
    fn effort(&self) -> Section {
        let mut timings = self.timings.clone();
        timings.push(("all".to_owned(), self.started.elapsed().as_secs_f64()));
        let table = DataTable::of(
            "effort",
            &timings,
            &[
                ("stage", "stage", &|(name, _)| Cell::text(name)),
                ("seconds", "seconds", &|(_, seconds)| Cell::Number(*seconds, 1)),
            ],
        );
        let table = table.with_note(format!("{} threads.", self.threads));
        Section::new("effort", "How long it took", vec![Part::Table(table)])
    }
}

fn flights_section(flights: &[Flown]) -> Section {
    fn explored(flown: &Flown, cell: impl Fn(&Explored) -> Cell) -> Cell {
        flown.explored.as_ref().map_or(Cell::Missing, cell)
    }
    let sum = |flown: &Flown, of: fn(&RecordFacts) -> u64| flown.records.iter().map(of).sum::<u64>();
    let table = DataTable::of(
        "flights",
        flights,
        &[
            ("scene", "scene", &|f| Cell::text(f.scene.name())),
            ("robots", "robots", &|f| Cell::count(f.records.len())),
            ("seconds", "seconds", &|f| Cell::Number(f.seconds, 1)),
            ("seen_share", "seen of what can be", &|f| explored(f, |e| Cell::Share(e.seen_share))),
            ("overlap", "robots a voxel", &|f| explored(f, |e| Cell::Number(e.overlap, 2))),
            ("path_m", "metres flown, all", &|f| Cell::Number(f.records.iter().map(|r| r.path_m).sum(), 1)),
            ("scans", "scans", &|f| Cell::Whole(sum(f, |r| r.scans))),
            ("points", "points", &|f| Cell::Whole(sum(f, |r| r.points))),
            ("file_mb", "MB on disk", &|f| Cell::Number(sum(f, |r| r.file_bytes) as f64 / KB / KB, 1)),
            ("sent_bytes", "sent meanwhile, bytes", &|f| explored(f, |e| Cell::Whole(e.sent_bytes))),
            ("ended", "ended because", &|f| Cell::text(f.ended)),
        ],
    );
    Section::new("flights", "The explorations", vec![Part::Table(table)])
}

/// Whether an exploration has seen what there is.
fn seen_verdict(flown: &Flown) -> Option<Verdict> {
    let seen_share = flown.explored?.seen_share;
    let words = format!(
        "{} robots have seen {} of what can be seen of the {} in {:.0} s ({}).",
        flown.records.len(),
        percent_short(seen_share),
        flown.scene.words(),
        flown.seconds,
        flown.ended
    );
    Some(Verdict::good_or_note(seen_share >= SEEN_SHARE, words))
}

/// What is not as in the paper.
fn deviations(args: &PaperArgs) -> Section {
    let lidar = format!(
        "LiDAR: the paper does not say which one its simulation had; its real robots carry an Avia. Ours is the {}, 10 scans a second, without noise, seeing \
         {} m far, rendered as `{}`. For each row returns from beyond the row's sensing range are left out, as if there was no return.",
        args.lidar,
        flown::LIDAR_RANGE_M,
        args.rendering
    );
    let points = [
        "Scenes: the paper's forest and office are not published. Ours are generated, of the same size (60 × 25 × 10 m and 35 × 30 × 4 m), from --seed.",
        &lidar,
        "Exploration: a small relative of RACER's planner (frontiers, viewpoints, regions divided pairwise), in which each robot plans on its own fused map, over \
         a perfect radio, and knows of rays that hit nothing, so that it need not go on looking at the open sky; the tables leave these rays out. One flight for each scene serves both of its rows and Table II, as the paper's one record does; it is flown with the maps of the first of them.",
        "Team-mates are seen in the scans and left out of the maps. The paper does not say what it does with them.",
        "Mapper: ROG-Map's rules and published values. The paper uses it on its robots and does not say what its simulation used.",
        "Averages: ours all divide by the length of the record. The paper's are over different times for its two methods (127 and 101 s in row 1, from \
         its totals); by its totals the saving in row 1 is 9.6 times, not the 12 times of the averages.",
        "`paper` carries our header of about 26 bytes a package (stream, index, times, box, check) in place of two 32-bit addresses, which cannot be decoded \
         without the sender's window.",
        "Wi-Fi: emulated, each datagram lost independently of the others.",
    ];
    let points = Part::Points(points.map(str::to_owned).to_vec());
    Section::new("deviations", "What is not as in the paper", vec![points])
}
