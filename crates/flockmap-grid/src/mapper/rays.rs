//! Casting the rays of one scan: how many rays pass through and how many end in each voxel.
//!
//! Rays walk from voxel to voxel across shared faces (Amanatides and Woo, "A Fast Voxel Traversal Algorithm",
//! 1987), eight of about equal length in step ([`group`](super::group)). Each thread has rays and counts of its own
//! ([`tally`](super::tally)); what they counted is added up block by block.

use super::collect::RayMaker;
use super::config::RaysWalked;
use super::group::{Group, Start, Walk};
use super::ray::{Ray, voxel_of};
use super::report::ScanReport;
use super::tally::{LANES, Once, Pool, STEPS_MAX, Tallies, Tally};
use super::window::Window;
use super::workers::Workers;
use crate::{BlockIndex, Voxel};
use fearless_simd::prelude::*;
use fearless_simd::{Level, dispatch};

/// Points that one thread takes before another one's turn.
pub(super) const TURN: usize = 256;

/// The rays of one scan. Reused from scan to scan.
pub(super) struct Rays<T: Tallies> {
    window: Window,
    /// One for each thread; of a small scan fewer are used.
    shares: Vec<Share<T>>,
    used: usize,
    workers: Workers,
}

/// The rays that one thread casts, and its counts.
struct Share<T: Tallies> {
    /// Which one of the shares it is.
    number: usize,
    rays: Vec<Ray>,
    /// The lowest and the highest voxel in which they end.
    ends_within: (Voxel, Voxel),
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

impl<T: Tallies> Rays<T> {
    pub(super) fn new(threads: usize) -> Self {
        Self {
            window: Window::default(),
            shares: (0..threads).map(Share::new).collect(),
            used: 0,
            workers: Workers::new(threads),
        }
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
        self.workers.each(&mut self.shares[..count], |share| {
            dispatch!(level, simd => share.collect(simd, count, maker, points));
        });
        for of_share in self.shares[..count].iter().map(|share| &share.report) {
            report.hits += of_share.hits;
            report.cut += of_share.cut;
            report.ignored += of_share.ignored;
            report.masked += of_share.masked;
        }
    }

    pub(super) const fn workers(&self) -> &Workers {
        &self.workers
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
        for (lowest, highest) in self.shares[..self.used].iter().map(|share| share.ends_within) {
            (low, high) = (low.lowest(lowest), high.highest(highest));
        }
        let window = Window::new(low.block(), high.block());
        self.window = window;
        let start = Start::new(start, from, &window);
        let (workers, shares) = (&self.workers, &mut self.shares[..self.used]);
        if walked == RaysWalked::OnePerEndVoxel {
            workers.each(shares, |share| {
                share.count_hits(&window);
                share.keep_one_per_end_voxel(&window);
            });
            let ends: Vec<Pool<Once>> =
                shares.iter_mut().map(|share| core::mem::take(&mut share.ends)).collect();
            workers.each(shares, |share| share.leave_out(&ends[..share.number], &window));
            shares.iter_mut().zip(ends).for_each(|(share, ends)| share.ends = ends);
        }
        let level = Level::new();
        workers.each(shares, |share| {
            if walked == RaysWalked::All {
                share.count_hits(&window);
            }
            dispatch!(level, simd => share.walk(simd, &start, &window));
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

impl<T: Tallies> Share<T> {
    fn new(number: usize) -> Self {
        Self {
            number,
            rays: Vec::new(),
            ends_within: (Voxel::new(0, 0, 0), Voxel::new(0, 0, 0)),
            report: ScanReport::default(),
            order: Vec::new(),
            misses: T::default(),
            hits: Pool::default(),
            ends: Pool::default(),
            touched: Vec::new(),
        }
    }

    /// No rays, of those that begin in a voxel.
    fn clear(&mut self, from: Voxel) {
        self.rays.clear();
        self.ends_within = (from, from);
    }

    /// One ray more, and the voxel in which it ends.
    #[inline(always)]
    fn push(&mut self, ray: Ray, end: Voxel) {
        self.rays.push(ray);
        let (low, high) = self.ends_within;
        self.ends_within = (low.lowest(end), high.highest(end));
    }

    #[inline(always)]
    fn collect<S: Simd>(
        &mut self,
        simd: S,
        shares: usize,
        maker: &RayMaker,
        points: [(&[[f32; 3]], bool); 2],
    ) {
        self.clear(maker.from());
        let all = points.iter().map(|(points, _)| points.len()).sum::<usize>();
        self.rays.reserve_exact(all.div_ceil(shares).next_multiple_of(TURN) + TURN);
        self.report = ScanReport::default();
        let turns = points.map(|(points, returned)| points.chunks(TURN).map(move |turn| (turn, returned)));
        let count: usize = turns.iter().map(ExactSizeIterator::len).sum();
        for (number, (turn, returned)) in turns.into_iter().flatten().enumerate() {
            let share = match maker.rays() {
                // Neighbours have about equal lengths, so no share has all of the long ones.
                RaysWalked::All => number % shares,
                // In the order of the scan, by which it is known which rays come first.
                RaysWalked::OnePerEndVoxel => number * shares / count,
            };
            if share != self.number {
                continue;
            }
            for points in turn.chunks(LANES) {
                let directions = maker.directions(simd, points);
                for lane in 0..points.len() {
                    if let Some((ray, end)) = maker.ray(&directions, lane, returned, &mut self.report) {
                        self.push(ray, end);
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn walk<S: Simd>(&mut self, simd: S, start: &Start, window: &Window) {
        self.misses.begin(window.blocks());
        self.sort_by_length();
        let order = core::mem::take(&mut self.order);
        let (groups, rest) = order.as_chunks::<LANES>();
        for group in groups {
            self.walk_group(simd, start, group);
        }
        if let Some(&first) = rest.first() {
            let lanes: [u32; LANES] = core::array::from_fn(|lane| *rest.get(lane).unwrap_or(&first));
            let walks = Group::new(simd, start, lanes.map(|ray| &self.rays[ray as usize])).walks();
            self.walk_on(&walks, start, rest, 0);
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

    /// Leaves out the rays to voxels in which rays of shares before this one end.
    fn leave_out(&mut self, others: &[Pool<Once>], window: &Window) {
        if !others.is_empty() {
            self.rays.retain(|ray| !others.iter().any(|ends| ends.contains(ray.end_place(window))));
        }
    }

    /// Longest first, so that the rays of a group end together.
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
    fn walk_group<S: Simd>(&mut self, simd: S, start: &Start, group: &[u32; LANES]) {
        let mut rays = Group::new(simd, start, group.map(|ray| &self.rays[ray as usize]));
        let together = self.rays[group[LANES - 1] as usize].length;
        let mut steps = [[0; LANES]; STEPS_MAX];
        for _ in 0..together as usize / T::STEPS {
            for at in &mut steps[..T::STEPS] {
                rays.advance(at);
            }
            self.misses.add_all(&steps[..T::STEPS]);
        }
        let rest = &mut steps[..together as usize % T::STEPS];
        for at in &mut *rest {
            rays.advance(at);
        }
        self.misses.add_all(rest);
        self.walk_on(&rays.walks(), start, group, together);
    }

    /// Each of some rays for itself, of which so many voxels are done.
    #[inline(always)]
    fn walk_on(&mut self, walks: &[Walk], start: &Start, rays: &[u32], done: u32) {
        for (walk, &ray) in walks.iter().zip(rays) {
            let mut walk = *walk;
            for _ in done..self.rays[ray as usize].length {
                self.misses.add(walk.advance(&start.masks));
            }
        }
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
                share.clear(voxel_of(start));
                for &(end, is_hit) in rays.iter().skip(n).step_by(3) {
                    share.push(Ray::new(voxel_of(start), end, voxel_of(end), is_hit), voxel_of(end));
                }
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
