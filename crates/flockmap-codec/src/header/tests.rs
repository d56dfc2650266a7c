//! What is written is read, and nothing else.

use super::*;
use proptest::prelude::*;

fn header() -> impl Strategy<Value = Header> {
    let stamp = prop_oneof![
        any::<i64>(),
        0..1_800_000_000_000_000i64,
        (0..180_000_000_000i64).prop_map(|hundredths| hundredths * HUNDREDTH),
    ];
    let numbers = (any::<u16>(), any::<u64>(), 1..=u32::MAX, any::<u32>(), 1_000..=100_000_000u32);
    let side = prop_oneof![1..200u32, Just(1 << 28)];
    let corner = -(1 << 28)..=1i32;
    let corners = [corner.clone(), corner.clone(), corner];
    let region = (corners, [side.clone(), side.clone(), side], any::<bool>());
    let region = region.prop_map(|(corner, size, is_in_blocks)| match is_in_blocks {
        true => (corner.map(|c| c & !7), size.map(|s| (s + 7) & !7)),
        false => (corner, size),
    });
    let content = prop_oneof![
        Just(ContentKind::Changes),
        (any::<u32>(), any::<u32>(), 0..9u32, 9..2_000u32)
            .prop_map(|(since, id, chunk, chunks)| ContentKind::Snapshot { since, id, chunk, chunks }),
    ];
    let content = (
        content,
        0..Priority::ALL.len(),
        proptest::option::of(any::<i64>()),
        proptest::option::of(any::<u32>()),
    );
    let codec = (0..Codec::ALL.len()).prop_map(|at| Codec::ALL[at]);
    (numbers, [stamp.clone(), stamp], region, codec, content).prop_map(
        |(
            (origin, epoch, index, base, resolution),
            stamps,
            (corner, size),
            codec,
            (mut content, priority, lost_upto, later),
        )| {
            if let ContentKind::Snapshot { since, .. } = &mut content {
                *since %= index;
            }
            let priority = if content == ContentKind::Changes { priority } else { 0 };
            let (start, end) = (Stamp(stamps[0].min(stamps[1])), Stamp(stamps[0].max(stamps[1])));
            Header {
                priority: Priority::ALL[priority],
                stream: Stream { origin: RobotId(origin), epoch },
                index,
                batch_start: if content == ContentKind::Changes { rounded_start(start, end) } else { start },
                batch_end: end,
                base: if content == ContentKind::Changes { base % index } else { 0 },
                is_independent: content != ContentKind::Changes || base % index == 0 || epoch % 2 == 0,
                // Whole millimetres, whole centimetres, or neither.
                resolution: Resolution::from_micrometres(match resolution % 3 {
                    0 => resolution / 1_000 * 1_000,
                    1 => (resolution / 10_000).max(1) * 10_000,
                    _ => resolution,
                })
                .unwrap(),
                region: VoxelBox::new(Voxel::new(corner[0], corner[1], corner[2]), size).unwrap(),
                codec,
                content,
                lost_upto: lost_upto.filter(|_| content != ContentKind::Changes).map(Stamp),
                changed_upto: later.filter(|_| content != ContentKind::Changes).map(|later| later.max(1)),
                says_upto: later
                    .filter(|later| content != ContentKind::Changes && later % 2 == 1 && later % 3 == 0)
                    .map(|later| later.wrapping_mul(5).max(1)),
                is_cut: later.is_some_and(|later| later % 2 == 0) && content != ContentKind::Changes,
                is_of_all: later.is_some_and(|later| later % 4 == 0) && content != ContentKind::Changes,
            }
        },
    )
}

fn written(header: &Header) -> Vec<u8> {
    let mut bytes = Vec::new();
    header.write(&mut bytes);
    bytes.extend_from_slice(&[1, 2, 3, 4]);
    bytes
}

proptest! {
    #[test]
    fn every_header_comes_back_and_has_one_form(header in header()) {
        let bytes = written(&header);
        let payload = [&bytes[..], &[9; 5]].concat();
        let (read, tail, rest) = Header::read(&payload).unwrap();
        prop_assert_eq!(read, header);
        prop_assert_eq!((tail.checked, tail.check, rest), (bytes.len() - 4, 0x0403_0201, &[9u8; 5][..]));
        for length in 0..bytes.len() {
            prop_assert!(Header::read(&bytes[..length]).is_err());
        }
    }

    #[test]
    fn whatever_is_read_is_written_the_same(mut bytes in prop::collection::vec(any::<u8>(), 20..80), codec in 0..5u8, kind in 0..32u8) {
        bytes[0] = FORMAT_VERSION;
        bytes[1] = kind << KIND_SHIFT | codec;
        // Low bytes end numbers: more of the fields are in range.
        bytes[2..].iter_mut().filter(|byte| **byte % 3 > 0).for_each(|byte| *byte &= 0x7f);
        if let Ok((header, tail, _)) = Header::read(&bytes) {
            prop_assert_eq!(&written(&header)[..tail.checked], &bytes[..tail.checked]);
        }
    }

    #[test]
    fn boxes_in_blocks_come_back(corner in prop::array::uniform3(-(1 << 25)..0i32), size in prop::array::uniform3(1..300u32)) {
        let min = Voxel::new(corner[0] * 8, corner[1] * 8, corner[2] * 8);
        let region = VoxelBox::new(min, size.map(|side| side * 8)).unwrap();
        let mut bytes = Vec::new();
        write_box(&region, 8, &mut bytes);
        prop_assert_eq!(read_box(&mut Fields::new(&bytes), 8), Ok(region));
    }
}

#[test]
fn a_usual_header_takes_few_bytes() {
    let epoch = flockmap_grid::epoch(1_700_000_000, 0x8765_4321);
    let end = Stamp(epoch_micros(epoch) + 10 * 60 * 1_000_000);
    let header = Header {
        stream: Stream { origin: RobotId(3), epoch },
        index: 12_000,
        batch_start: end.plus_micros(-500_000),
        batch_end: end,
        base: 11_970,
        is_independent: false,
        resolution: Resolution::from_metres(0.1).unwrap(),
        region: VoxelBox::new(Voxel::new(-200, 310, -8), [60, 40, 24]).unwrap(),
        codec: Codec::Paper,
        content: ContentKind::Changes,
        lost_upto: None,
        changed_upto: None,
        says_upto: None,
        is_cut: false,
        is_of_all: false,
        priority: Priority::NearFree,
    };
    assert_eq!(written(&header).len(), 32);
}

#[test]
fn numbers_out_of_range_are_refused() {
    let refused = |edit: &dyn Fn(&mut Vec<u8>)| {
        // Version, kind and codec, origin, epoch, index 5, duration, batch end, resolution 0.1 m, box, base.
        let mut bytes = vec![FORMAT_VERSION, 2, 1, 0, 5, 1, 0, 40, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4];
        assert!(Header::read(&bytes).is_ok());
        edit(&mut bytes);
        Header::read(&bytes).unwrap_err().to_string()
    };
    assert_eq!(refused(&|b| b[4] = 0), "package header: indices begin at 1");
    // One block, counted as 8 × 8 × 8 voxels.
    let blocks = refused(&|b| b[11..14].copy_from_slice(&[7; 3]));
    assert_eq!(blocks, "package header: a box of whole blocks is counted in blocks");
    let end = "package header: a batch that ends at a whole hundredth of a second says so";
    assert_eq!(refused(&|b| b[5] = 0), end);
    assert_eq!(refused(&|b| b[14] = 5), "package header: a base is an earlier package");
    assert_eq!(refused(&|b| b[1] |= 3 << 5), "package header: priorities are 0 to 2");
    let snapshot = |later: u8, end: &[u8]| {
        let mut bytes = vec![FORMAT_VERSION, 2 | KIND_SNAPSHOT << KIND_SHIFT | later << 5, 1, 0, 5, 0, 0, 40];
        bytes.extend(
            [0; 6].into_iter().chain([0, 9, 9, 9, 9, 0, 1]).chain(end.iter().copied()).chain([1, 2, 3, 4]),
        );
        let said = |header: Header| (header.changed_upto, header.says_upto, header.newest_of());
        Header::read(&bytes).map(|(header, ..)| said(header)).map_err(|error| error.to_string())
    };
    assert_eq!(snapshot(OF_LATER, &[12, 0]), Ok((Some(12), None, 5)));
    assert_eq!(snapshot(OF_LATER, &[0, 9]), Ok((None, Some(9), 5)));
    let nothing = "package header: of later packages there is something to say";
    assert_eq!(snapshot(OF_LATER, &[0, 0]), Err(nothing.into()));
    assert_eq!(snapshot(CUT, &[14]), Ok((Some(12), None, 5)));
    assert_eq!(snapshot(CUT_OF_ALL, &[14]), Ok((Some(12), None, 12)));
    let rule = "package header: indices begin at 1";
    assert_eq!(snapshot(CUT, &[9]), Err(rule.into()));
    assert_eq!(snapshot(CUT, &[0xff, 0xff, 0xff, 0xff, 0x0f]), Err(rule.into()));
    assert_eq!(refused(&|b| b[1] = 7), "package codec 7 is not known; the sender may be newer");
    let late = refused(&|b| {
        b[1] |= KIND_SNAPSHOT << KIND_SHIFT;
        // A snapshot has another order of the stamps.
        b[5..7].copy_from_slice(&[0, 0]);
        b[14] = 5;
    });
    assert_eq!(late, "package header: a span begins after an earlier package");
    let resolution = "package header: the resolution is 1,000 to 100,000,000 micrometres in its shorter form";
    // 100 mm as micrometres and as millimetres; 0 cm; 10,001 cm.
    for code in [&[0xc1, 0x9a, 0x0c][..], &[0x92, 0x03], &[0], &[0xc4, 0xb8, 0x02]] {
        let refused = refused(&|bytes| drop(bytes.splice(7..8, code.iter().copied())));
        assert_eq!(refused, resolution);
    }
    let mut far = Vec::new();
    put_zigzag(&mut far, i64::MAX);
    assert!(read_box(&mut Fields::new(&[&far[..], &[0; 5]].concat()), 8).is_err());
    let mut wide = vec![0; 3];
    put_varint(&mut wide, u64::from(u32::MAX) - 1);
    assert!(read_box(&mut Fields::new(&[&wide[..], &[0; 2]].concat()), 1).is_err());
    for size in [u64::MAX, 1 << 63, (1 << 63) - 1] {
        let mut wide = vec![1; 3];
        put_varint(&mut wide, size);
        let is_too_wide = read_box(&mut Fields::new(&wide), 8).is_err();
        assert_eq!(is_too_wide, size > (1 << 63) - 1, "{size}");
    }
}
