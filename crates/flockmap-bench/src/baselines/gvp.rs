//! The map exchange of GVP-MREP (its message MapC): sub-blocks, homogeneous in 8 bytes, mixed with 2 bits a
//! voxel.
//!
//! A sub-block goes out when more than 97.5 % of it is known for the first time, or when 2 s have passed
//! since it was last sent (or first touched) and at least 15 % of its voxels are new or changed. What never
//! comes to either stays unsent. Its place here is a block of 8³ voxels, looked at when a batch ends.
//!
//! A message is a row of sub-blocks: block index (3 × i16), state (1 occupied, 2 free, 3 mixed), a zero;
//! mixed: 128 bytes, 2 bits a voxel (0 unknown, 1 occupied, 2 free), x fastest.

use std::collections::BTreeSet;

use anyhow::{Result, ensure};
use flockmap::codec::Batch;
use flockmap::grid::{BLOCK_VOXELS, BlockIndex, Changes, Plane, Stamp, State, StateBlock};
use rustc_hash::FxHashMap;

use crate::baselines::bytes::Reader;
use crate::baselines::state_map::StateMap;
use crate::baselines::traits::{Messages, Sender};

/// Waits so long before it sends a sub-block that is not nearly whole.
const WAIT_MICROS: i64 = 2_000_000;

#[derive(Default)]
pub(crate) struct GvpSender {
    /// As packed by the mapper.
    now: StateMap,
    blocks: FxHashMap<BlockIndex, LastSent>,
    /// Blocks with something unsent.
    waiting: BTreeSet<BlockIndex>,
}

struct LastSent {
    /// What was sent last.
    states: StateBlock,
    /// When that was, or when the block was first touched.
    since: Stamp,
}

const METHOD: &str = "gvp";

impl Sender for GvpSender {
    fn batch(&mut self, now: Stamp, _batch: &Batch, changes: &Changes, out: &mut Messages) -> Result<()> {
        self.now.apply(changes)?;
        for (index, _) in changes.blocks() {
            let untouched = LastSent { states: StateBlock::default(), since: now };
            self.blocks.entry(*index).or_insert(untouched);
            self.waiting.insert(*index);
        }
        let mut message = Vec::new();
        let mut far = false;
        self.waiting.retain(|index| {
            let block = self.now.block(*index);
            let Some(sent) = self.blocks.get_mut(index) else { return false };
            if !is_due(&block, sent, now) {
                return true;
            }
            far |= !write(*index, &block, &mut message);
            *sent = LastSent { states: block, since: now };
            false
        });
        ensure!(!far, "{METHOD} cannot send this: block indices have 16 bits");
        if !message.is_empty() {
            out.push(message);
        }
        Ok(())
    }
}

fn is_due(block: &StateBlock, sent: &LastSent, now: Stamp) -> bool {
    let new = block.minus(&sent.states).known_count();
    let waited = now.micros_since(sent.since) >= WAIT_MICROS && new * 100 >= 15 * BLOCK_VOXELS as u32;
    is_nearly_known(block) && !is_nearly_known(&sent.states) || waited
}

fn is_nearly_known(block: &StateBlock) -> bool {
    block.known_count() * 1000 > 975 * BLOCK_VOXELS as u32
}

const OCCUPIED: u8 = 1;
const FREE: u8 = 2;
const MIXED: u8 = 3;
const ALL: Plane = [!0; 8];

/// Whether the index has room.
fn write(index: BlockIndex, block: &StateBlock, out: &mut Vec<u8>) -> bool {
    for axis in [index.x, index.y, index.z] {
        let Ok(axis) = i16::try_from(axis) else { return false };
        out.extend_from_slice(&axis.to_le_bytes());
    }
    let state = match (*block.free() == ALL, *block.occupied() == ALL) {
        (true, _) => FREE,
        (_, true) => OCCUPIED,
        _ => MIXED,
    };
    out.extend_from_slice(&[state, 0]);
    if state == MIXED {
        let code = |bit| match block.get(bit) {
            State::Unknown => 0,
            State::Occupied => OCCUPIED,
            State::Free => FREE,
        };
        out.extend(
            (0..BLOCK_VOXELS / 4)
                .map(|byte| (0..4).fold(0, |packed, place| packed | code(4 * byte + place) << (2 * place))),
        );
    }
    true
}

/// What a message changes: what it says to be unknown stays as it was. Memory: 140 bytes for each sub-block.
pub(crate) fn parse(message: &[u8]) -> Option<Changes> {
    let mut reader = Reader::new(message);
    let mut blocks = Vec::new();
    while !reader.is_empty() {
        let mut axis = || Some(i32::from(reader.u16()? as i16));
        let index = BlockIndex::new(axis()?, axis()?, axis()?);
        let block = match reader.array()? {
            [FREE, 0] => StateBlock::new(ALL, [0; 8]),
            [OCCUPIED, 0] => StateBlock::new([0; 8], ALL),
            [MIXED, 0] => {
                let mut block = StateBlock::default();
                for (byte, packed) in reader.bytes(BLOCK_VOXELS / 4)?.iter().enumerate() {
                    for place in 0..4 {
                        let state = match packed >> (2 * place) & 3 {
                            0 => continue,
                            OCCUPIED => State::Occupied,
                            FREE => State::Free,
                            _ => return None,
                        };
                        block.set(4 * byte + place, state);
                    }
                }
                block
            }
            _ => return None,
        };
        blocks.push((index, block));
    }
    Some(Changes::from_blocks(blocks))
}
