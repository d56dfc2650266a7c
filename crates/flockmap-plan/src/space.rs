//! Which part of a map is asked for, and how much of it may be.

use flockmap_grid::{Resolution, VoxelBox};

/// A box of more cells than a product may have.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error(
    "{what} of {region:?} voxels has {cells} cells, expected at most {max}: take a smaller part of the map"
)]
pub struct TooLarge {
    /// The product.
    pub what: &'static str,
    /// What it was asked for.
    pub region: VoxelBox,
    /// Its cells.
    pub cells: u128,
    /// The limit.
    pub max: u64,
}

impl TooLarge {
    /// Fails if there are more cells than may be.
    pub(crate) fn check(what: &'static str, region: &VoxelBox, cells: u128, max: u64) -> Result<(), Self> {
        let fits = cells <= u128::from(max);
        fits.then_some(()).ok_or(Self { what, region: *region, cells, max })
    }
}

/// The voxels between two corners in metres, in the frame of the map; a voxel of which less than a millionth of its
/// side lies between them does not count. `None` if a corner is not finite, not below the other on an axis, or out
/// of the grid ([`flockmap_grid::VOXEL_LIMIT`]).
pub fn box_between(resolution: Resolution, low_m: [f64; 3], high_m: [f64; 3]) -> Option<VoxelBox> {
    let hair = resolution.metres() * 1e-6;
    let is_below = (0..3).all(|a| low_m[a] + 2.0 * hair < high_m[a]);
    let low = resolution.voxel_at(low_m.map(|v| v + hair))?;
    let high = resolution.voxel_at(high_m.map(|v| v - hair))?;
    VoxelBox::spanning(low, high).filter(|_| is_below)
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::Voxel;

    #[test]
    fn a_box_holds_the_voxels_between_its_corners() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let found = box_between(resolution, [0.1, -0.3, 0.25], [0.3, 0.7, 0.35]).unwrap();
        assert_eq!((found.min(), found.size()), (Voxel::new(1, -3, 2), [2, 10, 2]));
        for (low, high) in [
            ([0.0; 3], [1.0, 1.0, 0.0]),
            ([f64::NAN; 3], [1.0; 3]),
            ([0.0; 3], [f64::INFINITY; 3]),
            ([1.0; 3], [0.0; 3]),
        ] {
            assert_eq!(box_between(resolution, low, high), None);
        }
    }
}
