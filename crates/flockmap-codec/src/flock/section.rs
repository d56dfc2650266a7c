//! A section: blocks in order, cut where there is no more room. The payload of a package of changes is one; a
//! chunk of a snapshot has one for each of its stamps.
//!
//! The payload: a varint, the number of blocks of the box before the first that is coded times five, plus
//! the set of tables; the sensor's position, three signed varints, in whole voxels from the middle of
//! the box; a varint, the number of blocks from the first to the last that is coded; the decisions. Blocks
//! are counted in the order of `order.rs`.

use flockmap_grid::{BLOCK_SIDE, BaseSuperseded, Changes, VOXEL_LIMIT, VoxelBox};

use super::adaptive_state::{AdaptiveState, CarriedState, Carry};
use super::block_box::{BOX_BLOCKS_MAX, BlockBox};
use super::coding::Coding;
use super::decide::Decide;
use super::field::AHEAD;
use super::flags::Flags;
use super::habits::Habits;
use super::head::Head;
use super::known::Known;
use super::model::Model;
use super::order::{self, Changed};
use super::orientation::Orientation;
use super::tables::TableSet;
use crate::bytes::{put_varint, varint_len};
use crate::codec::Codec;
use crate::error::PackageError;
use crate::fields::Fields;
use crate::work::{self, CARRY_STEPS, CHANGED_STEPS, TAKEN_IN_STEPS, Work};
use flockmap_coder::{BitReader, BitWriter};

/// Zeros at the end of a payload that is short for its work, at most, unless it has one block: another
/// package takes no more.
const PADDING_MAX: usize = 40;

/// More than most blocks take: with less room than this a section may be full with the next one.
const BLOCK_BYTES: usize = 30;

/// Memory that is used again from package to package: 550 bytes for each block of the largest package so far
/// and for each known block next to it, and five bytes for each block of its box and round it.
#[derive(Default)]
pub(crate) struct Workspace {
    model: Model,
    state: Box<AdaptiveState>,
    body: Vec<u8>,
    /// Of each block of the box, whether it is coded and changed.
    coded: Vec<u8>,
}

/// What became one section.
pub(crate) struct Section {
    pub(crate) set: TableSet,
    pub(crate) changes: Changes,
    pub(crate) region: VoxelBox,
    pub(crate) payload: Vec<u8>,
    /// What it takes to decode it.
    pub(crate) steps: u64,
    /// The same of all that was tried before it was this.
    pub(crate) tried: u64,
}

/// Codes as many blocks from the front of `blocks`, which are in order, as go into `room` bytes; `room` says
/// how many there are for a payload of a certain box. Returns the number of blocks too. At least one, even if
/// that takes more. `spare` are steps of work that the payload may ask for beside those for its bytes.
pub(crate) fn encode(
    workspace: &mut Workspace,
    known: &Known<'_>,
    habits: &mut Habits,
    sensor: [i32; 3],
    blocks: &[Changed<'_>],
    spare: u64,
    room: impl Fn(&VoxelBox) -> usize,
) -> Result<(Section, usize), BaseSuperseded> {
    let set = habits.tables(&mut workspace.model, known, sensor, blocks)?;
    let (mut before, mut tried) = (0, 0);
    loop {
        // The box is that of as many blocks as may go in, so that it is known from the start.
        let nearly = boxes(blocks, u64::MAX).next().and_then(|region| region.voxels());
        let nearly = nearly.map_or(0, |region| room(&region));
        // Half of the work is left to what is said of the box.
        let work = work::for_bytes(nearly).saturating_add(spare) / 2;
        let wanted = habits.reach(blocks, nearly).max(2 * before);
        let Some((reach, region)) = boxes(blocks, work).take(wanted).enumerate().last() else {
            unreachable!("a batch has a block")
        };
        let Some(voxels) = region.voxels() else { unreachable!("blocks lie in the grid") };
        let reach = reach + 1;
        let room = room(&voxels);
        let coded = blocks.get(..reach).unwrap_or_default();
        let (payload, count, steps) =
            write(workspace, known, set, habits.carry.as_mut(), sensor, coded, region, spare, room)?;
        tried += steps;
        let changes = order::changes_of(&blocks[..count]);
        habits.learn(payload.len(), changes.len());
        // All went in, and there is room for more: again, with a larger box.
        if count == reach && reach < blocks.len() && reach > before && payload.len() < room - room / 8 {
            before = reach;
            continue;
        }
        return Ok((Section { set, changes, region: voxels, payload, steps, tried }, count));
    }
}

/// The boxes of one, two, … blocks from the front, as many as a package may span that asks for no more than
/// this work for its box. One at least.
fn boxes(blocks: &[Changed<'_>], work: u64) -> impl Iterator<Item = BlockBox> {
    let boxes = blocks.iter().scan(None, |region: &mut Option<BlockBox>, (index, _)| {
        *region = Some(region.map_or(BlockBox::of(*index), |region| region.union(BlockBox::of(*index))));
        *region
    });
    boxes.take_while(move |region| {
        let volume = region.volume();
        volume == 1 || (volume <= BOX_BLOCKS_MAX && work::of_box(region.size()) <= work)
    })
}

/// Writes as many blocks as there is room for, at least one; `region` is the box of all. Returns how many,
/// and the steps for them.
#[expect(clippy::too_many_arguments, reason = "all of a package, from one place")]
fn write(
    workspace: &mut Workspace,
    known: &Known<'_>,
    set: TableSet,
    mut carry: Option<&mut Carry>,
    sensor: [i32; 3],
    blocks: &[Changed<'_>],
    region: BlockBox,
    spare: u64,
    room: usize,
) -> Result<(Vec<u8>, usize, u64), BaseSuperseded> {
    let Workspace { model, state, body, coded } = workspace;
    let sensor_block = order::sensor_block(sensor);
    let first = blocks.first().map(|(index, _)| *index);
    let before = order::blocks(region, sensor_block, 0).take_while(|index| Some(*index) != first).count();

    let mut payload = Vec::with_capacity(1_200);
    Head { set, sensor, before: before as u64 }.write(&region, &mut payload);
    model.field.clear(region);
    body.clear();
    state.begin(set, carry.as_ref().map(|carry| &carry.state));
    let mut decisions = Coding::new(set.tables(), state, BitWriter::new(body));
    let mut flags = Flags::new(region, coded);
    let mut left = blocks.iter();
    let mut next = left.next();
    // After how many blocks `at_end` was kept.
    let mut kept = 0;
    // Coded blocks, and those with changes.
    let (mut length, mut count) = (0u64, 0);
    let (mut seen, mut mark) = (0, decisions.bits.mark());
    let of_box = work::of_box(region.size()) + if carry.is_some() { CARRY_STEPS } else { 0 };
    let (mut steps, mut of_flags) = (of_box, 0);
    for index in order::blocks(region, sensor_block, before as u64) {
        let Some((changed, states)) = next else { break };
        seen += 1;
        let is_changed = *changed == index;
        let view = Orientation::of(index, sensor);
        let classes = model.field.classes(known, index)?;
        of_flags += work::of_flag(classes.is_any());
        decisions.flag(flags.context(index, view.0, classes), is_changed);
        flags.note(index, is_changed);
        if !is_changed {
            continue;
        }
        model.code(&mut decisions, known, index, view, classes, Some(states))?;
        let bytes = payload.len() + varint_len(seen) + decisions.bits.finished_len();
        let of_blocks = (count as u64 + 1) * CHANGED_STEPS + model.field.taken_in() * TAKEN_IN_STEPS;
        let all_steps = of_box + of_flags + of_blocks + decisions.steps;
        let padded = work::bytes_for(all_steps, spare);
        if (bytes.max(padded) > room || padded > bytes + PADDING_MAX) && count > 0 {
            if carry.is_some() && kept != count {
                // The state after the last block that goes in was not kept: again, without the one after it.
                let blocks = blocks.get(..count).unwrap_or_default();
                return write(workspace, known, set, carry, sensor, blocks, region, spare, room);
            }
            decisions.bits.back_to(&mark);
            break;
        }
        (length, count, mark, steps) = (seen, count + 1, decisions.bits.mark(), all_steps);
        next = left.next();
        if let Some(carry) = &mut carry
            && (next.is_none() || bytes + BLOCK_BYTES > room)
        {
            carry.at_end.copy_from(decisions.state);
            kept = count;
        }
    }
    decisions.bits.finish();
    put_varint(&mut payload, length);
    payload.extend_from_slice(body);
    payload.resize(payload.len().max(work::bytes_for(steps, spare)), 0);
    Ok((payload, count, steps))
}

/// What a payload says; `region` has at most [`BOX_BLOCKS_MAX`] blocks. `carried` is what a section of a snapshot
/// begins with, and afterwards the same for the next.
pub(crate) fn decode(
    workspace: &mut Workspace,
    known: &Known<'_>,
    carried: Option<&mut CarriedState>,
    payload: &[u8],
    region: BlockBox,
    work: &mut Work,
) -> Result<Changes, PackageError> {
    let wrong = |rule| PackageError::Payload { codec: Codec::Flock, rule };
    let mut reader = Fields::new(payload);
    let Head { set, sensor, before } = Head::read(&region, &mut reader)?;
    let volume = region.volume() as u64;
    let length = reader.number("coded blocks", volume - before)?;
    work.take(work::of_box(region.size()) + if carried.is_some() { CARRY_STEPS } else { 0 })?;

    let Workspace { model, state, coded, .. } = workspace;
    model.field.clear(region);
    let mut flags = Flags::new(region, coded);
    state.begin(set, carried.as_deref());
    let mut decisions = Coding::new(set.tables(), state, BitReader::new(reader.rest()));
    let mut changed = Vec::new();
    // Steps of what was taken in and decided, as far as they have been counted.
    let mut counted = 0;
    let mut blocks = order::blocks(region, order::sensor_block(sensor), before).take(length as usize);
    let mut ahead = Vec::with_capacity(AHEAD);
    let mut next = 0;
    loop {
        if next == ahead.len() {
            model.field.classes_of(known, blocks.by_ref().take(AHEAD), &mut ahead)?;
            next = 0;
        }
        let Some(&(index, classes)) = ahead.get(next) else { break };
        next += 1;
        let view = Orientation::of(index, sensor);
        let so_far = model.field.taken_in() * TAKEN_IN_STEPS + decisions.steps;
        work.take(work::of_flag(classes.is_any()) + so_far - counted)?;
        counted = so_far;
        let is_changed = decisions.flag(flags.context(index, view.0, classes), false);
        flags.note(index, is_changed);
        if !is_changed {
            continue;
        }
        work.take(CHANGED_STEPS)?;
        changed.push((index, model.code(&mut decisions, known, index, view, classes, None)?));
    }
    work.take(model.field.taken_in() * TAKEN_IN_STEPS + decisions.steps - counted)?;
    if let Some(carried) = carried {
        carried.note(set, decisions.state);
    }
    let changes = Changes::from_blocks(changed);
    // At its end the grid cuts a block, and only there can a voxel lie outside.
    let ends_grid = region.max.contains(&(VOXEL_LIMIT / BLOCK_SIDE));
    if ends_grid && !changes.is_empty() && changes.bounding_box().is_none() {
        return Err(wrong("no voxel lies outside of the grid"));
    }
    Ok(changes)
}
