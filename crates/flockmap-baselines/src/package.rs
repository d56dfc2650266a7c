//! The map packages of Flockmap as a method: the codecs of the paper and its comparisons.

use flockmap_codec::{Codec, Content, Cycle, Decoder, Encoder, PACKAGE_BYTES_MAX, Package};
use flockmap_grid::{BlockIndex, Changes, Layer, Mapper, Stamp, State, StateBlock, Voxel};

use crate::{MapTooLarge, ReceiveError, Receiver, SendError, Sender};

pub(crate) struct PackageSender {
    codec: Codec,
    datagrams: bool,
    encoder: Encoder,
    next_index: u32,
}

impl PackageSender {
    pub(crate) fn new(codec: Codec, datagrams: bool) -> Self {
        Self { codec, datagrams, encoder: Encoder::new(), next_index: 1 }
    }
}

impl Sender for PackageSender {
    fn cycle(
        &mut self,
        _now: Stamp,
        cycle: &Cycle,
        changes: &Changes,
        _mapper: &Mapper,
        out: &mut Vec<Vec<u8>>,
    ) -> Result<(), SendError> {
        let Self { codec, encoder, next_index, .. } = self;
        let packages = if self.datagrams {
            encoder.encode_cycle(*codec, cycle, *next_index, changes, PACKAGE_BYTES_MAX)?
        } else {
            vec![encoder.encode_whole(*codec, cycle, *next_index, changes)?]
        };
        *next_index += packages.len() as u32;
        out.extend(packages.iter().map(|package| package.bytes().to_vec()));
        Ok(())
    }
}

#[derive(Default)]
pub(crate) struct PackageReceiver {
    decoder: Decoder,
    layer: Layer,
}

impl Receiver for PackageReceiver {
    fn receive(&mut self, message: &[u8]) -> Result<(), ReceiveError> {
        let package = Package::parse(message)?;
        if self.layer.block_count() >= crate::BLOCKS_MAX {
            return Err(MapTooLarge.into());
        }
        match self.decoder.decode(&package)? {
            Content::Changes(changes) => {
                self.layer.apply(&changes, package.header().cycle_end);
            }
            // No sender here makes one; it says the same in another way.
            Content::Present(state) => {
                for (stamp, part) in &state.parts {
                    self.layer.apply(part, *stamp);
                }
            }
        }
        Ok(())
    }

    fn state(&self, voxel: Voxel) -> State {
        self.layer.state(voxel)
    }

    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_> {
        Box::new(self.layer.blocks().map(|(index, block)| (index, *block)))
    }

    fn layer(&self) -> Option<&Layer> {
        Some(&self.layer)
    }
}
