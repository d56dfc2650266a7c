//! The bytes of the format are frozen: packages committed here must be read for ever, and be written as they are
//! wherever no version of zlib has a say.
//!
//! After a change of layout, which is a change of [`FORMAT_VERSION`]: `FLOCKMAP_BLESS=1 cargo test -p flockmap-codec
//! --test golden` writes new files; keep the old ones if the old version can still be read.

mod common;

use common::{cycle, resolution, stream};
use flockmap_codec::{Codec, Content, Encoder, FORMAT_VERSION, Package, hilbert_order};
use flockmap_grid::{Changes, PresentState, Stamp, State, Voxel, VoxelBox};

/// The layout that [`FORMAT_VERSION`] stands for: CRC-32 over the golden packages that zlib has no part in.
/// If this changes, the version must change.
const LAYOUT: (u8, u32) = (1, 3_136_959_016);

fn golden_changes() -> Changes {
    let voxels = (0..60).map(|i: i32| {
        let voxel = Voxel::new(i * 7 % 11 - 5, i * 5 % 9 - 200, i * 3 % 7 + 1_000);
        (voxel, if i % 5 == 0 { State::Occupied } else { State::Free })
    });
    Changes::from_voxels(voxels)
}

fn golden_state(stamps: i64) -> PresentState {
    let changes = golden_changes();
    let part = |n: i64| {
        let of = |v: &Voxel| i64::from(v.x + v.y + v.z).rem_euclid(stamps) == n;
        (Stamp(1_000_000 * n - 5), Changes::from_voxels(changes.voxels().filter(|(v, _)| of(v))))
    };
    let region = VoxelBox::new(Voxel::new(-8, -208, 996), [24, 24, 16]).unwrap();
    PresentState { region, parts: (0..stamps).map(part).collect() }
}

/// Name, package made now, content it must have, whether its bytes must be those of the file.
fn golden() -> Vec<(String, Package, Content, bool)> {
    let mut encoder = Encoder::new();
    let mut all = Vec::new();
    for codec in Codec::ALL {
        let no_zlib = matches!(codec, Codec::Raw | Codec::Racer);
        let package = encoder.encode_whole(codec, &cycle(), 70_000, &golden_changes()).unwrap();
        all.push((format!("changes-{codec}"), package, Content::Changes(golden_changes()), no_zlib));
        for stamps in [1, 3] {
            let state = golden_state(stamps);
            let tiles = encoder.encode_present(codec, stream(), 70_000, resolution(), &state, 1150).unwrap();
            let [tile] = tiles.try_into().unwrap();
            let content = PresentState { region: golden_changes().bounding_box().unwrap(), ..state };
            let name = format!("present-{stamps}-{codec}");
            all.push((name, tile, Content::Present(content), no_zlib && stamps == 1));
        }
    }
    all
}

#[test]
fn golden_packages_are_read_and_written_as_ever() {
    let folder = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden"));
    let mut layout = Vec::new();
    for (name, made, content, same_bytes) in golden() {
        let file = folder.join(format!("v{FORMAT_VERSION}-{name}.bin"));
        if std::env::var_os("FLOCKMAP_BLESS").is_some() {
            std::fs::create_dir_all(folder).unwrap();
            std::fs::write(&file, made.bytes()).unwrap();
        }
        let bytes = std::fs::read(&file).unwrap();
        let read = Package::parse(&bytes).unwrap();
        assert_eq!(read.decode().unwrap(), content, "{name}");
        if same_bytes {
            assert_eq!(read.header(), made.header(), "{name}");
            assert!(made.bytes() == bytes, "{name}: other bytes than before; that is a new format version");
            layout.extend_from_slice(&bytes);
        } else {
            let (now, before) = (made.bytes().len(), bytes.len());
            assert!(now.abs_diff(before) * 20 <= before, "{name}: {now} B, was {before} B");
        }
    }
    let found = (FORMAT_VERSION, crc32fast::hash(&layout));
    assert_eq!(found, LAYOUT, "the layout has changed: that is a new format version");
}

/// The walk is part of the format: a decoder with another curve would give other voxels.
#[test]
fn the_hilbert_walk_is_as_ever() {
    let order: Vec<String> = hilbert_order([2, 3, 2]).iter().map(|[x, y, z]| format!("{x}{y}{z}")).collect();
    assert_eq!(order.join(" "), "000 010 020 021 011 001 101 111 121 120 110 100");
    let mut bytes = Vec::new();
    for size in [[20, 30, 10], [17, 9, 13], [64, 1, 31], [5, 40, 41]] {
        bytes.extend(hilbert_order(size).into_iter().flatten().flat_map(u32::to_le_bytes));
    }
    assert_eq!(crc32fast::hash(&bytes), 2_716_778_508);
}
