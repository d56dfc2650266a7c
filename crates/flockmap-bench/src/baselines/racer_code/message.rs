//! The two messages and their ROS 1 serialisation: little-endian, a list begins with its length as `u32`.

use flockmap::codec::bytes::Reader;
use flockmap::sync::IntervalSet;

use super::config::CHUNK_VOXELS;

/// Largest index of a chunk.
const INDEX_MAX: u32 = i32::MAX as u32;

/// What the first byte of a datagram says: it holds [`ChunkStamps`]. In ROS a topic has a connection of its own.
pub const STAMPS: u8 = 0;
/// It holds [`ChunkData`].
pub const CHUNK: u8 = 1;

/// Voxels of one robot: 52 + 5 n bytes for n voxels, 1,052 for a full chunk.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ChunkData {
    /// Who sends it.
    pub from: i32,
    /// Whom it is meant for.
    pub to: i32,
    /// Whose observations it holds.
    pub owner: i32,
    /// Its number, from 1 for each owner.
    pub index: u32,
    /// Where each voxel lies in the grid. At most 200.
    pub addresses: Vec<u32>,
    /// 1 Occupied, 0 Free; as many as addresses.
    pub states: Vec<u8>,
}

impl ChunkData {
    /// The message.
    pub fn emit(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(52 + 5 * self.addresses.len());
        for id in [self.from, self.to, self.owner] {
            out.extend(id.to_le_bytes());
        }
        out.extend((self.addresses.len() as u32).to_le_bytes());
        self.addresses.iter().for_each(|address| out.extend(address.to_le_bytes()));
        out.extend((self.states.len() as u32).to_le_bytes());
        out.extend(&self.states);
        out.extend(self.index.to_le_bytes());
        // The newest index, which nobody reads, and a position of three doubles, which nobody sets.
        out.extend([0; 4 + 24]);
        out
    }

    /// Reads the message; `None` if it is damaged. Memory: at most as many bytes.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let mut reader = Reader::new(bytes);
        let [from, to, owner] = [reader.u32()?, reader.u32()?, reader.u32()?].map(|id| id as i32);
        let count = reader.u32().filter(|count| *count as usize <= CHUNK_VOXELS)?;
        let addresses = (0..count).map(|_| reader.u32()).collect::<Option<Vec<_>>>()?;
        reader.u32().filter(|states| *states == count)?;
        let states = reader.bytes(count as usize)?.to_vec();
        let index = reader.u32().filter(|index| (1..=INDEX_MAX).contains(index))?;
        reader.bytes(4 + 24)?;
        let is_sound = reader.is_empty() && states.iter().all(|state| *state <= 1);
        is_sound.then_some(Self { from, to, owner, index, addresses, states })
    }
}

/// Which chunks a robot holds, of every owner in turn: 16 bytes, and 4 + 4 m for each owner, where m is twice
/// the number of intervals.
#[derive(Clone, PartialEq, Debug)]
pub struct ChunkStamps {
    /// Who holds them.
    pub from: i32,
    /// The set of indices of owner 1, 2, 3 …
    pub held: Vec<IntervalSet>,
    /// When, in seconds of the sender's clock.
    pub time_s: f64,
}

impl ChunkStamps {
    /// The message.
    pub fn emit(&self) -> Vec<u8> {
        let mut out = Vec::new();
        out.extend(self.from.to_le_bytes());
        out.extend((self.held.len() as u32).to_le_bytes());
        for held in &self.held {
            out.extend((held.intervals().len() as u32 * 2).to_le_bytes());
            for (low, high) in held.intervals() {
                out.extend(low.to_le_bytes());
                out.extend(high.to_le_bytes());
            }
        }
        out.extend(self.time_s.to_le_bytes());
        out
    }

    /// Reads the message; `None` if it is damaged. Memory: at most six times as many bytes.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let mut reader = Reader::new(bytes);
        let from = reader.u32()? as i32;
        let owners = reader.u32().filter(|owners| *owners as usize <= bytes.len() / 4)?;
        let mut held = Vec::with_capacity(owners as usize);
        for _ in 0..owners {
            let bounds =
                reader.u32().filter(|bounds| bounds % 2 == 0 && *bounds as usize <= bytes.len() / 4)?;
            let intervals = (0..bounds / 2).map(|_| {
                let (low, high) = (reader.u32()?, reader.u32()?);
                (0 < low && low <= high && high <= INDEX_MAX).then_some((low, high))
            });
            held.push(IntervalSet::from_intervals(0, intervals.collect::<Option<_>>()?));
        }
        let time_s = f64::from_le_bytes(reader.array()?);
        reader.is_empty().then_some(Self { from, held, time_s })
    }
}
