//! The state of a layer: chunks that are cut in space, each with the states of its voxels and their stamps.

use flockmap_grid::{BlockRuns, Changes, Snapshot, SnapshotVoxels, Stamp, VoxelBox};

use super::fit::{Fit, Writer};
use super::stamps;
use super::states::{self, Others, Scratch};
use crate::check;
use crate::codec::Codec;
use crate::draft::ChunkDraft;
use crate::error::{EncodeError, PackageError};
use crate::fields::Fields;
use crate::piece::Piece;
use crate::work::{self, Work};

/// Voxels of a snapshot that are cut at once: their parts take up to 144 bytes a voxel, some of them twice.
const RUN_VOXELS_MAX: usize = 1 << 15;

/// Cuts a state into chunks, some at a time.
pub(crate) struct SnapshotWriter {
    codec: Codec,
    runs: BlockRuns,
    is_taken_in: bool,
    /// Of the run that is being cut.
    fit: Option<Fit>,
    done: Vec<ChunkDraft>,
}

impl SnapshotWriter {
    pub(crate) fn new(codec: Codec) -> Self {
        Self { codec, runs: BlockRuns::default(), is_taken_in: false, fit: None, done: Vec::new() }
    }

    /// Goes on until it has taken so many steps, or a part, a run or a chunk more. `room` says how many bytes the
    /// payload of a chunk may have that spans a box and some stamps; a payload of a single voxel may be longer. `seen`
    /// is called with each part, all of them before the first chunk. Returns the steps taken; 0: all is coded.
    pub(crate) fn step(
        &mut self,
        writer: &mut Writer,
        state: &SnapshotVoxels,
        room: impl Fn(&VoxelBox, [Stamp; 2]) -> usize,
        mut seen: impl FnMut(Stamp, &Changes),
        steps_max: u64,
    ) -> Result<u64, EncodeError> {
        let blocks_of = |parts: &[(Stamp, Changes)]| {
            parts.iter().map(|(_, part)| part.blocks().len() as u64).sum::<u64>() * work::PART_BLOCK_STEPS
        };
        let mut steps = 0;
        while steps < steps_max {
            if !self.is_taken_in {
                match self.runs.take_in(state) {
                    Some((stamp, part)) => {
                        seen(stamp, &part);
                        steps += part.blocks().len() as u64 * work::PART_BLOCK_STEPS;
                    }
                    None => self.is_taken_in = true,
                }
                continue;
            }
            let Some(fit) = &mut self.fit else {
                let Some(parts) = self.runs.next_run(RUN_VOXELS_MAX) else { break };
                steps += blocks_of(&parts);
                let blocks = parts.iter().flat_map(|(_, part)| part.blocks().iter().copied()).collect();
                let piece =
                    Piece::new(Changes::from_blocks(blocks), parts).ok_or(EncodeError::OutsideGrid)?;
                self.fit = Some(Fit::new(self.codec, Others::Unknown, piece));
                continue;
            };
            let room = |piece: &Piece| room(&piece.region, ends_of(&piece.parts));
            let next = fit.next(writer, room);
            steps += fit.take_steps();
            match next {
                Some(piece) => self.done.push(draft(piece)),
                None => self.fit = None,
            }
        }
        Ok(steps)
    }

    /// Bytes of the chunks so far. O(chunks).
    pub(crate) fn bytes(&self) -> usize {
        self.done.iter().map(|chunk| chunk.payload.len()).sum()
    }

    /// All chunks, at least one; after all is coded.
    pub(crate) fn finish(
        mut self,
        writer: &mut Writer,
        state: &SnapshotVoxels,
    ) -> Result<Vec<ChunkDraft>, EncodeError> {
        if self.done.is_empty() {
            let region = VoxelBox::new(state.region().min(), [1; 3]).ok_or(EncodeError::OutsideGrid)?;
            let piece = Piece { states: Changes::default(), parts: Vec::new(), region, edges: 0 };
            writer.encode(self.codec, &piece, Others::Unknown);
            self.done.push(draft((piece, writer.payload.clone())));
        }
        Ok(self.done)
    }
}

fn draft((piece, payload): (Piece, Vec<u8>)) -> ChunkDraft {
    let content = check::of_chunk(&piece.parts, &[]);
    ChunkDraft { region: piece.region, ends: ends_of(&piece.parts), payload, content }
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
