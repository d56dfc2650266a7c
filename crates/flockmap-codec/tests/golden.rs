//! The bytes of the format are frozen: packages committed here must be read for ever, and be written as they are
//! wherever no version of zlib has a say.
//!
//! After a change of layout, which is a change of [`FORMAT_VERSION`]: `FLOCKMAP_BLESS=1 cargo test -p
//! flockmap-codec --test golden` writes new files, and its failure says the new [`LAYOUT`]; keep the old
//! files if the old version can still be read, or else to hold that it is refused.

mod common;

use common::{batch, resolution, stream};
use flockmap_codec::{
    Base, Codec, Content, Decoder, Encoder, FORMAT_VERSION, Package, PackageError, hilbert_order,
};
use flockmap_grid::{Changes, Layer, Snapshot, Stamp, State, Voxel};

/// The layout that [`FORMAT_VERSION`] stands for: CRC-32 over the golden packages that zlib has no part in.
/// If this changes, the version must change.
const LAYOUT: (u8, u32) = (5, 355_778_567);

/// Voxels without a pattern; for `flock`, which would take them for noise, a piece of a room in front of a wall.
fn golden_changes(codec: Codec) -> Changes {
    if codec == Codec::Flock {
        return room(0..9);
    }
    let voxels = (0..60).map(|i: i32| {
        let voxel = Voxel::new(i * 7 % 11 - 5, i * 5 % 9 - 200, i * 3 % 7 + 1_000);
        (voxel, if i % 5 == 0 { State::Occupied } else { State::Free })
    });
    Changes::from_voxels(voxels)
}

/// Free space in which nothing was seen here and there, and a wall that it ends at.
fn room(ys: core::ops::Range<i32>) -> Changes {
    let voxels = ys.flat_map(|y| (0..21).flat_map(move |x| (0..13).map(move |z| (x, y, z))));
    let voxels = voxels.filter(|(x, y, z)| (3 * x + 5 * y + 7 * z) % 11 != 0);
    Changes::from_voxels(voxels.map(|(x, y, z)| {
        let state = if x == 20 { State::Occupied } else { State::Free };
        (Voxel::new(x - 5, y - 200, z + 1_000), state)
    }))
}

fn golden_state(codec: Codec, stamps: i64) -> Snapshot {
    let changes = golden_changes(codec);
    let part = |n: i64| {
        let of = |v: &Voxel| match codec {
            Codec::Flock => i64::from(v.x + 5) * stamps / 21 == n,
            _ => i64::from(v.x + v.y + v.z).rem_euclid(stamps) == n,
        };
        (Stamp(1_000_000 * n - 5), Changes::from_voxels(changes.voxels().filter(|(v, _)| of(v))))
    };
    let blocks = changes.bounding_box().unwrap().blocks().map(|block| block.voxel_box());
    let region = blocks.reduce(|all, block| all.union(&block)).unwrap();
    // In the middle of a voxel, where `flock` puts them.
    let sensors = (0..stamps).map(|n| (part(n).0, [16 * n as i32 - 104, -3_000, 16_504])).collect();
    Snapshot { region, parts: (0..stamps).map(part).collect(), sensors }
}

/// A package with what it has to say.
struct Golden {
    name: String,
    package: Package,
    content: Content,
    /// What the package is coded against.
    layer: Option<Layer>,
    /// Its bytes must be those of the file.
    same_bytes: bool,
}

fn golden() -> Vec<Golden> {
    let mut encoder = Encoder::new();
    let mut all = Vec::new();
    for codec in Codec::ALL {
        let same_bytes = matches!(codec, Codec::Raw | Codec::Racer | Codec::Flock);
        let changes = golden_changes(codec);
        let package = encoder.encode_whole(codec, &batch(), 70_000, &changes).unwrap();
        let (name, content) = (format!("changes-{codec}"), Content::Changes(changes.clone()));
        all.push(Golden { name, package, content, layer: None, same_bytes });
        for stamps in [1, 3] {
            let state = golden_state(codec, stamps);
            let chunks =
                encoder.encode_snapshot(codec, stream(), 70_000, resolution(), &state, 1150).unwrap();
            let [package] = chunks.try_into().unwrap();
            assert_eq!(package.header().codec, codec);
            let content = if codec == Codec::Flock {
                state
            } else {
                Snapshot { region: changes.bounding_box().unwrap(), sensors: Vec::new(), ..state }
            };
            let (name, content) = (format!("present-{stamps}-{codec}"), Content::Snapshot(content));
            let same_bytes = same_bytes && (stamps == 1 || codec == Codec::Flock);
            all.push(Golden { name, package, content, layer: None, same_bytes });
        }
    }
    let package = encoder.encode_whole(Codec::Flock, &batch(), 70_000, &golden_changes(Codec::Raw)).unwrap();
    let content = Content::Changes(golden_changes(Codec::Raw));
    all.push(Golden { name: "noise-flock".into(), package, content, layer: None, same_bytes: true });
    all.push(against());
    all
}

/// The next batch: more of the room, and a part of the wall that is gone.
fn against() -> Golden {
    let before = Stamp(batch().end.0 - 1);
    let mut layer = Layer::default();
    let known = room(0..6);
    layer.apply(&known, before);
    let gone = known.voxels().filter(|(v, _)| v.x == 15 && v.z > 1_005).map(|(v, _)| (v, State::Free));
    let changes = Changes::from_voxels(room(6..12).voxels().chain(gone));
    let base = Base { layer: Some(&layer), batches: &[(before, 69_000)], readers: &[] };
    let packages = Encoder::new()
        .encode_batch_against(Codec::Flock, &batch(), 70_000, &changes, Some(&base), 1150)
        .unwrap();
    let [package] = packages.try_into().unwrap();
    assert_eq!((package.header().base, package.header().is_independent), (69_000, false));
    let content = Content::Changes(changes);
    Golden { name: "changes-against-flock".into(), package, content, layer: Some(layer), same_bytes: true }
}

#[test]
fn golden_packages_are_read_and_written_as_ever() {
    let folder = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden"));
    let mut layout = Vec::new();
    for Golden { name, package: made, content, layer, same_bytes } in golden() {
        let file = folder.join(format!("v{FORMAT_VERSION}-{name}.bin"));
        if std::env::var_os("FLOCKMAP_BLESS").is_some() {
            std::fs::create_dir_all(folder).unwrap();
            std::fs::write(&file, made.bytes()).unwrap();
        }
        let bytes = std::fs::read(&file).unwrap();
        let read = Package::parse(&bytes).unwrap();
        assert_eq!(Decoder::new().decode_against(&read, layer.as_ref()).unwrap(), content, "{name}");
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

#[test]
fn packages_of_former_versions_are_refused_with_a_word_about_the_version() {
    let folder = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden"));
    let mut refused = 0;
    for Golden { name, .. } in golden() {
        let bytes = std::fs::read(folder.join(format!("v4-{name}.bin"))).unwrap();
        let error = Package::parse(&bytes).unwrap_err();
        assert_eq!(error, PackageError::Version { found: 4 }, "{name}");
        assert_eq!(error.to_string(), "package format version 4, this program reads version 5");
        refused += 1;
    }
    assert!(refused > 10);
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
