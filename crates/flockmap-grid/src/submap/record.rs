//! What a stream says of its submaps, as voxels where no sensor comes to.
//!
//! Each submap but the first has a block in a place of the grid that is kept for this. One voxel of it is Occupied since
//! the submap began: its stamp says when that was. 170 others are the bits of its pose, Free for 0 and Occupied for 1.
//! All of them are said each time, in one batch; so where they have one stamp they are one pose, the newest that has
//! come, and where they have not, a part of a newer one is still to come. The first submap has a pose alone.

use super::SubmapId;
use super::pose_bits::{POSE_MASK, PoseBits};
use super::sheet::RECORDS;
use crate::{BlockIndex, Changes, Layer, Pose, PoseError, Stamp, State, StateBlock};

/// What is to be said of a submap.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SubmapRecord {
    /// Which one.
    pub submap: SubmapId,
    /// Whether it begins now.
    pub begins: bool,
    /// `T_map_submap`, if that is to be said. Of one that never had a pose it is that of the submap before it.
    pub pose: Option<Pose>,
}

/// What a layer says of a submap.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct Record {
    /// The stamp from which on it goes. Of the first: none.
    pub began: Option<Stamp>,
    /// Its pose.
    pub pose: Option<Pose>,
}

/// The slice of a block that says that the submap has begun, in its first voxel.
const BEGUN: usize = 4;
/// Records along x and y: so those of fifty submaps lie in a small box.
const SIDE: i32 = 4;

/// The block in which the record of a submap lies.
const fn block_of(submap: SubmapId) -> BlockIndex {
    let ([x, y, z], number) = (RECORDS, submap.0 as i32);
    BlockIndex { x: x + number % SIDE, y: y + number / SIDE % SIDE, z: z + number / (SIDE * SIDE) }
}

/// The submap whose record lies in a block.
pub(crate) fn submap_at(block: BlockIndex) -> Option<SubmapId> {
    let [x, y, z] = RECORDS;
    let (x, y, z) = (block.x - x, block.y - y, block.z - z);
    let is_there = (0..SIDE).contains(&x) && (0..SIDE).contains(&y) && z >= 0;
    let number = is_there.then_some(z.checked_mul(SIDE * SIDE)? + y * SIDE + x)?;
    SubmapId::new(u16::try_from(number).ok()?)
}

impl SubmapRecord {
    /// The changes of a batch that say this to all who take it into their layers: 20 to 50 bytes for a pose.
    ///
    /// # Errors
    /// [`PoseError`] if a pose is none, or lies beyond ±214 km.
    pub fn changes(records: &[Self]) -> Result<Changes, PoseError> {
        let blocks = records.iter().map(|record| {
            let (mut free, mut occupied) = ([0; 8], [0; 8]);
            occupied[BEGUN] = u64::from(record.begins);
            let bits = record.pose.map(Pose::to_bits).transpose()?;
            for (word, bits) in bits.iter().flatten().enumerate() {
                (free[word], occupied[word]) = (!bits & POSE_MASK[word], *bits);
            }
            Ok((block_of(record.submap), StateBlock::new(free, occupied)))
        });
        blocks.collect::<Result<Vec<_>, _>>().map(Changes::from_blocks)
    }
}

/// What a layer says of a submap.
pub(crate) fn read(layer: &Layer, submap: SubmapId) -> Record {
    let block = block_of(submap);
    let began = layer.get(block.voxel(BEGUN * 64)).filter(|(state, _)| *state == State::Occupied);
    Record { began: began.map(|(_, stamp)| stamp), pose: read_bits(layer, block).map(Pose::from_bits) }
}

/// `None` if there are none, or not all of one batch.
fn read_bits(layer: &Layer, block: BlockIndex) -> Option<PoseBits> {
    let (_, newest) = layer.get(block.voxel(0))?;
    let mut bits = [0; 3];
    for (word, mask) in POSE_MASK.into_iter().enumerate() {
        for bit in crate::block::bits(mask) {
            let (state, stamp) = layer.get(block.voxel(word * 64 + bit))?;
            if stamp != newest {
                return None;
            }
            bits[word] |= u64::from(state == State::Occupied) << bit;
        }
    }
    Some(bits)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn submap(number: u16) -> SubmapId {
        SubmapId::new(number).unwrap()
    }

    #[test]
    fn each_submap_has_a_block_of_its_own() {
        for number in 0..SubmapId::COUNT as u16 {
            assert_eq!(submap_at(block_of(submap(number))), Some(submap(number)));
        }
        let [x, y, z] = RECORDS;
        for block in [[x - 1, y, z], [x + 4, y, z], [x, y + 4, z], [x, y, z - 1], [x, y, z + 256], [0; 3]] {
            assert_eq!(submap_at(BlockIndex::new(block[0], block[1], block[2])), None, "{block:?}");
        }
    }

    #[test]
    fn the_newest_pose_of_one_batch_stands_in_whatever_order_they_come() {
        let pose = |at| Pose::from_yaw([at, -at, 0.5], at).rounded().unwrap();
        let changes = |begins, at| {
            let record = SubmapRecord { submap: submap(9), begins, pose: Some(pose(at)) };
            SubmapRecord::changes(&[record]).unwrap()
        };
        let all = [(10, changes(true, 1.0)), (20, changes(false, 2.0)), (30, changes(false, 3.0))];
        for order in [[0, 1, 2], [2, 1, 0], [1, 2, 0]] {
            let mut layer = Layer::default();
            assert_eq!(read(&layer, submap(9)), Record::default());
            for number in order {
                let (stamp, changes) = &all[number];
                layer.apply(changes, Stamp(*stamp));
            }
            let expected = Record { began: Some(Stamp(10)), pose: Some(pose(3.0)) };
            assert_eq!(read(&layer, submap(9)), expected);
            assert_eq!(read(&layer, submap(8)), Record::default());
            // Half of a newer one.
            let newer = changes(false, 4.0);
            let half: Vec<_> = newer.voxels().take(80).collect();
            layer.apply(&Changes::from_voxels(half), Stamp(40));
            assert_eq!(read(&layer, submap(9)), Record { pose: None, ..expected });
            layer.apply(&newer, Stamp(40));
            assert_eq!(read(&layer, submap(9)).pose, Some(pose(4.0)));
        }
    }
}
