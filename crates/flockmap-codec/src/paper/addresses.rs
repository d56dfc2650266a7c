//! The codec `racer`, the paper's baseline: a list of the voxels.

use flockmap_grid::{Changes, State, Voxel, VoxelBox};

use crate::codec::Codec;
use crate::error::PackageError;

/// Bytes for each voxel in the list of addresses.
const ADDRESS_BYTES: usize = 5;

/// Appends for each voxel of `states`, ascending: the place in nested order as `u32`, then 0 for Free or 1
/// for Occupied.
pub(crate) fn encode(states: &Changes, region: &VoxelBox, out: &mut Vec<u8>) {
    let (min, [_, ny, nz]) = (region.min(), region.size());
    let mut list: Vec<(u32, u8)> = states
        .voxels()
        .map(|(v, state)| {
            let [x, y, z] = [v.x - min.x, v.y - min.y, v.z - min.z].map(|d| d as u32);
            ((x * ny + y) * nz + z, u8::from(state == State::Occupied))
        })
        .collect();
    list.sort_unstable();
    out.reserve(list.len() * ADDRESS_BYTES);
    for (address, state) in list {
        out.extend_from_slice(&address.to_le_bytes());
        out.push(state);
    }
}

/// The inverse of [`encode`].
pub(crate) fn decode(payload: &[u8], region: &VoxelBox) -> Result<Changes, PackageError> {
    let wrong = |rule| PackageError::Payload { codec: Codec::Racer, rule };
    let (entries, rest) = payload.as_chunks::<ADDRESS_BYTES>();
    if !rest.is_empty() {
        return Err(wrong("five bytes for each voxel"));
    }
    let (min, [nx, ny, nz]) = (region.min(), region.size());
    let mut next = 0u32;
    let mut voxels = Vec::with_capacity(entries.len());
    for &[a, b, c, d, state] in entries {
        let address = u32::from_le_bytes([a, b, c, d]);
        let (xy, z) = (address / nz, address % nz);
        let (x, y) = (xy / ny, xy % ny);
        if address < next || x >= nx {
            return Err(wrong("addresses ascend and lie in the box"));
        }
        next = address + 1;
        let state = match state {
            0 => State::Free,
            1 => State::Occupied,
            _ => return Err(wrong("a state is 0 for Free or 1 for Occupied")),
        };
        voxels.push((Voxel::new(min.x + x as i32, min.y + y as i32, min.z + z as i32), state));
    }
    Ok(Changes::from_voxels(voxels))
}
