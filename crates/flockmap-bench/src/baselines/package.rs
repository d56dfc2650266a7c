//! The map packages of Flockmap as a method: the codecs of the paper and its comparisons.

use anyhow::{Result, ensure};
use flockmap::codec::{Codec, Content, Cycle, Decoder, Encoder, PACKAGE_BYTES_MAX, Package, Reference};
use flockmap::grid::{BlockIndex, Changes, Layer, Stamp, StateBlock};

use crate::baselines::state_map::BLOCKS_MAX;
use crate::baselines::traits::{Messages, Receiver, Sender};

pub(crate) struct PackageSender {
    codec: Codec,
    datagrams: bool,
    encoder: Encoder,
    next_index: u32,
    /// What was told so far, and the last package of each cycle: what the next cycle is told against.
    layer: Layer,
    cycles: Vec<(Stamp, u32)>,
}

impl PackageSender {
    pub(crate) fn new(codec: Codec, datagrams: bool) -> Self {
        Self {
            codec,
            datagrams,
            encoder: Encoder::new(),
            next_index: 1,
            layer: Layer::default(),
            cycles: Vec::new(),
        }
    }
}

impl Sender for PackageSender {
    fn cycle(&mut self, _now: Stamp, cycle: &Cycle, changes: &Changes, out: &mut Messages) -> Result<()> {
        let Self { codec, encoder, next_index, layer, cycles, .. } = self;
        let packages = if self.datagrams {
            // Nothing is lost here, so nobody has to be waited for.
            let reference = Reference { layer: Some(layer), cycles, readers: &[] };
            encoder.encode_cycle_against(
                *codec,
                cycle,
                *next_index,
                changes,
                Some(&reference),
                PACKAGE_BYTES_MAX,
            )?
        } else {
            vec![encoder.encode_whole(*codec, cycle, *next_index, changes)?]
        };
        *next_index += packages.len() as u32;
        out.extend(packages.iter().map(|package| package.bytes().to_vec()));
        Ok(())
    }

    fn told(&mut self, cycle: &Cycle, changes: &Changes) {
        if self.codec == Codec::Flock {
            self.layer.apply(changes, cycle.end);
            self.cycles.push((cycle.end, self.next_index - 1));
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
                self.layer.apply(&changes, package.header().cycle_end);
            }
            // No sender here makes one; it says the same in another way.
            Content::Present(state) => {
                self.layer.apply_present(&state);
            }
        }
        Ok(())
    }

    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_> {
        Box::new(self.layer.blocks().map(|(index, block)| (index, *block)))
    }

    fn layer(&self) -> Option<&Layer> {
        Some(&self.layer)
    }
}
