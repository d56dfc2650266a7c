//! Who saw each voxel of a mirrored map last.

use flockmap_grid::{BLOCK_VOXELS, BlockIndex, Plane, RobotId, Voxel, set_bits, voxel_bit};
use rustc_hash::FxHashMap;

/// The origins of blocks; none of a block means that nothing is known of it.
#[derive(Debug, Default)]
pub(crate) struct Origins(FxHashMap<BlockIndex, Seen>);

#[derive(Debug)]
enum Seen {
    /// One saw every known voxel.
    By(RobotId, Plane),
    /// Voxel by voxel.
    Each(Box<[Option<RobotId>; BLOCK_VOXELS]>),
}

impl Origins {
    pub(crate) fn set(&mut self, index: BlockIndex, origins: &[(RobotId, Plane)]) {
        let seen = match origins {
            [] => {
                self.0.remove(&index);
                return;
            }
            [(only, plane)] => Seen::By(*only, *plane),
            several => {
                let mut each = Box::new([None; BLOCK_VOXELS]);
                for (origin, plane) in several {
                    set_bits(plane).for_each(|bit| each[bit] = Some(*origin));
                }
                Seen::Each(each)
            }
        };
        self.0.insert(index, seen);
    }

    pub(crate) fn get(&self, voxel: Voxel) -> Option<RobotId> {
        let bit = voxel_bit(voxel);
        match self.0.get(&voxel.block())? {
            Seen::By(origin, plane) => (plane[bit / 64] >> (bit % 64) & 1 == 1).then_some(*origin),
            Seen::Each(each) => each[bit],
        }
    }
}
