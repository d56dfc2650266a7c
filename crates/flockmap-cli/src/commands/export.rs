//! `flockmap export`: a map taken elsewhere.

use flockmap_cli::outputs;
use std::path::PathBuf;

use anyhow::{bail, ensure};
use clap::Args;
use flockmap::grid::{Changes, Mapper};
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::{MapArgs, OF_BATCHES, SourceArgs};
use flockmap_cli::progress::Progress;
use flockmap_cli::sources::{self, ending};
use flockmap_cli::stop;
use flockmap_io::{ExportOptions, export_map, read_map};

use super::export_flat::{FlatArgs, OF_PICTURES};

/// Map a record and take the map elsewhere, or convert a map or cloud
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap export robot1.mcap --to map.bt --resolution 0.2 --range 30
  flockmap export robot1.mcap --to map.ply --free
  flockmap export rosbag2_2026_11_23/ --to map.bt --resolution 0.2 --range 30
  flockmap export fr_079.bt --to map.pcd
  flockmap export TLS_Clip.laz --to map.bt --resolution 0.2
  flockmap export robot1.mcap --to map.pgm --band -0.8 0.6        (and map.yaml: ros2 run nav2_map_server map_server)
  flockmap export map.bt --to slice.png --band 1 1.1 --area -10 -10 20 20
  flockmap export map.bt --to heights.png --product heights

A record is mapped with the mapper options. A map (.bt, or a .ply or .pcd from here) keeps its own resolution. Of any
other cloud every voxel with a point is occupied. The ending of --to decides the format: .ply, .pcd and .bt hold voxels, .pgm and .png are
pictures from above, up is +y.", mut_args(super::hidden::hide(&[&OF_BATCHES])))]
pub struct ExportArgs {
    /// A record, a map, or a point cloud
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Where to: a path that ends in .ply, .pcd, .bt, .pgm or .png
    #[arg(long, value_name = "MAP", value_parser = outputs::file())]
    pub to: PathBuf,
    /// Write free voxels too (a .bt always holds them)
    #[arg(long)]
    pub free: bool,
    #[command(flatten)]
    pub flat: FlatArgs,
    #[command(flatten)]
    pub map: MapArgs,
    #[command(flatten)]
    pub source: SourceArgs,
}

/// Runs the command.
pub fn run(args: &ExportArgs) -> anyhow::Result<bool> {
    let is_picture = match ending(&args.to).as_deref() {
        Some("ply" | "pcd" | "bt") => false,
        Some("pgm" | "png") => true,
        _ => bail!("--to {}: expected a path that ends in .ply, .pcd, .bt, .pgm or .png", args.to.display()),
    };
    if is_picture {
        ensure!(!args.free, "--free is for .ply and .pcd, and {} is a picture", args.to.display());
        args.flat.check(&args.to)?;
    } else {
        let why = format!("is for .pgm and .png, and {} holds voxels", args.to.display());
        args.flat.given.refuse(&OF_PICTURES, &why)?;
    }
    let (resolution, voxels): (_, Box<dyn Iterator<Item = _>>) = match ending(&args.file).as_deref() {
        Some("bt" | "pcd" | "ply" | "las" | "laz") => {
            let why = format!("is for records, and {} is a map or a cloud", args.file.display());
            args.map.given.refuse(&["range", "mapper"], &why)?;
            args.source.given.refuse_all(&why)?;
            let map = read_map(&args.file, args.map.resolution()?)?;
            if map.resolution != args.map.resolution()? {
                let own =
                    format!("does not apply: {} has voxels of {:?}", args.file.display(), map.resolution);
                args.map.given.refuse(&["resolution"], &own)?;
            }
            if map.origin != [0.0; 3] {
                println!("  coordinates are seen from {:?} m, the lowest corner of the cloud", map.origin);
            }
            (map.resolution, map.voxels)
        }
        _ => (args.map.resolution()?, Box::new(map_sources(args)?.into_voxels())),
    };
    if is_picture {
        args.flat.write(&args.to, resolution, &Changes::from_voxels(voxels))?;
        return Ok(true);
    }
    let count = export_map(&args.to, resolution, voxels, &ExportOptions { free: args.free })?;
    println!("{}: {} voxels of {} m", args.to.display(), thousands(count), resolution.metres());
    Ok(true)
}

/// The map that a record, or a simulated flight, makes.
fn map_sources(args: &ExportArgs) -> anyhow::Result<Changes> {
    ensure!(
        args.source.points_topic.len() <= 1,
        "--points-topic is given {} times, and a map of one robot is exported: give it once",
        args.source.points_topic.len()
    );
    let mut mapper = Mapper::new(args.map.mapper()?)?;
    let sources = sources::open(std::slice::from_ref(&args.file), &args.source, args.map.range, false)?;
    let progress = Progress::new("scans", sources.robots.iter().map(|source| source.frames_expected).sum());
    // Several simulated robots share one frame, so one map holds what all have seen.
    for frame in sources.robots.into_iter().flat_map(|source| source.frames) {
        if stop::requested() {
            eprintln!("warning: ended by Ctrl-C: the map holds what was seen so far");
            break;
        }
        mapper.insert(&frame.scan, &frame.pose, &frame.masks());
        progress.step();
    }
    let blocks = mapper.blocks().map(|(index, block)| (index, *block)).collect();
    let changes = Changes::from_blocks(blocks);
    ensure!(!changes.is_empty(), "{}: nothing to export: no voxel is known", args.file.display());
    Ok(changes)
}
