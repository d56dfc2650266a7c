//! Casting the rays of one scan: how many rays pass through and how many end in each voxel.
//!
//! Rays walk from voxel to voxel across shared faces (Amanatides and Woo, "A Fast Voxel Traversal Algorithm",
//! 1987). Eight rays of about equal length walk in step, so that the compiler can use vector instructions. A
//! place is one number with interleaved fields, `[block z][block y][block x][z][y][x]`, three bits each for the
//! place in the block; a step adds to one field and lets the carry run through the bits between. Counts are kept
//! in blocks taken from a pool at first touch, so that memory follows what the scan sees and not the cube
//! around it.

use super::ScanReport;
use super::collect::RayMaker;
use super::config::RaysWalked;
use super::tally::{LANES, Once, Pool, STEPS_MAX, Tallies, Tally};
use super::window::Window;
use crate::{BlockIndex, Voxel};
use fearless_simd::{Level, dispatch};

/// Points that one thread takes before another one's turn.
pub(super) const TURN: usize = 256;

/// Times along a ray are whole numbers: this is the end of the ray.
const ONE: f64 = (1u32 << 29) as f64;

/// Longer than any ray: the face of an axis that a ray does not move along. One step past the end of the ray
/// plus this still fits 32 bits.
const NEVER: f64 = (1u32 << 30) as f64;

/// A ray in voxel units (metres divided by the resolution), in the frame of the map.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    pub(super) end: [f64; 3],
    pub(super) is_hit: bool,
    /// Voxels before the one in which it ends.
    length: u32,
}

impl Ray {
    #[inline(always)]
    pub(super) fn new(from: Voxel, end: [f64; 3], is_hit: bool) -> Self {
        let to = voxel_of(end);
        Self { end, is_hit, length: from.x.abs_diff(to.x) + from.y.abs_diff(to.y) + from.z.abs_diff(to.z) }
    }
}

/// The voxel in which a point lies. Not by `floor`, which is a call where no vector instructions are asked for.
#[inline(always)]
pub(super) fn voxel_of(p: [f64; 3]) -> Voxel {
    let floor = |v: f64| {
        let towards_zero = v as i32;
        towards_zero - i32::from(f64::from(towards_zero) > v)
    };
    Voxel::new(floor(p[0]), floor(p[1]), floor(p[2]))
}

/// The rays of one scan. Reused from scan to scan.
pub(super) struct Rays<T: Tallies> {
    window: Window,
    /// One for each thread; of a small scan fewer are used.
    shares: Vec<Share<T>>,
    used: usize,
}

/// The rays that one thread casts, and its counts.
struct Share<T: Tallies> {
    /// Which one of the shares it is.
    number: usize,
    rays: Vec<Ray>,
    /// What became of its points.
    report: ScanReport,
    /// Longest first.
    order: Vec<u32>,
    /// Rays that passed through.
    misses: T,
    /// Rays that ended here.
    hits: Pool<T::Block>,
    /// Where rays end, if one of each voxel is walked.
    ends: Pool<Once>,
    /// Blocks in which anything was counted, perhaps twice.
    touched: Vec<u32>,
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
}

impl<T: Tallies> Rays<T> {
    pub(super) fn new(threads: usize) -> Self {
        Self { window: Window::default(), shares: (0..threads).map(Share::new).collect(), used: 0 }
    }

    /// Makes the rays of points, in at most so many threads.
    pub(super) fn collect(
        &mut self,
        threads_max: usize,
        maker: &RayMaker,
        points: [(&[[f32; 3]], bool); 2],
        report: &mut ScanReport,
    ) {
        self.used = threads_max.clamp(1, self.shares.len());
        let count = self.used;
        let level = Level::new();
        each(&mut self.shares[..count], |share| {
            dispatch!(level, _ => share.collect(count, maker, points));
        });
        for of_share in self.shares[..count].iter().map(|share| &share.report) {
            report.hits += of_share.hits;
            report.cut += of_share.cut;
            report.ignored += of_share.ignored;
            report.masked += of_share.masked;
        }
    }

    /// Threads that work on this scan.
    pub(super) const fn used(&self) -> usize {
        self.used
    }

    /// Casts all rays from `start` (voxel units). Start and ends must lie within the voxel limits, and no ray
    /// may be longer than 500 voxels. A voxel that a ray passes through counts one miss, the voxel in which
    /// it ends counts one hit or, for a ray that was cut, nothing.
    pub(super) fn cast(&mut self, start: [f64; 3], walked: RaysWalked) {
        let from = voxel_of(start);
        let (mut low, mut high) = (from, from);
        for end in self.shares[..self.used].iter().flat_map(|share| &share.rays).map(|ray| voxel_of(ray.end))
        {
            (low, high) = (low.lowest(end), high.highest(end));
        }
        let window = Window::new(low.block(), high.block());
        self.window = window;
        let shares = &mut self.shares[..self.used];
        if walked == RaysWalked::OnePerEndVoxel {
            each(shares, |share| {
                share.count_hits(&window);
                share.keep_one_per_end_voxel(&window);
            });
            let ends: Vec<Pool<Once>> =
                shares.iter_mut().map(|share| core::mem::take(&mut share.ends)).collect();
            each(shares, |share| share.leave_out(&ends[..share.number], &window));
            shares.iter_mut().zip(ends).for_each(|(share, ends)| share.ends = ends);
        }
        let level = Level::new();
        each(shares, |share| {
            if walked == RaysWalked::All {
                share.count_hits(&window);
            }
            dispatch!(level, _ => share.walk(start, &window));
        });
    }

    /// The touched blocks, each with its number in the window, ascending.
    pub(super) fn touched(&self) -> Vec<(u32, BlockIndex)> {
        let of_shares = self.shares[..self.used].iter().flat_map(|share| &share.touched);
        let mut blocks: Vec<u32> = of_shares.copied().collect();
        blocks.sort_unstable();
        blocks.dedup();
        blocks.into_iter().map(|block| (block, self.window.block(block))).collect()
    }

    /// The counts of a touched block: misses, and hits if any ray ended there.
    pub(super) fn counts(&self, block: u32) -> (T::Block, Option<T::Block>) {
        let (mut misses, mut hits) = (T::Block::ZERO, None::<T::Block>);
        for share in &self.shares[..self.used] {
            share.misses.block(block).into_iter().for_each(|of_share| misses.merge(of_share));
            if let Some(of_share) = share.hits.block(block) {
                hits.get_or_insert(T::Block::ZERO).merge(of_share);
            }
        }
        (misses, hits)
    }
}

/// Does something with each, in a thread of its own but the first.
pub(super) fn each<S: Send>(items: &mut [S], work: impl Fn(&mut S) + Sync) {
    let Some((first, rest)) = items.split_first_mut() else { return };
    if rest.is_empty() {
        work(first);
        return;
    }
    let work = &work;
    std::thread::scope(|scope| {
        for item in rest {
            scope.spawn(move || work(item));
        }
        work(first);
    });
}

impl<T: Tallies> Share<T> {
    fn new(number: usize) -> Self {
        Self {
            number,
            rays: Vec::new(),
            report: ScanReport::default(),
            order: Vec::new(),
            misses: T::default(),
            hits: Pool::default(),
            ends: Pool::default(),
            touched: Vec::new(),
        }
    }

    #[inline(always)]
    fn collect(&mut self, shares: usize, maker: &RayMaker, points: [(&[[f32; 3]], bool); 2]) {
        self.rays.clear();
        let all = points.iter().map(|(points, _)| points.len()).sum::<usize>();
        self.rays.reserve_exact(all.div_ceil(shares).next_multiple_of(TURN) + TURN);
        self.report = ScanReport::default();
        for (points, returned) in points {
            for turn in points.chunks(TURN).skip(self.number).step_by(shares) {
                for point in turn {
                    self.rays.extend(maker.ray(point, returned, &mut self.report));
                }
            }
        }
    }

    #[inline(always)]
    fn walk(&mut self, start: [f64; 3], window: &Window) {
        self.misses.begin(window.blocks());
        self.sort_by_length();
        let order = core::mem::take(&mut self.order);
        let (groups, rest) = order.as_chunks::<LANES>();
        for group in groups {
            self.walk_group(start, window, group);
        }
        for &ray in rest {
            let ray = &self.rays[ray as usize];
            let (walk, length) = (ray.walk(start, window), ray.length);
            self.walk_one(walk, window, length);
        }
        self.order = order;
        self.touched.clear();
        self.misses.end(&mut self.touched);
        self.hits.end(&mut self.touched);
    }

    fn count_hits(&mut self, window: &Window) {
        self.hits.begin(window.blocks());
        for ray in self.rays.iter().filter(|ray| ray.is_hit) {
            self.hits.add(ray.end_place(window));
        }
    }

    fn keep_one_per_end_voxel(&mut self, window: &Window) {
        self.ends.begin(window.blocks());
        let ends = &mut self.ends;
        self.rays.retain(|ray| {
            let place = ray.end_place(window);
            let is_first = !ends.contains(place);
            ends.add(place);
            is_first
        });
    }

    /// Leaves out the rays to voxels in which rays of other shares end.
    fn leave_out(&mut self, others: &[Pool<Once>], window: &Window) {
        if !others.is_empty() {
            self.rays.retain(|ray| !others.iter().any(|ends| ends.contains(ray.end_place(window))));
        }
    }

    /// Longest first, equal lengths in the order of the scan, so that the rays of a group end together.
    fn sort_by_length(&mut self) {
        let longest = self.rays.iter().map(|ray| ray.length).max().unwrap_or(0) as usize;
        let mut starts = vec![0u32; longest + 2];
        for ray in &self.rays {
            starts[longest - ray.length as usize + 1] += 1;
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let ends = starts.clone();
        self.order.clear();
        self.order.reserve_exact(self.rays.len());
        self.order.resize(self.rays.len(), 0);
        for (number, ray) in self.rays.iter().enumerate() {
            let at = &mut starts[longest - ray.length as usize];
            self.order[*at as usize] = number as u32;
            *at += 1;
        }
        // Rays that follow one another in the scan pass the same voxels, and would wait for each other: those of a group
        // are far apart.
        let mut apart = Vec::new();
        for bucket in ends.windows(2) {
            let bucket = &mut self.order[bucket[0] as usize..bucket[1] as usize];
            let rows = bucket.len() / LANES;
            apart.clear();
            apart.extend_from_slice(&bucket[..rows * LANES]);
            for row in 0..rows {
                for lane in 0..LANES {
                    bucket[row * LANES + lane] = apart[lane * rows + row];
                }
            }
        }
    }

    #[inline(always)]
    fn walk_group(&mut self, start: [f64; 3], window: &Window, group: &[u32; LANES]) {
        let mut place = [[0u32; LANES]; 3];
        let mut step = [[0u32; LANES]; 3];
        let mut next = [[0i32; LANES]; 3];
        let mut delta = [[0i32; LANES]; 3];
        for (lane, &ray) in group.iter().enumerate() {
            let walk = self.rays[ray as usize].walk(start, window);
            for axis in 0..3 {
                place[axis][lane] = walk.place[axis];
                step[axis][lane] = walk.step[axis];
                next[axis][lane] = walk.next[axis];
                delta[axis][lane] = walk.delta[axis];
            }
        }
        let masks = window.masks;
        let together = self.rays[group[LANES - 1] as usize].length;
        let mut steps = [[0u32; LANES]; STEPS_MAX];
        let mut done = 0;
        while done < together {
            let count = T::STEPS.min((together - done) as usize);
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
            self.misses.add_all(&steps[..count]);
            done += count as u32;
        }
        for (lane, &ray) in group.iter().enumerate() {
            let length = self.rays[ray as usize].length;
            if length > together {
                let at = |of: &[[u32; LANES]; 3]| core::array::from_fn(|axis| of[axis][lane]);
                let time = |of: &[[i32; LANES]; 3]| core::array::from_fn(|axis| of[axis][lane]);
                let walk =
                    Walk { place: at(&place), step: at(&step), next: time(&next), delta: time(&delta) };
                self.walk_one(walk, window, length - together);
            }
        }
    }

    /// Walks one ray for so many voxels.
    #[inline(always)]
    fn walk_one(&mut self, mut walk: Walk, window: &Window, length: u32) {
        for _ in 0..length {
            let [x, y, z] = walk.place;
            self.misses.add(x | y | z);
            let [x, y, z] = walk.next;
            let axis = if x <= y && x <= z {
                0
            } else if y <= z {
                1
            } else {
                2
            };
            walk.next[axis] = walk.next[axis].wrapping_add(walk.delta[axis]);
            walk.place[axis] = walk.place[axis].wrapping_add(walk.step[axis]) & window.masks[axis];
        }
    }
}

impl Ray {
    /// Place of the voxel in which it ends.
    fn end_place(&self, window: &Window) -> u32 {
        let [x, y, z] = window.place(voxel_of(self.end));
        x | y | z
    }

    #[inline(always)]
    fn walk(&self, start: [f64; 3], window: &Window) -> Walk {
        let from = voxel_of(start);
        let mut walk = Walk { place: window.place(from), ..Walk::default() };
        let from = [from.x, from.y, from.z];
        for axis in 0..3 {
            let direction = self.end[axis] - start[axis];
            let fraction = start[axis] - f64::from(from[axis]);
            let unit = 1u32 << (3 * axis);
            let inverse = ONE / direction.abs();
            let to_face;
            if direction > 0.0 {
                walk.step[axis] = (!window.masks[axis]).wrapping_add(unit);
                to_face = 1.0 - fraction;
            } else {
                walk.step[axis] = unit.wrapping_neg();
                to_face = fraction;
            }
            // A direction of zero gives an infinite inverse, and 0 · ∞ is not a number: `min` takes the
            // other.
            walk.next[axis] = ((to_face * inverse).min(NEVER) + 0.5) as i32;
            walk.delta[axis] = (inverse.min(NEVER) + 0.5) as i32;
        }
        walk
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BLOCK_VOXELS;
    use proptest::prelude::*;
    use std::collections::HashMap;

    fn counts(start: [f64; 3], rays: &[([f64; 3], bool)]) -> HashMap<Voxel, (u16, u16)> {
        let mut cast = Rays::<Pool<[u16; BLOCK_VOXELS]>>::new(3);
        let mut found = HashMap::new();
        // Used before, as it is from the second scan on.
        for (start, rays) in [([0.5; 3], &[([40.0, 3.0, -9.0], true)][..]), (start, rays)] {
            found.clear();
            cast.used = 3;
            for (n, share) in cast.shares.iter_mut().enumerate() {
                share.rays.clear();
                let own = rays.iter().skip(n).step_by(3);
                share.rays.extend(own.map(|&(end, is_hit)| Ray::new(voxel_of(start), end, is_hit)));
            }
            cast.cast(start, RaysWalked::All);
            for (place, index) in cast.touched() {
                let (misses, hits) = cast.counts(place);
                let hits = hits.unwrap_or([0; BLOCK_VOXELS]);
                let counts = (0..BLOCK_VOXELS).map(|bit| (index.voxel(bit), (misses[bit], hits[bit])));
                found.extend(counts.filter(|(_, counts)| *counts != (0, 0)));
            }
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
            let found = counts(start, &[(end, true)]);
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
        let along = counts([0.5; 3], &[([3.5, 0.5, 0.5], false)]);
        assert_eq!(along.len(), 3);
        assert!((0..3).all(|x| along[&Voxel::new(x, 0, 0)] == (1, 0)));
        let within = counts([0.2; 3], &[([0.8; 3], true)]);
        assert_eq!(within, HashMap::from([(Voxel::new(0, 0, 0), (0, 1))]));
        let back = counts([3.0, 0.5, 0.5], &[([0.5, 0.5, 0.5], true)]);
        assert_eq!(back.len(), 4);
    }
}
