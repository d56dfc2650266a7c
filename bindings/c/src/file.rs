//! Maps in files.

use std::ffi::c_char;

use flockmap_core::grid::Changes;
use flockmap_core::{MapView, State};
use flockmap_io::{ExportOptions, export_map, read_map};

use crate::args::{Args, flag, handle, one, text};
use crate::result::{Failure, Outcome, guard};
use crate::view::View;
use crate::voxel::resolution;

/// Writes a map by the ending of the path: .ply or .pcd with the centre of each voxel, or an OctoMap .bt. Equal maps give
/// equal files; a file that is there is replaced.
///
/// `path`: UTF-8, ends with a 0. `with_free` 1: .ply and .pcd hold free voxels too (a .bt always does). `*voxels`: how
/// many were written; may be null. FLOCKMAP_ERROR_FILE says what was wrong with the file. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_save(
    view: *const View,
    path: *const c_char,
    with_free: i32,
    voxels: *mut u64,
) -> Outcome {
    guard("flockmap_view_save", || {
        // SAFETY: the caller's word, as of the header.
        let (view, path, voxels) = unsafe {
            (handle(view, "view")?, text(path, "path")?, Args::default().wanted(voxels, 1, "voxels")?)
        };
        let options = ExportOptions { free: flag(with_free, "with_free")? };
        let written = export_map(path, view.map.resolution(), view.map.voxels(), &options)
            .map_err(|error| Failure::new(Outcome::ErrorFile, error))?;
        if let Some(mut voxels) = voxels {
            voxels.set(0, written);
        }
        Ok(Outcome::Ok)
    })
}

/// Reads a map by the ending of the path: an OctoMap .bt, a .ply or .pcd that flockmap_view_save wrote, or a point cloud
/// (.ply, .pcd, .las, .laz), of which every voxel with a point is Occupied.
///
/// `resolution_m`: side of a voxel of a point cloud; a map has its own. `*view` is to be freed by flockmap_view_free; null
/// on an error. FLOCKMAP_ERROR_FILE names the file, the place in it and what was wrong. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_load(
    path: *const c_char,
    resolution_m: f64,
    view: *mut *mut View,
) -> Outcome {
    guard("flockmap_view_load", || {
        // SAFETY: the caller's word, as of the header.
        let (mut to, path) = unsafe { (one(&mut Args::default(), view, "view")?, text(path, "path")) };
        to.set(0, std::ptr::null_mut());
        let file = read_map(path?, resolution(resolution_m)?)
            .map_err(|error| Failure::new(Outcome::ErrorFile, error))?;
        let known = file.voxels.filter(|(_, state)| *state != State::Unknown);
        let mut map = MapView::new(file.resolution);
        for (index, states) in Changes::from_voxels(known).blocks() {
            map.set_block(*index, states);
        }
        to.set(0, View::boxed(map));
        Ok(Outcome::Ok)
    })
}
