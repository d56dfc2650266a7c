use super::datagram::{CHECK, put_record, record_len, seal};
use super::*;
use crate::{IntervalSet, SwarmKey};
use flockmap_codec::{Batch, Codec, Encoder, Package};
use flockmap_grid::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
use proptest::prelude::*;

const HEADER: DatagramHeader = DatagramHeader {
    kind: Kind::Request,
    swarm: 0x0102,
    sender: Stream { origin: RobotId(7), epoch: 3 },
    stamp: Stamp(0x0011_2233_4455_6677),
};

/// All origins.
const ALL: Option<OriginRange> = Some(OriginRange::all_from(RobotId(0)));

fn set(intervals: &[(u32, u32)]) -> IntervalSet {
    IntervalSet::from_intervals(1_000, intervals.to_vec())
}

fn sample() -> Request {
    let stream = Stream { origin: RobotId(7), epoch: 3 };
    let other = Stream { origin: RobotId(300), epoch: 1_700_000_000 };
    Request {
        origins: ALL,
        all_echoes: true,
        no_new_streams: false,
        is_short: false,
        next_within_ms: 0,
        echoes: vec![Echo {
            robot: RobotId(300),
            epoch_low: 0xabcd,
            stamp_low: 0x1234_5678,
            age_micros: 1_000,
        }],
        newest_runs: Vec::new(),
        hears: Vec::new(),
        received_newest: Vec::new(),
        heard: Vec::new(),
        received: vec![
            Received { in_part: None, is_oldest_wanted: false, stream, from: 1, received: set(&[(1, 200)]) },
            Received {
                in_part: None,
                is_oldest_wanted: false,
                stream: other,
                from: 5,
                received: set(&[(5, 9), (12, 12), (300, 500)]),
            },
        ],
        transfers: vec![TransferProgress {
            source: RobotId(7),
            stream: other,
            since: 200,
            upto: 1_000,
            snapshot_id: 0xdead_beef,
            chunks: 40,
            from: 1,
            accepted: set(&[(1, 3), (8, 8)]),
        }],
        clocks: vec![ClockReport { robot: RobotId(9), epoch_low: 1, offset_micros: -1_500 }],
        snapshot_requests: vec![SnapshotRequest {
            stream: other,
            since: 300,
            from: 1,
            undecodable: set(&[(777, 777), (780, 900)]),
        }],
    }
}

/// With streams in part.
fn sample_in_part() -> Request {
    let rest = Some(RestRequest { holder: RobotId(300), upto: 1_000, since: 700 });
    let in_part = [InPart { wants_independent: false, rest: None }, InPart { wants_independent: true, rest }];
    let mut request = sample();
    for (received, in_part) in request.received.iter_mut().zip(in_part) {
        (received.in_part, received.is_oldest_wanted) = (Some(in_part), in_part.wants_independent);
    }
    request
}

fn package(index: u32) -> Package {
    let stream = Stream { origin: RobotId(7), epoch: 3 };
    let resolution = Resolution::from_metres(0.1).unwrap();
    let batch = Batch { stream, start: Stamp(1_000), end: Stamp(2_000), resolution, sensor: [0; 3] };
    let changes =
        Changes::from_voxels([(Voxel::new(1, 2, 3), State::Free), (Voxel::new(1, 2, 4), State::Occupied)]);
    Encoder::new().encode_whole(Codec::Raw, &batch, index, &changes).unwrap()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Writes the right check into bytes that were changed on purpose.
fn resealed(bytes: Vec<u8>) -> Vec<u8> {
    seal(bytes)
}

#[test]
fn a_change_of_the_layout_is_a_change_of_the_version() {
    // If this fails: raise WIRE_VERSION, describe the new layout in LAYOUT and WIRE.md, and put the new pair
    // here.
    assert_eq!((WIRE_VERSION, crc32fast::hash(LAYOUT.as_bytes())), (7, GOLDEN_LAYOUT));
}

#[test]
fn golden_datagrams() {
    // If one of these fails, robots of the old and the new build no longer understand each other: raise the
    // version.
    assert_eq!(hex(&sample().emit(HEADER, DATAGRAM_BYTES_MAX)), GOLDEN_REQUEST);
    let in_part = hex(&sample_in_part().emit(HEADER, DATAGRAM_BYTES_MAX));
    assert!(GOLDEN_LACKS.iter().all(|golden| in_part.contains(golden)), "{in_part}");
    let mut writer = PackagesWriter::new(HEADER, DATAGRAM_BYTES_MAX);
    let package = package(5);
    assert!(writer.push(&package));
    let bytes = hex(&writer.finish());
    // What is inside a package is the matter of the codec's own golden files.
    let (head, tail) = bytes.split_at(2 * (HEADER_BYTES + 2));
    let check = 2 * CHECK.start..2 * CHECK.end;
    // It is of the sender's own run: without origin and epoch, a byte each.
    let [front, back] = package.without_stream();
    assert_eq!(tail, hex(&[front, back].concat()));
    assert_eq!(head[..check.start], GOLDEN_PACKAGES_HEADER[..check.start]);
    assert_eq!(head[check.end..], format!("11{:02x}", package.bytes().len() - 2));
}

#[test]
fn golden_sealed_datagram() {
    // Made by another implementation (Python's `cryptography`), as docs/key.md shows.
    let key = SwarmKey::from_bytes(core::array::from_fn(|i| i as u8));
    let plain = sample().emit(HEADER, DATAGRAM_BYTES_MAX);
    let sealed = seal_datagram(&key, &SALT, &plain, None, 0x0a0b_0c0d_0e0f).unwrap();
    assert_eq!(hex(&sealed), GOLDEN_SEALED);
    assert_eq!(sealed.len(), plain.len() + seal_bytes(Kind::Request));

    let datagram = SealedDatagram::new_checked(&sealed).unwrap();
    assert_eq!((datagram.swarm(), datagram.sender()), (HEADER.swarm, HEADER.sender));
    assert_eq!(datagram.counter(), 0x0a0b_0c0d_0e0f);
    assert!(is_sealed(&sealed) && !is_sealed(&plain));
    let opened = datagram.open(&key, &SALT, RobotId(9)).unwrap();
    let datagram = opened.datagram().unwrap();
    assert_eq!(*datagram.header(), HEADER);
    assert_eq!(Request::parse(&datagram, 1_000).unwrap(), sample());
}

#[test]
fn the_longest_package_fits_into_a_sealed_datagram() {
    let record = record_len(flockmap_codec::PACKAGE_BYTES_MAX);
    assert_eq!(HEADER_BYTES + record + SEAL_BYTES, 1_199);
    let mut plain = PackagesWriter::new(HEADER, DATAGRAM_BYTES_MAX - SEAL_BYTES).finish();
    put_record(&mut plain, 16, &[0xa5; flockmap_codec::PACKAGE_BYTES_MAX]);
    let key = SwarmKey::from_bytes([7; 32]);
    let sealed = seal_datagram(&key, &SALT, &plain, Some(RobotId(2)), COUNTER_MAX).unwrap();
    assert_eq!(sealed.len(), 1_199);
    assert_eq!(seal_datagram(&key, &SALT, &plain, None, COUNTER_MAX + 1), None);
}

#[test]
fn what_cannot_be_a_sealed_datagram_is_refused() {
    let key = SwarmKey::from_bytes([7; 32]);
    let sealed = seal_datagram(&key, &SALT, &sample().emit(HEADER, DATAGRAM_BYTES_MAX), None, 5).unwrap();
    for length in 0..sealed.len() {
        let opened = SealedDatagram::new_checked(&sealed[..length])
            .and_then(|datagram| datagram.open(&key, &SALT, RobotId(9)));
        assert!(opened.is_err(), "cut to {length} bytes");
    }
    let long = [&sealed[..], &[0; DATAGRAM_BYTES_MAX]].concat();
    assert!(matches!(SealedDatagram::new_checked(&long), Err(DatagramError::Length { .. })));
    let mut other = sealed;
    other[2] = WIRE_VERSION + 1;
    assert!(matches!(SealedDatagram::new_checked(&other), Err(DatagramError::Version { .. })));
    // A holder of the key that seals nonsense is faulty, and no more.
    for kind in [0, 4, 63] {
        let mut plain = PackagesWriter::new(HEADER, DATAGRAM_BYTES_MAX).finish();
        plain[3] = kind;
        assert_eq!(seal_datagram(&key, &SALT, &plain, None, 6), None);
        other[2] = WIRE_VERSION;
        other[3] = kind | 0x80;
        assert_eq!(
            SealedDatagram::new_checked(&other).unwrap_err(),
            DatagramError::Kind { got: kind | 0x80 }
        );
    }
}

const SALT: Salt =
    [0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88, 0x99, 0xaa, 0xbb, 0xcc, 0xdd, 0xee, 0xff, 0];
const GOLDEN_SEALED: &str = "464d07810201070003000000000000000f0e0d0c0b0a112233445566778899aabbccddeeff000ec28fc9b9ab92a615795081\
    926e9ce493eed5c508da0ece75dc42ab53eed86ca4c2fd79c94a719fd3e6daa48ee2ade3ebad2889d11d3be007e588ade370\
    17ceba238429c00021cdf884636d611fe015c3a6073f8ef96054ae76d819bad348630bc6140fe09b1c27d85e24dab9554d";
const GOLDEN_LAYOUT: u32 = 2_847_443_524;
const GOLDEN_REQUEST: &str = "464d07010201070003000000000000007766554433221100547a5d5f03010a2c01cdab78563412e8070505090100b717060f\
    ac0280e2cfaa06ac02018806000178020607030100c7010210ac0280e2cfaa0605000401009e02c801031607ac0280e2cfaa\
    06c801e807efbeadde280100020300";
/// Of records 8: one whole, and of the other one flags, holder, upto and since.
const GOLDEN_LACKS: [&str; 2] = ["0807070300", "0fac02e807bc05"];
const GOLDEN_PACKAGES_HEADER: &str = "464d07020201070003000000000000007766554433221100";

#[test]
fn a_request_survives_the_wire() {
    for sample in [sample(), sample_in_part()] {
        let bytes = sample.emit(HEADER, DATAGRAM_BYTES_MAX);
        let datagram = Datagram::new_checked(&bytes).unwrap();
        assert_eq!(*datagram.header(), HEADER);
        assert_eq!(Request::parse(&datagram, 1_000).unwrap(), sample);
    }
}

#[test]
fn packages_survive_the_wire_and_small_ones_share_a_datagram() {
    let mut writer = PackagesWriter::new(HEADER, DATAGRAM_BYTES_MAX);
    let packages: Vec<Package> = (1..).map(package).take_while(|package| writer.push(package)).collect();
    assert!(packages.len() > 10);
    let bytes = writer.finish();
    assert!(bytes.len() <= DATAGRAM_BYTES_MAX);
    let datagram = Datagram::new_checked(&bytes).unwrap();
    assert_eq!(datagram.header().kind, Kind::Packages);
    assert_eq!(parse_packages(&datagram).unwrap(), packages);
}

#[test]
fn records_of_unknown_types_are_skipped() {
    let mut bytes = sample().emit(HEADER, DATAGRAM_BYTES_MAX);
    put_record(&mut bytes, 99, b"from a later version");
    let bytes = resealed(bytes);
    let datagram = Datagram::new_checked(&bytes).unwrap();
    assert_eq!(Request::parse(&datagram, 1_000).unwrap(), sample());
}

#[test]
fn a_request_that_does_not_fit_says_so_and_keeps_the_newest() {
    let torn: Vec<(u32, u32)> = (0..800).map(|i| (10_000 + 3 * i, 10_000 + 3 * i)).collect();
    let stream = |origin| Stream { origin: RobotId(origin), epoch: 1 };
    let request = Request {
        origins: ALL,
        all_echoes: true,
        echoes: (0..100)
            .map(|i| Echo { robot: RobotId(i), epoch_low: 1, stamp_low: 2, age_micros: 3 })
            .collect(),
        received: (0..4)
            .map(|origin| Received {
                in_part: None,
                is_oldest_wanted: false,
                stream: stream(origin),
                from: 1,
                received: set(&torn),
            })
            .collect(),
        ..Request::default()
    };
    for bytes_max in [200, 300, 700, 1_199, 1_200] {
        let (bytes, origins) = request.emit_in_order(HEADER, bytes_max, 0);
        assert!(bytes.len() <= bytes_max, "{} of {bytes_max} bytes", bytes.len());
        let read = Request::parse(&Datagram::new_checked(&bytes).unwrap(), 1_000).unwrap();
        assert!(
            read.origins == origins && origins.is_none_or(|origins| !origins.is_all()) && !read.all_echoes
        );
        let first = &read.received[0];
        assert_eq!(first.received.last(), Some(10_000 + 3 * 799));
        assert!(first.from > 1 && first.received == set(&torn).within(first.from, u32::MAX));
    }
    let whole = Request {
        received: vec![Received {
            in_part: None,
            is_oldest_wanted: false,
            stream: stream(1),
            from: 1,
            received: set(&torn[..300]),
        }],
        ..request
    };
    let bytes = whole.emit(HEADER, 1_200);
    let read = Request::parse(&Datagram::new_checked(&bytes).unwrap(), 1_000).unwrap();
    assert!(read.origins == ALL && !read.all_echoes);
    assert_eq!(read.received, whole.received);
}

#[test]
fn a_transfer_is_named_however_long_the_lists_of_held_indices_are() {
    let torn: Vec<(u32, u32)> = (0..800).map(|i| (10_000 + 3 * i, 10_000 + 3 * i)).collect();
    let stream = |origin| Stream { origin: RobotId(origin), epoch: 1 };
    let transfer = TransferProgress {
        source: RobotId(9),
        stream: stream(1),
        since: 9_000,
        upto: 12_000,
        snapshot_id: 5,
        chunks: 900,
        from: 1,
        accepted: set(&[(1, 3), (7, 7)]),
    };
    let request = Request {
        received: (0..4)
            .map(|origin| Received {
                in_part: None,
                is_oldest_wanted: false,
                stream: stream(origin),
                from: 1,
                received: set(&torn),
            })
            .collect(),
        transfers: vec![transfer],
        ..Request::default()
    };
    for bytes_max in [200, 265, 1_200] {
        let bytes = request.emit(HEADER, bytes_max);
        assert!(bytes.len() <= bytes_max, "{} of {bytes_max} bytes", bytes.len());
        let read = Request::parse(&Datagram::new_checked(&bytes).unwrap(), 1_000).unwrap();
        assert_eq!(read.transfers, request.transfers);
        assert_eq!(read.received[0].received.last(), Some(10_000 + 3 * 799));
    }
}

#[test]
fn long_lists_keep_their_newest_intervals_when_read() {
    let torn: Vec<(u32, u32)> = (0..100).map(|i| (3 * i + 1, 3 * i + 1)).collect();
    let stream = Stream { origin: RobotId(1), epoch: 1 };
    let received =
        vec![Received { in_part: None, is_oldest_wanted: false, stream, from: 1, received: set(&torn) }];
    let bytes = Request { received, ..Request::default() }.emit(HEADER, 1_200);
    let read = Request::parse(&Datagram::new_checked(&bytes).unwrap(), 10).unwrap();
    assert_eq!(read.received[0].received, set(&torn[90..]));
    assert_eq!(read.received[0].from, torn[89].1 + 1);
}

#[test]
fn a_list_that_is_cut_keeps_to_its_room_and_is_cut_the_same_again() {
    // Gaps of 127 or 128 below an interval, which take one byte or two.
    for gap in [129, 130] {
        let intervals: Vec<(u32, u32)> =
            (0..200).map(|i| (0x1000_0000 + gap * i, 0x1000_0000 + gap * i)).collect();
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        let received = vec![Received {
            in_part: None,
            is_oldest_wanted: false,
            stream,
            from: 1,
            received: set(&intervals),
        }];
        let request = Request { received, ..Request::default() };
        for bytes_max in 300..500 {
            let bytes = request.emit(HEADER, bytes_max);
            assert!(bytes.len() <= bytes_max, "{} of {bytes_max} bytes", bytes.len());
            let read = Request::parse(&Datagram::new_checked(&bytes).unwrap(), 1_000).unwrap();
            assert!(!read.received[0].received.is_empty());
            assert_eq!(read.emit(HEADER, bytes_max), bytes, "gaps of {gap}, {bytes_max} bytes");
        }
    }
}

#[test]
fn an_echoed_stamp_is_completed_from_the_own_clock() {
    for (sent, now) in [(0i64, 5), (-3, 4), (u32::MAX.into(), 1 << 32), (1 << 50, (1 << 50) + 4_000_000_000)]
    {
        let echo = Echo { robot: RobotId(1), epoch_low: 1, stamp_low: sent as u32, age_micros: 0 };
        assert_eq!(echo.stamp(Stamp(now)), Stamp(sent));
    }
}

#[test]
fn every_truncation_and_every_flipped_bit_is_an_error() {
    let mut writer = PackagesWriter::new(HEADER, DATAGRAM_BYTES_MAX);
    assert!(writer.push(&package(1)));
    for bytes in [sample().emit(HEADER, DATAGRAM_BYTES_MAX), writer.finish()] {
        for length in 0..bytes.len() {
            assert!(Datagram::new_checked(&bytes[..length]).is_err());
        }
        for bit in 0..bytes.len() * 8 {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(Datagram::new_checked(&flipped).is_err(), "bit {bit}");
        }
    }
    assert!(Datagram::new_checked(&[0; 1_201]).is_err());
}

proptest! {
    #[test]
    fn any_request_survives_the_wire(
        intervals in prop::collection::vec((1..5_000u32, 0..50u32), 0..40),
        from in 1..50u32, origin: u16, epoch: u64, count: u32, stamp: i64, age_micros: u32, offset_micros: i64,
    ) {
        let all = IntervalSet::from_intervals(1_000, intervals.into_iter().map(|(l, n)| (l, l + n)).collect());
        let received = all.within(from, u32::MAX);
        let stream = Stream { origin: RobotId(origin), epoch };
        let request = Request {
            origins: ALL,
            echoes: vec![Echo { robot: RobotId(origin), epoch_low: epoch as u16, stamp_low: stamp as u32, age_micros }],
            received: vec![Received { in_part: None, is_oldest_wanted: origin % 2 == 0, stream, from, received: received.clone() }],
            transfers: vec![TransferProgress { source: stream.origin, stream, since: count, upto: count, snapshot_id: count, chunks: count, from, accepted: received }],
            clocks: vec![ClockReport { robot: stream.origin, epoch_low: 5, offset_micros }],
            snapshot_requests: vec![SnapshotRequest { stream, since: count / 2, from: 1, undecodable: set(&[(count / 2 + 1, count / 2 + 1)]) }],
            ..Request::default()
        };
        let bytes = request.emit(DatagramHeader { stamp: Stamp(stamp), ..HEADER }, 1_200);
        let datagram = Datagram::new_checked(&bytes).unwrap();
        prop_assert_eq!(datagram.header().stamp, Stamp(stamp));
        prop_assert_eq!(Request::parse(&datagram, 1_000).unwrap(), request);
    }

    /// Behind the check, so that the readers of the records see the damage.
    #[test]
    fn damaged_records_never_panic(
        changes in prop::collection::vec((0..200usize, any::<u8>()), 1..8), cut in 0..200usize, packages: bool,
    ) {
        let mut bytes = if packages {
            let mut writer = PackagesWriter::new(HEADER, DATAGRAM_BYTES_MAX);
            writer.push(&package(1));
            writer.push(&package(2));
            writer.finish()
        } else {
            sample().emit(HEADER, DATAGRAM_BYTES_MAX)
        };
        bytes.truncate(bytes.len().saturating_sub(cut).max(HEADER_BYTES));
        for (at, value) in changes {
            let length = bytes.len();
            bytes[(HEADER_BYTES + at).min(length - 1)] = value;
        }
        let bytes = resealed(bytes);
        if let Ok(datagram) = Datagram::new_checked(&bytes) {
            if let Ok(request) = Request::parse(&datagram, 64) {
                for received in &request.received {
                    prop_assert!(received.received.intervals().len() <= 64);
                    prop_assert!(received.received.first().is_none_or(|first| first >= received.from));
                }
            }
            let _ = parse_packages(&datagram);
        }
    }

    #[test]
    fn random_bytes_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..1_300)) {
        prop_assert!(Datagram::new_checked(&bytes).is_err());
    }
}

/// A request of a crowd, newest runs by digests, and what of it comes back.
fn crowd(robots: u16, bytes_max: usize) -> (Request, Request, Vec<u8>) {
    let run =
        |origin| Stream { origin: RobotId(origin), epoch: 7_709_466_304_177_273_941 + u64::from(origin) };
    let list = |origin| Received {
        stream: run(origin),
        is_oldest_wanted: origin == 5,
        in_part: (origin == 6).then_some(InPart { wants_independent: true, rest: None }),
        from: 1,
        received: match origin % 10 {
            8 => set(&[]),
            9 => set(&[(1, 7), (9, 40), (42, 42)]),
            _ => set(&[(1, 40)]),
        },
    };
    let request = Request {
        origins: ALL,
        all_echoes: true,
        received: (1..=robots).map(list).collect(),
        // Robot 4 is known in a later run than that of which packages are held.
        newest_runs: (1..=robots).filter(|origin| *origin != 4).map(run).collect(),
        hears: (1..=robots).filter(|origin| origin % 20 != 3).map(run).collect(),
        ..Request::default()
    };
    let (bytes, _) = request.emit_in_order(HEADER, bytes_max, 0);
    let datagram = Datagram::new_checked(&bytes).unwrap();
    let parsed = Request::parse(&datagram, 64).unwrap();
    (request, parsed, bytes)
}

/// Who knows the same newest runs as the sender.
fn knows_all(request: &Request) -> impl Fn(RobotId) -> Option<Stream> {
    let runs: Vec<Stream> = request.received.iter().map(|received| received.stream).collect();
    move |robot| runs.iter().find(|run| run.origin == robot).copied()
}

fn by_origin(mut received: Vec<Received>) -> Vec<Received> {
    received.sort_by_key(|received| received.stream.origin);
    received
}

#[test]
fn newest_runs_named_by_digests_are_found_by_who_knows_them_and_cost_a_quarter() {
    let (request, mut parsed, bytes) = crowd(50, DATAGRAM_BYTES_MAX);
    let in_full = Request { newest_runs: Vec::new(), ..request.clone() }.emit(HEADER, DATAGRAM_BYTES_MAX);
    println!("lists of 50 runs: {} bytes, {} in full", bytes.len(), in_full.len());
    assert!(bytes.len() * 4 < in_full.len() + 4 * 60, "{} of {}", bytes.len(), in_full.len());
    parsed.find_runs(knows_all(&request), |_| None, 64);
    assert_eq!(by_origin(parsed.received.clone()), request.received);
    assert_eq!((parsed.origins, parsed.all_echoes, &parsed.hears), (ALL, true, &request.hears));
    assert!(parsed.received_newest.is_empty() && parsed.heard.is_empty());
}

#[test]
fn who_knows_another_run_of_one_robot_learns_nothing_of_those_beside_it() {
    let (request, parsed, _) = crowd(100, DATAGRAM_BYTES_MAX);
    let known = knows_all(&request);
    for (other, epoch) in [(10, Some(1)), (10, None), (77, Some(u64::MAX)), (77, None)] {
        let mut parsed = parsed.clone();
        let newest = |robot: RobotId| {
            let stream = known(robot)?;
            if robot.0 == other { epoch.map(|epoch| Stream { epoch, ..stream }) } else { Some(stream) }
        };
        parsed.find_runs(newest, |_| None, 64);
        assert_eq!((parsed.origins, parsed.all_echoes), (None, false));
        let of = |robots: &[Stream]| robots.iter().filter(|run| request.hears.contains(run)).count();
        assert_eq!(of(&parsed.hears), parsed.hears.len(), "nobody who is not heard");
        assert!((60..70).contains(&parsed.hears.len()), "{} of 95", parsed.hears.len());
        for received in &parsed.received {
            assert!(request.received.contains(received) && received.stream.origin.0 != other);
        }
        assert!((60..75).contains(&parsed.received.len()), "{} of 100", parsed.received.len());
    }
}

#[test]
fn a_request_by_digests_keeps_to_its_room_and_says_which_origins_it_covers() {
    for bytes_max in 200..500 {
        let (request, mut parsed, bytes) = crowd(120, bytes_max);
        assert!(bytes.len() <= bytes_max);
        parsed.find_runs(knows_all(&request), |_| None, 64);
        for list in &request.received {
            assert_eq!(
                parsed.received.iter().filter(|read| *read == list).count(),
                usize::from(parsed.covers(list.stream.origin)),
                "{list:?} of {bytes_max} bytes"
            );
        }
    }
}

#[test]
fn a_request_of_the_shortest_lists_holds_no_more_than_is_stated() {
    let received: Vec<Received> = (0..250)
        .map(|origin| {
            let stream = Stream { origin: RobotId(origin), epoch: 1 << 40 };
            Received { stream, is_oldest_wanted: false, in_part: None, from: 1, received: set(&[(1, 1)]) }
        })
        .collect();
    let newest_runs = received.iter().map(|received| received.stream).collect();
    let request = Request { newest_runs, received, ..Request::default() };
    let bytes = request.emit(HEADER, DATAGRAM_BYTES_MAX);
    let mut parsed = Request::parse(&Datagram::new_checked(&bytes).unwrap(), 64).unwrap();
    parsed.find_runs(|origin| Some(Stream { origin, epoch: 1 << 40 }), |_| None, 64);
    assert_eq!(parsed.received.len(), 250, "two bytes each: {}", bytes.len());
    // While they get their runs, the lists of a record are there twice; each interval is an allocation of 32 bytes at most.
    let held = (parsed.received.capacity() + 32) * size_of::<Received>() + 250 * 32;
    assert!(held <= 80 * bytes.len(), "{held} bytes for {}", bytes.len());
}

#[test]
fn who_is_named_again_as_heard_is_left_out() {
    let runs: Vec<Stream> = (1..=32).map(|id| Stream { origin: RobotId(id), epoch: 1 << 40 }).collect();
    let once = Request { all_echoes: true, hears: runs.clone(), ..Request::default() };
    let mut bytes = once.emit(HEADER, DATAGRAM_BYTES_MAX);
    let record = bytes[HEADER_BYTES + 1..].to_vec();
    for _ in 0..100 {
        bytes.extend(&record);
    }
    let bytes = seal(bytes);
    let mut read = Request::parse(&Datagram::new_checked(&bytes).unwrap(), 64).unwrap();
    read.find_runs(|robot| runs.iter().find(|run| run.origin == robot).copied(), |_| None, 64);
    assert_eq!((read.hears, read.all_echoes), (runs, false));
}

proptest! {
    #[test]
    fn lists_of_newest_runs_come_back(
        lists in prop::collection::btree_map(any::<u16>(), (any::<u64>(), prop::collection::vec((1u32.., 0u32..9), 0..20)), 1..120),
        first in any::<u16>(),
    ) {
        let received = lists.iter().map(|(&origin, (epoch, intervals))| {
            let intervals = intervals.iter().map(|&(low, more)| (low, low.saturating_add(more)));
            Received {
                stream: Stream { origin: RobotId(origin), epoch: *epoch },
                is_oldest_wanted: false,
                in_part: None,
                from: 1,
                received: IntervalSet::from_intervals(1_000, intervals.collect()),
            }
        });
        let mut received: Vec<Received> = received.collect();
        let mut newest_runs: Vec<Stream> = received.iter().map(|received| received.stream).collect();
        let hears = newest_runs.clone();
        newest_runs.retain(|run| run.epoch % 7 != 0);
        received.sort_by_key(|received| received.stream.origin.0.wrapping_sub(first));
        let origins = Some(OriginRange::all_from(RobotId(first)));
        let request = Request { origins, all_echoes: true, received, newest_runs, hears, ..Request::default() };
        let (bytes, covered) = request.emit_in_order(HEADER, DATAGRAM_BYTES_MAX, 3);
        let mut read = Request::parse(&Datagram::new_checked(&bytes).unwrap(), 1_000).unwrap();
        read.find_runs(knows_all(&request), |_| None, 1_000);
        prop_assert!(read.hears.iter().eq(request.hears.iter().take(read.hears.len())));
        prop_assert_eq!(read.all_echoes, read.hears.len() == request.hears.len());
        for received in &request.received {
            let said = read.received.iter().find(|said| said.stream == received.stream);
            if covered.is_some_and(|covered| covered.contains(received.stream.origin)) {
                prop_assert!(said.is_some(), "{:?} was not named", received);
            }
            if let Some(said) = said {
                prop_assert_eq!(&said.received, &received.received.within(said.from, u32::MAX));
            }
        }
    }
}
