//! Whether layers may take more.

use super::sources::Sources;
use super::view::VIEW_BLOCK_BYTES;
use super::{Fusion, FusionError};
use crate::layer::SENSOR_BYTES;
use crate::{Changes, Mapper, Stream};

/// Blocks of the fused map that a new block of a layer in another frame is taken to add, before it is there
/// and they are counted.
const REACHED_BLOCKS: usize = 4;

/// To which nothing was applied by so many changes of blocks of all layers, that is packed where room is wanting; where the
/// cap is small, by one for each 256 bytes of it.
const COLD: u64 = 32_768;
/// Most blocks that are packed for one change, some 15 µs each; where there is no room then, something is dropped.
const PACKED_AT_ONCE: usize = 512;
/// Of these, so many before it is looked again whether there is room.
const PACKED_AT_A_TIME: usize = 64;
/// Packed for each change when seven eighths are taken, so that rarely much is to be packed for one.
const PACKED_AHEAD: usize = 128;

impl Fusion {
    /// Bytes that the layers of others hold, those that are leaving too, with what of the fused map, and of the one
    /// that is being made, the own map does not account for. O(1); O(regions of 64³ voxels) while a map is being made.
    pub fn memory_bytes_of_others(&self, mapper: &Mapper) -> usize {
        let beside = self.next.as_ref().map(|next| next.fused.view.memory_bytes_beside(&self.shown.view));
        let maps = self.shown.view.memory_bytes() + beside.unwrap_or(0);
        self.sources.bytes() + maps.saturating_sub(mapper.block_count() * VIEW_BLOCK_BYTES)
    }

    /// Whether there is no room that could be made. An error if there are too many streams.
    pub(super) fn is_full(room: Result<(), FusionError>) -> Result<bool, FusionError> {
        match room {
            Ok(()) => Ok(false),
            Err(FusionError::LayersFull { .. } | FusionError::OwnLayerFull { .. }) => Ok(true),
            Err(error) => Err(error),
        }
    }

    /// Packs layers if they would not fit else, or soon: the layer of a stream is to take these changes over.
    pub(super) fn make_room<'a, P: Iterator<Item = &'a Changes>>(
        &mut self,
        mapper: &Mapper,
        stream: Stream,
        parts: impl Fn() -> P,
        sensors: usize,
    ) -> Result<(), FusionError> {
        let is_own = stream == self.sources.own;
        let (held, max) = if is_own {
            let own = self.sources.get(stream).map(|source| source.layer.memory_bytes());
            (own.unwrap_or(0), self.config.own_layer_bytes_max)
        } else {
            (self.memory_bytes_of_others(mapper), self.config.layer_bytes_max)
        };
        let cold = COLD.min(max as u64 / 256);
        let pack = |sources: &mut Sources, blocks_max| match is_own {
            true => sources.make_room_of_own(cold, blocks_max),
            false => sources.make_room_of_others(cold, blocks_max),
        };
        if held > max / 8 * 7 {
            pack(&mut self.sources, PACKED_AHEAD);
        }
        let mut packed = 0;
        loop {
            let result = self.check_room(mapper, stream, parts(), sensors);
            let is_full =
                matches!(result, Err(FusionError::LayersFull { .. } | FusionError::OwnLayerFull { .. }));
            if !is_full || packed >= PACKED_AT_ONCE {
                return result;
            }
            match pack(&mut self.sources, PACKED_AT_A_TIME) {
                0 => return result,
                more => packed += more,
            }
        }
    }

    /// Whether the layer of a stream may take these changes over, each with a stamp of its own, and so many
    /// sensors.
    pub(super) fn check_room<'a>(
        &self,
        mapper: &Mapper,
        stream: Stream,
        parts: impl Iterator<Item = &'a Changes>,
        sensors: usize,
    ) -> Result<(), FusionError> {
        let source = self.sources.get(stream);
        if source.is_none() && self.sources.is_full(self.config.streams_max) {
            return Err(FusionError::StreamsFull(stream, self.config.streams_max));
        }
        let nothing = Default::default();
        let source = source.unwrap_or(&nothing);
        let (growth, new_blocks) = source.layer.growth_max(parts);
        let layer_growth = growth + sensors * SENSOR_BYTES + source.spans.growth_max(new_blocks);
        if stream == self.sources.own {
            let (held, max) = (source.layer.memory_bytes(), self.config.own_layer_bytes_max);
            let is_within = held + layer_growth <= max;
            return is_within.then_some(()).ok_or(FusionError::OwnLayerFull {
                held,
                more: layer_growth,
                max,
            });
        }
        let reached = self.maps().map(|fused| {
            let origin = fused.settings.origin(stream.origin);
            let is_shift = origin.alignment().is_shift() && fused.settings.is_unmoved(stream);
            match (origin.is_muted, is_shift) {
                (true, _) => 0,
                (false, true) => new_blocks,
                (false, false) => new_blocks * REACHED_BLOCKS,
            }
        });
        let reached: usize = reached.sum();
        let (held, max) = (self.memory_bytes_of_others(mapper), self.config.layer_bytes_max);
        let more = layer_growth + source.received.growth_max() + reached * VIEW_BLOCK_BYTES;
        if held + more <= max { Ok(()) } else { Err(FusionError::LayersFull { held, more, max }) }
    }
}
