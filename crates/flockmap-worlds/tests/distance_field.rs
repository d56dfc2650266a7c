//! The distance field of 10 × 10 × 4 m about a robot, on maps of recordings and worlds.

use std::path::PathBuf;
use std::sync::Arc;

use flockmap_grid::{MapView, Mapper, MapperConfig, Pose, Preset, Resolution, Scan, State, Voxel, VoxelBox};
use flockmap_io::{RecordOptions, open_record};
use flockmap_plan::{DistanceField, FieldConfig, Updated};
use flockmap_worlds::{Flight, Lidar, ScanOptions, Trajectory, TrajectoryOptions, World};

/// A file of the test data; `None`, with a message, where there is none.
fn data(name: &str) -> Option<PathBuf> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = std::env::var_os("FLOCKMAP_DATA").map_or_else(|| PathBuf::from(default), PathBuf::from);
    let path = folder.join(name);
    if !path.exists() {
        println!("skipped: no data in {}", folder.display());
        return None;
    }
    Some(path)
}

fn flight(world: World) -> impl Iterator<Item = (Scan, Pose)> {
    let options = TrajectoryOptions { duration_s: 5.0, ..TrajectoryOptions::default() };
    let trajectory = Trajectory::plan(&world, 1, 1, &options).unwrap().remove(0);
    let flight = Flight::new(Arc::new(world), Lidar::Mid360, ScanOptions::default(), trajectory);
    flight.map(|frame| (frame.scan, frame.t_map_sensor))
}

/// Maps so many scans; a field of a box about the last pose goes along with the last few of them.
fn check(scans: impl Iterator<Item = (Scan, Pose)>, count: usize) {
    let resolution = Resolution::from_metres(0.1).unwrap();
    let scans: Vec<(Scan, Pose)> = scans.take(count).collect();
    let at = resolution.voxel_at(scans[count - 1].1.translation()).unwrap();
    let region = VoxelBox::new(Voxel::new(at.x - 50, at.y - 50, at.z - 20), [100, 100, 40]).unwrap();
    let config = FieldConfig::default();
    let mut mapper = Mapper::new(MapperConfig::preset(Preset::RogMap, resolution, 10.0)).unwrap();
    let mut map = MapView::new(resolution);
    let mut field = DistanceField::new(&map, region, &config).unwrap();
    let mut partly = 0;
    for (number, (scan, pose)) in scans.iter().enumerate() {
        mapper.insert(scan, pose, &[]);
        mapper.blocks().for_each(|(index, block)| map.set_block(index, block));
        if number + 5 > count {
            partly += u32::from(field.update(&map) == Updated::Partly);
        }
    }
    let anew = DistanceField::new(&map, region, &config).unwrap();
    let is_obstacle = |voxel: &Voxel| map.state(*voxel) == State::Occupied;
    let obstacles: Vec<Voxel> = region.voxels().filter(is_obstacle).collect();
    assert!(obstacles.len() > 500 && partly > 0, "{} obstacles, {partly} updates", obstacles.len());
    for voxel in region.voxels() {
        let squared = |o: &Voxel| (o.x - voxel.x).pow(2) + (o.y - voxel.y).pow(2) + (o.z - voxel.z).pow(2);
        let nearest = obstacles.iter().map(squared).min().map(|squared| squared as u32);
        assert_eq!(anew.squared_voxels(voxel), nearest, "{voxel:?}");
        assert_eq!(field.squared_voxels(voxel), nearest, "{voxel:?}, kept up to date");
    }
}

#[test]
fn it_is_right_on_a_recorded_walk() {
    let Some(path) = data("hku_mb/robot1.mcap") else { return };
    let record = open_record(&path, &RecordOptions::default()).unwrap();
    check(record.frames.map(|frame| frame.unwrap()).map(|frame| (frame.scan, frame.t_map_sensor)), 60);
}

#[test]
fn it_is_right_in_a_building() {
    let Some(path) = data("buildings/fr_079.bt") else { return };
    check(flight(World::open(path, None).unwrap()), 25);
}

#[test]
fn it_is_right_in_a_forest() {
    check(flight(World::forest(1)), 25);
}
