//! The judge: what happens in the world as it is, which no robot sees.

use super::Ending;
use flockmap_grid::VoxelBox;
use flockmap_worlds::World;
use flockmap_worlds::curve::distance;

/// A robot touches what is nearer to its centre than this, in metres.
pub const BODY_RADIUS_M: f64 = 0.2;

/// Distance from a point to the nearest solid cell of the world, in metres, if it is less than `most`.
/// O(cells within `most`).
fn clearance(world: &World, point: [f64; 3], most: f64) -> Option<f64> {
    let side = world.resolution().metres();
    let low = world.resolution().voxel_at(point.map(|v| v - most))?;
    let high = world.resolution().voxel_at(point.map(|v| v + most))?;
    let squares = VoxelBox::spanning(low, high)?.voxels().filter(|cell| world.is_solid(*cell)).map(|cell| {
        let index = [cell.x, cell.y, cell.z];
        let gap = |a: usize| {
            let low = f64::from(index[a]) * side;
            (low - point[a]).max(point[a] - (low + side)).max(0.0)
        };
        gap(0) * gap(0) + gap(1) * gap(1) + gap(2) * gap(2)
    });
    squares.min_by(f64::total_cmp).map(f64::sqrt).filter(|distance| *distance < most)
}

/// What is wrong with these positions of leader and follower, if anything.
pub(super) fn collision(world: &World, leader: [f64; 3], follower: [f64; 3]) -> Option<Ending> {
    if clearance(world, leader, BODY_RADIUS_M).is_some() {
        Some(Ending::LeaderHit)
    } else if clearance(world, follower, BODY_RADIUS_M).is_some() {
        Some(Ending::FollowerHit)
    } else if distance(leader, follower) < 2.0 * BODY_RADIUS_M {
        Some(Ending::RobotsTouched)
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::Resolution;

    #[test]
    fn who_touched_what_is_distinguished() {
        // One solid cell from 1.0 to 1.1 m on each axis.
        let world = World::from_points([[1.05, 1.05, 1.05]], Resolution::from_metres(0.1).unwrap()).unwrap();
        let away = [5.0, 5.0, 1.0];
        let near = [1.05, 1.29, 1.05];
        let apart = [1.05, 1.31, 1.05];
        assert_eq!(collision(&world, near, away), Some(Ending::LeaderHit));
        assert_eq!(collision(&world, away, near), Some(Ending::FollowerHit));
        assert_eq!(collision(&world, apart, away), None);
        assert_eq!(collision(&world, [5.0, 5.3, 1.2], away), Some(Ending::RobotsTouched));
        assert_eq!(collision(&world, [5.0, 5.3, 1.3], away), None);
        // Past a corner it is the straight distance that counts.
        assert_eq!(collision(&world, [1.23, 1.23, 1.05], away), Some(Ending::LeaderHit));
        assert_eq!(collision(&world, [1.25, 1.25, 1.05], away), None);
    }
}
