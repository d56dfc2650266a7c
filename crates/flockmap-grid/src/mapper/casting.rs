//! How a scan is taken into the map.

use super::block::MapBlock;
use super::collect::RayMaker;
use super::config::Rules;
use super::rays::Rays;
use super::tally::{Bits, Pool, Tallies};
use super::{Mapper, ScanReport, far_key};
use crate::{BLOCK_VOXELS, BlockIndex, Plane, Scan, StateBlock};

/// Points for which one more thread is worth its while.
const WORTH: usize = 4_096;

/// The rays of a scan, with the smallest counts that the rules allow.
pub(super) enum Casting {
    Once(Rays<Bits>),
    Bytes(Rays<Pool<[u8; BLOCK_VOXELS]>>),
    Words(Rays<Pool<[u16; BLOCK_VOXELS]>>),
}

impl Casting {
    pub(super) fn new(rules: &Rules, threads: usize) -> Self {
        match rules.rays_max {
            0..=1 => Self::Once(Rays::new(threads)),
            2..=255 => Self::Bytes(Rays::new(threads)),
            _ => Self::Words(Rays::new(threads)),
        }
    }
}

impl Default for Casting {
    fn default() -> Self {
        Self::Once(Rays::new(0))
    }
}

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
    pub(super) fn take_in<T: Tallies>(
        &mut self,
        rays: &mut Rays<T>,
        scan: &Scan,
        maker: &RayMaker,
        number: u16,
        report: &mut ScanReport,
    ) {
        let points = scan.points.len() + scan.no_returns.len();
        rays.collect(
            (points / WORTH).max(1),
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
        let parts = work.len().div_ceil(rays.used()).max(1);
        let parts =
            work.chunks_mut(parts).map(|work| Part { work, touched: Vec::new(), changed: Vec::new() });
        let mut parts: Vec<Part<'_, '_>> = parts.collect();
        let rays = &*rays;
        rays.workers().each(&mut parts, |part| part.update(rays, &rules, number));
        let parts: Vec<_> = parts.into_iter().map(|part| (part.touched, part.changed)).collect();
        for (touched, changed) in parts {
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
