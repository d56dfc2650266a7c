//! Small files that ask for much memory do not get it. The only test in this file: it counts what the process
//! holds.

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use common::Folder;
use flockmap_io::ros::{
    Bytes, DiagnosticArray, MarkerArray, OccupancyGrid, PointCloud2, RosMessage, TFMessage, decode,
};
use flockmap_io::{OctoMap, RecordOptions, open_record, read_cloud};

struct Counting;

static HELD: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: hands every call on to the system's allocator and counts beside it.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let held = HELD.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        PEAK.fetch_max(held, Ordering::Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The most that was held at a time while `read` ran.
fn peak(read: impl FnOnce()) -> usize {
    let before = HELD.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    read();
    PEAK.load(Ordering::Relaxed) - before
}

/// An MCAP file with one chunk that says it unpacks to `size` bytes.
fn mcap(compression: &str, packed: &[u8], size: u64) -> Vec<u8> {
    let mut chunk = vec![0; 16];
    chunk.extend(size.to_le_bytes());
    chunk.extend([0; 4]);
    chunk.extend((compression.len() as u32).to_le_bytes());
    chunk.extend(compression.as_bytes());
    chunk.extend((packed.len() as u64).to_le_bytes());
    chunk.extend(packed);
    let mut bytes = b"\x89MCAP0\r\n".to_vec();
    bytes.push(6);
    bytes.extend((chunk.len() as u64).to_le_bytes());
    bytes.extend(chunk);
    bytes
}

fn lz4(data: &[u8]) -> Vec<u8> {
    use std::io::Write;
    let mut packer = lz4_flex::frame::FrameEncoder::new(Vec::new());
    packer.write_all(data).unwrap();
    packer.finish().unwrap()
}

#[test]
fn small_files_that_ask_for_much_memory_do_not_get_it() {
    let mib = 1 << 20;
    let zeros = vec![0; 100 * mib];
    let (zstd_bomb, lz4_bomb) = (zstd::bulk::compress(&zeros, 3).unwrap(), lz4(&zeros));
    drop(zeros);
    let promise = [b"\x89MCAP0\r\n".as_slice(), &[6], &(60u64 << 20).to_le_bytes(), b"no more"].concat();
    let pcd = |points: u64, data: &str| {
        format!("FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS {points}\nDATA {data}\n\u{1}\0\0\0\0\0\0\0")
            .into_bytes()
    };
    let ply = b"ply\nformat ascii 1.0\nelement vertex 190000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n";
    let tree = b"# Octomap OcTree binary file\nid OcTree\nsize 18446744073709551615\nres 0.1\ndata\n\x55\x55";
    let files: Vec<(&str, Vec<u8>)> = vec![
        ("a.mcap", mcap("zstd", &zstd_bomb, 8)),
        ("b.mcap", mcap("zstd", &zstd_bomb, 1 << 62)),
        ("c.mcap", mcap("lz4", &lz4_bomb, 8)),
        ("d.mcap", mcap("lz4", &lz4_bomb, u64::MAX)),
        ("e.mcap", mcap("", b"\x05\xff\xff\xff\xff\xff\xff\xff\x7f", 9)),
        ("f.mcap", [b"\x89MCAP0\r\n".as_slice(), &[6], &u64::MAX.to_le_bytes()].concat()),
        ("g.mcap.zstd", zstd::bulk::compress(&promise, 3).unwrap()),
        ("h.mcap.zstd", zstd_bomb.clone()),
        ("a.pcd", pcd(150_000_000, "binary")),
        ("b.pcd", pcd(150_000_000, "ascii")),
        ("c.pcd", pcd(150_000_000, "binary_compressed")),
        ("d.pcd", pcd(u64::MAX, "binary")),
        ("a.ply", ply.to_vec()),
        ("a.bt", tree.to_vec()),
    ];
    let folder = Folder::new();
    let read = |path: &Path| match path.extension().and_then(|e| e.to_str()) {
        Some("mcap" | "zstd") => open_record(path, &RecordOptions::default()).map(|_| ()),
        Some("bt") => OctoMap::read(path).map(|_| ()),
        _ => read_cloud(path).map(|_| ()),
    };
    for (name, bytes) in files {
        let path = folder.join(name);
        std::fs::write(&path, &bytes).unwrap();
        let mut result = Ok(());
        let held = peak(|| result = read(&path));
        println!("{name}: {} bytes in the file, {held} held", bytes.len());
        let error = result.expect_err(name);
        println!("{error}");
        // The window of lz4 is up to 4 MiB, and the packed bytes are held too.
        assert!(
            held < 12 * mib,
            "{name} of {} bytes made the reader hold {held} bytes: {error}",
            bytes.len()
        );
    }
    check_messages();
}

/// Messages that claim endless lists, of elements that take the fewest bytes.
fn check_messages() {
    fn check<T: RosMessage + serde::de::DeserializeOwned>(count_at: usize) {
        let mut bytes = vec![0; 1 << 20];
        bytes[1] = 1;
        bytes[count_at..count_at + 4].fill(0xff);
        let mut result = Ok(());
        let held = peak(|| result = decode::<T>(&bytes).map(drop));
        println!("{}, list at {count_at}: {held} held", T::SCHEMA);
        result.expect_err(T::SCHEMA);
        assert!(held < 24 * bytes.len(), "{} of {} bytes held {held}", T::SCHEMA, bytes.len());
    }
    check::<TFMessage>(4);
    check::<MarkerArray>(4);
    // Statuses, and the figures of a status.
    check::<DiagnosticArray>(16);
    let mut bytes = vec![0; 1 << 20];
    bytes[1] = 1;
    bytes[16] = 1;
    bytes[36..40].fill(0xff);
    let held = peak(|| drop(decode::<DiagnosticArray>(&bytes).unwrap_err()));
    assert!(held < 24 * bytes.len(), "figures held {held}");
    println!("figures: {held} held");
    // Fields, and points.
    check::<PointCloud2<Bytes>>(24);
    check::<PointCloud2<Bytes>>(40);
    check::<OccupancyGrid>(92);
}
