//! The map packages of Flockmap as a method: the codecs of the paper and its comparisons.

use anyhow::{Result, ensure};
use flockmap::codec::{Base, Batch, Codec, Content, Decoder, Encoder, PACKAGE_BYTES_MAX, Package};
use flockmap::grid::{BlockIndex, Changes, Layer, Stamp, StateBlock};

use crate::baselines::state_map::BLOCKS_MAX;
use crate::baselines::traits::{Messages, Receiver, Sender};

pub(crate) struct PackageSender {
    codec: Codec,
    datagrams: bool,
    encoder: Encoder,
    next_index: u32,
    /// What was sent so far, and the last package of each batch: what the next batch is coded against.
    layer: Layer,
    batches: Vec<(Stamp, u32)>,
}

impl PackageSender {
    pub(crate) fn new(codec: Codec, datagrams: bool) -> Self {
        Self {
            codec,
            datagrams,
            encoder: Encoder::new(),
            next_index: 1,
            layer: Layer::default(),
            batches: Vec::new(),
        }
    }
}

impl Sender for PackageSender {
    fn batch(&mut self, _now: Stamp, batch: &Batch, changes: &Changes, out: &mut Messages) -> Result<()> {
        let (codec, index) = (self.codec, self.next_index);
        let packages = if self.datagrams {
            // Nothing is lost here, so nobody has to be waited for.
            let base = Base { layer: Some(&self.layer), batches: &self.batches, readers: &[] };
            self.encoder.encode_batch_against(codec, batch, index, changes, Some(&base), PACKAGE_BYTES_MAX)?
        } else {
            vec![self.encoder.encode_whole(codec, batch, index, changes)?]
        };
        self.next_index += packages.len() as u32;
        out.extend(packages.iter().map(|package| package.bytes().to_vec()));
        Ok(())
    }

    fn published(&mut self, batch: &Batch, changes: &Changes) {
        if self.codec == Codec::Flock {
            self.layer.apply(changes, batch.end);
            self.batches.push((batch.end, self.next_index - 1));
        }
    }
}

#[derive(Default)]
pub(crate) struct PackageReceiver {
    decoder: Decoder,
    layer: Layer,
}

impl Receiver for PackageReceiver {
    fn receive(&mut self, message: &[u8]) -> Result<()> {
        let package = Package::parse(message)?;
        ensure!(
            self.layer.block_count() < BLOCKS_MAX,
            "the map would grow beyond {BLOCKS_MAX} blocks of 8³ voxels"
        );
        match self.decoder.decode_against(&package, Some(&self.layer))? {
            Content::Changes(changes) => {
                self.layer.apply(&changes, package.header().batch_end);
            }
            // No sender here makes one; it holds the same in another form.
            Content::Snapshot(state) => {
                self.layer.apply_snapshot(&state);
            }
        }
        Ok(())
    }

    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_> {
        Box::new(self.layer.blocks())
    }

    fn layer(&self) -> Option<&Layer> {
        Some(&self.layer)
    }
}
