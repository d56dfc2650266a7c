//! `flockmap export`: a map taken elsewhere.

use anyhow::{Context, bail};
use flockmap::grid::{Changes, Mapper};
use flockmap::{Resolution, State, Voxel};
use flockmap_io::{ExportOptions, OctoMap, export_map, read_cloud};

use crate::args::ExportArgs;
use crate::progress::Progress;
use crate::table::thousands;
use crate::{sources, stop};

/// Runs the command.
pub fn run(args: &ExportArgs) -> anyhow::Result<bool> {
    let ending = args.to.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    if !matches!(ending.as_deref(), Some("ply" | "pcd" | "bt")) {
        bail!("--to {}: expected a path that ends in .ply, .pcd or .bt", args.to.display());
    }
    let extension = args.file.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    let (resolution, voxels): (Resolution, Box<dyn Iterator<Item = (Voxel, State)>>) = match extension
        .as_deref()
    {
        Some("bt") => {
            let map = OctoMap::read(&args.file)?;
            let voxels =
                map.cubes().to_vec().into_iter().flat_map(|c| c.voxels().map(move |voxel| (voxel, c.state)));
            (map.resolution(), Box::new(voxels))
        }
        Some("pcd" | "ply" | "las" | "laz") => {
            let resolution = args.map.resolution()?;
            let cloud = read_cloud(&args.file)?;
            if cloud.origin != [0.0; 3] {
                println!("  coordinates are seen from {:?} m, the lowest corner of the cloud", cloud.origin);
            }
            let voxel = |p: &[f32; 3]| Some((resolution.voxel_at(p.map(f64::from))?, State::Occupied));
            let changes = Changes::from_voxels(cloud.points.iter().filter_map(voxel));
            (resolution, Box::new(changes.into_voxels()))
        }
        _ => (args.map.resolution()?, Box::new(map_sources(args)?.into_voxels())),
    };
    let count = export_map(&args.to, resolution, voxels, &ExportOptions { free: args.free })?;
    println!("{}: {} voxels of {} m", args.to.display(), thousands(count), resolution.metres());
    Ok(true)
}

/// The map that a record, or a simulated flight, makes.
fn map_sources(args: &ExportArgs) -> anyhow::Result<Changes> {
    let mut mapper = Mapper::new(args.map.mapper()?)?;
    let sources = sources::open(std::slice::from_ref(&args.file), &args.source, args.map.range, false)?;
    let mut progress =
        Progress::new("scans", sources.robots.iter().map(|source| source.frames_expected).sum());
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
    if changes.is_empty() {
        return Err(anyhow::anyhow!("no voxel is known"))
            .with_context(|| format!("{}: nothing to export", args.file.display()));
    }
    Ok(changes)
}
