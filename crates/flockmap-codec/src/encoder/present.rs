//! From the state of a layer, or what of it is newer than some package, to tiles.

use crc32fast::Hasher;
use flockmap_grid::{Changes, PresentState, PresentVoxels, Resolution, Stamp, Stream, VoxelBox};

use super::{Encoder, check_limit, header_length};
use crate::check::{check_hashed, hash_present, set_check};
use crate::flock;
use crate::piece::Piece;
use crate::states::Others;
use crate::{Codec, ContentKind, EncodeError, Header, Package, Priority};

/// Which packages a present state contains.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Span {
    /// The stream.
    pub stream: Stream,
    /// 0: the whole state. Else it has at least the voxels whose newest change is in a package after this one. Below `upto`.
    pub since: u32,
    /// The newest package whose changes, with those of all before it, are in the state; from 1.
    pub upto: u32,
}

/// What will be a tile when the number of tiles is known.
struct Draft {
    region: VoxelBox,
    ends: [Stamp; 2],
    payload: Vec<u8>,
    content: Hasher,
}

/// Bits of a voxel from which on a present state in `flock` is compared with one of the paper. Maps of real flights take one or less.
const FLOCK_TILE_BITS_MAX: usize = 3;

/// Voxels of a present state that are cut at once, in the codecs that cut by space: their parts take up to 144 bytes a voxel, some of
/// them twice.
const RUN_VOXELS_MAX: usize = 1 << 15;

impl Encoder {
    /// The state of a layer as tiles of at most `bytes_max` bytes each, codes `00 01 10` (Sec. IV-B of the paper), with
    /// the stamp of every voxel. `upto_index` is the newest package whose changes, with those of all before it, are in
    /// `state`. Always at least one tile: where nothing is known, one that says so of a single voxel.
    ///
    /// Tiles of [`Codec::Flock`] are told one against the other, see [`TilesRead`](crate::TilesRead). They are those of
    /// [`Codec::Paper`] where that takes fewer bytes.
    pub fn encode_present(
        &mut self,
        codec: Codec,
        stream: Stream,
        upto_index: u32,
        resolution: Resolution,
        state: &PresentState,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        check_rules(state)?;
        let voxels = PresentVoxels::from_state(state);
        let voxels = voxels.ok_or(EncodeError::PresentState { rule: "at most 2²⁷ stamps and blocks" })?;
        let span = Span { stream, since: 0, upto: upto_index };
        self.encode_span(codec, span, resolution, &voxels, bytes_max)
    }

    /// The same of a state in less memory, that need not be whole: see [`Layer::present_voxels`](flockmap_grid::Layer::present_voxels).
    /// Takes at most some 20 bytes for each voxel of a map of dense blocks while it works, beside what the encoder keeps: 140 to 300 for
    /// each block, the tiles, and 15 MB where they are of another codec than [`Codec::Flock`].
    pub fn encode_span(
        &mut self,
        codec: Codec,
        span: Span,
        resolution: Resolution,
        state: &PresentVoxels,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        let Span { stream, since, upto } = span;
        if upto == 0 || since >= upto {
            return Err(EncodeError::IndexOutOfRange { first: since, count: 1 });
        }
        let set = set_check(codec, bytes_max, [since, upto], state);
        let header = |region: VoxelBox, [cycle_start, cycle_end]: [Stamp; 2], tile, tiles| Header {
            stream,
            index: upto,
            cycle_start,
            cycle_end,
            reference: 0,
            is_alone: true,
            resolution,
            region,
            codec,
            content: ContentKind::Present { since, set, tile, tiles },
            priority: Priority::Obstacles,
        };
        if codec == Codec::Flock {
            let tiles = match self.flock_tiles(state, header, bytes_max) {
                Ok(tiles) => tiles,
                // Not even a block fits; the paper's tiles can be cut further.
                Err(EncodeError::BytesMaxTooSmall { .. }) => Vec::new(),
                Err(error) => return Err(error),
            };
            let bytes = |tiles: &[Package]| tiles.iter().map(|tile| tile.bytes().len()).sum::<usize>();
            if !tiles.is_empty() && bytes(&tiles) * 8 <= FLOCK_TILE_BITS_MAX * state.len() {
                return Ok(tiles);
            }
            // A history without a pattern: the paper's way may be shorter.
            let paper = self.encode_span(Codec::Paper, span, resolution, state, bytes_max)?;
            let is_paper = tiles.is_empty() || bytes(&paper) < bytes(&tiles);
            return Ok(if is_paper { paper } else { tiles });
        }
        let drafts = self.tiles_by_space(codec, state, header, bytes_max)?;
        let tiles = u32::try_from(drafts.len()).unwrap_or(u32::MAX);
        let packages = (0..tiles).zip(drafts).map(|(tile, Draft { region, ends, payload, content })| {
            let header = header(region, ends, tile, tiles);
            Package::seal(&header, &payload, |header| check_hashed(header, &content))
        });
        Ok(packages.collect())
    }

    /// A present state in the codecs that can tell any box: cut in space.
    fn tiles_by_space(
        &mut self,
        codec: Codec,
        state: &PresentVoxels,
        header: impl Fn(VoxelBox, [Stamp; 2], u32, u32) -> Header,
        bytes_max: usize,
    ) -> Result<Vec<Draft>, EncodeError> {
        check_limit(bytes_max)?;
        let mut drafts = Vec::new();
        // There are no more tiles than voxels.
        let tiles_max = u32::try_from(state.len()).unwrap_or(u32::MAX);
        for parts in state.runs(RUN_VOXELS_MAX) {
            let blocks = parts.iter().flat_map(|(_, part)| part.blocks().iter().copied()).collect();
            let piece = Piece::new(Changes::from_blocks(blocks), parts).ok_or(EncodeError::OutsideGrid)?;
            let longest = header(piece.region, ends_of(&piece.parts), tiles_max, tiles_max);
            let pieces = self.fit(codec, piece, &longest, bytes_max)?;
            drafts.extend(pieces.into_iter().map(|(piece, payload)| Draft {
                region: piece.region,
                ends: ends_of(&piece.parts),
                payload,
                content: hash_present(&piece.parts, &[]),
            }));
        }
        if drafts.is_empty() {
            let min = state.region().min();
            let region = VoxelBox::new(min, [1; 3]).ok_or(EncodeError::OutsideGrid)?;
            let piece = Piece { states: Changes::default(), parts: Vec::new(), region, edges: 0 };
            self.encode_piece(codec, &piece, Others::Unknown);
            let payload = self.payload.clone();
            drafts.push(Draft { region, ends: ends_of(&[]), payload, content: Hasher::new() });
        }
        Ok(drafts)
    }

    /// A present state in the codec `flock`: cut along its history.
    fn flock_tiles(
        &mut self,
        state: &PresentVoxels,
        header: impl Fn(VoxelBox, [Stamp; 2], u32, u32) -> Header,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        check_limit(bytes_max)?;
        // There are no more tiles than blocks.
        let tiles_max = u32::try_from(state.part_blocks()).unwrap_or(u32::MAX);
        let room = |region: &VoxelBox, ends: [Stamp; 2]| {
            bytes_max.saturating_sub(header_length(&header(*region, ends, tiles_max, tiles_max)))
        };
        let tiles = flock::present::encode(self.flock.get_or_insert_default(), state, room);
        let count = u32::try_from(tiles.len()).unwrap_or(u32::MAX);
        let packages = (0..count).zip(tiles).map(|(number, tile)| {
            let region = tile.region.voxels().ok_or(EncodeError::OutsideGrid)?;
            let header = header(region, tile.ends, number, count);
            let package =
                Package::seal(&header, &tile.payload(), |header| check_hashed(header, &tile.content));
            if package.bytes().len() > bytes_max {
                return Err(EncodeError::BytesMaxTooSmall { bytes_max });
            }
            Ok(package)
        });
        packages.collect()
    }
}

/// Oldest and newest stamp; zero without any.
fn ends_of(parts: &[(Stamp, Changes)]) -> [Stamp; 2] {
    [parts.first(), parts.last()].map(|part| part.map_or(Stamp(0), |part| part.0))
}

/// Whether a present state is one.
fn check_rules(state: &PresentState) -> Result<(), EncodeError> {
    let wrong = |rule| Err(EncodeError::PresentState { rule });
    if !state.parts.is_sorted_by(|a, b| a.0 < b.0) {
        return wrong("the stamps of the parts ascend");
    }
    let parts = || state.parts.iter().map(|(_, part)| part);
    if parts().any(Changes::is_empty) {
        return wrong("no part is empty");
    }
    let inside = |part: &Changes| part.bounding_box().is_some_and(|b| b.union(&state.region) == state.region);
    if !parts().all(inside) {
        return wrong("all voxels lie in the region");
    }
    let blocks = parts().flat_map(|part| part.blocks().iter().copied()).collect();
    let all = Changes::from_blocks(blocks);
    if all.len() != parts().map(Changes::len).sum::<usize>() {
        return wrong("no voxel is in two parts");
    }
    Ok(())
}
