//! The two messages and their ROS 1 serialisation: little-endian, a list begins with its length as `u32`.

use anyhow::{Error, Result, anyhow};
use flockmap::sync::IntervalSet;

use super::config::CHUNK_VOXELS;
use crate::baselines::bytes::Reader;

const NAME: &str = "racer-code";
/// The rule that a message cut short breaks.
const BYTES: &str = "the bytes that it announces";

/// Which message a datagram is. In ROS a topic has a connection of its own, so this takes no bytes in the message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Topic {
    /// [`ChunkStamps`].
    Stamps,
    /// [`ChunkData`].
    Chunk,
}

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

    /// Reads the message. Memory: at most as many bytes.
    ///
    /// # Errors
    /// Names the rule that is broken.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let mut reader = Reader::new(NAME, bytes);
        let (from, to, owner) = (reader.i32(BYTES)?, reader.i32(BYTES)?, reader.i32(BYTES)?);
        let count = reader.u32(BYTES)? as usize;
        if count > CHUNK_VOXELS {
            return Err(broken("at most 200 voxels in a chunk"));
        }
        let addresses = (0..count).map(|_| reader.u32(BYTES)).collect::<Result<Vec<_>, _>>()?;
        if reader.u32(BYTES)? as usize != count {
            return Err(broken("as many states as addresses"));
        }
        let states = reader.take(count, BYTES)?.to_vec();
        if states.iter().any(|state| *state > 1) {
            return Err(broken("states of 0 or 1"));
        }
        let index = reader.u32(BYTES)?;
        if index == 0 || index > i32::MAX as u32 {
            return Err(broken("an index of 1 to 2³¹ − 1"));
        }
        reader.take(4 + 24, BYTES)?;
        end(&reader)?;
        Ok(Self { from, to, owner, index, addresses, states })
    }
}

/// Which chunks a robot holds, of every owner in turn: 16 bytes, and 4 + 4 m for each owner, where m is twice the number of
/// intervals.
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

    /// Reads the message. Memory: at most six times as many bytes.
    ///
    /// # Errors
    /// Names the rule that is broken.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let mut reader = Reader::new(NAME, bytes);
        let from = reader.i32(BYTES)?;
        let owners = reader.u32(BYTES)? as usize;
        if owners > bytes.len() / 4 {
            return Err(broken("no more lists than bytes"));
        }
        let mut held = Vec::with_capacity(owners);
        for _ in 0..owners {
            let bounds = reader.u32(BYTES)? as usize;
            if bounds % 2 == 1 || bounds > bytes.len() / 4 {
                return Err(broken("two bounds for each interval"));
            }
            let mut intervals = Vec::with_capacity(bounds / 2);
            for _ in 0..bounds / 2 {
                let (low, high) = (reader.u32(BYTES)?, reader.u32(BYTES)?);
                if low == 0 || low > high || high > i32::MAX as u32 {
                    return Err(broken("intervals of indices from 1 to 2³¹ − 1"));
                }
                intervals.push((low, high));
            }
            held.push(IntervalSet::from_intervals(0, intervals));
        }
        let time_s = reader.f64(BYTES)?;
        end(&reader)?;
        Ok(Self { from, held, time_s })
    }
}

pub(super) fn broken(rule: &str) -> Error {
    anyhow!("damaged message of {NAME}: expected {rule}")
}

/// Nothing may stand after the message.
fn end(reader: &Reader<'_>) -> Result<()> {
    if reader.is_empty() { Ok(()) } else { Err(broken("nothing after the message")) }
}
