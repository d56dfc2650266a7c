//! `flockmap-bench states`: what a map that comes from elsewhere costs, beside the same map made of scans.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use flockmap::codec::Codec;
use flockmap::grid::{BlockIndex, Layer, StateBlock, set_bits};
use flockmap::{
    Batch, BatchConfig, Changes, Mapper, MapperConfig, ScanReport, State, States, StatesUpdate, Voxel,
    VoxelBox,
};
use flockmap_cli::document::DataTable;
use flockmap_cli::measure::{Comparison, blocks_of};
use flockmap_cli::numbers::{percent, thousands};
use flockmap_cli::options::{MapArgs, SourceArgs};
use flockmap_cli::progress::Progress;
use flockmap_cli::sources::Frame;
use flockmap_cli::{json_file, outputs, sources, stop};
use serde::Serialize;

use crate::baselines::{Messages, Method, Receiver, Sender};
use crate::batcher::{Batcher, Step};

/// A map that comes from elsewhere, as states of voxels: bytes beside those of the same map made of scans
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench states forest
  flockmap-bench states robot1.mcap robot2.mcap --resolution 0.2 --range 30

A mapper takes the scans, and other robots get from it what each scan touched: as single voxels or as a box. All publish in
the same cycles, in `flock`. Without the place of the sensor, the codec is given what stands for it.
Exit code 1 if a listener ends with another map than by scans.")]
pub struct StatesArgs {
    /// Records, or one world: forest, indoor, or a .bt .pcd .ply .las .laz file
    #[arg(value_name = "RECORD", required = true)]
    pub records: Vec<PathBuf>,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// How a robot gets the map.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Feed {
    Scans,
    /// Single voxels, or else a box; and what is said of the sensor.
    States {
        is_box: bool,
        place: Place,
    },
}

/// What is said of the place of the sensor.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Place {
    /// Where it was.
    Known,
    /// Nothing: the robot makes up its mind.
    Unsaid,
    /// Where it was at first.
    First,
    /// The middle of the smallest box round what was touched.
    MiddleOfTouched,
    /// The mean of these.
    MeanOfTouched,
}

const FEEDS: [(&str, Feed); 8] = [
    ("scans", Feed::Scans),
    ("voxels, with the sensor's place", states(false, Place::Known)),
    ("a box, with the sensor's place", states(true, Place::Known)),
    ("voxels, without", states(false, Place::Unsaid)),
    ("a box, without", states(true, Place::Unsaid)),
    ("voxels, place of the first scan", states(false, Place::First)),
    ("voxels, mean of touched", states(false, Place::MeanOfTouched)),
    ("voxels, middle of touched", states(false, Place::MiddleOfTouched)),
];

const fn states(is_box: bool, place: Place) -> Feed {
    Feed::States { is_box, place }
}

/// What a feed came to.
#[derive(Serialize)]
struct Row {
    feed: &'static str,
    total_bytes: u64,
    packages: u64,
    changed_voxels: u64,
    agreement: f64,
}

/// What the JSON holds.
#[derive(Serialize)]
struct Output<'a> {
    records: Vec<String>,
    resolution_m: f64,
    range_m: f64,
    publish_period_s: f64,
    feeds: &'a [Row],
}

/// Runs the command. Whether all listeners end with the same map.
pub fn run(args: &StatesArgs) -> anyhow::Result<bool> {
    let (mapper, batch) = (args.map.mapper()?, args.map.batch()?);
    let sources = sources::open(&args.records, &args.source, args.map.range, false)?;
    let rows =
        FEEDS.map(|(feed, _)| Row { feed, total_bytes: 0, packages: 0, changed_voxels: 0, agreement: 0.0 });
    let (mut rows, mut compared) = (rows, FEEDS.map(|_| Comparison::default()));
    let progress = Progress::new("scans", sources.robots.iter().map(|source| source.frames_expected).sum());
    let records = sources.robots.iter().map(|source| source.name.clone()).collect();
    for (number, source) in sources.robots.into_iter().enumerate() {
        progress.say(format!("{}: scans", source.name));
        let lanes = record(number, &mapper, batch, source.frames, || progress.step())?;
        let Some(truth) = lanes.first().map(|lane| &lane.published) else { continue };
        for ((row, compared), lane) in rows.iter_mut().zip(&mut compared).zip(&lanes) {
            row.total_bytes += lane.bytes;
            row.packages += lane.packages;
            row.changed_voxels += lane.changed;
            compared.merge(Comparison::of(lane.receiver.states(), blocks_of(truth)));
            row.agreement = compared.share();
        }
    }
    drop(progress);
    let MapArgs { resolution: resolution_m, range: range_m, publish_period: publish_period_s, .. } = args.map;
    print(&sources.title, &rows);
    let output = Output { records, resolution_m, range_m, publish_period_s, feeds: &rows };
    json_file::write_asked(args.json.as_deref(), &output)?;
    Ok(compared.iter().all(|compared| compared.known == compared.equal))
}

fn print(title: &str, rows: &[Row]) {
    let by_scans = rows.first().map_or(1, |row| row.total_bytes.max(1)) as f64;
    println!("{title}{}\n", if stop::requested() { " (partial: ended by Ctrl-C)" } else { "" });
    let table = DataTable::of_text(
        rows,
        &[
            ("fed by", &|row: &Row| row.feed.to_owned()),
            ("total bytes", &|row| thousands(row.total_bytes)),
            ("vs scans", &|row| format!("×{:.3}", row.total_bytes as f64 / by_scans)),
            ("packages", &|row| thousands(row.packages)),
            ("changed voxels", &|row| thousands(row.changed_voxels)),
            ("agreement", &|row| percent(row.agreement)),
        ],
    );
    print!("{table}");
}

/// One record by all feeds, in the order of [`FEEDS`].
fn record(
    number: usize,
    config: &MapperConfig,
    batch: BatchConfig,
    frames: impl IntoIterator<Item = Frame>,
    mut progress: impl FnMut(),
) -> anyhow::Result<Vec<Lane>> {
    let mut elsewhere = Mapper::new(config.clone())?;
    let lanes = FEEDS.iter().map(|(_, feed)| Lane::new(*feed, number, config, batch));
    let mut lanes = lanes.collect::<anyhow::Result<Vec<_>>>()?;
    let mut first = None;
    for frame in frames {
        if stop::requested() {
            break;
        }
        let report = elsewhere.insert(&frame.scan, &frame.pose, &frame.masks());
        let seen = Seen::new(&elsewhere, &report, *first.get_or_insert_with(|| frame.pose.translation()));
        lanes.iter_mut().try_for_each(|lane| lane.take(&frame, &seen, config))?;
        progress();
    }
    lanes.iter_mut().try_for_each(Lane::end)?;
    Ok(lanes)
}

fn states_of(mapper: &Mapper, index: BlockIndex) -> StateBlock {
    mapper.block(index).copied().unwrap_or_default()
}

/// What the mapper elsewhere has made of a scan.
struct Seen {
    touched: Vec<(Voxel, State)>,
    /// The smallest box round these, and its states.
    region: Option<(VoxelBox, Vec<State>)>,
    resolution_m: f64,
    first: [f64; 3],
}

impl Seen {
    fn new(mapper: &Mapper, report: &ScanReport, first: [f64; 3]) -> Self {
        let of_block = |(index, plane): &(BlockIndex, _)| {
            let (index, states) = (*index, states_of(mapper, *index));
            set_bits(plane).map(move |bit| (index.voxel(bit), states.get(bit)))
        };
        let touched: Vec<(Voxel, State)> = report.touched.iter().flat_map(of_block).collect();
        let ends = touched.iter().filter_map(|(voxel, _)| VoxelBox::spanning(*voxel, *voxel));
        let region = ends.reduce(|a, b| a.union(&b)).map(|region| {
            let ([width, depth, _], min) = (region.size().map(|side| side as usize), region.min());
            let mut states = vec![State::Unknown; region.volume() as usize];
            for (index, block) in region.blocks().map(|index| (index, states_of(mapper, index))) {
                for bit in set_bits(&block.known()) {
                    let voxel = index.voxel(bit);
                    if region.contains(voxel) {
                        let [x, y, z] =
                            [voxel.x - min.x, voxel.y - min.y, voxel.z - min.z].map(|at| at as usize);
                        states[(z * depth + y) * width + x] = block.get(bit);
                    }
                }
            }
            (region, states)
        });
        Self { touched, region, resolution_m: mapper.config().resolution.metres(), first }
    }

    /// What is said of the sensor, which was at `at`.
    fn place(&self, place: Place, at: [f64; 3]) -> Option<[f64; 3]> {
        let middle = |region: Option<VoxelBox>| {
            let (min, max) = (region?.min(), region?.max());
            Some([(min.x, max.x), (min.y, max.y), (min.z, max.z)])
                .map(|ends| ends.map(|(min, max)| f64::from(min + max + 1) / 2.0 * self.resolution_m))
        };
        match place {
            Place::Known => Some(at),
            Place::Unsaid => None,
            Place::First => Some(self.first),
            Place::MiddleOfTouched => middle(self.region.as_ref().map(|(region, _)| *region)),
            Place::MeanOfTouched => {
                let count = self.touched.len() as f64;
                let mean = |of: fn(&Voxel) -> i32| {
                    let sum: f64 = self.touched.iter().map(|(voxel, _)| f64::from(of(voxel)) + 0.5).sum();
                    sum / count * self.resolution_m
                };
                (count > 0.0).then(|| [mean(|v| v.x), mean(|v| v.y), mean(|v| v.z)])
            }
        }
    }
}

/// A robot that is fed, and one that listens to it.
struct Lane {
    feed: Feed,
    robot: Batcher,
    out: Out,
    published: Layer,
    receiver: Box<dyn Receiver>,
    bytes: u64,
    packages: u64,
    changed: u64,
}

/// What makes messages of its batches.
struct Out {
    sender: Box<dyn Sender>,
    messages: Messages,
}

impl Lane {
    fn new(feed: Feed, number: usize, config: &MapperConfig, batch: BatchConfig) -> anyhow::Result<Self> {
        let method = Method::Datagrams(Codec::Flock);
        Ok(Self {
            feed,
            robot: Batcher::new(number, config, batch)?,
            out: Out { sender: method.sender(config), messages: Messages::new() },
            published: Layer::default(),
            receiver: method.receiver(config)?,
            bytes: 0,
            packages: 0,
            changed: 0,
        })
    }

    fn take(&mut self, frame: &Frame, seen: &Seen, config: &MapperConfig) -> anyhow::Result<()> {
        let mut closed = Vec::new();
        let step = |now, step| {
            if let Step::Closed(batch, changes) = step {
                closed.push((now, batch, changes));
            }
            Ok(())
        };
        match self.feed {
            Feed::Scans => self.robot.scan(&frame.scan, &frame.pose, &frame.masks(), step)?,
            Feed::States { is_box, place } => {
                let sensor = seen.place(place, frame.pose.translation());
                let states = match &seen.region {
                    Some((region, states)) if is_box => {
                        States::Box { region: *region, states, clear_unknown: true }
                    }
                    _ => States::Voxels(&seen.touched),
                };
                let (stamp, resolution) = (frame.scan.stamp, config.resolution);
                self.robot.states(&StatesUpdate { stamp, resolution, sensor, states }, step)?;
            }
        }
        closed.into_iter().try_for_each(|(now, batch, changes)| self.batch(now, &batch, &changes))
    }

    fn end(&mut self) -> anyhow::Result<()> {
        match self.robot.end() {
            Some((batch, changes)) => self.batch(self.robot.last, &batch, &changes),
            None => Ok(()),
        }
    }

    fn batch(&mut self, now: flockmap::Stamp, batch: &Batch, changes: &Changes) -> anyhow::Result<()> {
        let Out { sender, messages } = &mut self.out;
        sender.batch(now, batch, changes, messages).context("flock")?;
        sender.published(batch, changes);
        self.published.apply(changes, batch.end);
        self.changed += changes.len() as u64;
        for message in messages.drain(..) {
            self.bytes += message.len() as u64;
            self.packages += 1;
            self.receiver.receive(&message).context("flock")?;
        }
        Ok(())
    }
}
