//! The check of a package: CRC-32 (the one of zlib) over its header and its decoded content in one fixed form.

use crc32fast::Hasher;
use flockmap_grid::{Changes, PresentState, PresentVoxels, Stamp};

use crate::Codec;

/// The check of a package of changes. `header` is its bytes up to the check field.
pub(crate) fn check_changes(header: &[u8], changes: &Changes) -> u32 {
    let mut hasher = Hasher::new();
    hasher.update(header);
    hash_changes(&mut hasher, changes);
    hasher.finalize()
}

/// The check of a tile of a present state.
pub(crate) fn check_present(header: &[u8], state: &PresentState) -> u32 {
    check_hashed(header, &hash_present(&state.parts, &state.sensors))
}

/// The check of a package whose content was hashed before its header was known.
pub(crate) fn check_hashed(header: &[u8], content: &Hasher) -> u32 {
    let mut hasher = Hasher::new();
    hasher.update(header);
    hasher.combine(content);
    hasher.finalize()
}

/// The content of a tile of a present state.
pub(crate) fn hash_present(parts: &[(Stamp, Changes)], sensors: &[(Stamp, [i32; 3])]) -> Hasher {
    let mut hasher = Hasher::new();
    parts.iter().for_each(|(stamp, changes)| hash_part(&mut hasher, *stamp, changes));
    hash_sensors(&mut hasher, sensors);
    hasher
}

/// Tells sets of tiles apart: the check of a whole present state, of the packages that it contains, and of all that decides how it is
/// cut and coded, since tiles may be told against each other.
pub(crate) fn set_check(
    codec: Codec,
    bytes_max: usize,
    [since, upto]: [u32; 2],
    state: &PresentVoxels,
) -> u32 {
    let mut hasher = Hasher::new();
    hasher.update(&[codec.id()]);
    hasher.update(&(bytes_max as u64).to_le_bytes());
    hasher.update(&since.to_le_bytes());
    hasher.update(&upto.to_le_bytes());
    hash_sensors(&mut hasher, state.sensors());
    state.parts().for_each(|(stamp, changes)| hash_part(&mut hasher, stamp, &changes));
    hasher.finalize()
}

fn hash_sensors(hasher: &mut Hasher, sensors: &[(Stamp, [i32; 3])]) {
    for (stamp, sensor) in sensors {
        hasher.update(&stamp.0.to_le_bytes());
        sensor.iter().for_each(|at| hasher.update(&at.to_le_bytes()));
    }
}

fn hash_part(hasher: &mut Hasher, stamp: Stamp, changes: &Changes) {
    hasher.update(&stamp.0.to_le_bytes());
    hash_changes(hasher, changes);
}

/// Each block with a change, ascending by x, then y, then z: its index as three `i32`, then eight `u64` of
/// Free voxels and eight of Occupied ones, all little-endian.
fn hash_changes(hasher: &mut Hasher, changes: &Changes) {
    for (index, block) in changes.blocks() {
        let mut bytes = [0u8; 12 + 128];
        let (corner, planes) = bytes.split_at_mut(12);
        for (bytes, value) in corner.as_chunks_mut::<4>().0.iter_mut().zip([index.x, index.y, index.z]) {
            *bytes = value.to_le_bytes();
        }
        let words = block.free().iter().chain(block.occupied());
        for (bytes, word) in planes.as_chunks_mut::<8>().0.iter_mut().zip(words) {
            *bytes = word.to_le_bytes();
        }
        hasher.update(&bytes);
    }
}
