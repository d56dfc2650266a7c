//! `flockmap export`: a map taken elsewhere.

use flockmap_cli::outputs;
use std::path::PathBuf;

use anyhow::{bail, ensure};
use clap::Args;
use flockmap::grid::Changes;
use flockmap_cli::numbers::thousands;
use flockmap_cli::options::{MapArgs, OF_BATCHES, SourceArgs};
use flockmap_cli::sources::ending;
use flockmap_io::{ExportOptions, export_map};

use super::export_flat::{FlatArgs, OF_PICTURES};
use super::voxels_of::voxels_of;

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
    let (resolution, voxels) = voxels_of(&args.file, &args.map, &args.source)?;
    if is_picture {
        args.flat.write(&args.to, resolution, &Changes::from_voxels(voxels))?;
        return Ok(true);
    }
    let count = export_map(&args.to, resolution, voxels, &ExportOptions { free: args.free })?;
    println!("{}: {} voxels of {} m", args.to.display(), thousands(count), resolution.metres());
    Ok(true)
}
