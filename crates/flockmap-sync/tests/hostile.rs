//! Datagrams made to hurt: no panic, and no memory beyond the stated limits.
#![allow(unsafe_code, reason = "a counting allocator cannot be had without")]

mod swarm;

use flockmap_codec::{Batch, Codec, Encoder, Package};
use flockmap_grid::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
use flockmap_sync::wire::{
    DatagramHeader, Echo, Kind, OriginRange, PackagesWriter, Received, Request, SnapshotRequest,
    TransferProgress, seal_datagram,
};
use flockmap_sync::{Cast, Event, IntervalSet, Session, SessionConfig, SwarmKey, Verdict};
use std::alloc::{GlobalAlloc, Layout, System};
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use swarm::{Radio, Random, SECOND, Swarm};

/// Counts the bytes in use.
struct Counting;

/// Of every sender.
const SALT: [u8; 16] = [3; 16];

static IN_USE: AtomicUsize = AtomicUsize::new(0);

// SAFETY: passes everything on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        IN_USE.fetch_add(layout.size(), Relaxed);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        IN_USE.fetch_sub(layout.size(), Relaxed);
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn package(random: &mut Random, stream: Stream, index: u32) -> Package {
    let batch = Batch {
        stream,
        start: Stamp(0),
        end: Stamp(1),
        resolution: Resolution::from_metres(0.1).unwrap(),
        sensor: [0; 3],
    };
    let voxel = Voxel::new(random.below(9) as i32, 0, 0);
    Encoder::new()
        .encode_whole(Codec::Raw, &batch, index, &Changes::from_voxels([(voxel, State::Free)]))
        .unwrap()
}

fn any_stream(random: &mut Random) -> Stream {
    Stream { origin: RobotId(random.below(1 << 16) as u16), epoch: random.next() as u32 as u64 }
}

fn any_index(random: &mut Random) -> u32 {
    match random.below(3) {
        0 => 1 + random.below(50) as u32,
        1 => u32::MAX - random.below(50) as u32,
        _ => (random.next() as u32).max(1),
    }
}

fn any_set(random: &mut Random) -> IntervalSet {
    let intervals = (0..random.below(120)).map(|_| {
        let low = any_index(random);
        let bits = random.below(31);
        (low, low.saturating_add(random.below(1 << bits) as u32))
    });
    IntervalSet::from_intervals(1_000, intervals.collect())
}

/// A datagram with a right check and wild content, much of it about the robot `own`.
fn wild(random: &mut Random, now: Stamp, senders: u64, own: RobotId) -> Vec<u8> {
    let sender = Stream { origin: RobotId(2 + random.below(senders) as u16), epoch: random.below(3) };
    let stamp = if random.happens(0.9) { now } else { Stamp(random.next() as i64) };
    let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender, stamp };
    if random.happens(0.5) {
        let mut writer = PackagesWriter::new(header, 1_200);
        for _ in 0..1 + random.below(30) {
            let stream = match random.below(8) {
                0 => Stream { origin: own, epoch: 1 },
                1..5 => sender,
                _ => any_stream(random),
            };
            let index = any_index(random);
            if !writer.push(&package(random, stream, index)) {
                break;
            }
        }
        return writer.finish();
    }
    let request = |random: &mut Random, stream| SnapshotRequest {
        stream,
        since: any_index(random),
        from: 1,
        undecodable: any_set(random),
    };
    let received = |random: &mut Random| {
        let stream = if random.happens(0.3) { Stream { origin: own, epoch: 1 } } else { any_stream(random) };
        Received {
            in_part: None,
            is_oldest_wanted: random.happens(0.2),
            stream,
            from: 1,
            received: any_set(random),
        }
    };
    let lists: Vec<Received> = (0..random.below(4)).map(|_| received(random)).collect();
    let newest_runs: BTreeSet<Stream> =
        lists.iter().map(|list| list.stream).filter(|_| random.happens(0.5)).collect();
    Request {
        origins: random.happens(0.5).then(|| OriginRange {
            first: RobotId(random.below(20) as u16),
            last: RobotId(random.next() as u16),
        }),
        all_echoes: random.happens(0.5),
        no_new_streams: random.happens(0.2),
        is_short: random.happens(0.2),
        next_within_ms: if random.happens(0.2) { random.next() as u32 } else { 0 },
        echoes: (0..random.below(4))
            .map(|i| Echo {
                robot: if i == 0 { own } else { RobotId(random.next() as u16) },
                epoch_low: 1,
                stamp_low: random.next() as u32,
                age_micros: random.next() as u32,
            })
            .collect(),
        newest_runs: newest_runs.into_iter().collect(),
        hears: (0..random.below(4)).map(|robot| Stream { origin: RobotId(robot as u16), epoch: 1 }).collect(),
        received: lists,
        transfers: (0..random.below(3))
            .map(|_| TransferProgress {
                source: own,
                stream: Stream { origin: own, epoch: 1 },
                since: any_index(random),
                upto: any_index(random),
                snapshot_id: random.next() as u32,
                chunks: any_index(random),
                from: any_index(random),
                accepted: any_set(random),
            })
            .collect(),
        clocks: Vec::new(),
        snapshot_requests: vec![
            request(random, Stream { origin: own, epoch: 1 }),
            request(random, Stream { origin: RobotId(2), epoch: 1 }),
        ],
        ..Request::default()
    }
    .emit(header, 1_200)
}

// One test, so that nothing else allocates while it counts.
#[test]
fn hostile_datagrams_neither_panic_nor_fill_the_memory() {
    // The third time there is a key, and a holder of it is wild.
    for (cast, swarm_key) in
        [(Cast::Unicast, None), (Cast::Broadcast, None), (Cast::Unicast, Some(SwarmKey::from_bytes([5; 32])))]
    {
        let config = SessionConfig {
            cast,
            swarm_key: swarm_key.clone(),
            salt: [8; 16],
            peers_max: 4,
            streams_max: 8,
            store_bytes_max: 200_000,
            in_flight_max: 256,
            snapshot_bytes_min: Some(1_000),
            ..SessionConfig::default()
        };
        let mut random = Random(99);
        let before = IN_USE.load(Relaxed);
        let mut session = Session::new(Stream { origin: RobotId(1), epoch: 1 }, config, 1).unwrap();
        let mut now = Stamp(0);
        let mut most = 0;
        for round in 0..6_000u32 {
            now = now.plus_micros(random.below(20_000) as i64);
            let mut bytes = wild(&mut random, now, 12, RobotId(1));
            if let Some(key) = &swarm_key
                && bytes.len() <= 1_181
                && random.happens(0.95)
            {
                // Most are fresh.
                let late_max = if random.happens(0.2) { 4_000 } else { 3 };
                let late = random.below(late_max);
                bytes = seal_datagram(key, &SALT, &bytes, None, u64::from(round + 4_000) - late).unwrap();
            }
            match random.below(8) {
                0 => bytes.truncate(random.below(bytes.len() as u64) as usize),
                1 => {
                    let at = random.below(bytes.len() as u64) as usize;
                    bytes[at] ^= 1 << random.below(8);
                }
                2 => bytes = (0..random.below(1_300)).map(|_| random.next() as u8).collect(),
                _ => {}
            }
            let _ = session.handle_datagram(now, &bytes);
            if round % 20 == 0 {
                let next = session.store().newest_known(session.own()) + 1;
                let own = session.own();
                session.publish(now, package(&mut random, own, next)).unwrap();
            }
            while let Some(event) = session.poll_event() {
                if let Event::Received(package) = event {
                    if random.happens(0.8) {
                        session.verdict(now, &package, Verdict::Merged);
                    } else {
                        session.verdict(now, &package, Verdict::Damaged);
                    }
                }
            }
            for _ in 0..50 {
                if session.poll_transmit(now).is_none() {
                    break;
                }
            }
            most = most.max(IN_USE.load(Relaxed).saturating_sub(before));
        }
        assert!(session.peers().count() <= 4);
        assert!(session.streams().count() <= 9);
        let counters = session.counters();
        for (count, what) in [
            (counters.damaged, "damaged"),
            (counters.too_many_streams, "streams"),
            (counters.too_many_peers, "peers"),
            (counters.stale_epoch, "epochs"),
            (counters.own_returned, "own"),
        ] {
            assert!(count > 0, "no {what} among {counters:#?}");
        }
        if swarm_key.is_some() {
            assert!(counters.forged > 0 && counters.replayed > 0 && counters.unsealed > 0, "{counters:#?}");
        }
        println!("{cast:?}: at most {most} bytes in use");
        // 200 kB store, 9 held lists of 8 KiB, 4 peers × 9 views of 16 KiB and what they cost while they grow.
        assert!(most < 1_600_000, "{most} bytes in use");
    }

    // A driver that never drains its events.
    let before = IN_USE.load(Relaxed);
    let mut random = Random(5);
    let mut session =
        Session::new(Stream { origin: RobotId(1), epoch: 1 }, SessionConfig::default(), 1).unwrap();
    let sender = Stream { origin: RobotId(2), epoch: 1 };
    for index in (1..20_000).step_by(10) {
        let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender, stamp: Stamp(index.into()) };
        let mut writer = PackagesWriter::new(header, 1_200);
        for index in index..index + 10 {
            writer.push(&package(&mut random, sender, index));
        }
        session.handle_datagram(Stamp(index.into()), &writer.finish()).unwrap();
    }
    assert!(session.counters().events_overflowed > 0);
    let used = IN_USE.load(Relaxed) - before;
    assert!(used < 4_096 * 1_000, "{used} bytes for events that nobody takes");
    drop(session);

    // Among good robots one that talks wildly, though not of the good ones' packages: against that only a
    // swarm key helps. The good ones still get in sync.
    let mut swarm = Swarm::of(2, 31, Radio::lossy(0.1), &SessionConfig::default());
    let mut random = Random(6);
    for round in 0..40 {
        swarm.publish(1, 300);
        swarm.publish(2, 300);
        for id in [1, 2] {
            let robot = swarm.robots.get_mut(&id).unwrap();
            let now = Stamp(swarm.now + robot.clock);
            let mut bytes = wild(&mut random, now, 3, RobotId(4_000));
            if round % 2 == 0 {
                let at = random.below(bytes.len() as u64) as usize;
                bytes[at] ^= 0x55;
            }
            // Not in the name of the good ones.
            if bytes.get(6) != Some(&1) && bytes.get(6) != Some(&2) {
                let _ = robot.session.handle_datagram(now, &bytes);
            }
            swarm.drive(id);
        }
        swarm.run(SECOND / 2);
    }
    swarm.run(10 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2)]);
}
