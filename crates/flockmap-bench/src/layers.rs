//! `flockmap-bench layers`: what layers take, open and packed.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::ensure;
use clap::Args;
use flockmap::grid::Layer;
use flockmap::{BatchConfig, MapperConfig, Pose, Scan};
use flockmap_cli::document::DataTable;
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::{MapArgs, SourceArgs};
use flockmap_cli::progress::Progress;
use flockmap_cli::{json_file, outputs, sources, stop};
use serde::Serialize;

use crate::batcher::{Batcher, Step};
use crate::corridor;

/// What the layers of records take in memory, open and packed, and how long packing takes
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap-bench layers forest
  flockmap-bench layers robot1.mcap robot2.mcap --resolution 0.2 --range 30
  flockmap-bench layers corridor --metres 1000

`corridor` is a straight flight past walls that are never the same, of 720 rays every 0.4 m: everything is new, and
nothing is seen twice.
Exit code 1 if a layer is not the same after it was packed.")]
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
    is_same: bool,
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
        rows.push(Row::of(format!("corridor of {} m", args.metres), &maker.finish()));
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
            rows.push(Row::of(source.name, &maker.finish()));
        }
    }
    print(&rows);
    json_file::write_asked(args.json.as_deref(), &rows)?;
    Ok(rows.iter().all(|row| row.is_same))
}

/// Makes the own layer of a robot.
struct Maker {
    batcher: Batcher,
    layer: Layer,
}

impl Maker {
    fn new(mapper: &MapperConfig, batch: BatchConfig) -> anyhow::Result<Self> {
        Ok(Self { batcher: Batcher::new(0, mapper, batch)?, layer: Layer::default() })
    }

    fn scan(&mut self, scan: &Scan, pose: &Pose) -> anyhow::Result<()> {
        let layer = &mut self.layer;
        self.batcher.scan(scan, pose, &[], |_, step| {
            if let Step::Closed(batch, changes) = step {
                layer.apply(&changes, batch.end);
            }
            Ok(())
        })
    }

    fn finish(mut self) -> Layer {
        if let Some((batch, changes)) = self.batcher.end() {
            self.layer.apply(&changes, batch.end);
        }
        self.layer
    }
}

impl Row {
    fn of(name: String, layer: &Layer) -> Self {
        let (digest, blocks, open) =
            (layer.digest(), layer.block_count(), layer.block_count() - layer.packed_count());
        let per_block =
            |started: Instant, blocks: usize| started.elapsed().as_secs_f64() * 1e6 / blocks.max(1) as f64;
        let mut again = layer.clone();
        let started = Instant::now();
        again.pack();
        let pack_us_per_block = per_block(started, open);
        let started = Instant::now();
        let counted = again.blocks().count();
        let unpack_us_per_block = per_block(started, blocks);
        let is_same = counted == blocks && again.digest() == digest;
        Self {
            name,
            voxels: layer.len(),
            blocks,
            open,
            bytes: layer.memory_bytes(),
            packed_bytes: again.memory_bytes(),
            pack_us_per_block,
            unpack_us_per_block,
            is_same,
        }
    }
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
    if stop::requested() {
        println!("partial: ended by Ctrl-C\n");
    }
    print!("{table}");
    println!(
        "\n  Bytes with stamps and all that finds a block: when the record is over, what lies cold is packed; and all of it packed."
    );
}
