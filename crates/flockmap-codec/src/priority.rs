//! How urgent a package is.

use flockmap_grid::{Changes, Resolution, VoxelBox};

/// How urgent the changes of a package are: a radio with little room sends the urgent ones first.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Priority {
    /// At least one voxel became Occupied.
    Obstacles,
    /// Free space of which some may be within [`FAR_METRES`] of the sensor.
    NearFree,
    /// Free space in a box farther than [`FAR_METRES`] from the sensor.
    FarFree,
}

/// Free space farther than this from the sensor is the least urgent. In metres.
pub const FAR_METRES: u32 = 4;

impl Priority {
    /// All priorities, the most urgent first.
    pub const ALL: [Self; 3] = [Self::Obstacles, Self::NearFree, Self::FarFree];

    /// The priority of changes in a box, seen from `sensor`, in sixteenths of a voxel from the corner of
    /// voxel (0, 0, 0).
    pub(crate) fn of(changes: &Changes, region: &VoxelBox, sensor: [i32; 3], resolution: Resolution) -> Self {
        if changes.has_occupied() {
            Self::Obstacles
        } else if is_far(region, sensor, resolution) {
            Self::FarFree
        } else {
            Self::NearFree
        }
    }
}

/// Whether all of a box is farther than [`FAR_METRES`] from the sensor.
fn is_far(region: &VoxelBox, sensor: [i32; 3], resolution: Resolution) -> bool {
    let (min, max) = (region.min(), region.max());
    let sides = [(min.x, max.x), (min.y, max.y), (min.z, max.z)];
    // Gaps are below 2³³ sixteenths, a voxel below 2²⁷ micrometres: the sum of squares is below 2¹²².
    let gaps = sides.into_iter().zip(sensor).map(|((min, max), sensor)| {
        let (low, high) = (i64::from(min) * 16, (i64::from(max) + 1) * 16);
        let gap = (low - i64::from(sensor)).max(i64::from(sensor) - high).max(0);
        u128::from(gap.unsigned_abs()).pow(2)
    });
    let far = u128::from(FAR_METRES) * 1_000_000 * 16;
    gaps.sum::<u128>() * u128::from(resolution.micrometres()).pow(2) > far * far
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::Voxel;

    #[test]
    fn free_space_is_far_where_all_of_its_box_is_farther_than_four_metres() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let region = VoxelBox::new(Voxel::new(40, -5, -5), [8, 10, 10]).unwrap();
        // The near side lies at 4 m.
        assert!(!is_far(&region, [0; 3], resolution));
        assert!(is_far(&region, [-1, 0, 0], resolution));
        assert!(!is_far(&region, [44 * 16, 0, 0], resolution));
        // Beyond the far side, and across a corner.
        assert!(is_far(&region, [(48 + 41) * 16, 0, 0], resolution));
        assert!(!is_far(&region, [(40 - 28) * 16, (5 + 28) * 16, 0], resolution));
        assert!(is_far(&region, [(40 - 29) * 16, (5 + 29) * 16, 0], resolution));
        let changes = |state| Changes::from_voxels([(Voxel::new(41, 0, 0), state)]);
        let of = |state, sensor| Priority::of(&changes(state), &region, sensor, resolution);
        use flockmap_grid::State::{Free, Occupied};
        assert_eq!(of(Free, [0; 3]), Priority::NearFree);
        assert_eq!(of(Free, [-1, 0, 0]), Priority::FarFree);
        assert_eq!(of(Occupied, [-1, 0, 0]), Priority::Obstacles);
        // The ends of the grid and the largest voxels do not overflow.
        let whole = VoxelBox::new(Voxel::new((1 << 28) - 1, 0, 0), [1; 3]).unwrap();
        assert!(is_far(&whole, [i32::MIN; 3], Resolution::from_micrometres(100_000_000).unwrap()));
    }
}
