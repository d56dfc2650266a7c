//! Bytes as a sequence of calls of the C API, with arguments: nulls, lengths, numbers, poses, enums, boxes, texts and
//! datagrams as they come. Buffers are as long as their lengths say, and no handle is used after it was freed; all else may
//! be anything. No call may crash, or say that the library is at fault.
//!
//! Not called: save and load, whose files the fuzzers of the readers have.
#![no_main]

use std::ffi::{CStr, CString};
use std::ptr::{null, null_mut};

use flockmap::*;
use libfuzzer_sys::fuzz_target;

/// Handles at once, so that memory stays small.
const HANDLES_MAX: usize = 4;
/// Calls of one run.
const CALLS_MAX: usize = 128;

/// The bytes, taken from the front. When they are used up all is 0.
struct Input<'a> {
    bytes: &'a [u8],
}

impl Input<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let mut taken = [0; N];
        let (front, rest) = self.bytes.split_at(N.min(self.bytes.len()));
        taken[..front.len()].copy_from_slice(front);
        self.bytes = rest;
        taken
    }

    fn byte(&mut self) -> u8 {
        self.take::<1>()[0]
    }

    /// Mostly small, sometimes anything.
    fn int(&mut self) -> i32 {
        match self.byte() {
            255 => i32::from_le_bytes(self.take()),
            254 => i32::MAX,
            253 => i32::MIN,
            small => i32::from(small as i8),
        }
    }

    /// Mostly some metres, sometimes any bits.
    fn metres(&mut self) -> f64 {
        match self.byte() {
            255 => f64::from_le_bytes(self.take()),
            254 => f64::NAN,
            253 => f64::INFINITY,
            252 => -1e300,
            _ => f64::from(i16::from_le_bytes(self.take())) / 1024.0,
        }
    }

    fn stamp(&mut self) -> i64 {
        match self.byte() {
            255 => i64::from_le_bytes(self.take()),
            step => i64::from(step) * 50_000,
        }
    }

    fn count(&mut self) -> usize {
        usize::from(self.byte() % 33)
    }

    fn numbers(&mut self, count: usize) -> Vec<f64> {
        (0..count).map(|_| self.metres()).collect()
    }

    fn indices(&mut self, count: usize) -> Vec<i32> {
        (0..count).map(|_| self.int()).collect()
    }

    fn pose(&mut self) -> Vec<f64> {
        let mut pose = vec![1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        for _ in 0..self.byte() % 4 {
            let at = usize::from(self.byte() % 16);
            pose[at] = self.metres();
        }
        pose
    }

    /// Small enough to be answered soon in three of four cases.
    fn region(&mut self) -> Box3 {
        let low = [self.int(), self.int(), self.int()];
        let size = match self.byte() % 4 {
            0 => [self.int() as u32, self.int() as u32, self.int() as u32],
            _ => self.take::<3>().map(|side| u32::from(side % 40)),
        };
        Box3 { low, size }
    }

    fn is_null(&mut self) -> bool {
        self.byte() >= 250
    }

    fn at<T>(&mut self, of: &[T]) -> *const T {
        if self.is_null() { null() } else { of.as_ptr() }
    }

    fn to<T>(&mut self, of: &mut [T]) -> *mut T {
        if self.is_null() { null_mut() } else { of.as_mut_ptr() }
    }
}

#[derive(Default)]
struct Handles {
    robots: Vec<*mut RobotHandle>,
    views: Vec<*mut View>,
    fields: Vec<*mut Field>,
    frontiers: Vec<*mut Frontiers>,
}

impl Drop for Handles {
    fn drop(&mut self) {
        // SAFETY: each was made by the library, and is freed once.
        unsafe {
            self.robots.drain(..).for_each(|robot| flockmap_robot_free(robot));
            self.views.drain(..).for_each(|view| flockmap_view_free(view));
            self.fields.drain(..).for_each(|field| flockmap_field_free(field));
            self.frontiers.drain(..).for_each(|found| flockmap_frontiers_free(found));
        }
    }
}

/// One of them, or null.
fn pick<T>(input: &mut Input<'_>, all: &[*mut T]) -> *mut T {
    match input.byte() {
        255 => null_mut(),
        at => all.get(usize::from(at) % all.len().max(1)).copied().unwrap_or(null_mut()),
    }
}

/// Keeps what a function made: null exactly if it failed. The oldest goes where there are too many.
fn keep<T>(all: &mut Vec<*mut T>, made: *mut T, outcome: Outcome, free: unsafe extern "C" fn(*mut T)) {
    assert_eq!(made.is_null(), outcome != Outcome::Ok, "a handle and {outcome:?}");
    if !made.is_null() {
        all.push(made);
    }
    if all.len() > HANDLES_MAX {
        // SAFETY: made by the library, and taken out of the list.
        unsafe { free(all.remove(0)) };
    }
}

fn call(input: &mut Input<'_>, handles: &mut Handles) -> Outcome {
    let which = input.byte() % 40;
    let robot = pick(input, &handles.robots);
    let view = pick(input, &handles.views);
    let field = pick(input, &handles.fields);
    let found = pick(input, &handles.frontiers);
    let now = input.stamp();
    let mut count = 0;
    // SAFETY: handles live, and buffers are as long as their lengths say.
    unsafe {
        match which {
            0 => {
                let mut options = std::mem::zeroed();
                flockmap_robot_options_default(&mut options);
                options.id = input.byte().into();
                for _ in 0..input.byte() % 4 {
                    match input.byte() % 10 {
                        0 => options.resolution_m = input.metres(),
                        1 => options.range_m = input.metres(),
                        2 => options.range_min_m = input.metres(),
                        3 => options.mapper = input.int(),
                        4 => options.publish_period_ms = input.int() as u32,
                        5 => options.radio_bytes_per_s = input.int() as u32,
                        6 => options.link_bytes_per_s = input.int() as u32,
                        7 => options.has_swarm_key = input.byte(),
                        8 => options.swarm_key = input.take(),
                        _ => options.broadcast = input.byte(),
                    }
                }
                // What fits the machine that fuzzes.
                options.map_bytes_max = 1 << 22;
                options.epoch = 1 + u64::from(input.byte());
                let mut made = null_mut();
                let outcome = flockmap_robot_new(&options, now, &mut made);
                keep(&mut handles.robots, made, outcome, flockmap_robot_free);
                outcome
            }
            1 => {
                let length = input.count();
                let mut text = b"id = 1\n[map]\nresolution_m = 0.1\nrange_m = 3.0\nmemory_mb = 4\n".to_vec();
                text.extend((0..length).map(|_| input.byte()).filter(|byte| *byte != 0));
                let text = CString::new(text).unwrap_or_default();
                let mut made = null_mut();
                let outcome = flockmap_robot_new_from_toml(text.as_ptr(), 1, now, &mut made);
                keep(&mut handles.robots, made, outcome, flockmap_robot_free);
                outcome
            }
            2..=5 => {
                let (points, rays) = (input.count(), input.count() % 4);
                let narrow = |all: Vec<f64>| all.into_iter().map(|v| v as f32).collect::<Vec<f32>>();
                let (points, rays) = (narrow(input.numbers(3 * points)), narrow(input.numbers(3 * rays)));
                let (pose, stamp) = (input.pose(), input.stamp());
                let mut report = Report::default();
                flockmap_robot_insert_scan(
                    robot,
                    now,
                    stamp,
                    input.at(&points),
                    points.len() / 3,
                    input.at(&rays),
                    rays.len() / 3,
                    input.at(&pose),
                    &mut report,
                )
            }
            6 => {
                let count = input.count();
                let voxels = input.indices(3 * count);
                let states: Vec<u8> = (0..count).map(|_| input.byte() % 4).collect();
                let (resolution, sensor) =
                    (if input.is_null() { input.metres() } else { 0.1 }, input.numbers(3));
                flockmap_robot_insert_states(
                    robot,
                    now,
                    now,
                    resolution,
                    input.at(&sensor),
                    input.at(&voxels),
                    input.at(&states),
                    count,
                    null_mut(),
                )
            }
            7 => {
                let region = input.region();
                let volume = region.size.iter().map(|&side| side as usize).try_fold(1, usize::checked_mul);
                let count = volume.unwrap_or(0).min(4_096);
                let states: Vec<u8> = (0..count).map(|_| input.byte() % 3).collect();
                flockmap_robot_insert_box(
                    robot,
                    now,
                    now,
                    0.1,
                    null(),
                    region.low.as_ptr(),
                    region.size.as_ptr(),
                    input.at(&states),
                    count,
                    input.int(),
                    null_mut(),
                )
            }
            8 => flockmap_robot_set_alignment(robot, input.byte().into(), input.pose().as_ptr()),
            9 => flockmap_robot_set_clock_offset(robot, input.byte().into(), input.stamp(), input.int()),
            10 => flockmap_robot_set_muted(robot, input.byte().into(), input.int()),
            11 => flockmap_robot_set_teammate(
                robot,
                input.byte().into(),
                input.numbers(3).as_ptr(),
                input.stamp(),
            ),
            12 | 13 => {
                let length = 4 * input.count();
                let bytes: Vec<u8> = (0..length).map(|_| input.byte()).collect();
                flockmap_robot_handle_datagram_from(
                    robot,
                    now,
                    input.byte().into(),
                    bytes.as_ptr(),
                    bytes.len(),
                )
            }
            // What a robot sends, as it is or with a byte of it changed, to another one.
            14..=17 => {
                let mut bytes = vec![0; DATAGRAM_BYTES_MAX];
                let mut transmit = Transmit::default();
                let sent =
                    flockmap_robot_poll_transmit(robot, now, bytes.as_mut_ptr(), bytes.len(), &mut transmit);
                if sent != Outcome::Ok {
                    return sent;
                }
                if input.byte() >= 200 {
                    let at = usize::from(u16::from_le_bytes(input.take())) % transmit.length;
                    bytes[at] = input.byte();
                }
                let other = pick(input, &handles.robots);
                flockmap_robot_handle_datagram_from(other, now, 0, bytes.as_ptr(), transmit.length)
            }
            18 | 19 => flockmap_robot_handle_timeout(robot, now),
            20 => flockmap_robot_flush(robot, now),
            21 => {
                let (mut due, mut voxels, mut counters) = (0, 0, Counters::default());
                flockmap_robot_poll_timeout(robot, &mut due);
                flockmap_robot_unpublished(robot, &mut voxels);
                flockmap_robot_counters(robot, &mut counters)
            }
            22 => {
                let mut event = std::mem::zeroed::<EventRecord>();
                let outcome = flockmap_robot_poll_event(robot, &mut event);
                assert!(
                    CStr::from_ptr(event.text.as_ptr()).to_str().is_ok()
                        && event.text[EVENT_TEXT_BYTES - 1] == 0
                );
                outcome
            }
            23 => {
                let mut layers = vec![std::mem::zeroed::<Layer>(); input.count()];
                flockmap_robot_layers(robot, input.to(&mut layers), layers.len(), &mut count)
            }
            24 | 25 => {
                let mut made = null_mut();
                let outcome = flockmap_robot_view(robot, &mut made);
                keep(&mut handles.views, made, outcome, flockmap_view_free);
                outcome
            }
            26 => {
                let mut made = null_mut();
                let outcome = flockmap_view_new(input.metres(), &mut made);
                keep(&mut handles.views, made, outcome, flockmap_view_free);
                outcome
            }
            27 => {
                let count = input.count();
                let indices = input.indices(3 * count);
                let free: Vec<u64> = (0..8 * count).map(|_| u64::from_le_bytes(input.take())).collect();
                let mut occupied: Vec<u64> = free.iter().map(|word| !word).collect();
                if input.is_null() && count > 0 {
                    occupied[0] |= 1;
                }
                let mut made = null_mut();
                let outcome = flockmap_view_with_blocks(
                    view,
                    input.at(&indices),
                    free.as_ptr(),
                    occupied.as_ptr(),
                    count,
                    &mut made,
                );
                keep(&mut handles.views, made, outcome, flockmap_view_free);
                outcome
            }
            28 => {
                let points = input.numbers(3 * input.bytes.len().min(20));
                let mut states = vec![9; points.len() / 3];
                let outcome = flockmap_view_states(view, points.as_ptr(), states.len(), states.as_mut_ptr());
                assert!(outcome != Outcome::Ok || states.iter().all(|state| *state <= 2));
                let voxels = input.indices(3);
                flockmap_view_voxel_states(view, voxels.as_ptr(), 1, [0u8].as_mut_ptr());
                outcome
            }
            29 => {
                let (mut info, mut bounds) = (std::mem::zeroed(), std::mem::zeroed());
                flockmap_view_info(view, &mut info);
                flockmap_view_bounds(view, &mut bounds);
                let (mut free, mut occupied) = ([0; 8], [0; 8]);
                flockmap_view_block(view, input.indices(3).as_ptr(), free.as_mut_ptr(), occupied.as_mut_ptr())
            }
            30 => {
                let mut indices = vec![0; 3 * input.count()];
                let version = u64::from(input.byte());
                flockmap_view_changed_since(
                    view,
                    version,
                    input.to(&mut indices),
                    indices.len() / 3,
                    &mut count,
                )
            }
            31 => {
                let (region, state) = (input.region(), input.int());
                let mut voxels = vec![0; 3 * 64 * input.count()];
                let mut points = vec![0.0; voxels.len()];
                let region = if input.is_null() { null() } else { &raw const region };
                flockmap_view_occupied_points(
                    view,
                    region,
                    points.as_mut_ptr(),
                    points.len() / 3,
                    &mut count,
                );
                flockmap_view_voxels(view, region, state, input.to(&mut voxels), voxels.len() / 3, &mut count)
            }
            32 => {
                let count = input.count();
                let (from, to) = (input.numbers(3 * count), input.numbers(3 * count));
                let mut hits = vec![RayHit::default(); count];
                flockmap_view_cast_rays(
                    view,
                    from.as_ptr(),
                    to.as_ptr(),
                    count,
                    input.int(),
                    hits.as_mut_ptr(),
                )
            }
            33 => {
                let count = input.count() % 4;
                let (from, to) = (input.numbers(3 * count), input.numbers(3 * count));
                let (kind, radius) = (i32::from(input.byte() % 3), input.metres());
                // A large sphere of what is not Free has 2^29 voxels: well, but too slow to fuzz.
                let radius = if radius.is_finite() { radius.min(3.0) } else { radius };
                let (mut along, mut voxels, mut collides) =
                    (vec![0.0; count], vec![0; 3 * count], vec![0; count]);
                flockmap_view_spheres(view, kind, from.as_ptr(), count, radius, collides.as_mut_ptr());
                flockmap_view_segments(
                    view,
                    kind,
                    from.as_ptr(),
                    to.as_ptr(),
                    count,
                    radius,
                    along.as_mut_ptr(),
                    input.to(&mut voxels),
                )
            }
            34 => {
                let region = input.region();
                let cells = u64::from(region.size[0]) * u64::from(region.size[1]);
                let room = if cells <= 4_096 { cells as usize } else { 1 };
                let (mut bytes, mut bottoms, mut tops) = (vec![0; room], vec![0.0; room], vec![0.0; room]);
                flockmap_view_occupancy_grid(
                    view,
                    &region,
                    i32::from(input.byte() % 3),
                    bytes.as_mut_ptr(),
                    room,
                );
                flockmap_view_height_map(view, &region, input.to(&mut bottoms), input.to(&mut tops), room)
            }
            35 => {
                let (region, kind) = (input.region(), i32::from(input.byte() % 3));
                let mut made = null_mut();
                let outcome = flockmap_field_new(view, &region, kind, 1 << 20, &mut made);
                keep(&mut handles.fields, made, outcome, flockmap_field_free);
                outcome
            }
            36 => {
                let region = input.region();
                let mut did = 0;
                flockmap_field_update(field, view, &mut did);
                if input.byte() < 200 { Outcome::Ok } else { flockmap_field_move_to(field, view, &region) }
            }
            37 => {
                let count = input.count();
                let points = input.numbers(3 * count);
                let (mut distances, mut gradients, mut clear) =
                    (vec![0.0; count], vec![0.0; 3 * count], vec![0; count]);
                flockmap_field_at(
                    field,
                    points.as_ptr(),
                    count,
                    distances.as_mut_ptr(),
                    input.to(&mut gradients),
                );
                flockmap_field_are_clear(field, points.as_ptr(), count, input.metres(), clear.as_mut_ptr());
                let mut region = std::mem::zeroed::<Box3>();
                if flockmap_field_box(field, &mut region) != Outcome::Ok {
                    return Outcome::None;
                }
                let volume = region.size.iter().map(|side| *side as usize).product::<usize>();
                let mut array = vec![0.0; volume.min(100_000)];
                let outcome = flockmap_field_array(field, array.as_mut_ptr(), array.len());
                assert!(outcome == Outcome::Ok || volume > 100_000);
                outcome
            }
            38 => {
                let region = input.region();
                if region.size.iter().map(|&side| u128::from(side)).product::<u128>() > 1 << 20 {
                    return Outcome::None; // well, but too slow to fuzz
                }
                let mut made = null_mut();
                let outcome = flockmap_frontiers_new(view, &region, input.metres(), input.count(), &mut made);
                keep(&mut handles.frontiers, made, outcome, flockmap_frontiers_free);
                outcome
            }
            _ => {
                let mut info = std::mem::zeroed();
                flockmap_frontiers_count(found, &mut count);
                let at = usize::from(input.byte() % 8);
                flockmap_frontiers_get(found, at, &mut info);
                let mut voxels = vec![0; 3 * 64 * input.count()];
                flockmap_frontiers_voxels(found, at, input.to(&mut voxels), voxels.len() / 3, &mut count)
            }
        }
    }
}

fuzz_target!(|bytes: &[u8]| {
    let (mut input, mut handles) = (Input { bytes }, Handles::default());
    for _ in 0..CALLS_MAX {
        if input.bytes.is_empty() {
            break;
        }
        let outcome = call(&mut input, &mut handles);
        // SAFETY: the library's own, read before the next call.
        let text = unsafe { CStr::from_ptr(flockmap_last_error()) };
        let is_sound = outcome != Outcome::ErrorInternal && outcome != Outcome::ErrorPoisoned;
        assert!(is_sound, "{outcome:?}: {text:?}");
        assert!(text.to_str().is_ok());
    }
});
