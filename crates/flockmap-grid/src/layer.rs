//! What is known from one origin.

use std::collections::BTreeMap;

use rustc_hash::{FxHashMap, FxHashSet};

use crate::block::{meet, set_bits};
use crate::memory::table_bytes;
use crate::snapshot::SnapshotVoxels;
use crate::stamps::BlockStamps;
use crate::{BlockIndex, Changes, Plane, Snapshot, Stamp, State, StateBlock, Voxel, VoxelBox, voxel_bit};

/// State and stamp of every voxel that one stream has published, in the frame of its origin.
///
/// Every voxel keeps the state with the newest stamp (Sec. IV-C of the paper). So packages may be applied in any
/// order and any number of times, and every robot that has applied the same ones holds the same layer.
#[derive(Clone, Debug, Default)]
pub struct Layer {
    blocks: FxHashMap<BlockIndex, LayerBlock>,
    newest: Option<Stamp>,
    /// Of all blocks.
    stamp_bytes: usize,
    /// By end of batch, where the sensor was. Codecs make use of it; it is no part of what is known.
    sensors: BTreeMap<Stamp, [i32; 3]>,
    /// How many were noted since the layer was last gone through for those of which nothing stands any more.
    sensors_noted: usize,
}

/// Most batches whose sensor a layer remembers; the oldest are forgotten.
const SENSORS_MAX: usize = 1 << 16;
/// A sensor in its map.
pub(crate) const SENSOR_BYTES: usize = 48;
/// So many sensors are noted at least before the layer is gone through.
const SENSORS_NOTED_MIN: usize = 1_024;

#[derive(Clone, Debug)]
struct LayerBlock {
    states: StateBlock,
    stamps: BlockStamps,
    /// The states before the newest stamp, if that is known.
    before: Option<StateBlock>,
}

/// A later batch has changed a block already, or a snapshot has: what it was before is not known any more.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error("block {block:?} holds states as new as {newest:?}: what was known before {stamp:?} is gone")]
pub struct BaseSuperseded {
    /// The block.
    pub block: BlockIndex,
    /// Newest stamp in it.
    pub newest: Stamp,
    /// What was asked for: the states before this.
    pub stamp: Stamp,
}

/// Most bytes that one block of a layer can take: 512 voxels that changed last in 512 different batches.
pub const LAYER_BLOCK_BYTES_MAX: usize = table_bytes(1, ENTRY_BYTES) + BlockStamps::bytes_of(usize::MAX);
/// A block in the table.
const ENTRY_BYTES: usize = size_of::<(BlockIndex, LayerBlock)>();

impl Layer {
    /// Takes over each change that is newer than what is known of its voxel. At equal stamps the known one
    /// stays, unless the new one is Occupied. Returns the blocks and voxels that it took over. O(changes).
    pub fn apply(&mut self, changes: &Changes, stamp: Stamp) -> Vec<(BlockIndex, Plane)> {
        self.take_over(changes, stamp, true)
    }

    /// The same for every voxel of a snapshot, each with its own stamp. Returns the blocks and voxels that it
    /// took over, a block once for each stamp. O(voxels).
    pub fn apply_snapshot(&mut self, state: &Snapshot) -> Vec<(BlockIndex, Plane)> {
        let taken =
            state.parts.iter().flat_map(|(stamp, part)| self.take_over(part, *stamp, false)).collect();
        // After the voxels: the sensor of a batch of which nothing stands may be forgotten at once.
        state.sensors.iter().for_each(|(stamp, sensor)| self.note_sensor(*stamp, *sensor));
        taken
    }

    /// Notes where the sensor was in the batch that ended at `stamp`, in sixteenths of a voxel; to be called
    /// after its voxels were taken over. Of at most 2¹⁶ batches, 48 bytes each; batches of which no voxel
    /// stands any more are forgotten now and then. O(log n) over time.
    pub fn note_sensor(&mut self, stamp: Stamp, sensor: [i32; 3]) {
        if self.sensors.insert(stamp, sensor).is_some() {
            return;
        }
        self.sensors_noted += 1;
        // So rare that going through all blocks costs little for each.
        if self.sensors_noted >= SENSORS_NOTED_MIN.max(self.blocks.len() / 4).max(self.sensors.len() / 2) {
            self.forget_sensors();
        }
        if self.sensors.len() > SENSORS_MAX {
            self.sensors.pop_first();
        }
    }

    /// Where the sensor was in the newest batch of which that is known, in sixteenths of a voxel. O(log n).
    pub fn newest_sensor(&self) -> Option<(Stamp, [i32; 3])> {
        self.sensors.last_key_value().map(|(stamp, sensor)| (*stamp, *sensor))
    }

    /// Forgets the sensors of batches of which no voxel stands. O(voxels).
    fn forget_sensors(&mut self) {
        self.sensors_noted = 0;
        let mut unseen: FxHashSet<Stamp> = self.sensors.keys().copied().collect();
        for block in self.blocks.values() {
            block.stamps.for_each_in_use(&block.states.known(), |stamp| {
                unseen.remove(&stamp);
            });
        }
        self.sensors.retain(|stamp, _| !unseen.contains(stamp));
    }

    /// `is_batch`: the changes are of one batch, and what was there before remains known.
    fn take_over(&mut self, changes: &Changes, stamp: Stamp, is_batch: bool) -> Vec<(BlockIndex, Plane)> {
        let mut taken = Vec::with_capacity(changes.blocks().len());
        for (index, new) in changes.blocks() {
            let block = self.blocks.entry(*index).or_insert_with(|| {
                let stamps = BlockStamps::new(stamp);
                self.stamp_bytes += stamps.memory_bytes();
                LayerBlock { states: StateBlock::default(), stamps, before: Some(StateBlock::default()) }
            });
            block.keep_before(new, stamp, is_batch);
            let mut mask = new.known();
            if block.stamps.newest() >= stamp
                && !flockmap_mutation::is(flockmap_mutation::Mutation::StampCompareDropped)
            {
                block.keep_newer(&mut mask, new, stamp);
            }
            if mask != [0; 8] {
                block.states.overlay(&new.masked(&mask));
                self.stamp_bytes -= block.stamps.memory_bytes();
                block.stamps.set(&mask, stamp, &block.states.known());
                self.stamp_bytes += block.stamps.memory_bytes();
                taken.push((*index, mask));
            }
        }
        self.newest = self.newest.max((!changes.is_empty()).then_some(stamp));
        taken
    }

    /// State of a voxel.
    pub fn state(&self, voxel: Voxel) -> State {
        self.blocks.get(&voxel.block()).map_or(State::Unknown, |block| block.states.get(voxel_bit(voxel)))
    }

    /// State of a voxel and when it was set. `None` if it is Unknown.
    pub fn get(&self, voxel: Voxel) -> Option<(State, Stamp)> {
        let block = self.blocks.get(&voxel.block())?;
        let bit = voxel_bit(voxel);
        match block.states.get(bit) {
            State::Unknown => None,
            state => Some((state, block.stamps.get(bit))),
        }
    }

    /// The states of a block, `None` if nothing in it is known.
    pub fn block(&self, index: BlockIndex) -> Option<&StateBlock> {
        self.blocks.get(&index).map(|block| &block.states)
    }

    /// The states of a block as they were before the batch that ended at `stamp`, whether packages of that
    /// batch have been applied meanwhile or not; `None` if nothing was known. This is what packages of the
    /// batch are coded against.
    ///
    /// # Errors
    /// [`BaseSuperseded`] if something newer has been applied to the block, or a snapshot that says more of
    /// it than was known.
    pub fn block_before(
        &self,
        index: BlockIndex,
        stamp: Stamp,
    ) -> Result<Option<&StateBlock>, BaseSuperseded> {
        Ok(self.known_before(index, stamp)?.map(|(states, _)| states))
    }

    /// As [`Self::block_before`], with the newest stamp in the block as it is now: at most `stamp`.
    ///
    /// # Errors
    /// [`BaseSuperseded`], as there.
    pub fn known_before(
        &self,
        index: BlockIndex,
        stamp: Stamp,
    ) -> Result<Option<(&StateBlock, Stamp)>, BaseSuperseded> {
        let Some(block) = self.blocks.get(&index) else { return Ok(None) };
        let newest = block.stamps.newest();
        if newest < stamp {
            return Ok(Some((&block.states, newest)));
        }
        let before = block.before.as_ref().filter(|_| newest == stamp);
        before.map(|before| Some((before, newest))).ok_or(BaseSuperseded { block: index, newest, stamp })
    }

    /// All blocks, in no order.
    pub fn blocks(&self) -> impl Iterator<Item = (BlockIndex, &StateBlock)> {
        self.blocks.iter().map(|(index, block)| (*index, &block.states))
    }

    /// Every known voxel with its state, block by block in ascending order. O(n log n) in blocks.
    pub fn voxels(&self) -> impl Iterator<Item = (Voxel, State)> {
        let all = self.blocks().map(|(index, block)| (index, *block)).collect();
        Changes::from_blocks(all).into_voxels()
    }

    /// Number of known voxels. O(blocks).
    pub fn len(&self) -> usize {
        self.blocks.values().map(|block| block.states.known_count() as usize).sum()
    }

    /// Whether nothing is known.
    pub fn is_empty(&self) -> bool {
        self.blocks.is_empty()
    }

    /// Number of blocks.
    pub fn block_count(&self) -> usize {
        self.blocks.len()
    }

    /// The newest stamp applied.
    pub const fn newest(&self) -> Option<Stamp> {
        self.newest
    }

    /// Bytes that the layer holds, as asked of the allocator. O(1).
    pub fn memory_bytes(&self) -> usize {
        table_bytes(self.blocks.len(), ENTRY_BYTES) + SENSOR_BYTES * self.sensors.len() + self.stamp_bytes
    }

    /// Bytes that it may hold at most while and after so many blocks are added to it, beside their stamps. O(1).
    pub fn memory_bytes_with(&self, blocks: usize) -> usize {
        self.memory_bytes() + self.table_growth(blocks)
    }

    /// The most by which taking over these changes, each with a stamp of its own, can make it grow, in bytes
    /// (sensors not counted), and by how many blocks. O(blocks).
    pub(crate) fn growth_max<'a>(&self, parts: impl ExactSizeIterator<Item = &'a Changes>) -> (usize, usize) {
        let of_block = |index: &BlockIndex, stamps: usize| match self.blocks.get(index) {
            Some(block) => (block.stamps.growth_max(stamps), 0),
            None => (BlockStamps::bytes_of(stamps), 1),
        };
        let sum = |sum: (usize, usize), more: (usize, usize)| (sum.0 + more.0, sum.1 + more.1);
        let (stamps, blocks) = if parts.len() == 1 {
            let blocks = parts.flat_map(Changes::blocks);
            blocks.map(|(index, _)| of_block(index, 1)).fold((0, 0), sum)
        } else {
            let mut stamps_of = FxHashMap::<BlockIndex, usize>::default();
            for (index, _) in parts.flat_map(Changes::blocks) {
                *stamps_of.entry(*index).or_default() += 1;
            }
            stamps_of.iter().map(|(index, stamps)| of_block(index, *stamps)).fold((0, 0), sum)
        };
        (stamps + self.table_growth(blocks), blocks)
    }

    /// While a table grows, the old one is there too.
    fn table_growth(&self, blocks: usize) -> usize {
        let [now, then] = [0, blocks].map(|more| table_bytes(self.blocks.len() + more, ENTRY_BYTES));
        if then > now { then } else { 0 }
    }

    /// The whole layer with its stamps, such that applying its parts to an empty layer gives this one. `None`
    /// if nothing is known. O(voxels). Takes 144 bytes for each block of each stamp; see
    /// [`Self::snapshot_voxels`].
    pub fn snapshot(&self) -> Option<Snapshot> {
        self.snapshot_voxels(None).map(|voxels| voxels.to_state())
    }

    /// The voxels with a stamp newer than this one, such that applying its parts to a layer that knows all up
    /// to `stamp` gives this one. `None` if there are none. O(voxels).
    pub fn snapshot_since(&self, stamp: Stamp) -> Option<Snapshot> {
        self.snapshot_voxels(Some(stamp)).map(|voxels| voxels.to_state())
    }

    /// The same in 8 bytes for each voxel: of the whole layer, or what is newer than a stamp. Takes no more
    /// while it works, beside 16 bytes for each block and each stamp. `None` if that is nothing, or more than
    /// 2²⁷ blocks or stamps. O(n log n) in voxels.
    pub fn snapshot_voxels(&self, newer_than: Option<Stamp>) -> Option<SnapshotVoxels> {
        let is_wanted = |stamp: Stamp| newer_than.is_none_or(|limit| stamp > limit);
        let mut blocks: Vec<BlockIndex> = Vec::with_capacity(self.blocks.len());
        blocks.extend(
            self.blocks.iter().filter(|(_, b)| is_wanted(b.stamps.newest())).map(|(index, _)| *index),
        );
        blocks.sort_unstable();
        let wanted = |index: &BlockIndex| {
            let block = self.blocks.get(index);
            block.into_iter().flat_map(move |block| {
                let voxels = set_bits(&block.states.known()).map(|bit| (bit, block.stamps.get(bit)));
                voxels
                    .filter(move |(_, stamp)| is_wanted(*stamp))
                    .map(move |(bit, stamp)| (block, bit, stamp))
            })
        };
        let mut number_of = FxHashMap::<Stamp, u32>::default();
        let (mut region, mut count, mut last) = (None::<VoxelBox>, 0, None);
        for index in &blocks {
            let mut known = [0; 8];
            for (_, bit, stamp) in wanted(index) {
                if last != Some(stamp) {
                    number_of.insert(stamp, 0);
                    last = Some(stamp);
                }
                known[bit / 64] |= 1 << (bit % 64);
                count += 1;
            }
            let part = Changes::from_blocks(vec![(*index, StateBlock::new(known, [0; 8]))]).bounding_box();
            region = match (region, part) {
                (Some(a), Some(b)) => Some(a.union(&b)),
                (a, b) => a.or(b),
            };
        }
        let mut stamps: Vec<Stamp> = number_of.keys().copied().collect();
        stamps.sort_unstable();
        for (number, stamp) in (0..).zip(&stamps) {
            number_of.insert(*stamp, number);
        }
        let sensors = stamps.iter().filter_map(|stamp| Some((*stamp, *self.sensors.get(stamp)?))).collect();
        let region = region?;
        let numbered = (0..).zip(blocks.clone());
        let mut last = (Stamp(0), None);
        let voxels = numbered.flat_map(|(number, index)| {
            let number_of = &number_of;
            wanted(&index).map(move |(block, bit, stamp)| {
                let of_stamp = match last {
                    (same, Some(of_stamp)) if same == stamp => of_stamp,
                    _ => number_of.get(&stamp).copied().unwrap_or(0),
                };
                last = (stamp, Some(of_stamp));
                (of_stamp, number, bit, block.states.get(bit))
            })
        });
        SnapshotVoxels::new(region, stamps, blocks, count, voxels, sensors)
    }

    /// A number that is equal for layers with equal states and stamps, on every machine, and (very likely)
    /// different for others. O(voxels).
    pub fn digest(&self) -> u64 {
        let mut sum = 0u64;
        for (index, block) in &self.blocks {
            let mut hash = mix(0x666c_6f63_6b6d_6170, (index.x as u32 as u64) << 32 | index.y as u32 as u64);
            hash = mix(hash, index.z as u32 as u64);
            for word in block.states.free().iter().chain(block.states.occupied()) {
                hash = mix(hash, *word);
            }
            for bit in set_bits(&block.states.known()) {
                hash = mix(hash, block.stamps.get(bit).0 as u64);
            }
            // A sum does not depend on the order of the blocks.
            sum = sum.wrapping_add(hash);
        }
        sum
    }
}

impl LayerBlock {
    /// Keeps what is known before something with this stamp is taken over.
    fn keep_before(&mut self, new: &StateBlock, stamp: Stamp, is_batch: bool) {
        match stamp.cmp(&self.stamps.newest()) {
            core::cmp::Ordering::Greater if is_batch => self.before = Some(self.states),
            // More of the same batch.
            core::cmp::Ordering::Equal if is_batch => {}
            // An older state that comes late is a part of what was before, unless another one stands there:
            // which of them is newer is not known.
            core::cmp::Ordering::Less => {
                let is_certain = |before: &StateBlock| {
                    !meet(before.free(), new.occupied()) && !meet(before.occupied(), new.free())
                };
                self.before = self.before.filter(is_certain).map(|mut before| {
                    before.overlay(new);
                    before
                });
            }
            // A snapshot names no voxel twice: something is missing before it.
            _ => self.before = None,
        }
    }

    /// Takes the voxels out of `mask` whose known state stands against a new one of this stamp.
    fn keep_newer(&self, mask: &mut Plane, new: &StateBlock, stamp: Stamp) {
        let known = self.states.known();
        let rivals: Plane = core::array::from_fn(|z| mask[z] & known[z]);
        set_bits(&rivals).for_each(|bit| {
            let stays = match self.stamps.get(bit).cmp(&stamp) {
                core::cmp::Ordering::Less => false,
                core::cmp::Ordering::Greater => true,
                core::cmp::Ordering::Equal => {
                    !(new.get(bit) == State::Occupied && self.states.get(bit) == State::Free)
                }
            };
            if stays {
                mask[bit / 64] &= !(1 << (bit % 64));
            }
        });
    }
}

/// SplitMix64's finaliser over the sum of both.
fn mix(hash: u64, word: u64) -> u64 {
    let mut z = hash.rotate_left(23) ^ word.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn package() -> impl Strategy<Value = (Stamp, Vec<(Voxel, State)>)> {
        let voxel = (-6..12i32, -6..12i32, -3..9i32).prop_map(|(x, y, z)| Voxel::new(x, y, z));
        let state = prop_oneof![Just(State::Free), Just(State::Occupied)];
        (0..700i64, prop::collection::vec((voxel, state), 1..40)).prop_map(|(stamp, v)| (Stamp(stamp), v))
    }

    proptest! {
        #[test]
        fn the_newest_word_on_each_voxel_stays_in_any_order(
            packages in prop::collection::vec(package(), 0..60).prop_shuffle(),
        ) {
            let mut layer = Layer::default();
            let mut model = BTreeMap::<Voxel, (Stamp, bool)>::new();
            for (stamp, voxels) in &packages {
                let changes = Changes::from_voxels(voxels.iter().copied());
                let before = (layer.memory_bytes(), layer.block_count());
                let (growth, new_blocks) = layer.growth_max(std::iter::once(&changes));
                let taken = layer.apply(&changes, *stamp);
                prop_assert!(layer.memory_bytes() <= before.0 + growth, "{} after {:?}", growth, before);
                prop_assert_eq!(layer.block_count(), before.1 + new_blocks);
                let mut expected = 0;
                for (voxel, state) in changes.voxels() {
                    let word = (*stamp, state == State::Occupied);
                    let known = model.get(&voxel).copied();
                    if known.is_none_or(|known| known < word) {
                        model.insert(voxel, word);
                        expected += 1;
                    }
                }
                let count: u32 = taken.iter().map(|(_, m)| m.iter().map(|w| w.count_ones()).sum::<u32>()).sum();
                prop_assert_eq!(count, expected);
            }
            prop_assert_eq!(layer.len(), model.len());
            let stamp_bytes: usize = layer.blocks.values().map(|block| block.stamps.memory_bytes()).sum();
            prop_assert_eq!(layer.stamp_bytes, stamp_bytes);
            prop_assert_eq!(layer.memory_bytes_with(0), layer.memory_bytes());
            for (voxel, (stamp, occupied)) in &model {
                let state = if *occupied { State::Occupied } else { State::Free };
                prop_assert_eq!(layer.get(*voxel), Some((state, *stamp)));
            }
            // Its snapshot makes the same layer again.
            let mut again = Layer::default();
            if let Some(snapshot) = layer.snapshot() {
                for (stamp, part) in snapshot.parts.iter().rev() {
                    prop_assert_eq!(part.within(&snapshot.region), part.clone());
                    again.apply(part, *stamp);
                }
            }
            prop_assert_eq!(again.digest(), layer.digest());
            if let Some(snapshot) = layer.snapshot() {
                let (mut at_once, parts) = (Layer::default(), snapshot.parts.iter().map(|(_, part)| part));
                let (growth, new_blocks) = at_once.growth_max(parts);
                at_once.apply_snapshot(&snapshot);
                prop_assert!(at_once.memory_bytes() <= growth);
                prop_assert_eq!(at_once.block_count(), new_blocks);
            }
        }

        /// Against a layer that never forgets a sensor of its own accord.
        #[test]
        fn sensors_are_forgotten_only_where_no_voxel_of_their_batch_stands(
            packages in prop::collection::vec(package(), 1..60).prop_shuffle(), rounds in 1..30u64,
        ) {
            let (mut layer, mut all) = (Layer::default(), BTreeMap::new());
            for round in 0..rounds as i64 {
                for (stamp, voxels) in &packages {
                    let stamp = Stamp(stamp.0 + 700 * round);
                    layer.apply(&Changes::from_voxels(voxels.iter().copied()), stamp);
                    let sensor = [stamp.0 as i32, 1, 2];
                    layer.note_sensor(stamp, sensor);
                    all.insert(stamp, sensor);
                }
            }
            layer.forget_sensors();
            let snapshot = layer.snapshot().unwrap();
            let standing: Vec<_> = snapshot.parts.iter().map(|(stamp, _)| (*stamp, all[stamp])).collect();
            prop_assert_eq!(&snapshot.sensors, &standing, "every sensor of a batch that stands is there");
            prop_assert_eq!(layer.sensors.len(), standing.len(), "and no other");
        }

        #[test]
        fn what_is_newer_than_a_stamp_completes_a_layer_that_knows_the_rest(
            packages in prop::collection::vec(package(), 0..40).prop_shuffle(), limit in 0..700i64,
        ) {
            let (mut layer, mut older) = (Layer::default(), Layer::default());
            for (stamp, voxels) in &packages {
                let changes = Changes::from_voxels(voxels.iter().copied());
                layer.apply(&changes, *stamp);
                if stamp.0 <= limit {
                    older.apply(&changes, *stamp);
                }
            }
            layer.note_sensor(Stamp(3), [1, 2, 3]);
            let since = layer.snapshot_since(Stamp(limit));
            prop_assert_eq!(since.is_none(), packages.iter().all(|(stamp, _)| stamp.0 <= limit));
            if let Some(since) = &since {
                prop_assert!(since.parts.iter().all(|(stamp, part)| stamp.0 > limit && !part.is_empty()));
                prop_assert!(since.parts.is_sorted_by(|a, b| a.0 < b.0));
                let boxes = since.parts.iter().filter_map(|(_, part)| part.bounding_box());
                prop_assert_eq!(boxes.reduce(|a, b| a.union(&b)), Some(since.region));
                older.apply_snapshot(since);
                let voxels = SnapshotVoxels::from_state(since).unwrap();
                prop_assert_eq!(&voxels.to_state(), since);
                for voxels_max in [1, 30, 10_000] {
                    let mut again = Layer::default();
                    for run in voxels.runs(voxels_max) {
                        let count: usize = run.iter().map(|(_, part)| part.len()).sum();
                        let blocks: std::collections::BTreeSet<_> =
                            run.iter().flat_map(|(_, part)| part.blocks()).map(|(index, _)| *index).collect();
                        prop_assert!(count > 0 && (count <= voxels_max || blocks.len() == 1));
                        prop_assert!(run.is_sorted_by(|a, b| a.0 < b.0));
                        prop_assert!(blocks.iter().all(|index| again.block(*index).is_none()));
                        run.iter().for_each(|(stamp, part)| drop(again.apply(part, *stamp)));
                    }
                    let mut whole = Layer::default();
                    whole.apply_snapshot(since);
                    prop_assert_eq!(again.digest(), whole.digest());
                }
            }
            prop_assert_eq!(older.digest(), layer.digest());
            let newest = layer.snapshot_since(Stamp(i64::MIN));
            prop_assert_eq!(newest, layer.snapshot());
        }
    }

    proptest! {
        #[test]
        fn what_was_before_a_batch_is_right_or_refused(
            packages in prop::collection::vec((package(), prop::bool::weighted(0.2)), 0..30),
        ) {
            // Few stamps, so that batches have several packages and some come late.
            let mut layer = Layer::default();
            let mut applied: Vec<(Stamp, Vec<(Voxel, State)>)> = Vec::new();
            let has_snapshot = packages.iter().any(|(_, is_snapshot)| *is_snapshot);
            for ((stamp, voxels), is_snapshot) in &packages {
                let stamp = Stamp(stamp.0 / 100);
                let changes = Changes::from_voxels(voxels.iter().copied());
                match changes.bounding_box().filter(|_| *is_snapshot) {
                    Some(region) => {
                        let parts = vec![(stamp, changes.clone())];
                        layer.apply_snapshot(&Snapshot { region, parts, sensors: Vec::new() });
                    }
                    None => {
                        layer.apply(&changes, stamp);
                    }
                }
                applied.push((stamp, changes.voxels().collect()));
                let in_order = applied.is_sorted_by_key(|(stamp, _)| *stamp);
                let newest = applied.iter().map(|(stamp, _)| *stamp).max().unwrap_or_default();
                for at in (0..9).map(Stamp) {
                    let mut expected = Layer::default();
                    for (stamp, voxels) in applied.iter().filter(|(stamp, _)| *stamp < at) {
                        expected.apply(&Changes::from_voxels(voxels.iter().copied()), *stamp);
                    }
                    for (index, _) in layer.blocks() {
                        match layer.block_before(index, at) {
                            Ok(before) => {
                                let expected = expected.block(index).copied().unwrap_or_default();
                                prop_assert_eq!(before.copied().unwrap_or_default(), expected);
                            }
                            Err(_) => prop_assert!(newest > at || has_snapshot || !in_order),
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn a_package_of_an_older_batch_that_comes_late_joins_the_past_where_that_is_certain() {
        let voxel = |x, state| Changes::from_voxels([(Voxel::new(x, 0, 0), state)]);
        let mut layer = Layer::default();
        let block = Voxel::new(0, 0, 0).block();
        layer.apply(&voxel(0, State::Free), Stamp(10));
        layer.apply(&voxel(1, State::Free), Stamp(20));
        layer.apply(&voxel(2, State::Occupied), Stamp(20));
        let before = *layer.block_before(block, Stamp(20)).unwrap().unwrap();
        assert_eq!([0, 1, 2].map(|bit| before.get(bit)), [State::Free, State::Unknown, State::Unknown]);
        assert!(layer.block_before(block, Stamp(10)).is_err());
        // Between both, of a voxel that was not known before.
        layer.apply(&voxel(3, State::Free), Stamp(15));
        let before = *layer.block_before(block, Stamp(20)).unwrap().unwrap();
        assert_eq!([0, 1, 3].map(|bit| before.get(bit)), [State::Free, State::Unknown, State::Free]);
        layer.apply(&voxel(0, State::Occupied), Stamp(15));
        assert!(layer.block_before(block, Stamp(20)).is_err());
        assert_eq!(layer.block_before(block, Stamp(21)).unwrap(), layer.block(block));
    }

    #[test]
    fn a_snapshot_hides_what_was_before_its_newest_batch_and_not_what_is_before_later_ones() {
        let voxel = |x, state| Changes::from_voxels([(Voxel::new(x, 0, 0), state)]);
        let block = Voxel::new(0, 0, 0).block();
        let snapshot = Snapshot {
            sensors: Vec::new(),
            region: block.corner().block().voxel_box(),
            parts: vec![(Stamp(10), voxel(0, State::Free)), (Stamp(20), voxel(1, State::Free))],
        };
        let mut layer = Layer::default();
        layer.apply(&voxel(0, State::Free), Stamp(10));
        layer.apply_snapshot(&snapshot);
        for stamp in [10, 15, 20] {
            assert!(layer.block_before(block, Stamp(stamp)).is_err());
        }
        // A later batch, by one package or two, knows what was before it.
        let expected = *layer.block(block).unwrap();
        assert_eq!(layer.block_before(block, Stamp(21)), Ok(Some(&expected)));
        layer.apply(&voxel(2, State::Occupied), Stamp(30));
        assert_eq!(layer.block_before(block, Stamp(30)), Ok(Some(&expected)));
        // Nor does a chunk that says nothing new hide it.
        layer.apply_snapshot(&snapshot);
        assert_eq!(layer.block_before(block, Stamp(30)), Ok(Some(&expected)));
    }

    #[test]
    fn a_block_of_512_different_stamps_and_then_many_more() {
        let mut layer = Layer::default();
        for round in 0..5i64 {
            for bit in 0..512i64 {
                let voxel = Voxel::new((bit & 7) as i32, (bit >> 3 & 7) as i32, (bit >> 6) as i32);
                let state = if (bit + round) % 3 == 0 { State::Occupied } else { State::Free };
                layer.apply(&Changes::from_voxels([(voxel, state)]), Stamp(round * 1000 + bit));
                assert_eq!(layer.get(voxel), Some((state, Stamp(round * 1000 + bit))));
            }
            assert_eq!(layer.get(Voxel::new(3, 2, 1)).unwrap().1, Stamp(round * 1000 + 64 + 16 + 3));
        }
        assert!(layer.memory_bytes() <= LAYER_BLOCK_BYTES_MAX, "{}", layer.memory_bytes());
    }

    #[test]
    fn sensors_of_a_flight_that_sees_the_same_place_again_and_again_do_not_pile_up() {
        let mut layer = Layer::default();
        let kept =
            |batch: i64| if batch % 100 == 0 { Voxel::new(batch as i32, 50, 0) } else { Voxel::new(1, 1, 1) };
        for batch in 0..20_000 {
            layer.apply(&Changes::from_voxels([(kept(batch), State::Free)]), Stamp(batch));
            layer.note_sensor(Stamp(batch), [batch as i32, 0, 0]);
            // 200 batches stand at the end, and the blocks are as few.
            assert!(layer.sensors.len() < 200 + 2 * SENSORS_NOTED_MIN, "{} of {batch}", layer.sensors.len());
        }
        let snapshot = layer.snapshot().unwrap();
        assert_eq!(snapshot.sensors.len(), snapshot.parts.len());
        // A snapshot says where its batches were seen from.
        let mut again = Layer::default();
        again.apply_snapshot(&snapshot);
        assert_eq!(again.snapshot().unwrap(), snapshot);
    }

    #[test]
    fn the_digest_tells_states_and_stamps_apart() {
        let of = |state, stamp| {
            let mut layer = Layer::default();
            layer.apply(&Changes::from_voxels([(Voxel::new(1, -2, 3), state)]), Stamp(stamp));
            layer.digest()
        };
        assert_eq!(of(State::Free, 7), of(State::Free, 7));
        assert_ne!(of(State::Free, 7), of(State::Occupied, 7));
        assert_ne!(of(State::Free, 7), of(State::Free, 8));
    }
}
