//! What is known from one origin.

mod block;
mod cube;
mod packed;
mod packing;
mod stamps;
mod unpacked;

use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use rustc_hash::{FxHashMap, FxHashSet};

use crate::block::set_bits;
use crate::changes::bounding_box;
use crate::memory::table_bytes;
use crate::snapshot::SnapshotVoxels;
use crate::{BlockIndex, Changes, Plane, Snapshot, Stamp, State, StateBlock, Voxel, VoxelBox, voxel_bit};
use block::LayerBlock;
use cube::{CUBE_BLOCK_BYTES, Cube, cube_of};
use packed::PackedCube;
use stamps::BlockStamps;
pub(crate) use unpacked::Unpacked;

/// State and stamp of every voxel that one stream has published, in the frame of its origin.
///
/// Every voxel keeps the state with the newest stamp (Sec. IV-C of the paper). So packages may be applied in any
/// order and any number of times, and every robot that has applied the same ones holds the same layer.
///
/// Blocks lie in cubes of 4³. A cube that nothing was applied to for a while is packed, to a tenth of a byte or two
/// for each voxel of a scanned place, its stamp included; it is unpacked when it is read or something is applied to
/// it. A copy of a layer shares what is packed.
#[derive(Clone, Debug, Default)]
pub struct Layer {
    cubes: FxHashMap<BlockIndex, Place>,
    newest: Option<Stamp>,
    blocks: usize,
    /// Of cubes that are open, and how many bytes these take on the heap.
    open: usize,
    open_bytes: usize,
    packed_bytes: usize,
    /// Each open cube once, with a value that its `touched` had: those first to which nothing was applied for longest,
    /// nearly.
    queue: VecDeque<(u64, BlockIndex)>,
    /// How often blocks were changed.
    changed: u64,
    unpacked: Arc<Unpacked>,
    /// By end of batch, where the sensor was. Codecs make use of it; it is no part of what is known.
    sensors: BTreeMap<Stamp, [i32; 3]>,
    /// How many were noted since the layer was last gone through for those of which nothing stands any more.
    sensors_noted: usize,
}

/// A cube of blocks where it lies.
#[derive(Clone, Debug)]
enum Place {
    Open(Box<Open>),
    Packed(Arc<PackedCube>),
}

#[derive(Clone, Debug, Default)]
struct Open {
    cube: Cube,
    /// [`Layer::changed`] when something was applied to it last.
    touched: u64,
}

/// Most batches whose sensor a layer remembers; the oldest are forgotten.
const SENSORS_MAX: usize = 1 << 16;
/// A sensor in its map.
pub(crate) const SENSOR_BYTES: usize = 48;
/// So many sensors are noted at least before the layer is gone through.
const SENSORS_NOTED_MIN: usize = 1_024;

/// When blocks were changed so often, it is looked whether some lie cold.
const LOOKED_EVERY: u64 = 256;
/// A cube is cold to which nothing was applied while blocks were changed four times as often as there are open ones,
/// but between these. So what is changed all the time stays open, however large it is, and what a robot has left
/// behind is packed within half a minute as a rule.
const COLD: [u64; 2] = [8_192, 65_536];

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

/// Most bytes that one block of a layer can take: 512 voxels that changed last in 512 different batches, alone in
/// its cube.
pub const LAYER_BLOCK_BYTES_MAX: usize = table_bytes(1, PLACE_BYTES)
    + size_of::<Open>()
    + 2 * CUBE_BLOCK_BYTES
    + BlockStamps::bytes_of(usize::MAX);
/// An open cube in the queue, which doubles.
const QUEUE_BYTES: usize = size_of::<(u64, BlockIndex)>();
/// A cube in the table.
const PLACE_BYTES: usize = size_of::<(BlockIndex, Place)>();

impl Layer {
    /// Nothing is known. `unpacked` are cubes that were unpacked to be read, of other layers too.
    pub(crate) fn new(unpacked: &Arc<Unpacked>) -> Self {
        Self { unpacked: Arc::clone(unpacked), ..Self::default() }
    }

    /// Takes over each change that is newer than what is known of its voxel. At equal stamps the known one
    /// stays, unless the new one is Occupied. Returns the blocks and voxels that it took over. O(changes).
    pub fn apply(&mut self, changes: &Changes, stamp: Stamp) -> Vec<(BlockIndex, Plane)> {
        let taken = self.take_over(changes, stamp, true);
        self.note_changed(changes.blocks().len());
        taken
    }

    /// The same for every voxel of a snapshot, each with its own stamp. Returns the blocks and voxels that it
    /// took over, a block once for each stamp. O(voxels).
    pub fn apply_snapshot(&mut self, state: &Snapshot) -> Vec<(BlockIndex, Plane)> {
        let taken =
            state.parts.iter().flat_map(|(stamp, part)| self.take_over(part, *stamp, false)).collect();
        // After the voxels: the sensor of a batch of which nothing stands may be forgotten at once.
        state.sensors.iter().for_each(|(stamp, sensor)| self.note_sensor(*stamp, *sensor));
        self.note_changed(state.parts.iter().map(|(_, part)| part.blocks().len()).sum());
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
        if self.sensors_noted >= SENSORS_NOTED_MIN.max(self.blocks / 4).max(self.sensors.len() / 2) {
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

    /// Forgets the sensors of batches of which no voxel stands. O(voxels of open cubes, stamps of packed ones).
    fn forget_sensors(&mut self) {
        self.sensors_noted = 0;
        let mut unseen: FxHashSet<Stamp> = self.sensors.keys().copied().collect();
        for place in self.cubes.values() {
            let mut found = |stamp| {
                unseen.remove(&stamp);
            };
            match place {
                Place::Open(open) => open.cube.parts().iter().for_each(|block| {
                    block.stamps.for_each_in_use(&block.states.known(), &mut found);
                }),
                Place::Packed(packed) => packed.for_each_stamp(found),
            }
        }
        self.sensors.retain(|stamp, _| !unseen.contains(stamp));
    }

    /// `is_batch`: the changes are of one batch, and what was there before remains known.
    fn take_over(&mut self, changes: &Changes, stamp: Stamp, is_batch: bool) -> Vec<(BlockIndex, Plane)> {
        let mut taken = Vec::with_capacity(changes.blocks().len());
        for (index, new) in changes.blocks() {
            let changed = self.changed;
            let open = self.open(cube_of(*index));
            open.touched = changed;
            let (list, blocks) = (open.cube.list_bytes(), open.cube.len());
            let block = open.cube.entry(*index, stamp);
            let stamps = block.stamps.memory_bytes();
            let mask = block.take_over(new, stamp, is_batch);
            let grown = block.stamps.memory_bytes();
            let (list_grown, blocks_grown) = (open.cube.list_bytes(), open.cube.len());
            // The stamps of a block that is new count from nothing.
            let before = if blocks_grown > blocks { 0 } else { stamps };
            self.open_bytes = self.open_bytes + list_grown - list + grown - before;
            self.blocks += blocks_grown - blocks;
            self.open += blocks_grown - blocks;
            if mask != [0; 8] {
                taken.push((*index, mask));
            }
        }
        self.newest = self.newest.max((!changes.is_empty()).then_some(stamp));
        taken
    }

    /// The cube at a place of the table to write to, unpacked if need be.
    fn open(&mut self, at: BlockIndex) -> &mut Open {
        let place = self.cubes.entry(at).or_insert_with(|| {
            self.open_bytes += size_of::<Open>();
            self.queue.push_back((self.changed, at));
            Place::Open(Box::default())
        });
        if let Place::Packed(packed) = place {
            let cube = packed.unpack();
            self.packed_bytes -= packed.memory_bytes();
            self.open_bytes += size_of::<Open>() + cube.memory_bytes();
            self.open += cube.len();
            self.queue.push_back((self.changed, at));
            *place = Place::Open(Box::new(Open { cube, touched: 0 }));
        }
        match place {
            Place::Open(open) => open,
            Place::Packed(_) => unreachable!("it was unpacked"),
        }
    }

    /// Unpacks what lies in a box or next to it: for who is about to read and change it block by block. No more than
    /// so many blocks, some 15 µs each, and no more bytes than there is room for; what stays packed can be read too.
    pub(crate) fn open_near(&mut self, region: &VoxelBox, mut blocks_left: usize, mut room: usize) {
        let [min, max] = [region.min().block(), region.max().block()];
        let low = cube_of(BlockIndex { x: min.x - 1, y: min.y - 1, z: min.z - 1 });
        let high = cube_of(BlockIndex { x: max.x + 1, y: max.y + 1, z: max.z + 1 });
        let is_near = |at: BlockIndex| {
            [(at.x, low.x, high.x), (at.y, low.y, high.y), (at.z, low.z, high.z)]
                .into_iter()
                .all(|(at, low, high)| (low..=high).contains(&at))
        };
        let packed = |at: BlockIndex| match self.cubes.get(&at) {
            Some(Place::Packed(packed)) => Some((at, packed.len(), packed.open_bytes() + size_of::<Open>())),
            _ => None,
        };
        // The box of a hostile package may be larger than the map.
        let sides = [(low.x, high.x), (low.y, high.y), (low.z, high.z)];
        let cubes = sides.map(|(low, high)| u128::from(high.abs_diff(low)) + 1).into_iter().product::<u128>();
        let mut near: Vec<_> = if cubes <= self.cubes.len() as u128 {
            let all = (low.x..=high.x).flat_map(|x| {
                (low.y..=high.y).flat_map(move |y| (low.z..=high.z).map(move |z| BlockIndex { x, y, z }))
            });
            all.filter_map(packed).collect()
        } else {
            self.cubes.keys().copied().filter(|at| is_near(*at)).filter_map(packed).collect()
        };
        near.sort_unstable();
        for (at, blocks, bytes) in near {
            if blocks <= blocks_left && bytes <= room {
                (blocks_left, room) = (blocks_left - blocks, room - bytes);
                let changed = self.changed;
                self.open(at).touched = changed;
            }
        }
    }

    /// Notes that blocks were changed, and packs as many of those that lie cold now and then: some 15 µs for each.
    fn note_changed(&mut self, blocks: usize) {
        let before = self.changed;
        self.changed += blocks as u64;
        if self.changed / LOOKED_EVERY > before / LOOKED_EVERY {
            self.pack_cold((4 * self.open as u64).clamp(COLD[0], COLD[1]), blocks.max(LOOKED_EVERY as usize));
        }
    }

    /// Packs cubes to which nothing was applied by the last `cold` changes of blocks, the longest ago first, until
    /// `blocks_max` blocks are packed.
    fn pack_cold(&mut self, cold: u64, blocks_max: usize) {
        let limit = self.changed.saturating_sub(cold);
        let mut packed = 0;
        while packed < blocks_max
            && let Some((_, at)) = self.queue.pop_front_if(|(noted, _)| *noted < limit)
        {
            match self.cubes.get(&at) {
                Some(Place::Open(open)) if open.touched >= limit => self.queue.push_back((open.touched, at)),
                _ => packed += self.pack_cube(at),
            }
        }
    }

    /// Packs all that is open. O(open blocks).
    pub fn pack(&mut self) {
        self.pack_cold(0, usize::MAX);
    }

    /// Packs all but what had something lately, for who needs the room: what is written to all the time would be
    /// open again at once. O(open blocks).
    pub(crate) fn make_room(&mut self) {
        self.pack_cold(COLD[0], usize::MAX);
    }

    /// Packs an open cube. Returns the number of its blocks.
    fn pack_cube(&mut self, at: BlockIndex) -> usize {
        let Some(place) = self.cubes.get_mut(&at) else { return 0 };
        let Place::Open(open) = place else { return 0 };
        let (blocks, bytes) = (open.cube.len(), size_of::<Open>() + open.cube.memory_bytes());
        let packed = PackedCube::pack(&open.cube);
        self.open_bytes -= bytes;
        self.open -= blocks;
        self.packed_bytes += packed.memory_bytes();
        *place = Place::Packed(Arc::new(packed));
        blocks
    }

    /// State of a voxel. A cube that is packed is unpacked for it: some 15 µs for each of its blocks, if it was not
    /// read just before.
    pub fn state(&self, voxel: Voxel) -> State {
        self.get(voxel).map_or(State::Unknown, |(state, _)| state)
    }

    /// State of a voxel and when it was set. `None` if it is Unknown. Cost as of [`Self::state`].
    pub fn get(&self, voxel: Voxel) -> Option<(State, Stamp)> {
        self.with_block(voxel.block(), |block| block.get(voxel_bit(voxel))).flatten()
    }

    /// The states of a block, `None` if nothing in it is known. Cost as of [`Self::state`].
    pub fn block(&self, index: BlockIndex) -> Option<StateBlock> {
        self.with_block(index, |block| block.states)
    }

    /// Reads a block that is there.
    fn with_block<T>(&self, index: BlockIndex, read: impl FnOnce(&LayerBlock) -> T) -> Option<T> {
        match self.cubes.get(&cube_of(index))? {
            Place::Open(open) => open.cube.block(index).map(read),
            Place::Packed(packed) if packed.has(index) => self.unpacked.cube(packed).block(index).map(read),
            Place::Packed(_) => None,
        }
    }

    /// All cubes with their places in the table, unpacked one by one.
    fn cubes(&self) -> impl Iterator<Item = (BlockIndex, Cow<'_, Cube>)> {
        self.cubes.iter().map(|(at, place)| (*at, place.read()))
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
    ) -> Result<Option<StateBlock>, BaseSuperseded> {
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
    ) -> Result<Option<(StateBlock, Stamp)>, BaseSuperseded> {
        let known = self.with_block(index, |block| block.known_before(stamp)).transpose();
        known.map_err(|newest| BaseSuperseded { block: index, newest, stamp })
    }

    /// All blocks, in no order. Packed cubes are unpacked one by one.
    pub fn blocks(&self) -> impl Iterator<Item = (BlockIndex, StateBlock)> {
        self.cubes().flat_map(|(at, cube)| {
            let blocks = cube.blocks(at).map(|(index, block)| (index, block.states));
            blocks.collect::<Vec<_>>()
        })
    }

    /// Every known voxel with its state, block by block in ascending order. O(n log n) in blocks.
    pub fn voxels(&self) -> impl Iterator<Item = (Voxel, State)> {
        Changes::from_blocks(self.blocks().collect()).into_voxels()
    }

    /// Number of known voxels. O(open blocks, packed cubes).
    pub fn len(&self) -> usize {
        let of = |place: &Place| match place {
            Place::Open(open) => {
                open.cube.parts().iter().map(|block| block.states.known_count() as usize).sum()
            }
            Place::Packed(packed) => packed.voxels(),
        };
        self.cubes.values().map(of).sum()
    }

    /// Whether nothing is known.
    pub const fn is_empty(&self) -> bool {
        self.blocks == 0
    }

    /// Number of blocks.
    pub const fn block_count(&self) -> usize {
        self.blocks
    }

    /// Number of blocks that are packed.
    pub const fn packed_count(&self) -> usize {
        self.blocks - self.open
    }

    /// The newest stamp applied.
    pub const fn newest(&self) -> Option<Stamp> {
        self.newest
    }

    /// Bytes that the layer holds, as asked of the allocator. O(1).
    pub fn memory_bytes(&self) -> usize {
        let beside = table_bytes(self.cubes.len(), PLACE_BYTES) + SENSOR_BYTES * self.sensors.len();
        beside + self.open_bytes + self.packed_bytes + self.queue.capacity() * QUEUE_BYTES
    }

    /// Bytes that it may hold at most while and after so many blocks are added to it, beside their stamps. O(1).
    pub fn memory_bytes_with(&self, blocks: usize) -> usize {
        // Each in a cube of its own.
        let of_cube = size_of::<Open>() + 2 * CUBE_BLOCK_BYTES;
        self.memory_bytes() + self.table_growth(blocks) + self.queue_growth(blocks) + blocks * of_cube
    }

    /// The most by which taking over these changes, each with a stamp of its own, can make it grow, in bytes
    /// (sensors not counted), and by how many blocks. O(blocks), and blocks of packed cubes that are met.
    pub(crate) fn growth_max<'a>(&self, parts: impl Iterator<Item = &'a Changes>) -> (usize, usize) {
        let mut stamps_of = FxHashMap::<BlockIndex, usize>::default();
        for (index, _) in parts.flat_map(Changes::blocks) {
            *stamps_of.entry(*index).or_default() += 1;
        }
        // By cube: how many blocks are new.
        let mut cubes = FxHashMap::<BlockIndex, usize>::default();
        let (mut bytes, mut new_blocks) = (0, 0);
        for (index, stamps) in stamps_of {
            let new = cubes.entry(cube_of(index)).or_default();
            let growth = self.with_block(index, |block| block.stamps.growth_max(stamps));
            bytes += growth.unwrap_or_else(|| {
                *new += 1;
                new_blocks += 1;
                BlockStamps::bytes_of(stamps)
            });
        }
        let (mut new_cubes, mut opened) = (0, 0);
        for (at, new) in cubes {
            bytes += match self.cubes.get(&at) {
                Some(Place::Open(open)) => open.cube.growth_max(new),
                Some(Place::Packed(packed)) => {
                    opened += 1;
                    size_of::<Open>() + packed.open_bytes() + Cube::list_bytes_max(packed.len() + new)
                }
                None => {
                    new_cubes += 1;
                    size_of::<Open>() + Cube::list_bytes_max(new)
                }
            };
        }
        (bytes + self.table_growth(new_cubes) + self.queue_growth(new_cubes + opened), new_blocks)
    }

    /// While the queue grows, the old one is there too.
    fn queue_growth(&self, cubes: usize) -> usize {
        let then = self.queue.len() + cubes;
        if then > self.queue.capacity() { then.next_power_of_two().max(4) * QUEUE_BYTES } else { 0 }
    }

    /// While a table grows, the old one is there too.
    fn table_growth(&self, cubes: usize) -> usize {
        let [now, then] = [0, cubes].map(|more| table_bytes(self.cubes.len() + more, PLACE_BYTES));
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
        let wanted = || {
            let cubes = self.cubes.iter().filter(|(_, place)| place.newest().is_some_and(is_wanted));
            cubes.map(|(at, place)| (*at, place.read()))
        };
        let mut blocks: Vec<BlockIndex> =
            Vec::with_capacity(if newer_than.is_none() { self.blocks } else { 0 });
        let mut number_of = FxHashMap::<Stamp, u32>::default();
        let (mut region, mut count, mut last) = (None::<VoxelBox>, 0, None);
        for (at, cube) in wanted() {
            for (index, block) in cube.blocks(at).filter(|(_, block)| is_wanted(block.stamps.newest())) {
                let mut known = [0; 8];
                for bit in set_bits(&block.states.known()) {
                    let stamp = block.stamps.get(bit);
                    if !is_wanted(stamp) {
                        continue;
                    }
                    if last != Some(stamp) {
                        number_of.insert(stamp, 0);
                        last = Some(stamp);
                    }
                    known[bit / 64] |= 1 << (bit % 64);
                    count += 1;
                }
                let part = bounding_box(core::iter::once((index, &StateBlock::new(known, [0; 8]))));
                region = match (region, part) {
                    (Some(a), Some(b)) => Some(a.union(&b)),
                    (a, b) => a.or(b),
                };
                blocks.push(index);
            }
        }
        blocks.sort_unstable();
        let mut stamps: Vec<Stamp> = number_of.keys().copied().collect();
        stamps.sort_unstable();
        for (number, stamp) in (0..).zip(&stamps) {
            number_of.insert(*stamp, number);
        }
        let sensors = stamps.iter().filter_map(|stamp| Some((*stamp, *self.sensors.get(stamp)?))).collect();
        let region = region?;
        let places_of = blocks.clone();
        let voxels = wanted().flat_map(|(at, cube)| {
            let mut of_cube = Vec::new();
            let mut last = (Stamp(0), None);
            for (index, block) in cube.blocks(at) {
                let Ok(number) = places_of.binary_search(&index) else { continue };
                for bit in set_bits(&block.states.known()) {
                    let stamp = block.stamps.get(bit);
                    if !is_wanted(stamp) {
                        continue;
                    }
                    let of_stamp = match last {
                        (same, Some(of_stamp)) if same == stamp => of_stamp,
                        _ => number_of.get(&stamp).copied().unwrap_or(0),
                    };
                    last = (stamp, Some(of_stamp));
                    of_cube.push((of_stamp, number as u32, bit, block.states.get(bit)));
                }
            }
            of_cube
        });
        SnapshotVoxels::new(region, stamps, blocks, count, voxels, sensors)
    }

    /// A number that is equal for layers with equal states and stamps, on every machine, and (very likely)
    /// different for others. O(voxels).
    pub fn digest(&self) -> u64 {
        // A sum does not depend on the order of the blocks.
        let blocks = self.cubes().flat_map(|(at, cube)| cube.blocks(at).map(hash_of).collect::<Vec<_>>());
        blocks.fold(0, u64::wrapping_add)
    }
}

/// Of a block with its states and stamps.
fn hash_of((index, block): (BlockIndex, &LayerBlock)) -> u64 {
    let mut hash = mix(0x666c_6f63_6b6d_6170, (index.x as u32 as u64) << 32 | index.y as u32 as u64);
    hash = mix(hash, index.z as u32 as u64);
    for word in block.states.free().iter().chain(block.states.occupied()) {
        hash = mix(hash, *word);
    }
    for bit in set_bits(&block.states.known()) {
        hash = mix(hash, block.stamps.get(bit).0 as u64);
    }
    hash
}

impl Place {
    /// The cube to be read, unpacked if need be.
    fn read(&self) -> Cow<'_, Cube> {
        match self {
            Self::Open(open) => Cow::Borrowed(&open.cube),
            Self::Packed(packed) => Cow::Owned(packed.unpack()),
        }
    }

    /// The newest stamp of all blocks.
    fn newest(&self) -> Option<Stamp> {
        match self {
            Self::Open(open) => open.cube.parts().iter().map(|block| block.stamps.newest()).max(),
            Self::Packed(packed) => Some(packed.newest()),
        }
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
mod tests;
