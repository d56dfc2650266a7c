//! Time to make and to read the packages of one batch in a forest, 150 × 150 × 30 voxels (the paper's Table
//! IV has 5.30 ms for packing one). `cargo bench -p flockmap-codec`

#![allow(missing_docs, reason = "the macros of criterion make public functions")]

#[path = "../tests/common/mod.rs"]
mod common;

use criterion::{Criterion, criterion_group, criterion_main};
use flockmap_codec::{Codec, Decoder, Encoder, PACKAGE_BYTES_MAX, hilbert_order};
use std::hint::black_box;

fn benches(c: &mut Criterion) {
    let changes = common::forest_batch();
    let batch = common::batch();
    let (mut encoder, mut decoder) = (Encoder::new(), Decoder::new());

    c.bench_function("hilbert_order, 150 x 150 x 30", |b| {
        b.iter(|| hilbert_order(black_box([150, 150, 30])))
    });
    for codec in Codec::ALL {
        c.bench_function(&format!("encode_whole, {codec}"), |b| {
            b.iter(|| encoder.encode_whole(codec, &batch, 1, black_box(&changes)).unwrap());
        });
        let whole = encoder.encode_whole(codec, &batch, 1, &changes).unwrap();
        c.bench_function(&format!("decode whole, {codec}"), |b| {
            b.iter(|| decoder.decode(black_box(&whole)).unwrap());
        });
        c.bench_function(&format!("encode_batch, {codec}"), |b| {
            b.iter(|| {
                encoder.encode_batch(codec, &batch, 1, black_box(&changes), PACKAGE_BYTES_MAX).unwrap()
            });
        });
        let packages = encoder.encode_batch(codec, &batch, 1, &changes, PACKAGE_BYTES_MAX).unwrap();
        c.bench_function(&format!("decode batch, {codec}"), |b| {
            b.iter(|| packages.iter().map(|package| decoder.decode(package).unwrap()).count());
        });
    }
}

criterion_group! {
    name = all;
    config = Criterion::default().sample_size(20).warm_up_time(std::time::Duration::from_millis(300))
        .measurement_time(std::time::Duration::from_millis(1000)).without_plots();
    targets = benches
}
criterion_main!(all);
