//! A package of changes: blocks in order, cut where the package is full.
//!
//! The payload: a varint, the number of blocks of the box before the first that is told of times four, plus the set of tables; the
//! sensor's position, three signed varints, in quarters of a voxel from the middle of the box; a varint, the number of blocks from the
//! first to the last that is told of; the decisions. Blocks are counted in the order of `order.rs`.

use flockmap_grid::{BLOCK_SIDE, BlockIndex, Changes, Overtaken, StateBlock, VOXEL_LIMIT, Voxel, VoxelBox};

use super::block::{self, Distance, TurnedChanges};
use super::cells::{Neighbourhood, Turn};
use super::choice;
use super::coder::{BitReader, BitWriter};
use super::coding::Coding;
use super::decide::Decide;
use super::field::{AHEAD, Field, OWN};
use super::order::{self, BLOCK_UNITS, BlockBox};
use super::tables::{Chances, TableSet};
use crate::reference::Known;
use crate::work::{self, CHANGED_STEPS, TAKEN_IN_STEPS, Work};
use crate::{BOX_VOXELS_MAX, Codec, PackageError, varint};

/// Most blocks in the box of a package.
pub(crate) const BOX_BLOCKS_MAX: u128 = (BOX_VOXELS_MAX / 512) as u128;

/// Zeros at the end of a payload that is short for its work, at most, unless it tells of one block: another package takes no more.
const PADDING_MAX: usize = 40;

/// Memory that is used again from package to package: 550 bytes for each block of the largest package so far and for each known
/// block next to it, and five bytes for each block of its box and round it.
pub(crate) struct Workspace {
    field: Field,
    cells: Neighbourhood,
    chances: Box<Chances>,
    body: Vec<u8>,
    /// By place in the box: 0 not told, 1 no changes, 2 changes.
    told: Vec<u8>,
}

impl Default for Workspace {
    fn default() -> Self {
        Self {
            field: Field::default(),
            cells: Neighbourhood::new(),
            chances: Chances::even(),
            body: Vec::new(),
            told: Vec::new(),
        }
    }
}

/// What became one package.
pub(crate) struct Piece {
    pub(crate) changes: Changes,
    pub(crate) region: VoxelBox,
    pub(crate) payload: Vec<u8>,
    /// What it takes to decode it.
    pub(crate) steps: u64,
}

/// A block with its changes.
pub(crate) type Changed<'a> = &'a (BlockIndex, StateBlock);

/// The blocks of a cycle in the order in which they are told.
pub(crate) fn in_order(changes: &Changes, sensor: [i32; 3]) -> Vec<Changed<'_>> {
    let sensor = order::sensor_block(sensor);
    let mut blocks: Vec<_> = changes.blocks().iter().collect();
    blocks.sort_by_cached_key(|(index, _)| order::key(*index, sensor));
    blocks
}

/// Some of these blocks as changes again.
pub(crate) fn changes_of(blocks: &[Changed<'_>]) -> Changes {
    let mut blocks = blocks.to_vec();
    blocks.sort_unstable_by_key(|(index, _)| *index);
    Changes::from_blocks(blocks.into_iter().copied().collect())
}

/// What the packages of a cycle so far have taught.
pub(crate) struct Habits {
    /// The sets of tables to choose from; one that was chosen.
    sets: Vec<TableSet>,
    /// Bytes for each 1,024 changes.
    rate: usize,
}

impl Habits {
    pub(crate) fn new(sets: &[TableSet]) -> Self {
        Self { sets: sets.to_vec(), rate: 0 }
    }

    /// Chooses tables when it sees the first blocks of a cycle.
    fn tables(
        &mut self,
        Workspace { field, cells, .. }: &mut Workspace,
        known: &Known<'_>,
        sensor: [i32; 3],
        blocks: &[Changed<'_>],
    ) -> Result<TableSet, Overtaken> {
        let set = match *self.sets {
            [set] => set,
            _ => choice::choose(field, cells, known, &self.sets, sensor, blocks)?,
        };
        if self.rate == 0 {
            self.sets = vec![set];
            self.rate = match set {
                TableSet::Dense => 180,
                TableSet::Sparse => 380,
                TableSet::Obstacles => 900,
            };
        }
        Ok(set)
    }

    /// How many blocks from the front are sure to fill so many bytes, if there are as many.
    fn reach(&self, blocks: &[Changed<'_>], room: usize) -> usize {
        let changes = room.saturating_mul(1_024 + 1_024 / 4) / self.rate.max(1);
        let mut left = u32::try_from(changes.max(1)).unwrap_or(u32::MAX);
        let full = blocks.iter().position(|(_, states)| {
            let changes = states.known_count();
            let is_full = changes >= left;
            left = left.saturating_sub(changes);
            is_full
        });
        full.map_or(blocks.len(), |last| last + 1)
    }
}

/// Codes as many blocks from the front of `blocks`, which are [`in_order`], as go into `room` bytes; `room` says how many there are for a
/// payload of a certain box. Returns the number of blocks too. At least one, even if that takes more. `spare` are steps of work that the
/// payload may ask for beside those for its bytes.
pub(crate) fn encode(
    workspace: &mut Workspace,
    known: &Known<'_>,
    habits: &mut Habits,
    sensor: [i32; 3],
    blocks: &[Changed<'_>],
    spare: u64,
    room: impl Fn(&VoxelBox) -> usize,
) -> Result<(Piece, usize), Overtaken> {
    let set = habits.tables(workspace, known, sensor, blocks)?;
    let mut before = 0;
    loop {
        // The box is that of as many blocks as may go in, so that it is known from the start.
        let nearly = boxes(blocks, u64::MAX).next().and_then(|region| region.voxels());
        let nearly = nearly.map_or(0, |region| room(&region));
        // Half of the work is left to what is said of the box.
        let work = work::for_bytes(nearly).saturating_add(spare) / 2;
        let wanted = habits.reach(blocks, nearly).max(2 * before);
        let Some((reach, region)) = boxes(blocks, work).take(wanted).enumerate().last() else {
            unreachable!("a cycle has a block")
        };
        let Some(voxels) = region.voxels() else { unreachable!("blocks lie in the grid") };
        let reach = reach + 1;
        let room = room(&voxels);
        let told = blocks.get(..reach).unwrap_or_default();
        let (payload, count, steps) = write(workspace, known, set, sensor, told, region, spare, room)?;
        let changes = changes_of(&blocks[..count]);
        habits.rate = (payload.len() * 1_024 / changes.len().max(1)).max(1);
        // All went in, and there is room for more: again, with a larger box.
        if count == reach && reach < blocks.len() && reach > before && payload.len() < room - room / 8 {
            before = reach;
            continue;
        }
        return Ok((Piece { changes, region: voxels, payload, steps }, count));
    }
}

/// The boxes of one, two, … blocks from the front, as many as a package may span that asks for no more than this work for its box. One at
/// least.
fn boxes(blocks: &[Changed<'_>], work: u64) -> impl Iterator<Item = BlockBox> {
    let boxes = blocks.iter().scan(None, |region: &mut Option<BlockBox>, (index, _)| {
        *region = Some(region.map_or(BlockBox::of(*index), |region| region.with(*index)));
        *region
    });
    boxes.take_while(move |region| {
        let volume = region.volume();
        volume == 1 || (volume <= BOX_BLOCKS_MAX && work::of_box(region.size()) <= work)
    })
}

/// Writes as many blocks as there is room for, at least one; `region` is the box of all. Returns how many, and the steps for them.
#[expect(clippy::too_many_arguments, reason = "all of a package, from one place")]
fn write(
    workspace: &mut Workspace,
    known: &Known<'_>,
    set: TableSet,
    sensor: [i32; 3],
    blocks: &[Changed<'_>],
    region: BlockBox,
    spare: u64,
    room: usize,
) -> Result<(Vec<u8>, usize, u64), Overtaken> {
    let Workspace { field, cells, chances, body, told, .. } = workspace;
    let sensor_block = order::sensor_block(sensor);
    let first = blocks.first().map(|(index, _)| *index);
    let before = order::blocks(region, sensor_block, 0).take_while(|index| Some(*index) != first).count();

    let mut payload = Vec::with_capacity(1_200);
    Head { set, sensor, before: before as u64 }.write(&region, &mut payload);
    field.clear(region);
    body.clear();
    let mut decisions = Coding::new(set.tables(), chances, BitWriter::new(body));
    let mut flags = Flags::new(region, told);
    let mut left = blocks.iter();
    let mut next = left.next();
    // Blocks told of, and those with changes.
    let (mut length, mut count) = (0u64, 0);
    let (mut seen, mut mark) = (0, decisions.bits.mark());
    let of_box = work::of_box(region.size());
    let (mut steps, mut of_flags) = (of_box, 0);
    for index in order::blocks(region, sensor_block, before as u64) {
        let Some((changed, states)) = next else { break };
        seen += 1;
        let is_changed = *changed == index;
        let (turn, distance) = view(index, sensor);
        let counts = field.classes(known, index)?;
        of_flags += work::of_flag(counts.is_any());
        decisions.flag(flags.context(index, turn, counts), is_changed);
        flags.tell(index, is_changed);
        if !is_changed {
            continue;
        }
        let slots = field.around(known, index, turn)?;
        cells.gather(turn, &slots, field.cells());
        let turns = block::turns(known.block(index)?, states);
        let truth = TurnedChanges::of(states, turn);
        block::code(&mut decisions, cells, distance, counts, &truth, turns);
        field.tell(slots[OWN], index, turn, &truth);
        let bytes = payload.len() + varint::length(seen) + decisions.bits.finished_len();
        let of_blocks = (count as u64 + 1) * CHANGED_STEPS + field.taken_in() * TAKEN_IN_STEPS;
        let all_steps = of_box + of_flags + of_blocks + decisions.steps;
        let padded = work::bytes_for(all_steps, spare);
        if (bytes.max(padded) > room || padded > bytes + PADDING_MAX) && count > 0 {
            decisions.bits.back_to(&mark);
            break;
        }
        (length, count, mark, steps) = (seen, count + 1, decisions.bits.mark(), all_steps);
        next = left.next();
    }
    decisions.bits.finish();
    varint::write(&mut payload, length);
    payload.extend_from_slice(body);
    payload.resize(payload.len().max(work::bytes_for(steps, spare)), 0);
    Ok((payload, count, steps))
}

/// What a payload says; `region` has at most [`BOX_BLOCKS_MAX`] blocks.
pub(crate) fn decode(
    workspace: &mut Workspace,
    known: &Known<'_>,
    payload: &[u8],
    region: BlockBox,
    work: &mut Work,
) -> Result<Changes, PackageError> {
    let wrong = |rule| PackageError::Payload { codec: Codec::Flock, rule };
    let mut reader = varint::Reader::new(payload);
    let Head { set, sensor, before } = Head::read(&region, &mut reader)?;
    let volume = region.volume() as u64;
    let length = reader.number("blocks told of", volume - before)?;
    work.take(work::of_box(region.size()))?;

    let Workspace { field, cells, chances, told, .. } = workspace;
    field.clear(region);
    let mut flags = Flags::new(region, told);
    let mut decisions = Coding::new(set.tables(), chances, BitReader::new(reader.rest()));
    let mut changed = Vec::new();
    // Steps of what was taken in and decided, as far as they have been counted.
    let mut counted = 0;
    let mut blocks = order::blocks(region, order::sensor_block(sensor), before).take(length as usize);
    let mut ahead = Vec::with_capacity(AHEAD);
    let mut next = 0;
    loop {
        if next == ahead.len() {
            field.classes_of(known, blocks.by_ref().take(AHEAD), &mut ahead)?;
            next = 0;
        }
        let Some(&(index, counts)) = ahead.get(next) else { break };
        next += 1;
        let (turn, distance) = view(index, sensor);
        let so_far = field.taken_in() * TAKEN_IN_STEPS + decisions.steps;
        work.take(work::of_flag(counts.is_any()) + so_far - counted)?;
        counted = so_far;
        let is_changed = decisions.flag(flags.context(index, turn, counts), false);
        flags.tell(index, is_changed);
        if !is_changed {
            continue;
        }
        work.take(CHANGED_STEPS)?;
        let slots = field.around(known, index, turn)?;
        cells.gather(turn, &slots, field.cells());
        let told =
            block::code(&mut decisions, cells, distance, counts, &TurnedChanges::default(), [false; 2]);
        changed.push((index, field.tell(slots[OWN], index, turn, &told)));
    }
    work.take(field.taken_in() * TAKEN_IN_STEPS + decisions.steps - counted)?;
    let changes = Changes::from_blocks(changed);
    // At its end the grid cuts a block, and only there can a voxel lie outside.
    let ends_grid = region.max.contains(&(VOXEL_LIMIT / BLOCK_SIDE));
    if ends_grid && !changes.is_empty() && changes.bounding_box().is_none() {
        return Err(wrong("no voxel lies outside of the grid"));
    }
    Ok(changes)
}

/// What a payload begins with.
pub(crate) struct Head {
    set: TableSet,
    /// In sixteenths of a voxel, a [`whole`] number of units.
    pub(crate) sensor: [i32; 3],
    /// Blocks of the box before the first that is told of.
    before: u64,
}

/// Sixteenths of a voxel to which the place of a sensor is told.
const SENSOR_UNIT: i32 = 4;

/// A sensor as it can be told.
pub(crate) fn whole(sensor: [i32; 3]) -> [i32; 3] {
    sensor.map(|at| at & -SENSOR_UNIT)
}

impl Head {
    fn write(&self, region: &BlockBox, out: &mut Vec<u8>) {
        varint::write(out, self.before << 2 | u64::from(self.set.id()));
        for (at, middle) in self.sensor.into_iter().zip(region.middle()) {
            varint::write_signed(out, (i64::from(at) - middle) / i64::from(SENSOR_UNIT));
        }
    }

    /// `region` is the box of the payload.
    pub(crate) fn read(region: &BlockBox, reader: &mut varint::Reader<'_>) -> Result<Self, PackageError> {
        let wrong = |rule| PackageError::Payload { codec: Codec::Flock, rule };
        let volume = region.volume().min(BOX_BLOCKS_MAX) as u64;
        let number = reader.number("tables and blocks before", volume << 2 | 3)?;
        let set = TableSet::from_id((number & 3) as u8).ok_or_else(|| wrong("the tables are known"))?;
        let mut sensor = [0; 3];
        for (at, middle) in sensor.iter_mut().zip(region.middle()) {
            let place = reader.signed("sensor")?.checked_mul(SENSOR_UNIT.into());
            let place =
                place.and_then(|place| place.checked_add(middle)).and_then(|at| i32::try_from(at).ok());
            *at = place.ok_or_else(|| wrong("the sensor is within 2³¹ sixteenths of a voxel"))?;
        }
        Ok(Self { set, sensor, before: number >> 2 })
    }
}

/// How a block is turned, and where the sensor is then.
pub(crate) fn view(block: BlockIndex, sensor: [i32; 3]) -> (Turn, Distance) {
    const FAR: i64 = 1 << 24;
    let middle = [block.x, block.y, block.z].map(|at| i64::from(at) * BLOCK_UNITS + BLOCK_UNITS / 2);
    let offset: [i32; 3] =
        core::array::from_fn(|a| (middle[a] - i64::from(sensor[a])).clamp(-FAR, FAR) as i32);
    let is_up = offset.map(|offset| offset > 0);
    let mut distance = offset.map(i32::abs);
    // The last of the largest, so that all agree.
    let major = if distance[2] >= distance[0].max(distance[1]) {
        2
    } else if distance[1] >= distance[0] {
        1
    } else {
        0
    };
    distance.swap(major, 2);
    (Turn { major, is_up }, distance)
}

/// The flags of the blocks of a box as they are told.
pub(crate) struct Flags<'a> {
    /// The block before the lowest of the box.
    min: [i32; 3],
    /// From one place to the next along each axis; there is one more place than blocks on each side.
    steps: [usize; 3],
    told: &'a mut [u8],
}

impl<'a> Flags<'a> {
    /// `region` has at most [`BOX_BLOCKS_MAX`] blocks.
    pub(crate) fn new(region: BlockBox, told: &'a mut Vec<u8>) -> Self {
        let size = region.size().map(|side| side as usize + 2);
        told.clear();
        told.resize(size.iter().product(), 0);
        let min = region.min.map(|min| min.wrapping_sub(1));
        Self { min, steps: [1, size[0], size[0] * size[1]], told }
    }

    /// Where a block of the box has its place.
    fn place(&self, block: BlockIndex) -> usize {
        let at = [block.x, block.y, block.z];
        (0..3).map(|a| at[a].wrapping_sub(self.min[a]) as u32 as usize * self.steps[a]).sum()
    }

    /// The context of the flag of a block of the box.
    pub(crate) fn context(&self, block: BlockIndex, turn: Turn, counts: block::KnownClasses) -> usize {
        let place = self.place(block);
        let [x, y, z]: [usize; 3] =
            core::array::from_fn(
                |a| {
                    if turn.is_up[a] { self.steps[a] } else { self.steps[a].wrapping_neg() }
                },
            );
        let beyond = |step: usize| self.told.get(place.wrapping_add(step)).copied().unwrap_or(0);
        let [xy, xz, yz] = [x.wrapping_add(y), x.wrapping_add(z), y.wrapping_add(z)];
        block::block_flag(
            [beyond(x), beyond(y), beyond(z)],
            [beyond(xy), beyond(xz), beyond(yz), beyond(xy.wrapping_add(z))],
            counts,
        )
    }

    pub(crate) fn tell(&mut self, block: BlockIndex, is_changed: bool) {
        let place = self.place(block);
        if let Some(told) = self.told.get_mut(place) {
            *told = 1 + u8::from(is_changed);
        }
    }
}

impl BlockBox {
    /// The same box in voxels, `None` beyond the limits of the grid.
    pub(crate) fn voxels(&self) -> Option<VoxelBox> {
        let corner = |at: [i32; 3]| BlockIndex::new(at[0], at[1], at[2]).corner();
        // At its end the grid cuts a block.
        let max = corner(self.max);
        let [x, y, z] = [max.x, max.y, max.z].map(|last| last.saturating_add(7).min(VOXEL_LIMIT));
        VoxelBox::spanning(corner(self.min), Voxel::new(x, y, z))
    }

    /// The blocks that a box touches.
    pub(crate) fn around(region: &VoxelBox) -> Self {
        let [low, high] = [region.min().block(), region.max().block()];
        Self { min: [low.x, low.y, low.z], max: [high.x, high.y, high.z] }
    }

    /// The blocks that a box is made of, `None` if it cuts one.
    pub(crate) fn of_voxels(region: &VoxelBox) -> Option<Self> {
        let of = Self::around(region);
        (of.voxels()? == *region).then_some(of)
    }
}
