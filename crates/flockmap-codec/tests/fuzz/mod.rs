//! What the fuzzer runs, shared with the test that replays its corpus: `fuzz/README.md` says how to run it.

mod choices;
pub(crate) mod chunks;
pub(crate) mod decode;
mod digest;
#[path = "../common/random.rs"]
mod random;
pub(crate) mod round_trip;

pub(crate) use choices::Choices;
pub(crate) use digest::Digest;
pub(crate) use random::Random;

use flockmap_codec::{ChunksRead, Codec, Content, Decoder, Encoder, Package};
use flockmap_grid::{Snapshot, VOXEL_LIMIT, Voxel, VoxelBox};

/// What one run leaves to the next: memory that is used again must not change a result.
#[derive(Default)]
pub(crate) struct Fuzz {
    encoder: Encoder,
    decoder: Decoder,
    /// Of all that was written and read: the same on every machine.
    pub(crate) digest: Digest,
}

impl Fuzz {
    /// Notes the bytes of a package just made. Those of zlib may be others on another machine.
    fn note(&mut self, package: &Package) {
        if matches!(package.header().codec, Codec::Raw | Codec::Racer | Codec::Flock) {
            self.digest.add(package.bytes());
        }
    }

    /// What an honest chunk says that follows those before.
    fn read_chunk(&mut self, chunk: &Package, before: &mut ChunksRead) -> Snapshot {
        if chunk.header().codec == Codec::Flock {
            return self.decoder.decode_chunk(chunk, before).unwrap();
        }
        match self.decoder.decode(chunk).unwrap() {
            Content::Snapshot(state) => state,
            other => panic!("{other:?}"),
        }
    }
}

/// All voxels that there can be.
fn grid() -> VoxelBox {
    let end = VOXEL_LIMIT;
    VoxelBox::spanning(Voxel::new(-end, -end, -end), Voxel::new(end, end, end)).unwrap()
}
