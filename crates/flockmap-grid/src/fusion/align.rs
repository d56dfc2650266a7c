//! A layer seen from another frame.

use std::borrow::Cow;

use rustc_hash::FxHashMap;

use super::rigid::{Planes, Rigid, is_dense, numbered, places};
use crate::block::plane_within;
use crate::submap::BlockBox;
use crate::{BLOCK_SIDE, BlockIndex, Layer, Plane, Pose, Resolution, Sheet, Stamp, State, StateBlock, Voxel};

/// How what is seen from another frame lies in the own one, and back, in voxel units.
#[derive(Clone, Debug)]
pub(super) struct Alignment {
    forward: Rigid,
    backward: Rigid,
    /// Where blocks stay blocks, by how many they are moved.
    shift: Option<[i32; 3]>,
}

/// Blocks of voxels with stamps.
pub(super) trait Blocks {
    /// The states of a block, `None` if nothing in it is known.
    fn block(&self, index: BlockIndex) -> Option<StateBlock>;

    /// State of a voxel and when it was set. `None` if it is Unknown.
    fn get(&self, voxel: Voxel) -> Option<(State, Stamp)>;

    /// The states of blocks of which something is known, with their numbers in the list.
    fn each_block(&self, indices: impl Iterator<Item = BlockIndex>, found: impl FnMut(usize, StateBlock));
}

/// The same for who looks up each block for itself.
pub(super) fn one_by_one(
    blocks: &impl Blocks,
    indices: impl Iterator<Item = BlockIndex>,
    mut found: impl FnMut(usize, StateBlock),
) {
    for (number, index) in indices.enumerate() {
        if let Some(block) = blocks.block(index) {
            found(number, block);
        }
    }
}

impl Blocks for Layer {
    fn block(&self, index: BlockIndex) -> Option<StateBlock> {
        self.block(index)
    }

    fn get(&self, voxel: Voxel) -> Option<(State, Stamp)> {
        self.get(voxel)
    }

    fn each_block(
        &self,
        indices: impl Iterator<Item = BlockIndex>,
        mut found: impl FnMut(usize, StateBlock),
    ) {
        self.blocks_at(indices).for_each(|(number, block)| found(number, block));
    }
}

impl Alignment {
    /// Of a pose that lies in the grid. What it brings beyond the end of the grid is not there.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub(super) fn new(T_own_origin: &Pose, resolution: Resolution) -> Self {
        Self {
            forward: Rigid::new(T_own_origin, resolution),
            backward: Rigid::new(&T_own_origin.inverse(), resolution),
            shift: (*T_own_origin == Pose::IDENTITY).then_some([0; 3]),
        }
    }

    /// The same of what lies on a sheet of the other grid.
    pub(super) fn of_sheet(&self, sheet: Sheet) -> Self {
        let middle = sheet.middle();
        let voxels = middle.map(|at| f64::from(at * BLOCK_SIDE));
        Self {
            forward: self.forward.after_shift(voxels.map(|at| -at)),
            backward: self.backward.before_shift(voxels),
            shift: self.shift.map(|shift| core::array::from_fn(|axis| shift[axis] - middle[axis])),
        }
    }

    /// Whether voxels of both grids are the same voxels.
    pub(super) const fn is_identity(&self) -> bool {
        matches!(self.shift, Some([0, 0, 0]))
    }

    /// Whether blocks of both grids are the same blocks, whatever their indices.
    pub(super) const fn is_shift(&self) -> bool {
        self.shift.is_some()
    }

    /// A box of blocks in which all lies that comes from a box of blocks of the other frame.
    pub(super) fn image_of(&self, blocks: &BlockBox) -> BlockBox {
        let [low, high] = blocks.ends();
        let corners = (0..8).map(|n| {
            let pick = |bit: i32, low: i32, high: i32| {
                f64::from(if n >> bit & 1 == 0 { low } else { high + 1 } * BLOCK_SIDE)
            };
            self.forward.transform([pick(0, low.x, high.x), pick(1, low.y, high.y), pick(2, low.z, high.z)])
        });
        let ends = corners.fold([[f64::MAX; 3], [f64::MIN; 3]], |[low, high], at| {
            [core::array::from_fn(|i| low[i].min(at[i])), core::array::from_fn(|i| high[i].max(at[i]))]
        });
        // A voxel and a bit more on all sides: what lies near has a say too. A cast clamps.
        let [low, high] = [(ends[0], -2.0), (ends[1], 2.0)].map(|(end, more)| {
            let [x, y, z] = end.map(|at| ((at + more) / f64::from(BLOCK_SIDE)).floor() as i32);
            BlockIndex::new(x, y, z)
        });
        let mut image = BlockBox::new(low);
        image.add(high);
        image
    }

    /// A point of the other frame in the own one, both in voxels.
    pub(super) fn transform(&self, point: [f64; 3]) -> [f64; 3] {
        self.forward.transform(point)
    }

    /// The voxel of the own frame that holds the centre of one of the other.
    pub(super) fn voxel(&self, voxel: Voxel) -> Voxel {
        self.forward.voxel(voxel)
    }

    /// What a layer says of a voxel of the own grid, and with which stamp.
    ///
    /// Occupied voxels are carried forward: the voxel is Occupied if the centre of any occupied voxel of the
    /// layer comes to lie in it, so that no obstacle is lost. Free is looked up backwards: the voxel is Free
    /// if its own centre lies in a free voxel of the layer, so that no holes appear.
    pub(super) fn look_up(&self, layer: &impl Blocks, target: Voxel) -> Option<(State, Stamp)> {
        if let Some(shift) = self.shift {
            let [x, y, z] = shift.map(|blocks| blocks * BLOCK_SIDE);
            return layer.get(Voxel::new(target.x - x, target.y - y, target.z - z));
        }
        let [low, high] = self.backward.near(target);
        let mut occupied: Option<Stamp> = None;
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                for x in low.x..=high.x {
                    let near = Voxel::new(x, y, z);
                    if let Some((State::Occupied, stamp)) = layer.get(near)
                        && self.forward.voxel(near) == target
                    {
                        occupied = occupied.max(Some(stamp));
                    }
                }
            }
        }
        match occupied {
            Some(stamp) => Some((State::Occupied, stamp)),
            None => layer.get(self.backward.voxel(target)).filter(|(state, _)| *state == State::Free),
        }
    }

    /// What a layer says of voxels of the own grid, [`Self::look_up`] of each: forwards, block by block, the
    /// number of the target and the states. Occupied voxels are carried forward once for all targets.
    pub(super) fn blocks(
        &self,
        layer: &impl Blocks,
        targets: &[(BlockIndex, Plane)],
        mut source: impl FnMut(usize, StateBlock),
    ) {
        if let Some([x, y, z]) = self.shift {
            let indices = targets.iter().map(|(at, _)| BlockIndex::new(at.x - x, at.y - y, at.z - z));
            return layer
                .each_block(indices, |number, block| source(number, block.masked(&targets[number].1)));
        }
        let mut free = vec![[0; 8]; targets.len()];
        let mut near = FxHashMap::<BlockIndex, Plane>::default();
        for ((index, mask), free) in targets.iter().zip(&mut free).filter(|((_, mask), _)| *mask != [0; 8]) {
            let ends = self.backward.near_block(*index, mask);
            let sources = Sources::new(layer, ends);
            if sources.any(StateBlock::free) {
                *free = self.free(&sources, *index, mask);
            }
            if sources.any(StateBlock::occupied) {
                let mut add = |source: BlockIndex, block: &StateBlock, plane: &Plane| {
                    let near = near.entry(source).or_default();
                    let occupied = block.occupied();
                    *near = core::array::from_fn(|z| near[z] | occupied[z] & plane[z]);
                };
                if is_dense(*index, mask) {
                    sources.each(|source, block| add(source, block, &plane_within(source, ends[0], ends[1])));
                } else {
                    self.backward.near_voxels(&self.forward, *index, mask, |source, plane| {
                        layer.block(source).into_iter().for_each(|block| add(source, &block, plane));
                    });
                }
            }
        }
        let mut occupied = FxHashMap::<BlockIndex, Plane>::default();
        if !near.is_empty() {
            occupied.extend(targets.iter().map(|(index, _)| (*index, [0; 8])));
        }
        for (source, voxels) in &near {
            self.forward.images(*source, voxels, |target, images| {
                if let Some(occupied) = occupied.get_mut(&target) {
                    *occupied = core::array::from_fn(|z| occupied[z] | images[z]);
                }
            });
        }
        for (number, ((index, mask), free)) in targets.iter().zip(free).enumerate() {
            let occupied =
                occupied.get(index).map_or([0; 8], |all| core::array::from_fn(|z| all[z] & mask[z]));
            if free != [0; 8] || occupied != [0; 8] {
                source(number, StateBlock::new(free, occupied));
            }
        }
    }

    /// The voxels of `mask` whose centres lie in free voxels.
    fn free(&self, sources: &Sources, index: BlockIndex, mask: &Plane) -> Plane {
        let planes = sources.planes(StateBlock::free);
        let mut free = [0; 8];
        self.backward.each_row(index, mask, |first, bits, voxels| {
            let mut row = 0;
            for (x, place) in places(voxels, sources.low).into_iter().enumerate() {
                row |= (planes[(place as usize >> 6) % planes.len()] >> (place & 63) & 1) << x;
            }
            free[first / 64] |= (row & u64::from(bits)) << (first & 63);
        });
        free
    }

    /// The voxels of the own grid on which these voxels of the layer can have a say, and few others.
    pub(super) fn reach<'a>(&self, source: &'a [(BlockIndex, Plane)]) -> Cow<'a, [(BlockIndex, Plane)]> {
        match self.shift {
            Some([0, 0, 0]) => return Cow::Borrowed(source),
            Some([x, y, z]) => {
                let moved = |(at, plane): &(BlockIndex, Plane)| {
                    (BlockIndex::new(at.x + x, at.y + y, at.z + z), *plane)
                };
                return Cow::Owned(source.iter().map(moved).collect());
            }
            None => {}
        }
        let mut reached = FxHashMap::<BlockIndex, Plane>::default();
        for (index, mask) in source {
            self.forward.near_voxels(&self.backward, *index, mask, |target, near| {
                let plane = reached.entry(target).or_default();
                *plane = core::array::from_fn(|z| plane[z] | near[z]);
            });
        }
        let mut reached: Vec<_> = reached.into_iter().collect();
        reached.sort_unstable_by_key(|(index, _)| *index);
        Cow::Owned(reached)
    }
}

/// The blocks of a layer in which lies what it says of a block of another grid: three along each axis at most.
struct Sources {
    low: BlockIndex,
    blocks: [Option<StateBlock>; 27],
}

impl Sources {
    fn new(layer: &impl Blocks, ends: [Voxel; 2]) -> Self {
        let [low, high] = ends.map(Voxel::block);
        let mut blocks = [None; 27];
        for z in low.z..=high.z.min(low.z + 2) {
            for y in low.y..=high.y.min(low.y + 2) {
                for x in low.x..=high.x.min(low.x + 2) {
                    let number = (z - low.z) * 9 + (y - low.y) * 3 + x - low.x;
                    blocks[number as usize % 27] = layer.block(BlockIndex::new(x, y, z));
                }
            }
        }
        Self { low, blocks }
    }

    fn any(&self, plane: impl Fn(&StateBlock) -> &Plane) -> bool {
        self.blocks.iter().flatten().any(|block| *plane(block) != [0; 8])
    }

    /// Calls `found` with all that have Occupied voxels.
    fn each(&self, mut found: impl FnMut(BlockIndex, &StateBlock)) {
        for (number, block) in (0..27).zip(self.blocks) {
            if let Some(block) = block.filter(|block| *block.occupied() != [0; 8]) {
                found(numbered(self.low, number), &block);
            }
        }
    }

    /// One after the other, as [`places`] has them. Their number is a power of two, so that no place lies beyond.
    fn planes(&self, plane: impl Fn(&StateBlock) -> &Plane) -> Planes {
        let mut planes = [0; 32 * 8];
        for (to, block) in planes.chunks_exact_mut(8).zip(self.blocks) {
            if let Some(block) = block {
                to.copy_from_slice(plane(&block));
            }
        }
        planes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{BLOCK_VOXELS, Changes, VOXEL_LIMIT, bit_of};
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    fn resolution() -> Resolution {
        Resolution::from_metres(0.5).unwrap()
    }

    /// The voxel in which the image of a centre lies, as the matrix of the pose says.
    fn moved(pose: &Pose, v: Voxel) -> [i64; 3] {
        let p = [v.x, v.y, v.z].map(|i| f64::from(i) + 0.5);
        let (rows, scale) = (pose.rotation_rows(), 1.0 / resolution().metres());
        core::array::from_fn(|axis| {
            let ([a, b, c], t) = (rows[axis], pose.translation()[axis] * scale);
            (a * p[0] + b * p[1] + c * p[2] + t).floor() as i64
        })
    }

    /// The rules in plain words: where the occupied voxels of a layer come to lie, and which is the newest there.
    fn images(layer: &Layer, pose: &Pose) -> BTreeMap<[i64; 3], Stamp> {
        let mut images = BTreeMap::new();
        for (voxel, _) in layer.voxels().filter(|(_, state)| *state == State::Occupied) {
            let (_, stamp) = layer.get(voxel).unwrap();
            let newest = images.entry(moved(pose, voxel)).or_insert(stamp);
            *newest = stamp.max(*newest);
        }
        images
    }

    /// What a layer says of a voxel.
    fn naive(
        layer: &Layer,
        pose: &Pose,
        images: &BTreeMap<[i64; 3], Stamp>,
        target: Voxel,
    ) -> Option<(State, Stamp)> {
        if let Some(stamp) = images.get(&[target.x, target.y, target.z].map(i64::from)) {
            return Some((State::Occupied, *stamp));
        }
        let [x, y, z] = moved(&pose.inverse(), target).map(|at| at as i32);
        layer.get(Voxel::new(x, y, z)).filter(|(state, _)| *state == State::Free)
    }

    fn pose() -> impl Strategy<Value = Pose> {
        let translation = prop_oneof![
            (-9.0..9.0f64, -9.0..9.0f64, -9.0..9.0f64).prop_map(|(x, y, z)| [x, y, z]),
            // Halves and quarters of voxels: centres come to lie on borders.
            (-9..9i32, -9..9i32, -9..9i32).prop_map(|(x, y, z)| [x, y, z].map(|t| f64::from(t) * 0.125)),
        ];
        let unit = -1.0..1.0f64;
        let rotation = prop_oneof![
            [unit.clone(), unit.clone(), unit.clone(), 0.1..1.0f64],
            (unit, 0.1..1.0f64).prop_map(|(z, w)| [0.0, 0.0, z, w]),
            // Quarter and third turns.
            prop::sample::select(vec![
                [0.0, 0.0, 1.0, 1.0],
                [1.0, 0.0, 0.0, 1.0],
                [0.0, 1.0, 0.0, 0.0],
                [1.0, 1.0, 1.0, 1.0],
                [0.0, 0.0, 0.0, 1.0],
                [0.0, 0.0, 0.382_683_432_365_089_8, 0.923_879_532_511_286_7],
            ]),
        ];
        (translation, rotation).prop_map(|(t, q)| Pose::new(t, q).unwrap())
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 96, ..ProptestConfig::default() })]

        /// At the middle of the grid and at its ends, where block and images of it may lie half beyond.
        #[test]
        fn a_block_seen_from_another_frame_is_what_the_rules_say_of_each_voxel(
            pose in pose(),
            at in prop::sample::select(vec![[0, 0, 0], [-1, 0, 1], [1, 1, 1], [0, -1, 0], [0, 0, -1]]),
            is_far in any::<bool>(),
            voxels in prop::collection::vec((-14..14i32, -14..14i32, -14..14i32, any::<bool>(), 0..9i64), 1..400),
            fill in prop::option::of(any::<bool>()),
            masks in prop::collection::vec(prop_oneof![any::<u64>(), Just(u64::MAX), Just(0), Just(1 << 27)], 8),
        ) {
            let far = if is_far { VOXEL_LIMIT } else { 0 };
            let middle = at.map(|side| side * far);
            let mut layer = Layer::default();
            let place = |x: i32, y: i32, z: i32| Voxel::new(middle[0] + x, middle[1] + y, middle[2] + z);
            let state = |occupied: bool| if occupied { State::Occupied } else { State::Free };
            if let Some(occupied) = fill {
                let all = (0..4_096).map(|n| place(n % 16 - 9, n / 16 % 16 - 9, n / 256 - 9));
                let all = all.filter(|voxel| voxel.in_limits()).map(|voxel| (voxel, state(occupied)));
                layer.apply(&Changes::from_voxels(all), Stamp(4));
            }
            for (x, y, z, occupied, stamp) in voxels {
                if place(x, y, z).in_limits() {
                    layer.apply(&Changes::from_voxels([(place(x, y, z), state(occupied))]), Stamp(stamp));
                }
            }
            let alignment = Alignment::new(&pose, resolution());
            let mut mask: Plane = masks.try_into().unwrap();
            let centre = alignment.forward.voxel(place(0, 0, 0));
            if !centre.in_limits() {
                return Ok(());
            }
            let index = centre.block();
            let corner = index.corner();
            let voxel = |bit: usize| {
                let [x, y, z] = bit_of(bit);
                Voxel::new(corner.x + x, corner.y + y, corner.z + z)
            };
            for bit in (0..BLOCK_VOXELS).filter(|bit| !voxel(*bit).in_limits()) {
                mask[bit / 64] &= !(1 << (bit % 64));
            }
            let mut source = StateBlock::default();
            alignment.blocks(&layer, &[(index, mask)], |_, states| source = states);
            // Among others, and twice, it is the same.
            let neighbour = (numbered(index, 1), [u64::MAX; 8]);
            let among_others = [neighbour, (index, mask), (index, [0; 8]), (numbered(index, 13), mask), (index, mask)];
            let mut found = [StateBlock::default(); 5];
            alignment.blocks(&layer, &among_others, |number, states| found[number] = states);
            prop_assert_eq!(found[1], source);
            prop_assert_eq!(found[2], StateBlock::default());
            prop_assert_eq!(found[4], source);
            let known: Vec<_> = layer.blocks().map(|(index, block)| (index, block.known())).collect();
            let reached = alignment.reach(&known);
            let images = images(&layer, &pose);
            for bit in 0..BLOCK_VOXELS {
                if mask[bit / 64] >> (bit % 64) & 1 == 0 {
                    prop_assert_eq!(source.get(bit), State::Unknown);
                    continue;
                }
                let expected = naive(&layer, &pose, &images, voxel(bit));
                prop_assert_eq!(alignment.look_up(&layer, voxel(bit)), expected, "{:?}", voxel(bit));
                let state = expected.map_or(State::Unknown, |(state, _)| state);
                prop_assert_eq!(source.get(bit), state, "{:?}", voxel(bit));
                let is_reached = reached.iter().any(|(reached, plane)| {
                    *reached == index && plane[bit / 64] >> (bit % 64) & 1 == 1
                });
                prop_assert!(is_reached || expected.is_none(), "{:?} is not worked out anew", voxel(bit));
            }
            for (index, plane) in reached.iter() {
                let is_inside = (0..BLOCK_VOXELS).filter(|bit| plane[bit / 64] >> (bit % 64) & 1 == 1).all(|bit| {
                    let ([x, y, z], corner) = (bit_of(bit), index.corner());
                    Voxel::new(corner.x + x, corner.y + y, corner.z + z).in_limits()
                });
                prop_assert!(is_inside, "{:?}", index);
            }
        }
    }
}
