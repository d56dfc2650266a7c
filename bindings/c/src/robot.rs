//! A robot: what goes in, and what it counts. `transport` has its datagrams.

use std::sync::{Mutex, MutexGuard};

use flockmap_core::{Pose, Robot, RobotId, Scan, ScanReport, Stamp, SubmapId};

use crate::args::{Args, Out, flag, handle, list, one};
use crate::result::{Answer, Failure, Outcome, guard};
use crate::view::View;

/// Most points of a scan, with its rays without a return.
pub const SCAN_POINTS_MAX: usize = 1 << 24;

/// A robot of the swarm. Opaque; any thread may call any function with it at any time, one call at a time is done.
pub struct RobotHandle {
    robot: Mutex<Robot>,
}

impl RobotHandle {
    pub(crate) fn boxed(robot: Robot) -> *mut Self {
        Box::into_raw(Box::new(Self { robot: Mutex::new(robot) }))
    }

    pub(crate) fn lock(&self) -> Result<MutexGuard<'_, Robot>, Failure> {
        self.robot.lock().map_err(|_| Failure::poisoned())
    }
}

/// The robot behind a pointer.
///
/// # Safety
/// As of [`handle`].
pub(crate) unsafe fn lock<'a>(robot: *const RobotHandle) -> Result<MutexGuard<'a, Robot>, Failure> {
    // SAFETY: as of this function.
    unsafe { handle(robot, "robot") }?.lock()
}

/// Frees a robot. Its views stay. Null does nothing. No other thread may use the robot any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_free(robot: *mut RobotHandle) {
    guard("flockmap_robot_free", || {
        if !robot.is_null() {
            // SAFETY: made by Box::into_raw, and the caller's word that it is the last use.
            drop(unsafe { Box::from_raw(robot) });
        }
        Ok(Outcome::Ok)
    });
}

/// What became of a scan, or of an update with states.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct Report {
    /// Rays that ended with a hit.
    pub hits: usize,
    /// Rays that were cut, or came back with nothing: they carve free space only.
    pub cut: usize,
    /// Points that were ignored: not finite, too near, or too far out.
    pub ignored: usize,
    /// Points that were ignored since they lie on a team-mate.
    pub masked: usize,
    /// Voxels that are Free or Occupied now and were not before.
    pub changed: usize,
    /// Blocks that were forgotten under map_bytes_max.
    pub forgotten: usize,
}

impl Report {
    pub(crate) fn of(report: &ScanReport) -> Self {
        Self {
            hits: report.hits,
            cut: report.cut,
            ignored: report.ignored,
            masked: report.masked,
            changed: report.changed.iter().map(|(_, states)| states.known_count() as usize).sum(),
            forgotten: report.forgotten.len(),
        }
    }

    pub(crate) fn write(self, out: Option<Out<'_, Self>>) -> Answer {
        if let Some(mut out) = out {
            out.set(0, self);
        }
        Ok(Outcome::Ok)
    }
}

/// A pose of 4 × 4 numbers, row by row.
#[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
pub(crate) fn pose(T: &[f64], what: &str) -> Result<Pose, Failure> {
    let wrong = |why: &str| Failure::argument(format_args!("{what} is no pose: {why}: {T:?}"));
    let (rows, last) = T.split_first_chunk::<12>().ok_or_else(|| wrong("it has no 16 numbers"))?;
    if !T.iter().all(|v| v.is_finite()) {
        return Err(wrong("a number is not finite"));
    }
    if last != [0.0, 0.0, 0.0, 1.0] {
        return Err(wrong("the last row is not 0 0 0 1; is the matrix column by column?"));
    }
    Pose::from_rows(*rows).ok_or_else(|| wrong("its upper left 3 x 3 is no rotation"))
}

/// Takes in a scan. It is mapped before this returns; datagrams of it come with the next flockmap_robot_handle_timeout
/// that is due.
///
/// `now_us`: the time on the robot's clock; `stamp_us`: when the scan was made, on the same clock, in microseconds. A
/// stamp ahead of `now_us` counts as now. `points`: `point_count` times x, y, z in metres, in the frame of the sensor;
/// points that are not finite are ignored and counted. `no_returns`: rays that came back with nothing, a point far out
/// along each; null with 0 if there are none. At most 2^24 of both. `T_map_sensor`: 16 numbers, row by row, the pose
/// of the sensor in the map. `report` may be null.
///
/// Buffers are read and not kept. What is wrong (FLOCKMAP_ERROR_NULL, FLOCKMAP_ERROR_ARGUMENT for a pose that is none
/// or beyond the grid, FLOCKMAP_ERROR_TOO_LARGE) changes nothing. Any thread.
#[unsafe(no_mangle)]
#[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
pub unsafe extern "C" fn flockmap_robot_insert_scan(
    robot: *mut RobotHandle,
    now_us: i64,
    stamp_us: i64,
    points: *const f32,
    point_count: usize,
    no_returns: *const f32,
    no_return_count: usize,
    T_map_sensor: *const f64,
    report: *mut Report,
) -> Outcome {
    guard("flockmap_robot_insert_scan", || {
        // Before anything of such a length is looked at.
        let rays = point_count.saturating_add(no_return_count);
        if rays > SCAN_POINTS_MAX {
            let text = format!("{rays} points and rays, expected at most {SCAN_POINTS_MAX} in a scan");
            return Err(Failure::new(Outcome::ErrorTooLarge, text));
        }
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (robot, points, no_returns, numbers, report) = unsafe {
            (
                handle(robot, "robot")?,
                args.rows::<3, f32>(points, point_count, "points")?,
                args.rows::<3, f32>(no_returns, no_return_count, "no_returns")?,
                args.input(T_map_sensor, 16, "T_map_sensor")?,
                args.wanted(report, 1, "report")?,
            )
        };
        let pose = pose(numbers, "T_map_sensor")?;
        let scan = Scan { stamp: Stamp(stamp_us), points: points.to_vec(), no_returns: no_returns.to_vec() };
        let made = robot.lock()?.insert_scan(Stamp(now_us), &scan, &pose);
        Report::of(&made.map_err(Failure::argument)?).write(report)
    })
}

/// Says how a robot's frame lies in this one's: 16 numbers, row by row, which take a point in the frame of `origin` to
/// this robot's. May change at any time. The map stays as it is until it has been made by the new one, a part with each
/// call of flockmap_robot_handle_timeout, which is due until then. FLOCKMAP_ERROR_ARGUMENT if it is no pose; the one
/// before is kept then. Any thread.
#[unsafe(no_mangle)]
#[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
pub unsafe extern "C" fn flockmap_robot_set_alignment(
    robot: *mut RobotHandle,
    origin: u16,
    T_own_origin: *const f64,
) -> Outcome {
    guard("flockmap_robot_set_alignment", || {
        // SAFETY: the caller's word, as of the header.
        let (robot, numbers) =
            unsafe { (handle(robot, "robot")?, Args::default().input(T_own_origin, 16, "T_own_origin")?) };
        let pose = pose(numbers, "T_own_origin")?;
        robot.lock()?.set_alignment(RobotId(origin), &pose).map_err(Failure::argument)?;
        Ok(Outcome::Ok)
    })
}

/// Begins the next submap of this run: what is seen from now on moves with it. `*submap`: its number; null: not wanted.
/// FLOCKMAP_ERROR_ARGUMENT after 4,096 submaps; the last one goes on then. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_begin_submap(
    robot: *mut RobotHandle,
    now_us: i64,
    submap: *mut u16,
) -> Outcome {
    guard("flockmap_robot_begin_submap", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (robot, out) = unsafe { (handle(robot, "robot")?, args.wanted(submap, 1, "submap")?) };
        let begun = robot.lock()?.begin_submap(Stamp(now_us)).map_err(Failure::argument)?;
        if let Some(mut out) = out {
            out.set(0, begun.number());
        }
        Ok(Outcome::Ok)
    })
}

/// Says how a submap of this run lies in the map now, as after a closed loop: what all robots know of it moves there, and
/// nothing of it is sent again. 16 numbers, row by row: the correction of what was given as `T_map_sensor` while the
/// submap was written. Rounded to a tenth of a millimetre. Comes into force as an alignment does.
/// FLOCKMAP_ERROR_ARGUMENT if the submap has not begun, or it is no pose; the one before is kept then. Any thread.
#[unsafe(no_mangle)]
#[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
pub unsafe extern "C" fn flockmap_robot_set_submap_pose(
    robot: *mut RobotHandle,
    now_us: i64,
    submap: u16,
    T_map_submap: *const f64,
) -> Outcome {
    guard("flockmap_robot_set_submap_pose", || {
        // SAFETY: the caller's word, as of the header.
        let (robot, numbers) =
            unsafe { (handle(robot, "robot")?, Args::default().input(T_map_submap, 16, "T_map_submap")?) };
        let pose = pose(numbers, "T_map_submap")?;
        let submap = SubmapId::new(submap).ok_or_else(|| {
            Failure::argument(format!("submap is {submap}, expected 0 to {}", SubmapId::COUNT - 1))
        })?;
        robot.lock()?.set_submap_pose(Stamp(now_us), submap, &pose).map_err(Failure::argument)?;
        Ok(Outcome::Ok)
    })
}

/// Says how far a robot's clock is ahead of this one's, in microseconds; used in place of what is measured.
/// `is_measured` 1: measure again, `ahead_us` is not used; else 0. Comes into force as an alignment does. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_set_clock_offset(
    robot: *mut RobotHandle,
    origin: u16,
    ahead_us: i64,
    is_measured: i32,
) -> Outcome {
    guard("flockmap_robot_set_clock_offset", || {
        let micros = (!flag(is_measured, "is_measured")?).then_some(ahead_us);
        // SAFETY: the caller's word, as of the header.
        unsafe { lock(robot) }?.set_clock_offset(RobotId(origin), micros);
        Ok(Outcome::Ok)
    })
}

/// Leaves what a robot observed out of the fused map (`is_muted` 1), or takes it in again (0). Comes into force as an
/// alignment does. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_set_muted(
    robot: *mut RobotHandle,
    origin: u16,
    is_muted: i32,
) -> Outcome {
    guard("flockmap_robot_set_muted", || {
        let is_muted = flag(is_muted, "is_muted")?;
        // SAFETY: the caller's word, as of the header.
        unsafe { lock(robot) }?.set_muted(RobotId(origin), is_muted);
        Ok(Outcome::Ok)
    })
}

/// Says where a team-mate is, so that it is not taken for an obstacle: 3 numbers, metres in the frame of the own map;
/// `seen_us` on the own clock. Positions of at most 1,024 robots are kept. FLOCKMAP_ERROR_ARGUMENT if it is no position;
/// the one before is kept then. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_set_teammate(
    robot: *mut RobotHandle,
    id: u16,
    position_m: *const f64,
    seen_us: i64,
) -> Outcome {
    guard("flockmap_robot_set_teammate", || {
        // SAFETY: the caller's word, as of the header.
        let (robot, at) =
            unsafe { (handle(robot, "robot")?, Args::default().input(position_m, 3, "position_m")?) };
        let at = [at[0], at[1], at[2]];
        robot.lock()?.set_teammate(RobotId(id), at, Stamp(seen_us)).map_err(Failure::argument)?;
        Ok(Outcome::Ok)
    })
}

/// The fused map at this moment: what any robot has seen, in the own frame. O(1).
///
/// `*view` stays as it is while the robot goes on, and outlives it; free it by flockmap_view_free; null on an error.
/// While a view lives, what changes in the map is copied once, region by region, so do not keep many. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_view(robot: *const RobotHandle, view: *mut *mut View) -> Outcome {
    guard("flockmap_robot_view", || {
        // SAFETY: the caller's word, as of the header.
        let mut to = unsafe { one(&mut Args::default(), view, "view") }?;
        to.set(0, std::ptr::null_mut());
        // SAFETY: the same.
        to.set(0, View::boxed(unsafe { lock(robot) }?.view()));
        Ok(Outcome::Ok)
    })
}

/// What one run of one robot has said so far.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Layer {
    /// Number of the run.
    pub epoch: u64,
    /// A number that two robots share for a stream when they hold the same of it.
    pub digest: u64,
    /// Newest stamp of what it says, on the own clock; the lowest number if it says nothing.
    pub newest_us: i64,
    /// Voxels of it that are known.
    pub voxels: usize,
    /// Id of the robot.
    pub origin: u16,
}

/// What of the other robots, and of the own published changes, has come in: one layer for each run of each robot, the
/// own one among them. Robots whose layers have the same digests hold the same. O(voxels).
///
/// `layers`: room for `capacity`. `*count`: how many there are; with a capacity of 0 that is all that is asked for,
/// with too little room it is FLOCKMAP_ERROR_BUFFER. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_layers(
    robot: *const RobotHandle,
    layers: *mut Layer,
    capacity: usize,
    count: *mut usize,
) -> Outcome {
    guard("flockmap_robot_layers", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (robot, out, count) = unsafe {
            (
                handle(robot, "robot")?,
                args.output(layers, capacity, "layers")?,
                one(&mut args, count, "count")?,
            )
        };
        let robot = robot.lock()?;
        let found = robot.fusion().layers().map(|(stream, layer)| Layer {
            epoch: stream.epoch,
            digest: layer.digest(),
            newest_us: layer.newest().map_or(i64::MIN, |newest| newest.0),
            voxels: layer.len(),
            origin: stream.origin.0,
        });
        #[expect(clippy::needless_collect, reason = "how many there are is said first")]
        let found: Vec<Layer> = found.collect();
        list(out, count, found.into_iter(), "layers")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_core::{Resolution, RobotConfig};
    use std::ptr::null_mut;

    #[test]
    fn a_panic_within_poisons_the_robot_and_nothing_else() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let config = RobotConfig::new(RobotId(1), resolution, 7.0);
        let robot = RobotHandle::boxed(Robot::new(config, Stamp(0)).unwrap());
        let mut view = null_mut();
        // SAFETY: handles that live until they are freed.
        unsafe {
            assert_eq!(flockmap_robot_view(robot, &mut view), Outcome::Ok);
            let failed = guard("f", || {
                let _held = lock(robot)?;
                panic!("within")
            });
            assert_eq!(failed, Outcome::ErrorInternal);
            assert_eq!(flockmap_robot_set_muted(robot, 2, 1), Outcome::ErrorPoisoned);
            let mut state = 9;
            let point = [0.0; 3];
            assert_eq!(crate::flockmap_view_states(view, point.as_ptr(), 1, &mut state), Outcome::Ok);
            assert_eq!(state, 0);
            flockmap_robot_free(robot);
            crate::flockmap_view_free(view);
        }
    }

    #[test]
    fn a_pose_of_kilometres_and_a_turn_is_one_and_a_mirror_image_is_none() {
        let mut turned = [0.0, -1.0, 0.0, 5e3, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let [x, ..] = pose(&turned, "T").ok().unwrap().transform([0.0, 1.0, 0.0]);
        assert!((x - (5e3 - 1.0)).abs() < 1e-9);
        turned[10] = -1.0;
        assert!(pose(&turned, "T").is_err());
    }
}
