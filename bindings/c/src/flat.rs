//! What planners in two dimensions want: an occupancy grid of a band of heights, and a height map.

use flockmap_plan::{ColumnRule, HeightMap, OccupancyGrid, TooLarge};

use crate::args::{Args, handle};
use crate::result::{Failure, Outcome, guard};
use crate::view::{Box3, View};

/// When a cell of an occupancy grid is Free, of whose column no voxel is Occupied.
#[repr(i32)]
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum ColumnKind {
    /// At least one voxel of its column is Free, as octomap_server projects.
    AnyFree = 0,
    /// Every voxel of its column is Free: for a robot that fills the band.
    AllFree = 1,
}

fn refused(error: TooLarge) -> Failure {
    Failure::new(Outcome::ErrorTooLarge, error)
}

fn check_room(what: &str, room: usize, region: &Box3) -> Result<(), Failure> {
    let cells = u128::from(region.size[0]) * u128::from(region.size[1]);
    if room as u128 == cells {
        return Ok(());
    }
    let [x, y, _] = region.size;
    Err(Failure::argument(format_args!("{what}: room for {room} cells, expected {x} x {y}")))
}

/// The columns of a box as an occupancy grid.
///
/// `rule`: one of flockmap_column_kind. `cells`: room for `capacity`, which must be size[0] * size[1] of the box, else it is
/// FLOCKMAP_ERROR_ARGUMENT; row by row from the lowest y, x fastest; 0 free, 100 occupied, -1 unknown, as
/// nav_msgs/OccupancyGrid has them. FLOCKMAP_ERROR_TOO_LARGE above 2^26 cells. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_occupancy_grid(
    view: *const View,
    band: *const Box3,
    rule: i32,
    cells: *mut i8,
    capacity: usize,
) -> Outcome {
    guard("flockmap_view_occupancy_grid", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (view, band, mut to) = unsafe {
            (handle(view, "view")?, &args.input(band, 1, "band")?[0], args.output(cells, capacity, "cells")?)
        };
        let rule = match rule {
            0 => ColumnRule::AnyFree,
            1 => ColumnRule::AllFree,
            _ => {
                return Err(Failure::argument(format_args!(
                    "rule is {rule}, expected a flockmap_column_kind, 0 or 1"
                )));
            }
        };
        let region = band.region()?;
        check_room("cells", capacity, band)?;
        to.fill(OccupancyGrid::new(&view.map, &region, rule).map_err(refused)?.to_ros());
        Ok(Outcome::Ok)
    })
}

/// The lowest and the highest obstacle of each column of a box, in metres in the frame of the map.
///
/// `bottoms_m`: the lower face of the lowest Occupied voxel; `tops_m`: the upper face of the highest; NaN where there is
/// none. Either may be null. Room for `capacity` each, and order, as for flockmap_view_occupancy_grid.
/// FLOCKMAP_ERROR_TOO_LARGE above 2^24 cells. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_height_map(
    view: *const View,
    region: *const Box3,
    bottoms_m: *mut f32,
    tops_m: *mut f32,
    capacity: usize,
) -> Outcome {
    guard("flockmap_view_height_map", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (view, columns, bottoms, tops) = unsafe {
            (
                handle(view, "view")?,
                &args.input(region, 1, "region")?[0],
                args.wanted(bottoms_m, capacity, "bottoms_m")?,
                args.wanted(tops_m, capacity, "tops_m")?,
            )
        };
        let region = columns.region()?;
        check_room("bottoms_m and tops_m", capacity, columns)?;
        let heights = HeightMap::new(&view.map, &region).map_err(refused)?;
        if let Some(mut bottoms) = bottoms {
            bottoms.fill(heights.bottoms_m());
        }
        if let Some(mut tops) = tops {
            tops.fill(heights.tops_m());
        }
        Ok(Outcome::Ok)
    })
}
