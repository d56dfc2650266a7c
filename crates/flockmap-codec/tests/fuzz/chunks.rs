//! Any bytes as the chunks of a snapshot in `flock`, which are coded one against the other.
//!
//! Input: chunks, each behind its length as `u16 LE`.

use flockmap_codec::{ChunksRead, Codec, Content, PACKAGE_BYTES_MAX, Package, PackageError};
use flockmap_grid::Layer;

use super::{Fuzz, decode};

/// More is not encoded again: it takes long.
const AGAIN_BLOCKS_MAX: usize = 64;

pub(crate) fn run(fuzz: &mut Fuzz, input: &[u8]) {
    let (mut before, mut layer) = (ChunksRead::default(), Layer::default());
    let mut newest = None;
    let mut rest = input;
    while let Some((length, after)) = rest.split_first_chunk() {
        let (bytes, after) = after.split_at(after.len().min(u16::from_le_bytes(*length).into()));
        rest = after;
        let Ok(chunk) = Package::parse(bytes) else { continue };
        let mut read = before.clone();
        let state = match fuzz.decoder.decode_chunk(&chunk, &mut read) {
            Ok(state) => state,
            Err(PackageError::Check { stated, found }) => {
                assert_eq!(read.next(), 0);
                decode::mended(&chunk, [stated, found], |chunk| {
                    read = before.clone();
                    fuzz.decoder.decode_chunk(chunk, &mut read).ok()
                })
                .1
            }
            Err(error) => {
                let is_the_next =
                    !matches!(error, PackageError::ChunkMissing { .. } | PackageError::Header { .. });
                assert_eq!(read.next(), if is_the_next { 0 } else { before.next() });
                fuzz.digest.add(error.to_string().as_bytes());
                continue;
            }
        };
        assert_eq!(read.next(), before.next() + 1);
        before = read;
        decode::check_snapshot(chunk.header(), &state);
        let voxels: usize = state.parts.iter().map(|part| part.1.len()).sum();
        let known = layer.len();
        layer.apply_snapshot(&state);
        assert_eq!(layer.len(), known + voxels, "every voxel has one stamp");
        assert_eq!(layer.block_count(), before.block_count());
        newest = Some(*chunk.header());
        fuzz.digest.add_content(&Content::Snapshot(state));
    }
    // What could be read can be written.
    let (Some(header), Some(state)) = (newest, layer.snapshot()) else { return };
    if layer.block_count() > AGAIN_BLOCKS_MAX {
        return;
    }
    let chunks = fuzz.encoder.encode_snapshot(
        Codec::Flock,
        header.stream,
        header.index,
        header.resolution,
        &state,
        PACKAGE_BYTES_MAX,
    );
    let (mut again, mut before) = (Layer::default(), ChunksRead::default());
    for chunk in chunks.unwrap() {
        fuzz.note(&chunk);
        again.apply_snapshot(&fuzz.read_chunk(&chunk, &mut before));
    }
    assert_eq!(again.digest(), layer.digest());
}
