//! Planes and bands of a map as files: what a reader makes of them is what the voxels say.

mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use common::Folder;
use flockmap_grid::{Changes, MapView, Mapper, MapperConfig, Preset, Resolution, State, Voxel, VoxelBox};
use flockmap_io::{
    RecordOptions, Scale, export_heights, export_occupancy, export_values, occupancy_yaml, open_record,
};
use flockmap_plan::{ColumnRule, HeightMap, OccupancyGrid, box_between, frontier_cells};
use proptest::prelude::*;

type Model = BTreeMap<Voxel, State>;

fn view_of(resolution: Resolution, voxels: impl IntoIterator<Item = (Voxel, State)>) -> MapView {
    let mut view = MapView::new(resolution);
    for (index, block) in Changes::from_voxels(voxels).blocks() {
        view.set_block(*index, block);
    }
    view
}

/// A cell of a map server: where its middle lies, in tenths of a millimetre, and its value.
type Cells = BTreeMap<[i64; 2], i8>;

/// What Nav2's `map_server` makes of a `.yaml` and the picture that it names, as its documentation has it: pixels
/// from the top left; how black a pixel is, beside two thresholds.
fn served(yaml: &Path) -> Cells {
    let text = std::fs::read_to_string(yaml).unwrap();
    let value = |key: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(&format!("{key}: ")));
        line.unwrap_or_else(|| panic!("no {key} in\n{text}")).to_owned()
    };
    let number = |key: &str| value(key).parse::<f64>().unwrap();
    assert_eq!((value("mode").as_str(), value("negate").as_str()), ("trinary", "0"));
    let origin = value("origin");
    let origin: Vec<f64> =
        origin.trim_matches(['[', ']']).split(", ").map(|part| part.parse().unwrap()).collect();
    assert_eq!((origin.len(), origin[2]), (3, 0.0));
    let name = value("image");
    let ([width, height], grey) = grey_of(&yaml.with_file_name(name.trim_matches('"')));
    let (side, free, occupied) = (number("resolution"), number("free_thresh"), number("occupied_thresh"));
    let mut cells = Cells::new();
    for (row, y) in (0..height).rev().enumerate() {
        for x in 0..width {
            let black = (255.0 - f64::from(grey[row * width + x])) / 255.0;
            let value = if black > occupied {
                100
            } else if black < free {
                0
            } else {
                -1
            };
            let place = [origin[0] + (x as f64 + 0.5) * side, origin[1] + (y as f64 + 0.5) * side];
            cells.insert(place.map(|v| (v * 1e4).round() as i64), value);
        }
    }
    assert_eq!(cells.len(), width * height);
    cells
}

/// A picture with a byte a pixel.
fn grey_of(path: &Path) -> ([usize; 2], Vec<u8>) {
    if path.extension().is_some_and(|ending| ending == "png") {
        let (size, colour, bytes, _) = png_of(path);
        assert_eq!(colour, (png::ColorType::Grayscale, png::BitDepth::Eight));
        return (size, bytes);
    }
    let bytes = std::fs::read(path).unwrap();
    let mut lines = bytes.split(|byte| *byte == b'\n');
    let mut line = || std::str::from_utf8(lines.next().unwrap()).unwrap();
    assert_eq!(line(), "P5");
    assert!(line().starts_with("# Flockmap"));
    let size: Vec<usize> = line().split(' ').map(|n| n.parse().unwrap()).collect();
    assert_eq!(line(), "255");
    ([size[0], size[1]], bytes[bytes.len() - size[0] * size[1]..].to_vec())
}

type Png = ([usize; 2], (png::ColorType, png::BitDepth), Vec<u8>, String);

fn png_of(path: &Path) -> Png {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let frame = reader.next_frame(&mut bytes).unwrap();
    let note = &reader.info().uncompressed_latin1_text[0];
    assert_eq!(note.keyword, "Description");
    let size = [frame.width as usize, frame.height as usize];
    (size, (frame.color_type, frame.bit_depth), bytes, note.text.clone())
}

/// The same from the voxels, one by one.
fn naive(model: &Model, region: &VoxelBox, side: f64) -> Cells {
    let (low, high) = (region.min(), region.max());
    let mut cells = Cells::new();
    for x in low.x..=high.x {
        for y in low.y..=high.y {
            let states = (low.z..=high.z).filter_map(|z| model.get(&Voxel::new(x, y, z)));
            let (free, occupied) = states.fold((false, false), |(free, occupied), state| {
                (free | (*state == State::Free), occupied | (*state == State::Occupied))
            });
            let place = [x, y].map(|v| ((f64::from(v) + 0.5) * side * 1e4).round() as i64);
            cells.insert(
                place,
                if occupied {
                    100
                } else if free {
                    0
                } else {
                    -1
                },
            );
        }
    }
    cells
}

fn voxels() -> impl Strategy<Value = Voxel> {
    (-30..30i32, -30..30i32, -6..6i32).prop_map(|(x, y, z)| Voxel::new(x, y, z))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn a_map_server_reads_what_the_voxels_say(
        model in prop::collection::btree_map(voxels(), prop_oneof![Just(State::Free), Just(State::Occupied)], 1..400),
        a in voxels(), b in voxels(), side in prop_oneof![Just(0.05), Just(0.1), Just(0.3)],
    ) {
        let folder = Folder::new();
        let resolution = Resolution::from_metres(side).unwrap();
        let view = view_of(resolution, model.iter().map(|(voxel, state)| (*voxel, *state)));
        let region = VoxelBox::spanning(a, b).unwrap();
        let grid = OccupancyGrid::new(&view, &region, ColumnRule::AnyFree).unwrap();
        for name in ["map.pgm", "a \"map\": #1.png"] {
            let path = folder.join(name);
            export_occupancy(&path, &grid).unwrap();
            let yaml = occupancy_yaml(&path);
            if name == "map.pgm" {
                prop_assert_eq!(served(&yaml), naive(&model, &region, side));
            } else {
                // The name needs quotes in YAML; the picture is the same.
                let text = std::fs::read_to_string(&yaml).unwrap();
                prop_assert!(text.contains("image: \"a \\\"map\\\": #1.png\"\n"), "{}", text);
                prop_assert_eq!(grey_of(&path), grey_of(&folder.join("map.pgm")));
            }
        }
    }
}

#[test]
fn heights_are_millimetres_above_the_lower_end_of_the_band() {
    let folder = Folder::new();
    let resolution = Resolution::from_metres(0.1).unwrap();
    let wall = (0..7).map(|z| (Voxel::new(-1, 4, z), State::Occupied));
    let view = view_of(resolution, wall.chain([(Voxel::new(0, 4, 0), State::Free)]));
    let region = box_between(resolution, [-0.2, 0.4, -0.3], [0.1, 0.6, 0.5]).unwrap();
    let heights = HeightMap::new(&view, &region).unwrap();
    let path = folder.join("heights.png");
    export_heights(&path, &heights).unwrap();
    let (size, colour, bytes, note) = png_of(&path);
    assert_eq!((size, colour), ([3, 2], (png::ColorType::Grayscale, png::BitDepth::Sixteen)));
    let values: Vec<u16> = bytes.chunks(2).map(|v| u16::from_be_bytes([v[0], v[1]])).collect();
    assert_eq!(values, [0, 0, 0, 0, 800, 0], "the upper row first; the wall goes on above the band");
    assert!(note.contains("-0.3"), "{note}");

    // In colours: the wall, what is known to be empty, and what is not known.
    export_values(
        &path,
        [3, 2],
        &heights.tops_m(),
        |x, y| heights.is_known(x, y),
        Scale { low: 0.0, high: 0.5 },
        "m",
    )
    .unwrap();
    let (_, _, bytes, _) = png_of(&path);
    let pixels: Vec<[u8; 3]> = bytes.chunks(3).map(|p| [p[0], p[1], p[2]]).collect();
    assert_eq!(pixels[3..], [[205; 3], [240, 120, 40], [246; 3]]);
    assert_eq!(pixels[..3], [[205; 3]; 3]);

    let tower = VoxelBox::new(Voxel::default(), [1, 1, 656]).unwrap();
    let error = export_heights(&path, &HeightMap::new(&view, &tower).unwrap()).unwrap_err().to_string();
    assert!(error.contains("take a lower band"), "{error}");
    let error =
        export_values(&path, [2, 2], &[0.0], |_, _| true, Scale::of(&[]), "m").unwrap_err().to_string();
    assert!(error.contains("do not fill 2 × 2 cells"), "{error}");
    let grid = OccupancyGrid::new(&view, &region, ColumnRule::AnyFree).unwrap();
    let error = export_occupancy(folder.join("map.bmp"), &grid).unwrap_err().to_string();
    assert!(error.contains(".pgm or .png"), "{error}");
}

#[test]
fn a_scale_goes_from_the_least_to_the_greatest_number() {
    assert_eq!(Scale::of(&[2.0, f32::NAN, -1.0, f32::INFINITY]), Scale { low: -1.0, high: 2.0 });
    assert_eq!(Scale::of(&[f32::NAN]), Scale { low: 0.0, high: 1.0 });
}

/// A real map: the same cells as voxel by voxel. Says how much faster (`--nocapture`, with `--release`).
#[test]
fn a_slice_of_a_real_map_is_what_its_voxels_are() {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = std::env::var_os("FLOCKMAP_DATA").map_or_else(|| PathBuf::from(default), PathBuf::from);
    let path = folder.join("hku_mb/robot1.mcap");
    if !path.exists() {
        println!("skipped: no data in {}", folder.display());
        return;
    }
    let resolution = Resolution::from_metres(0.1).unwrap();
    let mut mapper = Mapper::new(MapperConfig::preset(Preset::RogMap, resolution, 20.0)).unwrap();
    for frame in open_record(&path, &RecordOptions::default()).unwrap().frames {
        let frame = frame.unwrap();
        mapper.insert(&frame.scan, &frame.t_map_sensor, &[]);
    }
    let mut view = MapView::new(resolution);
    for (index, block) in mapper.blocks() {
        view.set_block(index, block);
    }
    let known = view.bounding_box().unwrap();
    println!("{known:?}, {} blocks, {:?} free and occupied", view.block_count(), view.count());
    // 50 × 50 m round the middle of what is known; as high as the sensor at its start.
    let middle = |low: i32, size: u32| low + size as i32 / 2 - 250;
    let low = Voxel::new(middle(known.min().x, known.size()[0]), middle(known.min().y, known.size()[1]), 0);
    let slice = VoxelBox::new(low, [500, 500, 1]).unwrap();
    let voxel_by_voxel = || -> Vec<i8> {
        let (low, high) = (slice.min(), slice.max());
        let of_row = |y| {
            let view = &view;
            (low.x..=high.x).map(move |x| match view.state(Voxel::new(x, y, low.z)) {
                State::Unknown => -1,
                State::Free => 0,
                State::Occupied => 100,
            })
        };
        (low.y..=high.y).flat_map(of_row).collect()
    };
    let grid = || OccupancyGrid::new(&view, &slice, ColumnRule::AnyFree).unwrap();
    assert_eq!(grid().to_ros(), voxel_by_voxel());
    let (free, occupied) = grid().count();
    assert!(free > 20_000 && occupied > 500, "{free} free, {occupied} occupied: too little to see anything");

    let [mut planes, mut ros, mut voxels] = [Vec::new(), Vec::new(), Vec::new()];
    for _ in 0..31 {
        let start = Instant::now();
        std::hint::black_box(grid());
        planes.push(start.elapsed());
        let start = Instant::now();
        std::hint::black_box(grid().to_ros());
        ros.push(start.elapsed());
        let start = Instant::now();
        std::hint::black_box(voxel_by_voxel());
        voxels.push(start.elapsed());
    }
    let [planes, ros, voxels] = [planes, ros, voxels].map(|mut times| {
        times.sort_unstable();
        times[15]
    });
    println!("medians of 31: planes {planes:?}, for ROS {ros:?}, voxel by voxel {voxels:?}");
    println!("voxel by voxel takes {:.0} times as long", voxels.as_secs_f64() / planes.as_secs_f64());
    let start = Instant::now();
    let cells = frontier_cells(&view, &known);
    let count: u32 = cells.iter().flat_map(|(_, plane)| plane).map(|word| word.count_ones()).sum();
    println!("{count} frontier cells of the whole map in {:?}", start.elapsed());
}
