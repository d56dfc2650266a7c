//! The map exchange of GVP-MREP (its message MapC): sub-blocks, homogeneous in 8 bytes, mixed with 2 bits a voxel.
//!
//! A sub-block goes out when more than 97.5 % of it is known for the first time, or when 2 s have passed since it was last sent (or
//! first touched) and at least 15 % of its voxels are new or changed. What never comes to either stays unsent. Its place
//! here is a block of 8³ voxels, told at the end of a batch like everything else.
//!
//! A message is a row of sub-blocks: block index (3 × i16), state (1 occupied, 2 free, 3 mixed), a zero; mixed: 128 bytes, 2
//! bits a voxel (0 unknown, 1 occupied, 2 free), x fastest.

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
    blocks: FxHashMap<BlockIndex, SentBytes>,
    /// Blocks with something unsent, and the same as a list without order.
    waiting: Vec<BlockIndex>,
}

struct SentBytes {
    /// What was sent last.
    states: StateBlock,
    /// When that was, or when the block was first touched.
    since: Stamp,
    is_waiting: bool,
}

const METHOD: &str = "gvp";

impl Sender for GvpSender {
    fn batch(&mut self, now: Stamp, _batch: &Batch, changes: &Changes, out: &mut Messages) -> Result<()> {
        self.now.apply(changes)?;
        for (index, _) in changes.blocks() {
            let untouched = SentBytes { states: StateBlock::default(), since: now, is_waiting: false };
            let sent = self.blocks.entry(*index).or_insert(untouched);
            if !sent.is_waiting {
                sent.is_waiting = true;
                self.waiting.push(*index);
            }
        }
        self.waiting.sort_unstable();
        let mut message = Vec::new();
        let mut far = false;
        self.waiting.retain(|index| {
            let block = self.now.block(*index);
            let Some(sent) = self.blocks.get_mut(index) else { return false };
            if !is_due(&block, sent, now) {
                return true;
            }
            far |= !write(*index, &block, &mut message);
            *sent = SentBytes { states: block, since: now, is_waiting: false };
            false
        });
        ensure!(!far, "{METHOD} cannot send this: block indices have 16 bits");
        if !message.is_empty() {
            out.push(message);
        }
        Ok(())
    }
}

fn is_due(block: &StateBlock, sent: &SentBytes, now: Stamp) -> bool {
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

/// Takes in a message. Holds nothing beyond the map.
pub(crate) fn apply(message: &[u8], map: &mut StateMap) -> Result<()> {
    let mut reader = Reader::new(METHOD, message);
    let rule =
        "sub-blocks of 8 bytes: 3 indices, a state of 1 to 3, a zero; then 128 bytes of voxels if mixed";
    while !reader.is_empty() {
        let axis = |reader: &mut Reader<'_>| reader.array(rule).map(|b| i32::from(i16::from_le_bytes(b)));
        let index = BlockIndex::new(axis(&mut reader)?, axis(&mut reader)?, axis(&mut reader)?);
        let block = match reader.array(rule)? {
            [FREE, 0] => StateBlock::new(ALL, [0; 8]),
            [OCCUPIED, 0] => StateBlock::new([0; 8], ALL),
            [MIXED, 0] => {
                let mut block = StateBlock::default();
                for (byte, packed) in reader.take(BLOCK_VOXELS / 4, rule)?.iter().enumerate() {
                    for place in 0..4 {
                        let state = match packed >> (2 * place) & 3 {
                            0 => continue,
                            OCCUPIED => State::Occupied,
                            FREE => State::Free,
                            _ => return Err(reader.wrong("voxels of 0 unknown, 1 occupied or 2 free")),
                        };
                        block.set(4 * byte + place, state);
                    }
                }
                block
            }
            _ => return Err(reader.wrong(rule)),
        };
        // What is said to be unknown stays as it was told before.
        map.overlay(index, &block)?;
    }
    Ok(())
}
