//! How like a map is to the right one.

use std::collections::{BTreeMap, HashSet};

use flockmap::grid::{BlockIndex, StateBlock};
use flockmap::{MapView, State, Voxel};
use serde::Serialize;

/// A map, and its obstacles.
pub(super) struct Obstacles {
    blocks: BTreeMap<BlockIndex, StateBlock>,
    occupied: HashSet<Voxel>,
    voxel_m: f64,
}

/// A map beside the right one.
#[derive(Serialize, Clone, Copy, Debug)]
pub(super) struct Likeness {
    /// Known voxels.
    pub(super) known: u64,
    pub(super) occupied: u64,
    /// Share of the voxels known in both that are the same.
    pub(super) same: f64,
    /// Share of the obstacles that lie within a voxel of a right one.
    pub(super) near: f64,
    /// Share of the right ones that lie within a voxel of one of them.
    pub(super) found: f64,
    /// How far an obstacle goes on along the axis on which that is least, the mean of all, in metres.
    pub(super) thickness_m: f64,
}

impl Obstacles {
    pub(super) fn of(map: &MapView) -> Self {
        let blocks: BTreeMap<_, _> = map.blocks().collect();
        let occupied = map.voxels().filter(|(_, state)| *state == State::Occupied).map(|(voxel, _)| voxel);
        Self { blocks, occupied: occupied.collect(), voxel_m: map.resolution().metres() }
    }

    /// How like a map is to this one. O(voxels).
    pub(super) fn likeness(&self, map: &MapView) -> Likeness {
        let here = Self::of(map);
        let (mut both, mut same) = (0u64, 0u64);
        for (index, states) in &here.blocks {
            let Some(right) = self.blocks.get(index) else { continue };
            let count = |a: &[u64; 8], b: &[u64; 8]| {
                a.iter().zip(b).map(|(a, b)| u64::from((a & b).count_ones())).sum::<u64>()
            };
            both += count(&states.known(), &right.known());
            same += count(states.occupied(), right.occupied()) + count(states.free(), right.free());
        }
        Likeness {
            known: here.blocks.values().map(|states| u64::from(states.known_count())).sum(),
            occupied: here.occupied.len() as u64,
            same: same as f64 / both.max(1) as f64,
            near: here.share_near(self),
            found: self.share_near(&here),
            thickness_m: here.thickness_m(),
        }
    }

    /// Share of the obstacles that lie within a voxel of one of the others.
    fn share_near(&self, others: &Self) -> f64 {
        let is_near = |v: &&Voxel| {
            (0..27).any(|n| {
                others.occupied.contains(&Voxel::new(v.x + n % 3 - 1, v.y + n / 3 % 3 - 1, v.z + n / 9 - 1))
            })
        };
        self.occupied.iter().filter(is_near).count() as f64 / self.occupied.len().max(1) as f64
    }

    fn thickness_m(&self) -> f64 {
        let run = |at: Voxel, [x, y, z]: [i32; 3]| {
            let steps = (1..).map(|n| Voxel::new(at.x + n * x, at.y + n * y, at.z + n * z));
            steps.take_while(|voxel| self.occupied.contains(voxel)).count()
        };
        let along = |at: Voxel, axis: [i32; 3]| 1 + run(at, axis) + run(at, axis.map(|side| -side));
        let least = |at: &Voxel| {
            [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map(|axis| along(*at, axis)).into_iter().min().unwrap_or(1)
        };
        let sum: usize = self.occupied.iter().map(least).sum();
        sum as f64 / self.occupied.len().max(1) as f64 * self.voxel_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn obstacles(voxels: impl IntoIterator<Item = [i32; 3]>) -> Obstacles {
        let occupied = voxels.into_iter().map(|[x, y, z]| Voxel::new(x, y, z)).collect();
        Obstacles { blocks: BTreeMap::new(), occupied, voxel_m: 0.5 }
    }

    #[test]
    fn a_wall_is_as_thick_as_its_voxels_one_behind_another() {
        let wall = |thick: i32| {
            (0..20).flat_map(move |y| (0..thick).flat_map(move |x| (0..9).map(move |z| [x, y, z])))
        };
        assert!((obstacles(wall(1)).thickness_m() - 0.5).abs() < 1e-9);
        assert!((obstacles(wall(3)).thickness_m() - 1.5).abs() < 1e-9);
        assert!(obstacles([]).thickness_m().abs() < 1e-9);
    }

    #[test]
    fn an_obstacle_is_near_up_to_the_next_voxel() {
        let right = obstacles([[0, 0, 0], [9, 9, 9]]);
        assert!((obstacles([[1, -1, 1], [2, 0, 0]]).share_near(&right) - 0.5).abs() < 1e-9);
        assert!((right.share_near(&obstacles([[1, -1, 1], [2, 0, 0]])) - 0.5).abs() < 1e-9);
    }
}
