//! A batch as payloads: with the model, or gap coded where that is shorter.

use flockmap_grid::{Changes, Layer, Plane, Stamp, VoxelBox, meet};

use super::block_box::{BOX_BLOCKS_MAX, BlockBox};
use super::gap_coding;
use super::habits::Habits;
use super::head::{GAP_CODED, Head, as_sent};
use super::known::Known;
use super::order;
use super::section::{self, Workspace};
use super::tables::TableSet;
use crate::codec::Codec;
use crate::draft::BatchDraft;
use crate::error::{EncodeError, PackageError};
use crate::fields::Fields;
use crate::limits::BOX_VOXELS_MAX;
use crate::source::Batch;
use crate::work::{self, Work};

/// Up to so many changes the model is tried even if there seems to be no pattern.
const TRY_BOTH_MAX: usize = 4_096;

/// Codes all changes of a batch, of which there is at least one, against what `layer` held before it. `room`
/// says how many bytes of payload the package of a number, from 0, and with a certain box may have; a payload
/// of a single voxel may be longer.
pub(crate) fn encode_batch(
    workspace: &mut Workspace,
    layer: Option<&Layer>,
    batch: &Batch,
    changes: &Changes,
    room: impl Fn(usize, &VoxelBox) -> usize,
) -> Result<Vec<BatchDraft>, EncodeError> {
    let tight = changes.bounding_box().ok_or(EncodeError::OutsideGrid)?;
    let is_small = tight.volume() <= u128::from(BOX_VOXELS_MAX);
    let has_no_pattern = is_small && gap_coding::has_no_pattern(changes, &tight);
    if has_no_pattern && changes.len() > TRY_BOTH_MAX {
        return Ok(gap_coded(changes, &room));
    }
    // The model cannot say that a voxel stays what it is: a batch that does so is coded independent.
    let layer = layer.filter(|layer| !repeats(changes, layer, batch.end));
    let modelled = modelled(workspace, &Known::new(layer, batch.end), batch.sensor, changes, &room)?;
    if has_no_pattern {
        let gap_coded = gap_coded(changes, &room);
        let bytes =
            |all: &[BatchDraft]| all.iter().map(|draft| draft.payload.len() + HEADER_BYTES).sum::<usize>();
        if bytes(&gap_coded) < bytes(&modelled) {
            return Ok(gap_coded);
        }
    }
    Ok(modelled)
}

/// What a package takes beside its payload, about.
const HEADER_BYTES: usize = 32;

/// Whether a voxel changes to what it was before the batch that ended at `end`. Not so in net changes, if
/// `layer` holds all before.
fn repeats(changes: &Changes, layer: &Layer, end: Stamp) -> bool {
    changes.blocks().iter().any(|(index, block)| match layer.block_before(*index, end) {
        Ok(Some(before)) => meet(block.free(), before.free()) || meet(block.occupied(), before.occupied()),
        // Nothing was known; or it is gone, as the model will find.
        _ => false,
    })
}

fn modelled(
    workspace: &mut Workspace,
    known: &Known<'_>,
    sensor: [i32; 3],
    changes: &Changes,
    room: impl Fn(usize, &VoxelBox) -> usize,
) -> Result<Vec<BatchDraft>, EncodeError> {
    let sensor = as_sent(sensor);
    let sets: &[_] = match count_of(changes) {
        [0, _] => &[TableSet::Obstacles],
        [free, occupied] if free / FREE_FOR_EACH_OCCUPIED >= occupied => &[TableSet::Free, TableSet::Sparse],
        _ => &[TableSet::Dense, TableSet::Sparse],
    };
    let mut habits = Habits::new(sets);
    let blocks = order::in_order(changes, sensor);
    let mut rest = blocks.as_slice();
    let mut drafts = Vec::new();
    while !rest.is_empty() {
        known.take_newest();
        let number = drafts.len();
        let room_here = |region: &VoxelBox| room(number, region);
        let (section, count) =
            section::encode(workspace, known, &mut habits, sensor, rest, work::STEPS_FREE, room_here)?;
        rest = rest.get(count..).unwrap_or_default();
        let section::Section { changes, region, payload, .. } = section;
        if payload.len() <= room_here(&region) {
            drafts.push(BatchDraft { changes, region, payload, base: known.take_newest() });
        } else {
            // A single block that takes more than a package, against all that the model expects.
            drafts.extend(gap_coded(&changes, |most, region| room(number + most, region)));
        }
    }
    Ok(drafts)
}

/// A batch with so many voxels that become Free for each that becomes Occupied is one of free space. With all changes
/// together there are 2 to 32 as a rule, where obstacles went ahead 64 to 1,000.
const FREE_FOR_EACH_OCCUPIED: usize = 40;

/// How many changes are to Free, and to Occupied.
fn count_of(changes: &Changes) -> [usize; 2] {
    let count = |plane: &Plane| plane.iter().map(|slice| slice.count_ones() as usize).sum::<usize>();
    changes.blocks().iter().fold([0; 2], |[free, occupied], (_, block)| {
        [free + count(block.free()), occupied + count(block.occupied())]
    })
}

fn gap_coded(changes: &Changes, room: impl Fn(usize, &VoxelBox) -> usize) -> Vec<BatchDraft> {
    // The longest header is that of the last package, with the largest box.
    let longest = changes.bounding_box().map_or(0, |region| room(changes.len(), &region));
    let pieces = gap_coding::cut(changes, longest.saturating_sub(1));
    let drafts = pieces.into_iter().filter_map(|(region, changes)| {
        let region = BlockBox::around(&region).voxels()?;
        let mut payload = vec![GAP_CODED];
        gap_coding::encode(&changes, &region, &mut payload);
        Some(BatchDraft { changes, region, payload, base: None })
    });
    drafts.collect()
}

/// What a payload says that was coded against what `layer` held before the batch. Takes no memory before it
/// is sure that the box is not too large.
pub(crate) fn decode_batch(
    workspace: &mut Option<Box<Workspace>>,
    layer: Option<&Layer>,
    batch_end: Stamp,
    payload: &[u8],
    region: &VoxelBox,
    work: &mut Work,
) -> Result<Changes, PackageError> {
    let codec = Codec::Flock;
    let blocks = BlockBox::of_voxels(region);
    let blocks = blocks.ok_or(PackageError::Payload { codec, rule: "the box is made of whole blocks" })?;
    if blocks.volume() > BOX_BLOCKS_MAX {
        let (payload, limit) = (payload.len(), BOX_VOXELS_MAX);
        return Err(PackageError::BoxTooLarge { voxels: region.volume(), payload, codec, limit });
    }
    match payload.split_first() {
        Some((&GAP_CODED, rest)) => gap_coding::decode(rest, region, work),
        _ => {
            let known = Known::new(layer, batch_end);
            section::decode(workspace.get_or_insert_default(), &known, None, payload, blocks, work)
        }
    }
}

/// From where the changes in a payload were seen, in sixteenths of a voxel. `None` if they were coded
/// without that.
pub(crate) fn sensor(payload: &[u8], region: &VoxelBox) -> Option<[i32; 3]> {
    let blocks = BlockBox::of_voxels(region)?;
    if payload.first() == Some(&GAP_CODED) {
        return None;
    }
    Head::read(&blocks, &mut Fields::new(payload)).ok().map(|head| head.sensor)
}
