//! Folders of scans, clouds and maps through files.

mod common;

use std::path::Path;

use common::Folder;
use flockmap_grid::{Resolution, Stamp, State, Voxel};
use flockmap_io::{
    ExportOptions, OctoMap, PointCloud, RecordOptions, Unwritable, check_writable, describe, export_map,
    open_record, read_cloud, write_cloud,
};

fn cloud(x: f32) -> PointCloud {
    PointCloud { points: vec![[x, 1.0, 2.0], [x, -1.0, 0.5]], ..Default::default() }
}

/// A folder of three scans; row `i` moves the sensor to x = i.
fn scans(folder: &Folder, names: [&str; 3], rows: usize) {
    std::fs::create_dir_all(folder.join("Scans")).unwrap();
    for (i, name) in names.iter().enumerate() {
        write_cloud(folder.join(format!("Scans/{name}.pcd")), &cloud(i as f32)).unwrap();
    }
    let poses: String = (0..rows).map(|i| format!("1 0 0 {i} 0 1 0 0 0 0 1 0\n")).collect();
    std::fs::write(folder.join("odom_poses.txt"), poses).unwrap();
    let times: String = (0..rows).map(|i| format!("{}.5\n", 100 + i)).collect();
    std::fs::write(folder.join("times.txt"), times).unwrap();
}

fn open(folder: &Folder, options: &RecordOptions) -> Result<Vec<(Stamp, f64, f32)>, String> {
    let record = open_record(folder.join(""), options).map_err(|e| e.to_string())?;
    record
        .frames
        .map(|frame| {
            let frame = frame.map_err(|e| e.to_string())?;
            Ok((frame.scan.stamp, frame.t_map_sensor.translation()[0], frame.scan.points[0][0]))
        })
        .collect()
}

#[test]
fn a_scan_named_by_its_number_has_the_row_of_that_number() {
    let folder = Folder::new();
    scans(&folder, ["2", "10", "11"], 12);
    let expected =
        [(Stamp(102_500_000), 2.0, 0.0), (Stamp(110_500_000), 10.0, 1.0), (Stamp(111_500_000), 11.0, 2.0)];
    assert_eq!(open(&folder, &RecordOptions::default()).unwrap(), expected);
}

#[test]
fn scans_with_other_names_have_the_rows_in_order() {
    let folder = Folder::new();
    scans(&folder, ["a", "b", "c"], 3);
    let places: Vec<f64> =
        open(&folder, &RecordOptions::default()).unwrap().into_iter().map(|(_, x, _)| x).collect();
    assert_eq!(places, [0.0, 1.0, 2.0]);
    let folder = Folder::new();
    scans(&folder, ["a", "b", "c"], 4);
    let error = open(&folder, &RecordOptions::default()).unwrap_err();
    assert!(error.contains("as many poses as scans (3)") && error.contains("4 poses"), "{error}");
}

#[test]
fn points_of_a_scan_that_are_no_numbers_are_dropped_and_counted() {
    let folder = Folder::new();
    scans(&folder, ["0", "1", "2"], 3);
    let text =
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA ascii\nnan 1 2\n1 2 3\n";
    std::fs::write(folder.join("Scans/0.pcd"), text).unwrap();
    let mut frames = open_record(folder.join(""), &RecordOptions::default()).unwrap().frames;
    let frame = frames.next().unwrap().unwrap();
    assert_eq!((frame.scan.points, frame.points_dropped), (vec![[1.0, 2.0, 3.0]], 1));
}

#[test]
fn what_is_missing_in_a_folder_is_told() {
    let folder = Folder::new();
    let error = |options: &RecordOptions| open(&folder, options).unwrap_err();
    let default = RecordOptions::default();
    assert!(error(&default).contains("a folder Scans"));
    scans(&folder, ["0", "1", "2"], 3);
    std::fs::remove_file(folder.join("times.txt")).unwrap();
    assert!(error(&default).contains("times.txt: cannot be used"));
    let period = RecordOptions { scan_period_s: Some(0.1), ..Default::default() };
    assert_eq!(open(&folder, &period).unwrap()[2].0, Stamp(200_000));
    std::fs::write(folder.join("odom_poses.txt"), "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 2 0 0 0 0 1 0\n")
        .unwrap();
    assert!(error(&period).contains("odom_poses.txt: line 2: damaged"), "{}", error(&period));
    std::fs::write(folder.join("odom_poses.txt"), "").unwrap();
    assert!(error(&period).contains("0 poses"));
}

#[test]
fn a_damaged_scan_is_an_error_and_the_others_are_read() {
    let folder = Folder::new();
    scans(&folder, ["0", "1", "2"], 3);
    let path = folder.join("Scans/1.pcd");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
    let record = open_record(folder.join(""), &RecordOptions::default()).unwrap();
    let frames: Vec<_> = record.frames.collect();
    assert!(frames[0].is_ok() && frames[2].is_ok() && frames.len() == 3);
    let error = frames[1].as_ref().unwrap_err().to_string();
    assert!(error.contains("1.pcd: byte ") && error.contains("expected 24 bytes"), "{error}");
}

fn voxels() -> Vec<(Voxel, State)> {
    vec![
        (Voxel::new(3, -2, 0), State::Occupied),
        (Voxel::new(-1, 0, 0), State::Free),
        (Voxel::new(-4, 7, 1), State::Occupied),
        (Voxel::new(9, 9, 9), State::Unknown),
    ]
}

#[test]
fn an_exported_map_is_read_back_in_every_format() {
    let folder = Folder::new();
    let resolution = Resolution::from_metres(0.1).unwrap();
    for (name, free, count) in
        [("a.ply", false, 2), ("b.ply", true, 3), ("c.pcd", false, 2), ("d.pcd", true, 3)]
    {
        let path = folder.join(name);
        let written = export_map(&path, resolution, voxels(), &ExportOptions { free }).unwrap();
        assert_eq!(written, count);
        let cloud = read_cloud(&path).unwrap();
        for (state, points) in [(State::Occupied, cloud.points), (State::Free, cloud.free)] {
            let mut back: Vec<Voxel> =
                points.iter().map(|p| resolution.voxel_at(p.map(f64::from)).unwrap()).collect();
            back.sort();
            let is_held = |s: State| s == state && (free || s == State::Occupied);
            let mut expected: Vec<Voxel> =
                voxels().into_iter().filter(|(_, s)| is_held(*s)).map(|(v, _)| v).collect();
            expected.sort();
            assert_eq!(back, expected, "{name}: {state:?}");
        }
    }
    let path = folder.join("map.bt");
    assert_eq!(export_map(&path, resolution, voxels(), &ExportOptions::default()).unwrap(), 3);
    let map = OctoMap::read(&path).unwrap();
    let mut back: Vec<_> = map.voxels().collect();
    back.sort_by_key(|(voxel, _)| *voxel);
    let mut expected = voxels();
    expected.retain(|(_, state)| *state != State::Unknown);
    expected.sort_by_key(|(voxel, _)| *voxel);
    assert_eq!(back, expected);
    assert_eq!(map.resolution(), resolution);
    let text = describe(&path).unwrap().to_string();
    assert!(text.contains("2 occupied and 1 free voxels"), "{text}");
    let error =
        export_map(folder.join("map.txt"), resolution, voxels(), &ExportOptions::default()).unwrap_err();
    assert!(error.to_string().contains(".ply, .pcd or .bt can be written"), "{error}");
}

#[test]
fn a_map_far_out_keeps_its_voxels() {
    let folder = Folder::new();
    let resolution = Resolution::from_metres(0.05).unwrap();
    let far = Voxel::new(10_000_001, -9_999_999, 5);
    for name in ["a.ply", "a.pcd"] {
        let path = folder.join(name);
        export_map(&path, resolution, [(far, State::Occupied)], &ExportOptions::default()).unwrap();
        let cloud = read_cloud(&path).unwrap();
        let place = core::array::from_fn(|axis| cloud.origin[axis] + f64::from(cloud.points[0][axis]));
        assert_eq!(resolution.voxel_at(place), Some(far));
    }
}

#[test]
fn equal_maps_give_equal_files() {
    let folder = Folder::new();
    let resolution = Resolution::from_metres(0.1).unwrap();
    let mut reversed = voxels();
    reversed.reverse();
    for name in ["ply", "pcd", "bt"] {
        let (a, b) = (folder.join(format!("a.{name}")), folder.join(format!("b.{name}")));
        export_map(&a, resolution, voxels(), &ExportOptions::default()).unwrap();
        export_map(&b, resolution, reversed.clone(), &ExportOptions::default()).unwrap();
        assert_eq!(std::fs::read(a).unwrap(), std::fs::read(b).unwrap(), "{name}");
    }
}

#[test]
fn a_surveyed_cloud_has_its_origin_taken_off() {
    let points = [[500_000.25, 4_000_000.5, 100.0], [500_010.0, 4_000_001.0, 101.0], [f64::NAN, 0.0, 0.0]];
    let cloud = PointCloud::from_points(&points);
    assert_eq!(cloud.origin, [500_000.0, 4_000_000.0, 100.0]);
    assert_eq!((cloud.points.as_slice(), cloud.dropped), (&[[0.25, 0.5, 0.0], [10.0, 1.0, 1.0]][..], 1));
    let folder = Folder::new();
    write_cloud(folder.join("a.ply"), &cloud).unwrap();
    let back = read_cloud(folder.join("a.ply")).unwrap();
    assert_eq!((back.points, back.origin), (cloud.points, cloud.origin));
}

#[test]
fn the_viewpoint_of_a_cloud_is_where_its_points_are_seen_from() {
    let folder = Folder::new();
    let path = folder.join("a.pcd");
    let text = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nVIEWPOINT 10 0 0 0 0 0 1\nPOINTS 1\nDATA ascii\n1 2 3\n";
    std::fs::write(&path, text).unwrap();
    // Half a turn about z, then 10 m along x.
    assert_eq!(read_cloud(&path).unwrap().points, [[9.0, -2.0, 3.0]]);
    let scans_folder = Folder::new();
    scans(&scans_folder, ["0", "1", "2"], 3);
    std::fs::write(scans_folder.join("Scans/1.pcd"), text).unwrap();
    let error = open(&scans_folder, &RecordOptions::default()).unwrap_err();
    assert!(error.contains("line 5: cannot be used: expected VIEWPOINT 0 0 0 1 0 0 0"), "{error}");
}

#[test]
fn whether_a_file_can_be_written_is_known_beforehand_and_leaves_nothing_behind() {
    let folder = Folder::new();
    let (file, nothing) = (folder.join("result.json"), folder.join("nothing"));
    std::fs::create_dir(&nothing).unwrap();
    check_writable(&file).unwrap();
    assert!(!file.exists(), "it was only tried");
    std::fs::write(&file, "kept").unwrap();
    check_writable(&file).unwrap();
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "kept");
    assert!(check_writable(&nothing).unwrap_err().to_string().contains("is a folder"));
    assert!(check_writable(&folder.join("a/b.json")).unwrap_err().to_string().contains("mkdir -p"));
    assert!(matches!(check_writable(&file.join("b.json")), Err(Unwritable::NoFolder(_))));
    assert!(matches!(check_writable(Path::new("/proc/result.json")), Err(Unwritable::System(_))));
    check_writable(Path::new("/dev/null")).unwrap();
}

#[test]
fn a_file_that_cannot_be_written_says_why_once() {
    let path = Path::new("/proc/map.ply");
    let voxels = [(Voxel::new(0, 0, 0), State::Occupied)];
    let resolution = Resolution::from_metres(0.1).unwrap();
    let error = export_map(path, resolution, voxels, &ExportOptions { free: false }).unwrap_err();
    assert!(error.to_string().starts_with("/proc/map.ply: cannot write: "), "{error}");
    assert!(std::error::Error::source(&error).is_none(), "its words have it already");
}
