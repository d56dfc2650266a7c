//! How a scan is taken into the map.

use super::block::MapBlock;
use super::casting::Casting;
use super::collect::RayMaker;
use super::config::Rules;
use super::rays::Rays;
use super::report::{ScanReport, Sphere};
use super::tally::Tallies;
use super::{Mapper, far_key};
use crate::{BlockIndex, Plane, Pose, Scan, Stamp, StateBlock};

/// Fewer points than this are not worth one more thread.
const POINTS_PER_THREAD: usize = 4_096;

/// A touched block, and the place of its counts.
struct Work<'a> {
    index: BlockIndex,
    place: u32,
    block: &'a mut MapBlock,
}

/// The blocks that one thread updates, and what came of it.
struct Part<'a, 'b> {
    work: &'a mut [Work<'b>],
    touched: Vec<(BlockIndex, Plane)>,
    /// With how many changes there are now.
    changed: Vec<(BlockIndex, StateBlock, u32)>,
}

impl Mapper {
    /// Takes in one scan made at `T_map_sensor`. Points inside one of the spheres of `teammates` are ignored,
    /// so that a robot in sight does not become an obstacle. With a pose that is none, or beyond the grid
    /// ([`Pose::check`]), the whole scan is ignored.
    ///
    /// Cost: grows with the voxels that rays pass (times of LiDARs: `BENCHMARK.md`); memory for what is touched for the
    /// first time.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn insert(&mut self, scan: &Scan, T_map_sensor: &Pose, teammates: &[Sphere]) -> ScanReport {
        self.insert_at(scan.stamp, scan, T_map_sensor, teammates)
    }

    /// The same with another stamp in place of the scan's own.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn insert_at(
        &mut self,
        stamp: Stamp,
        scan: &Scan,
        T_map_sensor: &Pose,
        teammates: &[Sphere],
    ) -> ScanReport {
        let mut report = ScanReport { stamp, ..ScanReport::default() };
        if T_map_sensor.check(self.config.resolution).is_err() {
            report.ignored = scan.points.len() + scan.no_returns.len();
            return report;
        }
        self.place = Some(T_map_sensor.translation());
        report.sensor = self.place;
        let maker = RayMaker::new(&self.config, T_map_sensor, teammates);
        let number = self.next_scan_number(stamp);
        // Out of the way, so that the map can be changed by what they say.
        let mut casting = core::mem::take(&mut self.casting);
        match &mut casting {
            Casting::Once(rays) => self.take_in(rays, scan, &maker, number, &mut report),
            Casting::Bytes(rays) => self.take_in(rays, scan, &maker, number, &mut report),
            Casting::Words(rays) => self.take_in(rays, scan, &maker, number, &mut report),
        }
        self.casting = casting;
        self.note_tables();
        report
    }

    fn take_in<T: Tallies>(
        &mut self,
        rays: &mut Rays<T>,
        scan: &Scan,
        maker: &RayMaker,
        number: u16,
        report: &mut ScanReport,
    ) {
        let points = scan.points.len() + scan.no_returns.len();
        rays.collect(
            (points / POINTS_PER_THREAD).max(1),
            maker,
            [(&scan.points, true), (&scan.no_returns, false)],
            report,
        );
        rays.cast(maker.start(), maker.rays());
        let touched = rays.touched();
        let nearer_than =
            self.forget_far_blocks(maker.start(), touched.iter().map(|(_, index)| *index), report);
        let rules = self.rules;
        let mut places: Vec<(u32, BlockIndex, u32)> = Vec::with_capacity(touched.len());
        for (place, index) in touched {
            if nearer_than.is_some_and(|end| far_key(maker.start(), index) >= end) {
                continue;
            }
            if self.is_over(index) {
                let (misses, hits) = rays.counts(place);
                let update = |block: &mut MapBlock| block.update(&rules, number, &misses, hits.as_ref());
                if !self.revisit(index, report, update) {
                    continue;
                }
            }
            let (_, listed) = self.touch(index, report);
            places.push((listed, index, place));
        }
        places.sort_unstable();
        let blocks = self.blocks.at(places.iter().map(|(listed, ..)| *listed));
        let work = places.iter().zip(blocks).map(|(&(_, index, place), block)| Work { index, place, block });
        let mut work: Vec<Work<'_>> = work.collect();
        let part_len = work.len().div_ceil(rays.used()).max(1);
        let parts =
            work.chunks_mut(part_len).map(|work| Part { work, touched: Vec::new(), changed: Vec::new() });
        let mut parts: Vec<Part<'_, '_>> = parts.collect();
        let rays = &*rays;
        rays.workers().each(&mut parts, |part| part.update(rays, &rules, number));
        let updates: Vec<_> = parts.into_iter().map(|part| (part.touched, part.changed)).collect();
        for (touched, changed) in updates {
            report.touched.extend(touched);
            for (index, states, changes) in changed {
                report.changed.push((index, states));
                self.note_pending(index, changes);
            }
        }
    }
}

impl Part<'_, '_> {
    fn update<T: Tallies>(&mut self, rays: &Rays<T>, rules: &Rules, number: u16) {
        self.touched.reserve_exact(self.work.len());
        self.changed.reserve_exact(self.work.len());
        for Work { index, place, block } in &mut *self.work {
            let before = *block.states();
            let (misses, hits) = rays.counts(*place);
            let touched = block.update(rules, number, &misses, hits.as_ref());
            if *block.states() != before {
                self.changed.push((*index, block.states().minus(&before), block.changes().known_count()));
            }
            if touched != [0; 8] {
                self.touched.push((*index, touched));
            }
        }
    }
}
