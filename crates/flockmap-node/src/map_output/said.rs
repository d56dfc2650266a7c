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

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{Pose, Resolution, RobotConfig, RobotId, SubmapId};

    fn robot() -> Robot {
        let resolution = Resolution::from_metres(0.1).unwrap();
        Robot::new(RobotConfig::new(RobotId(1), resolution, 7.0), Stamp(0)).unwrap()
    }

    fn up(metres: f64) -> Pose {
        Pose::from_translation([0.0, 0.0, metres])
    }

    #[test]
    fn submaps_are_said_as_they_are_shown_and_only_those_that_lie_otherwise_than_the_one_before() {
        let (mut robot, now) = (robot(), Stamp(1_000_000));
        let submaps = |robot: &Robot| {
            let [run] = &submaps_of(robot)[..] else { panic!("one run") };
            assert_eq!((run.stream, run.left_out), (robot.own_stream(), 0));
            let poses = run.poses.iter().map(|(submap, pose)| (submap.number(), pose.translation()[2]));
            (run.newest.number(), poses.collect::<Vec<_>>())
        };
        assert_eq!(submaps(&robot), (0, vec![(0, 0.0)]));
        for _ in 0..4 {
            robot.begin_submap(now).unwrap();
        }
        assert_eq!(submaps(&robot), (4, vec![(0, 0.0)]), "all lie as the first does");
        // The one after it stays, which has to be said then.
        robot.set_submap_pose(now, SubmapId::new(2).unwrap(), &up(0.5)).unwrap();
        assert_eq!(
            submaps(&robot),
            (4, vec![(0, 0.0)]),
            "the map is as it was, and so is what is said of it"
        );
        robot.finish_rebuild();
        assert_eq!(submaps(&robot), (4, vec![(0, 0.0), (2, 0.5), (3, 0.0)]));
        robot.set_submap_pose(now, SubmapId::FIRST, &up(0.5)).unwrap();
        robot.set_submap_pose(now, SubmapId::new(1).unwrap(), &up(0.5)).unwrap();
        robot.finish_rebuild();
        assert_eq!(submaps(&robot), (4, vec![(0, 0.5), (3, 0.0)]));
    }
}
