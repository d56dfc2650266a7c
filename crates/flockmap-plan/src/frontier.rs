//! Where the known meets the unknown.

use flockmap_grid::{BlockIndex, MapView, Plane, StateBlock, Voxel, VoxelBox, plane_within, set_bits};

use crate::lattice::{Lattice, distance, flood};
use crate::space::TooLarge;

/// Most voxels of a box that is searched for clusters: 2²⁸ (100 × 100 × 26 m at 0.1 m), for which 64 MiB are held
/// meanwhile.
const VOXELS_MAX: u64 = 1 << 28;

/// How frontier cells make clusters.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FrontierConfig {
    /// A cluster reaches no further than this from its first cell, in metres between centres. Default 1.5.
    pub reach_m: f64,
    /// Fewer cells are no cluster. Default 6.
    pub cells_min: usize,
}

impl Default for FrontierConfig {
    fn default() -> Self {
        Self { reach_m: 1.5, cells_min: 6 }
    }
}

/// Free voxels beside Unknown ones, near each other (Yamauchi, "A frontier-based approach for autonomous
/// exploration", CIRA 1997; of limited reach as in Zhou et al., "FUEL", RA-L 2021).
#[derive(Clone, PartialEq, Debug)]
pub struct Frontier {
    /// The voxels.
    pub voxels: Vec<Voxel>,
    /// The middle of their centres in metres, in the frame of the map. It need not lie in one of them.
    pub centroid_m: [f64; 3],
    /// The smallest box that holds them.
    pub bounds: VoxelBox,
}

/// The Free voxels of a box that share a face with an Unknown voxel of the box, by block, ascending. What lies outside
/// is of no interest: there the Unknown makes no frontier. O(blocks of the box or of the regions of the map that it
/// meets, whichever are fewer).
pub fn frontier_cells(view: &MapView, region: &VoxelBox) -> Vec<(BlockIndex, Plane)> {
    let (low, high) = (region.min(), region.max());
    let (first, last) = (low.block(), high.block());
    let view = &view.open_in(region);
    let unknown = |[x, y, z]: [i32; 3]| -> Plane {
        let index = BlockIndex::new(x, y, z);
        let inside = if first.x < x && x < last.x && first.y < y && y < last.y && first.z < z && z < last.z {
            [u64::MAX; 8]
        } else {
            plane_within(index, low, high)
        };
        let of_block = |block: &StateBlock| {
            let known = block.known();
            core::array::from_fn(|slice| inside[slice] & !known[slice])
        };
        view.with_block(index, of_block).unwrap_or(inside)
    };
    let frontier = |index: BlockIndex, block: &StateBlock| {
        if *block.free() == [0; 8] {
            return None;
        }
        let BlockIndex { x, y, z } = index;
        let own = unknown([x, y, z]);
        let beside = [
            unknown([x - 1, y, z]),
            unknown([x + 1, y, z]),
            unknown([x, y - 1, z]),
            unknown([x, y + 1, z]),
            unknown([x, y, z - 1]),
            unknown([x, y, z + 1]),
        ];
        let inside = plane_within(index, low, high);
        let near = beside_any(&own, &beside);
        let cells: Plane = core::array::from_fn(|slice| block.free()[slice] & inside[slice] & near[slice]);
        (cells != [0; 8]).then_some((index, cells))
    };
    let mut cells = Vec::new();
    view.for_each_in(region, |index, block| cells.extend(frontier(index, block)));
    cells.sort_unstable_by_key(|(index, _)| *index);
    cells
}

/// The voxels of a block that share a face with a set bit: of the block's own plane, or of the planes of the blocks
/// before and behind it along x, y and z.
fn beside_any(own: &Plane, [x_low, x_high, y_low, y_high, z_low, z_high]: &[Plane; 6]) -> Plane {
    const FIRST_X: u64 = 0x0101_0101_0101_0101;
    core::array::from_fn(|z| {
        let along_x = (own[z] << 1) & !FIRST_X
            | (x_low[z] >> 7) & FIRST_X
            | (own[z] & !FIRST_X) >> 1
            | (x_high[z] & FIRST_X) << 7;
        let along_y = own[z] << 8 | y_low[z] >> 56 | own[z] >> 8 | y_high[z] << 56;
        let below = if z == 0 { z_low[7] } else { own[z - 1] };
        let above = if z == 7 { z_high[0] } else { own[z + 1] };
        along_x | along_y | below | above
    })
}

/// The clusters of the [`frontier_cells`] of a box, by their first voxels in the order z, y, x. Each voxel is in one of
/// them at most. O(voxels of the box) in bits, and some 26 steps for each frontier voxel.
///
/// # Errors
/// The box has more than 2²⁸ voxels.
pub fn frontiers(
    view: &MapView,
    region: &VoxelBox,
    config: &FrontierConfig,
) -> Result<Vec<Frontier>, TooLarge> {
    TooLarge::check("a search for frontiers", region, region.volume(), VOXELS_MAX)?;
    let lattice = Lattice::of_voxels(region, view.resolution());
    let mut open = Bits::new(lattice.count());
    for (index, cells) in frontier_cells(view, region) {
        for voxel in set_bits(&cells).map(|bit| index.voxel(bit)) {
            if let Some(cell) = lattice.number_of([voxel.x, voxel.y, voxel.z]) {
                open.set(cell, true);
            }
        }
    }
    let clusters = Clusters::new(lattice, *config).find(open.ones(), |cell| open.get(cell));
    let frontier = |cluster: Cluster| {
        let voxel = |cell: &u32| {
            let [x, y, z] = lattice.index(*cell as usize);
            Voxel::new(x, y, z)
        };
        let voxels: Vec<Voxel> = cluster.cells.iter().map(voxel).collect();
        let ends = voxels.iter().fold(None, |ends: Option<[Voxel; 2]>, voxel| {
            let [low, high] = ends.unwrap_or([*voxel; 2]);
            Some([low.lowest(*voxel), high.highest(*voxel)])
        });
        let bounds = ends.and_then(|[low, high]| VoxelBox::spanning(low, high))?;
        Some(Frontier { voxels, centroid_m: cluster.centroid_m, bounds })
    };
    Ok(clusters.into_iter().filter_map(frontier).collect())
}

/// Cells of a lattice that hang together.
#[derive(Clone, PartialEq, Debug)]
pub struct Cluster {
    /// Their numbers, the first cell first, the others as they are reached.
    pub cells: Vec<u32>,
    /// The middle of their centres in metres.
    pub centroid_m: [f64; 3],
}

/// Clusters of cells of a lattice, whatever they are cells of. Each cell is in one cluster at most. A bit a cell.
///
/// ```
/// use flockmap_plan::{Clusters, FrontierConfig, lattice::Lattice};
///
/// let mut clusters = Clusters::new(Lattice::new([7, 1, 1]), FrontierConfig { reach_m: 2.0, cells_min: 2 });
/// let found = clusters.find(0..7, |cell| cell != 3);
/// assert_eq!(found.iter().map(|cluster| &cluster.cells[..]).collect::<Vec<_>>(), [[0, 1, 2], [4, 5, 6]]);
/// assert_eq!(found[1].centroid_m, [5.5, 0.5, 0.5]);
/// // What was found is not found again, until it is released.
/// clusters.release(&[5, 6]);
/// assert_eq!(clusters.find(0..7, |cell| cell != 3)[0].cells, [5, 6]);
/// ```
#[derive(Clone, Debug)]
pub struct Clusters {
    lattice: Lattice,
    config: FrontierConfig,
    claimed: Bits,
}

impl Clusters {
    /// None yet.
    pub fn new(lattice: Lattice, config: FrontierConfig) -> Self {
        Self { lattice, config, claimed: Bits::new(lattice.count()) }
    }

    /// Marks cells as those of a cluster.
    pub fn claim(&mut self, cells: &[u32]) {
        cells.iter().for_each(|cell| self.claimed.set(*cell as usize, true));
    }

    /// Marks cells as those of none.
    pub fn release(&mut self, cells: &[u32]) {
        cells.iter().for_each(|cell| self.claimed.set(*cell as usize, false));
    }

    /// New clusters of cells that belong to none yet. Each grows from the first of `seeds` that `belongs`, over cells that
    /// do and share a face, an edge or a corner, as far as clusters reach. Where fewer hang together than make a
    /// cluster, they stay free to belong to another.
    pub fn find(
        &mut self,
        seeds: impl IntoIterator<Item = usize>,
        belongs: impl Fn(usize) -> bool,
    ) -> Vec<Cluster> {
        let mut found = Vec::new();
        for seed in seeds {
            if self.claimed.get(seed) || !belongs(seed) {
                continue;
            }
            let cells = self.grow(seed, &belongs);
            if cells.len() >= self.config.cells_min {
                found.push(Cluster { centroid_m: self.lattice.middle(&cells), cells });
            } else {
                self.release(&cells);
            }
        }
        found
    }

    fn grow(&mut self, seed: usize, belongs: impl Fn(usize) -> bool) -> Vec<u32> {
        let Self { lattice, config, claimed } = self;
        let origin = lattice.centre(seed);
        claimed.set(seed, true);
        let around = |cell| lattice.around(cell).map(|(next, _)| next);
        flood(vec![seed as u32], around, |_, next| {
            let is_new = !claimed.get(next)
                && belongs(next)
                && distance(lattice.centre(next), origin) <= config.reach_m;
            if is_new {
                claimed.set(next, true);
            }
            is_new
        })
    }
}

/// A set of numbers.
#[derive(Clone, Debug)]
struct Bits(Vec<u64>);

impl Bits {
    fn new(count: usize) -> Self {
        Self(vec![0; count.div_ceil(64)])
    }

    fn get(&self, at: usize) -> bool {
        self.0[at / 64] >> (at % 64) & 1 == 1
    }

    fn set(&mut self, at: usize, is_set: bool) {
        let mask = 1 << (at % 64);
        if is_set {
            self.0[at / 64] |= mask;
        } else {
            self.0[at / 64] &= !mask;
        }
    }

    /// The numbers in the set, ascending.
    fn ones(&self) -> impl Iterator<Item = usize> {
        self.0.iter().enumerate().flat_map(|(at, word)| {
            let mut left = *word;
            core::iter::from_fn(move || {
                let bit = left.trailing_zeros() as usize;
                (left != 0).then(|| left &= left - 1)?;
                Some(at * 64 + bit)
            })
        })
    }
}
