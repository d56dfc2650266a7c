//! Point clouds, and how large they may be.

use flockmap_grid::Resolution;
use glam::{DVec3, Vec3};

use crate::error::{Fault, Place, excerpt};

/// Largest cloud file that is read.
pub const CLOUD_BYTES_MAX: u64 = 4 << 30;
/// Most points in a cloud.
pub const CLOUD_POINTS_MAX: u64 = 200_000_000;
/// Coordinates beyond this are too coarse as `f32` (1 mm at 10 km): an origin is taken off them.
const ORIGIN_BEYOND_M: f64 = 10_000.0;

/// Name of the number that tells what is at a point: 1 something solid, 0 free space.
pub(crate) const STATE: &str = "state";
/// Begins the comment that tells the side of the voxels whose centres the points are.
const VOXELS_NOTE: &str = "Flockmap, voxels of ";

/// The comment in the header of a file with the centres of voxels.
pub(crate) fn voxels_note(side: Resolution) -> String {
    format!("{VOXELS_NOTE}{} m", side.metres())
}

/// The side of the voxels, if this comment of a header tells one.
pub(crate) fn noted_voxels(comment: &str, place: &Place) -> Result<Option<Resolution>, Fault> {
    let Some(side) = comment.trim().strip_prefix(VOXELS_NOTE) else { return Ok(None) };
    let metres = side.strip_suffix(" m").and_then(|side| side.parse().ok());
    metres.and_then(Resolution::from_metres).map(Some).ok_or_else(|| {
        Fault::damaged(place.clone(), "voxels of 0.001 to 100 m, such as \"0.1 m\"", excerpt(side.as_bytes()))
    })
}

/// Points as a file has them, also those that are no numbers.
#[derive(Clone, PartialEq, Debug, Default)]
pub(crate) struct StoredPoints {
    /// Where something is.
    pub(crate) solid: Vec<[f64; 3]>,
    /// Where the file says that nothing is.
    pub(crate) free: Vec<[f64; 3]>,
    /// Whether the file has a state for each point.
    pub(crate) has_states: bool,
    /// Side of the voxels whose centres the points are, if the file says so.
    pub(crate) voxels: Option<Resolution>,
}

impl StoredPoints {
    /// Takes over a point, with its state where the file has one.
    pub(crate) fn push(
        &mut self,
        point: [f64; 3],
        state: Option<f64>,
        place: impl FnOnce() -> Place,
    ) -> Result<(), Fault> {
        match state {
            None | Some(1.0) => self.solid.push(point),
            Some(0.0) => self.free.push(point),
            Some(other) => {
                let expected = "1 (occupied) or 0 (free) as the state of a point; call the number otherwise if it is something else";
                return Err(Fault::foreign(place(), expected, other.to_string()));
            }
        }
        Ok(())
    }
}

impl From<StoredPoints> for PointCloud {
    fn from(stored: StoredPoints) -> Self {
        let origin = origin_of(stored.solid.iter().chain(&stored.free));
        let mut cloud = Self { origin, voxels: stored.voxels, ..Self::default() };
        cloud.points = cloud.seen_from_origin(&stored.solid);
        cloud.free = cloud.seen_from_origin(&stored.free);
        cloud
    }
}

/// Whether it is a place at all.
pub(crate) fn is_finite(point: &[f64; 3]) -> bool {
    point.iter().all(|v| v.is_finite() && v.abs() < 1e15)
}

/// What to take off the coordinates of points that are far out.
fn origin_of<'a>(points: impl Iterator<Item = &'a [f64; 3]> + Clone) -> [f64; 3] {
    let finite = || points.clone().filter(|point| is_finite(point));
    let far = finite().flatten().any(|v| v.abs() > ORIGIN_BEYOND_M);
    let lowest = |axis: usize| finite().map(|p| p[axis]).fold(f64::INFINITY, f64::min);
    if far { core::array::from_fn(|axis| lowest(axis).floor()) } else { [0.0; 3] }
}

/// Points in metres. The place of a point is `origin + point`.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct PointCloud {
    /// Where something is, seen from `origin`.
    pub points: Vec<[f32; 3]>,
    /// Where nothing is, seen from `origin`: points to which the file gives a `state` of 0, as an exported
    /// map with free voxels does. Empty for a file without states.
    pub free: Vec<[f32; 3]>,
    /// Side of the voxels whose centres the points are, in a file written by
    /// [`export_map`](crate::export_map).
    pub voxels: Option<Resolution>,
    /// Whole metres taken off the coordinates of the file. Zero unless a coordinate is more than 10 km from
    /// zero, as in surveyed clouds; then the lowest corner of the cloud, rounded down.
    pub origin: [f64; 3],
    /// Points left out because a coordinate was not a finite number.
    pub dropped: u64,
}

impl PointCloud {
    /// Takes a common origin off points where they are far out.
    pub fn from_points(points: &[[f64; 3]]) -> Self {
        let mut cloud = Self { origin: origin_of(points.iter()), ..Self::default() };
        cloud.points = cloud.seen_from_origin(points);
        cloud
    }

    /// The points that are finite, seen from the origin. The others are counted.
    fn seen_from_origin(&mut self, points: &[[f64; 3]]) -> Vec<[f32; 3]> {
        let mut taken = Vec::with_capacity(points.len());
        let seen = |p: &[f64; 3]| core::array::from_fn(|axis| (p[axis] - self.origin[axis]) as f32);
        taken.extend(points.iter().filter(|point| is_finite(point)).map(seen));
        self.dropped += (points.len() - taken.len()) as u64;
        taken
    }

    /// Lowest and highest corner of the cloud in the coordinates of the file. `None` if it is empty.
    pub fn bounds(&self) -> Option<[[f64; 3]; 2]> {
        let points = || self.points.iter().chain(&self.free).map(|p| Vec3::from_array(*p));
        let (low, high) = (points().reduce(Vec3::min)?, points().reduce(Vec3::max)?);
        let place = |p: Vec3| (DVec3::from_array(self.origin) + p.as_dvec3()).to_array();
        Some([place(low), place(high)])
    }
}
