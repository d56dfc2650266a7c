//! The voxels of a file: those of a map or a cloud as they are, those of a record mapped first.

use std::path::PathBuf;

use anyhow::ensure;
use flockmap::grid::{Changes, Mapper, Resolution};
use flockmap::{State, Voxel};
use flockmap_cli::options::{MapArgs, SourceArgs};
use flockmap_cli::progress::Progress;
use flockmap_cli::sources::{self, ending};
use flockmap_cli::stop;
use flockmap_io::read_map;

/// How large voxels are, and those that are known.
pub type Voxels = (Resolution, Box<dyn Iterator<Item = (Voxel, State)>>);

/// Reads or maps a file. Options that do not apply to it are refused.
pub fn voxels_of(file: &PathBuf, map_args: &MapArgs, source: &SourceArgs) -> anyhow::Result<Voxels> {
    Ok(match ending(file).as_deref() {
        Some("bt" | "pcd" | "ply" | "las" | "laz") => {
            let why = format!("is for records, and {} is a map or a cloud", file.display());
            map_args.given.refuse(&["range", "mapper"], &why)?;
            source.given.refuse_all(&why)?;
            let map = read_map(file, map_args.resolution()?)?;
            if map.resolution != map_args.resolution()? {
                let own = format!("does not apply: {} has voxels of {:?}", file.display(), map.resolution);
                map_args.given.refuse(&["resolution"], &own)?;
            }
            if map.origin != [0.0; 3] {
                println!("  coordinates are seen from {:?} m, the lowest corner of the cloud", map.origin);
            }
            (map.resolution, map.voxels)
        }
        _ => (map_args.resolution()?, Box::new(map_sources(file, map_args, source)?.into_voxels())),
    })
}

/// The map that a record, or a simulated flight, makes.
fn map_sources(file: &PathBuf, map_args: &MapArgs, source: &SourceArgs) -> anyhow::Result<Changes> {
    ensure!(
        source.points_topic.len() <= 1,
        "--points-topic is given {} times, and this is the map of one robot: give it once",
        source.points_topic.len()
    );
    let mut mapper = Mapper::new(map_args.mapper()?)?;
    let sources = sources::open(std::slice::from_ref(file), source, map_args.range, false)?;
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
    ensure!(!changes.is_empty(), "{}: no voxel is known when it is mapped", file.display());
    Ok(changes)
}
