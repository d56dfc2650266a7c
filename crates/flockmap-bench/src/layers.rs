//! `flockmap-bench layers`: what layers take, and the fused map of what they say, open and packed.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::ensure;
use clap::Args;
use flockmap::grid::Layer;
use flockmap::{BatchConfig, Changes, MapView, MapperConfig, Pose, Scan, Stamp};
use flockmap_cli::document::DataTable;
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::{MapArgs, SourceArgs};
use flockmap_cli::progress::Progress;
use flockmap_cli::{json_file, outputs, sources, stop};
use serde::Serialize;

use crate::batcher::{Batcher, Step};
use crate::corridor;

/// What the layers of records and a map of what they say take in memory, open and packed, and how long packing takes
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench layers forest
  flockmap-bench layers robot1.mcap robot2.mcap --resolution 0.2 --range 30
  flockmap-bench layers corridor --metres 1000

`corridor` is a straight flight past walls that are never the same, of 720 rays every 0.4 m: everything is new, and
nothing is seen twice.
Exit code 1 if a layer or a map is not the same after it was packed.")]
pub struct LayersArgs {
    /// Records, or one world: forest, indoor, or a .bt .pcd .ply .las .laz file; or `corridor`
    #[arg(value_name = "RECORD", required = true)]
    pub records: Vec<PathBuf>,
    /// Length of the corridor
    #[arg(long, value_name = "M", default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub metres: u32,
    /// Write the table as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// A layer.
#[derive(Serialize, Debug)]
struct Row {
    name: String,
    voxels: usize,
    blocks: usize,
    /// Blocks that are open when the record is over: the rest lies cold, and is packed.
    open: usize,
    /// As it lies then.
    bytes: usize,
    packed_bytes: usize,
    pack_us_per_block: f64,
    unpack_us_per_block: f64,
    map: MapRow,
    is_same: bool,
}

/// The fused map of a robot that has heard this layer and nothing else.
#[derive(Serialize, Debug)]
struct MapRow {
    open: usize,
    /// As it lies when the record is over; all of it open; all of it packed.
    bytes: usize,
    open_bytes: usize,
    packed_bytes: usize,
    pack_us_per_block: f64,
    unpack_us_per_block: f64,
}

/// Runs the command. Whether all layers were the same after they were packed.
pub fn run(args: &LayersArgs) -> anyhow::Result<bool> {
    let (mapper, batch) = (args.map.mapper()?, args.map.batch()?);
    let mut rows = Vec::new();
    if args.records.iter().any(|record| record.as_os_str() == "corridor") {
        ensure!(args.records.len() == 1, "corridor stands alone: it is no record");
        let scans = corridor::scans(args.metres);
        let progress = Progress::new("scans", scans.into());
        let mut maker = Maker::new(&mapper, batch)?;
        for step in 0..scans {
            if stop::requested() {
                break;
            }
            maker.scan(&corridor::scan(step), &corridor::pose(step))?;
            progress.step();
        }
        drop(progress);
        rows.push(Row::of(format!("corridor of {} m", args.metres), maker.finish()));
    } else {
        let sources = sources::open(&args.records, &args.source, args.map.range, false)?;
        let progress = Progress::new("scans", sources.robots.iter().map(|robot| robot.frames_expected).sum());
        for source in sources.robots {
            let mut maker = Maker::new(&mapper, batch)?;
            for frame in source.frames {
                if stop::requested() {
                    break;
                }
                maker.scan(&frame.scan, &frame.pose)?;
                progress.step();
            }
            rows.push(Row::of(source.name, maker.finish()));
        }
    }
    print(&rows);
    json_file::write_asked(args.json.as_deref(), &rows)?;
    Ok(rows.iter().all(|row| row.is_same))
}

/// Makes the own layer of a robot, and the map of one that hears it.
struct Maker {
    batcher: Batcher,
    layer: Layer,
    map: MapView,
}

impl Maker {
    fn new(mapper: &MapperConfig, batch: BatchConfig) -> anyhow::Result<Self> {
        let batcher = Batcher::new(0, mapper, batch)?;
        Ok(Self { batcher, layer: Layer::default(), map: MapView::new(mapper.resolution) })
    }

    fn scan(&mut self, scan: &Scan, pose: &Pose) -> anyhow::Result<()> {
        let Self { layer, map, .. } = self;
        self.batcher.scan(scan, pose, &[], |_, step| {
            if let Step::Closed(batch, changes) = step {
                take_over(layer, map, &changes, batch.end);
            }
            Ok(())
        })
    }

    fn finish(mut self) -> (Layer, MapView) {
        if let Some((batch, changes)) = self.batcher.end() {
            take_over(&mut self.layer, &mut self.map, &changes, batch.end);
        }
        (self.layer, self.map)
    }
}

fn take_over(layer: &mut Layer, map: &mut MapView, changes: &Changes, stamp: Stamp) {
    layer.apply(changes, stamp);
    for (index, new) in changes.blocks() {
        let mut states = map.block(*index).unwrap_or_default();
        states.overlay(new);
        map.set_block(*index, &states);
    }
}

impl Row {
    fn of(name: String, (layer, map): (Layer, MapView)) -> Self {
        let (digest, blocks, open) =
            (layer.digest(), layer.block_count(), layer.block_count() - layer.packed_count());
        let mut again = layer.clone();
        let started = Instant::now();
        again.pack();
        let pack_us_per_block = per_block(started, open);
        let started = Instant::now();
        let counted = again.blocks().count();
        let unpack_us_per_block = per_block(started, blocks);
        let (map, is_map_same) = MapRow::of(&map);
        let is_same = counted == blocks && again.digest() == digest && is_map_same;
        Self {
            name,
            voxels: layer.len(),
            blocks,
            open,
            bytes: layer.memory_bytes(),
            packed_bytes: again.memory_bytes(),
            pack_us_per_block,
            unpack_us_per_block,
            map,
            is_same,
        }
    }
}

impl MapRow {
    /// And whether it was the same after it was packed.
    fn of(map: &MapView) -> (Self, bool) {
        let opened = |map: &MapView| map.bounding_box().map_or_else(|| map.clone(), |all| map.open_in(&all));
        let open = opened(map);
        let mut packed = open.clone();
        let started = Instant::now();
        packed.pack();
        let pack_us_per_block = per_block(started, map.block_count());
        let started = Instant::now();
        let again = opened(&packed);
        let unpack_us_per_block = per_block(started, packed.packed_count());
        let row = Self {
            open: map.block_count() - map.packed_count(),
            bytes: map.memory_bytes(),
            open_bytes: open.memory_bytes(),
            packed_bytes: packed.memory_bytes(),
            pack_us_per_block,
            unpack_us_per_block,
        };
        let is_same = again.changed_since(0) == map.changed_since(0)
            && open.blocks().all(|(index, states)| again.block(index) == Some(states));
        (row, is_same)
    }
}

/// Microseconds since then for each of so many blocks.
fn per_block(started: Instant, blocks: usize) -> f64 {
    started.elapsed().as_secs_f64() * 1e6 / blocks.max(1) as f64
}

fn print(rows: &[Row]) {
    let per_voxel = |row: &Row, bytes: usize| format!("{:.3}", bytes as f64 / row.voxels.max(1) as f64);
    let table = DataTable::of_text(
        rows,
        &[
            ("layer", &|row| row.name.clone()),
            ("voxels", &|row| thousands(row.voxels as u64)),
            ("blocks", &|row| thousands(row.blocks as u64)),
            ("open", &|row| thousands(row.open as u64)),
            ("B/voxel", &|row| per_voxel(row, row.bytes)),
            ("packed B/voxel", &|row| per_voxel(row, row.packed_bytes)),
            ("pack µs/block", &|row| format!("{:.1}", row.pack_us_per_block)),
            ("unpack µs/block", &|row| format!("{:.1}", row.unpack_us_per_block)),
            ("same", &|row| if row.is_same { "yes" } else { "no" }.to_owned()),
        ],
    );
    let per_block = |row: &Row, bytes: usize| format!("{:.1}", bytes as f64 / row.blocks.max(1) as f64);
    let maps = DataTable::of_text(
        rows,
        &[
            ("fused map", &|row| row.name.clone()),
            ("open", &|row| thousands(row.map.open as u64)),
            ("B/voxel", &|row| per_voxel(row, row.map.bytes)),
            ("open B/voxel", &|row| per_voxel(row, row.map.open_bytes)),
            ("packed B/voxel", &|row| per_voxel(row, row.map.packed_bytes)),
            ("open B/block", &|row| per_block(row, row.map.open_bytes)),
            ("packed B/block", &|row| per_block(row, row.map.packed_bytes)),
            ("pack µs/block", &|row| format!("{:.1}", row.map.pack_us_per_block)),
            ("unpack µs/block", &|row| format!("{:.1}", row.map.unpack_us_per_block)),
        ],
    );
    if stop::requested() {
        println!("partial: ended by Ctrl-C\n");
    }
    print!("{table}\n{maps}");
    println!(
        "\n  Bytes with stamps and all that finds a block: when the record is over, what lies cold is packed; and all of it packed.\n  \
         The fused map is that of a robot which has heard the layer and nothing else."
    );
}
