//! The final map of each record as a present state: what a late joiner has to be told.

use std::time::Instant;

use anyhow::{Context, ensure};
use flockmap::codec::{Content, Decoder, Encoder, PACKAGE_BYTES_MAX, TilesRead};
use flockmap::grid::Layer;
use flockmap::{Codec, Package, Resolution, RobotId, Stream};
use serde::Serialize;

use crate::baselines::Method;

/// The present states of all records together, by one method.
#[derive(Serialize, Debug)]
pub struct PresentRow {
    pub name: String,
    /// Tiles with their headers.
    pub total_bytes: u64,
    pub tiles: u64,
    pub encode_ms: f64,
    pub decode_ms: f64,
}

/// Where a method does not cut its packages: 1 MiB, more than any of these maps takes under the paper's codec.
const WHOLE_BYTES: usize = 1 << 20;

/// Tells `layers` by each of the methods that make map packages, reads it back and compares.
///
/// # Errors
/// If what comes back is not what went in.
pub fn run(layers: &[Layer], resolution: Resolution, methods: &[Method]) -> anyhow::Result<Vec<PresentRow>> {
    let mut rows = Vec::new();
    for method in methods {
        let (codec, bytes_max) = match method {
            Method::Whole(codec) => (*codec, WHOLE_BYTES),
            Method::Datagrams(codec) => (*codec, PACKAGE_BYTES_MAX),
            _ => continue,
        };
        let mut row =
            PresentRow { name: method.to_string(), total_bytes: 0, tiles: 0, encode_ms: 0.0, decode_ms: 0.0 };
        for layer in layers {
            row.add(codec, bytes_max, layer, resolution).with_context(|| row.name.clone())?;
        }
        rows.push(row);
    }
    Ok(rows)
}

impl PresentRow {
    fn add(
        &mut self,
        codec: Codec,
        bytes_max: usize,
        layer: &Layer,
        resolution: Resolution,
    ) -> anyhow::Result<()> {
        let Some(state) = layer.present_state() else { return Ok(()) };
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        let started = Instant::now();
        let tiles = Encoder::new().encode_present(codec, stream, 1, resolution, &state, bytes_max)?;
        self.encode_ms += started.elapsed().as_secs_f64() * 1e3;
        let started = Instant::now();
        let received = received(&tiles)?;
        self.decode_ms += started.elapsed().as_secs_f64() * 1e3;
        ensure!(received.digest() == layer.digest(), "the present state is not what was told");
        self.total_bytes += tiles.iter().map(|tile| tile.bytes().len() as u64).sum::<u64>();
        self.tiles += tiles.len() as u64;
        Ok(())
    }
}

fn received(tiles: &[Package]) -> anyhow::Result<Layer> {
    let (mut decoder, mut before, mut layer) = (Decoder::new(), TilesRead::default(), Layer::default());
    for tile in tiles {
        let tile = Package::parse(tile.bytes())?;
        let state = if tile.header().codec == Codec::Flock {
            decoder.decode_tile(&tile, &mut before)?
        } else {
            let Content::Present(state) = decoder.decode(&tile)? else { continue };
            state
        };
        layer.apply_present(&state);
    }
    Ok(layer)
}
