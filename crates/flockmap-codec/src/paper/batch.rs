//! The changes of a batch.

use flockmap_grid::{Changes, VoxelBox};

use super::fit::{Writer, fit};
use super::states::{self, Others, Scratch};
use crate::codec::Codec;
use crate::draft::BatchDraft;
use crate::error::{EncodeError, PackageError};
use crate::limits::BOX_VOXELS_MAX;
use crate::piece::Piece;
use crate::work::{self, Work};

/// All changes as one package, whatever its size.
pub(crate) fn encode_whole(
    writer: &mut Writer,
    codec: Codec,
    changes: &Changes,
) -> Result<BatchDraft, EncodeError> {
    let piece = Piece::new(changes.clone(), Vec::new()).ok_or(EncodeError::OutsideGrid)?;
    let voxels = piece.region.volume();
    if voxels > u128::from(BOX_VOXELS_MAX) {
        return Err(EncodeError::BoxTooLarge { voxels });
    }
    let steps = writer.encode(codec, &piece, Others::Unchanged);
    if steps > work::limit(writer.payload.len()) {
        return Err(EncodeError::TooMuchWork);
    }
    Ok(draft(piece, writer.payload.clone()))
}

/// All changes as packages. `room` says how many bytes of payload the package of a number, from 0, and with a
/// certain box may have; a payload of a single voxel may be longer.
pub(crate) fn encode_batch(
    writer: &mut Writer,
    codec: Codec,
    changes: &Changes,
    room: impl Fn(usize, &VoxelBox) -> usize,
) -> Result<Vec<BatchDraft>, EncodeError> {
    let piece = Piece::new(changes.clone(), Vec::new()).ok_or(EncodeError::OutsideGrid)?;
    // There are no more packages than voxels, which bounds the index and with it the header.
    let most = changes.len();
    let pieces = fit(writer, codec, Others::Unchanged, piece, |piece| room(most, &piece.region));
    Ok(pieces.into_iter().map(|(piece, payload)| draft(piece, payload)).collect())
}

fn draft(piece: Piece, payload: Vec<u8>) -> BatchDraft {
    BatchDraft { changes: piece.states, region: piece.region, payload, base: None }
}

/// What a payload says.
pub(crate) fn decode_batch(
    scratch: &mut Scratch,
    codec: Codec,
    payload: &[u8],
    region: &VoxelBox,
    work: &mut Work,
) -> Result<Changes, PackageError> {
    states::decode(codec, payload, region, Others::Unchanged, scratch, work)
}
