//! Time of one scan, by world, LiDAR, rendering and range.
//!
//! `cargo bench -p flockmap-sim --bench scan`

use criterion::{Criterion, criterion_group, criterion_main};
use flockmap_grid::{Pose, Stamp};
use flockmap_worlds::{Lidar, Rendering, ScanOptions, Scanner, World};
use std::sync::Arc;

fn bench(c: &mut Criterion) {
    let worlds = [
        ("forest", Arc::new(World::forest(1)), [0.375, 0.025, 2.325]),
        ("indoor", Arc::new(World::indoor(1)), [-1.0, 1.2, 1.7]),
    ];
    for (name, world, place) in worlds {
        for lidar in Lidar::ALL {
            for rendering in [Rendering::Cast, Rendering::Polar] {
                for range_m in [10.0, 30.0] {
                    let options = ScanOptions { range_m, rendering, ..ScanOptions::default() };
                    let mut scanner = Scanner::new(Arc::clone(&world), lidar, options);
                    let mut number = 0;
                    c.bench_function(&format!("{name} {lidar} {rendering} {range_m} m"), |b| {
                        b.iter(|| {
                            number += 1;
                            let pose = Pose::from_yaw(place, number as f64 * 0.02);
                            scanner.scan(Stamp(number * 100_000), &pose, None, &[])
                        });
                    });
                }
            }
        }
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .sample_size(10)
        .warm_up_time(core::time::Duration::from_millis(200))
        .measurement_time(core::time::Duration::from_millis(600));
    targets = bench
}
criterion_main!(benches);
