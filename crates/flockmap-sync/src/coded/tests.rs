use super::block::Sources;
use super::code::solve;
use super::*;
use crate::IntervalSet;
use crate::wire::{Coded, DatagramHeader, Kind, PackagesWriter};
use flockmap_codec::{Batch, Codec, Encoder, Header, Package};
use flockmap_grid::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
use proptest::prelude::*;
use std::collections::BTreeMap;

const STREAM: Stream = Stream { origin: RobotId(300), epoch: 1_700_000_000 << 32 };

fn header() -> Header {
    let batch = Batch {
        stream: STREAM,
        start: Stamp(1_000),
        end: Stamp(2_000),
        resolution: Resolution::from_metres(0.1).unwrap(),
        sensor: [0; 3],
    };
    let changes = Changes::from_voxels([(Voxel::new(1, 2, 3), State::Free)]);
    *Encoder::new().encode_whole(Codec::Raw, &batch, 1, &changes).unwrap().header()
}

/// Numbers that look like any, the same each time.
fn noise(seed: u64) -> impl Iterator<Item = u64> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    core::iter::repeat_with(move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state >> 8
    })
}

/// A package with so many bytes of nonsense for a payload: nobody here decodes it.
fn package(index: u32, payload: usize) -> Package {
    let payload: Vec<u8> =
        noise(u64::from(index) << 20 | payload as u64).take(payload).map(|v| v as u8).collect();
    Package::from_parts(&Header { index, ..header() }, &payload, index)
}

fn packages(first: u32, payloads: &[usize]) -> Vec<Package> {
    (first..).zip(payloads).map(|(index, &payload)| package(index, payload)).collect()
}

fn refs(packages: &[Package]) -> Vec<&Package> {
    packages.iter().collect()
}

fn block(packages: &[Package]) -> Block {
    Block::of(STREAM, packages[0].header().index, &refs(packages)).unwrap()
}

fn coded(block: &Block, packages: &[Package], from: u32, count: usize) -> Coded {
    let symbols = repair_symbols(block, &refs(packages), from, count).unwrap();
    Coded { block: block.clone(), first_symbol: from, symbols }
}

/// What a receiver has stored.
type Stored = BTreeMap<u32, Package>;

fn stored(packages: &[Package], has: impl Fn(u32) -> bool) -> Stored {
    let all = packages.iter().map(|package| (package.header().index, package.clone()));
    all.filter(|(index, _)| has(*index)).collect()
}

fn lacking(packages: &[Package], stored: &Stored) -> Vec<Package> {
    packages.iter().filter(|package| !stored.contains_key(&package.header().index)).cloned().collect()
}

const SOME: [usize; 8] = [20, 300, 1_000, 0, 77, 78, 640, 5];

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_loss_is_mended_bit_by_bit_by_as_many_symbols_as_are_lacking_or_two_more(
        payloads in prop::collection::vec(0..1_090usize, 1..=PACKAGES_MAX),
        first in 1..u32::MAX - 64,
        has: u64,
        starts in prop::collection::vec(0..SYMBOL_NUMBERS, 1..4),
        at_once in 1..70usize,
    ) {
        let packages = packages(first, &payloads);
        let block = block(&packages);
        prop_assert!(block.sources() <= SOURCES_MAX);
        let stored = stored(&packages, |index| has >> (index - first) & 1 == 1);
        let received = IntervalSet::from_intervals(64, stored.keys().map(|&index| (index, index)).collect());
        let needs = block.symbols_lacking(&received);
        let mut mender = Mender::default();
        let mut numbers = std::collections::BTreeSet::new();
        let encoder = BlockEncoder::new(&block, &refs(&packages)).unwrap();
        // Several holders, each with numbers of its own.
        for nth in 0.. {
            let from = (starts[nth % starts.len()] + (nth / starts.len() * at_once) as u32) % SYMBOL_NUMBERS;
            numbers.extend(block::numbers(from, at_once));
            let symbols = encoder.symbols(from, at_once);
            let coded = Coded { block: block.clone(), first_symbol: from, symbols };
            let mended = mender.take(coded, |index| stored.get(&index)).unwrap();
            match mended {
                Mended::Needs(more) if numbers.len() < needs => {
                    prop_assert_eq!(more, needs - numbers.len());
                }
                Mended::Needs(more) => prop_assert!(more == 1 && numbers.len() < needs + 2),
                Mended::Packages(mended) => {
                    prop_assert!(needs == 0 || numbers.len() >= needs);
                    prop_assert_eq!(mended, lacking(&packages, &stored));
                    break;
                }
            }
        }
        prop_assert_eq!(mender.repairs_kept(), 0);
    }
}

#[test]
fn symbols_of_two_holders_help_each_other() {
    let packages = packages(5, &SOME);
    let block = block(&packages);
    let stored = stored(&packages, |index| index % 2 == 0);
    let needs: usize = [5, 7, 9, 11].iter().map(|&index| block.symbols_of(index)).sum();
    let half = needs / 2;
    let [one, other] =
        [1, 2].map(|robot| coded(&block, &packages, symbol_number(RobotId(robot), 0), needs - half));
    let mut mender = Mender::default();
    let get = |index: u32| stored.get(&index);
    assert_eq!(mender.take(one.clone(), get), Ok(Mended::Needs(half)));
    assert_eq!(mender.take(one, get), Ok(Mended::Needs(half)), "the same again is no help");
    assert_eq!(mender.take(other, get), Ok(Mended::Packages(lacking(&packages, &stored))));
}

#[test]
fn three_hundred_robots_begin_far_from_each_other() {
    let starts: std::collections::BTreeSet<u32> =
        (0..=300).map(|robot| symbol_number(RobotId(robot), 0)).collect();
    assert_eq!(starts.len(), 301);
    let starts: Vec<u32> = starts.into_iter().collect();
    let nearest = starts.windows(2).map(|pair| pair[1] - pair[0]).min();
    assert_eq!(nearest, Some(4_025));
    for robot in 0..=u16::MAX {
        let number = symbol_number(RobotId(robot), u32::MAX);
        assert!(number < SYMBOL_NUMBERS);
    }
}

#[test]
fn numbers_go_on_from_0_after_the_last() {
    let packages = packages(1, &SOME);
    let block = block(&packages);
    let across = coded(&block, &packages, SYMBOL_NUMBERS - 2, 5);
    let last = coded(&block, &packages, SYMBOL_NUMBERS - 2, 2);
    let next = coded(&block, &packages, 0, 3);
    assert_eq!(across.symbols, [last.symbols, next.symbols].concat());
    let mut mender = Mender::default();
    let first = stored(&packages, |index| !(1..=2).contains(&index));
    let needs = block.symbols_of(1) + block.symbols_of(2);
    let all = coded(&block, &packages, SYMBOL_NUMBERS - 2, needs);
    let mended = mender.take(all, |index| first.get(&index));
    assert_eq!(mended, Ok(Mended::Packages(packages[..2].to_vec())));
}

#[test]
fn a_package_that_comes_meanwhile_counts() {
    let packages = packages(1, &SOME);
    let block = block(&packages);
    let mut has = stored(&packages, |index| index > 3);
    let needs = block.symbols_of(1) + block.symbols_of(2);
    let mut mender = Mender::default();
    let mended = mender.take(coded(&block, &packages, 9, needs), |index| has.get(&index));
    assert_eq!(mended, Ok(Mended::Needs(block.symbols_of(3))));
    has.insert(3, packages[2].clone());
    assert_eq!(mender.retry(Stream { epoch: 1, ..STREAM }, 3, |index| has.get(&index)), []);
    assert_eq!(mender.retry(STREAM, 99, |index| has.get(&index)), []);
    assert_eq!(mender.retry(STREAM, 3, |index| has.get(&index)), packages[..2]);
    assert_eq!((mender.repairs_kept(), mender.failed()), (0, 0));
}

#[test]
fn what_nothing_is_lacking_of_is_not_kept() {
    let packages = packages(1, &SOME);
    let block = block(&packages);
    let mut mender = Mender::default();
    let mended = mender.take(coded(&block, &packages, 9, 1), |index| packages.get(index as usize - 1));
    assert_eq!((mended, mender.repairs_kept()), (Ok(Mended::Packages(Vec::new())), 0));
}

#[test]
fn a_package_that_is_dropped_meanwhile_is_lacking() {
    let packages = packages(1, &SOME);
    let block = block(&packages);
    let [most, fewer] = [1, 2].map(|lost| stored(&packages, |index| index > lost));
    let mut mender = Mender::default();
    let needs = block.symbols_of(1);
    let mended = mender.take(coded(&block, &packages, 0, needs - 1), |index| most.get(&index));
    assert_eq!(mended, Ok(Mended::Needs(1)));
    let more = block.symbols_of(2);
    let mended = mender.take(coded(&block, &packages, needs as u32 - 1, 1), |index| fewer.get(&index));
    assert_eq!(mended, Ok(Mended::Needs(more)));
    let mended = mender.take(coded(&block, &packages, needs as u32, more), |index| fewer.get(&index));
    assert_eq!(mended, Ok(Mended::Packages(packages[..2].to_vec())));
}

#[test]
fn symbols_of_other_blocks_are_kept_apart() {
    let ours = packages(1, &SOME);
    let mut theirs = ours.clone();
    theirs[0] = Package::from_parts(&Header { index: 1, ..header() }, &[7; 20], 1);
    let (block_of_ours, block_of_theirs) = (block(&ours), block(&theirs));
    // Nothing but the check tells them apart.
    assert_eq!(Block { check: block_of_ours.check, ..block_of_theirs.clone() }, block_of_ours);
    let stored = stored(&ours, |index| index > 1);
    let get = |index: u32| stored.get(&index);
    let needs = block_of_ours.symbols_of(1);
    let mut mender = Mender::default();
    let first = mender.take(coded(&block_of_theirs, &theirs, 0, needs - 1), get);
    assert_eq!(first, Ok(Mended::Needs(1)));
    let ours_mended = mender.take(coded(&block_of_ours, &ours, 0, needs), get);
    assert_eq!(ours_mended, Ok(Mended::Packages(ours[..1].to_vec())));
    let theirs_mended = mender.take(coded(&block_of_theirs, &theirs, 9, 1), get);
    assert_eq!(theirs_mended, Ok(Mended::Packages(theirs[..1].to_vec())));
}

#[test]
fn a_false_symbol_drops_the_block_and_true_ones_mend_it_after_that() {
    let packages = packages(1, &SOME);
    let block = block(&packages);
    let stored = stored(&packages, |index| index > 2);
    let get = |index: u32| stored.get(&index);
    let needs = block.symbols_of(1) + block.symbols_of(2);
    let honest = coded(&block, &packages, 40, needs);
    for at in 0..honest.symbols.len() {
        let mut mender = Mender::default();
        let mut false_one = honest.clone();
        false_one.symbols[at] ^= 1;
        assert_eq!(mender.take(false_one, get), Err(MendError::Check));
        assert_eq!((mender.repairs_kept(), mender.failed()), (0, 1));
        assert_eq!(mender.take(honest.clone(), get), Ok(Mended::Packages(packages[..2].to_vec())));
    }
    let mut mender = Mender::default();
    let false_check = Coded { block: Block { check: block.check ^ 1, ..block }, ..honest };
    assert_eq!(mender.take(false_check, get), Err(MendError::Check));
}

#[test]
fn symbols_that_say_nothing_new_drop_the_block_after_eight() {
    let one = package(1, 10);
    let blank = Block::new(STREAM, 1, vec![1], 64, 0).unwrap();
    let sources = blank.sources_of(|_| Some(&one)).unwrap();
    let block = Block { check: crc32fast::hash(&sources.bytes), ..blank };
    let encoder = BlockEncoder::new(&block, &[&one]).unwrap();
    let coded =
        |number| Coded { block: block.clone(), first_symbol: number, symbols: encoder.symbols(number, 1) };
    // Of one source symbol a repair symbol is a multiple, and one in 256 of these is zero.
    let is_useless = |number: &u32| match Mender::default().take(coded(*number), |_| None).unwrap() {
        Mended::Needs(more) => more == 1,
        Mended::Packages(mended) => mended != [one.clone()],
    };
    let useless: Vec<u32> = (0..20_000).filter(is_useless).take(9).collect();
    let mut mender = Mender::default();
    let (last, all_but_one) = useless.split_last().unwrap();
    for &number in all_but_one {
        assert_eq!(mender.take(coded(number), |_| None), Ok(Mended::Needs(1)));
        assert_eq!(mender.take(coded(number), |_| None), Ok(Mended::Needs(1)), "the same again");
    }
    assert_eq!(mender.take(coded(*last), |_| None), Err(MendError::Dependent));
    assert_eq!((mender.repairs_kept(), mender.failed()), (0, 1));
    for &number in all_but_one {
        mender.take(coded(number), |_| None).unwrap();
    }
    let useful = (0..).find(|number| !is_useless(number)).unwrap();
    assert_eq!(mender.take(coded(useful), |_| None), Ok(Mended::Packages(vec![one])));
}

#[test]
fn an_encoder_that_is_kept_makes_the_same_symbols() {
    let packages = packages(1, &SOME);
    let block = block(&packages);
    let encoder = BlockEncoder::new(&block, &refs(&packages)).unwrap();
    let three = repair_symbols(&block, &refs(&packages), 7, 3).unwrap();
    assert_eq!([encoder.symbols(7, 1), encoder.symbols(8, 2)].concat(), three);
    assert_eq!((encoder.symbols(7, 0), encoder.block()), (vec![], &block));
    let long = self::packages(1, &[1_090; 64]);
    let encoder = BlockEncoder::new(&self::block(&long), &refs(&long)).unwrap();
    assert!((150_000..200_000).contains(&encoder.bytes()), "{}", encoder.bytes());
}

#[test]
fn a_block_that_what_is_stored_does_not_fit_is_dropped() {
    let packages = packages(1, &SOME);
    let block = block(&packages);
    let mut stored = stored(&packages, |index| index > 1);
    stored.insert(2, package(2, 900));
    let mut mender = Mender::default();
    let all = coded(&block, &packages, 0, block.symbols_of(1));
    assert_eq!(mender.take(all, |index| stored.get(&index)), Err(MendError::Layout));
    assert_eq!((mender.repairs_kept(), mender.failed()), (0, 1));
}

#[test]
fn a_right_check_makes_no_package_of_another_index_nor_of_nonsense() {
    let real = packages(7, &SOME);
    let renamed = Block { first: 1, ..block(&real) };
    let symbols = repair_symbols(&renamed, &refs(&real), 0, renamed.sources()).unwrap();
    let take = |block, symbols| Mender::default().take(Coded { block, first_symbol: 0, symbols }, |_| None);
    assert_eq!(take(renamed, symbols), Err(MendError::Another));
    // Zero symbols are symbols of zeros, of which this is the check.
    for (count, symbol_bytes) in [(1, 16), (74, 16), (4, 256)] {
        let bytes = vec![0; count * symbol_bytes];
        let block =
            Block::new(STREAM, 1, vec![count as u8], symbol_bytes as u16, crc32fast::hash(&bytes)).unwrap();
        assert!(matches!(take(block, bytes), Err(MendError::Package(_))));
    }
}

#[test]
fn a_layout_beyond_a_limit_is_none() {
    let new = |first, symbols: &[u8], bytes| Block::new(STREAM, first, symbols.to_vec(), bytes, 0);
    assert!(new(1, &[1], 16).is_some() && new(u32::MAX, &[1], 256).is_some());
    assert!(new(1, &[16; 64], 64).is_some() && new(u32::MAX - 63, &[1; 64], 16).is_some());
    assert_eq!(new(0, &[1], 16), None);
    assert_eq!(new(u32::MAX, &[1, 1], 16), None);
    assert_eq!(new(1, &[], 16), None);
    assert_eq!(new(1, &[1; 65], 16), None);
    assert_eq!(new(1, &[1, 0, 1], 16), None);
    assert_eq!(new(1, &[75], 16), None);
    assert_eq!(new(1, &[74; 14], 16), None);
    for bytes in [0, 8, 17, 272, u16::MAX] {
        assert_eq!(new(1, &[1], bytes), None, "{bytes}");
    }
}

#[test]
fn a_block_is_made_of_packages_in_a_row_and_no_others() {
    let packages = packages(1, &SOME);
    let refs = refs(&packages);
    assert!(Block::of(STREAM, 1, &refs).is_some());
    assert_eq!(Block::of(STREAM, 2, &refs), None);
    assert_eq!(Block::of(STREAM, 1, &[]), None);
    assert_eq!(Block::of(STREAM, 1, &[refs[0], refs[2]]), None);
    assert_eq!(Block::of(Stream { epoch: 1, ..STREAM }, 1, &refs), None);
    let long = package(9, 1_200);
    assert_eq!(Block::of(STREAM, 9, &[&long]), None);
    let block = block(&packages);
    assert_eq!(repair_symbols(&block, &refs[1..], 0, 1), None);
    assert_eq!(block.symbols_of(0) + block.symbols_of(9), 0);
    assert_eq!(block.symbols_lacking(&IntervalSet::new(1)), block.sources());
}

#[test]
fn small_packages_have_short_symbols_and_many_long_ones_longer_ones() {
    assert_eq!(block(&packages(1, &SOME)).symbol_bytes, 16);
    assert_eq!(block(&packages(1, &[60; 64])).symbol_bytes, 16);
    assert!(block(&packages(1, &[1_090; 64])).symbol_bytes > 64);
}

#[test]
fn of_a_hundred_thousand_records_no_more_is_kept_than_stated() {
    let mut mender = Mender::default();
    let mut next = noise(77);
    let mut most = 0;
    for _ in 0..100_000 {
        let mut v = || next.next().unwrap() as usize;
        // Few blocks with few checks, which come again and grow; and some that are like no others.
        let (symbols, symbol_bytes) = if v() % 50 > 0 {
            (vec![10; 64], 96)
        } else {
            ((0..1 + v() % PACKAGES_MAX).map(|_| 1 + (v() % 20) as u8).collect(), 16 * (1 + v() % 16))
        };
        let stream = Stream { origin: RobotId((v() % 3) as u16), epoch: 1 };
        let check = (v() % 4) as u32;
        let Some(block) = Block::new(stream, 1, symbols, symbol_bytes as u16, check) else { continue };
        let symbols = vec![v() as u8; block.symbol_bytes() * (1 + v() % (1_100 / block.symbol_bytes()))];
        let first_symbol = v() as u32 % SYMBOL_NUMBERS;
        let mended = mender.take(Coded { block, first_symbol, symbols }, |_| None);
        assert!(!matches!(mended, Ok(Mended::Packages(_))));
        most = most.max(mender.bytes());
        assert!(mender.bytes() <= 256 << 10 && mender.repairs_kept() <= 32);
    }
    assert!(most > 200 << 10 && mender.failed() > 0, "{most} bytes, {} failed", mender.failed());
    for origin in 0..3 {
        mender.forget(Stream { origin: RobotId(origin), epoch: 1 });
    }
    assert_eq!(mender.repairs_kept(), 0);
    assert!(mender.bytes() < 16 << 10);
}

/// The figures of `docs/coded-repair.md`. Run it as
/// `cargo test --release -p flockmap-sync --lib coded::tests::figures -- --ignored --nocapture`.
#[test]
#[ignore = "measures, and takes a minute"]
fn figures() {
    let micros = |work: &mut dyn FnMut()| {
        let start = std::time::Instant::now();
        let mut runs = 0;
        while start.elapsed().as_millis() < 100 {
            work();
            runs += 1;
        }
        start.elapsed().as_secs_f64() * 1e6 / f64::from(runs)
    };
    println!("K, lacking: symbols needed beyond, mean, 99 of 100, most");
    let mut noise_of_all = noise(5);
    let mut any = |below: usize| noise_of_all.next().unwrap() as usize % below;
    for (count, runs) in
        [(1, 20_000), (2, 20_000), (5, 20_000), (10, 20_000), (40, 10_000), (200, 3_000), (800, 1_000)]
    {
        let symbols = if count < 64 { vec![1; count] } else { vec![(count / 40) as u8; 40] };
        let block = Block::new(STREAM, 1, symbols, 16, 0).unwrap();
        let bytes: Vec<u8> = (0..16 * count).map(|_| any(256) as u8).collect();
        let encoder = BlockEncoder::of_sources(&block, &bytes);
        for lost in [1, count.div_ceil(10), count.div_ceil(2), count] {
            let mut beyond: Vec<usize> = (0..runs)
                .map(|_| {
                    let mut order: Vec<u16> = (0..count as u16).collect();
                    (0..lost).for_each(|at| order.swap(at, at + any(count - at)));
                    let (lacking, known) = order.split_at(lost);
                    let [lacking, known] = [lacking, known].map(|numbers| {
                        let mut numbers = numbers.to_vec();
                        numbers.sort_unstable();
                        numbers
                    });
                    let sources = Sources { bytes: bytes.clone(), known, lacking };
                    let from = any(SYMBOL_NUMBERS as usize) as u32;
                    let numbers: Vec<u32> = block::numbers(from, lost + 8).collect();
                    let symbols = encoder.symbols(from, lost + 8);
                    let solves = |more: &usize| {
                        let found = solve(&block, &sources, &numbers[..lost + more], &symbols);
                        found.is_some_and(|found| found == bytes)
                    };
                    (0..=8).find(solves).unwrap()
                })
                .collect();
            beyond.sort_unstable();
            let mean = beyond.iter().sum::<usize>() as f64 / runs as f64;
            println!("{count}, {lost}: {mean:.4}, {}, {}", beyond[runs * 99 / 100], beyond[runs - 1]);
        }
    }
    println!("packages, K, T, symbols: microseconds to the first symbol, of each further one, to mend");
    for (count, payload, lost) in [
        (4, 20, 1),
        (16, 200, 1),
        (16, 200, 4),
        (64, 100, 1),
        (64, 300, 2),
        (64, 300, 8),
        (64, 1_080, 4),
        (64, 1_080, 64),
        (18, 860, 18),
        (64, 20, 1),
    ] {
        let packages = packages(1, &vec![payload; count]);
        let block = block(&packages);
        let stored = stored(&packages, |index| index > lost);
        let needs = block.symbols_of(1) * lost as usize;
        let coded = coded(&block, &packages, 77, needs);
        let refs = refs(&packages);
        let make = micros(&mut || drop(repair_symbols(&block, &refs, 77, 1)));
        let encoder = BlockEncoder::new(&block, &refs).unwrap();
        let more = micros(&mut || drop(encoder.symbols(77, 100))) / 100.0;
        let mend = micros(&mut || {
            let mended = Mender::default().take(coded.clone(), |index| stored.get(&index));
            assert!(matches!(mended, Ok(Mended::Packages(mended)) if mended.len() == lost as usize));
        });
        println!(
            "{count} of {} B, {}, {}, {needs}: {make:.0}, {more:.2}, {mend:.0}",
            packages[0].bytes().len(),
            block.sources(),
            block.symbol_bytes
        );
    }
    println!("packages, lengths: bytes on the air for each of what is lacking, T, K");
    for (what, least, factor) in
        [("50 to 150", 50.0, 3.0f64), ("50 to 600", 50.0, 12.0), ("900 to 1,150", 900.0, 1.27)]
    {
        for count in [8, 16, 32, 64] {
            let (mut air, mut lacking, mut sizes, mut sources) = (0.0, 0.0, 0, 0);
            for seed in 0..100 {
                let lengths: Vec<usize> = noise(seed * 4_001 + count)
                    .skip(9)
                    .take(count as usize)
                    .map(|v| (least * factor.powf((v % 1_000) as f64 / 1_000.0)) as usize - 45)
                    .collect();
                let packages = packages(1_000, &lengths);
                let block = block(&packages);
                let header = DatagramHeader {
                    kind: Kind::Packages,
                    swarm: 1,
                    sender: Stream { origin: RobotId(1), epoch: 1 },
                    stamp: Stamp(1),
                };
                let room = PackagesWriter::new(header, 1_200).room_for_coded(&block);
                air += 1_200.0 / room as f64 * block.sources() as f64;
                lacking += packages.iter().map(|package| package.bytes().len() as f64).sum::<f64>();
                sizes += u32::from(block.symbol_bytes);
                sources += block.sources();
            }
            println!("{count} of {what}: {:.3}, {}, {}", air / lacking, sizes / 100, sources / 100);
        }
    }
}
