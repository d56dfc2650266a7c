//! What can be seen of a world at all.

use super::sight::Sight;
use crate::threads::in_parallel;
use crate::{NavigationGrid, Router};
use flockmap_grid::{BlockIndex, Mapper, Plane, Resolution, Voxel, voxel_bit};
use flockmap_plan::lattice::Lattice;
use flockmap_worlds::curve::distance;
use flockmap_worlds::random::hash_at;
use flockmap_worlds::{ScanOptions, World};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Metres between places to look from, along x and y, and along z.
const SPACING_M: [f64; 3] = [1.2, 1.2, 0.6];

/// Only one voxel in so many is tried, drawn by its place: the share comes out the same.
const DRAWN_ONE_IN: u64 = 8;

/// The voxels of a region that a sensor can see from somewhere.
///
/// An estimate from below and above at once: a voxel counts if the ray to its centre from one of the places
/// (one in each box of 1.2 × 1.2 × 0.6 m in which a robot can be) is within the reach of the sensor and
/// either ends in the voxel or goes through its centre and, unless rays without a return are delivered, hits
/// something further on. A robot may see a little more (from places in between), and not everything that
/// counts is easy to see.
pub(super) struct Seeable {
    blocks: BTreeMap<BlockIndex, Plane>,
    count: u64,
}

/// What decides whether a voxel is seen from a place.
pub(super) struct Eyes<'a> {
    pub(super) world: &'a World,
    pub(super) sight: &'a Sight,
    pub(super) scan: ScanOptions,
    pub(super) resolution: Resolution,
}

impl Seeable {
    /// For robots that can start at `start` and fly where `may_fly` says, in the world as it is (`truth`).
    /// `goes_on` is called with how many of how many blocks are done; `None` once it has said no.
    pub(super) fn new(
        eyes: &Eyes<'_>,
        truth: &NavigationGrid,
        start: [f64; 3],
        may_fly: impl Fn(usize) -> bool,
        threads: usize,
        goes_on: &(dyn Fn(usize, usize) -> bool + Sync),
    ) -> Option<Self> {
        let places = places(truth, start, may_fly);
        let mut candidates: Vec<(BlockIndex, Plane)> =
            candidates(eyes.world, truth, start, eyes.resolution).into_iter().collect();
        let (done, stopped) = (AtomicUsize::new(0), AtomicBool::new(false));
        let count = candidates.len();
        in_parallel(threads, &mut candidates, |_, (index, plane)| {
            if !stopped.load(Ordering::Relaxed) {
                stopped.fetch_or(!goes_on(done.fetch_add(1, Ordering::Relaxed), count), Ordering::Relaxed);
                *plane = look(eyes, &places, *index, plane);
            }
        });
        if stopped.into_inner() {
            return None;
        }
        let blocks: BTreeMap<BlockIndex, Plane> = candidates.into_iter().collect();
        let count = blocks.values().flatten().map(|word: &u64| u64::from(word.count_ones())).sum();
        Some(Self { blocks, count })
    }

    /// Number of voxels, estimated from those drawn.
    pub(super) const fn count(&self) -> u64 {
        self.count * DRAWN_ONE_IN
    }

    /// Share of them that at least one of the robots has mapped itself; 1 if there are none.
    pub(super) fn share<'a>(&self, mappers: impl Iterator<Item = &'a Mapper> + Clone) -> f64 {
        let mut known = 0u64;
        for (index, plane) in &self.blocks {
            let mut all = [0u64; 8];
            for block in mappers.clone().filter_map(|mapper| mapper.block(*index)) {
                let part = block.known();
                all = core::array::from_fn(|z| all[z] | part[z]);
            }
            known += (0..8).map(|z| u64::from((all[z] & plane[z]).count_ones())).sum::<u64>();
        }
        if self.count == 0 { 1.0 } else { known as f64 / self.count as f64 }
    }
}

/// One place in each box of the lattice in which a robot can be: the one nearest to its middle.
fn places(truth: &NavigationGrid, start: [f64; 3], may_fly: impl Fn(usize) -> bool) -> Vec<[f64; 3]> {
    let mut router = Router::new(truth);
    router.flood(truth, start, f64::INFINITY, |cell| !may_fly(cell));
    let mut best: BTreeMap<[i64; 3], (f64, [f64; 3])> = BTreeMap::new();
    for cell in 0..truth.count() {
        if router.metres_to(truth, cell).is_none() {
            continue;
        }
        let place = truth.cells.centre(cell);
        let key: [i64; 3] = core::array::from_fn(|a| (place[a] / SPACING_M[a]).floor() as i64);
        let middle = core::array::from_fn(|a| (key[a] as f64 + 0.5) * SPACING_M[a]);
        let away = distance(place, middle);
        let entry = best.entry(key).or_insert((away, place));
        if away < entry.0 {
            *entry = (away, place);
        }
    }
    best.into_values().map(|(_, place)| place).collect()
}

/// Voxels that light can come to at all: those without anything solid that hang together with the start, and the
/// solid ones around them. Leaves out what is buried.
fn candidates(
    world: &World,
    truth: &NavigationGrid,
    start: [f64; 3],
    resolution: Resolution,
) -> BTreeMap<BlockIndex, Plane> {
    let (region, side) = (truth.region(), resolution.metres());
    let min = region.min();
    let voxels =
        Lattice::new(region.size().map(|n| n as usize)).placed([0.0; 3], [min.x, min.y, min.z], side);
    let cell = world.resolution().metres();
    const OPEN: u8 = 0;
    const SOLID: u8 = 1;
    const REACHED: u8 = 2;
    let mut marks = vec![OPEN; voxels.count()];
    for solid in world.solid_cells() {
        let index = [solid.x, solid.y, solid.z].map(f64::from);
        if let Some(voxel) = voxels.number_of(index.map(|i| ((i + 0.5) * cell / side).floor() as i32)) {
            marks[voxel] = SOLID;
        }
    }
    let mut blocks: BTreeMap<BlockIndex, Plane> = BTreeMap::new();
    let mut add = |number: usize| {
        let [x, y, z] = voxels.index(number);
        let voxel = Voxel::new(x, y, z);
        let bit = voxel_bit(voxel);
        blocks.entry(voxel.block()).or_default()[bit >> 6] |= 1 << (bit & 63);
    };
    let start = resolution.voxel_at(start).and_then(|at| voxels.number_of([at.x, at.y, at.z]));
    let mut queue: Vec<usize> = start.into_iter().collect();
    queue.iter().for_each(|voxel| marks[*voxel] = REACHED);
    while let Some(voxel) = queue.pop() {
        add(voxel);
        for next in voxels.beside(voxel) {
            match marks[next] {
                OPEN => {
                    marks[next] = REACHED;
                    queue.push(next);
                }
                SOLID => add(next),
                _ => {}
            }
        }
    }
    blocks
}

/// The voxels of a block that can be seen from one of the places.
fn look(eyes: &Eyes<'_>, places: &[[f64; 3]], index: BlockIndex, candidates: &Plane) -> Plane {
    let Eyes { world, sight, scan, resolution } = eyes;
    let side = resolution.metres();
    let corner = index.corner();
    let middle = [corner.x, corner.y, corner.z].map(|v| (f64::from(v) + 4.0) * side);
    let reach = sight.range_m + 7.0 * side;
    let away = places.iter().map(|place| (distance(*place, middle), *place));
    let mut near: Vec<(f64, [f64; 3])> = away.filter(|(away, _)| *away <= reach).collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut seen: Plane = [0; 8];
    // What saw the last voxel most likely sees the next one.
    let mut last = 0;
    for voxel in index.voxel_box().voxels() {
        let bit = voxel_bit(voxel);
        let place = [voxel.x, voxel.y, voxel.z].map(i64::from);
        let is_drawn = hash_at(0x5ee, place[0], place[1], place[2]).is_multiple_of(DRAWN_ONE_IN);
        if !is_drawn || candidates[bit >> 6] >> (bit & 63) & 1 == 0 {
            continue;
        }
        let centre = resolution.centre(voxel);
        let is_seen = |from: [f64; 3]| {
            if !sight.covers(from, None, centre) {
                return false;
            }
            let direction = core::array::from_fn(|a| centre[a] - from[a]);
            match world.cast_ray(from, direction, scan.range_m) {
                Some(hit) => {
                    hit.distance_m >= distance(from, centre) || resolution.voxel_at(hit.point) == Some(voxel)
                }
                None => scan.no_returns,
            }
        };
        let found = if near.get(last).is_some_and(|(_, place)| is_seen(*place)) {
            Some(last)
        } else {
            near.iter().position(|(_, place)| is_seen(*place))
        };
        if let Some(found) = found {
            last = found;
            seen[bit >> 6] |= 1 << (bit & 63);
        }
    }
    seen
}
