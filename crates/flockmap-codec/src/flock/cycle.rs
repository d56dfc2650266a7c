//! A cycle as payloads: with the model, or as noise where that is shorter.

use flockmap_grid::{Changes, Overtaken, Stamp, VoxelBox};

use super::noise;
use super::order::BlockBox;
use super::package::{self, Habits, Piece, Workspace};
use super::tables::TableSet;
use crate::reference::Known;
use crate::varint::Reader;
use crate::work::{self, Work};
use crate::{BOX_VOXELS_MAX, Codec, PackageError};

/// The first byte of a payload of noise. Others tell a set of tables, of which there is none with this number.
const NOISE: u8 = 3;

/// Up to so many changes the model is tried even if they look like noise.
const TRY_BOTH_MAX: usize = 4_096;

/// A payload, and the newest stamp in the blocks that it was coded against; `None` if it was coded against nothing.
pub(crate) struct Told {
    pub(crate) piece: Piece,
    pub(crate) reference: Option<Stamp>,
}

/// Codes all changes of a cycle, of which there is at least one. `room` says how many bytes of payload the package of a
/// number, from 0, and with a certain box may have; a payload of a single voxel may be longer.
pub(crate) fn encode(
    workspace: &mut Workspace,
    known: &Known<'_>,
    sensor: [i32; 3],
    changes: &Changes,
    room: impl Fn(usize, &VoxelBox) -> usize,
) -> Result<Vec<Told>, Overtaken> {
    let sensor = package::whole(sensor);
    let tight = changes.bounding_box();
    let tight = tight.filter(|region| region.volume() <= u128::from(BOX_VOXELS_MAX));
    let is_noise = tight.is_some_and(|region| noise::is_noise(changes, &region));
    if is_noise && changes.len() > TRY_BOTH_MAX {
        return Ok(as_noise(changes, &room));
    }
    let modelled = with_model(workspace, known, sensor, changes, &room)?;
    if is_noise {
        let noise = as_noise(changes, &room);
        let bytes =
            |all: &[Told]| all.iter().map(|told| told.piece.payload.len() + HEADER_BYTES).sum::<usize>();
        if bytes(&noise) < bytes(&modelled) {
            return Ok(noise);
        }
    }
    Ok(modelled)
}

/// What a package takes beside its payload, about.
const HEADER_BYTES: usize = 32;

fn with_model(
    workspace: &mut Workspace,
    known: &Known<'_>,
    sensor: [i32; 3],
    changes: &Changes,
    room: impl Fn(usize, &VoxelBox) -> usize,
) -> Result<Vec<Told>, Overtaken> {
    let is_obstacles = changes.blocks().iter().all(|(_, block)| *block.free() == [0; 8]);
    let sets: &[_] = if is_obstacles { &[TableSet::Obstacles] } else { &[TableSet::Dense, TableSet::Sparse] };
    let mut habits = Habits::new(sets);
    let blocks = package::in_order(changes, sensor);
    let mut rest = blocks.as_slice();
    let mut all = Vec::new();
    while !rest.is_empty() {
        known.take_newest();
        let number = all.len();
        let (piece, count) =
            package::encode(workspace, known, &mut habits, sensor, rest, work::STEPS_FREE, |region| {
                room(number, region)
            })?;
        let (told, left) = rest.split_at(count.min(rest.len()));
        rest = left;
        if piece.payload.len() <= room(number, &piece.region) {
            all.push(Told { piece, reference: known.take_newest() });
        } else {
            // A single block that takes more than a package, against all that the model expects.
            let block = package::changes_of(told);
            all.extend(as_noise(&block, |_, region| room(number + block.len(), region)));
        }
    }
    Ok(all)
}

fn as_noise(changes: &Changes, room: impl Fn(usize, &VoxelBox) -> usize) -> Vec<Told> {
    // The longest header is that of the last package, with the largest box.
    let longest = changes.bounding_box().map_or(0, |region| room(changes.len(), &region));
    let pieces = noise::cut(changes, longest.saturating_sub(1));
    let told = pieces.into_iter().filter_map(|(region, changes)| {
        let region = BlockBox::around(&region).voxels()?;
        let mut payload = vec![NOISE];
        noise::encode(&changes, &region, &mut payload);
        let steps = noise::steps(changes.len(), changes.blocks().len());
        Some(Told { piece: Piece { changes, region, payload, steps }, reference: None })
    });
    told.collect()
}

/// What a payload says; `region` is made of whole blocks. Takes no memory before it is sure that the box is not too large.
pub(crate) fn decode(
    workspace: &mut Option<Box<Workspace>>,
    known: &Known<'_>,
    payload: &[u8],
    region: &VoxelBox,
    work: &mut Work,
) -> Result<Changes, PackageError> {
    let codec = Codec::Flock;
    let blocks = BlockBox::of_voxels(region);
    let blocks = blocks.ok_or(PackageError::Payload { codec, rule: "the box is made of whole blocks" })?;
    if blocks.volume() > package::BOX_BLOCKS_MAX {
        let (payload, limit) = (payload.len(), BOX_VOXELS_MAX);
        return Err(PackageError::BoxTooLarge { voxels: region.volume(), payload, codec, limit });
    }
    match payload.split_first() {
        Some((&NOISE, rest)) => noise::decode(rest, region, noise::changes_max(rest.len()), work),
        _ => package::decode(workspace.get_or_insert_default(), known, payload, blocks, work),
    }
}

/// From where the changes in a payload were seen, in sixteenths of a voxel. `None` if they were told without that.
pub(crate) fn sensor(payload: &[u8], region: &VoxelBox) -> Option<[i32; 3]> {
    let blocks = BlockBox::of_voxels(region)?;
    if payload.first() == Some(&NOISE) {
        return None;
    }
    package::Head::read(&blocks, &mut Reader::new(payload)).ok().map(|head| head.sensor)
}
