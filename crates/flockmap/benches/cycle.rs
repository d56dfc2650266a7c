//! The two times of the paper's Table IV: `t_pack` (batch start to packages ready; 5.30 ms there) and
//! `t_recv2insert` (package to fused map; 7.08 ms there), for a batch of the paper's real flight: 0.1 m
//! voxels, a local update box of 150 × 150 × 30, publish period 0.2 s (the paper's t_l), that is two scans at
//! 10 Hz.
//!
//! `cargo bench -p flockmap --bench batch`

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use flockmap::codec::{Content, Decoder, Encoder, PACKAGE_BYTES_MAX};
use flockmap::grid::Which;
use flockmap::{
    Batch, Changes, Codec, Fusion, FusionConfig, Mapper, MapperConfig, Pose, Preset, Resolution, RobotId,
    Scan, Stamp, Stream,
};

/// 20,000 rays among 60 trunks, from −7° to +52°, as of a robot 1.5 m above the ground.
fn scan(seed: u64) -> Scan {
    let mut seed = seed;
    let mut random = move || {
        seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (seed >> 40) as f64 / (1u64 << 24) as f64
    };
    let trunks: Vec<[f64; 3]> = (0..60)
        .map(|i| f64::from(i) * 2.399)
        .map(|a| [a.cos() * (1.5 + a / 10.0), a.sin() * (1.5 + a / 10.0), 0.15])
        .collect();
    let points = (0..20_000)
        .map(|_| {
            let (azimuth, elevation) =
                (random() * core::f64::consts::TAU, (random() * 59.0 - 7.0).to_radians());
            let d = [azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()];
            let mut length = if d[2] < 0.0 { 30f64.min(-1.5 / d[2]) } else { 30.0 };
            for [x, y, radius] in &trunks {
                let (along, across) = (x * d[0] + y * d[1], x * d[1] - y * d[0]);
                let flat = d[0].hypot(d[1]);
                if along > 0.0 && across.abs() < radius * flat {
                    length = length.min((x.hypot(*y) - radius) / flat);
                }
            }
            d.map(|d| (d * length) as f32)
        })
        .collect();
    Scan { stamp: Stamp(0), points, no_returns: Vec::new() }
}

/// The heaviest batch that the paper's settings allow: everything in the update box is seen for the first
/// time. Or, `on_the move`: two scans later, at 1.5 m/s.
fn mapper(on_the_move: bool) -> Mapper {
    let mut config = MapperConfig::preset(Preset::RogMap, Resolution::from_metres(0.1).unwrap(), 20.0);
    config.update_box_m = Some([7.49, 7.49, 1.49]);
    let mut mapper = Mapper::new(config).unwrap();
    mapper.insert(&scan(1), &Pose::IDENTITY, &[]);
    mapper.insert(&scan(2), &Pose::from_translation([0.005, 0.0, 0.0]), &[]);
    if on_the_move {
        mapper.take_changes(Which::All);
        mapper.insert(&scan(3), &Pose::from_translation([0.15, 0.0, 0.0]), &[]);
        mapper.insert(&scan(4), &Pose::from_translation([0.30, 0.0, 0.0]), &[]);
    }
    mapper
}

fn bench(c: &mut Criterion) {
    let resolution = Resolution::from_metres(0.1).unwrap();
    let stream = Stream { origin: RobotId(1), epoch: 1 };
    let batch = Batch { stream, start: Stamp(0), end: Stamp(200_000), resolution, sensor: [0; 3] };
    let mut encoder = Encoder::new();
    let mut decoder = Decoder::new();
    let own = Mapper::new(MapperConfig::preset(Preset::RogMap, resolution, 7.0)).unwrap();
    let fusion = || Fusion::new(Stream { origin: RobotId(2), epoch: 1 }, resolution, FusionConfig::default());

    for (kind, on_the_move) in [("first sight", false), ("on the move", true)] {
        let changes: Changes = mapper(on_the_move).take_changes(Which::All);
        let size = changes.bounding_box().unwrap().size();
        println!("{kind}: {} changed voxels in a box of {size:?}", changes.len());
        c.bench_function(&format!("t_pack, {kind}, one package"), |b| {
            b.iter_batched_ref(
                || mapper(on_the_move),
                |mapper| {
                    let changes = mapper.take_changes(Which::All);
                    encoder.encode_whole(Codec::Paper, &batch, 1, &changes).unwrap()
                },
                BatchSize::LargeInput,
            );
        });
        c.bench_function(&format!("t_pack, {kind}, datagrams"), |b| {
            b.iter_batched_ref(
                || mapper(on_the_move),
                |mapper| {
                    let changes = mapper.take_changes(Which::All);
                    encoder.encode_batch(Codec::Paper, &batch, 1, &changes, PACKAGE_BYTES_MAX).unwrap()
                },
                BatchSize::LargeInput,
            );
        });
        let whole = encoder.encode_whole(Codec::Paper, &batch, 1, &changes).unwrap();
        let parts = encoder.encode_batch(Codec::Paper, &batch, 1, &changes, PACKAGE_BYTES_MAX).unwrap();
        println!("{kind}: {} B in one package; {} datagrams", whole.bytes().len(), parts.len());
        for (name, packages) in [("one package", vec![whole]), ("datagrams", parts)] {
            c.bench_function(&format!("t_recv2insert, {kind}, {name}"), |b| {
                b.iter_batched_ref(
                    fusion,
                    |fusion| {
                        for package in &packages {
                            let received = flockmap::Package::parse(package.bytes()).unwrap();
                            let Content::Changes(changes) = decoder.decode(&received).unwrap() else {
                                unreachable!()
                            };
                            let end = received.header().batch_end;
                            fusion.apply(&own, stream, &changes, end, end).unwrap();
                        }
                    },
                    BatchSize::LargeInput,
                );
            });
        }
    }
}

criterion_group!(benches, bench);
criterion_main!(benches);
