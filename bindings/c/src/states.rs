//! States of voxels from a mapper elsewhere, in place of scans.

use flockmap_core::{Stamp, State, States, StatesError, StatesUpdate, Voxel, VoxelBox};

use crate::args::{Args, flag, handle};
use crate::result::{Failure, Outcome, guard};
use crate::robot::{Report, RobotHandle};
use crate::voxel::{resolution, state_of};

fn refused(error: StatesError) -> Failure {
    match error {
        StatesError::TooMany { .. } => Failure::new(Outcome::ErrorTooLarge, error),
        _ => Failure::argument(error),
    }
}

fn place(sensor: &[f64]) -> Option<[f64; 3]> {
    sensor.try_into().ok()
}

/// Takes in the states of single voxels, such as the changed keys of an octree. All of them count as observed.
///
/// Stamps as in flockmap_robot_insert_scan. `resolution_m` must be the robot's: states are not resampled. `sensor_m`:
/// where the sensor was, 3 numbers in metres in the frame of the map; null if nobody knows, which costs more bytes on
/// the radio. `voxels`: `count` times x, y, z, the index of a voxel: floor(position / resolution). `states`: as many of
/// flockmap_voxel_state. At most 2^22. Of two for one voxel the later wins. `report` may be null. Buffers are not kept;
/// an error changes nothing. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_insert_states(
    robot: *mut RobotHandle,
    now_us: i64,
    stamp_us: i64,
    resolution_m: f64,
    sensor_m: *const f64,
    voxels: *const i32,
    states: *const u8,
    count: usize,
    report: *mut Report,
) -> Outcome {
    guard("flockmap_robot_insert_states", || {
        if count > StatesUpdate::VOXELS_MAX {
            return Err(refused(StatesError::TooMany { got: count as u128, max: StatesUpdate::VOXELS_MAX }));
        }
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (robot, sensor, voxels, states, report) = unsafe {
            (
                handle(robot, "robot")?,
                args.input(sensor_m, if sensor_m.is_null() { 0 } else { 3 }, "sensor_m")?,
                args.rows::<3, i32>(voxels, count, "voxels")?,
                args.input(states, count, "states")?,
                args.wanted(report, 1, "report")?,
            )
        };
        let resolution = resolution(resolution_m)?;
        let pairs = voxels.iter().zip(states).enumerate();
        let pair = |(at, (&[x, y, z], &byte)): (usize, (&[i32; 3], &u8))| {
            Ok((Voxel::new(x, y, z), state_of(at, byte)?))
        };
        let pairs: Vec<(Voxel, State)> = pairs.map(pair).collect::<Result<_, Failure>>()?;
        let update = StatesUpdate {
            stamp: Stamp(stamp_us),
            resolution,
            sensor: place(sensor),
            states: States::Voxels(&pairs),
        };
        let made = robot.lock()?.insert_states(Stamp(now_us), &update).map_err(refused)?;
        Report::of(&made).write(report)
    })
}

/// Takes in all voxels of a box, such as the local map of another mapper. Only voxels whose state differs count as
/// observed.
///
/// As flockmap_robot_insert_states, but: `low`, 3 numbers: the index of the lowest voxel. `size`, 3 numbers: voxels
/// along x, y, z, 1 or more. `states`: `state_count` of them, which must be size[0] * size[1] * size[2], x fastest,
/// then y, then z. At most 2^25. `clear_unknown` 1: Unknown takes back what the robot itself knew; 0: it leaves it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_insert_box(
    robot: *mut RobotHandle,
    now_us: i64,
    stamp_us: i64,
    resolution_m: f64,
    sensor_m: *const f64,
    low: *const i32,
    size: *const u32,
    states: *const u8,
    state_count: usize,
    clear_unknown: i32,
    report: *mut Report,
) -> Outcome {
    guard("flockmap_robot_insert_box", || {
        if state_count > StatesUpdate::BOX_VOXELS_MAX {
            let max = StatesUpdate::BOX_VOXELS_MAX;
            return Err(refused(StatesError::TooMany { got: state_count as u128, max }));
        }
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (robot, sensor, low, size, states, report) = unsafe {
            (
                handle(robot, "robot")?,
                args.input(sensor_m, if sensor_m.is_null() { 0 } else { 3 }, "sensor_m")?,
                args.input(low, 3, "low")?,
                args.input(size, 3, "size")?,
                args.input(states, state_count, "states")?,
                args.wanted(report, 1, "report")?,
            )
        };
        let (resolution, clear_unknown) = (resolution(resolution_m)?, flag(clear_unknown, "clear_unknown")?);
        let region = VoxelBox::new(Voxel::new(low[0], low[1], low[2]), [size[0], size[1], size[2]]);
        let region = region.ok_or_else(|| {
            Failure::argument(format_args!(
                "low {low:?}, size {size:?} is no box: a size is 0, or it leaves the grid"
            ))
        })?;
        if region.volume() != state_count as u128 {
            return Err(refused(StatesError::BoxStates { got: state_count, region }));
        }
        let states = states.iter().enumerate().map(|(at, byte)| state_of(at, *byte));
        let states: Vec<State> = states.collect::<Result<_, Failure>>()?;
        let update = StatesUpdate {
            stamp: Stamp(stamp_us),
            resolution,
            sensor: place(sensor),
            states: States::Box { region, states: &states, clear_unknown },
        };
        let made = robot.lock()?.insert_states(Stamp(now_us), &update).map_err(refused)?;
        Report::of(&made).write(report)
    })
}
