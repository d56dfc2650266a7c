//! The final map of each record as a snapshot: what a late joiner has to be sent.

use std::time::Instant;

use anyhow::{Context, ensure};
use flockmap::codec::{ChunksRead, Content, Decoder, Encoder, PACKAGE_BYTES_MAX};
use flockmap::grid::Layer;
use flockmap::{Codec, Package, Resolution, RobotId, Stream};
use serde::Serialize;

use crate::baselines::Method;

/// The snapshots of all records together, by one method.
#[derive(Serialize, Debug, Default)]
pub struct SnapshotRow {
    pub name: String,
    /// Chunks with their headers.
    pub total_bytes: u64,
    pub chunks: u64,
    pub encode_ms: f64,
    pub decode_ms: f64,
}

/// Where a method does not cut its packages: 1 MiB, more than any of these maps takes under the paper's codec.
const WHOLE_BYTES: usize = 1 << 20;

/// Codes `layers` by each of the methods that make map packages, reads it back and compares.
///
/// # Errors
/// If what comes back is not what went in.
pub fn run(layers: &[Layer], resolution: Resolution, methods: &[Method]) -> anyhow::Result<Vec<SnapshotRow>> {
    let mut rows = Vec::new();
    for method in methods {
        let (codec, bytes_max) = match method {
            Method::Whole(codec) => (*codec, WHOLE_BYTES),
            Method::Datagrams(codec) => (*codec, PACKAGE_BYTES_MAX),
            _ => continue,
        };
        let mut row = SnapshotRow { name: method.to_string(), ..SnapshotRow::default() };
        for layer in layers {
            row.add(codec, bytes_max, layer, resolution).with_context(|| row.name.clone())?;
        }
        rows.push(row);
    }
    Ok(rows)
}

impl SnapshotRow {
    fn add(
        &mut self,
        codec: Codec,
        bytes_max: usize,
        layer: &Layer,
        resolution: Resolution,
    ) -> anyhow::Result<()> {
        let Some(state) = layer.snapshot() else { return Ok(()) };
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        let started = Instant::now();
        let chunks = Encoder::new().encode_snapshot(codec, stream, 1, resolution, &state, bytes_max)?;
        self.encode_ms += started.elapsed().as_secs_f64() * 1e3;
        let started = Instant::now();
        let received = received(&chunks)?;
        self.decode_ms += started.elapsed().as_secs_f64() * 1e3;
        ensure!(received.digest() == layer.digest(), "the snapshot is not what was published");
        self.total_bytes += chunks.iter().map(|chunk| chunk.bytes().len() as u64).sum::<u64>();
        self.chunks += chunks.len() as u64;
        Ok(())
    }
}

fn received(chunks: &[Package]) -> anyhow::Result<Layer> {
    let (mut decoder, mut before, mut layer) = (Decoder::new(), ChunksRead::default(), Layer::default());
    for chunk in chunks {
        let chunk = Package::parse(chunk.bytes())?;
        let state = if chunk.header().codec == Codec::Flock {
            decoder.decode_chunk(&chunk, &mut before)?
        } else {
            let Content::Snapshot(state) = decoder.decode(&chunk)? else { continue };
            state
        };
        layer.apply_snapshot(&state);
    }
    Ok(layer)
}
