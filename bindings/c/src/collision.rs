//! Whether bodies collide with what is in the map.

use flockmap_plan::{Collision, QuestionError};

use crate::args::{Args, handle};
use crate::field::obstacles as kind_of;
use crate::result::{Failure, Outcome, guard};
use crate::view::{View, triple};

fn refused(error: QuestionError) -> Failure {
    match error {
        QuestionError::TooLarge { .. } => Failure::new(Outcome::ErrorTooLarge, error),
        _ => Failure::argument(error),
    }
}

/// Whether spheres of a radius meet an obstacle, taken as full cubes, exactly; touching counts.
///
/// `obstacles`: one of flockmap_obstacle_kind. `centres`: `count` times x, y, z, metres in the frame of the map.
/// `collides`: room for `count`, 1 or 0. FLOCKMAP_ERROR_ARGUMENT for a number that is not finite, negative or beyond the
/// grid, FLOCKMAP_ERROR_TOO_LARGE for a sphere that meets more than 2^20 blocks; `collides` is written up to there. Any
/// thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_spheres(
    view: *const View,
    obstacles: i32,
    centres: *const f64,
    count: usize,
    radius_m: f64,
    collides: *mut u8,
) -> Outcome {
    guard("flockmap_view_spheres", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (view, centres, mut to) = unsafe {
            (
                handle(view, "view")?,
                args.rows::<3, f64>(centres, count, "centres")?,
                args.output(collides, count, "collides")?,
            )
        };
        let collision = Collision::new(&view.map, kind_of(obstacles)?);
        for (at, centre) in centres.iter().enumerate() {
            to.set(at, collision.sphere(*centre, radius_m).map_err(refused)?.is_some().into());
        }
        Ok(Outcome::Ok)
    })
}

/// What spheres of a radius meet first on straight ways of their centres.
///
/// `from`, `to`: `count` times x, y, z. `along_m`: room for `count`: metres that the centre has gone by then, 0 if it
/// began in touch, infinity if nothing is in the way. `voxels`: room for `count` times x, y, z, the obstacle, 0 if there
/// is none; null if not wanted. The rest as for flockmap_view_spheres. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_segments(
    view: *const View,
    obstacles: i32,
    from: *const f64,
    to: *const f64,
    count: usize,
    radius_m: f64,
    along_m: *mut f64,
    voxels: *mut i32,
) -> Outcome {
    guard("flockmap_view_segments", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (view, from, to, mut along, mut voxels) = unsafe {
            (
                handle(view, "view")?,
                args.rows::<3, f64>(from, count, "from")?,
                args.rows::<3, f64>(to, count, "to")?,
                args.output(along_m, count, "along_m")?,
                args.rows_wanted::<3, i32>(voxels, count, "voxels")?,
            )
        };
        let collision = Collision::new(&view.map, kind_of(obstacles)?);
        for (at, (from, to)) in from.iter().zip(to).enumerate() {
            let hit = collision.swept_sphere(*from, *to, radius_m).map_err(refused)?;
            along.set(at, hit.map_or(f64::INFINITY, |hit| hit.along_m));
            if let Some(voxels) = &mut voxels {
                voxels.set(at, hit.map_or([0; 3], |hit| triple(hit.voxel)));
            }
        }
        Ok(Outcome::Ok)
    })
}
