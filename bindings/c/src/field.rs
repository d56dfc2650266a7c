//! Distance fields.

use std::sync::{RwLock, RwLockReadGuard, RwLockWriteGuard};

use flockmap_plan::{DistanceField, FieldConfig, FieldError, Obstacles, Updated};

use crate::args::{Args, handle, one};
use crate::result::{Failure, Outcome, guard};
use crate::view::{Box3, View};

/// Which voxels are obstacles.
#[repr(i32)]
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum ObstacleKind {
    /// What was seen to be Occupied. Unknown counts as free.
    Occupied = 0,
    /// Whatever was not seen to be Free: Occupied and Unknown.
    NotFree = 1,
}

pub(crate) fn obstacles(value: i32) -> Result<Obstacles, Failure> {
    match value {
        0 => Ok(Obstacles::Occupied),
        1 => Ok(Obstacles::NotFree),
        _ => Err(Failure::argument(format_args!(
            "obstacles is {value}, expected a flockmap_obstacle_kind, 0 or 1"
        ))),
    }
}

/// What flockmap_field_update did.
#[repr(i32)]
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum UpdateKind {
    /// Nothing: no block of the box had changed.
    Unchanged = 0,
    /// What depends on the blocks that had changed.
    Partly = 1,
    /// All of it.
    Anew = 2,
}

/// How far the nearest obstacle of a box is, from centre to centre, for each voxel of it. Obstacles outside of the box do
/// not count. Opaque; any thread may call any function with it: questions go on at the same time, updates alone.
pub struct Field {
    field: RwLock<DistanceField>,
}

impl Field {
    fn read(&self) -> Result<RwLockReadGuard<'_, DistanceField>, Failure> {
        self.field.read().map_err(|_| Failure::poisoned())
    }

    fn write(&self) -> Result<RwLockWriteGuard<'_, DistanceField>, Failure> {
        self.field.write().map_err(|_| Failure::poisoned())
    }
}

fn refused(error: FieldError) -> Failure {
    Failure::new(Outcome::ErrorTooLarge, error)
}

/// Makes the field of a box. `obstacles`: one of flockmap_obstacle_kind. `memory_max`: bytes that it may take, 6 to 12
/// for each voxel; 0: 256 MiB. FLOCKMAP_ERROR_TOO_LARGE if it would take more, or if the box is longer than 4,096 voxels
/// from corner to corner. `*field` is to be freed by flockmap_field_free; null on an error. The view is not kept. Any
/// thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_field_new(
    view: *const View,
    region: *const Box3,
    obstacles: i32,
    memory_max: u64,
    field: *mut *mut Field,
) -> Outcome {
    guard("flockmap_field_new", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let mut to = unsafe { one(&mut args, field, "field") }?;
        to.set(0, std::ptr::null_mut());
        // SAFETY: the same.
        let (view, region) = unsafe { (handle(view, "view")?, args.input(region, 1, "region")?) };
        let obstacles = self::obstacles(obstacles)?;
        let default = FieldConfig::default().memory_max;
        let config =
            FieldConfig { obstacles, memory_max: if memory_max == 0 { default } else { memory_max } };
        let made = DistanceField::new(&view.map, region[0].region()?, &config).map_err(refused)?;
        to.set(0, Box::into_raw(Box::new(Field { field: RwLock::new(made) })));
        Ok(Outcome::Ok)
    })
}

/// Frees a field. Null does nothing. No other thread may use it any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_field_free(field: *mut Field) {
    guard("flockmap_field_free", || {
        if !field.is_null() {
            // SAFETY: made by Box::into_raw, and the caller's word that it is the last use.
            drop(unsafe { Box::from_raw(field) });
        }
        Ok(Outcome::Ok)
    });
}

/// Brings a field to a newer view of the same map; what did not change is not looked at. `did`: one of
/// flockmap_update_kind; may be null. A view of another map makes nonsense: use flockmap_field_move_to. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_field_update(
    field: *mut Field,
    view: *const View,
    did: *mut i32,
) -> Outcome {
    guard("flockmap_field_update", || {
        // SAFETY: the caller's word, as of the header.
        let (field, view, did) = unsafe {
            (handle(field, "field")?, handle(view, "view")?, Args::default().wanted(did, 1, "did")?)
        };
        let updated = match field.write()?.update(&view.map) {
            Updated::Unchanged => UpdateKind::Unchanged,
            Updated::Partly => UpdateKind::Partly,
            Updated::Anew => UpdateKind::Anew,
        };
        if let Some(mut did) = did {
            did.set(0, updated as i32);
        }
        Ok(Outcome::Ok)
    })
}

/// Makes the field of another box or another map, in the memory of this one: for a box that goes with the robot. On
/// FLOCKMAP_ERROR_TOO_LARGE it stays as it is. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_field_move_to(
    field: *mut Field,
    view: *const View,
    region: *const Box3,
) -> Outcome {
    guard("flockmap_field_move_to", || {
        // SAFETY: the caller's word, as of the header.
        let (field, view, region) = unsafe {
            (handle(field, "field")?, handle(view, "view")?, Args::default().input(region, 1, "region")?)
        };
        field.write()?.move_to(&view.map, region[0].region()?).map_err(refused)?;
        Ok(Outcome::Ok)
    })
}

/// The box of a field. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_field_box(field: *const Field, region: *mut Box3) -> Outcome {
    guard("flockmap_field_box", || {
        // SAFETY: the caller's word, as of the header.
        let (field, mut to) =
            unsafe { (handle(field, "field")?, one(&mut Args::default(), region, "region")?) };
        to.set(0, Box3::of(&field.read()?.region()));
        Ok(Outcome::Ok)
    })
}

/// Distances at many points, trilinear between the centres of voxels. `points`: `count` times x, y, z, metres in the frame
/// of the map. `distances_m`: room for `count`; infinity where the box has no obstacle, NaN outside of the box.
/// `gradients`: room for `count` times x, y, z, metres of distance gained by a metre; null if not wanted. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_field_at(
    field: *const Field,
    points: *const f64,
    count: usize,
    distances_m: *mut f64,
    gradients: *mut f64,
) -> Outcome {
    guard("flockmap_field_at", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (field, points, mut distances, mut gradients) = unsafe {
            (
                handle(field, "field")?,
                args.rows::<3, f64>(points, count, "points")?,
                args.output(distances_m, count, "distances_m")?,
                args.rows_wanted::<3, f64>(gradients, count, "gradients")?,
            )
        };
        let field = field.read()?;
        for (at, point) in points.iter().enumerate() {
            let found = field.at(*point);
            distances.set(at, found.map_or(f64::NAN, |near| near.distance_m));
            if let Some(gradients) = &mut gradients {
                gradients.set(at, found.map_or([f64::NAN; 3], |near| near.gradient));
            }
        }
        Ok(Outcome::Ok)
    })
}

/// Whether the spheres of a radius about many points surely keep clear of every obstacle of the box, taken as full cubes;
/// some that just pass are 0. `centres`: `count` times x, y, z. `clear`: room for `count`, 1 or 0; 0 outside of the box.
/// FLOCKMAP_ERROR_ARGUMENT if the radius is negative or not finite. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_field_are_clear(
    field: *const Field,
    centres: *const f64,
    count: usize,
    radius_m: f64,
    clear: *mut u8,
) -> Outcome {
    guard("flockmap_field_are_clear", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (field, centres, mut to) = unsafe {
            (
                handle(field, "field")?,
                args.rows::<3, f64>(centres, count, "centres")?,
                args.output(clear, count, "clear")?,
            )
        };
        length(radius_m, "radius_m")?;
        let field = field.read()?;
        for (at, centre) in centres.iter().enumerate() {
            let mut is_clear = [false];
            field.are_clear(&[*centre], radius_m, &mut is_clear);
            to.set(at, is_clear[0].into());
        }
        Ok(Outcome::Ok)
    })
}

/// All distances in metres, at the centres of the voxels of the box: x fastest, then y, then z; infinity where the box has
/// no obstacle. `distances_m`: room for `capacity`, which must be the number of voxels of the box, else it is
/// FLOCKMAP_ERROR_ARGUMENT. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_field_array(
    field: *const Field,
    distances_m: *mut f32,
    capacity: usize,
) -> Outcome {
    guard("flockmap_field_array", || {
        // SAFETY: the caller's word, as of the header.
        let (field, mut to) = unsafe {
            (handle(field, "field")?, Args::default().output(distances_m, capacity, "distances_m")?)
        };
        let field = field.read()?;
        let region = field.region();
        if region.volume() != capacity as u128 {
            return Err(Failure::argument(format_args!(
                "room for {capacity}, expected {} for {region:?}",
                region.volume()
            )));
        }
        let (low, high) = (region.min(), region.max());
        let cells = (low.z..=high.z).flat_map(|z| {
            (low.y..=high.y)
                .flat_map(move |y| (low.x..=high.x).map(move |x| flockmap_core::Voxel::new(x, y, z)))
        });
        to.fill(cells.map(|voxel| field.distance(voxel).unwrap_or(f64::NAN) as f32));
        Ok(Outcome::Ok)
    })
}

/// A length that can be one.
pub(crate) fn length(metres: f64, what: &str) -> Result<(), Failure> {
    if metres.is_finite() && metres >= 0.0 {
        return Ok(());
    }
    Err(Failure::argument(format_args!("{what} is {metres}, expected finite metres, 0 or more")))
}
