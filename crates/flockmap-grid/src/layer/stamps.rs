//! A stamp for each voxel of a block, exact and small.

use crate::block::set_bits;
use crate::{BLOCK_VOXELS, Plane, Stamp};

/// Stamps of the voxels of a block, as a palette and an index into it for each voxel. A block is touched by a few
/// dozen batches as a rule, so a byte a voxel is enough; with more than 256 stamps in use it takes two.
/// At most 9.2 kB: 1,024 palette entries, the half of them of no use any more, and 512 indices of two bytes.
#[derive(PartialEq, Debug)]
pub(super) struct BlockStamps {
    palette: Vec<Stamp>,
    indices: Indices,
    newest: Stamp,
}

/// Most stamps in a palette.
const STAMPS_MAX: usize = 2 * BLOCK_VOXELS;

#[derive(Clone, PartialEq, Debug)]
enum Indices {
    /// All voxels have the only stamp of the palette.
    One,
    Narrow(Box<[u8; BLOCK_VOXELS]>),
    Wide(Box<[u16; BLOCK_VOXELS]>),
}

impl Clone for BlockStamps {
    /// With as much room: it takes as many bytes, and grows in the same steps.
    fn clone(&self) -> Self {
        let mut palette = Vec::with_capacity(self.palette.capacity());
        palette.extend_from_slice(&self.palette);
        Self { palette, indices: self.indices.clone(), newest: self.newest }
    }
}

impl BlockStamps {
    /// One stamp for all voxels.
    pub(super) fn new(stamp: Stamp) -> Self {
        Self { palette: vec![stamp], indices: Indices::One, newest: stamp }
    }

    /// The stamps of a palette without one that is of no use, by the number of each voxel in it.
    pub(super) fn from_parts(palette: Vec<Stamp>, numbers: &[u16; BLOCK_VOXELS], newest: Stamp) -> Self {
        let indices = Indices::of(palette.len(), numbers);
        Self { palette, indices, newest }
    }

    /// Stamp of the voxel with this bit number.
    pub(super) fn get(&self, bit: usize) -> Stamp {
        self.palette[self.index(bit)]
    }

    /// The newest stamp that a voxel may have.
    pub(super) const fn newest(&self) -> Stamp {
        self.newest
    }

    /// No voxel's stamp is older.
    pub(super) fn oldest(&self) -> Stamp {
        self.palette.iter().copied().min().unwrap_or_default()
    }

    /// Gives the voxels of `mask` this stamp. `in_use` are the voxels whose stamps matter.
    pub(super) fn set(&mut self, mask: &Plane, stamp: Stamp, in_use: &Plane) {
        self.newest = self.newest.max(stamp);
        let number = match self.palette.iter().rposition(|s| *s == stamp) {
            Some(number) => number,
            None => {
                if self.palette.len() >= self.capacity() {
                    self.compact(in_use);
                }
                self.palette.push(stamp);
                self.widen();
                self.palette.len() - 1
            }
        };
        match &mut self.indices {
            Indices::One => {}
            Indices::Narrow(indices) => set_bits(mask).for_each(|bit| indices[bit] = number as u8),
            Indices::Wide(indices) => set_bits(mask).for_each(|bit| indices[bit] = number as u16),
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.palette.capacity() * size_of::<Stamp>()
            + match self.indices {
                Indices::One => 0,
                Indices::Narrow(_) => BLOCK_VOXELS,
                Indices::Wide(_) => 2 * BLOCK_VOXELS,
            }
    }

    /// The most bytes that so many further stamps can add.
    pub(super) fn growth_max(&self, further: usize) -> usize {
        Self::bytes_of(self.palette.len() + further).saturating_sub(self.memory_bytes())
    }

    /// The most bytes that so many stamps take. The palette is a list that doubles.
    pub(super) const fn bytes_of(stamps: usize) -> usize {
        let stamps = if stamps < STAMPS_MAX { stamps } else { STAMPS_MAX };
        match stamps {
            0 | 1 => size_of::<Stamp>(),
            2..=4 => 4 * size_of::<Stamp>() + BLOCK_VOXELS,
            5..=256 => stamps.next_power_of_two() * size_of::<Stamp>() + BLOCK_VOXELS,
            _ => stamps.next_power_of_two() * size_of::<Stamp>() + 2 * BLOCK_VOXELS,
        }
    }

    /// Calls `found` with each stamp that a voxel of `in_use` has, once. O(voxels), less if there is but one
    /// stamp.
    pub(super) fn for_each_in_use(&self, in_use: &Plane, mut found: impl FnMut(Stamp)) {
        if let Indices::One = self.indices {
            if *in_use != [0; 8] {
                found(self.palette[0]);
            }
            return;
        }
        let mut is_found = [false; STAMPS_MAX];
        set_bits(in_use).for_each(|bit| {
            let number = self.index(bit);
            if !core::mem::replace(&mut is_found[number], true) {
                found(self.palette[number]);
            }
        });
    }

    fn index(&self, bit: usize) -> usize {
        match &self.indices {
            Indices::One => 0,
            Indices::Narrow(indices) => usize::from(indices[bit]),
            Indices::Wide(indices) => usize::from(indices[bit]),
        }
    }

    /// Stamps that fit before something has to give.
    fn capacity(&self) -> usize {
        match self.indices {
            Indices::One => 1,
            Indices::Narrow(_) => 256,
            Indices::Wide(_) => STAMPS_MAX,
        }
    }

    /// Makes room in the indices for the palette as it is now.
    fn widen(&mut self) {
        match &self.indices {
            Indices::One if self.palette.len() > 1 => {
                self.indices = Indices::Narrow(Box::new([0; BLOCK_VOXELS]))
            }
            Indices::Narrow(indices) if self.palette.len() > 256 => {
                self.indices = Indices::Wide(Box::new(indices.map(u16::from)));
            }
            _ => {}
        }
    }

    /// Drops the stamps that no voxel in use has. At most 512 are left.
    fn compact(&mut self, in_use: &Plane) {
        let mut number_of = vec![usize::MAX; self.palette.len()];
        let mut palette = Vec::new();
        let mut renumbered = [0u16; BLOCK_VOXELS];
        for bit in set_bits(in_use) {
            let old = self.index(bit);
            if number_of[old] == usize::MAX {
                number_of[old] = palette.len();
                palette.push(self.palette[old]);
            }
            renumbered[bit] = number_of[old] as u16;
        }
        if palette.is_empty() {
            palette.push(self.newest());
        }
        self.indices = Indices::of(palette.len(), &renumbered);
        self.palette = palette;
    }
}

impl Indices {
    /// Of a palette with so many stamps, at least one.
    fn of(stamps: usize, numbers: &[u16; BLOCK_VOXELS]) -> Self {
        match stamps {
            0 | 1 => Self::One,
            2..=256 => Self::Narrow(Box::new(numbers.map(|number| number as u8))),
            _ => Self::Wide(Box::new(*numbers)),
        }
    }
}
