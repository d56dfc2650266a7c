//! What a robot says of itself and of the others, beside its map.

use std::collections::BTreeSet;
use std::time::Duration;

use flockmap::sync::PeerInfo;
use flockmap::{KnownPose, Robot, Stamp, Stream};
use flockmap_feed::{Link, RobotPose, RunSubmaps};

/// Where robots are, as far as this one knows. O(streams).
pub fn poses_of(robot: &Robot, now: Stamp) -> Vec<RobotPose> {
    let pose = |pose: KnownPose| RobotPose {
        stream: pose.stream,
        position: pose.position,
        orientation: pose.orientation,
        age: since(now, pose.seen),
    };
    robot.poses().into_iter().map(pose).collect()
}

/// How the robot hears each of the others. O(peers × streams).
pub fn links_of(robot: &Robot, now: Stamp) -> Vec<Link> {
    let session = robot.session();
    let newest = session.store().newest_known(session.own());
    let confirmed: Vec<_> = session.own_received_by_peers().collect();
    let link = |peer: PeerInfo| {
        let missing = session.store().missing(peer.stream).map(|(low, high)| u64::from(high - low) + 1);
        let confirmed = confirmed.iter().find(|(stream, ..)| *stream == peer.stream);
        Link {
            stream: peer.stream,
            hears_us: peer.hears_us,
            round_trip: peer.round_trip,
            loss: peer.loss,
            bytes_in: peer.traffic_in.bytes,
            bytes_out: peer.traffic_out.bytes,
            missing: u32::try_from(missing.sum::<u64>()).unwrap_or(u32::MAX),
            unconfirmed: newest.saturating_sub(confirmed.map_or(0, |(_, _, upto)| *upto)),
            silence: since(now, peer.last_heard),
        }
    };
    session.peers().map(link).collect()
}

/// Which submaps each run has, as far as this robot knows, and how they lie in its fused map as that is now. O(submaps).
pub fn submaps_of(robot: &Robot) -> Vec<RunSubmaps> {
    let (fusion, own) = (robot.fusion(), robot.own_stream());
    let streams: BTreeSet<Stream> = fusion.layers().map(|(stream, _)| stream).chain([own]).collect();
    let run = |stream| {
        // What has just begun here has not been published yet.
        let begun = fusion.submaps(stream).chain((stream == own).then(|| robot.submap()));
        let newest = begun.max().unwrap_or_default();
        RunSubmaps { stream, newest, poses: fusion.shown_submaps(stream), left_out: 0 }
    };
    RunSubmaps::within_limits(streams.into_iter().map(run).collect())
}

fn since(now: Stamp, then: Stamp) -> Duration {
    Duration::from_micros(now.micros_since(then).max(0).unsigned_abs())
}
