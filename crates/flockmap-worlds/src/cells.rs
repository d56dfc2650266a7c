//! A sparse set of cells with fast exact ray casts: what is solid in a world.

use flockmap_grid::{Voxel, VoxelBox};
use flockmap_plan::lattice::Lattice;

/// Cells along one side of a chunk.
const CHUNK: i32 = 16;

/// Cells along one side of a brick.
const BRICK: i32 = 4;

/// Most chunks that a set may span: 2²⁴, for which its tables take 80 MiB (a cube 4,096 cells wide).
const CHUNKS_SPANNED_MAX: usize = 1 << 24;

/// Most chunks that may hold cells: 2¹⁸, together 130 MiB.
const CHUNKS_FILLED_MAX: usize = 1 << 18;

/// 16³ cells as 4³ bricks of 4³ cells.
#[derive(Clone, Debug)]
struct Chunk {
    /// Which bricks hold a cell.
    filled: u64,
    bricks: [u64; 64],
}

/// A sparse set of cells within a box. Empty space costs 5 bytes for each 16³ cells.
#[derive(Clone, Debug)]
pub(crate) struct CellSet {
    region: VoxelBox,
    /// The chunks of the region as cells.
    lattice: Lattice,
    /// For each chunk of the region 0, or one more than its place in `chunks`.
    table: Vec<u32>,
    chunks: Vec<Chunk>,
    /// For each chunk the distance (largest of the three axes, in chunks) to the nearest chunk that holds a
    /// cell. Made by [`CellSet::seal`]; until then all zero, which is right but slow.
    gap: Vec<u8>,
}

/// Why a set could not be made or grow.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct TooLarge;

impl CellSet {
    /// An empty set for the cells of `region`.
    pub(crate) fn new(region: VoxelBox) -> Result<Self, TooLarge> {
        let (low, high) = (chunk_of(region.min()), chunk_of(region.max()));
        let size: [usize; 3] = core::array::from_fn(|a| high[a].abs_diff(low[a]) as usize + 1);
        let count = size.into_iter().try_fold(1usize, usize::checked_mul);
        let count = count.filter(|&n| n <= CHUNKS_SPANNED_MAX).ok_or(TooLarge)?;
        let lattice = Lattice::new(size).placed([0.0; 3], low, f64::from(CHUNK));
        Ok(Self { region, lattice, table: vec![0; count], chunks: Vec::new(), gap: vec![0; count] })
    }

    /// The box that all cells lie in.
    pub(crate) const fn region(&self) -> VoxelBox {
        self.region
    }

    /// Adds a cell. A cell outside of the region is left out.
    pub(crate) fn insert(&mut self, cell: Voxel) -> Result<(), TooLarge> {
        if !self.region.contains(cell) {
            return Ok(());
        }
        let Some(at) = self.lattice.number_of(chunk_of(cell)) else { return Ok(()) };
        if self.table[at] == 0 {
            if self.chunks.len() == CHUNKS_FILLED_MAX {
                return Err(TooLarge);
            }
            self.chunks.push(Chunk { filled: 0, bricks: [0; 64] });
            self.table[at] = self.chunks.len() as u32;
        }
        let chunk = &mut self.chunks[self.table[at] as usize - 1];
        let brick = brick_bit(cell);
        chunk.bricks[brick] |= 1 << cell_bit(cell);
        chunk.filled |= 1 << brick;
        Ok(())
    }

    /// Adds all cells of a box that lie in the region.
    pub(crate) fn insert_box(&mut self, cells: &VoxelBox) -> Result<(), TooLarge> {
        let Some(part) = cells.intersection(&self.region) else { return Ok(()) };
        let (low, high) = (chunk_of(part.min()), chunk_of(part.max()));
        let chunks = (0..3).map(|a| i64::from(high[a] - low[a]) + 1).product::<i64>();
        if chunks > CHUNKS_FILLED_MAX as i64 {
            return Err(TooLarge);
        }
        // Brick by brick; one cell makes room for the brick that is then filled.
        for corner in bricks_of(&part) {
            let brick = VoxelBox::new(corner, [BRICK as u32; 3]);
            let Some(inside) = brick.and_then(|brick| brick.intersection(&part)) else { continue };
            self.insert(inside.min())?;
            if inside.volume() > 1
                && let Some(chunk) = self.chunk_at(corner)
            {
                let mask = inside.voxels().fold(0u64, |mask, cell| mask | 1 << cell_bit(cell));
                self.chunks[chunk].bricks[brick_bit(corner)] |= mask;
            }
        }
        Ok(())
    }

    /// Takes a cell out.
    pub(crate) fn remove(&mut self, cell: Voxel) {
        let Some(chunk) = self.chunk_at(cell) else { return };
        let chunk = &mut self.chunks[chunk];
        let brick = brick_bit(cell);
        chunk.bricks[brick] &= !(1 << cell_bit(cell));
        if chunk.bricks[brick] == 0 {
            chunk.filled &= !(1 << brick);
        }
    }

    /// Whether the cell is in the set.
    pub(crate) fn contains(&self, cell: Voxel) -> bool {
        self.brick(cell) >> cell_bit(cell) & 1 != 0
    }

    /// Whether any cell of a box is in the set. Goes by bricks of 4³ cells.
    pub(crate) fn contains_any(&self, cells: &VoxelBox) -> bool {
        let Some(part) = cells.intersection(&self.region) else { return false };
        bricks_of(&part).any(|corner| Bits(self.brick(corner)).any(|bit| part.contains(cell_of(corner, bit))))
    }

    /// Every cell, in an order that depends only on which cells there are.
    pub(crate) fn iter(&self) -> impl Iterator<Item = Voxel> + '_ {
        self.bricks().flat_map(|(corner, brick)| Bits(brick).map(move |bit| cell_of(corner, bit)))
    }

    /// Every brick of 4³ cells that is not empty, with its lowest cell; bit `z·16 + y·4 + x` is a cell.
    pub(crate) fn bricks(&self) -> impl Iterator<Item = (Voxel, u64)> + '_ {
        let chunks = (0..self.table.len()).filter_map(|slot| Some((slot, self.filled_chunk(slot)?)));
        chunks.flat_map(|(slot, chunk)| {
            let low = self.lattice.index(slot).map(|c| c * CHUNK);
            Bits(chunk.filled).map(move |b| {
                let cell = Voxel::new(low[0] + (b & 3) * 4, low[1] + (b >> 2 & 3) * 4, low[2] + (b >> 4) * 4);
                (cell, chunk.bricks[b as usize])
            })
        })
    }

    /// The cells of the brick that a cell is in; bits as in [`Self::bricks`].
    pub(crate) fn brick(&self, cell: Voxel) -> u64 {
        self.chunk_at(cell).map_or(0, |chunk| self.chunks[chunk].bricks[brick_bit(cell)])
    }

    /// Prepares for ray casts: finds for each chunk how far it is to the next one that holds a cell.
    pub(crate) fn seal(&mut self) {
        for slot in 0..self.table.len() {
            self.gap[slot] = if self.filled_chunk(slot).is_some() { 0 } else { u8::MAX };
        }
        self.lattice.spread(&mut self.gap, |distance| distance as u8, u8::max);
    }

    /// The first cell of the set that a ray enters, and where: `origin` and `direction` in cells,
    /// `length_max` in multiples of `direction`. A ray that starts in a cell of the set enters it at 0.
    ///
    /// Gives exactly the cell and the number that a step-by-step Amanatides–Woo walk gives, whatever it
    /// skips: a boundary at index k along an axis is always crossed at `(k − origin) · (1 / direction)`, and
    /// of crossings at the same place the one of the lower axis comes first. Chunks, bricks and cells are
    /// walked by that one rule, so a walk through chunks leaves each where the walk through its cells would.
    pub(crate) fn cast(
        &self,
        origin: [f64; 3],
        direction: [f64; 3],
        length_max: f64,
    ) -> Option<(Voxel, f64)> {
        let ray = Ray::new(origin, direction)?;
        let [first, last] = self.lattice.ends();
        let (mut at, mut index) = ray.enter(first, last)?;
        let mut next = ray.crossings::<CHUNK>(index);
        while at.t <= length_max {
            let slot = self.lattice.number_of(index)?;
            if let Some(chunk) = self.filled_chunk(slot) {
                if let Some((cell, t)) = ray.cast_in_chunk(chunk, index, at) {
                    return (t <= length_max).then_some((cell, t));
                }
            } else if self.gap[slot] > 2 {
                // All chunks up to this far around are empty: leave them at once.
                let reach = i32::from(self.gap[slot]) - 1;
                let far = core::array::from_fn(|a| index[a] + ray.step[a] * reach);
                at = Crossing::first(ray.crossings::<CHUNK>(far))?;
                for a in 0..3 {
                    index[a] = if a == at.axis {
                        far[a] + ray.step[a]
                    } else {
                        ray.index::<CHUNK>(a, index[a], far[a], at)
                    };
                }
                next = ray.crossings::<CHUNK>(index);
                continue;
            }
            (at, _) = ray.advance::<CHUNK>(&mut index, &mut next)?;
        }
        None
    }

    /// Where in `chunks` the chunk of a cell is, if there is one.
    fn chunk_at(&self, cell: Voxel) -> Option<usize> {
        let slot = self.lattice.number_of(chunk_of(cell))?;
        (self.table[slot] as usize).checked_sub(1)
    }

    /// The chunk with this number among those of the region, if it holds a cell.
    #[inline]
    fn filled_chunk(&self, slot: usize) -> Option<&Chunk> {
        let chunk = self.chunks.get((self.table[slot] as usize).checked_sub(1)?)?;
        (chunk.filled != 0).then_some(chunk)
    }
}

/// A ray in cells. Places along it are in multiples of its direction.
struct Ray {
    origin: [f64; 3],
    direction: [f64; 3],
    inverse: [f64; 3],
    step: [i32; 3],
    /// 1 on axes along which the ray goes up.
    ahead: [i32; 3],
    start: [i32; 3],
}

/// Where a ray crosses from one box into the next, and along which axis.
#[derive(Clone, Copy)]
struct Crossing {
    t: f64,
    axis: usize,
}

impl Crossing {
    /// The first of three crossings, of equal ones that of the lowest axis. `None` if the ray crosses nothing
    /// more.
    #[inline]
    fn first(t: [f64; 3]) -> Option<Self> {
        let flat = usize::from(t[1] < t[0]);
        let axis = if t[2] < t[flat] { 2 } else { flat };
        (t[axis] < f64::INFINITY).then_some(Self { t: t[axis], axis })
    }
}

impl Ray {
    /// `None` if a number is not finite, the origin is out of the range of indices, or nothing moves.
    fn new(origin: [f64; 3], direction: [f64; 3]) -> Option<Self> {
        let fits = |v: f64| v.is_finite() && v.abs() < f64::from(1 << 28);
        let moves = direction.iter().any(|d| *d != 0.0);
        if !origin.into_iter().chain(direction).all(fits) || !moves {
            return None;
        }
        let inverse = direction.map(|d| 1.0 / d);
        // Along an axis on which it takes longer than any number to get anywhere the ray stands still.
        let step =
            core::array::from_fn(|a| if inverse[a].is_infinite() { 0 } else { direction[a].signum() as i32 });
        let ahead = step.map(|s: i32| i32::from(s > 0));
        let start = origin.map(|o| o.floor() as i32);
        Some(Self { origin, direction, inverse, step, ahead, start })
    }

    /// Where the ray leaves, along `axis`, boxes of `SIDE` cells with this index.
    #[inline]
    fn crossing<const SIDE: i32>(&self, axis: usize, index: i32) -> f64 {
        if self.step[axis] == 0 {
            f64::INFINITY
        } else {
            (f64::from((index + self.ahead[axis]) * SIDE) - self.origin[axis]) * self.inverse[axis]
        }
    }

    #[inline]
    fn crossings<const SIDE: i32>(&self, index: [i32; 3]) -> [f64; 3] {
        core::array::from_fn(|a| self.crossing::<SIDE>(a, index[a]))
    }

    /// Takes the first of the crossings `next` out of the box of `SIDE` cells at `index`, and says whether
    /// it also leads out of the box of 4³ such boxes. `None` if the ray crosses nothing more.
    #[inline(always)]
    fn advance<const SIDE: i32>(
        &self,
        index: &mut [i32; 3],
        next: &mut [f64; 3],
    ) -> Option<(Crossing, bool)> {
        // Three branches with a fixed axis each: places in registers, where an index would be a place in
        // memory.
        if next[1] < next[0] {
            if next[2] < next[1] {
                self.advance_along::<SIDE, 2>(index, next)
            } else {
                self.advance_along::<SIDE, 1>(index, next)
            }
        } else if next[2] < next[0] {
            self.advance_along::<SIDE, 2>(index, next)
        } else {
            self.advance_along::<SIDE, 0>(index, next)
        }
    }

    #[inline(always)]
    fn advance_along<const SIDE: i32, const AXIS: usize>(
        &self,
        index: &mut [i32; 3],
        next: &mut [f64; 3],
    ) -> Option<(Crossing, bool)> {
        let t = next[AXIS];
        if t == f64::INFINITY {
            return None;
        }
        let before = index[AXIS];
        let after = before + self.step[AXIS];
        index[AXIS] = after;
        next[AXIS] = (f64::from((after + self.ahead[AXIS]) * SIDE) - self.origin[AXIS]) * self.inverse[AXIS];
        Some((Crossing { t, axis: AXIS }, (before ^ after) & !3 != 0))
    }

    /// The index along `axis` of the box of `SIDE` cells that the ray is in at a crossing of another axis,
    /// given that it lies between the index `near`, which the ray comes to first, and `far`.
    #[inline]
    fn index<const SIDE: i32>(&self, axis: usize, near: i32, far: i32, at: Crossing) -> i32 {
        let step = self.step[axis];
        if near == far || step == 0 {
            return near;
        }
        let left = |index: i32| {
            let t = self.crossing::<SIDE>(axis, index);
            t < at.t || (t == at.t && axis < at.axis)
        };
        // A guess by rounding, put right by the exact rule.
        let guess = nearly_floor((self.origin[axis] + self.direction[axis] * at.t) / f64::from(SIDE));
        let mut index = guess.clamp(near.min(far), near.max(far));
        while index != far && left(index) {
            index += step;
        }
        while index != near && !left(index - step) {
            index -= step;
        }
        index
    }

    /// The index, in boxes of `SIDE` cells, of where the ray is right after a crossing into the box of `4 ·
    /// SIDE` cells or more with lowest and highest index `low` and `high`.
    #[inline]
    fn descend<const SIDE: i32>(&self, low: [i32; 3], high: [i32; 3], at: Crossing) -> [i32; 3] {
        core::array::from_fn(|a| {
            let up = self.step[a] >= 0;
            let start = self.start[a].div_euclid(SIDE).clamp(low[a], high[a]);
            let starts_inside = self.start[a].div_euclid(SIDE) == start;
            let near = match (starts_inside, up) {
                (true, _) => start,
                (false, true) => low[a],
                (false, false) => high[a],
            };
            // Having just crossed along this axis, the ray is at the near side. At its start it has crossed
            // nothing.
            if a == at.axis {
                near
            } else {
                self.index::<SIDE>(a, near, if up { high[a] } else { low[a] }, at)
            }
        })
    }

    /// The first crossing into the box of chunks with lowest and highest index `low` and `high`, and the
    /// chunk there. For a ray that starts inside, the start.
    fn enter(&self, low: [i32; 3], high: [i32; 3]) -> Option<(Crossing, [i32; 3])> {
        let start = self.start.map(|c| c >> 4);
        // The last of the crossings into the slabs that the ray is not yet in.
        let mut last = Crossing { t: 0.0, axis: 0 };
        let mut inside = true;
        for a in 0..3 {
            let before = match (start[a] < low[a], start[a] > high[a]) {
                (true, _) if self.step[a] > 0 => low[a] - 1,
                (_, true) if self.step[a] < 0 => high[a] + 1,
                (false, false) => continue,
                _ => return None,
            };
            let t = self.crossing::<CHUNK>(a, before);
            if inside || t >= last.t {
                last = Crossing { t, axis: a };
            }
            inside = false;
        }
        if inside {
            return Some((last, start));
        }
        let mut index = start;
        for a in 0..3 {
            if a == last.axis {
                index[a] = if self.step[a] > 0 { low[a] } else { high[a] };
            } else if self.step[a] != 0 {
                // One chunk past the box is enough to see that the ray misses it.
                let far = if self.step[a] > 0 { high[a].max(start[a]) + 1 } else { low[a].min(start[a]) - 1 };
                index[a] = self.index::<CHUNK>(a, start[a], far, last);
            }
        }
        (0..3).all(|a| low[a] <= index[a] && index[a] <= high[a]).then_some((last, index))
    }

    /// The first cell of a chunk on the ray, which enters the chunk at `at`.
    #[inline]
    fn cast_in_chunk(&self, chunk: &Chunk, chunk_index: [i32; 3], mut at: Crossing) -> Option<(Voxel, f64)> {
        let low = chunk_index.map(|c| c * 4);
        let mut index = self.descend::<BRICK>(low, low.map(|c| c + 3), at);
        let mut next = self.crossings::<BRICK>(index);
        loop {
            let bit = ((index[2] & 3) << 4 | (index[1] & 3) << 2 | (index[0] & 3)) as usize;
            if chunk.filled >> bit & 1 != 0
                && let Some(hit) = self.cast_in_brick(chunk.bricks[bit], index, at)
            {
                return Some(hit);
            }
            let left;
            (at, left) = self.advance::<BRICK>(&mut index, &mut next)?;
            if left {
                return None;
            }
        }
    }

    /// The first cell of a brick on the ray, which enters the brick at `at`.
    #[inline]
    fn cast_in_brick(&self, brick: u64, brick_index: [i32; 3], mut at: Crossing) -> Option<(Voxel, f64)> {
        let low = brick_index.map(|c| c * 4);
        let mut cell = self.descend::<1>(low, low.map(|c| c + 3), at);
        let mut next = self.crossings::<1>(cell);
        loop {
            let voxel = Voxel::new(cell[0], cell[1], cell[2]);
            if brick >> cell_bit(voxel) & 1 != 0 {
                return Some((voxel, at.t));
            }
            let left;
            (at, left) = self.advance::<1>(&mut cell, &mut next)?;
            if left {
                return None;
            }
        }
    }
}

/// A number rounded down, or one off where it is within 2⁻²² of a whole one. Much faster than `floor`, which
/// is a call where the CPU is not known to have the instruction.
#[inline]
const fn nearly_floor(v: f64) -> i32 {
    const SHIFT: i64 = 1 << 30;
    ((v + SHIFT as f64) as i64 - SHIFT) as i32
}

const fn chunk_of(cell: Voxel) -> [i32; 3] {
    [cell.x >> 4, cell.y >> 4, cell.z >> 4]
}

/// The bricks that share cells with a box, by their lowest cells.
fn bricks_of(cells: &VoxelBox) -> impl Iterator<Item = Voxel> + use<> {
    let [low, high] =
        [cells.min(), cells.max()].map(|cell| Voxel::new(cell.x >> 2, cell.y >> 2, cell.z >> 2));
    let bricks = VoxelBox::spanning(low, high).into_iter().flat_map(|bricks| bricks.voxels());
    bricks.map(|brick| Voxel::new(brick.x * BRICK, brick.y * BRICK, brick.z * BRICK))
}

/// The cell of a brick that has this bit.
pub(crate) const fn cell_of(corner: Voxel, bit: i32) -> Voxel {
    Voxel::new(corner.x + (bit & 3), corner.y + (bit >> 2 & 3), corner.z + (bit >> 4))
}

const fn brick_bit(cell: Voxel) -> usize {
    ((cell.z >> 2 & 3) << 4 | (cell.y >> 2 & 3) << 2 | (cell.x >> 2 & 3)) as usize
}

pub(crate) const fn cell_bit(cell: Voxel) -> u32 {
    ((cell.z & 3) << 4 | (cell.y & 3) << 2 | (cell.x & 3)) as u32
}

/// The numbers of the set bits of a 64-bit word, ascending.
pub(crate) struct Bits(pub(crate) u64);

impl Iterator for Bits {
    type Item = i32;

    fn next(&mut self) -> Option<i32> {
        if self.0 == 0 {
            return None;
        }
        let bit = self.0.trailing_zeros();
        self.0 &= self.0 - 1;
        Some(bit as i32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// One face at a time, by the same rule for where a face is crossed.
    fn naive_cast(
        set: &CellSet,
        origin: [f64; 3],
        direction: [f64; 3],
        length_max: f64,
    ) -> Option<(Voxel, f64)> {
        let inverse = direction.map(|d| 1.0 / d);
        let mut cell = origin.map(|o| o.floor() as i32);
        let mut t = 0.0;
        while t <= length_max {
            let voxel = Voxel::new(cell[0], cell[1], cell[2]);
            if set.contains(voxel) {
                return Some((voxel, t));
            }
            let mut first = (f64::INFINITY, 0);
            for a in 0..3 {
                let face = cell[a] + i32::from(direction[a] > 0.0);
                let crossed = (f64::from(face) - origin[a]) * inverse[a];
                if direction[a] != 0.0 && crossed < first.0 {
                    first = (crossed, a);
                }
            }
            t = first.0;
            cell[first.1] += if direction[first.1] > 0.0 { 1 } else { -1 };
        }
        None
    }

    fn cell() -> impl Strategy<Value = Voxel> {
        (-40..90i32, -30..50i32, -20..40i32).prop_map(|(x, y, z)| Voxel::new(x, y, z))
    }

    fn coordinate(low: i32, high: i32) -> impl Strategy<Value = f64> {
        // Quarters hit faces and edges exactly, the rest do not.
        prop_oneof![(low * 4..high * 4).prop_map(|q| f64::from(q) / 4.0), f64::from(low)..f64::from(high)]
    }

    fn snapshot_of(cells: &[Voxel]) -> CellSet {
        let region = VoxelBox::spanning(Voxel::new(-40, -30, -20), Voxel::new(89, 49, 39)).unwrap();
        let mut set = CellSet::new(region).unwrap();
        for cell in cells {
            set.insert(*cell).unwrap();
        }
        set.seal();
        set
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2_000))]
        #[test]
        fn a_cast_ends_just_where_a_step_by_step_walk_ends(
            cells in prop::collection::vec(cell(), 1..300),
            aim in any::<prop::sample::Index>(),
            origin in (coordinate(-60, 110), coordinate(-50, 70), coordinate(-40, 60)),
            offset in (coordinate(-2, 3), coordinate(-2, 3), coordinate(-2, 3)),
        ) {
            let set = snapshot_of(&cells);
            let target = cells[aim.index(cells.len())];
            let origin = [origin.0, origin.1, origin.2];
            let direction = [
                f64::from(target.x) + offset.0 - origin[0],
                f64::from(target.y) + offset.1 - origin[1],
                f64::from(target.z) + offset.2 - origin[2],
            ];
            prop_assume!(direction != [0.0; 3]);
            let expected = naive_cast(&set, origin, direction, 3.0);
            prop_assert_eq!(set.cast(origin, direction, 3.0), expected);
        }

        #[test]
        fn the_set_holds_what_was_put_in(
            cells in prop::collection::vec(cell(), 0..200), gone in prop::collection::vec(cell(), 0..50),
        ) {
            let mut set = snapshot_of(&cells);
            let mut model: std::collections::BTreeSet<Voxel> = cells.iter().copied().collect();
            for cell in gone.iter().chain(cells.iter().take(3)) {
                set.remove(*cell);
                model.remove(cell);
            }
            prop_assert_eq!(set.iter().count(), model.len());
            prop_assert!(set.iter().all(|c| model.contains(&c)));
            prop_assert!(model.iter().all(|c| set.contains(*c)));
        }
    }

    proptest! {
        #[test]
        fn a_box_is_all_its_cells(a in cell(), b in cell()) {
            let region = VoxelBox::spanning(Voxel::new(-30, -30, -10), Voxel::new(70, 40, 39)).unwrap();
            let cells = VoxelBox::spanning(a, b).unwrap();
            let mut set = CellSet::new(region).unwrap();
            set.insert_box(&cells).unwrap();
            let expected = cells.intersection(&region).map_or(0, |part| part.volume() as usize);
            prop_assert_eq!(set.iter().count(), expected);
            prop_assert!(set.iter().all(|cell| cells.contains(cell) && region.contains(cell)));
        }
    }

    #[test]
    fn a_ray_of_nothing_or_nowhere_hits_nothing() {
        let set = snapshot_of(&[Voxel::new(0, 0, 0)]);
        assert_eq!(set.cast([0.5; 3], [0.0; 3], 1.0), None);
        assert_eq!(set.cast([f64::NAN, 0.0, 0.0], [1.0, 0.0, 0.0], 1.0), None);
        assert_eq!(set.cast([3.0; 3], [1e-310, 0.0, -0.0], 1e300), None);
        assert_eq!(set.cast([0.5, 0.0, 9.0], [0.0, 1e-310, -1.0], 9.0), Some((Voxel::new(0, 0, 0), 8.0)));
        assert_eq!(set.cast([1e30, 0.0, 0.0], [-1.0, 0.0, 0.0], 1e40), None);
        assert_eq!(set.cast([0.5; 3], [0.0, 0.0, 1.0], 1.0), Some((Voxel::new(0, 0, 0), 0.0)));
    }

    #[test]
    fn a_set_beyond_its_limit_is_refused() {
        let region = VoxelBox::new(Voxel::new(0, 0, 0), [1 << 20, 1 << 20, 1 << 10]).unwrap();
        assert_eq!(CellSet::new(region).err(), Some(TooLarge));
    }
}
