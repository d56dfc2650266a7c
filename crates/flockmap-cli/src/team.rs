//! Where the robots of a run are, so that each can leave its team-mates out of its map.

use std::sync::Arc;

use flockmap::{Pose, Scan, Sphere, Stamp};

/// Returns within so many metres of a team-mate's centre are its own. A simulated robot reaches 0.33 m.
pub const MASK_RADIUS_M: f64 = 0.5;

/// A team-mate at the time of a scan.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TeamMate {
    /// Its place among the robots of the run, counted from 0.
    pub number: usize,
    /// Where it is, in metres in the common frame.
    pub position: [f64; 3],
}

impl TeamMate {
    /// The sphere in which returns are not taken for obstacles.
    pub const fn mask(&self) -> Sphere {
        Sphere { centre: self.position, radius: MASK_RADIUS_M }
    }
}

/// Where a robot was, in the order of the stamps.
type Track = Vec<(Stamp, [f64; 3])>;

/// The tracks of all robots of a run, known beforehand.
#[derive(Clone, Debug, Default)]
pub struct Team {
    tracks: Arc<Vec<Track>>,
}

impl Team {
    /// From the poses of each robot, in the order of their stamps.
    pub fn new<'a>(tracks: impl Iterator<Item = (&'a [(Stamp, Pose)], Stamp)>) -> Self {
        let track = |(poses, zero): (&[(Stamp, Pose)], Stamp)| {
            let place = |(stamp, pose): &(Stamp, Pose)| (Stamp(stamp.micros_since(zero)), pose.translation());
            poses.iter().map(place).collect()
        };
        Self { tracks: Arc::new(tracks.map(track).collect()) }
    }

    /// All but one robot at a time. Between two poses a robot is on the straight line between them; before
    /// its first and after its last it stays where it is.
    pub fn mates(&self, of: usize, at: Stamp) -> Vec<TeamMate> {
        let others = self.tracks.iter().enumerate().filter(|(number, _)| *number != of);
        others
            .filter_map(|(number, track)| place_at(track, at).map(|position| TeamMate { number, position }))
            .collect()
    }
}

fn place_at(track: &[(Stamp, [f64; 3])], at: Stamp) -> Option<[f64; 3]> {
    let after = track.partition_point(|(stamp, _)| *stamp < at);
    let previous = after.checked_sub(1).and_then(|i| track.get(i));
    match (previous, track.get(after)) {
        (_, Some((stamp, place))) if *stamp == at => Some(*place),
        (Some((a, from)), Some((b, to))) => {
            let share = at.micros_since(*a) as f64 / b.micros_since(*a).max(1) as f64;
            Some(core::array::from_fn(|axis| from[axis] + (to[axis] - from[axis]) * share))
        }
        (one, other) => one.or(other).map(|(_, place)| *place),
    }
}

/// Whether a place lies in one of the masks.
pub fn is_masked(place: [f64; 3], masks: &[Sphere]) -> bool {
    masks.iter().any(|mask| {
        let away: f64 = place.iter().zip(mask.centre).map(|(a, b)| (a - b) * (a - b)).sum();
        away <= mask.radius * mask.radius
    })
}

/// Takes the points out of a scan that a mapper with these masks would leave out.
pub fn cut_out(scan: &mut Scan, pose: &Pose, masks: &[Sphere]) {
    if !masks.is_empty() {
        scan.points.retain(|point| !is_masked(pose.transform(point.map(f64::from)), masks));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_team_mate_is_where_it_flies_and_stays_where_it_ends() {
        let track = |y: f64| {
            let pose = |i: i64| (Stamp(1_000 + i * 100), Pose::from_translation([i as f64, y, 1.0]));
            (0..3).map(pose).collect::<Vec<_>>()
        };
        let (a, b) = (track(0.0), track(5.0));
        let team = Team::new([(a.as_slice(), Stamp(1_000)), (b.as_slice(), Stamp(1_000))].into_iter());
        for (at, x) in [(-50, 0.0), (0, 0.0), (50, 0.5), (100, 1.0), (175, 1.75), (200, 2.0), (9_000, 2.0)] {
            let expected = TeamMate { number: 1, position: [x, 5.0, 1.0] };
            assert_eq!(team.mates(0, Stamp(at)), [expected], "at {at}");
        }
        assert_eq!(team.mates(1, Stamp(0))[0].number, 0);
        assert_eq!(Team::default().mates(0, Stamp(0)), []);
    }

    #[test]
    fn returns_of_a_team_mate_are_cut_out() {
        let pose = Pose::from_yaw([10.0, 0.0, 0.0], core::f64::consts::FRAC_PI_2);
        let points = vec![[3.0, 0.0, 0.0], [2.7, 0.1, 0.1], [4.0, 0.0, 0.0]];
        let mut scan = Scan { stamp: Stamp(0), points, no_returns: Vec::new() };
        cut_out(&mut scan, &pose, &[Sphere { centre: [10.0, 3.0, 0.0], radius: 0.5 }]);
        assert_eq!(scan.points, [[4.0, 0.0, 0.0]]);
    }
}
