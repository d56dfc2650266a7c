//! Hostile peers fill every limit of a session, one at a time: it holds no more than
//! `SessionConfig::memory_max` states.

use flockmap_codec::{Batch, Codec, Encoder, PACKAGE_BYTES_MIN, Package};
use flockmap_grid::{Changes, Resolution, RobotId, Snapshot, Stamp, State, Stream, Voxel, VoxelBox};
use flockmap_sync::wire::{
    Datagram, DatagramError, DatagramHeader, Echo, Kind, OriginRange, PackagesWriter, Received, Request,
    SnapshotRequest,
};
use flockmap_sync::{Cast, Event, IntervalSet, Session, SessionConfig, SwarmKey, Verdict};
use peak_alloc::PeakAlloc;

/// Counts the bytes that are held, and the most that ever were.
#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

const OWN: Stream = Stream { origin: RobotId(500), epoch: 1 };
const SECOND: i64 = 1_000_000;

/// A session, its time, and what it held before it began.
struct Victim {
    session: Session,
    now: Stamp,
    encoder: Encoder,
    /// The driver takes no events.
    takes_no_events: bool,
    /// Bytes held before the limit in question is filled.
    base: usize,
}

fn config() -> SessionConfig {
    SessionConfig {
        store_bytes_max: 100_000,
        streams_max: 4,
        epochs_max: 64,
        peers_max: 4,
        in_flight_max: 64,
        transfers_max: 1,
        snapshot_bytes_max: 100_000,
        radio_bytes_per_s: None,
        // What goes out fills limits too.
        congestion_control: false,
        ..SessionConfig::default()
    }
}

fn peer(number: u16) -> Stream {
    Stream { origin: RobotId(1 + number), epoch: 1 }
}

fn stream(number: u32) -> Stream {
    Stream { origin: RobotId(1_000 + number as u16), epoch: 1 }
}

/// Every third index from `first`.
fn torn(first: u32, count: u32) -> IntervalSet {
    IntervalSet::from_intervals(1 << 20, (0..count).map(|n| (first + 3 * n, first + 3 * n)).collect())
}

impl Victim {
    /// As if a disk had said that packages 1 to `upto` of a stream are in the map.
    fn hold(&mut self, stream: Stream, upto: u32) {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let changes = Changes::from_voxels([(Voxel::new(1, 2, 3), State::Free)]);
        let state = Snapshot {
            region: VoxelBox::spanning(Voxel::new(1, 2, 3), Voxel::new(2, 3, 4)).unwrap(),
            parts: vec![(Stamp(1), changes)],
            sensors: Vec::new(),
        };
        let chunks =
            self.encoder.encode_snapshot(Codec::Raw, stream, upto, resolution, &state, 1_150).unwrap();
        for chunk in chunks {
            assert!(self.session.deliver_package(self.now, chunk));
        }
        while let Some(event) = self.session.poll_event() {
            if let Event::Received(chunk) = event {
                self.session.verdict(self.now, &chunk, Verdict::Merged);
            }
        }
        assert!(self.session.received(stream).unwrap().contains_range(1, upto));
    }

    fn new(config: SessionConfig) -> Self {
        let session = Session::new(OWN, config, 1).unwrap();
        Self { session, now: Stamp(SECOND), encoder: Encoder::new(), takes_no_events: false, base: 0 }
    }

    fn package(&mut self, stream: Stream, index: u32, bytes: usize) -> Package {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let batch = Batch { stream, start: Stamp(0), end: Stamp(1), resolution, sensor: [0; 3] };
        // Two bits for each voxel of the box.
        let far = Voxel::new((bytes.saturating_sub(50) * 4) as i32, 0, 0);
        let changes = Changes::from_voxels([(Voxel::new(0, 0, 0), State::Free), (far, State::Occupied)]);
        self.encoder.encode_whole(Codec::Raw, &batch, index, &changes).unwrap()
    }

    fn chunks(&mut self, stream: Stream, upto: u32, chunks: usize) -> Vec<Package> {
        let end = (chunks * 500) as i32;
        let changes = Changes::from_voxels((0..end).step_by(7).map(|x| (Voxel::new(x, 0, 0), State::Free)));
        let region = VoxelBox::spanning(Voxel::new(0, 0, 0), Voxel::new(end, 0, 0)).unwrap();
        let state = Snapshot { region, parts: vec![(Stamp(1), changes)], sensors: Vec::new() };
        let resolution = Resolution::from_metres(0.1).unwrap();
        let bytes_max = PACKAGE_BYTES_MIN;
        self.encoder.encode_snapshot(Codec::Raw, stream, upto, resolution, &state, bytes_max).unwrap()
    }

    fn take(&mut self, bytes: &[u8]) {
        self.now = self.now.plus_micros(10);
        // A refusal is as good: this is about what is held.
        let _ = self.session.handle_datagram(self.now, bytes);
        if !self.takes_no_events {
            self.answer();
        }
    }

    fn take_packages(&mut self, from: Stream, packages: impl IntoIterator<Item = Package>) {
        let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender: from, stamp: self.now };
        let mut writer = PackagesWriter::new(header, 1_200);
        for package in packages {
            if !writer.push(&package) {
                self.take(&std::mem::replace(&mut writer, PackagesWriter::new(header, 1_200)).finish());
                assert!(writer.push(&package));
            }
        }
        self.take(&writer.finish());
    }

    fn take_request(&mut self, from: Stream, request: &Request) {
        self.now = self.now.plus_micros(1_000);
        let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender: from, stamp: self.now };
        self.take(&request.emit(header, 1_200));
    }

    /// Takes all events and accepts all packages.
    fn answer(&mut self) {
        while let Some(event) = self.session.poll_event() {
            match event {
                Event::Received(package) => self.session.verdict(self.now, &package, Verdict::Merged),
                Event::SnapshotWanted { stream, upto, .. } => {
                    let chunks = self.chunks(stream, upto, 1);
                    self.session.provide_snapshot(self.now, stream, chunks);
                }
                _ => {}
            }
        }
    }

    /// What follows fills the limit; what the test itself took meanwhile counts no more.
    fn is_prepared(&mut self) {
        self.base = ALLOCATOR.current_usage();
        ALLOCATOR.reset_peak_usage();
    }

    fn transmit_all(&mut self) {
        while self.session.poll_transmit(self.now).is_some() {}
    }
}

/// Runs a case with a large limit. The most that it held must be within what is stated, and what filled the
/// limit must be at least `least` of the share that the large limit has in that (stated with it, less stated
/// with the small one), or the case is no case.
fn case(name: &str, large: SessionConfig, small: &SessionConfig, least: f64, fill: impl FnOnce(&mut Victim)) {
    let (stated, share) = (large.memory_max(), large.memory_max() - small.memory_max());
    let mut victim = Victim::new(large);
    // The encoder is not the session's.
    victim.package(OWN, 1, 1_000);
    let before = ALLOCATOR.current_usage();
    victim.is_prepared();
    fill(&mut victim);
    let peak = ALLOCATOR.peak_usage();
    let (measured, filled) = (peak - before, peak - victim.base);
    let percent = 100.0 * filled as f64 / share as f64;
    println!(
        "{name}: {measured} of {stated} bytes stated; {filled}, {percent:.0} %, of the {share} of this limit"
    );
    assert!(measured <= stated, "{name}: {measured} bytes held, {stated} stated");
    assert!(percent >= 100.0 * least, "{name}: the limit was not filled: {filled} bytes of {share}");
}

/// One test, since the counter is one for the whole process.
#[test]
fn hostile_peers_cannot_make_a_session_hold_more_than_is_stated() {
    let small = config();
    println!("by default {} bytes are stated", SessionConfig::default().memory_max());

    let large = SessionConfig { store_bytes_max: 8 << 20, ..config() };
    case("store of small packages", large, &small, 0.7, |victim| {
        for first in (1..60_000).step_by(20) {
            let packages: Vec<_> =
                (first..first + 20).map(|n| victim.package(stream(n % 4), n / 4 + 1, 0)).collect();
            victim.take_packages(peer(0), packages);
        }
        assert!(victim.session.store().dropped() > 0, "the store is full");
    });

    let large = SessionConfig { store_bytes_max: 8 << 20, ..config() };
    case("store of long packages", large, &small, 0.7, |victim| {
        for n in 1..9_000 {
            let package = victim.package(stream(n % 4), n / 4 + 1, 1_100);
            victim.take_packages(peer(0), [package]);
        }
        assert!(victim.session.store().dropped() > 0, "the store is full");
    });

    let large = SessionConfig { streams_max: 100, peers_max: 1, ..config() };
    case("torn streams", large, &SessionConfig { peers_max: 1, ..config() }, 0.2, |victim| {
        for n in 0..100 {
            for first in (0..1_200).step_by(20) {
                let packages: Vec<_> =
                    (first..first + 20).map(|k| victim.package(stream(n), 3 * k + 2, 0)).collect();
                victim.take_packages(peer(0), packages);
            }
        }
        assert!(victim.session.counters().too_fragmented > 0, "the lists are full");
        victim.transmit_all();
    });

    let large = SessionConfig { peers_max: 32, streams_max: 64, ..config() };
    let base = SessionConfig { streams_max: 64, peers_max: 1, ..config() };
    case("views of peers", large, &base, 0.3, |victim| {
        for n in 0..64 {
            victim.hold(stream(n), 100_000);
        }
        // The echoes put this robot down the line of those who answer, so that it keeps what stays missing.
        let echoes = |now: Stamp| {
            [2, 3, OWN.origin.0].map(|robot| Echo {
                robot: RobotId(robot),
                epoch_low: 1,
                stamp_low: now.0 as u32,
                age_micros: 0,
            })
        };
        for round in 0..3u32 {
            for n in 0..32 {
                for first in (0..64).step_by(2) {
                    let lists = (first..first + 2).map(|k| {
                        let received = torn(10 + 1_000 * round, 255);
                        Received {
                            in_part: None,
                            is_oldest_wanted: false,
                            stream: stream(k),
                            from: if round == 0 { 1 } else { 10 + 1_000 * round },
                            received,
                        }
                    });
                    let request = Request {
                        echoes: echoes(victim.now).to_vec(),
                        all_echoes: true,
                        received: lists.collect(),
                        snapshot_requests: vec![SnapshotRequest {
                            stream: stream(first),
                            since: 0,
                            from: 1,
                            undecodable: torn(1, 255),
                        }],
                        ..Request::default()
                    };
                    victim.take_request(peer(n), &request);
                }
            }
            victim.transmit_all();
            victim.now = victim.now.plus_micros(5 * SECOND);
        }
        assert_eq!(victim.session.peers().count(), 32);
    });

    let large = SessionConfig {
        in_flight_max: 20_000,
        peers_max: 2,
        store_bytes_max: 16 << 20,
        snapshot_bytes_min: None,
        ..config()
    };
    let base = SessionConfig { in_flight_max: 1, ..large.clone() };
    case("packages in flight", large, &base, 0.5, |victim| {
        for index in 1..=20_000 {
            let package = victim.package(OWN, index, 0);
            victim.session.publish(victim.now, package).unwrap();
        }
        victim.is_prepared();
        let echo = Echo { robot: OWN.origin, epoch_low: 1, stamp_low: victim.now.0 as u32, age_micros: 0 };
        let request = Request {
            origins: Some(OriginRange::all_from(RobotId(0))),
            all_echoes: true,
            echoes: vec![echo],
            ..Request::default()
        };
        for n in 0..2 {
            victim.take_request(peer(n), &request);
        }
        victim.transmit_all();
        let in_flight: usize = victim.session.peers().map(|peer| peer.in_flight).sum();
        assert!(in_flight > 30_000, "{in_flight}");
    });

    // What everyone hears is noted for all who hear it, with holes wherever it has some.
    let large = SessionConfig { in_flight_max: 2_000, cast: Cast::Broadcast, ..config() };
    let base = SessionConfig { in_flight_max: 1, ..large.clone() };
    case("packages in flight, by broadcast", large, &base, 0.4, |victim| {
        let echoes = [OWN, peer(3)].map(|robot| Echo {
            robot: robot.origin,
            epoch_low: 1,
            stamp_low: 0,
            age_micros: 0,
        });
        for k in 0..4 {
            victim.hold(stream(k), 1);
        }
        for n in [0, 1, 2, 3, 0, 1, 2, 3] {
            let received = (0..4).map(|k| Received {
                in_part: None,
                is_oldest_wanted: false,
                stream: stream(k),
                from: 1,
                received: torn(1, 1),
            });
            let request = Request {
                echoes: echoes.to_vec(),
                all_echoes: true,
                origins: Some(OriginRange::all_from(RobotId(0))),
                received: received.collect(),
                ..Request::default()
            };
            victim.take_request(peer(n), &request);
        }
        victim.is_prepared();
        for k in 0..4 {
            for first in (0..4_400).step_by(20) {
                let packages: Vec<_> =
                    (first..first + 20).map(|n| victim.package(stream(k), 3 * n + 5, 0)).collect();
                victim.take_packages(peer(3), packages);
            }
        }
        let most = victim.session.peers().map(|peer| peer.in_flight).max().unwrap();
        assert_eq!(most, 4_000);
    });

    let swarm_key = Some(SwarmKey::from_bytes([7; 32]));
    let large = SessionConfig { swarm_key, salt: [8; 16], peers_max: 64, ..config() };
    let base = SessionConfig { swarm_key: None, ..large };
    case("counters of all robots that there can be", large.clone(), &base, 0.5, |victim| {
        for id in (0..=u16::MAX).filter(|id| *id != OWN.origin.0) {
            let own = Stream { origin: RobotId(id), epoch: 1 };
            let mut sender = Session::new(own, large.clone(), 1).unwrap();
            let bytes = sender.poll_transmit(victim.now).unwrap().bytes;
            drop(sender);
            victim.take(&bytes);
        }
        assert_eq!(victim.session.peers().count(), 64);
        assert!(victim.session.counters().too_many_peers > 65_000);
    });

    let large = SessionConfig { transfers_max: 4, ..config() };
    // The rest of its share is for chunks that wait, of which torn transfers have none.
    case("torn transfers", large, &small, 0.03, |victim| {
        let chunks = victim.chunks(stream(1), 1_000_000, 3_000);
        assert!(chunks.len() > 2_100, "{} chunks", chunks.len());
        victim.is_prepared();
        for source in 0..4 {
            for chunk in chunks.iter().step_by(2).take(1_060) {
                victim.take_packages(peer(source), [chunk.clone()]);
            }
        }
    });

    // A fixed limit: 4,096 events. All else is as small as can be.
    let large = SessionConfig { peers_max: 1, streams_max: 1, in_flight_max: 1, ..config() };
    let base = SessionConfig { store_bytes_max: 0, ..large.clone() };
    case("events that nobody takes", large, &base, 1.0, |victim| {
        victim.takes_no_events = true;
        for n in 1..5_000 {
            let package = victim.package(stream(0), n, 1_150);
            victim.take_packages(peer(0), [package]);
        }
        assert!(victim.session.counters().events_overflowed > 0);
    });

    let large = SessionConfig { peers_max: 64, streams_max: 1, in_flight_max: 1, ..config() };
    let base = SessionConfig { peers_max: 1, ..large.clone() };
    case("requests full of small records", large, &base, 0.03, |victim| {
        for n in 0..64 {
            // What takes the most memory for its bytes: empty lists of held indices, of five bytes each.
            let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender: peer(n), stamp: victim.now };
            let mut bytes = Request::default().emit(header, 1_200);
            while bytes.len() + 5 <= 1_200 {
                bytes.extend([2, 3, (bytes.len() % 120) as u8, 1, 1]);
            }
            if let Err(DatagramError::Check { expected, .. }) = Datagram::new_checked(&bytes) {
                bytes[24..28].copy_from_slice(&expected.to_le_bytes());
            }
            victim.take(&bytes);
        }
        assert_eq!(victim.session.counters().requests_in.datagrams, 64);
    });
}
