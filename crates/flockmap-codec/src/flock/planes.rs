//! Bits of a block that are moved many at a time. A [`Plane`] has a bit for each voxel: words are slices
//! along z, bytes of a word rows along y, bits of a byte voxels along x.

use flockmap_grid::Plane;

/// Reverses the bits of each byte.
#[inline]
pub(crate) const fn mirrored_bytes(word: u64) -> u64 {
    const NIBBLES: u64 = 0x0f0f_0f0f_0f0f_0f0f;
    const PAIRS: u64 = 0x3333_3333_3333_3333;
    const SINGLES: u64 = 0x5555_5555_5555_5555;
    let word = (word >> 4 & NIBBLES) | (word & NIBBLES) << 4;
    let word = (word >> 2 & PAIRS) | (word & PAIRS) << 2;
    (word >> 1 & SINGLES) | (word & SINGLES) << 1
}

/// Exchanges the bits of `low` that stand `shift` above `mask` with those of `high` in it.
#[inline]
pub(crate) const fn exchange(low: u64, high: u64, mask: u64, shift: usize) -> (u64, u64) {
    let differ = (low >> shift ^ high) & mask;
    (low ^ differ << shift, high ^ differ)
}

/// Swaps slices and rows.
pub(crate) fn swapped_y_and_z(plane: Plane) -> Plane {
    swapped::<8>(plane, [0x0000_0000_ffff_ffff, 0x0000_ffff_0000_ffff, 0x00ff_00ff_00ff_00ff])
}

/// Swaps slices and the voxels of rows.
pub(crate) fn swapped_x_and_z(plane: Plane) -> Plane {
    swapped::<1>(plane, [0x0f0f_0f0f_0f0f_0f0f, 0x3333_3333_3333_3333, 0x5555_5555_5555_5555])
}

/// Swaps the words of a plane with parts of each word: bytes if a part has 8 bits, bits of bytes if it has 1.
#[inline]
fn swapped<const PART: usize>(mut plane: Plane, masks: [u64; 3]) -> Plane {
    for (apart, mask) in [4, 2, 1].into_iter().zip(masks) {
        for low in (0..8).filter(|low| low & apart == 0) {
            let high = (low + apart) & 7;
            (plane[low], plane[high]) = exchange(plane[low], plane[high], mask, apart * PART);
        }
    }
    plane
}
