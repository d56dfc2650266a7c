//! Any bytes as the log of a store; what the fuzzer runs, shared with the test that replays its corpus
//! (`fuzz/README.md`).
//!
//! Input: choices of pieces, of which a segment is made behind its sound header. First byte of a piece: 0 to
//! 127: so many of the bytes that follow stand as they are. 128 to 191: they are framed as a record of a type
//! from 0 to 3 with the right check, `u16 LE` long. 192 to 255: one of the honest packages stands there,
//! framed.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use flockmap::codec::{Base, Batch, Codec, Encoder};
use flockmap::grid::Layer;
use flockmap::{Changes, Package, Resolution, Robot, RobotConfig, RobotId, Stamp, State, Stream, Voxel};
use flockmap_store::memory::MemoryDisk;
use flockmap_store::{Disk, Folder, Identity, Store, StoreOptions, inspect};

fn resolution() -> Resolution {
    Resolution::from_metres(0.1).expect("a resolution")
}

fn identity() -> Identity {
    Identity { swarm: 0, robot: RobotId(1), resolution: resolution() }
}

fn robot(epoch: u64) -> Robot {
    let mut config = RobotConfig { epoch, ..RobotConfig::new(RobotId(1), resolution(), 7.0) };
    // What a store may make it hold is bounded by these.
    config.fusion.layer_bytes_max = 4 << 20;
    config.session.streams_max = 8;
    Robot::new(config, Stamp(0)).expect("a configuration that works")
}

/// Packages of two streams that build on each other, and a snapshot with its chunks.
fn honest() -> &'static [Package] {
    static PACKAGES: OnceLock<Vec<Package>> = OnceLock::new();
    PACKAGES.get_or_init(|| {
        let mut encoder = Encoder::new();
        let mut packages = Vec::new();
        for origin in [1, 2] {
            let stream = Stream { origin: RobotId(origin), epoch: 1 };
            let (mut layer, mut batches) = (Layer::default(), Vec::new());
            let mut next = 1;
            for tick in 1..=6 {
                let wall = (0..300).map(|n| (Voxel::new(n % 20, n / 20, tick), State::Free));
                let changes = Changes::from_voxels(wall.chain([(Voxel::new(tick, 3, 0), State::Occupied)]));
                let end = Stamp(i64::from(tick) * 100);
                let batch = Batch { stream, start: end, end, resolution: resolution(), sensor: [0; 3] };
                let base = Base { layer: Some(&layer), batches: &batches, readers: &[] };
                let coded =
                    encoder.encode_batch_against(Codec::Flock, &batch, next, &changes, Some(&base), 400);
                let coded = coded.expect("a batch that can be coded");
                layer.apply(&changes, end);
                next += coded.len() as u32;
                batches.push((end, next - 1));
                packages.extend(coded);
            }
            let state = layer.snapshot().expect("something is known");
            let chunks = encoder.encode_snapshot(Codec::Flock, stream, next - 1, resolution(), &state, 300);
            packages.extend(chunks.expect("a snapshot that can be coded"));
        }
        packages
    })
}

/// A segment of the pieces that the input chooses.
fn segment(input: &[u8]) -> Vec<u8> {
    // The header as a store writes it.
    static EMPTY: OnceLock<Vec<u8>> = OnceLock::new();
    let mut bytes = EMPTY
        .get_or_init(|| {
            let disk = MemoryDisk::default();
            let store = Store::open(Arc::new(disk.clone()), identity(), StoreOptions::default());
            drop(store.expect("an empty store").start(1));
            disk.files().into_values().next().expect("a segment")
        })
        .clone();
    let seed = crc32fast::hash(&bytes[..32]);
    let mut rest = input;
    while let Some((&choice, after)) = rest.split_first() {
        rest = after;
        match choice {
            0..128 => {
                let (raw, after) = rest.split_at(rest.len().min(choice.into()));
                bytes.extend_from_slice(raw);
                rest = after;
            }
            128..192 => {
                let Some((length, after)) = rest.split_first_chunk() else { break };
                let (content, after) = after.split_at(after.len().min(u16::from_le_bytes(*length).into()));
                frame(seed, choice % 4, content, &mut bytes);
                rest = after;
            }
            _ => frame(seed, 1, honest()[usize::from(choice - 192) % honest().len()].bytes(), &mut bytes),
        }
    }
    bytes
}

fn frame(seed: u32, kind: u8, content: &[u8], out: &mut Vec<u8>) {
    let length = (content.len() as u16).to_le_bytes();
    let mut hasher = crc32fast::Hasher::new_with_initial(seed);
    hasher.update(&[kind, length[0], length[1]]);
    hasher.update(content);
    out.extend_from_slice(&[0xf1, 0x0c, kind, length[0], length[1]]);
    out.extend_from_slice(&hasher.finalize().to_le_bytes());
    out.extend_from_slice(content);
}

pub(crate) fn run(input: &[u8]) {
    let name = "00000001-00000000000000000001.log";
    // A second one of which nothing is sure, not even the header.
    let other = "00000002-00000000000000000001.log";
    let files = [(name.to_owned(), segment(input)), (other.to_owned(), input.to_vec())];
    let disk = MemoryDisk::of(files.clone().into());
    let open = || Store::open(Arc::new(disk.clone()), identity(), StoreOptions::default());
    let Ok(mut store) = open() else { return };
    let epoch: u64 = store.last_epoch().map_or(2, |last| (last + 1).max(2));
    let mut first = robot(epoch);
    let restored = store.restore(&mut first, Stamp(1_000));
    assert!(restored.merged <= restored.packages, "{restored:?}");
    let bytes = files.iter().map(|(_, file)| file.len() as u64).sum::<u64>();
    assert!(restored.skipped_bytes + restored.torn_bytes <= bytes);
    assert!(first.fusion().layers().map(|(_, layer)| layer.block_count()).sum::<usize>() <= 2_000);

    // The second time it is the same, without what was cut off.
    let mut again = robot(epoch);
    let mut store = open().expect("as before");
    let second = store.restore(&mut again, Stamp(1_000));
    assert_eq!((second.packages, second.merged, second.torn_bytes), (restored.packages, restored.merged, 0));
    let digests = |robot: &Robot| -> Vec<(Stream, u64)> {
        robot.fusion().layers().map(|(stream, layer)| (stream, layer.digest())).collect()
    };
    assert_eq!(digests(&first), digests(&again));

    // And it can be gone on with, once its number is free.
    if epoch > 2 {
        return;
    }
    drop(store.start(epoch));
    assert!(disk.names().is_ok_and(|names| names.len() >= 2));
}

/// `flockmap info` reads real files: now and then only.
pub(crate) fn inspect_one(input: &[u8]) {
    let folder: PathBuf = std::env::temp_dir().join(format!("flockmap-store-fuzz-{}", std::process::id()));
    let fill = |folder: &Path| -> std::io::Result<()> {
        std::fs::create_dir_all(folder)?;
        std::fs::write(folder.join("00000001-00000000000000000001.log"), segment(input))?;
        std::fs::write(folder.join("00000002-00000000000000000001.log"), input)
    };
    fill(&folder).expect("a folder to write to");
    let inspection = inspect(&folder).expect("a folder to read");
    assert_eq!(inspection.segments.len(), 2);
    drop(Folder::open(&folder));
    std::fs::remove_dir_all(&folder).expect("the folder is ours");
}
