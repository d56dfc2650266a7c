//! Speed of what planners ask, in a forest of 60 trunks on 30 × 30 m, at 0.1 m.
//!
//! `cargo bench -p flockmap-plan --bench plan`

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use flockmap_grid::{
    BLOCK_VOXELS, MapView, Pose, RayEnd, Resolution, State, StateBlock, Voxel, VoxelBox, voxel_bit,
};
use flockmap_plan::{Collision, DistanceField, FieldConfig, Obstacles, cast_rays, states};

fn random() -> impl FnMut() -> f64 {
    let mut seed = 1u64;
    move || {
        seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (seed >> 40) as f64 / (1u64 << 24) as f64
    }
}

/// Ground below −1 m, trunks, and Free all between up to 8 m.
fn forest() -> MapView {
    let mut random = random();
    let trunks: Vec<[f64; 3]> =
        (0..60).map(|_| [random() * 300.0 - 150.0, random() * 300.0 - 150.0, 1.0 + random() * 3.0]).collect();
    let mut map = MapView::new(Resolution::from_metres(0.1).unwrap());
    for index in VoxelBox::new(Voxel::new(-160, -160, -16), [320, 320, 96]).unwrap().blocks() {
        let mut block = StateBlock::default();
        for bit in 0..BLOCK_VOXELS {
            let voxel = index.voxel(bit);
            let is_in = |[x, y, radius]: &[f64; 3]| {
                (f64::from(voxel.x) - x).powi(2) + (f64::from(voxel.y) - y).powi(2) < radius * radius
            };
            let is_occupied = voxel.z <= -10 || trunks.iter().any(is_in);
            block.set(bit, if is_occupied { State::Occupied } else { State::Free });
        }
        map.set_block(index, &block);
    }
    map
}

fn bench(c: &mut Criterion) {
    let map = forest();
    let config = FieldConfig::default();
    for (name, size) in [("10 × 10 × 4 m", [100, 100, 40]), ("20 × 20 × 6 m", [200, 200, 60])] {
        let region =
            VoxelBox::new(Voxel::new(-(size[0] as i32) / 2, -(size[1] as i32) / 2, -15), size).unwrap();
        c.bench_function(&format!("field, new, {name}"), |b| {
            b.iter(|| DistanceField::new(&map, region, &config).unwrap());
        });
        let mut field = DistanceField::new(&map, region, &config).unwrap();
        c.bench_function(&format!("field, in the memory of the last, {name}"), |b| {
            b.iter(|| field.move_to(&map, region).unwrap());
        });
        // One more trunk, 0.3 m wide and 2 m high.
        let mut after = map.clone();
        for voxel in VoxelBox::new(Voxel::new(20, 20, -9), [3, 3, 20]).unwrap().voxels() {
            let mut block = after.block(voxel.block()).unwrap_or_default();
            block.set(voxel_bit(voxel), State::Occupied);
            after.set_block(voxel.block(), &block);
        }
        let field = DistanceField::new(&map, region, &config).unwrap();
        c.bench_function(&format!("field, update by a new trunk, {name}"), |b| {
            b.iter_batched_ref(|| field.clone(), |field| field.update(&after), BatchSize::LargeInput);
        });
        // Of every block one voxel is another: what an update has to do at most.
        let mut after = map.clone();
        for index in region.blocks() {
            let mut block = map.block(index).unwrap_or_default();
            let is_occupied = block.get(219) == State::Occupied;
            block.set(219, if is_occupied { State::Free } else { State::Occupied });
            after.set_block(index, &block);
        }
        c.bench_function(&format!("field, update of every block, {name}"), |b| {
            b.iter_batched_ref(|| field.clone(), |field| field.update(&after), BatchSize::LargeInput);
        });
        c.bench_function(&format!("field, anew where every block is other, {name}"), |b| {
            b.iter_batched_ref(
                || field.clone(),
                |field| field.move_to(&after, region).unwrap(),
                BatchSize::LargeInput,
            );
        });
        c.bench_function(&format!("inflation by 0.5 m, {name}"), |b| b.iter(|| field.inflated(&map, 0.5)));
    }

    let mut random = random();
    let mut points = |count: usize| -> Vec<[f64; 3]> {
        (0..count).map(|_| [random() * 10.0 - 5.0, random() * 10.0 - 5.0, random() * 4.0 - 1.0]).collect()
    };
    let (from, to) = (points(10_000), points(10_000));
    let region = VoxelBox::new(Voxel::new(-50, -50, -15), [100, 100, 40]).unwrap();
    let field = DistanceField::new(&map, region, &config).unwrap();
    let collision = Collision::new(&map, Obstacles::Occupied);
    let mut found = vec![State::Unknown; from.len()];
    c.bench_function("10,000 states", |b| b.iter(|| states(&map, &from, &mut found).unwrap()));
    let (mut distances, mut gradients) = (vec![0.0; from.len()], vec![[0.0; 3]; from.len()]);
    c.bench_function("10,000 distances with gradients", |b| {
        b.iter(|| field.clearances(&from, &mut distances, &mut gradients));
    });
    let mut ends = vec![RayEnd::Clear; from.len()];
    c.bench_function("10,000 rays", |b| b.iter(|| cast_rays(&map, &from, &to, true, &mut ends).unwrap()));
    let mut flags = vec![false; from.len()];
    c.bench_function("10,000 spheres of 0.3 m, exact", |b| {
        b.iter(|| collision.spheres(&from, 0.3, &mut flags).unwrap());
    });
    c.bench_function("10,000 spheres of 0.3 m, by the field", |b| {
        b.iter(|| field.are_clear(&from, 0.3, &mut flags));
    });
    c.bench_function("10,000 spheres of 0.3 m swept along a segment", |b| {
        b.iter(|| {
            let sweep = |(from, to): (&[f64; 3], &[f64; 3])| collision.swept_sphere(*from, *to, 0.3).unwrap();
            from.iter().zip(&to).map(sweep).filter(Option::is_some).count()
        });
    });
    // About as many blocks as may be asked for at once, none of them there.
    c.bench_function("an aligned box of 97 × 97 × 97 blocks, Unknown", |b| {
        b.iter(|| collision.aligned_box([21.65; 3], [99.15; 3]).unwrap());
    });
    // Where all is an obstacle, the most cubes are near.
    let cautious = Collision::new(&map, Obstacles::NotFree);
    c.bench_function("a sphere of 38 m swept over 10 m, in the Unknown", |b| {
        b.iter(|| cautious.swept_sphere([110.0; 3], [100.0, 110.0, 110.0], 38.0).unwrap());
    });
    c.bench_function("10,000 oriented boxes of 0.6 × 0.4 × 0.3 m", |b| {
        b.iter(|| {
            let meets = |at: &&[f64; 3]| {
                let pose = Pose::from_yaw(**at, at[0]);
                collision.oriented_box(&pose, [0.3, 0.2, 0.15]).unwrap().is_some()
            };
            from.iter().filter(meets).count()
        });
    });
}

criterion_group!(benches, bench);
criterion_main!(benches);
