//! Where the known meets the unknown.

use flockmap_plan::{Frontier, FrontierConfig, frontiers};

use crate::args::{Args, handle, list, one};
use crate::field::length;
use crate::result::{Failure, Outcome, guard};
use crate::view::{Box3, View, triple};

/// The frontiers of a box. Opaque and never changed: any number of threads may ask it at once.
pub struct Frontiers {
    found: Vec<Frontier>,
}

/// One frontier: Free voxels beside Unknown ones, near each other.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct FrontierInfo {
    /// The middle of the centres of its voxels in metres, in the frame of the map.
    pub centroid_m: [f64; 3],
    /// Voxels of it.
    pub voxels: usize,
    /// The smallest box that holds them.
    pub bounds: Box3,
}

/// Looks for the frontiers of a box. `reach_m`: one reaches no further than this from its first voxel (1.5 is usual).
/// `voxels_min`: fewer are none (6 is usual). FLOCKMAP_ERROR_TOO_LARGE above 2^28 voxels. `*found` is to be freed by
/// flockmap_frontiers_free; null on an error. The view is not kept. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_frontiers_new(
    view: *const View,
    region: *const Box3,
    reach_m: f64,
    voxels_min: usize,
    found: *mut *mut Frontiers,
) -> Outcome {
    guard("flockmap_frontiers_new", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let mut to = unsafe { one(&mut args, found, "found") }?;
        to.set(0, std::ptr::null_mut());
        // SAFETY: the same.
        let (view, region) = unsafe { (handle(view, "view")?, args.input(region, 1, "region")?) };
        length(reach_m, "reach_m")?;
        let config = FrontierConfig { reach_m, cells_min: voxels_min };
        let found = frontiers(&view.map, &region[0].region()?, &config)
            .map_err(|error| Failure::new(Outcome::ErrorTooLarge, error))?;
        to.set(0, Box::into_raw(Box::new(Frontiers { found })));
        Ok(Outcome::Ok)
    })
}

/// Frees frontiers. Null does nothing. No other thread may use them any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_frontiers_free(found: *mut Frontiers) {
    guard("flockmap_frontiers_free", || {
        if !found.is_null() {
            // SAFETY: made by Box::into_raw, and the caller's word that it is the last use.
            drop(unsafe { Box::from_raw(found) });
        }
        Ok(Outcome::Ok)
    });
}

/// `*count`: how many were found. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_frontiers_count(found: *const Frontiers, count: *mut usize) -> Outcome {
    guard("flockmap_frontiers_count", || {
        // SAFETY: the caller's word, as of the header.
        let (found, mut to) =
            unsafe { (handle(found, "found")?, one(&mut Args::default(), count, "count")?) };
        to.set(0, found.found.len());
        Ok(Outcome::Ok)
    })
}

/// One of them, by their order along z, y, x. FLOCKMAP_ERROR_ARGUMENT if there are not so many. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_frontiers_get(
    found: *const Frontiers,
    at: usize,
    frontier: *mut FrontierInfo,
) -> Outcome {
    guard("flockmap_frontiers_get", || {
        // SAFETY: the caller's word, as of the header.
        let (found, mut to) =
            unsafe { (handle(found, "found")?, one(&mut Args::default(), frontier, "frontier")?) };
        let frontier = found.at(at)?;
        to.set(
            0,
            FrontierInfo {
                centroid_m: frontier.centroid_m,
                voxels: frontier.voxels.len(),
                bounds: Box3::of(&frontier.bounds),
            },
        );
        Ok(Outcome::Ok)
    })
}

/// Its voxels, 3 numbers each. `voxels`, `capacity` and `count` as for flockmap_view_voxels. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_frontiers_voxels(
    found: *const Frontiers,
    at: usize,
    voxels: *mut i32,
    capacity: usize,
    count: *mut usize,
) -> Outcome {
    guard("flockmap_frontiers_voxels", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (found, out, count) = unsafe {
            (
                handle(found, "found")?,
                args.rows_out::<3, i32>(voxels, capacity, "voxels")?,
                one(&mut args, count, "count")?,
            )
        };
        list(out, count, found.at(at)?.voxels.iter().map(|voxel| triple(*voxel)), "voxels")
    })
}

impl Frontiers {
    fn at(&self, at: usize) -> Result<&Frontier, Failure> {
        let count = self.found.len();
        let none = || {
            Failure::argument(format_args!(
                "there is no frontier {at}, they are counted from 0 to less than {count}"
            ))
        };
        self.found.get(at).ok_or_else(none)
    }
}
