//! Views of a map, and what is asked of them.

use flockmap_core::grid::{BlockIndex, StateBlock};
use flockmap_core::{MapView, RayEnd, State, Voxel, VoxelBox};
use flockmap_plan::box_between;

use crate::args::{Args, flag, handle, list, one};
use crate::result::{Failure, Outcome, guard};
use crate::voxel::{byte_of, resolution};

/// Questions that are answered at a time, in memory of a fixed size.
const CHUNK: usize = 1_024;

/// A map as it was at one moment. Opaque and never changed: any number of threads may ask it at once.
pub struct View {
    pub(crate) map: MapView,
}

impl View {
    pub(crate) fn boxed(map: MapView) -> *mut Self {
        Box::into_raw(Box::new(Self { map }))
    }
}

/// Voxels from `low` on, `size` of them along x, y, z. A voxel (x, y, z) covers x * r to (x + 1) * r metres, and so on,
/// with r the side of a voxel. Indices go to 2^28 in both directions.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Box3 {
    /// Index of the lowest voxel.
    pub low: [i32; 3],
    /// Voxels along x, y, z; 1 or more.
    pub size: [u32; 3],
}

impl Box3 {
    pub(crate) const fn of(region: &VoxelBox) -> Self {
        let low = region.min();
        Self { low: [low.x, low.y, low.z], size: region.size() }
    }

    pub(crate) fn region(&self) -> Result<VoxelBox, Failure> {
        let [x, y, z] = self.low;
        VoxelBox::new(Voxel::new(x, y, z), self.size).ok_or_else(|| {
            Failure::argument(format_args!(
                "low {:?}, size {:?} is no box: a size is 0, or it leaves the grid",
                self.low, self.size
            ))
        })
    }
}

/// A box, or all of the map where it is null; `None` if that is empty.
///
/// # Safety
/// As of [`Args::input`].
unsafe fn region_of(
    args: &mut Args,
    map: &MapView,
    region: *const Box3,
) -> Result<Option<VoxelBox>, Failure> {
    if region.is_null() {
        return Ok(map.bounding_box());
    }
    // SAFETY: as of this function.
    unsafe { args.input(region, 1, "region") }?[0].region().map(Some)
}

pub(crate) const fn triple(voxel: Voxel) -> [i32; 3] {
    [voxel.x, voxel.y, voxel.z]
}

/// A map of which nothing is known, at version 0. `resolution_m`: side of a voxel, 0.001 to 100. `*view` is to be freed
/// by flockmap_view_free; null on an error. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_new(resolution_m: f64, view: *mut *mut View) -> Outcome {
    guard("flockmap_view_new", || {
        // SAFETY: the caller's word, as of the header.
        let mut to = unsafe { one(&mut Args::default(), view, "view") }?;
        to.set(0, std::ptr::null_mut());
        to.set(0, View::boxed(MapView::new(resolution(resolution_m)?)));
        Ok(Outcome::Ok)
    })
}

/// A view in which some blocks of another one are replaced, such as those that a mirror of a node's map received.
///
/// `indices`: `count` times x, y, z, the index of a block: that of a voxel divided by 8, rounded down; within +-2^25.
/// `free`, `occupied`: 8 words for each, as flockmap_view_block writes them. A voxel that is both is FLOCKMAP_ERROR_ARGUMENT.
/// At most 2^22 blocks at a time. `view` stays as it is; `*changed` is a new one with a higher version, to be freed by
/// flockmap_view_free; null on an error. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_with_blocks(
    view: *const View,
    indices: *const i32,
    free: *const u64,
    occupied: *const u64,
    count: usize,
    changed: *mut *mut View,
) -> Outcome {
    const BLOCKS_MAX: usize = 1 << 22;
    const INDEX_MAX: i32 = 1 << 25;
    guard("flockmap_view_with_blocks", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let mut to = unsafe { one(&mut args, changed, "changed") }?;
        to.set(0, std::ptr::null_mut());
        if count > BLOCKS_MAX {
            let text = format!("{count} blocks, expected at most {BLOCKS_MAX} at a time");
            return Err(Failure::new(Outcome::ErrorTooLarge, text));
        }
        // SAFETY: the same.
        let (view, indices, free, occupied) = unsafe {
            (
                handle(view, "view")?,
                args.rows::<3, i32>(indices, count, "indices")?,
                args.rows::<8, u64>(free, count, "free")?,
                args.rows::<8, u64>(occupied, count, "occupied")?,
            )
        };
        let mut map = view.map.clone();
        for (at, ((&[x, y, z], free), occupied)) in indices.iter().zip(free).zip(occupied).enumerate() {
            // The block at 2^25 would begin at the last voxel of the grid.
            if ![x, y, z].iter().all(|i| (-INDEX_MAX..INDEX_MAX).contains(i)) {
                let text =
                    format!("indices[{at}] is {:?}, expected -2^25 or more and less than 2^25", [x, y, z]);
                return Err(Failure::argument(text));
            }
            if free.iter().zip(occupied).any(|(free, occupied)| free & occupied != 0) {
                return Err(Failure::argument(format_args!(
                    "block {at} has voxels that are free and occupied"
                )));
            }
            map.set_block(BlockIndex::new(x, y, z), &StateBlock::new(*free, *occupied));
        }
        to.set(0, View::boxed(map));
        Ok(Outcome::Ok)
    })
}

/// Frees a view. Null does nothing. No other thread may use it any more; the robot that it is of may be gone.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_free(view: *mut View) {
    guard("flockmap_view_free", || {
        if !view.is_null() {
            // SAFETY: made by Box::into_raw, and the caller's word that it is the last use.
            drop(unsafe { Box::from_raw(view) });
        }
        Ok(Outcome::Ok)
    });
}

/// What a view is, in a few numbers.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct ViewInfo {
    /// Goes up with each change of a block.
    pub version: u64,
    /// Side of a voxel in metres.
    pub resolution_m: f64,
    /// Voxels that are Free.
    pub free: usize,
    /// Voxels that are Occupied.
    pub occupied: usize,
    /// Blocks of 8 x 8 x 8 voxels of which something is known.
    pub blocks: usize,
    /// Bytes that it takes, most of them shared with the views before and after it.
    pub memory_bytes: usize,
}

/// Version, resolution and counts. O(blocks). `info` is the caller's. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_info(view: *const View, info: *mut ViewInfo) -> Outcome {
    guard("flockmap_view_info", || {
        // SAFETY: the caller's word, as of the header.
        let (map, mut to) = unsafe { (&handle(view, "view")?.map, one(&mut Args::default(), info, "info")?) };
        let (free, occupied) = map.count();
        to.set(
            0,
            ViewInfo {
                version: map.version(),
                resolution_m: map.resolution().metres(),
                free,
                occupied,
                blocks: map.block_count(),
                memory_bytes: map.memory_bytes(),
            },
        );
        Ok(Outcome::Ok)
    })
}

/// The smallest box that holds all blocks of which something is known. FLOCKMAP_NONE if nothing is. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_bounds(view: *const View, bounds: *mut Box3) -> Outcome {
    guard("flockmap_view_bounds", || {
        // SAFETY: the caller's word, as of the header.
        let (map, mut to) =
            unsafe { (&handle(view, "view")?.map, one(&mut Args::default(), bounds, "bounds")?) };
        let Some(bounds) = map.bounding_box() else { return Ok(Outcome::None) };
        to.set(0, Box3::of(&bounds));
        Ok(Outcome::Ok)
    })
}

/// The voxels between two corners: `low_m` and `high_m`, 3 numbers each, in metres in the frame of the map. FLOCKMAP_ERROR_ARGUMENT if a
/// corner is not finite, not below the other on an axis, or out of the grid. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_box_between(
    resolution_m: f64,
    low_m: *const f64,
    high_m: *const f64,
    region: *mut Box3,
) -> Outcome {
    guard("flockmap_box_between", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (low, high, mut to) = unsafe {
            (
                args.input(low_m, 3, "low_m")?,
                args.input(high_m, 3, "high_m")?,
                one(&mut args, region, "region")?,
            )
        };
        let (low, high) = ([low[0], low[1], low[2]], [high[0], high[1], high[2]]);
        let found = box_between(resolution(resolution_m)?, low, high).ok_or_else(|| {
            let text = format_args!(
                "{low:?} to {high:?} m is no box: expected finite corners, low below high, within the grid"
            );
            Failure::argument(text)
        })?;
        to.set(0, Box3::of(&found));
        Ok(Outcome::Ok)
    })
}

/// States at many points. `points`: `count` times x, y, z, metres in the frame of the map. `states`: room for `count` of
/// flockmap_voxel_state; Unknown for points that are not finite or out of the grid. Points in a row that lie in one
/// block cost one look-up. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_states(
    view: *const View,
    points: *const f64,
    count: usize,
    states: *mut u8,
) -> Outcome {
    guard("flockmap_view_states", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (map, points, mut to) = unsafe {
            (
                &handle(view, "view")?.map,
                args.rows::<3, f64>(points, count, "points")?,
                args.output(states, count, "states")?,
            )
        };
        let mut found = [State::Unknown; CHUNK];
        for (chunk, points) in points.chunks(CHUNK).enumerate() {
            let found = &mut found[..points.len()];
            flockmap_plan::states(map, points, found).map_err(Failure::argument)?;
            found.iter().enumerate().for_each(|(at, state)| to.set(chunk * CHUNK + at, byte_of(*state)));
        }
        Ok(Outcome::Ok)
    })
}

/// States of many voxels. `voxels`: `count` times x, y, z, the index of a voxel; any numbers. `states`: room for `count`
/// of flockmap_voxel_state. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_voxel_states(
    view: *const View,
    voxels: *const i32,
    count: usize,
    states: *mut u8,
) -> Outcome {
    guard("flockmap_view_voxel_states", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (map, voxels, mut to) = unsafe {
            (
                &handle(view, "view")?.map,
                args.rows::<3, i32>(voxels, count, "voxels")?,
                args.output(states, count, "states")?,
            )
        };
        to.fill(voxels.iter().map(|&[x, y, z]| byte_of(map.state(Voxel::new(x, y, z)))));
        Ok(Outcome::Ok)
    })
}

/// One block of 8 x 8 x 8 voxels. `index`: 3 numbers, that of a voxel divided by 8, rounded down. `free`, `occupied`: room
/// for 8 words each: word z, bit 8 * y + x of the place (0 to 7) of a voxel in the block. FLOCKMAP_NONE if nothing of it
/// is known. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_block(
    view: *const View,
    index: *const i32,
    free: *mut u64,
    occupied: *mut u64,
) -> Outcome {
    guard("flockmap_view_block", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (map, index, mut to_free, mut to_occupied) = unsafe {
            (
                &handle(view, "view")?.map,
                args.input(index, 3, "index")?,
                args.output(free, 8, "free")?,
                args.output(occupied, 8, "occupied")?,
            )
        };
        let Some(block) = map.block(BlockIndex::new(index[0], index[1], index[2])) else {
            return Ok(Outcome::None);
        };
        to_free.fill(*block.free());
        to_occupied.fill(*block.occupied());
        Ok(Outcome::Ok)
    })
}

/// The blocks that changed after a version, as 3 numbers each, and whatever else may have. FLOCKMAP_NONE: too many were
/// emptied since to know; look at all of them. `indices`, `capacity`, `count` as for flockmap_view_voxels; version 0
/// asks for all blocks. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_changed_since(
    view: *const View,
    version: u64,
    indices: *mut i32,
    capacity: usize,
    count: *mut usize,
) -> Outcome {
    guard("flockmap_view_changed_since", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (map, out, count) = unsafe {
            (
                &handle(view, "view")?.map,
                args.rows_out::<3, i32>(indices, capacity, "indices")?,
                one(&mut args, count, "count")?,
            )
        };
        let Some(changed) = map.changed_since(version) else { return Ok(Outcome::None) };
        list(out, count, changed.into_iter().map(|index| [index.x, index.y, index.z]), "blocks")
    })
}

/// The voxels of a state: 3 numbers each, ascending by x, y, z. O(voxels known).
///
/// `region`: only those of this box; null: of all of the map. `state`: FLOCKMAP_VOXEL_STATE_FREE or _OCCUPIED. `voxels`: room for
/// `capacity` of them. `*count`: how many there are; with a capacity of 0 that is all that is asked for (`voxels` may be
/// null), with too little room it is FLOCKMAP_ERROR_BUFFER and no voxel is written. A view does not change, so the count
/// holds. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_voxels(
    view: *const View,
    region: *const Box3,
    state: i32,
    voxels: *mut i32,
    capacity: usize,
    count: *mut usize,
) -> Outcome {
    guard("flockmap_view_voxels", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (map, out, count, region) = unsafe {
            let map = &handle(view, "view")?.map;
            (
                map,
                args.rows_out::<3, i32>(voxels, capacity, "voxels")?,
                one(&mut args, count, "count")?,
                region_of(&mut args, map, region)?,
            )
        };
        let found = voxels_of(map, region, known(state)?);
        list(out, count, found.into_iter().map(triple), "voxels")
    })
}

/// The centres of the voxels that are Occupied, in the same order: x, y, z in metres, in the frame of the map, as float.
/// Arguments as for flockmap_view_voxels. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_occupied_points(
    view: *const View,
    region: *const Box3,
    points: *mut f32,
    capacity: usize,
    count: *mut usize,
) -> Outcome {
    guard("flockmap_view_occupied_points", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (map, out, count, region) = unsafe {
            let map = &handle(view, "view")?.map;
            (
                map,
                args.rows_out::<3, f32>(points, capacity, "points")?,
                one(&mut args, count, "count")?,
                region_of(&mut args, map, region)?,
            )
        };
        let found = voxels_of(map, region, State::Occupied);
        let centre = |voxel| map.resolution().centre(voxel).map(|v| v as f32);
        list(out, count, found.into_iter().map(centre), "points")
    })
}

fn known(state: i32) -> Result<State, Failure> {
    match state {
        1 => Ok(State::Free),
        2 => Ok(State::Occupied),
        _ => Err(Failure::argument(format_args!("state is {state}, expected 1 (Free) or 2 (Occupied)"))),
    }
}

fn voxels_of(map: &MapView, region: Option<VoxelBox>, state: State) -> Vec<Voxel> {
    let Some(region) = region else { return Vec::new() };
    let all = map.voxels_in(&region).filter(|(_, found)| *found == state);
    let mut voxels: Vec<Voxel> = all.map(|(voxel, _)| voxel).collect();
    voxels.sort_unstable();
    voxels
}

/// Where a ray ended.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct RayHit {
    /// Metres from its start to where it enters the voxel; infinity if it reached its end.
    pub distance_m: f64,
    /// The voxel, unless it reached its end.
    pub voxel: [i32; 3],
    /// FLOCKMAP_VOXEL_STATE_OCCUPIED or _UNKNOWN for what it met, _FREE if it reached its end.
    pub state: i32,
}

/// Follows many rays to the first voxel that is Occupied, or Unknown unless `through_unknown` is 1.
///
/// `from`, `to`: `count` times x, y, z, metres in the frame of the map. `hits`: room for `count`. A point that is not
/// finite or out of the grid ends as Unknown at its start. FLOCKMAP_ERROR_TOO_LARGE, before any is cast, if one is longer than 2^20 voxels.
/// Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_view_cast_rays(
    view: *const View,
    from: *const f64,
    to: *const f64,
    count: usize,
    through_unknown: i32,
    hits: *mut RayHit,
) -> Outcome {
    guard("flockmap_view_cast_rays", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (map, from, to, mut hits) = unsafe {
            (
                &handle(view, "view")?.map,
                args.rows::<3, f64>(from, count, "from")?,
                args.rows::<3, f64>(to, count, "to")?,
                args.output(hits, count, "hits")?,
            )
        };
        let through_unknown = flag(through_unknown, "through_unknown")?;
        // The lengths of all of them first: of no rays to cast, only the check is left.
        let mut ends = [RayEnd::Clear; CHUNK];
        for is_check in [true, false] {
            for (chunk, (from, to)) in from.chunks(CHUNK).zip(to.chunks(CHUNK)).enumerate() {
                if is_check {
                    check_lengths(map, from, to)?;
                    continue;
                }
                let ends = &mut ends[..from.len()];
                let cast = flockmap_plan::cast_rays(map, from, to, through_unknown, ends);
                cast.map_err(|error| Failure::new(Outcome::ErrorTooLarge, error))?;
                ends.iter().enumerate().for_each(|(at, end)| hits.set(chunk * CHUNK + at, hit_of(*end)));
            }
        }
        Ok(Outcome::Ok)
    })
}

fn check_lengths(map: &MapView, from: &[[f64; 3]], to: &[[f64; 3]]) -> Result<(), Failure> {
    let side = map.resolution().metres();
    let voxels =
        |(a, b): (&[f64; 3], &[f64; 3])| a.iter().zip(b).map(|(a, b)| (b - a).abs()).sum::<f64>() / side;
    let max = flockmap_plan::QUESTION_BLOCKS_MAX as f64;
    match from.iter().zip(to).map(voxels).find(|voxels| voxels.is_finite() && *voxels > max) {
        Some(voxels) => Err(Failure::new(
            Outcome::ErrorTooLarge,
            format_args!("a ray passes {voxels} voxels, expected at most {max}: cast it in parts"),
        )),
        None => Ok(()),
    }
}

fn hit_of(end: RayEnd) -> RayHit {
    match end {
        RayEnd::Occupied { voxel, distance_m } => RayHit { distance_m, voxel: triple(voxel), state: 2 },
        RayEnd::Unknown { voxel, distance_m } => RayHit { distance_m, voxel: triple(voxel), state: 0 },
        RayEnd::Clear => RayHit { distance_m: f64::INFINITY, voxel: [0; 3], state: 1 },
    }
}
