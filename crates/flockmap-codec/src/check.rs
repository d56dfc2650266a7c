//! The check of a package: CRC-32 (the one of zlib) over its header, the length of its payload, and its
//! decoded content in one fixed form.

use crc32fast::Hasher;
use flockmap_grid::{Changes, SnapshotVoxels, Stamp};

use crate::codec::Codec;
use crate::source::Span;

/// The check of a package. `header` is its bytes up to the check. With the length of the payload a package
/// that lost its end, or got another, is damaged for every codec.
pub(crate) fn of_package(header: &[u8], payload: &[u8], content: &Hasher) -> u32 {
    let mut hasher = Hasher::new();
    hasher.update(header);
    // No payload comes near the end of a `u32`: that of the largest box takes 2²⁷ times a few bytes.
    hasher.update(&(payload.len() as u32).to_le_bytes());
    hasher.combine(content);
    hasher.finalize()
}

/// The content of a package of changes.
pub(crate) fn of_changes(changes: &Changes) -> Hasher {
    let mut hasher = Hasher::new();
    hash_changes(&mut hasher, changes);
    hasher
}

/// The content of a chunk of a snapshot.
pub(crate) fn of_chunk(parts: &[(Stamp, Changes)], sensors: &[(Stamp, [i32; 3])]) -> Hasher {
    let mut hasher = Hasher::new();
    parts.iter().for_each(|(stamp, changes)| hash_part(&mut hasher, *stamp, changes));
    hash_sensors(&mut hasher, sensors);
    hasher
}

/// The id of a snapshot: a check of its whole state, of the packages that it contains, and of all that decides
/// how it is cut and coded, since chunks may be coded against each other. Its parts follow, in order.
pub(crate) fn begin_snapshot_id(
    codec: Codec,
    bytes_max: usize,
    span: &Span,
    state: &SnapshotVoxels,
) -> Hasher {
    let mut hasher = Hasher::new();
    hasher.update(&[codec.id()]);
    hasher.update(&(bytes_max as u64).to_le_bytes());
    hasher.update(&span.since.to_le_bytes());
    hasher.update(&span.upto.to_le_bytes());
    if let Some(lost_upto) = span.lost_upto {
        hasher.update(&lost_upto.0.to_le_bytes());
    }
    if let Some(changed_upto) = span.changed_upto {
        hasher.update(&changed_upto.to_le_bytes());
        hasher.update(&[u8::from(span.is_cut) | u8::from(span.is_of_all) << 1]);
    }
    if let Some(says_upto) = span.says_upto {
        hasher.update(b"says");
        hasher.update(&says_upto.to_le_bytes());
    }
    hash_sensors(&mut hasher, state.sensors());
    hasher
}

fn hash_sensors(hasher: &mut Hasher, sensors: &[(Stamp, [i32; 3])]) {
    for (stamp, sensor) in sensors {
        hasher.update(&stamp.0.to_le_bytes());
        sensor.iter().for_each(|at| hasher.update(&at.to_le_bytes()));
    }
}

/// A part of a snapshot.
pub(crate) fn hash_part(hasher: &mut Hasher, stamp: Stamp, changes: &Changes) {
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
