//! A snapshot as its own history: part by part in the order of their stamps, each coded as a batch against the
//! older ones.
//!
//! So the stamps cost next to nothing, and what a later batch left of an earlier one is coded where that batch
//! coded it. A chunk holds sections, each a part or a piece of one. Who has read the chunks before knows what
//! the next one is coded against. A chunk without sections says that nothing is known.
//!
//! A section: the stamp, a varint, as the difference to the section before (the first: to the start in the
//! header); the box in blocks, three varints for its lowest block as the difference to that of the chunk,
//! three for its size less one; the length of the rest, a varint; the rest, as in a package of changes.

use flockmap_grid::{
    BlockIndex, Changes, Layer, Snapshot, SnapshotVoxels, Stamp, StateBlock, VoxelBox, meet,
};
use rustc_hash::FxHashMap;

use super::adaptive_state::CarriedState;
use super::block_box::{BLOCK_UNITS, BOX_BLOCKS_MAX, BlockBox};
use super::habits::Habits;
use super::head::{Head, as_sent};
use super::known::Known;
use super::order;
use super::section::{self, Section, Workspace};
use super::tables::TableSet;
use crate::bytes::put_varint;
use crate::check;
use crate::codec::Codec;
use crate::draft::ChunkDraft;
use crate::error::{EncodeError, PackageError};
use crate::fields::Fields;
use crate::work::{self, Work};

/// The changes of a stamp, by stamp.
type Parts = Vec<(Stamp, Changes)>;
/// From where the changes of a stamp were seen.
type Sensors = Vec<(Stamp, [i32; 3])>;

/// Room that is not worth beginning a section in.
const SECTION_BYTES_MIN: usize = 100;

/// What the head of a section takes at most: stamp, corner, size, length.
const SECTION_HEAD_MAX: usize = 10 + 3 * 5 + 3 * 5 + 3;

/// Codes the parts of a state, some at a time.
pub(crate) struct SnapshotWriter {
    /// What all parts before this one say.
    coded: FxHashMap<BlockIndex, StateBlock>,
    habits: Habits,
    /// A chunk can grow to this as sections are added, and its header with it.
    largest: BlockBox,
    part: Option<Part>,
    /// The stamp of the part that was begun last.
    begun: Option<Stamp>,
    chunk: Chunk,
    /// A chunk may be closed for want of room.
    is_begun: bool,
    done: Vec<ChunkDraft>,
}

/// The part that is being coded.
struct Part {
    stamp: Stamp,
    sensor: [i32; 3],
    /// In order.
    blocks: Vec<(BlockIndex, StateBlock)>,
    /// So many of them are in sections.
    next: usize,
}

impl SnapshotWriter {
    pub(crate) fn new(state: &SnapshotVoxels) -> Self {
        let mut coded = FxHashMap::default();
        coded.reserve(state.block_count());
        Self {
            coded,
            habits: Habits::of_snapshot(&[TableSet::Dense, TableSet::Sparse]),
            largest: BlockBox::around(&state.region()),
            part: None,
            begun: None,
            chunk: Chunk::default(),
            is_begun: false,
            done: Vec::new(),
        }
    }

    /// Goes on until it has taken so many steps, or a section or the beginning of a part more. `room` says how many
    /// bytes the payload of a chunk may have that spans a box and some stamps; a chunk of a single block may be
    /// longer. `seen` is called with each part before it is coded. Returns the steps taken; 0: all is coded.
    pub(crate) fn step(
        &mut self,
        workspace: &mut Workspace,
        state: &SnapshotVoxels,
        room: impl Fn(&VoxelBox, [Stamp; 2]) -> usize,
        mut seen: impl FnMut(Stamp, &Changes),
        steps_max: u64,
    ) -> Result<u64, EncodeError> {
        let mut steps = 0;
        while steps < steps_max {
            let Some(mut part) = self.part.take() else {
                let Some((stamp, changes)) = state.part_after(self.begun) else { break };
                self.begun = Some(stamp);
                seen(stamp, &changes);
                let at = state.sensors().binary_search_by_key(&stamp, |(stamp, _)| *stamp).ok();
                let sensor = at.and_then(|at| state.sensors().get(at));
                let sensor = as_sent(sensor.map_or_else(|| middle(&changes), |(_, at)| *at));
                let blocks = order::in_order(&changes, sensor).into_iter().copied().collect();
                steps += work::PART_BLOCK_STEPS * changes.blocks().len() as u64;
                self.part = Some(Part { stamp, sensor, blocks, next: 0 });
                continue;
            };
            steps += self.code(workspace, &mut part, &room, steps_max - steps)?;
            if part.next < part.blocks.len() {
                self.part = Some(part);
            } else {
                let blocks = part.blocks.iter();
                blocks.for_each(|(index, block)| self.coded.entry(*index).or_default().overlay(block));
            }
        }
        Ok(steps)
    }

    /// Codes sections of a part, at least one, until it has taken so many steps.
    fn code(
        &mut self,
        workspace: &mut Workspace,
        part: &mut Part,
        room: impl Fn(&VoxelBox, [Stamp; 2]) -> usize,
        steps_max: u64,
    ) -> Result<u64, EncodeError> {
        let Self { coded, habits, largest, chunk, is_begun, done, .. } = self;
        let (stamp, sensor, largest) = (part.stamp, part.sensor, *largest);
        let left_in = |chunk: &Chunk| {
            let first = chunk.sections.first().map_or(stamp, |section| section.stamp);
            let room = largest.voxels().map_or(0, |region| room(&region, [first, stamp]));
            // Corners are the longer the larger the chunk.
            room.saturating_sub(chunk.payload(largest).len() + SECTION_HEAD_MAX)
        };
        let known = Known::of_states(coded);
        let blocks: Vec<_> = part.blocks.iter().skip(part.next).collect();
        let mut rest = blocks.as_slice();
        let mut steps = 0;
        while !rest.is_empty() && steps < steps_max {
            let mut left = left_in(chunk);
            // Where chunks are this small, one that was begun for want of room may be left empty: bytes that
            // stay as they are.
            if left < SECTION_BYTES_MIN && *is_begun {
                done.push(core::mem::take(chunk).draft(largest)?);
                left = left_in(chunk);
            }
            *is_begun = true;
            let section = section::encode(workspace, &known, habits, sensor, rest, chunk.spare(), |_| left);
            // Parts come in the order of their stamps, so that nothing in `coded` is as new.
            let Ok((section, count)) = section else {
                unreachable!("what is known before a part is never gone")
            };
            steps += section.tried;
            let blocks = chunk.blocks() + BlockBox::around(&section.region).volume();
            if !chunk.sections.is_empty() && (section.payload.len() > left || blocks > BOX_BLOCKS_MAX) {
                // Not even one block goes in any more, or no box as large as this.
                done.push(core::mem::take(chunk).draft(largest)?);
                continue;
            }
            rest = rest.get(count..).unwrap_or_default();
            habits.accept(section.set);
            chunk.add(stamp, sensor, section);
        }
        part.next = part.blocks.len() - rest.len();
        Ok(steps)
    }

    /// Bytes of the chunks so far. O(chunks).
    pub(crate) fn bytes(&self) -> usize {
        self.done.iter().map(|chunk| chunk.payload.len()).sum()
    }

    /// All chunks, at least one; after all is coded.
    pub(crate) fn finish(mut self) -> Result<Vec<ChunkDraft>, EncodeError> {
        if !self.chunk.sections.is_empty() || self.done.is_empty() {
            self.done.push(self.chunk.draft(self.largest)?);
        }
        Ok(self.done)
    }
}

/// The middle of some changes, in sixteenths of a voxel.
fn middle(changes: &Changes) -> [i32; 3] {
    let count = changes.blocks().len().max(1) as i64;
    let sum = changes.blocks().iter().fold([0i64; 3], |sum, (block, _)| {
        [sum[0] + i64::from(block.x), sum[1] + i64::from(block.y), sum[2] + i64::from(block.z)]
    });
    let middle = sum.map(|sum| sum * BLOCK_UNITS / count + BLOCK_UNITS / 2);
    middle.map(|at| at.clamp(i64::from(i32::MIN), i64::from(i32::MAX)) as i32)
}

/// A chunk that is being filled.
#[derive(Default)]
struct Chunk {
    sections: Vec<Stamped>,
    /// What the sections say.
    parts: Parts,
    sensors: Sensors,
    /// What it takes to decode the sections.
    steps: u64,
}

/// A section in its box.
struct Stamped {
    stamp: Stamp,
    region: BlockBox,
    payload: Vec<u8>,
}

impl Chunk {
    /// Blocks in the boxes of its sections, counted together: what it takes to read it goes with them.
    fn blocks(&self) -> u128 {
        self.sections.iter().map(|section| section.region.volume()).sum()
    }

    /// Steps of work that the sections so far leave of those that the chunk may ask for.
    fn spare(&self) -> u64 {
        let bytes: usize = self.sections.iter().map(|section| section.payload.len()).sum();
        work::limit(bytes).saturating_sub(self.steps)
    }

    fn add(&mut self, stamp: Stamp, sensor: [i32; 3], section: Section) {
        add_sensor(&mut self.sensors, stamp, sensor);
        let Section { changes, region, payload, steps, .. } = section;
        self.steps += steps;
        self.sections.push(Stamped { stamp, region: BlockBox::around(&region), payload });
        match self.parts.last_mut() {
            Some((last, part)) if *last == stamp => {
                *part = Changes::from_blocks([part.blocks(), changes.blocks()].concat());
            }
            _ => self.parts.push((stamp, changes)),
        }
    }

    /// The payload of a chunk with this box.
    fn payload(&self, region: BlockBox) -> Vec<u8> {
        let mut payload = Vec::new();
        let mut before = self.sections.first().map_or(Stamp(0), |section| section.stamp);
        for Stamped { stamp, region: section, payload: rest } in &self.sections {
            put_varint(&mut payload, stamp.0.wrapping_sub(before.0) as u64);
            before = *stamp;
            for (at, of_chunk) in section.min.into_iter().zip(region.min) {
                put_varint(&mut payload, i64::from(at).abs_diff(i64::from(of_chunk)));
            }
            for side in section.size() {
                put_varint(&mut payload, side - 1);
            }
            put_varint(&mut payload, rest.len() as u64);
            payload.extend_from_slice(rest);
        }
        payload
    }

    /// The whole chunk. Its box is that of its sections; `largest` without any.
    fn draft(self, largest: BlockBox) -> Result<ChunkDraft, EncodeError> {
        let region = self.sections.iter().map(|section| section.region).reduce(BlockBox::union);
        let region = region.unwrap_or(largest);
        let ends = [self.sections.first(), self.sections.last()];
        Ok(ChunkDraft {
            region: region.voxels().ok_or(EncodeError::OutsideGrid)?,
            ends: ends.map(|section| section.map_or(Stamp(0), |section| section.stamp)),
            payload: self.payload(region),
            content: check::of_chunk(&self.parts, &self.sensors),
        })
    }
}

/// Adds the sensor of a part, if it is not there yet.
fn add_sensor(sensors: &mut Sensors, stamp: Stamp, sensor: [i32; 3]) {
    if sensors.last().is_none_or(|(last, _)| *last != stamp) {
        sensors.push((stamp, sensor));
    }
}

/// What a chunk says; `coded` is what the chunks before it said, `carried` what its first section begins with, and
/// afterwards the same for the next chunk. After an error they are of no use.
pub(crate) fn decode_chunk(
    workspace: &mut Option<Box<Workspace>>,
    (coded, carried): (&mut Layer, &mut CarriedState),
    payload: &[u8],
    region: &VoxelBox,
    [first, last]: [Stamp; 2],
    work: &mut Work,
) -> Result<Snapshot, PackageError> {
    let wrong = |rule| PackageError::Payload { codec: Codec::Flock, rule };
    let blocks = BlockBox::of_voxels(region).ok_or_else(|| wrong("the box is made of whole blocks"))?;
    let (mut parts, mut sensors) = (Vec::<(Stamp, Vec<(BlockIndex, StateBlock)>)>::new(), Sensors::new());
    let mut stamp = first;
    let mut blocks_left = BOX_BLOCKS_MAX;
    let mut rest = payload;
    while !rest.is_empty() {
        let mut fields = Fields::new(rest);
        let later = fields.number("difference of stamps", u64::MAX)?;
        let next = stamp.0.checked_add_unsigned(later).map(Stamp).filter(|stamp| *stamp <= last);
        stamp = next.ok_or_else(|| wrong("stamps ascend to the newest in the header"))?;
        let section = read_box(&mut fields, &blocks)?;
        let length = fields.number("section length", u64::MAX)?;
        let split = usize::try_from(length).ok().and_then(|length| fields.rest().split_at_checked(length));
        let (body, after) = split.ok_or_else(|| wrong("a section ends within its chunk"))?;
        rest = after;
        blocks_left = blocks_left
            .checked_sub(section.volume())
            .ok_or_else(|| wrong("the boxes of its sections have at most 2¹⁸ blocks together"))?;
        section.voxels().ok_or_else(|| wrong("a section lies in the grid"))?;
        let known = Known::new(Some(coded), stamp);
        let changes =
            section::decode(workspace.get_or_insert_default(), &known, Some(carried), body, section, work)?;
        let is_known = |(at, block): &(BlockIndex, StateBlock)| {
            coded.block(*at).is_some_and(|known| meet(&block.known(), &known.known()))
        };
        if changes.blocks().iter().any(is_known) {
            return Err(wrong("every voxel has one stamp"));
        }
        coded.apply(&changes, stamp);
        add_sensor(&mut sensors, stamp, Head::read(&section, &mut Fields::new(body))?.sensor);
        match parts.last_mut() {
            Some((last, part)) if *last == stamp => part.extend_from_slice(changes.blocks()),
            // Bytes can be made that say nothing; a part is never empty.
            _ if changes.is_empty() => {}
            _ => parts.push((stamp, changes.blocks().to_vec())),
        }
    }
    let parts = parts.into_iter().map(|(stamp, part)| (stamp, Changes::from_blocks(part))).collect();
    Ok(Snapshot { region: *region, parts, sensors })
}

/// The box of a section in that of its chunk.
fn read_box(fields: &mut Fields<'_>, of_chunk: &BlockBox) -> Result<BlockBox, PackageError> {
    let mut section = *of_chunk;
    for (min, max) in section.min.iter_mut().zip(of_chunk.max) {
        let at = fields.number("section corner", max.abs_diff(*min).into())?;
        *min = (i64::from(*min) + at as i64) as i32;
    }
    for (max, min) in section.max.iter_mut().zip(section.min) {
        let side = fields.number("section size", max.abs_diff(min).into())?;
        *max = (i64::from(min) + side as i64) as i32;
    }
    Ok(section)
}
