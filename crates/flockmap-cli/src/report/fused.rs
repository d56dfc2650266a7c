//! Fused maps beside each other. Layers must be equal; fused maps need not be: where several robots saw a
//! voxel, each trusts its own newer observation.

use std::collections::HashMap;

use flockmap::Robot;
use flockmap::grid::{BlockIndex, StateBlock};
use serde::Serialize;

/// How far the fused maps of robots are the same, over all pairs. All robots of a run share one frame, so
/// their voxels lie on each other.
#[derive(Serialize)]
pub struct Fused {
    #[serde(flatten)]
    pub all: Shared,
    /// Share of equal voxels among those that two fused maps know; `None` if they know none in common.
    pub share: Option<f64>,
    /// The same among those that both robots saw themselves.
    pub share_of_seen: Option<f64>,
    pub pairs: Vec<FusedPair>,
}

/// Two robots.
#[derive(Serialize)]
pub struct FusedPair {
    pub robots: [u16; 2],
    #[serde(flatten)]
    pub shared: Shared,
}

/// Voxels that two robots have in common.
#[derive(Serialize, Clone, Copy, Default, PartialEq, Eq, Debug)]
pub struct Shared {
    /// Known in both fused maps.
    pub known: u64,
    /// Of these, in the same state in both.
    pub equal: u64,
    /// Known to the own mappers of both.
    pub seen: u64,
    /// Of these, in the same state in both fused maps.
    pub seen_equal: u64,
}

impl Shared {
    fn add(&mut self, ours: &StateBlock, theirs: &StateBlock, seen: impl Fn(usize) -> u64) {
        let count = |plane: u64| u64::from(plane.count_ones());
        for z in 0..8 {
            let known = ours.known()[z] & theirs.known()[z];
            let equal = ours.free()[z] & theirs.free()[z] | ours.occupied()[z] & theirs.occupied()[z];
            self.known += count(known);
            self.equal += count(equal);
            self.seen += count(known & seen(z));
            self.seen_equal += count(equal & seen(z));
        }
    }

    /// Share of equal voxels among those that both know.
    pub(super) fn share(&self) -> Option<f64> {
        (self.known > 0).then(|| self.equal as f64 / self.known as f64)
    }

    /// Share of equal voxels among those that both saw.
    pub(super) fn share_of_seen(&self) -> Option<f64> {
        (self.seen > 0).then(|| self.seen_equal as f64 / self.seen as f64)
    }

    fn merge(&mut self, other: Self) {
        self.known += other.known;
        self.equal += other.equal;
        self.seen += other.seen;
        self.seen_equal += other.seen_equal;
    }
}

impl Fused {
    /// Compares every two robots, voxel by voxel, block by block.
    pub fn of<'a>(robots: impl IntoIterator<Item = &'a Robot>) -> Self {
        let with_seen = |robot: &'a Robot| (robot, robot.mapper().blocks().collect::<HashMap<_, _>>());
        let robots: Vec<(_, HashMap<BlockIndex, &StateBlock>)> = robots.into_iter().map(with_seen).collect();
        let (mut all, mut pairs) = (Shared::default(), Vec::new());
        for (number, (ours, we_saw)) in robots.iter().enumerate() {
            for (theirs, they_saw) in &robots[number + 1..] {
                let mut shared = Shared::default();
                for (index, block) in ours.map().blocks() {
                    let Some(other) = theirs.map().block(index) else { continue };
                    let saw = we_saw.get(&index).zip(they_saw.get(&index));
                    shared
                        .add(&block, &other, |z| saw.map_or(0, |(we, they)| we.known()[z] & they.known()[z]));
                }
                all.merge(shared);
                let robots = [ours, theirs].map(|robot| robot.own_stream().origin.0);
                pairs.push(FusedPair { robots, shared });
            }
        }
        Self { all, share: all.share(), share_of_seen: all.share_of_seen(), pairs }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{Pose, Resolution, RobotConfig, RobotId, Scan, Stamp, State};

    /// A robot that saw these points, each in a scan of its own, at these seconds.
    fn robot(id: u16, seen: &[(i64, [f32; 3])]) -> Robot {
        let resolution = Resolution::from_metres(0.5).unwrap();
        let mut config = RobotConfig::new(RobotId(id), resolution, 20.0);
        config.epoch = u64::from(id);
        let mut robot = Robot::new(config, Stamp(0)).unwrap();
        for (second, point) in seen {
            let stamp = Stamp(second * 1_000_000);
            let scan = Scan { stamp, points: vec![*point; 4], no_returns: Vec::new() };
            robot.insert_scan(stamp, &scan, &Pose::IDENTITY).unwrap();
        }
        robot
    }

    /// What a voxel-by-voxel reading of the public maps gives.
    fn counted(a: &Robot, b: &Robot) -> Shared {
        let mut shared = Shared::default();
        for (voxel, state) in a.map().voxels() {
            let other = b.map().state(voxel);
            if other == State::Unknown {
                continue;
            }
            let both_saw = [a, b].iter().all(|robot| robot.mapper().state(voxel) != State::Unknown);
            shared.known += 1;
            shared.equal += u64::from(state == other);
            shared.seen += u64::from(both_saw);
            shared.seen_equal += u64::from(both_saw && state == other);
        }
        shared
    }

    #[test]
    fn the_shares_are_of_what_both_know_and_of_what_both_saw() {
        // Both look the same way; the second one sees through where the first one saw an obstacle.
        let a = robot(1, &[(1, [5.25, 0.25, 0.25]), (2, [0.25, 4.25, 0.25])]);
        let b = robot(2, &[(1, [9.25, 0.25, 0.25]), (2, [0.25, 0.25, 6.25])]);
        let fused = Fused::of([&a, &b]);
        assert_eq!(fused.all, counted(&a, &b));
        assert_eq!(fused.all.known, fused.all.seen, "nothing was exchanged");
        assert_eq!(fused.all.known - fused.all.equal, 1, "the obstacle of the first");
        assert!(fused.share.unwrap() < 1.0 && fused.share == fused.share_of_seen);
        assert_eq!((fused.pairs.len(), fused.pairs[0].robots), (1, [1, 2]));
    }

    #[test]
    fn what_only_one_saw_is_shared_and_not_contested() {
        let mut a = robot(1, &[(1, [5.25, 0.25, 0.25])]);
        let mut b = robot(2, &[(1, [-5.25, 0.25, 0.25])]);
        for second in 2..20 {
            let now = Stamp(second * 1_000_000);
            exchange(&mut a, &mut b, now);
            exchange(&mut b, &mut a, now);
        }
        let fused = Fused::of([&a, &b]);
        assert_eq!(fused.all, counted(&a, &b));
        assert!(fused.all.known > fused.all.seen + 10, "{:?}", fused.all);
        assert_eq!(fused.share, Some(1.0));
        assert_eq!(Fused::of([&a]).share, None, "one robot has nobody to agree with");
    }

    fn exchange(from: &mut Robot, to: &mut Robot, now: Stamp) {
        from.handle_timeout(now);
        while let Some(transmit) = from.poll_transmit(now) {
            to.handle_datagram(now, &transmit.bytes).unwrap();
        }
    }
}
