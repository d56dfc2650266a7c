//! Maps taken elsewhere and back: the same voxels, whatever the format, and what is not said is not made up.

mod common;

use std::collections::BTreeMap;
use std::path::Path;

use common::Folder;
use flockmap_grid::{Resolution, State, Voxel};
use flockmap_io::{ExportOptions, PointCloud, export_map, read_cloud, read_map, write_cloud};
use proptest::prelude::*;

/// A map as plainly as it can be said.
type Model = BTreeMap<Voxel, State>;

fn metres(side: f64) -> Resolution {
    Resolution::from_metres(side).unwrap()
}

/// Another resolution than any map here has: what a user says who does not know it.
fn another() -> Resolution {
    metres(0.77)
}

fn maps(reach: i32) -> impl Strategy<Value = Model> {
    let index = prop_oneof![4 => -6..6i32, 1 => -reach..reach];
    let voxel = prop::array::uniform3(index).prop_map(|[x, y, z]| Voxel::new(x, y, z));
    let state = prop_oneof![Just(State::Unknown), Just(State::Free), Just(State::Occupied)];
    prop::collection::btree_map(voxel, state, 0..120)
}

fn known(model: &Model, has_free: bool) -> Model {
    let is_held = |state: State| state == State::Occupied || (has_free && state == State::Free);
    model.iter().map(|(voxel, state)| (*voxel, *state)).filter(|(_, state)| is_held(*state)).collect()
}

fn read(path: &Path, asked: Resolution) -> (Resolution, bool, Model) {
    let map = read_map(path, asked).unwrap();
    assert_eq!(map.origin, [0.0; 3]);
    let voxels: Vec<_> = map.voxels.collect();
    let model: Model = voxels.iter().copied().collect();
    assert_eq!(model.len(), voxels.len(), "each voxel once");
    (map.resolution, map.tells_free, model)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn a_map_comes_back_from_every_format_that_is_written(
        near in maps(32_767), far in maps(1 << 27),
        side in prop_oneof![Just(0.001), Just(0.05), Just(0.1), Just(0.3), Just(0.123_457), Just(1.0)],
    ) {
        let folder = Folder::new();
        let resolution = metres(side);
        for (ending, model) in [("bt", &near), ("ply", &near), ("ply", &far), ("pcd", &near), ("pcd", &far)] {
            for free in [false, true] {
                let path = folder.join(format!("map.{ending}"));
                let voxels = model.iter().map(|(voxel, state)| (*voxel, *state));
                let count = export_map(&path, resolution, voxels, &ExportOptions { free }).unwrap();
                let has_free = free || ending == "bt";
                let expected = known(model, has_free);
                prop_assert_eq!(count, expected.len() as u64);
                prop_assert_eq!(read(&path, another()), (resolution, has_free, expected), "{}", ending);
            }
        }
    }

    #[test]
    fn a_map_that_went_through_other_programs_comes_back(model in maps(1 << 20), side in prop_oneof![Just(0.05), Just(0.2)]) {
        let expected = known(&model, true);
        let folder = Folder::new();
        for (name, bytes) in by_others(&expected, side) {
            let path = folder.join(name);
            std::fs::write(&path, bytes).unwrap();
            // They keep the numbers of each point, and drop the comment with the resolution.
            prop_assert_eq!(read(&path, metres(side)), (metres(side), true, expected.clone()), "{}", name);
            let solid = known(&model, false);
            let cloud = read_cloud(&path).unwrap();
            prop_assert_eq!((cloud.points.len(), cloud.free.len()), (solid.len(), expected.len() - solid.len()));
        }
    }
}

/// The same points with their states in the forms that are read and not written.
fn by_others(model: &Model, side: f64) -> Vec<(&'static str, Vec<u8>)> {
    let rows: Vec<([f64; 3], u8)> = model
        .iter()
        .map(|(v, state)| {
            ([v.x, v.y, v.z].map(|i| (f64::from(i) + 0.5) * side), u8::from(*state == State::Occupied))
        })
        .collect();
    let count = rows.len();
    let text: String = rows.iter().map(|([x, y, z], state)| format!("{x} {state} {y} {z}\n")).collect();
    let ply = |format: &str| {
        format!(
            "ply\nformat {format} 1.0\nelement vertex {count}\nproperty double x\nproperty float state\n\
             property double y\nproperty double z\nend_header\n"
        )
    };
    let pcd = |data: &str| {
        format!(
            "VERSION 0.7\nFIELDS x state y z\nSIZE 8 4 8 8\nTYPE F I F F\nCOUNT 1 1 1 1\nPOINTS {count}\nDATA {data}\n"
        )
    };
    let big_endian: Vec<u8> = rows
        .iter()
        .flat_map(|([x, y, z], state)| {
            let state = f32::from(*state).to_be_bytes();
            [&x.to_be_bytes()[..], &state, &y.to_be_bytes(), &z.to_be_bytes()].concat()
        })
        .collect();
    let column = |axis: usize| rows.iter().flat_map(move |(p, _)| p[axis].to_le_bytes());
    let states = rows.iter().flat_map(|(_, state)| i32::from(*state).to_le_bytes());
    let columns: Vec<u8> = column(0).chain(states).chain(column(1)).chain(column(2)).collect();
    // LZF without a repeat.
    let packed: Vec<u8> = columns.chunks(32).flat_map(|c| [&[c.len() as u8 - 1], c].concat()).collect();
    let sizes = [packed.len() as u32, columns.len() as u32].map(u32::to_le_bytes).concat();
    vec![
        ("ascii.ply", [ply("ascii").into_bytes(), text.clone().into_bytes()].concat()),
        ("big.ply", [ply("binary_big_endian").into_bytes(), big_endian].concat()),
        ("ascii.pcd", [pcd("ascii").into_bytes(), text.into_bytes()].concat()),
        ("packed.pcd", [pcd("binary_compressed").into_bytes(), sizes, packed].concat()),
    ]
}

fn ascii(fields: &str, rows: &str) -> Vec<u8> {
    let count = fields.split(' ').count();
    let each = |what: &str| vec![what; count].join(" ");
    let (size, kind, points) = (each("4"), each("F"), rows.lines().count());
    format!("FIELDS {fields}\nSIZE {size}\nTYPE {kind}\nPOINTS {points}\nDATA ascii\n{rows}").into_bytes()
}

fn error(bytes: &[u8], side: f64) -> String {
    let folder = Folder::new();
    let path = folder.join("a.pcd");
    std::fs::write(&path, bytes).unwrap();
    read_map(&path, metres(side)).map(drop).unwrap_err().to_string()
}

#[test]
fn a_cloud_of_others_is_read_as_points_of_something_solid() {
    let folder = Folder::new();
    let path = folder.join("a.pcd");
    std::fs::write(&path, ascii("x y z label", "0.01 0.01 0.01 0\n0.02 0.02 0.02 7\n1.01 0 0 0\n")).unwrap();
    let expected =
        Model::from([(Voxel::new(0, 0, 0), State::Occupied), (Voxel::new(10, 0, 0), State::Occupied)]);
    assert_eq!(read(&path, metres(0.1)), (metres(0.1), false, expected));
}

#[test]
fn points_with_a_state_that_are_no_centres_are_refused() {
    // The map had voxels of 0.1 m; read with others, what is unknown would become free.
    let map = ascii("x y z state", "0.05 0.05 0.05 0\n0.15 0.05 0.05 1\n");
    for side in [0.05, 0.2, 0.3, 1.0] {
        let error = error(&map, side);
        assert!(error.contains(&format!("the centre of a voxel of {side} m, which a map has")), "{error}");
    }
}

#[test]
fn a_state_that_is_none_is_told_with_its_place() {
    let error = |rows: &str| error(&ascii("x y z state", rows), 0.1);
    let text = error("0.05 0.05 0.05 1\n0.15 0.05 0.05 2\n");
    assert!(
        text.contains("line 7: cannot be used: expected 1 (occupied) or 0 (free)")
            && text.contains("found 2"),
        "{text}"
    );
    assert!(error("0.05 0.05 0.05 free\n").contains("line 6"), "{}", error("0.05 0.05 0.05 free\n"));
    assert!(error("nan 0.05 0.05 0\n").contains("the centre of a voxel"));
}

#[test]
fn a_damaged_resolution_is_told() {
    let folder = Folder::new();
    let path = folder.join("a.ply");
    export_map(&path, metres(0.1), [(Voxel::new(1, 2, 3), State::Occupied)], &ExportOptions::default())
        .unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let at = bytes.windows(5).position(|w| w == b"0.1 m").unwrap();
    let mut damaged = bytes;
    damaged[at] = b'x';
    std::fs::write(&path, damaged).unwrap();
    let error = read_map(&path, metres(0.1)).map(drop).unwrap_err().to_string();
    assert!(error.contains("line 3: damaged: expected voxels of 0.001 to 100 m"), "{error}");
}

#[test]
fn free_points_of_a_cloud_stay_free() {
    let folder = Folder::new();
    let cloud = PointCloud {
        points: vec![[1.0, 2.0, 3.0]],
        free: vec![[4.0, 5.0, 6.0], [7.0, 8.0, 9.0]],
        voxels: Some(metres(0.5)),
        ..PointCloud::default()
    };
    for name in ["a.ply", "a.pcd"] {
        write_cloud(folder.join(name), &cloud).unwrap();
        assert_eq!(read_cloud(folder.join(name)).unwrap(), cloud, "{name}");
    }
}

#[test]
fn a_map_is_no_scan_of_a_folder() {
    let folder = Folder::new();
    std::fs::create_dir_all(folder.join("Scans")).unwrap();
    let cloud = PointCloud { free: vec![[1.0; 3]], ..PointCloud::default() };
    write_cloud(folder.join("Scans/0.pcd"), &cloud).unwrap();
    std::fs::write(folder.join("poses.txt"), "1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
    std::fs::write(folder.join("times.txt"), "0\n").unwrap();
    let mut frames = flockmap_io::open_record(folder.join(""), &Default::default()).unwrap().frames;
    let error = frames.next().unwrap().unwrap_err().to_string();
    assert!(error.contains("0.pcd: cannot be used: expected a scan"), "{error}");
}
