//! A present state as its own history: part by part in the order of their stamps, each told as a cycle against the older ones.
//!
//! So the stamps cost next to nothing, and what a later cycle left of an earlier one is told where that cycle told it. A tile holds
//! sections, each a part or a piece of one. Who has read the tiles before knows what the next one is told against. A tile without
//! sections says that nothing is known.
//!
//! A section: the stamp, a varint, as the difference to the section before (the first: to the start in the header); the box in
//! blocks, three varints for its lowest block as the difference to that of the tile, three for its size less one; the length of
//! the rest, a varint; the rest, as in a package of changes.

use crc32fast::Hasher;
use flockmap_grid::{BlockIndex, Changes, Layer, PresentState, PresentVoxels, Stamp, StateBlock, VoxelBox};
use rustc_hash::FxHashMap;

use super::order::BlockBox;
use super::package::{self, Habits, Workspace};
use super::tables::TableSet;
use crate::check::hash_present;
use crate::reference::Known;
use crate::varint::{self, Reader};
use crate::work::{self, Work};
use crate::{Codec, PackageError};

/// A tile that is being filled or is full.
pub(crate) struct Tile {
    sections: Vec<Section>,
    pub(crate) region: BlockBox,
    /// Oldest and newest stamp. Zero without sections.
    pub(crate) ends: [Stamp; 2],
    /// What the sections say, until the tile is full.
    parts: Vec<(Stamp, Changes)>,
    /// What it takes to decode the sections.
    steps: u64,
    /// Of each part, as the sections tell it.
    sensors: Vec<(Stamp, [i32; 3])>,
    /// For the check, once the tile is full.
    pub(crate) content: Hasher,
}

struct Section {
    stamp: Stamp,
    region: BlockBox,
    payload: Vec<u8>,
}

/// Room that is not worth beginning a section in.
const SECTION_BYTES_MIN: usize = 100;

/// Codes the parts of a present state. `room` says how many bytes the payload of a tile may have that spans a box and some stamps. A tile
/// of a single block may be longer.
pub(crate) fn encode(
    workspace: &mut Workspace,
    state: &PresentVoxels,
    room: impl Fn(&VoxelBox, [Stamp; 2]) -> usize,
) -> Vec<Tile> {
    let mut told = FxHashMap::<BlockIndex, StateBlock>::default();
    told.reserve(state.block_count());
    let mut tiles: Vec<Tile> = Vec::new();
    let mut habits = Habits::new(&[TableSet::Dense, TableSet::Sparse]);
    // A tile can grow to this as sections are added, and its header with it.
    let largest = BlockBox::around(&state.region());
    let left_in = |tile: &Tile, stamp: Stamp| {
        let first = if tile.sections.is_empty() { stamp } else { tile.ends[0] };
        let room = largest.voxels().map_or(0, |region| room(&region, [first, stamp]));
        // Corners are the longer the larger the tile.
        room.saturating_sub(tile.payload_in(&largest).len() + SECTION_HEAD_MAX)
    };
    let begin = |tiles: &mut Vec<Tile>| {
        if let Some(full) = tiles.last_mut() {
            full.close();
        }
        tiles.push(Tile {
            sections: Vec::new(),
            region: largest,
            ends: [Stamp(0); 2],
            parts: Vec::new(),
            steps: 0,
            sensors: Vec::new(),
            content: Hasher::new(),
        });
    };
    for (stamp, part) in state.parts() {
        let sensors = state.sensors();
        let at = sensors.binary_search_by_key(&stamp, |(stamp, _)| *stamp).ok();
        let sensor = at.and_then(|at| sensors.get(at)).map_or_else(|| middle(&part), |(_, sensor)| *sensor);
        let sensor = package::whole(sensor);
        let known = Known::of_states(&told);
        let blocks = package::in_order(&part, sensor);
        let mut rest = blocks.as_slice();
        while !rest.is_empty() {
            let last = tiles.last().map(|tile| (left_in(tile, stamp), tile.sections.is_empty()));
            let (left, is_empty) = match last.filter(|(left, _)| *left >= SECTION_BYTES_MIN) {
                Some(last) => last,
                None => {
                    begin(&mut tiles);
                    (tiles.last().map_or(0, |tile| left_in(tile, stamp)), true)
                }
            };
            let spare = tiles.last().map_or(0, Tile::spare);
            let coded = package::encode(workspace, &known, &mut habits, sensor, rest, spare, |_| left);
            // Parts come in the order of their stamps, so that nothing in `told` is as new.
            let Ok((piece, count)) = coded else { unreachable!("what is known before a part is never gone") };
            let of_section = BlockBox::around(&piece.region).volume();
            let of_tile = tiles.last().map_or(0, Tile::blocks);
            if !is_empty && (piece.payload.len() > left || of_tile + of_section > package::BOX_BLOCKS_MAX) {
                // Not even one block goes in any more, or no box as large as this.
                begin(&mut tiles);
                continue;
            }
            rest = rest.get(count..).unwrap_or_default();
            if let Some(tile) = tiles.last_mut() {
                tile.add(stamp, sensor, piece);
            }
        }
        part.blocks().iter().for_each(|(index, block)| told.entry(*index).or_default().overlay(block));
    }
    if tiles.is_empty() {
        begin(&mut tiles);
    }
    if let Some(last) = tiles.last_mut() {
        last.close();
    }
    tiles
}

/// What the head of a section takes at most: stamp, corner, size, length.
const SECTION_HEAD_MAX: usize = 10 + 3 * 5 + 3 * 5 + 3;

/// The middle of some changes, in sixteenths of a voxel.
fn middle(changes: &Changes) -> [i32; 3] {
    let count = changes.blocks().len().max(1) as i64;
    let sum = changes.blocks().iter().fold([0i64; 3], |sum, (block, _)| {
        [sum[0] + i64::from(block.x), sum[1] + i64::from(block.y), sum[2] + i64::from(block.z)]
    });
    sum.map(|sum| (sum * 128 / count + 64).clamp(i64::from(i32::MIN), i64::from(i32::MAX)) as i32)
}

impl Tile {
    /// Blocks in the boxes of its sections, counted together: what it takes to read it goes with them.
    fn blocks(&self) -> u128 {
        self.sections.iter().map(|section| section.region.volume()).sum()
    }

    /// Steps of work that the sections so far leave of those that the tile may ask for.
    fn spare(&self) -> u64 {
        let bytes: usize = self.sections.iter().map(|section| section.payload.len()).sum();
        work::limit(bytes).saturating_sub(self.steps)
    }

    fn add(&mut self, stamp: Stamp, sensor: [i32; 3], piece: package::Piece) {
        add_sensor(&mut self.sensors, stamp, sensor);
        let region = BlockBox::around(&piece.region);
        let is_first = self.sections.is_empty();
        self.region = if is_first { region } else { self.region.union(&region) };
        self.ends = [if is_first { stamp } else { self.ends[0] }, stamp];
        self.steps += piece.steps;
        self.sections.push(Section { stamp, region, payload: piece.payload });
        add(&mut self.parts, stamp, piece.changes);
    }

    /// Lets go of what the tile says beside its sections: that takes a hundred times as much.
    fn close(&mut self) {
        self.content = hash_present(&self.parts, &self.sensors);
        (self.parts, self.sensors) = (Vec::new(), Vec::new());
    }

    /// The payload of the tile.
    pub(crate) fn payload(&self) -> Vec<u8> {
        self.payload_in(&self.region)
    }

    /// The same for a tile with this box.
    fn payload_in(&self, region: &BlockBox) -> Vec<u8> {
        let mut payload = Vec::new();
        let mut before = self.sections.first().map_or(Stamp(0), |section| section.stamp);
        for Section { stamp, region: section, payload: rest } in &self.sections {
            varint::write(&mut payload, stamp.0.wrapping_sub(before.0) as u64);
            before = *stamp;
            for (at, of_tile) in section.min.into_iter().zip(region.min) {
                varint::write(&mut payload, i64::from(at).abs_diff(i64::from(of_tile)));
            }
            for side in section.size() {
                varint::write(&mut payload, side - 1);
            }
            varint::write(&mut payload, rest.len() as u64);
            payload.extend_from_slice(rest);
        }
        payload
    }
}

/// What a tile says; `told` is what the tiles before it said, and holds this one too afterwards. After an error it is of no use.
pub(crate) fn decode(
    workspace: &mut Option<Box<Workspace>>,
    told: &mut Layer,
    payload: &[u8],
    region: &VoxelBox,
    [first, last]: [Stamp; 2],
    work: &mut Work,
) -> Result<PresentState, PackageError> {
    let wrong = |rule| PackageError::Payload { codec: Codec::Flock, rule };
    let blocks = BlockBox::of_voxels(region).ok_or_else(|| wrong("the box is made of whole blocks"))?;
    let (mut parts, mut sensors) = (Vec::<(Stamp, Vec<(BlockIndex, StateBlock)>)>::new(), Vec::new());
    let mut stamp = first;
    let mut blocks_left = package::BOX_BLOCKS_MAX;
    let mut rest = payload;
    while !rest.is_empty() {
        let mut reader = Reader::new(rest);
        let later = reader.number("difference of stamps", u64::MAX)?;
        let next = stamp.0.checked_add_unsigned(later).map(Stamp).filter(|stamp| *stamp <= last);
        stamp = next.ok_or_else(|| wrong("stamps ascend to the newest in the header"))?;
        let section = read_box(&mut reader, &blocks)?;
        let length = reader.number("section length", u64::MAX)?;
        let split = usize::try_from(length).ok().and_then(|length| reader.rest().split_at_checked(length));
        let (body, after) = split.ok_or_else(|| wrong("a section ends within its tile"))?;
        rest = after;
        blocks_left = blocks_left
            .checked_sub(section.volume())
            .ok_or_else(|| wrong("the boxes of its sections have at most 2¹⁸ blocks together"))?;
        let voxels = section.voxels().ok_or_else(|| wrong("a section lies in the grid"))?;
        let known = Known::new(Some(told), stamp);
        let changes = package::decode(workspace.get_or_insert_default(), &known, body, section, work)?;
        let is_known = |block: &StateBlock, known: &StateBlock| {
            block.known().iter().zip(known.known()).any(|(told, known)| told & known != 0)
        };
        let is_told = |(at, block): &(BlockIndex, StateBlock)| {
            told.block(*at).is_some_and(|known| is_known(block, known))
        };
        if changes.blocks().iter().any(is_told) {
            return Err(wrong("every voxel has one stamp"));
        }
        told.apply(&changes, stamp);
        if let Some(sensor) = super::sensor(body, &voxels) {
            add_sensor(&mut sensors, stamp, sensor);
        }
        match parts.last_mut() {
            Some((last, part)) if *last == stamp => part.extend_from_slice(changes.blocks()),
            // Bytes can be made that say nothing; a part is never empty.
            _ if changes.is_empty() => {}
            _ => parts.push((stamp, changes.blocks().to_vec())),
        }
    }
    let parts = parts.into_iter().map(|(stamp, part)| (stamp, Changes::from_blocks(part))).collect();
    Ok(PresentState { region: *region, parts, sensors })
}

/// The box of a section in that of its tile.
fn read_box(reader: &mut Reader<'_>, of_tile: &BlockBox) -> Result<BlockBox, PackageError> {
    let mut section = *of_tile;
    for (min, max) in section.min.iter_mut().zip(of_tile.max) {
        let at = reader.number("section corner", max.abs_diff(*min).into())?;
        *min = (i64::from(*min) + at as i64) as i32;
    }
    for (max, min) in section.max.iter_mut().zip(section.min) {
        let side = reader.number("section size", max.abs_diff(min).into())?;
        *max = (i64::from(min) + side as i64) as i32;
    }
    Ok(section)
}

/// Adds changes to the newest part, if they are of that, or as a new one.
fn add(parts: &mut Vec<(Stamp, Changes)>, stamp: Stamp, changes: Changes) {
    match parts.last_mut() {
        Some((last, part)) if *last == stamp => {
            *part = Changes::from_blocks([part.blocks(), changes.blocks()].concat());
        }
        _ => parts.push((stamp, changes)),
    }
}

/// Adds the sensor of a part, if it is not there yet.
fn add_sensor(sensors: &mut Vec<(Stamp, [i32; 3])>, stamp: Stamp, sensor: [i32; 3]) {
    if sensors.last().is_none_or(|(last, _)| *last != stamp) {
        sensors.push((stamp, sensor));
    }
}
