//! The state of a layer: chunks that are cut in space, each with the states of its voxels and their stamps.

use flockmap_grid::{Changes, Snapshot, SnapshotVoxels, Stamp, VoxelBox};

use super::fit::{Writer, fit};
use super::stamps;
use super::states::{self, Others, Scratch};
use crate::check;
use crate::codec::Codec;
use crate::draft::ChunkDraft;
use crate::error::{EncodeError, PackageError};
use crate::fields::Fields;
use crate::piece::Piece;
use crate::work::Work;

/// Voxels of a snapshot that are cut at once: their parts take up to 144 bytes a voxel, some of them twice.
const RUN_VOXELS_MAX: usize = 1 << 15;

/// The state as chunks, at least one. `room` says how many bytes the payload of a chunk may have that spans a
/// box and some stamps; a payload of a single voxel may be longer.
pub(crate) fn encode_snapshot(
    writer: &mut Writer,
    codec: Codec,
    state: &SnapshotVoxels,
    room: impl Fn(&VoxelBox, [Stamp; 2]) -> usize,
) -> Result<Vec<ChunkDraft>, EncodeError> {
    let draft = |(piece, payload): (Piece, Vec<u8>)| {
        let content = check::of_chunk(&piece.parts, &[]);
        ChunkDraft { region: piece.region, ends: ends_of(&piece.parts), payload, content }
    };
    let mut drafts = Vec::new();
    for parts in state.runs(RUN_VOXELS_MAX) {
        let blocks = parts.iter().flat_map(|(_, part)| part.blocks().iter().copied()).collect();
        let piece = Piece::new(Changes::from_blocks(blocks), parts).ok_or(EncodeError::OutsideGrid)?;
        let room = |piece: &Piece| room(&piece.region, ends_of(&piece.parts));
        drafts.extend(fit(writer, codec, Others::Unknown, piece, room).into_iter().map(draft));
    }
    if drafts.is_empty() {
        let region = VoxelBox::new(state.region().min(), [1; 3]).ok_or(EncodeError::OutsideGrid)?;
        let piece = Piece { states: Changes::default(), parts: Vec::new(), region, edges: 0 };
        writer.encode(codec, &piece, Others::Unknown);
        drafts.push(draft((piece, writer.payload.clone())));
    }
    Ok(drafts)
}

/// Oldest and newest stamp; zero without any.
fn ends_of(parts: &[(Stamp, Changes)]) -> [Stamp; 2] {
    [parts.first(), parts.last()].map(|part| part.map_or(Stamp(0), |part| part.0))
}

/// What a chunk says; `ends` are the oldest and the newest stamp by its header.
pub(crate) fn decode_chunk(
    scratch: &mut Scratch,
    codec: Codec,
    payload: &[u8],
    region: &VoxelBox,
    ends: [Stamp; 2],
    work: &mut Work,
) -> Result<Snapshot, PackageError> {
    let mut fields = Fields::new(payload);
    let length = fields.number("length of states", payload.len() as u64)? as usize;
    let rule = "the length of the states, the states, the stamps";
    let wrong = PackageError::Payload { codec, rule };
    let (states, stamps) = fields.rest().split_at_checked(length).ok_or(wrong)?;
    let states = states::decode(codec, states, region, Others::Unknown, scratch, work)?;
    stamps::decode(codec, stamps, states, region, ends, work, &mut scratch.grid)
}
