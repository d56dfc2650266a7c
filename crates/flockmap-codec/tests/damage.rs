//! Damaged and foreign bytes are an error or the very same content: never a panic, never a wrong voxel.

mod common;

use common::{Random, batch, changes, resolution, stream};
use flockmap_codec::{Codec, Content, Decoder, Encoder, FORMAT_VERSION, Package};
use flockmap_grid::{Changes, Snapshot, Stamp, State, Voxel};
use proptest::prelude::*;

/// Packages of every codec and kind around a few hundred bytes.
fn samples() -> Vec<Package> {
    let mut random = Random(11);
    let mut group = |low: i32, count: usize| {
        let voxels = (0..count).map(|_| {
            let mut place = |side: u64| (random.next() % side) as i32;
            let voxel = Voxel::new(low + place(12), place(9) - 4, place(7) - 40);
            (voxel, if place(5) == 0 { State::Occupied } else { State::Free })
        });
        Changes::from_voxels(voxels.collect::<Vec<_>>())
    };
    let (first, second) = (group(-20, 150), group(-6, 100));
    let blocks = first.blocks().iter().chain(second.blocks()).copied().collect();
    let region = Changes::from_blocks(blocks).bounding_box().unwrap();
    let state = Snapshot {
        region,
        parts: vec![(Stamp(-5), first.clone()), (Stamp(1_000_000), second)],
        sensors: Vec::new(),
    };
    let mut encoder = Encoder::new();
    let mut packages = Vec::new();
    for codec in Codec::ALL {
        packages.push(encoder.encode_whole(codec, &batch(), 300, &first).unwrap());
        packages.extend(encoder.encode_snapshot(codec, stream(), 7, resolution(), &state, 1150).unwrap());
    }
    packages
}

/// `bytes` must be refused, or say the same as `package`.
fn assert_harmless(decoder: &mut Decoder, bytes: &[u8], package: &Package, content: &Content) {
    if let Ok(read) = Package::parse(bytes)
        && let Ok(found) = decoder.decode(&read)
    {
        assert_eq!(&found, content);
        assert_eq!(read.header(), package.header());
    }
}

#[test]
fn every_single_bit_flip_is_refused_or_harmless() {
    let mut decoder = Decoder::new();
    for package in samples() {
        let content = package.decode().unwrap();
        let mut bytes = package.bytes().to_vec();
        for bit in 0..bytes.len() * 8 {
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert_harmless(&mut decoder, &bytes, &package, &content);
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
    }
}

#[test]
fn every_truncation_and_every_added_byte_is_refused() {
    let mut decoder = Decoder::new();
    let mut is_refused = |bytes: &[u8]| Package::parse(bytes).and_then(|read| decoder.decode(&read)).is_err();
    for package in samples() {
        for length in 0..package.bytes().len() {
            assert!(is_refused(&package.bytes()[..length]), "{length} bytes of {package:?}");
        }
        for extra in [0x00, 0x01, 0xff] {
            assert!(is_refused(&[package.bytes(), &[extra]].concat()), "{package:?} and {extra}");
        }
    }
}

#[test]
fn payloads_exchanged_between_packages_are_refused() {
    let packages = samples();
    for a in &packages {
        for b in packages.iter().filter(|b| *b != a) {
            // The header up to the check with another package's tail.
            for cut in 1..a.bytes().len().min(60) {
                let mixed = [&a.bytes()[..cut], &b.bytes()[cut.min(b.bytes().len())..]].concat();
                if let Ok(read) = Package::parse(&mixed)
                    && mixed != a.bytes()
                    && mixed != b.bytes()
                {
                    assert!(read.decode().is_err(), "{read:?}");
                }
            }
        }
    }
}

#[test]
fn unknown_versions_codecs_and_kinds_are_named() {
    let package = &samples()[0];
    let with = |at: usize, value: u8| {
        let mut bytes = package.bytes().to_vec();
        bytes[at] = value;
        Package::parse(&bytes).unwrap_err().to_string()
    };
    assert_eq!(with(0, 1), "package format version 1, this program reads version 5");
    assert_eq!(with(1, 0x07), "package codec 7 is not known; the sender may be newer");
    assert!(with(1, 0x1a).contains("chunks"), "{}, not a chunk of a snapshot", with(1, 0x1a));
    assert_eq!(with(1, 0x62), "package header: priorities are 0 to 2");
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(300) })]

    #[test]
    fn random_bytes_do_no_harm(mut bytes in prop::collection::vec(any::<u8>(), 0..300), codec in 0..5u8, kind in 0..3u8) {
        let _ = Package::parse(&bytes);
        // Past the first fields.
        for (to, from) in bytes.iter_mut().zip([FORMAT_VERSION, kind << 3 | codec]) {
            *to = from;
        }
        if let Ok(package) = Package::parse(&bytes) {
            prop_assert!(package.decode().is_err());
        }
    }

    #[test]
    fn random_damage_is_refused_or_harmless(
        changes in changes(), codec in 0..4u8, flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let codec = Codec::from_id(codec).unwrap();
        let packages = Encoder::new().encode_batch(codec, &batch(), 1, &changes, 1150).unwrap();
        let package = &packages[0];
        let mut bytes = package.bytes().to_vec();
        for (at, value) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= value;
        }
        assert_harmless(&mut Decoder::new(), &bytes, package, &package.decode().unwrap());
    }
}
