//! Cutting changes, or a snapshot, in two.

use std::collections::BTreeMap;

use flockmap_grid::{Changes, Plane, Stamp, StateBlock, Voxel, VoxelBox};

/// What will be one package, or be cut further.
pub(crate) struct Piece {
    /// All voxels of the piece. Never empty.
    pub(crate) states: Changes,
    /// The same voxels by stamp; empty for changes, which have one stamp.
    pub(crate) parts: Vec<(Stamp, Changes)>,
    /// The tight box around them.
    pub(crate) region: VoxelBox,
    /// How uneven it is: what the size of a zlib payload goes with, better than with the number of voxels.
    pub(crate) edges: usize,
}

impl Piece {
    /// `None` if there is nothing in it, or a voxel lies outside of the limits of the grid.
    pub(crate) fn new(states: Changes, parts: Vec<(Stamp, Changes)>) -> Option<Self> {
        let region = states.bounding_box()?;
        let edges = states.blocks().iter().map(|(_, block)| edges(block)).sum();
        Some(Self { states, parts, region, edges })
    }

    /// Cuts across the longest side of the box, so that `head / of` of the voxels, or of the edges, come
    /// first, or as near to that as whole slices allow. `None` if there is but one voxel.
    pub(crate) fn cut(&self, head: usize, of: usize, measure: Measure) -> Option<[Self; 2]> {
        let size = self.region.size();
        let axis = (0..3).rev().max_by_key(|&axis| size[axis])?;
        if size[axis] < 2 {
            return None;
        }
        let counts = slice_counts(&self.states, axis, measure);
        let total: usize = counts.iter().map(|(_, count)| count).sum();
        let wanted = total * head / of.max(1);
        // The last slice that goes first; both sides have voxels.
        let mut sum = 0;
        let best = counts.iter().take(counts.len().saturating_sub(1)).min_by_key(|(_, count)| {
            sum += count;
            sum.abs_diff(wanted)
        });
        let (last, _) = *best?;

        let (min, max) = (self.region.min(), self.region.max());
        let (mut head_max, mut tail_min) = (max, min);
        *coordinate(&mut head_max, axis) = last;
        *coordinate(&mut tail_min, axis) = last + 1;
        Some([
            self.within(&VoxelBox::spanning(min, head_max)?)?,
            self.within(&VoxelBox::spanning(tail_min, max)?)?,
        ])
    }

    fn within(&self, region: &VoxelBox) -> Option<Self> {
        let parts = self.parts.iter().map(|(stamp, part)| (*stamp, part.within(region)));
        let parts = parts.filter(|(_, part)| !part.is_empty()).collect();
        Self::new(self.states.within(region), parts)
    }
}

/// What of a piece is to be divided evenly.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Measure {
    Voxels,
    Edges,
}

/// Counts the neighbours along x, y and z in the block of which one is known, or Occupied, and the other is
/// not.
fn edges(block: &StateBlock) -> usize {
    let of_plane = |plane: &Plane| -> u32 {
        let mut below = 0;
        let mut count = 0;
        for &slice in plane {
            let along_x = slice ^ (slice << 1 & 0xfefe_fefe_fefe_fefe);
            let along_y = slice ^ slice << 8;
            count += along_x.count_ones() + along_y.count_ones() + (slice ^ below).count_ones();
            below = slice;
        }
        count
    };
    (of_plane(&block.known()) + of_plane(block.occupied())) as usize
}

fn coordinate(voxel: &mut Voxel, axis: usize) -> &mut i32 {
    match axis {
        0 => &mut voxel.x,
        1 => &mut voxel.y,
        _ => &mut voxel.z,
    }
}

/// How many voxels or edges there are in each slice across `axis` that has voxels, however far apart they
/// are; in ascending order. The edges of a block are shared out among its slices by their voxels.
fn slice_counts(states: &Changes, axis: usize, measure: Measure) -> Vec<(i32, usize)> {
    // By blocks, of which there are fewer than slices.
    let mut counts = BTreeMap::<i32, [Option<usize>; 8]>::new();
    for (index, block) in states.blocks() {
        let slices = counts.entry(*coordinate(&mut index.corner(), axis)).or_default();
        let known = block.known();
        let (weight, voxels) = match measure {
            Measure::Voxels => (1, 1),
            Measure::Edges => (edges(block), block.known_count().max(1) as usize),
        };
        for (slice, sum) in slices.iter_mut().enumerate() {
            let count: u32 = match axis {
                0 => known.iter().map(|word| (word & (0x0101_0101_0101_0101 << slice)).count_ones()).sum(),
                1 => known.iter().map(|word| (word & (0xff << (8 * slice))).count_ones()).sum(),
                _ => known[slice].count_ones(),
            };
            if count > 0 {
                *sum = Some(sum.unwrap_or(0) + count as usize * weight / voxels);
            }
        }
    }
    let slices = counts.into_iter().flat_map(|(first, slices)| (first..).zip(slices));
    slices.filter_map(|(slice, count)| Some((slice, count?))).collect()
}
