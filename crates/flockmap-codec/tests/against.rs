//! Batches of `flock` coded against what the receiver holds: right in every order, from wherever they were
//! seen, and never wrong.

mod common;

use common::{Random, batch, changes};
use flockmap_codec::{
    Base, Batch, Codec, Content, Decoder, Encoder, PACKAGE_BYTES_MAX, PACKAGE_BYTES_MIN, Package,
    PackageError,
};
use flockmap_grid::{Changes, Layer, Stamp, State, Voxel};
use proptest::prelude::*;

/// A sensor anywhere: among the voxels, far off, at the ends of what a header can say.
fn sensor() -> impl Strategy<Value = [i32; 3]> {
    let at = prop_oneof![4 => -1_500..1_500i32, 1 => any::<i32>(), 1 => Just(i32::MAX), 1 => Just(i32::MIN)];
    [at.clone(), at.clone(), at]
}

/// The changes that are news to a layer.
fn net(changes: &Changes, layer: &Layer) -> Changes {
    Changes::from_voxels(changes.voxels().filter(|(voxel, state)| layer.state(*voxel) != *state))
}

/// What a sensor at a place sees: free space in a ball, cut off by a wall, with holes.
fn seen(random: &mut Random, centre: [i32; 3]) -> Changes {
    let (radius, holes, wall) =
        (3 + (random.next() % 9) as i32, random.next() % 5, (random.next() % 9) as i32);
    let mut voxels = Vec::new();
    for x in -radius..=radius {
        for y in -radius..=radius {
            for z in -radius..=radius {
                if x * x + y * y + z * z > radius * radius || random.next() % 10 < holes || x > wall {
                    continue;
                }
                let state = if x == wall { State::Occupied } else { State::Free };
                voxels.push((Voxel::new(centre[0] + x, centre[1] + y, centre[2] + z), state));
            }
        }
    }
    Changes::from_voxels(voxels)
}

fn content(decoder: &mut Decoder, package: &Package, layer: &Layer) -> Result<Changes, PackageError> {
    let received = Package::parse(package.bytes())?;
    match decoder.decode_against(&received, Some(layer))? {
        Content::Changes(changes) => Ok(changes),
        Content::Snapshot(_) => panic!("a package of changes"),
    }
}

/// Sends the batches one after the other. The receiver takes the packages of each in any order, some of them
/// twice.
fn check(
    batches: &[Changes],
    sensors: &[[i32; 3]],
    bytes_max: usize,
    random: &mut Random,
) -> Result<(), TestCaseError> {
    let (mut encoder, mut decoder) = (Encoder::new(), Decoder::new());
    let (mut coded, mut held) = (Layer::default(), Layer::default());
    let mut ends: Vec<(Stamp, u32)> = Vec::new();
    let mut next_index = 1;
    for (number, (seen, sensor)) in batches.iter().zip(sensors.iter().cycle()).enumerate() {
        let changes = net(seen, &coded);
        if changes.is_empty() {
            continue;
        }
        let end = Stamp(batch().start.0 + 500_000 * number as i64);
        let batch = Batch { start: end, end, sensor: *sensor, ..batch() };
        let base = Base { layer: Some(&coded), batches: &ends, readers: &[] };
        let packages = encoder
            .encode_batch_against(Codec::Flock, &batch, next_index, &changes, Some(&base), bytes_max)
            .unwrap();
        next_index += packages.len() as u32;
        ends.push((end, next_index - 1));

        let mut order: Vec<usize> = (0..packages.len()).chain(0..packages.len() / 3).collect();
        (1..order.len()).for_each(|at| order.swap(at, random.next() as usize % (at + 1)));
        let mut voxels = 0;
        for (at, package) in packages.iter().enumerate() {
            prop_assert!(package.bytes().len() <= bytes_max);
            prop_assert!(package.header().base < package.header().index - at as u32);
        }
        for at in order {
            let part = content(&mut decoder, &packages[at], &held).unwrap();
            if let Some(sensor) = packages[at].sensor() {
                prop_assert_eq!(sensor, batch.sensor.map(|at| at & -16 | 8), "in the middle of a voxel");
            }
            voxels += part.len();
            held.apply(&part, end);
        }
        coded.apply(&changes, end);
        prop_assert!(voxels >= changes.len());
        prop_assert_eq!(held.digest(), coded.digest());
    }
    Ok(())
}

proptest! {
    #[test]
    fn any_changes_from_any_sensor_come_back_in_any_order(
        batches in prop::collection::vec(changes(), 1..4),
        sensors in prop::collection::vec(sensor(), 1..4),
        bytes_max in prop_oneof![Just(PACKAGE_BYTES_MAX), Just(PACKAGE_BYTES_MIN), 200..1_200usize],
        seed in any::<u64>(),
    ) {
        check(&batches, &sensors, bytes_max, &mut Random(seed))?;
    }

    #[test]
    fn flights_come_back_in_any_order(
        steps in 2..7usize,
        direction in [-4..=4i32, -4..=4i32, -4..=4i32],
        bytes_max in prop_oneof![Just(PACKAGE_BYTES_MAX), 192..400usize],
        seed in any::<u64>(),
    ) {
        let mut random = Random(seed);
        let centres = (0..steps as i32).map(|step| direction.map(|along| along * step));
        let centres: Vec<[i32; 3]> = centres.collect();
        let batches: Vec<Changes> = centres.iter().map(|centre| seen(&mut random, *centre)).collect();
        let sensors: Vec<[i32; 3]> = centres.iter().map(|centre| centre.map(|at| 16 * at + 8)).collect();
        check(&batches, &sensors, bytes_max, &mut random)?;
    }

    #[test]
    fn a_damaged_package_is_refused_or_says_the_same(seed in any::<u64>(), flips in prop::collection::vec((any::<u16>(), 0..8u8), 1..4)) {
        let mut random = Random(seed);
        let mut layer = Layer::default();
        layer.apply(&seen(&mut random, [0, 0, 0]), Stamp(1));
        let changes = net(&seen(&mut random, [3, 1, 0]), &layer);
        let end = Stamp(2);
        let batch = Batch { start: end, end, sensor: [56, 24, 8], ..batch() };
        let base = Base { layer: Some(&layer), batches: &[(Stamp(1), 1)], readers: &[] };
        let packages = Encoder::new()
            .encode_batch_against(Codec::Flock, &batch, 2, &changes, Some(&base), PACKAGE_BYTES_MAX)
            .unwrap();
        let mut decoder = Decoder::new();
        for package in &packages {
            let expected = content(&mut decoder, package, &layer).unwrap();
            let mut bytes = package.bytes().to_vec();
            for (at, bit) in &flips {
                let at = usize::from(*at) % bytes.len();
                bytes[at] ^= 1 << bit;
            }
            if let Ok(read) = Package::parse(&bytes)
                && let Ok(found) = decoder.decode_against(&read, Some(&layer))
            {
                prop_assert_eq!(found, Content::Changes(expected));
                prop_assert_eq!(read.header(), package.header());
            }
        }
    }
}

/// The state before the batch counts, and nothing else of the layer.
#[test]
fn another_state_before_the_batch_is_no_reference() {
    let mut random = Random(5);
    let (mut layer, mut other) = (Layer::default(), Layer::default());
    layer.apply(&seen(&mut random, [0, 0, 0]), Stamp(1));
    other.apply(&seen(&mut random, [0, 1, 0]), Stamp(1));
    let changes = net(&seen(&mut random, [4, 0, 0]), &layer);
    let batch = Batch { start: Stamp(2), end: Stamp(2), sensor: [72, 8, 8], ..batch() };
    let base = Base { layer: Some(&layer), batches: &[(Stamp(1), 1)], readers: &[] };
    let [package] = Encoder::new()
        .encode_batch_against(Codec::Flock, &batch, 2, &changes, Some(&base), PACKAGE_BYTES_MAX)
        .unwrap()
        .try_into()
        .unwrap();
    let mut decoder = Decoder::new();
    assert!(content(&mut decoder, &package, &other).is_err(), "the check finds it");
    assert_eq!(decoder.decode(&package), Err(PackageError::BaseMissing { base: 1 }), "nothing held at all");
    layer.apply(&Changes::from_voxels([(Voxel::new(0, 0, 0), State::Occupied)]), Stamp(3));
    let superseded = content(&mut decoder, &package, &layer);
    assert!(matches!(superseded, Err(PackageError::BaseSuperseded(_))), "{superseded:?}");
}
