//! A robot has places for few snapshots at once: what a peer has given its place to is what it is sent.

mod swarm;

use flockmap_codec::{Codec, ContentKind, Encoder};
use flockmap_grid::{Changes, Resolution, RobotId, Snapshot, Stamp, State, Stream, Voxel};
use flockmap_sync::wire::{
    Datagram, DatagramHeader, Kind, PackagesWriter, Received, Request, SnapshotRequest, TransferProgress,
};
use flockmap_sync::{Cast, IntervalSet, SessionConfig};
use std::collections::BTreeMap;
use swarm::{MS, Radio, Swarm};

/// Since which package, up to which, which snapshot, how many chunks.
type Id = (u32, u32, u32, u32);

/// Robot 1 as real as ever; what its peers say, a test says.
struct One {
    swarm: Swarm,
    own: Stream,
    /// Every chunk that it has sent, and how often.
    sent: BTreeMap<(Id, u32), u32>,
}

/// What a peer says of the snapshot to which it has given its place.
#[derive(Clone, Copy)]
struct Place {
    id: Id,
    /// The first so many chunks it has.
    chunks: u32,
    /// It wants a snapshot that contains this package.
    wants: Option<u32>,
}

impl One {
    /// A request of a peer that holds packages 1 to `held`, and has given its place to a snapshot.
    fn hears(&mut self, peer: u16, held: u32, place: Option<Place>) {
        let own = self.own;
        let list = |low, high| IntervalSet::from_intervals(64, vec![(low, high)]);
        let transfer = |Place { id: (since, upto, snapshot_id, chunks), chunks: accepted, .. }: Place| {
            TransferProgress {
                source: own.origin,
                stream: own,
                since,
                upto,
                snapshot_id,
                chunks,
                from: 1,
                accepted: list(1, accepted),
            }
        };
        let wanted = place.and_then(|place| place.wants).map(|package| SnapshotRequest {
            stream: own,
            since: package - 1,
            from: 1,
            undecodable: list(package, package),
        });
        let request = Request {
            received: vec![Received {
                in_part: None,
                stream: own,
                is_oldest_wanted: false,
                from: 1,
                received: list(1, held),
            }],
            transfers: place.map(transfer).into_iter().collect(),
            snapshot_requests: wanted.into_iter().collect(),
            ..Request::default()
        };
        self.swarm.hear_request(1, peer, request);
        self.swarm.run(250 * MS);
        for package in self.swarm.take_sent_packages() {
            if let ContentKind::Snapshot { since, id, chunk, chunks } = package.header().content {
                *self.sent.entry(((since, package.header().index, id, chunks), chunk)).or_default() += 1;
            }
        }
    }

    fn snapshot_since(&self, since: u32) -> Option<Id> {
        self.sent.keys().map(|(id, _)| *id).find(|id| id.0 == since)
    }
}

/// Robot 1 with 60 packages, of which only the newest are stored.
fn one(cast: Cast) -> One {
    let config =
        SessionConfig { cast, store_bytes_max: 8_000, snapshot_bytes_min: None, ..SessionConfig::default() };
    let mut swarm = Swarm::new(79, Radio::PERFECT);
    let own = swarm.start(1, 1, config);
    for _ in 0..60 {
        swarm.publish(1, 900);
        swarm.run(50 * MS);
    }
    One { swarm, own, sent: BTreeMap::new() }
}

/// The same, when it has sent a snapshot to robot 3, which lacks what is after package 30; what it sends from
/// now on is counted.
fn one_with_a_snapshot(cast: Cast) -> (One, Id) {
    let mut one = one(cast);
    for _ in 0..10 {
        one.hears(3, 30, None);
    }
    let id = one.snapshot_since(30).expect("a snapshot for robot 3");
    one.sent.clear();
    (one, id)
}

/// Once it was sent the snapshot that was meant for it, which it ignored, and each of the two was offered for
/// ever.
#[test]
fn a_peer_is_sent_the_snapshot_that_it_has_given_its_place_to() {
    let mut one = one(Cast::Broadcast);
    // Robot 3 lacks what is after package 30, robot 2 what is after package 10. Neither has a place for what
    // it is sent.
    for _ in 0..40 {
        one.hears(3, 30, None);
    }
    let own_set = one.snapshot_since(30).expect("a snapshot for robot 3");
    for _ in 0..40 {
        one.hears(2, 10, None);
        one.hears(3, 30, None);
    }
    let other = one.snapshot_since(10).expect("a snapshot for robot 2");
    assert!(other.3 > 2 && own_set.1 == other.1);
    // The first chunk of the snapshot for robot 2 got the place of robot 3.
    one.sent.clear();
    for _ in 0..40 {
        one.hears(2, 10, None);
        one.hears(3, 30, Some(Place { id: other, chunks: 1, wants: None }));
    }
    let chunks = one.sent.keys().filter(|(id, _)| *id == other).count() as u32;
    assert!(chunks >= other.3 - 1, "{chunks} of {} chunks", other.3);
}

/// Once each of its requests, which named the old snapshot alone, made the sender go back to that one, and
/// then begin the new one anew.
#[test]
fn a_peer_that_needs_another_snapshot_than_the_one_that_has_its_place_is_not_sent_that_one_over_and_over() {
    for (cast, chunks) in [(Cast::Unicast, 1), (Cast::Broadcast, 1), (Cast::Broadcast, u32::MAX)] {
        let (mut one, old) = one_with_a_snapshot(cast);
        // It turns out that robot 3 cannot decode a package before that snapshot, and it says nothing of the
        // snapshot that it is sent for it.
        for _ in 0..40 {
            one.hears(3, 30, Some(Place { id: old, chunks: chunks.min(old.3), wants: Some(21) }));
        }
        let new =
            one.snapshot_since(20).or_else(|| one.snapshot_since(0)).expect("another snapshot for robot 3");
        let most = one.sent.iter().filter(|((id, _), _)| *id == new).map(|(_, count)| *count).max();
        assert!(most.is_some_and(|most| most <= 8), "{cast:?}: a chunk was sent {most:?} times");
    }
}

/// Going over to a snapshot that is complete sends nothing, but makes the snapshot that the peer is sent
/// begin anew.
#[test]
fn a_snapshot_of_which_a_peer_has_all_chunks_does_not_displace_the_one_that_it_is_sent() {
    let (mut one, old) = one_with_a_snapshot(Cast::Broadcast);
    // Its snapshot request finds room in every second request.
    for wants in [Some(21), None].into_iter().cycle().take(200) {
        one.hears(3, 30, Some(Place { id: old, chunks: old.3, wants }));
    }
    let most = one.sent.values().max();
    assert!(most.is_some_and(|most| *most <= 16), "a chunk was sent {most:?} times in 50 s");
}

/// Once it kept its place for 30 s, and as long as it was named nobody else sent what it would have brought.
#[test]
fn a_snapshot_whose_sender_has_forgotten_the_stream_has_its_place_no_longer() {
    let mut swarm = Swarm::new(80, Radio::PERFECT);
    swarm.start(1, 1, SessionConfig::default());
    let stream = Stream { origin: RobotId(9), epoch: 1 };
    let sender = Stream { origin: RobotId(3), epoch: 1 };
    let row = Changes::from_voxels((0..5_000).step_by(7).map(|x| (Voxel::new(x, 0, 0), State::Free)));
    let region = row.bounding_box().unwrap();
    let state = Snapshot { region, parts: vec![(Stamp(1), row)], sensors: Vec::new() };
    let resolution = Resolution::from_metres(0.1).unwrap();
    let chunks = Encoder::new().encode_snapshot(Codec::Raw, stream, 20, resolution, &state, 600).unwrap();
    assert!(chunks.len() > 1);
    let mut first = chunks.first();

    // The transfers that robot 1 names after robot 3 said that it holds this.
    let mut named_after = |received: Vec<Received>| {
        swarm.take_sent();
        swarm.hear_request(1, 3, Request { received, ..Request::default() });
        let robot = swarm.robots.get_mut(&1).unwrap();
        let now = Stamp(swarm.now + robot.clock);
        let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender, stamp: now };
        if let Some(chunk) = first.take() {
            let mut writer = PackagesWriter::new(header, 1_200);
            assert!(writer.push(chunk));
            robot.session.handle_datagram(now, &writer.finish()).unwrap();
        }
        swarm.run(3_000 * MS);
        let sent = swarm.take_sent();
        let mut requests = sent.iter().filter_map(|(_, bytes)| {
            let datagram = Datagram::new_checked(bytes).unwrap();
            (datagram.header().kind == Kind::Request).then(|| Request::parse(&datagram, 64).unwrap())
        });
        requests.next_back().unwrap().transfers.iter().map(|transfer| transfer.source.0).collect::<Vec<_>>()
    };
    let received = IntervalSet::from_intervals(64, vec![(1, 20)]);
    let holds =
        || Received { in_part: None, stream, is_oldest_wanted: false, from: 1, received: received.clone() };
    assert_eq!(named_after(vec![holds()]), [3]);
    assert_eq!(named_after(vec![holds()]), [3]);
    assert_eq!(named_after(Vec::new()), [0; 0]);
}
