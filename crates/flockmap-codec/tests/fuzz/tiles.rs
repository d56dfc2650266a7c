//! Any bytes as the tiles of a present state in `flock`, which are told one against the other.
//!
//! Input: tiles, each behind its length as `u16 LE`.

use flockmap_codec::{Codec, Content, PACKAGE_BYTES_MAX, Package, PackageError, TilesRead};
use flockmap_grid::Layer;

use super::{Fuzz, decode};

/// More is not encoded again: it takes long.
const AGAIN_BLOCKS_MAX: usize = 64;

pub(crate) fn run(fuzz: &mut Fuzz, input: &[u8]) {
    let (mut before, mut layer) = (TilesRead::default(), Layer::default());
    let mut newest = None;
    let mut rest = input;
    while let Some((length, after)) = rest.split_first_chunk() {
        let (bytes, after) = after.split_at(after.len().min(u16::from_le_bytes(*length).into()));
        rest = after;
        let Ok(tile) = Package::parse(bytes) else { continue };
        let mut read = before.clone();
        let state = match fuzz.decoder.decode_tile(&tile, &mut read) {
            Ok(state) => state,
            Err(PackageError::Check { stated, found }) => {
                assert_eq!(read.next(), 0);
                decode::mended(&tile, [stated, found], |tile| {
                    read = before.clone();
                    fuzz.decoder.decode_tile(tile, &mut read).ok()
                })
                .1
            }
            Err(error) => {
                let is_the_next =
                    !matches!(error, PackageError::TileMissing { .. } | PackageError::Header { .. });
                assert_eq!(read.next(), if is_the_next { 0 } else { before.next() });
                fuzz.digest.add(error.to_string().as_bytes());
                continue;
            }
        };
        assert_eq!(read.next(), before.next() + 1);
        before = read;
        decode::check_present(tile.header(), &state);
        let voxels: usize = state.parts.iter().map(|part| part.1.len()).sum();
        let known = layer.len();
        layer.apply_present(&state);
        assert_eq!(layer.len(), known + voxels, "every voxel has one stamp");
        assert_eq!(layer.block_count(), before.block_count());
        newest = Some(*tile.header());
        fuzz.digest.add_content(&Content::Present(state));
    }
    // What could be read can be written.
    let (Some(header), Some(state)) = (newest, layer.present_state()) else { return };
    if layer.block_count() > AGAIN_BLOCKS_MAX {
        return;
    }
    let tiles = fuzz.encoder.encode_present(
        Codec::Flock,
        header.stream,
        header.index,
        header.resolution,
        &state,
        PACKAGE_BYTES_MAX,
    );
    let (mut again, mut before) = (Layer::default(), TilesRead::default());
    for tile in tiles.unwrap() {
        fuzz.note(&tile);
        again.apply_present(&fuzz.read_tile(&tile, &mut before));
    }
    assert_eq!(again.digest(), layer.digest());
}
