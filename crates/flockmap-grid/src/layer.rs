//! What is known from one origin.

use rustc_hash::FxHashMap;

use crate::stamps::BlockStamps;
use crate::{BlockIndex, Changes, Plane, PresentState, Stamp, State, StateBlock, Voxel, VoxelBox, voxel_bit};

/// State and stamp of every voxel that one stream has told of, in the frame of its origin.
///
/// Every voxel keeps the word with the newest stamp (Sec. IV-C of the paper). So packages may be applied in any
/// order and any number of times, and every robot that has applied the same ones holds the same layer.
#[derive(Clone, Debug, Default)]
pub struct Layer {
    blocks: FxHashMap<BlockIndex, LayerBlock>,
    newest: Option<Stamp>,
}

#[derive(Clone, Debug)]
struct LayerBlock {
    states: StateBlock,
    stamps: BlockStamps,
}

/// Most bytes that one block of a layer can take: 512 voxels that changed last in 512 different cycles.
pub const LAYER_BLOCK_BYTES_MAX: usize = size_of::<LayerBlock>() + 32 + 2 * 1024 * size_of::<Stamp>() + 1024;

impl Layer {
    /// Takes over each change that is newer than what is known of its voxel. At equal stamps the known one
    /// stays, unless the new one is Occupied. Returns the blocks and voxels that it took over. O(changes).
    pub fn apply(&mut self, changes: &Changes, stamp: Stamp) -> Vec<(BlockIndex, Plane)> {
        let mut taken = Vec::with_capacity(changes.blocks().len());
        for (index, new) in changes.blocks() {
            let block = self.blocks.entry(*index).or_insert_with(|| LayerBlock {
                states: StateBlock::default(),
                stamps: BlockStamps::new(stamp),
            });
            let mut mask = new.known();
            if block.stamps.newest() >= stamp {
                block.keep_newer(&mut mask, new, stamp);
            }
            if mask != [0; 8] {
                block.states.overlay(&new.masked(&mask));
                block.stamps.set(&mask, stamp, &block.states.known());
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

    /// Bytes that the layer holds. O(blocks).
    pub fn memory_bytes(&self) -> usize {
        self.blocks.values().map(|b| size_of::<LayerBlock>() + 32 + b.stamps.memory_bytes()).sum()
    }

    /// The whole layer with its stamps, such that applying its parts to an empty layer gives this one.
    /// `None` if nothing is known. O(voxels).
    pub fn present_state(&self) -> Option<PresentState> {
        let mut parts = std::collections::BTreeMap::<Stamp, FxHashMap<BlockIndex, StateBlock>>::new();
        let mut region: Option<VoxelBox> = None;
        for (index, block) in &self.blocks {
            let whole = Changes::from_blocks(vec![(*index, block.states)]);
            region = match (region, whole.bounding_box()) {
                (Some(a), Some(b)) => Some(a.union(&b)),
                (a, b) => a.or(b),
            };
            for (voxel, state) in whole.voxels() {
                let bit = voxel_bit(voxel);
                let part = parts.entry(block.stamps.get(bit)).or_default();
                part.entry(*index).or_default().set(bit, state);
            }
        }
        let changes = |part: FxHashMap<_, _>| Changes::from_blocks(part.into_iter().collect());
        Some(PresentState {
            region: region?,
            parts: parts.into_iter().map(|(stamp, part)| (stamp, changes(part))).collect(),
        })
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
            let known = block.states.known();
            for bit in (0..512).filter(|bit| known[bit / 64] >> (bit % 64) & 1 == 1) {
                hash = mix(hash, block.stamps.get(bit).0 as u64);
            }
            // A sum does not depend on the order of the blocks.
            sum = sum.wrapping_add(hash);
        }
        sum
    }
}

impl LayerBlock {
    /// Takes the voxels out of `mask` whose known word stands against a new one of this stamp.
    fn keep_newer(&self, mask: &mut Plane, new: &StateBlock, stamp: Stamp) {
        let known = self.states.known();
        for z in 0..8 {
            let mut rivals = mask[z] & known[z];
            while rivals != 0 {
                let bit = z * 64 + rivals.trailing_zeros() as usize;
                rivals &= rivals - 1;
                let stays = match self.stamps.get(bit).cmp(&stamp) {
                    core::cmp::Ordering::Less => false,
                    core::cmp::Ordering::Greater => true,
                    core::cmp::Ordering::Equal => {
                        !(new.get(bit) == State::Occupied && self.states.get(bit) == State::Free)
                    }
                };
                if stays {
                    mask[z] &= !(1 << (bit % 64));
                }
            }
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
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

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
                let taken = layer.apply(&changes, *stamp);
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
            for (voxel, (stamp, occupied)) in &model {
                let state = if *occupied { State::Occupied } else { State::Free };
                prop_assert_eq!(layer.get(*voxel), Some((state, *stamp)));
            }
            // Its present state makes the same layer again.
            let mut again = Layer::default();
            if let Some(present) = layer.present_state() {
                for (stamp, part) in present.parts.iter().rev() {
                    prop_assert_eq!(part.within(&present.region), part.clone());
                    again.apply(part, *stamp);
                }
            }
            prop_assert_eq!(again.digest(), layer.digest());
        }
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
