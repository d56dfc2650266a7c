//! How a block is turned, so that coding always goes in one direction: from the farthest slice from the sensor to
//! the nearest, along the axis on which the sensor is farthest away, and in each slice from the farthest row
//! and voxel.

use flockmap_grid::{BlockIndex, Plane, StateBlock};

use super::block_box::BLOCK_UNITS;
use super::cells::Bits;
use super::planes::{mirrored_bytes, swapped_x_and_z, swapped_y_and_z};

/// How a block is turned: which axis becomes the slices, and which axes are mirrored.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Orientation {
    /// The axis that is swapped with z: the one along which the sensor is farthest away.
    pub(crate) major: usize,
    /// By axis: the sensor lies below the block, so that far is up.
    pub(crate) is_up: [bool; 3],
}

/// Where the sensor is, seen from the middle of a block: along the axes as turned, in sixteenths of a voxel,
/// towards the side on which it is, so never negative.
pub(crate) type Distance = [i32; 3];

impl Orientation {
    /// How a block is turned, and where the sensor is then.
    pub(crate) fn of(block: BlockIndex, sensor: [i32; 3]) -> (Self, Distance) {
        const FAR: i64 = 1 << 24;
        let middle = [block.x, block.y, block.z].map(|at| i64::from(at) * BLOCK_UNITS + BLOCK_UNITS / 2);
        let offset: [i32; 3] =
            core::array::from_fn(|a| (middle[a] - i64::from(sensor[a])).clamp(-FAR, FAR) as i32);
        let is_up = offset.map(|offset| offset > 0);
        let mut distance = offset.map(i32::abs);
        // The last of the largest, so that all agree.
        let major = if distance[2] >= distance[0].max(distance[1]) {
            2
        } else if distance[1] >= distance[0] {
            1
        } else {
            0
        };
        distance.swap(major, 2);
        (Self { major, is_up }, distance)
    }

    /// Turns a plane.
    pub(crate) fn turned(self, plane: &Plane) -> Plane {
        self.swapped(&mirrored(plane, self.is_up))
    }

    /// The inverse of [`Self::turned`], except that x runs downwards still if it was mirrored.
    pub(crate) fn back_but_x(self, plane: &Plane) -> Plane {
        mirrored(&self.swapped(plane), [false, self.is_up[1], self.is_up[2]])
    }

    /// Runs x upwards again.
    pub(crate) fn back_x(self, plane: &Plane) -> Plane {
        mirrored(plane, [self.is_up[0], false, false])
    }

    fn swapped(self, plane: &Plane) -> Plane {
        match self.major {
            0 => swapped_x_and_z(*plane),
            1 => swapped_y_and_z(*plane),
            _ => *plane,
        }
    }
}

fn mirrored(plane: &Plane, [x, y, z]: [bool; 3]) -> Plane {
    let mut plane = *plane;
    if x {
        plane = plane.map(mirrored_bytes);
    }
    if y {
        plane = plane.map(u64::swap_bytes);
    }
    if z {
        plane.reverse();
    }
    plane
}

/// New states of a block in turned planes.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub(crate) struct TurnedChanges {
    pub(crate) free: Plane,
    pub(crate) occupied: Plane,
}

impl TurnedChanges {
    pub(crate) fn of(changes: &StateBlock, orientation: Orientation) -> Self {
        Self { free: orientation.turned(changes.free()), occupied: orientation.turned(changes.occupied()) }
    }

    #[inline]
    pub(crate) fn row(&self, y: usize, z: usize) -> Bits {
        let of = |plane: &Plane| (plane[z & 7] >> (8 * (y & 7))) as u8;
        Bits { free: of(&self.free), occupied: of(&self.occupied) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_plane_is_turned_and_back(major in 0usize..3, is_up in any::<[bool; 3]>(), plane in any::<Plane>()) {
            let orientation = Orientation { major, is_up };
            let there = orientation.turned(&plane);
            for at in (0..512).map(|bit| [bit & 7, bit >> 3 & 7, bit >> 6]) {
                let mut to: [usize; 3] = core::array::from_fn(|a| if is_up[a] { 7 - at[a] } else { at[a] });
                to.swap(major, 2);
                let bit = |plane: &Plane, [x, y, z]: [usize; 3]| plane[z] >> (x + 8 * y) & 1;
                prop_assert_eq!(bit(&there, to), bit(&plane, at));
            }
            prop_assert_eq!(orientation.back_x(&orientation.back_but_x(&there)), plane);
        }
    }
}
