//! The blocks of a box in which voxels are found, in any order.

use core::hash::Hash;

use flockmap_grid::{BlockIndex, Voxel, VoxelBox, voxel_bit};
use rustc_hash::FxHashMap;

use crate::error::PackageError;
use crate::work::{self, Work};

/// Voxels of a block by plane: Free ones and Occupied ones.
pub(crate) type Planes = [[u64; 8]; 2];

/// Blocks as they were found, each of the voxels with one key.
pub(crate) type Found<K> = Vec<((K, BlockIndex), Planes)>;

/// Blocks by their index and a key of each voxel.
pub(crate) struct Blocks<'w, K> {
    min: Voxel,
    found: Found<K>,
    number_of: FxHashMap<(K, BlockIndex), usize>,
    /// Where the last blocks are in `found`, one for each that is even or odd along the axes: so that
    /// neighbours are all here.
    last: [usize; 8],
    work: &'w mut Work,
    /// Why nothing is taken in any more.
    pub(crate) fault: Option<PackageError>,
}

impl<'w, K: Copy + Eq + Hash> Blocks<'w, K> {
    pub(crate) fn new(region: &VoxelBox, work: &'w mut Work) -> Self {
        let (found, number_of) = (Vec::new(), FxHashMap::default());
        Self { min: region.min(), found, number_of, last: [usize::MAX; 8], work, fault: None }
    }

    /// The block of a voxel that lies in the box, and its bit there. `None` after a fault.
    #[inline]
    pub(crate) fn at(&mut self, key: K, [x, y, z]: [i32; 3]) -> Option<(&mut Planes, usize)> {
        let voxel = Voxel::new(self.min.x + x, self.min.y + y, self.min.z + z);
        let index = voxel.block();
        let last = ((index.x & 1) | (index.y & 1) << 1 | (index.z & 1) << 2) as usize;
        let mut number = self.last[last & 7];
        if self.found.get(number).is_none_or(|(found, _)| *found != (key, index)) {
            number = self.number((key, index))?;
            self.last[last & 7] = number;
        }
        self.found.get_mut(number).map(|(_, planes)| (planes, voxel_bit(voxel)))
    }

    /// The number of a block, which is counted as work when it is new.
    #[inline(never)]
    fn number(&mut self, block: (K, BlockIndex)) -> Option<usize> {
        if self.fault.is_some() {
            return None;
        }
        let new = self.found.len();
        let number = *self.number_of.entry(block).or_insert(new);
        if number == new {
            self.fault = self.work.take(work::BLOCK_STEPS).err();
            if self.fault.is_some() {
                return None;
            }
            self.found.push((block, [[0; 8]; 2]));
        }
        Some(number)
    }

    /// The blocks as they were found.
    pub(crate) fn finish(self) -> Result<Found<K>, PackageError> {
        self.fault.map_or(Ok(self.found), Err)
    }
}
