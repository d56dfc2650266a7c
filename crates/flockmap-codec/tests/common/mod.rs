//! Content for tests and benchmarks: random changes, and the changes of a LiDAR's flight through a small forest.
#![allow(dead_code, reason = "each test file and the benchmark use a part of it")]

mod random;

pub(crate) use random::Random;

use flockmap_codec::Batch;
use flockmap_grid::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
use proptest::prelude::*;

pub(crate) fn stream() -> Stream {
    Stream { origin: RobotId(3), epoch: 2 }
}

pub(crate) fn resolution() -> Resolution {
    Resolution::from_micrometres(100_000).unwrap()
}

pub(crate) fn batch() -> Batch {
    let start = Stamp(1_700_000_000_000_000);
    Batch {
        stream: stream(),
        start,
        end: start.plus_micros(500_000),
        resolution: resolution(),
        sensor: [-900, -2_300, 16_100],
    }
}

/// Changes of many shapes: sparse and dense, flat and long boxes, far from zero on either side, single voxels.
pub(crate) fn changes() -> impl Strategy<Value = Changes> {
    let corner = prop_oneof![-40..40i32, Just(-(1 << 28)), Just((1 << 28) - 60), -100_000..100_000i32];
    let size = prop_oneof![Just([1u32, 1, 1]), [1..40u32, 1..40u32, 1..20u32], [1..3u32, 1..60u32, 1..30u32]];
    ([corner.clone(), corner.clone(), corner], size, 1..=100u64, any::<u64>()).prop_map(
        |(corner, size, percent, seed)| {
            let mut random = Random(seed);
            let mut voxels = Vec::new();
            for x in 0..size[0] as i32 {
                for y in 0..size[1] as i32 {
                    for z in 0..size[2] as i32 {
                        if random.next() % 100 < percent {
                            let state =
                                if random.next().is_multiple_of(4) { State::Occupied } else { State::Free };
                            voxels.push((Voxel::new(corner[0] + x, corner[1] + y, corner[2] + z), state));
                        }
                    }
                }
            }
            if voxels.is_empty() {
                voxels.push((Voxel::new(corner[0], corner[1], corner[2]), State::Free));
            }
            Changes::from_voxels(voxels)
        },
    )
}

/// The changes of half a second of flight: a sensor with a range of 7.4 m and 0.1 m voxels moves 0.75 m between
/// tree trunks, after it has mapped for half a second. The box is 150 × 150 × 30 voxels.
pub(crate) fn forest_batch() -> Changes {
    const SIZE: [usize; 3] = [150, 150, 30];
    let place = |v: [usize; 3]| (v[2] * SIZE[1] + v[1]) * SIZE[0] + v[0];
    let mut random = Random(7);
    let mut solid = vec![false; SIZE[0] * SIZE[1] * SIZE[2]];
    // Leaning trunks with crowns, on uneven ground.
    let trees: Vec<[f64; 7]> = (0..70)
        .map(|_| {
            let mut within = |low: f64, high: f64| low + (high - low) * random.unit();
            let (x, y) = (within(0.0, 150.0), within(0.0, 150.0));
            [
                x,
                y,
                within(1.0, 3.5),
                within(-0.25, 0.25),
                within(-0.25, 0.25),
                within(12.0, 34.0),
                within(3.0, 10.0),
            ]
        })
        .filter(|tree| (tree[0] - 75.0).hypot(tree[1] - 75.0) > 14.0)
        .collect();
    for x in 0..SIZE[0] {
        for y in 0..SIZE[1] {
            for z in 0..SIZE[2] {
                let p = [x, y, z].map(|c| c as f64 + 0.5);
                let ground = 2.0 + (p[0] * 0.11).sin() + (p[1] * 0.07).cos();
                let in_tree = |t: &[f64; 7]| {
                    let trunk = (p[0] - t[0] - t[3] * p[2]).hypot(p[1] - t[1] - t[4] * p[2]) < t[2];
                    let crown = [p[0] - t[0] - t[3] * t[5], p[1] - t[1] - t[4] * t[5], 1.5 * (p[2] - t[5])];
                    trunk || crown.iter().map(|c| c * c).sum::<f64>() < t[6] * t[6]
                };
                solid[place([x, y, z])] = p[2] < ground || trees.iter().any(in_tree);
            }
        }
    }
    let mut seen = vec![State::Unknown; solid.len()];
    let mut before = seen.clone();
    for scan in 0..10 {
        if scan == 5 {
            before.clone_from(&seen);
        }
        let from = [71.0 + 0.75 * f64::from(scan), 75.3, 14.6];
        let (roll, nod) = (0.05 * f64::from(scan).sin(), 0.12 + 0.03 * f64::from(scan).cos());
        for _ in 0..20_000 {
            let yaw = random.unit() * core::f64::consts::TAU;
            let pitch = -0.12 + random.unit();
            let d = [yaw.cos() * pitch.cos(), yaw.sin() * pitch.cos(), pitch.sin()];
            // The craft leans.
            let d = [d[0] + nod * d[2], d[1] + roll * d[2], d[2] - nod * d[0] - roll * d[1]];
            let mut range = 0.0;
            while range < 74.0 {
                let p: [f64; 3] = core::array::from_fn(|axis| from[axis] + d[axis] * range);
                if (0..3).any(|axis| p[axis] < 0.0 || p[axis] >= SIZE[axis] as f64) {
                    break;
                }
                let at = place(p.map(|c| c as usize));
                if solid[at] {
                    seen[at] = State::Occupied;
                    break;
                }
                seen[at] = State::Free;
                range += 0.5;
            }
        }
    }
    // Two corners, so that the box has its full size.
    for corner in [[0; 3], SIZE.map(|s| s - 1)] {
        before[place(corner)] = State::Unknown;
        seen[place(corner)] = State::Free;
    }
    let mut voxels = Vec::new();
    for x in 0..SIZE[0] {
        for y in 0..SIZE[1] {
            for z in 0..SIZE[2] {
                let at = place([x, y, z]);
                if seen[at] != before[at] {
                    voxels.push((Voxel::new(x as i32 - 70, y as i32 - 75, z as i32 - 10), seen[at]));
                }
            }
        }
    }
    Changes::from_voxels(voxels)
}
