//! Casting the rays of one scan: how many rays pass through and how many end in each voxel.
//!
//! Rays walk from voxel to voxel across shared faces (Amanatides and Woo, "A Fast Voxel Traversal Algorithm",
//! 1987). Eight rays of about equal length walk in step, so that the compiler can use vector instructions. A
//! place is one number with interleaved fields, `[block z][block y][block x][z][y][x]`, three bits each for the
//! place in the block; a step adds to one field and lets the carry run through the bits between. Counts are kept
//! in blocks taken from a pool at first touch, so that memory follows what the scan sees and not the cube
//! around it.

use crate::{BLOCK_VOXELS, BlockIndex, Voxel};

/// Rays that walk in step.
const LANES: usize = 8;

/// Rays between two checks that no count runs over 16 bits.
const BATCH: usize = 1 << 15;

/// Counts are cut to this between batches. No rule counts more rays than this.
pub(super) const COUNT_MAX: u16 = u16::MAX - BATCH as u16;

/// Steps that a group walks before its places are counted.
const STEPS: usize = 32;

/// Times along a ray are whole numbers: this is the end of the ray.
const ONE: f64 = (1u32 << 29) as f64;

/// Longer than any ray: the face of an axis that a ray does not move along. One step past the end of the ray
/// plus this still fits 32 bits.
const NEVER: f64 = (1u32 << 30) as f64;

/// Counts of one scan. Reused from scan to scan.
#[derive(Default)]
pub(super) struct RayCounts {
    window: Window,
    /// For each block of the window: where its counts begin in `misses`; 0 = not touched yet.
    table: Vec<u32>,
    /// Rays that passed through, 512 to a block. The first 512 are never used, so that 0 means "none".
    /// All zero between scans: who takes the counts sets them back.
    misses: Vec<u16>,
    /// Rays that ended here, in the same places. Ends are counted first, so that only the first blocks have
    /// hits: most blocks are only passed through.
    hits: Vec<u16>,
    /// How many blocks these are.
    hit_blocks: usize,
    /// Places in the table of the touched blocks, in the order of their first touch; block `n` has its counts
    /// at `(n + 1) · 512`.
    touched: Vec<u32>,
    walks: Vec<Walk>,
    by_length: Vec<u32>,
}

/// The part of the map that the rays of a scan can reach: block 0 0 0 of the table, and bits per axis.
#[derive(Clone, Copy, Default, Debug)]
struct Window {
    corner: BlockIndex,
    /// Which bits of a place belong to x, y, z.
    masks: [u32; 3],
    bits: [u32; 3],
}

impl Window {
    /// The smallest window that holds the blocks from `low` to `high`.
    fn new(low: BlockIndex, high: BlockIndex) -> Self {
        let bits_for = |low: i32, high: i32| 32 - ((high - low) as u32).leading_zeros();
        let bits = [bits_for(low.x, high.x), bits_for(low.y, high.y), bits_for(low.z, high.z)];
        let mut masks = [0b111, 0b111 << 3, 0b111 << 6];
        let mut shift = 9;
        for (mask, bits) in masks.iter_mut().zip(bits) {
            *mask |= ((1u32 << bits) - 1) << shift;
            shift += bits;
        }
        Self { corner: low, masks, bits }
    }

    fn blocks(&self) -> usize {
        1 << (self.bits[0] + self.bits[1] + self.bits[2])
    }

    fn place(&self, voxel: Voxel) -> [u32; 3] {
        let c = self.corner.corner();
        let (x, y, z) = ((voxel.x - c.x) as u32, (voxel.y - c.y) as u32, (voxel.z - c.z) as u32);
        let [bx, by, _] = self.bits;
        [
            (x & 7) | (x >> 3) << 9,
            (y & 7) << 3 | (y >> 3) << (9 + bx),
            (z & 7) << 6 | (z >> 3) << (9 + bx + by),
        ]
    }

    fn block(&self, index: u32) -> BlockIndex {
        let [bx, by, bz] = self.bits;
        let field = |shift: u32, bits: u32| ((index >> shift) & ((1 << bits) - 1)) as i32;
        BlockIndex::new(
            self.corner.x + field(0, bx),
            self.corner.y + field(bx, by),
            self.corner.z + field(bx + by, bz),
        )
    }
}

/// One ray, ready to walk.
#[derive(Clone, Copy, Default)]
struct Walk {
    place: [u32; 3],
    /// Added to a field of the place for one step along its axis.
    step: [u32; 3],
    /// When the ray next crosses a face of each axis.
    next: [i32; 3],
    /// Time between two crossings of each axis.
    delta: [i32; 3],
    /// Voxels before the one in which the ray ends.
    length: u32,
}

/// A ray in voxel units (metres divided by the resolution), in the frame of the map.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    pub(super) end: [f64; 3],
    pub(super) is_hit: bool,
}

/// The counts of one touched block.
pub(super) struct TouchedBlock<'a> {
    pub(super) index: BlockIndex,
    pub(super) misses: &'a mut [u16; BLOCK_VOXELS],
    /// `None` if no ray ended in the block.
    pub(super) hits: Option<&'a mut [u16; BLOCK_VOXELS]>,
}

/// The counts of a block: misses, and hits if any ray ended there.
type Counts = ([u16; BLOCK_VOXELS], Option<[u16; BLOCK_VOXELS]>);

impl TouchedBlock<'_> {
    /// The counts, to be [put back](Self::put_back) when they are used up.
    pub(super) fn copy(&self) -> Counts {
        (*self.misses, self.hits.as_deref().copied())
    }

    pub(super) fn put_back(&mut self, (misses, hits): Counts) {
        *self.misses = misses;
        if let (Some(to), Some(hits)) = (self.hits.as_deref_mut(), hits) {
            *to = hits;
        }
    }

    /// Sets the counts back to zero.
    pub(super) fn clear(self) {
        *self.misses = [0; BLOCK_VOXELS];
        if let Some(hits) = self.hits {
            *hits = [0; BLOCK_VOXELS];
        }
    }
}

fn voxel_of(p: [f64; 3]) -> Voxel {
    Voxel::new(p[0].floor() as i32, p[1].floor() as i32, p[2].floor() as i32)
}

impl RayCounts {
    /// Casts all rays from `start` (voxel units). Start and ends must lie within the voxel limits, and no ray
    /// may be longer than 500 voxels. A voxel that a ray passes through counts one miss, the voxel in which
    /// it ends counts one hit or, for a ray that was cut, nothing.
    pub(super) fn cast(&mut self, start: [f64; 3], rays: &[Ray]) {
        self.clear();
        let from = voxel_of(start);
        let (mut low, mut high) = (from, from);
        for end in rays.iter().map(|ray| voxel_of(ray.end)) {
            (low, high) = (low.lowest(end), high.highest(end));
        }
        self.window = Window::new(low.block(), high.block());
        if self.table.len() < self.window.blocks() {
            self.table.resize(self.window.blocks(), 0);
        }
        self.prepare(start, from, rays);
        self.sort_by_length();
        let order = core::mem::take(&mut self.by_length);
        for (number, batch) in order.chunks(BATCH).enumerate() {
            if number > 0 {
                for count in &mut self.misses {
                    *count = (*count).min(COUNT_MAX);
                }
            }
            let (groups, rest) = batch.as_chunks::<LANES>();
            for group in groups {
                self.walk_group(group);
            }
            for &ray in rest {
                self.walk_one(self.walks[ray as usize], 0);
            }
        }
        self.by_length = order;
    }

    /// The touched blocks, in the order of their first touch.
    pub(super) fn indices(&self) -> impl ExactSizeIterator<Item = BlockIndex> {
        self.touched.iter().map(|block| self.window.block(*block))
    }

    /// The same with their counts, which must be set back to zero.
    pub(super) fn blocks(&mut self) -> impl Iterator<Item = TouchedBlock<'_>> {
        let window = self.window;
        let misses = self.misses.as_chunks_mut::<BLOCK_VOXELS>().0.iter_mut().skip(1);
        let hits = self.hits.as_chunks_mut::<BLOCK_VOXELS>().0.iter_mut().skip(1).take(self.hit_blocks);
        let hits = hits.map(Some).chain(core::iter::repeat_with(|| None));
        self.touched.iter().zip(misses.zip(hits)).map(move |(block, (misses, hits))| TouchedBlock {
            index: window.block(*block),
            misses,
            hits,
        })
    }

    fn clear(&mut self) {
        for touched in &self.touched {
            self.table[*touched as usize] = 0;
        }
        self.touched.clear();
    }

    fn prepare(&mut self, start: [f64; 3], from: Voxel, rays: &[Ray]) {
        let place = self.window.place(from);
        let masks = self.window.masks;
        let fraction: [f64; 3] = core::array::from_fn(|a| start[a] - start[a].floor());
        let from = [from.x, from.y, from.z];
        self.walks.clear();
        self.walks.reserve_exact(rays.len());
        for ray in rays {
            let end = voxel_of(ray.end);
            let to = [end.x, end.y, end.z];
            let mut walk = Walk { place, ..Walk::default() };
            for axis in 0..3 {
                let direction = ray.end[axis] - start[axis];
                let unit = 1u32 << (3 * axis);
                let inverse = ONE / direction.abs();
                let to_face;
                if direction > 0.0 {
                    walk.step[axis] = (!masks[axis]).wrapping_add(unit);
                    to_face = 1.0 - fraction[axis];
                } else {
                    walk.step[axis] = unit.wrapping_neg();
                    to_face = fraction[axis];
                }
                // A direction of zero gives an infinite inverse, and 0 · ∞ is not a number: `min` takes the
                // other.
                walk.next[axis] = ((to_face * inverse).min(NEVER) + 0.5) as i32;
                walk.delta[axis] = (inverse.min(NEVER) + 0.5) as i32;
                walk.length += to[axis].abs_diff(from[axis]);
            }
            self.walks.push(walk);
            if ray.is_hit {
                let [x, y, z] = self.window.place(end);
                let at = self.slot(x | y | z);
                extend(&mut self.hits, at | (BLOCK_VOXELS - 1));
                self.hits[at] = self.hits[at].saturating_add(1);
            }
        }
        self.hit_blocks = self.touched.len();
    }

    /// Longest first, equal lengths in the order of the scan, so that the rays of a group end together.
    fn sort_by_length(&mut self) {
        let longest = self.walks.iter().map(|w| w.length).max().unwrap_or(0) as usize;
        let mut starts = vec![0u32; longest + 2];
        for walk in &self.walks {
            starts[longest - walk.length as usize + 1] += 1;
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        self.by_length.clear();
        self.by_length.reserve_exact(self.walks.len());
        self.by_length.resize(self.walks.len(), 0);
        for (ray, walk) in self.walks.iter().enumerate() {
            let at = &mut starts[longest - walk.length as usize];
            self.by_length[*at as usize] = ray as u32;
            *at += 1;
        }
    }

    fn walk_group(&mut self, group: &[u32; LANES]) {
        let mut place = [[0u32; LANES]; 3];
        let mut step = [[0u32; LANES]; 3];
        let mut next = [[0i32; LANES]; 3];
        let mut delta = [[0i32; LANES]; 3];
        for (lane, &ray) in group.iter().enumerate() {
            let walk = &self.walks[ray as usize];
            for axis in 0..3 {
                place[axis][lane] = walk.place[axis];
                step[axis][lane] = walk.step[axis];
                next[axis][lane] = walk.next[axis];
                delta[axis][lane] = walk.delta[axis];
            }
        }
        let masks = self.window.masks;
        let together = self.walks[group[LANES - 1] as usize].length;
        let mut steps = [[0u32; LANES]; STEPS];
        let mut done = 0;
        while done < together {
            let count = STEPS.min((together - done) as usize);
            for at in &mut steps[..count] {
                for l in 0..LANES {
                    at[l] = place[0][l] | place[1][l] | place[2][l];
                    let (x, y, z) = (next[0][l], next[1][l], next[2][l]);
                    let is_x = -i32::from((x <= y) & (x <= z));
                    let is_y = -i32::from(y <= z) & !is_x;
                    let is_z = !(is_x | is_y);
                    next[0][l] = x.wrapping_add(delta[0][l] & is_x);
                    next[1][l] = y.wrapping_add(delta[1][l] & is_y);
                    next[2][l] = z.wrapping_add(delta[2][l] & is_z);
                    place[0][l] = place[0][l].wrapping_add(step[0][l] & is_x as u32) & masks[0];
                    place[1][l] = place[1][l].wrapping_add(step[1][l] & is_y as u32) & masks[1];
                    place[2][l] = place[2][l].wrapping_add(step[2][l] & is_z as u32) & masks[2];
                }
            }
            self.count_misses(&steps[..count]);
            done += count as u32;
        }
        for (lane, &ray) in group.iter().enumerate() {
            let walk = Walk {
                place: core::array::from_fn(|axis| place[axis][lane]),
                next: core::array::from_fn(|axis| next[axis][lane]),
                ..self.walks[ray as usize]
            };
            self.walk_one(walk, together);
        }
    }

    /// Walks one ray, of which `done` voxels are behind it.
    fn walk_one(&mut self, mut walk: Walk, done: u32) {
        for _ in done..walk.length {
            let [x, y, z] = walk.place;
            let at = self.slot(x | y | z);
            self.misses[at] += 1;
            let [x, y, z] = walk.next;
            let axis = if x <= y && x <= z {
                0
            } else if y <= z {
                1
            } else {
                2
            };
            walk.next[axis] = walk.next[axis].wrapping_add(walk.delta[axis]);
            walk.place[axis] = walk.place[axis].wrapping_add(walk.step[axis]) & self.window.masks[axis];
        }
    }

    /// Counts a miss at each place.
    #[inline(always)]
    fn count_misses(&mut self, places: &[[u32; LANES]]) {
        // Slices in locals, so that the loop need not look them up again after every store.
        let (mut table, mut misses) = (self.table.as_slice(), self.misses.as_mut_slice());
        for step in places {
            for place in step {
                let mut slot = table[(place >> 9) as usize];
                if slot == 0 {
                    slot = self.touch((place >> 9) as usize);
                    (table, misses) = (self.table.as_slice(), self.misses.as_mut_slice());
                }
                misses[slot as usize + (place & 511) as usize] += 1;
            }
        }
    }

    /// Where in the pools the counts of a place are; takes a new block from them at the first touch.
    #[inline(always)]
    fn slot(&mut self, place: u32) -> usize {
        let block = (place >> 9) as usize;
        let mut slot = self.table[block];
        if slot == 0 {
            slot = self.touch(block);
        }
        slot as usize + (place & 511) as usize
    }

    #[cold]
    #[inline(never)]
    fn touch(&mut self, block: usize) -> u32 {
        let slot = (self.touched.len() + 1) * BLOCK_VOXELS;
        extend(&mut self.misses, slot | (BLOCK_VOXELS - 1));
        grow(&mut self.touched, slot / BLOCK_VOXELS);
        self.touched.push(block as u32);
        self.table[block] = slot as u32;
        slot as u32
    }
}

/// Makes a pool reach up to this place, with zeros.
fn extend(pool: &mut Vec<u16>, last: usize) {
    if pool.len() <= last {
        grow(pool, last + 1);
        pool.resize(last + 1, 0);
    }
}

/// Makes room for so many, a quarter more than there was at a time: lists of a scan are large, and twice of
/// what is used would be waste.
pub(super) fn grow<T>(list: &mut Vec<T>, needed: usize) {
    let capacity = list.capacity();
    if capacity < needed {
        list.reserve_exact(needed.max(capacity + capacity / 4) - list.len());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bit_of;
    use proptest::prelude::*;
    use std::collections::HashMap;

    fn counts(start: [f64; 3], rays: &[Ray]) -> HashMap<Voxel, (u16, u16)> {
        let mut counts = RayCounts::default();
        // Used before, as it is from the second scan on.
        counts.cast([0.5; 3], &[Ray { end: [40.0, 3.0, -9.0], is_hit: true }]);
        counts.blocks().for_each(TouchedBlock::clear);
        counts.cast(start, rays);
        let mut found = HashMap::new();
        for block in counts.blocks() {
            let corner = block.index.corner();
            for bit in 0..BLOCK_VOXELS {
                let hits = block.hits.as_ref().map_or(0, |hits| hits[bit]);
                if (block.misses[bit], hits) != (0, 0) {
                    let [x, y, z] = bit_of(bit);
                    let voxel = Voxel::new(corner.x + x, corner.y + y, corner.z + z);
                    found.insert(voxel, (block.misses[bit], hits));
                }
            }
            block.clear();
        }
        found
    }

    /// Length of the part of the ray that runs through a voxel, with each face moved outwards by `slack`.
    fn passes(start: [f64; 3], end: [f64; 3], voxel: Voxel, slack: f64) -> bool {
        let (mut enter, mut leave) = (0.0f64, 1.0f64);
        for (axis, index) in [voxel.x, voxel.y, voxel.z].into_iter().enumerate() {
            let d = end[axis] - start[axis];
            let (low, high) = (f64::from(index) - slack, f64::from(index) + 1.0 + slack);
            if d.abs() < 1e-12 {
                if start[axis] < low || start[axis] > high {
                    return false;
                }
            } else {
                let (a, b) = ((low - start[axis]) / d, (high - start[axis]) / d);
                enter = enter.max(a.min(b));
                leave = leave.min(a.max(b));
            }
        }
        enter <= leave
    }

    fn point() -> impl Strategy<Value = [f64; 3]> {
        [-60.0..60.0f64, -60.0..60.0f64, -60.0..60.0f64]
    }

    proptest! {
        #[test]
        fn a_ray_visits_just_the_voxels_that_it_passes(start in point(), end in point()) {
            let found = counts(start, &[Ray { end, is_hit: true }]);
            let last = voxel_of(end);
            let first = voxel_of(start);
            for (voxel, (misses, hits)) in &found {
                prop_assert!(passes(start, end, *voxel, 1e-4), "{voxel:?} is not on the ray");
                prop_assert_eq!(*hits, u16::from(*voxel == last));
                prop_assert_eq!(*misses, u16::from(*voxel != last));
            }
            // Face to face from first to last: as many voxels as there are faces between, and the last.
            let steps = first.x.abs_diff(last.x) + first.y.abs_diff(last.y) + first.z.abs_diff(last.z);
            prop_assert_eq!(found.len() as u32, steps + 1);
        }

        #[test]
        fn many_rays_count_as_the_sum_of_each(
            start in point(), rays in prop::collection::vec((point(), any::<bool>()), 1..60),
        ) {
            let rays: Vec<Ray> = rays.into_iter().map(|(end, is_hit)| Ray { end, is_hit }).collect();
            let mut expected: HashMap<Voxel, (u16, u16)> = HashMap::new();
            for ray in &rays {
                for (voxel, (misses, hits)) in counts(start, &[*ray]) {
                    let sum = expected.entry(voxel).or_default();
                    sum.0 += misses;
                    sum.1 += hits;
                }
            }
            prop_assert_eq!(counts(start, &rays), expected);
        }
    }

    #[test]
    fn rays_along_an_axis_and_within_one_voxel() {
        let along = counts([0.5; 3], &[Ray { end: [3.5, 0.5, 0.5], is_hit: false }]);
        assert_eq!(along.len(), 3);
        assert!((0..3).all(|x| along[&Voxel::new(x, 0, 0)] == (1, 0)));
        let within = counts([0.2; 3], &[Ray { end: [0.8; 3], is_hit: true }]);
        assert_eq!(within, HashMap::from([(Voxel::new(0, 0, 0), (0, 1))]));
        let back = counts([3.0, 0.5, 0.5], &[Ray { end: [0.5, 0.5, 0.5], is_hit: true }]);
        assert_eq!(back.len(), 4);
    }
}
