//! Parts of the map.

use flockmap_grid::{BlockIndex, Plane, RobotId, Stamp, StateBlock, VOXEL_LIMIT, meet};

use super::{BLOCKS, LENGTH_BYTES, ORIGINS, field};
use crate::FeedError;
use crate::bytes::{Fields, put_plane};

/// A block without origins: index and two planes.
const BLOCK_BYTES: usize = 3 * 4 + 2 * 64;

/// A block as it is.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Block {
    /// Where.
    pub index: BlockIndex,
    /// What is known of it; nothing if it was emptied.
    pub states: StateBlock,
    /// Who saw which of its known voxels last. Without a robot twice; together all known voxels. Empty in a
    /// feed without origins.
    pub origins: Vec<(RobotId, Plane)>,
}

/// A part of the map.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Blocks {
    /// The reader now has all that changed up to this version.
    pub upto: u64,
    /// The newest version of the node's map.
    pub newest: u64,
    /// When the node's map came to the newest version, on the node's clock.
    pub stamp: Stamp,
    /// Whether origins are there.
    pub origins: bool,
    /// In ascending order of the version at which they changed last.
    pub blocks: Vec<Block>,
}

impl Blocks {
    pub(super) fn parse(body: &[u8]) -> Result<Self, FeedError> {
        let mut fields = Fields::new("blocks", body);
        let [upto, newest] = [fields.u64("upto")?, fields.u64("newest")?];
        let stamp = Stamp(fields.i64("stamp")?);
        let origins = fields.u8("flags")? & ORIGINS != 0;
        let count = fields.u32("count")? as usize;
        let count = fields.check_count("blocks", count, BLOCK_BYTES)?;
        let blocks = (0..count).map(|_| Block::parse(&mut fields, origins)).collect::<Result<_, _>>()?;
        Ok(Self { upto, newest, stamp, origins, blocks })
    }
}

impl Block {
    fn parse(fields: &mut Fields<'_>, with_origins: bool) -> Result<Self, FeedError> {
        let mut at = [0; 3];
        for at in &mut at {
            *at = fields.i32("block index")?;
            if at.unsigned_abs() > VOXEL_LIMIT as u32 / 8 {
                let expected = "-33,554,432 to 33,554,432, as two's complement";
                return Err(field("blocks", "block index", u64::from(*at as u32), expected));
            }
        }
        let index = BlockIndex::new(at[0], at[1], at[2]);
        let [free, occupied] = [fields.plane("free plane")?, fields.plane("occupied plane")?];
        if meet(&free, &occupied) {
            return Err(FeedError::Block(index));
        }
        let states = StateBlock::new(free, occupied);
        let origins = if with_origins { parse_origins(fields, index, &states.known())? } else { Vec::new() };
        Ok(Self { index, states, origins })
    }
}

/// Origins that share no voxel, and have all that are known.
fn parse_origins(
    fields: &mut Fields<'_>,
    index: BlockIndex,
    known: &Plane,
) -> Result<Vec<(RobotId, Plane)>, FeedError> {
    let count = usize::from(fields.u16("number of origins")?);
    if count == 1 {
        let only = RobotId(fields.u16("origin")?);
        return if *known == [0; 8] { Err(FeedError::Block(index)) } else { Ok(vec![(only, *known)]) };
    }
    let count = fields.check_count("origins", count, 2 + 64)?;
    let (mut origins, mut seen) = (Vec::with_capacity(count), [0; 8]);
    for _ in 0..count {
        let (origin, plane) = (RobotId(fields.u16("origin")?), fields.plane("plane of an origin")?);
        if plane == [0; 8] || meet(&plane, &seen) || origins.iter().any(|(other, _)| *other == origin) {
            return Err(FeedError::Block(index));
        }
        seen = core::array::from_fn(|z| seen[z] | plane[z]);
        origins.push((origin, plane));
    }
    if seen == *known { Ok(origins) } else { Err(FeedError::Block(index)) }
}

/// A blocks frame that is written block by block.
pub(crate) struct BlocksFrame {
    bytes: Vec<u8>,
    count: u32,
    origins: bool,
}

/// Length, kind, two versions, stamp, flags, count.
const BLOCKS_HEAD_BYTES: usize = LENGTH_BYTES + 1 + 3 * 8 + 1 + 4;

impl BlocksFrame {
    pub(crate) fn new(origins: bool) -> Self {
        Self { bytes: vec![0; BLOCKS_HEAD_BYTES], count: 0, origins }
    }

    pub(crate) const fn len(&self) -> usize {
        self.bytes.len()
    }

    pub(crate) fn push(&mut self, block: &Block) {
        let Block { index, states, origins } = block;
        let bytes = &mut self.bytes;
        [index.x, index.y, index.z].iter().for_each(|at| bytes.extend_from_slice(&at.to_le_bytes()));
        put_plane(bytes, states.free());
        put_plane(bytes, states.occupied());
        if self.origins {
            bytes.extend_from_slice(&(origins.len() as u16).to_le_bytes());
            for (origin, plane) in origins {
                bytes.extend_from_slice(&origin.0.to_le_bytes());
                if origins.len() > 1 {
                    put_plane(bytes, plane);
                }
            }
        }
        self.count += 1;
    }

    pub(crate) fn finish(mut self, upto: u64, newest: u64, stamp: Stamp) -> Vec<u8> {
        let mut head = ((self.bytes.len() - LENGTH_BYTES) as u32).to_le_bytes().to_vec();
        head.push(BLOCKS);
        head.extend_from_slice(&upto.to_le_bytes());
        head.extend_from_slice(&newest.to_le_bytes());
        head.extend_from_slice(&stamp.0.to_le_bytes());
        head.push(if self.origins { ORIGINS } else { 0 });
        head.extend_from_slice(&self.count.to_le_bytes());
        self.bytes[..BLOCKS_HEAD_BYTES].copy_from_slice(&head);
        self.bytes
    }
}
