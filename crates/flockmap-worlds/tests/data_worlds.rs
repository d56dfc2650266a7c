//! Trajectories and scans in recorded and published worlds.

use flockmap_worlds::{Lidar, OpenError, ScanOptions, Scanner, Trajectory, TrajectoryOptions, World};
use std::path::PathBuf;
use std::sync::Arc;

/// Opens a world of the test data; `None`, with a message, where there is none.
fn open(name: &str) -> Option<World> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = std::env::var_os("FLOCKMAP_DATA").map_or_else(|| PathBuf::from(default), PathBuf::from);
    let path = folder.join(name);
    if !path.exists() {
        println!("skipped: no data in {}", folder.display());
        return None;
    }
    Some(World::open(path, None).unwrap())
}

/// Robots trajectory the world: they pass through nothing, keep apart, see something, and move about.
fn trajectory(name: &str, robots: usize, span_m: f64) {
    let Some(world) = open(name) else { return };
    let options = TrajectoryOptions { duration_s: 60.0, ..TrajectoryOptions::default() };
    let trajectories = Trajectory::plan(&world, robots, 1, &options).unwrap();
    let (mut low, mut high) = ([f64::MAX; 2], [f64::MIN; 2]);
    for trajectory in &trajectories {
        let places: Vec<[f64; 3]> = trajectory.poses().iter().map(|(_, pose)| pose.translation()).collect();
        let mut flown = 0.0;
        for pair in places.windows(2) {
            let ahead: [f64; 3] = core::array::from_fn(|a| pair[1][a] - pair[0][a]);
            let step = ahead.iter().map(|v| v * v).sum::<f64>().sqrt();
            flown += step;
            assert!(step == 0.0 || world.cast_ray(pair[0], ahead, step).is_none());
        }
        assert!(flown > 15.0, "{name}: {flown} m in 60 s");
        for place in &places {
            for a in 0..2 {
                low[a] = low[a].min(place[a]);
                high[a] = high[a].max(place[a]);
            }
            // Nothing solid within the clearance, seen along six axes.
            for axis in 0..3 {
                for sign in [-1.0, 1.0] {
                    let mut direction = [0.0; 3];
                    direction[axis] = sign;
                    assert_eq!(
                        world.cast_ray(*place, direction, trajectory.clearance_m() - 1e-6),
                        None,
                        "{name}: {place:?}"
                    );
                }
            }
            let cell = world.resolution().voxel_at(*place).unwrap();
            assert!(world.is_known_free(cell) != Some(false), "{name}: {place:?} is not known to be free");
        }
        let (stamp, pose) = trajectory.poses()[300];
        let scan = Scanner::new(Arc::new(world.clone()), Lidar::Mid360, ScanOptions::default()).scan(
            stamp,
            &pose,
            None,
            &[],
        );
        assert!(scan.points.len() > 1_000, "{name}: {} points", scan.points.len());
    }
    for (p, q) in trajectories[0].poses().iter().zip(trajectories[robots - 1].poses()) {
        let square: f64 = (0..3).map(|a| (p.1.translation()[a] - q.1.translation()[a]).powi(2)).sum();
        assert!(robots == 1 || square.sqrt() >= 1.0 - 1e-6);
    }
    let span = (high[0] - low[0]).max(high[1] - low[1]);
    println!(
        "{name}: clearance {:.2} m, flights span {:.1} × {:.1} m",
        trajectories[0].clearance_m(),
        high[0] - low[0],
        high[1] - low[1]
    );
    assert!(span >= span_m, "{name}: flights span {span} m");
}

#[test]
fn two_robots_patrol_the_building_fr_079() {
    trajectory("buildings/fr_079.bt", 2, 25.0);
}

#[test]
fn a_robot_patrols_the_room_fr_078() {
    trajectory("buildings/fr_078_tidyup.bt", 1, 2.0);
}

#[test]
fn two_robots_patrol_the_building_geb079() {
    trajectory("buildings/geb079.bt", 2, 20.0);
}

#[test]
fn five_robots_patrol_the_cubicle_office() {
    trajectory("worlds/cubicle_office.pcd", 5, 20.0);
}

#[test]
fn four_robots_patrol_the_maze() {
    trajectory("worlds/octa_maze.pcd", 4, 20.0);
}

#[test]
fn two_robots_patrol_among_pillars() {
    trajectory("worlds/pillar.pcd", 2, 10.0);
}

#[test]
fn two_robots_patrol_the_real_forest() {
    trajectory("forest_plot/TLS_Clip.laz", 2, 15.0);
}

#[test]
fn a_file_that_is_no_world_is_refused_by_name() {
    let error = World::open("somewhere/photo.jpg", None).unwrap_err();
    assert!(matches!(error, OpenError::Unknown { .. }));
    assert!(error.to_string().contains("photo.jpg"), "{error}");
    let error = World::open("somewhere/missing.bt", None).unwrap_err();
    assert!(error.to_string().contains("missing.bt"), "{error}");
}

#[test]
fn an_exported_map_is_a_world_with_its_own_cells_and_its_free_space() {
    use flockmap_grid::{Resolution, State, Voxel};
    use flockmap_io::{ExportOptions, export_map};
    let folder = std::env::temp_dir().join(format!("flockmap-worlds-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let resolution = Resolution::from_metres(0.3).unwrap();
    let (wall, air, beyond) = (Voxel::new(4, 0, 0), Voxel::new(-3, 0, 1), Voxel::new(4, 0, 1));
    for name in ["map.bt", "map.ply", "map.pcd"] {
        let path = folder.join(name);
        let voxels = [(wall, State::Occupied), (air, State::Free)];
        export_map(&path, resolution, voxels, &ExportOptions { free: true }).unwrap();
        let world = World::open(&path, None).unwrap();
        assert_eq!(world.resolution(), resolution, "{name}");
        assert_eq!(world.solid_cells().collect::<Vec<_>>(), [wall], "{name}");
        let is_free = [wall, air, beyond].map(|cell| world.is_known_free(cell));
        assert_eq!(is_free, [Some(false), Some(true), Some(false)], "{name}");
    }
    // Without free voxels nothing is said of them.
    let path = folder.join("walls.ply");
    export_map(&path, resolution, [(wall, State::Occupied)], &ExportOptions::default()).unwrap();
    assert_eq!(World::open(&path, None).unwrap().is_known_free(air), None);
    std::fs::remove_dir_all(&folder).unwrap();
}
