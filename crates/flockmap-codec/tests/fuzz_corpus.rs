//! What the fuzzer found worth keeping, and honest packages that it started from, run again: see
//! `fuzz/README.md`.
//!
//! After a change of layout `FLOCKMAP_BLESS=1 cargo test -p flockmap-codec --test fuzz_corpus` writes the
//! honest ones anew.

mod fuzz;

use std::path::{Path, PathBuf};

use flockmap_codec::{Base, Batch, Codec, Encoder, PACKAGE_BYTES_MAX, PACKAGE_BYTES_MIN, Package};
use flockmap_grid::{
    Changes, Resolution, RobotId, Snapshot, Stamp, State, Stream, VOXEL_LIMIT, Voxel, VoxelBox,
};
use fuzz::{Fuzz, Random, chunks, decode, round_trip};

fn folder(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(target)
}

/// Runs each file of a folder, by name; `made` are those that were not found by the fuzzer, for
/// `FLOCKMAP_BLESS`. The line that it prints must be the same on all machines, in debug and release.
fn replay(target: &str, made: impl FnOnce() -> Vec<(String, Vec<u8>)>, run: impl Fn(&mut Fuzz, &[u8])) {
    if std::env::var_os("FLOCKMAP_BLESS").is_some() {
        bless(target, made());
    }
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder(target)).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(!files.is_empty());
    let mut fuzz = Fuzz::default();
    for file in &files {
        println!("{}", file.display());
        run(&mut fuzz, &std::fs::read(file).unwrap());
    }
    println!("digest of {target}: {} files, {:016x}", files.len(), fuzz.digest.0);
}

#[test]
fn the_corpus_of_the_decoder_does_no_harm() {
    replay("decode", honest_packages, decode::run);
}

#[test]
fn the_corpus_of_chunks_does_no_harm() {
    replay("chunks", honest_chunks, chunks::run);
}

#[test]
fn the_corpus_of_flights_comes_back() {
    replay("round_trip", choices, round_trip::run);
}

/// What the fuzzer does, for a second: bytes changed here and there behind the header. That the check does
/// not fit stops nothing.
#[test]
fn damaged_payloads_say_nothing_impossible() {
    damage(&honest_packages(), 40, decode::run);
    damage(&honest_chunks(), 100, chunks::run);
}

fn damage(inputs: &[(String, Vec<u8>)], times: usize, run: impl Fn(&mut Fuzz, &[u8])) {
    let (mut fuzz, mut random) = (Fuzz::default(), Random(5));
    for (name, honest) in inputs {
        println!("{name}");
        for _ in 0..times {
            let mut bytes = honest.clone();
            for _ in 0..1 + random.next() % 3 {
                let at = 20 + random.next() as usize % (bytes.len() - 20);
                bytes[at] = random.next() as u8;
            }
            run(&mut fuzz, &bytes);
        }
    }
}

/// Writes inputs made here in place of those that were made before. What the fuzzer found stays: it has other
/// names.
fn bless(target: &str, inputs: Vec<(String, Vec<u8>)>) {
    let folder = folder(target);
    std::fs::create_dir_all(&folder).unwrap();
    for entry in std::fs::read_dir(&folder).unwrap() {
        let file = entry.unwrap().path();
        if file.extension().is_some_and(|extension| extension == "bin") {
            std::fs::remove_file(file).unwrap();
        }
    }
    for (name, bytes) in inputs {
        std::fs::write(folder.join(format!("{name}.bin")), bytes).unwrap();
    }
}

fn batch() -> Batch {
    Batch {
        stream: Stream { origin: RobotId(3), epoch: 2 },
        start: Stamp(1_000_000),
        end: Stamp(1_500_000),
        resolution: Resolution::from_micrometres(100_000).unwrap(),
        sensor: [-40, 0, 100],
    }
}

/// One voxel; a room's corner, seen from within; voxels without a pattern; a wall at the end of the grid,
/// which cuts its blocks.
fn contents() -> [(&'static str, Changes); 4] {
    let region = |low: [i32; 3], size| VoxelBox::new(Voxel::new(low[0], low[1], low[2]), size).unwrap();
    let room = region([-5, 3, -2], [20, 11, 9]).voxels().filter(|v| (3 * v.x + 5 * v.y + 7 * v.z) % 13 != 0);
    let room = room.map(|v| (v, if v.x == 14 || v.z == -2 { State::Occupied } else { State::Free }));
    let mut random = Random(11);
    let noise = region([500, -20, 0], [13, 9, 10]).voxels().filter_map(|voxel| match random.next() % 40 {
        0 => Some((voxel, State::Occupied)),
        1..5 => Some((voxel, State::Free)),
        _ => None,
    });
    let end = region([VOXEL_LIMIT - 8; 3], [9; 3]).voxels();
    let end = end.map(|v| (v, if v.x == VOXEL_LIMIT { State::Occupied } else { State::Free }));
    [
        ("one", Changes::from_voxels([(Voxel::new(-1, 7, 8), State::Occupied)])),
        ("room", Changes::from_voxels(room)),
        ("noise", Changes::from_voxels(noise.collect::<Vec<_>>())),
        ("end", Changes::from_voxels(end)),
    ]
}

/// Packages of every codec and kind, each behind the byte that chooses its layer.
fn honest_packages() -> Vec<(String, Vec<u8>)> {
    let (batch, mut encoder) = (batch(), Encoder::new());
    let mut all = Vec::new();
    let mut add = |name: String, seed: u8, package: &Package| {
        all.push((name, [&[seed], package.bytes()].concat()));
    };
    for codec in Codec::ALL {
        for (name, changes) in contents() {
            let name = format!("{codec}-{name}");
            add(name.clone(), 0, &encoder.encode_whole(codec, &batch, 7, &changes).unwrap());
            let pieces = encoder.encode_batch(codec, &batch, 300, &changes, PACKAGE_BYTES_MIN).unwrap();
            add(format!("{name}-piece"), 0, &pieces[pieces.len() - 1]);
            for stamps in [1, 3] {
                let state = snapshot(&changes, stamps);
                let chunks = encoder
                    .encode_snapshot(codec, batch.stream, 9, batch.resolution, &state, PACKAGE_BYTES_MAX)
                    .unwrap();
                add(format!("{name}-present-{stamps}"), 0, &chunks[0]);
            }
        }
    }
    for (name, changes) in contents() {
        for seed in [1, 6, 23, 64, 117] {
            // The layer goes by the box of the package, which is that of an independent package.
            let alone = encoder.encode_whole(Codec::Flock, &batch, 7, &changes).unwrap();
            let layer = decode::layer_beside(&alone.header().region, batch.end, seed);
            let base = Base { layer: layer.as_ref(), batches: &[(Stamp(0), 3)], readers: &[] };
            let packages = encoder
                .encode_batch_against(Codec::Flock, &batch, 7, &changes, Some(&base), PACKAGE_BYTES_MAX)
                .unwrap();
            add(format!("flock-{name}-against-{seed}"), seed, &packages[0]);
        }
    }
    all
}

/// Snapshots in small chunks, one after the other, each behind its length.
fn honest_chunks() -> Vec<(String, Vec<u8>)> {
    let (batch, mut encoder) = (batch(), Encoder::new());
    let mut all = Vec::new();
    for (name, changes) in contents() {
        for stamps in [1, 3, 20] {
            let mut state = snapshot(&changes, stamps);
            state.sensors = state.parts.iter().map(|part| (part.0, batch.sensor)).collect();
            let chunks = encoder
                .encode_snapshot(
                    Codec::Flock,
                    batch.stream,
                    9,
                    batch.resolution,
                    &state,
                    3 * PACKAGE_BYTES_MIN,
                )
                .unwrap();
            let bytes = chunks.iter().flat_map(|chunk| {
                let length = chunk.bytes().len() as u16;
                length.to_le_bytes().into_iter().chain(chunk.bytes().iter().copied())
            });
            all.push((format!("{name}-{stamps}"), bytes.collect()));
        }
    }
    all
}

fn snapshot(changes: &Changes, stamps: i64) -> Snapshot {
    let part = |number: i64| {
        let voxels = changes.voxels().filter(|(voxel, _)| i64::from(voxel.x).rem_euclid(stamps) == number);
        (Stamp(500_000 * number), Changes::from_voxels(voxels))
    };
    let parts: Vec<_> = (0..stamps).map(part).filter(|(_, part)| !part.is_empty()).collect();
    Snapshot { region: changes.bounding_box().unwrap(), parts, sensors: Vec::new() }
}

/// Flights of any kind, from short to long.
fn choices() -> Vec<(String, Vec<u8>)> {
    let mut random = Random(4);
    let inputs = (0..12).map(|number| {
        let bytes = (0..10 + 20 * number).map(|_| random.next() as u8).collect();
        (format!("any-{number}"), bytes)
    });
    inputs.collect()
}
