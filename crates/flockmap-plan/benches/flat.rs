//! What is made of bit planes, beside asking voxel by voxel, on a map of 50 × 50 m at 0.1 m.
//!
//! `cargo bench -p flockmap-plan --bench flat`

use criterion::{Criterion, criterion_group, criterion_main};
use flockmap_grid::{
    MapView, Mapper, MapperConfig, Pose, Preset, Resolution, Scan, Stamp, State, Voxel, VoxelBox,
};
use flockmap_plan::{ColumnRule, FrontierConfig, HeightMap, OccupancyGrid, frontier_cells, frontiers};

/// Metres from the sensor.
const RANGE: f64 = 10.0;

/// Half the side of what is mapped, in metres.
const HALF: f64 = 25.0;

/// Columns of 0.5 m stand 4 m apart, on flat ground: how far a ray from the sensor goes until it meets one.
fn meets(from: [f64; 3], ray: [f64; 3]) -> f64 {
    let ground = if ray[2] < 0.0 { -from[2] / ray[2] } else { f64::INFINITY };
    let near = |at: f64| {
        ((at / 4.0).round() as i32 - 3..=(at / 4.0).round() as i32 + 3).map(|i| f64::from(i) * 4.0 + 2.0)
    };
    let mut nearest = ground;
    for x in near(from[0]) {
        for y in near(from[1]) {
            let to = [x - from[0], y - from[1]];
            let flat = ray[0].hypot(ray[1]);
            let along = (to[0] * ray[0] + to[1] * ray[1]) / flat;
            let beside = (to[0] * ray[1] - to[1] * ray[0]) / flat;
            if along > 0.0 && beside.abs() < 0.25 {
                nearest = nearest.min((along - (0.0625 - beside * beside).sqrt()) / flat);
            }
        }
    }
    nearest
}

/// As a robot has it that scanned from 100 places, 5 m apart.
fn map() -> MapView {
    let resolution = Resolution::from_metres(0.1).unwrap();
    let mut mapper = Mapper::new(MapperConfig::preset(Preset::RogMap, resolution, RANGE)).unwrap();
    for number in 0..300 {
        let place = f64::from(number % 100);
        let from = [(place % 10.0) * 5.0 - 22.5, (place / 10.0).floor() * 5.0 - 22.5, 1.5];
        let mut scan = Scan { stamp: Stamp(i64::from(number) * 100_000), ..Scan::default() };
        for ray in 0..40_000 {
            // Evenly over the sphere from -40 to 40 degrees: the golden angle.
            let up = (f64::from(ray) + 0.5) / 40_000.0 * 1.28 - 0.64;
            let angle = f64::from(ray) * 2.399_963_229_728_653 + f64::from(number);
            let flat = (1.0 - up * up).sqrt();
            let ray = [flat * angle.cos(), flat * angle.sin(), up];
            let range = meets(from, ray);
            let end = ray.map(|v| (v * range.min(RANGE * 0.99)) as f32);
            if range < RANGE { scan.points.push(end) } else { scan.no_returns.push(end) }
        }
        mapper.insert(&scan, &Pose::from_translation(from), &[]);
    }
    let mut view = MapView::new(resolution);
    for (index, block) in mapper.blocks() {
        view.set_block(index, block);
    }
    view
}

fn region(view: &MapView, low: f64, high: f64) -> VoxelBox {
    flockmap_plan::box_between(view.resolution(), [-HALF, -HALF, low], [HALF, HALF, high]).unwrap()
}

fn voxel_by_voxel(view: &MapView, slice: &VoxelBox) -> Vec<i8> {
    let (low, high) = (slice.min(), slice.max());
    let mut cells = Vec::with_capacity(slice.volume() as usize);
    for y in low.y..=high.y {
        for x in low.x..=high.x {
            cells.push(match view.state(Voxel::new(x, y, low.z)) {
                State::Unknown => -1,
                State::Free => 0,
                State::Occupied => 100,
            });
        }
    }
    cells
}

fn bench(c: &mut Criterion) {
    let view = map();
    let (free, occupied) = view.count();
    println!("{} blocks, {free} free and {occupied} occupied voxels", view.block_count());
    let slice = region(&view, 1.0, 1.1);
    let band = region(&view, 0.2, 2.0);
    let all = region(&view, -0.5, 4.0);
    assert_eq!(
        OccupancyGrid::new(&view, &slice, ColumnRule::AnyFree).unwrap().to_ros(),
        voxel_by_voxel(&view, &slice)
    );
    c.bench_function("slice, voxel by voxel", |b| b.iter(|| voxel_by_voxel(&view, &slice)));
    let grid = |region, rule| OccupancyGrid::new(&view, region, rule).unwrap();
    c.bench_function("slice", |b| b.iter(|| grid(&slice, ColumnRule::AnyFree)));
    c.bench_function("slice for ROS", |b| b.iter(|| grid(&slice, ColumnRule::AnyFree).to_ros()));
    c.bench_function("band of 18 voxels, any free", |b| b.iter(|| grid(&band, ColumnRule::AnyFree)));
    c.bench_function("band of 18 voxels, all free", |b| b.iter(|| grid(&band, ColumnRule::AllFree)));
    c.bench_function("heights of 45 voxels", |b| b.iter(|| HeightMap::new(&view, &all).unwrap()));
    c.bench_function("frontier cells of 45 voxels", |b| b.iter(|| frontier_cells(&view, &all)));
    let found = frontiers(&view, &all, &FrontierConfig::default()).unwrap();
    println!("{} frontiers, {} cells", found.len(), found.iter().map(|f| f.voxels.len()).sum::<usize>());
    c.bench_function("frontiers of 45 voxels", |b| {
        b.iter(|| frontiers(&view, &all, &FrontierConfig::default()).unwrap());
    });
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .sample_size(20)
        .warm_up_time(core::time::Duration::from_millis(300))
        .measurement_time(core::time::Duration::from_secs(1));
    targets = bench
}
criterion_main!(benches);
