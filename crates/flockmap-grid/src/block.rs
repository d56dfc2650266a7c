//! The states of the 8³ voxels of a block as bit planes, so that work is done 64 voxels at a time.

use crate::{BlockIndex, State, Voxel, VoxelBox};

/// Voxels in a block.
pub const BLOCK_VOXELS: usize = 512;

/// One bit for each voxel of a block. Bit number of a voxel: `z·64 + y·8 + x` of its place in the block,
/// so that each word is one slice of constant z.
pub type Plane = [u64; 8];

/// The bit number (0 … 511) of a voxel in the planes of its block.
pub const fn voxel_bit(voxel: Voxel) -> usize {
    (((voxel.z & 7) << 6) | ((voxel.y & 7) << 3) | (voxel.x & 7)) as usize
}

/// The place of a bit in its block: x, y, z, each 0 … 7. Inverse of [`voxel_bit`].
pub const fn bit_of(bit: usize) -> [i32; 3] {
    [(bit & 7) as i32, ((bit >> 3) & 7) as i32, ((bit >> 6) & 7) as i32]
}

impl BlockIndex {
    /// The voxel with this bit number (0 … 511) in the planes of the block.
    pub const fn voxel(self, bit: usize) -> Voxel {
        let (corner, [x, y, z]) = (self.corner(), bit_of(bit));
        Voxel { x: corner.x + x, y: corner.y + y, z: corner.z + z }
    }
}

/// The numbers of the bits (0 … 511) that are set in a plane, ascending.
pub fn set_bits(plane: &Plane) -> impl Iterator<Item = usize> + use<> {
    let plane = *plane;
    (0..8).flat_map(move |z| bits(plane[z]).map(move |bit| z * 64 + bit))
}

/// The numbers of the bits (0 … 63) that are set in a slice, ascending.
pub(crate) fn bits(mut left: u64) -> impl Iterator<Item = usize> {
    core::iter::from_fn(move || {
        let bit = left.trailing_zeros() as usize;
        (left != 0).then(|| {
            left &= left - 1;
            bit
        })
    })
}

/// Whether a bit is set in both planes.
pub fn meet(a: &Plane, b: &Plane) -> bool {
    a.iter().zip(b).any(|(a, b)| a & b != 0)
}

/// Lowest and highest x, y, z (0 … 7) of the set bits; `[7; 3]` and `[0; 3]` if none is set.
pub(crate) fn extent(plane: &Plane) -> ([i32; 3], [i32; 3]) {
    let all = plane.iter().fold(0, |all, slice| all | slice);
    let columns = all.to_le_bytes().into_iter().fold(0, |columns, row| columns | row);
    let first_z = plane.iter().position(|slice| *slice != 0).unwrap_or(7);
    let last_z = plane.iter().rposition(|slice| *slice != 0).unwrap_or(0);
    let low = [columns.trailing_zeros().min(7), all.trailing_zeros().min(63) / 8, first_z as u32];
    let high = [7 - columns.leading_zeros().min(7), 7 - all.leading_zeros().min(63) / 8, last_z as u32];
    (low.map(|at| at as i32), high.map(|at| at as i32))
}

/// The voxels of a block that lie in the box from `low` to `high`.
pub fn plane_within(block: BlockIndex, low: Voxel, high: Voxel) -> Plane {
    let corner = block.corner();
    // Of one axis: a bit for each place within.
    let within = |low: i32, high: i32, corner: i32| {
        let [from, to] = [low - corner, high - corner + 1].map(|end| end.clamp(0, 8));
        (1u64 << to) - (1 << from.min(to))
    };
    let row = within(low.x, high.x, corner.x);
    let rows = within(low.y, high.y, corner.y);
    let slice = (0..8).filter(|y| rows >> y & 1 == 1).fold(0, |slice, y| slice | row << (8 * y));
    let slices = within(low.z, high.z, corner.z);
    core::array::from_fn(|z| slice * (slices >> z & 1))
}

impl VoxelBox {
    /// The voxels of a block that belong to the box.
    pub fn plane(&self, block: BlockIndex) -> Plane {
        plane_within(block, self.min(), self.max())
    }
}

/// The states of a block: each voxel Free, Occupied or neither (Unknown; in a set of changes: unchanged).
/// The two planes never share a bit.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct StateBlock {
    free: Plane,
    occupied: Plane,
}

impl StateBlock {
    /// A block from its planes. A bit set in both counts as Occupied.
    pub fn new(mut free: Plane, occupied: Plane) -> Self {
        for (f, o) in free.iter_mut().zip(&occupied) {
            *f &= !o;
        }
        Self { free, occupied }
    }

    /// The voxels that are Free.
    pub const fn free(&self) -> &Plane {
        &self.free
    }

    /// The voxels that are Occupied.
    pub const fn occupied(&self) -> &Plane {
        &self.occupied
    }

    /// The voxels that are Free or Occupied.
    pub fn known(&self) -> Plane {
        core::array::from_fn(|z| self.free[z] | self.occupied[z])
    }

    /// Number of voxels that are Free or Occupied.
    pub fn known_count(&self) -> u32 {
        self.known().iter().map(|w| w.count_ones()).sum()
    }

    /// Whether no voxel is Free or Occupied.
    pub fn is_empty(&self) -> bool {
        // The first known voxel decides.
        (0..8).all(|z| self.free[z] | self.occupied[z] == 0)
    }

    /// The state of the voxel with this bit number (0 … 511).
    pub fn get(&self, bit: usize) -> State {
        let (word, mask) = (bit >> 6 & 7, 1u64 << (bit & 63));
        if self.occupied[word] & mask != 0 {
            State::Occupied
        } else if self.free[word] & mask != 0 {
            State::Free
        } else {
            State::Unknown
        }
    }

    /// Sets the state of the voxel with this bit number (0 … 511).
    pub fn set(&mut self, bit: usize, state: State) {
        let (word, mask) = (bit >> 6 & 7, 1u64 << (bit & 63));
        self.free[word] &= !mask;
        self.occupied[word] &= !mask;
        match state {
            State::Unknown => {}
            State::Free => self.free[word] |= mask,
            State::Occupied => self.occupied[word] |= mask,
        }
    }

    /// The same block with only the voxels of `mask`.
    pub fn masked(&self, mask: &Plane) -> Self {
        Self {
            free: core::array::from_fn(|z| self.free[z] & mask[z]),
            occupied: core::array::from_fn(|z| self.occupied[z] & mask[z]),
        }
    }

    /// The voxels whose state is known here and is not the same in `other`.
    pub fn minus(&self, other: &Self) -> Self {
        Self {
            free: core::array::from_fn(|z| self.free[z] & !other.free[z]),
            occupied: core::array::from_fn(|z| self.occupied[z] & !other.occupied[z]),
        }
    }

    /// Takes over every voxel that is known in `newer`; the others stay.
    pub fn overlay(&mut self, newer: &Self) {
        for z in 0..8 {
            let keep = !(newer.free[z] | newer.occupied[z]);
            self.free[z] = (self.free[z] & keep) | newer.free[z];
            self.occupied[z] = (self.occupied[z] & keep) | newer.occupied[z];
        }
    }
}
