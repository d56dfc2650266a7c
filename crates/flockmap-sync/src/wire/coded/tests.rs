use super::super::datagram::{DatagramHeader, Kind, seal};
use super::*;
use crate::coded::{Mended, Mender, repair_symbols};
use flockmap_codec::bytes::varint_len;
use flockmap_codec::{Batch, Codec, Encoder, Header, Package};
use flockmap_grid::{Changes, Resolution, RobotId, Stamp, State, Voxel};
use proptest::prelude::*;

const OWN: Stream = Stream { origin: RobotId(7), epoch: 3 };
const OTHER: Stream = Stream { origin: RobotId(300), epoch: 1_700_000_000 << 32 };
const HEADER: DatagramHeader =
    DatagramHeader { kind: Kind::Packages, swarm: 1, sender: OWN, stamp: Stamp(5) };

fn packages(stream: Stream, first: u32, payloads: &[usize]) -> Vec<Package> {
    let resolution = Resolution::from_metres(0.1).unwrap();
    let batch = Batch { stream, start: Stamp(1_000), end: Stamp(2_000), resolution, sensor: [0; 3] };
    let changes = Changes::from_voxels([(Voxel::new(1, 2, 3), State::Free)]);
    let header = *Encoder::new().encode_whole(Codec::Raw, &batch, 1, &changes).unwrap().header();
    let package = |(index, &payload): (u32, &usize)| {
        let payload: Vec<u8> = (0..payload).map(|at| (at * 31 + index as usize) as u8).collect();
        Package::from_parts(&Header { index, ..header }, &payload, index)
    };
    (first..).zip(payloads).map(package).collect()
}

fn coded(packages: &[Package], from: u32, count: usize) -> Coded {
    let refs: Vec<&Package> = packages.iter().collect();
    let Header { stream, index, .. } = *packages[0].header();
    let block = Block::of(stream, index, &refs).unwrap();
    let symbols = repair_symbols(&block, &refs, from, count).unwrap();
    Coded { block, first_symbol: from, symbols }
}

/// What comes of a record with this content.
fn parsed(id: u8, content: &[u8]) -> Result<Vec<Coded>, DatagramError> {
    let mut bytes = PackagesWriter::new(HEADER, DATAGRAM_BYTES_MAX).bytes;
    put_record(&mut bytes, id, content);
    let bytes = seal(bytes);
    parse_coded(&Datagram::new_checked(&bytes)?)
}

/// Type and content of the one record of a datagram with these symbols.
fn record(coded: &Coded) -> (u8, Vec<u8>) {
    let mut writer = PackagesWriter::new(HEADER, DATAGRAM_BYTES_MAX);
    assert_eq!(writer.push_coded(coded), coded.symbols.len() / coded.block.symbol_bytes());
    let bytes = writer.finish();
    let (id, content) = Datagram::new_checked(&bytes).unwrap().records().next().unwrap();
    (id, content.to_vec())
}

#[test]
fn golden_record() {
    let coded = coded(&packages(OTHER, 5, &[3, 60]), 0x1234, 2);
    let hex: String = record(&coded).1.iter().map(|byte| format!("{byte:02x}")).collect();
    assert_eq!(hex, GOLDEN);
}

/// Check and symbols are as another program makes them: the one in `docs/coded-repair.md`.
const GOLDEN: &str = "ac028080808080a0fca965050230022084f8f87d\
    b424e41237730d01f69abab3ca28fcad538dd9d6ded1dd6cefcefa7d6b051e0b2aa3";

proptest! {
    #[test]
    fn repair_symbols_survive_the_wire_as_far_as_there_is_room(
        payloads in prop::collection::vec(0..1_090usize, 1..=PACKAGES_MAX),
        first in 1..u32::MAX - 64,
        is_own: bool,
        from in 0..SYMBOL_NUMBERS,
        bytes_max in 30..=DATAGRAM_BYTES_MAX,
    ) {
        let coded = coded(&packages(if is_own { OWN } else { OTHER }, first, &payloads), from, 80);
        let mut writer = PackagesWriter::new(HEADER, bytes_max);
        let room = writer.room_for_coded(&coded.block);
        let count = writer.push_coded(&coded);
        prop_assert_eq!(count, room.min(80));
        // Not one more would fit, or the last byte of it, with a number of any length.
        prop_assert!(writer.bytes() <= bytes_max);
        if count > 0 {
            let spared = NUMBER_BYTES_MAX - varint_len(coded.first_symbol.into());
            let more = coded.block.symbol_bytes() + 1 + spared;
            prop_assert!(writer.bytes() + more > bytes_max || count == 80);
        }
        let bytes = writer.finish();
        let parsed = parse_coded(&Datagram::new_checked(&bytes).unwrap()).unwrap();
        let symbols = coded.symbols[..count * coded.block.symbol_bytes()].to_vec();
        let expected = if count == 0 { vec![] } else { vec![Coded { symbols, ..coded }] };
        prop_assert_eq!(parsed, expected);
    }

    #[test]
    fn any_content_is_refused_or_is_what_its_block_is_written_as(
        own: bool,
        content in prop::collection::vec(any::<u8>(), 0..200),
        small in prop::collection::vec(0..3u8, 0..60),
    ) {
        let id = if own { OWN_CODED } else { CODED };
        for content in [&content[..], &[&small[..], &content[..]].concat()] {
            if let Ok(read) = parsed(id, content) {
                let sender = if own { OWN } else { Stream { epoch: 99, ..OWN } };
                let (_, mut again) = put_head(&read[0].block, sender);
                put_varint(&mut again, read[0].first_symbol.into());
                again.extend(&read[0].symbols);
                prop_assert_eq!(again, content);
            }
        }
    }
}

#[test]
fn a_record_that_is_cut_is_refused() {
    let coded = coded(&packages(OTHER, 5, &[3, 600, 90]), 0, 3);
    let (id, content) = record(&coded);
    let each = coded.block.symbol_bytes();
    for length in 0..content.len() {
        let is_whole =
            length > content.len() - coded.symbols.len() && (content.len() - length).is_multiple_of(each);
        assert_eq!(parsed(id, &content[..length]).is_ok(), is_whole, "cut to {length} bytes");
    }
}

#[test]
fn a_record_with_any_bit_turned_is_refused_or_another_block_or_symbol() {
    let coded = coded(&packages(OTHER, 5, &[3, 600, 90]), 0, 3);
    let (id, content) = record(&coded);
    for bit in 0..8 * content.len() {
        let mut turned = content.clone();
        turned[bit / 8] ^= 1 << (bit % 8);
        assert!(parsed(id, &turned).map_or(true, |read| read != [coded.clone()]), "bit {bit}");
    }
}

#[test]
fn a_record_beyond_a_limit_is_refused() {
    // First, packages, form, fewest; what follows is 7 bits of each count, check, number, symbols.
    let content = |head: [u8; 4], packed: &[u8], number: u32, symbols: usize| {
        let mut content = [&head[..], packed, &[0; 4]].concat();
        put_varint(&mut content, number.into());
        content.resize(content.len() + symbols, 0);
        content
    };
    let is_taken = |content: Vec<u8>| parsed(OWN_CODED, &content).is_ok();
    assert!(is_taken(content([1, 1, 0, 1], &[], 0, 16)));
    assert!(is_taken(content([1, 64, 15, 4], &[], SYMBOL_NUMBERS - 1, 1_024)));
    let refused = [
        ("first 0", content([0, 1, 0, 1], &[], 0, 16)),
        ("no packages", content([1, 0, 0, 1], &[], 0, 16)),
        ("65 packages", content([1, 65, 0, 1], &[], 0, 16)),
        ("255 packages", content([1, 255, 0x70, 1], &[0xff; 224], 0, 16)),
        ("no symbols of a package", content([1, 1, 0, 0], &[], 0, 16)),
        ("75 symbols of a package", content([1, 1, 0, 75], &[], 0, 16)),
        ("255 symbols of a package", content([1, 1, 15, 255], &[], 0, 256)),
        ("more symbols than a byte", content([1, 2, 0x70, 200], &[0x80, 0x3f], 0, 16)),
        ("1,088 symbols", content([1, 64, 0, 17], &[], 0, 16)),
        ("eight bits", content([1, 2, 0x80, 1], &[0, 1], 0, 16)),
        ("bits that are not needed", content([1, 2, 0x20, 1], &[0b0100], 0, 16)),
        ("bits after the last", content([1, 2, 0x10, 1], &[0b0110], 0, 16)),
        ("not the fewest", content([1, 2, 0x10, 1], &[0b11], 0, 16)),
        ("number too high", content([1, 1, 0, 1], &[], SYMBOL_NUMBERS, 16)),
        ("number at the maximum", content([1, 1, 0, 1], &[], u32::MAX, 16)),
        ("no symbol", content([1, 1, 0, 1], &[], 0, 0)),
        ("half a symbol", content([1, 1, 0, 1], &[], 0, 24)),
    ];
    assert!(is_taken(content([1, 2, 0x10, 1], &[0b10], 0, 16)));
    for (what, content) in refused {
        assert!(!is_taken(content), "{what}");
    }
    let beyond_the_last_index = [&[0xff, 0xff, 0xff, 0xff, 0x0f, 2, 0, 1][..], &[0; 5], &[0; 16]].concat();
    assert!(!is_taken(beyond_the_last_index));
}

#[test]
fn two_hundred_thousand_false_records_neither_panic_nor_mend_anything_else() {
    // Some of each block is stored; blocks of one symbol, of some, and now and then of 1,000.
    let blocks: Vec<(Vec<Package>, Coded)> = [&[0][..], &[3, 60], &[3, 600, 90, 0, 200], &[1_090; 64]]
        .into_iter()
        .map(|payloads| packages(OTHER, 5, payloads))
        .map(|packages| (packages.clone(), coded(&packages, SYMBOL_NUMBERS - 40, 80)))
        .collect();
    let mut state = 88_172_645_463_325_252_u64;
    let mut any = |below: usize| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 8) as usize % below
    };
    let mut mender = Mender::default();
    let (mut worst, mut refused, mut mended, mut failed) = (core::time::Duration::ZERO, 0, 0, 0);
    for _ in 0..200_000 {
        let (packages, all) = &blocks[if any(50) == 0 { 3 } else { any(3) }];
        let mut coded = all.clone();
        let each = coded.block.symbol_bytes();
        let (at, count) = (any(80), (1 + any(3) * any(30)).min(1_000 / each));
        coded.first_symbol = (coded.first_symbol + at as u32) % SYMBOL_NUMBERS;
        coded.symbols = coded.symbols.chunks(each).skip(at).take(count).flatten().copied().collect();
        match any(8) {
            // Other bytes under the same number, true bytes under another one, another block.
            0 => coded.symbols.iter_mut().for_each(|byte| *byte = any(256) as u8),
            1 => coded.first_symbol = [0, 1, SYMBOL_NUMBERS - 1, any(1 << 21) as u32][any(4)],
            2 => coded.block.check ^= 1 << any(32),
            _ => {}
        }
        let (id, mut content) = record(&coded);
        for _ in 0..any(2) * any(4) {
            let at = any(content.len());
            content[at] = [0, 0xff, content[at] ^ 1 << any(8), any(256) as u8][any(4)];
        }
        content.truncate(content.len() - any(2) * any(2) * any(content.len()));
        let start = std::time::Instant::now();
        let Ok(read) = parsed(id, &content) else {
            refused += 1;
            continue;
        };
        let lacks = if any(8) == 0 { any(70) } else { any(4) };
        for coded in read {
            let stream = coded.block.stream;
            let of_index = |index: u32| packages.get(index.checked_sub(5)? as usize);
            let stored = |index: u32| of_index(index).filter(|_| index as usize >= 5 + lacks);
            match mender.take(coded, stored) {
                Ok(Mended::Needs(_)) => {}
                // What stands in no symbol is no part of their check.
                Ok(Mended::Packages(found)) => {
                    mended += 1;
                    assert!(stream != OTHER || found.iter().all(|package| packages.contains(package)));
                }
                Err(_) => failed += 1,
            }
        }
        worst = worst.max(start.elapsed());
        assert!(mender.bytes() <= 256 << 10);
    }
    println!("{refused} refused, {mended} mended, {failed} failed; {worst:?} at most");
    assert!(refused > 1_000 && mended > 1_000 && failed > 1_000);
}
