//! Speed of the mapper: one scan of 20,000 rays among tree trunks, at 0.1 m and 7 m, and the same as states.
//!
//! `cargo bench -p flockmap-grid --bench mapper`

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use flockmap_grid::{
    Mapper, MapperConfig, Pose, Preset, Resolution, Scan, Stamp, State, States, StatesUpdate, Voxel,
    VoxelBox, Which,
};

/// Rays spread evenly from −7° to +52°, each ending on the ground 1.5 m below, on one of 60 trunks, or at 30 m.
fn scan() -> Scan {
    let mut seed = 1u64;
    let mut random = move || {
        seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (seed >> 40) as f64 / (1u64 << 24) as f64
    };
    let trunks: Vec<[f64; 3]> =
        (0..60).map(|_| [random() * 30.0 - 15.0, random() * 30.0 - 15.0, 0.1 + random() * 0.2]).collect();
    let points = (0..20_000)
        .map(|_| {
            let azimuth = random() * core::f64::consts::TAU;
            let elevation = (random() * 59.0 - 7.0).to_radians();
            let direction =
                [azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()];
            let mut length: f64 = 30.0;
            if direction[2] < 0.0 {
                length = length.min(-1.5 / direction[2]);
            }
            for [x, y, radius] in &trunks {
                let (a, c) = (direction[0].hypot(direction[1]), x.hypot(*y) - radius);
                let across = (x * direction[1] - y * direction[0]).abs() / a;
                if c > 0.0 && across < *radius && x * direction[0] + y * direction[1] > 0.0 {
                    length = length.min(c / a);
                }
            }
            direction.map(|d| (d * length) as f32)
        })
        .collect();
    Scan { stamp: Stamp(0), points, no_returns: Vec::new() }
}

fn bench(c: &mut Criterion) {
    let scan = scan();
    for preset in [Preset::RogMap, Preset::Racer, Preset::OctoMap] {
        let config = MapperConfig::preset(preset, Resolution::from_metres(0.1).unwrap(), 7.0);
        // The first scan meets new ground everywhere; a robot at 1.5 m/s and 10 Hz moves 0.15 m between scans.
        c.bench_function(&format!("insert, first scan, {preset}"), |b| {
            b.iter_batched_ref(
                || Mapper::new(config.clone()).unwrap(),
                |mapper| mapper.insert(&scan, &Pose::IDENTITY, &[]),
                BatchSize::LargeInput,
            );
        });
        let mut mapper = Mapper::new(config).unwrap();
        let mut x = 0.0;
        c.bench_function(&format!("insert, moving on, {preset}"), |b| {
            b.iter(|| {
                x += 0.15;
                mapper.insert(&scan, &Pose::from_translation([x, 0.0, 0.0]), &[])
            });
        });
        c.bench_function(&format!("take_changes, {preset}"), |b| {
            b.iter_batched_ref(
                || {
                    let mut mapper = Mapper::new(mapper.config().clone()).unwrap();
                    mapper.insert(&scan, &Pose::IDENTITY, &[]);
                    mapper
                },
                |mapper| mapper.take_changes(Which::All),
                BatchSize::LargeInput,
            );
        });
    }
}

/// What a mapper elsewhere says: the voxels that a scan changed, and the local map of 14 × 14 × 14 m about the robot.
fn states(c: &mut Criterion) {
    let resolution = Resolution::from_metres(0.1).unwrap();
    let config = MapperConfig::preset(Preset::RogMap, resolution, 7.0);
    let mut elsewhere = Mapper::new(config.clone()).unwrap();
    elsewhere.insert(&scan(), &Pose::IDENTITY, &[]);
    let changed: Vec<(Voxel, State)> = elsewhere.take_changes(Which::All).into_voxels().collect();
    let region = VoxelBox::new(Voxel::new(-70, -70, -70), [140; 3]).unwrap();
    let local: Vec<State> = region.voxels().map(|voxel| elsewhere.state(voxel)).collect();
    let single = States::Voxels(&changed);
    let whole = States::Box { region, states: &local, clear_unknown: false };
    for (name, states) in [(format!("{} voxels", changed.len()), single), ("a box of 140³".into(), whole)] {
        let update = StatesUpdate { stamp: Stamp(0), resolution, sensor: Some([0.0; 3]), states };
        c.bench_function(&format!("insert_states, {name}, all new"), |b| {
            b.iter_batched_ref(
                || Mapper::new(config.clone()).unwrap(),
                |mapper| mapper.insert_states(&update).unwrap(),
                BatchSize::LargeInput,
            );
        });
        let mut mapper = Mapper::new(config.clone()).unwrap();
        c.bench_function(&format!("insert_states, {name}, nothing new"), |b| {
            b.iter(|| mapper.insert_states(&update).unwrap());
        });
    }
}

criterion_group!(benches, bench, states);
criterion_main!(benches);
