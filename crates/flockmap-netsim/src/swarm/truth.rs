//! What every origin published, noted at the origin itself, to compare the others' layers with.

use flockmap::codec::{Content, Decoder, Package};
use flockmap::sync::IntervalSet;
use flockmap_grid::{Changes, Layer, Stamp, State, Stream, Voxel};
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;

/// What a package of an origin says of a voxel.
#[derive(Clone, Copy, Debug)]
struct Observation {
    index: u32,
    stamp: Stamp,
    state: State,
}

/// All that one stream published.
#[derive(Default)]
pub(super) struct Published {
    /// Of each voxel, oldest first.
    observations: FxHashMap<Voxel, Vec<Observation>>,
    /// Packages made.
    last: u32,
    /// Bytes of these.
    pub(super) bytes: u64,
    /// All of it, in order: what the packages of a batch are coded against.
    layer: Layer,
}

/// A layer that is not what it should be.
pub(super) struct Wrong {
    pub(super) voxel: Voxel,
    pub(super) expected: String,
    pub(super) found: String,
}

/// All streams of a flight.
#[derive(Default)]
pub(super) struct Truth {
    streams: BTreeMap<Stream, Published>,
    decoder: Decoder,
}

impl Truth {
    /// Notes a batch: what changed, and the packages made of it. The error is what is wrong with the packages.
    pub(super) fn note_batch(&mut self, changes: &Changes, packages: &[Package]) -> Result<(), String> {
        let Some(first) = packages.first() else { return Ok(()) };
        let published = self.streams.entry(first.header().stream).or_default();
        let mut together = Vec::new();
        for package in packages {
            let header = package.header();
            if header.index != published.last + 1 {
                return Err(format!("package {} after package {}", header.index, published.last));
            }
            let content = match self.decoder.decode_against(package, Some(&published.layer)) {
                Ok(Content::Changes(content)) => content,
                other => return Err(format!("package {}: {other:?}", header.index)),
            };
            published.last = header.index;
            published.bytes += package.bytes().len() as u64;
            for (voxel, state) in content.voxels() {
                let observation = Observation { index: header.index, stamp: header.batch_end, state };
                published.observations.entry(voxel).or_default().push(observation);
            }
            together.extend_from_slice(content.blocks());
        }
        let together = Changes::from_blocks(together);
        if together != *changes {
            let (got, expected) = (together.len(), changes.len());
            return Err(format!("the packages of a batch of {expected} changes say {got}, or others"));
        }
        published.layer.apply(&together, first.header().batch_end);
        Ok(())
    }

    pub(super) fn published(&self, stream: Stream) -> Option<&Published> {
        self.streams.get(&stream)
    }

    pub(super) fn streams(&self) -> impl Iterator<Item = (Stream, &Published)> {
        self.streams.iter().map(|(stream, published)| (*stream, published))
    }

    /// Packages that a stream made.
    pub(super) fn last(&self, stream: Stream) -> u32 {
        self.streams.get(&stream).map_or(0, |published| published.last)
    }
}

impl Published {
    /// The first of some voxels whose state and stamp were never published.
    pub(super) fn find_unpublished(
        &self,
        voxels: impl IntoIterator<Item = (Voxel, State, Stamp)>,
    ) -> Option<Wrong> {
        voxels.into_iter().find_map(|(voxel, state, stamp)| {
            let published = self.observations.get(&voxel).map_or(&[][..], Vec::as_slice);
            let is_right = published.iter().any(|one| (one.state, one.stamp) == (state, stamp));
            (!is_right).then(|| {
                let all = published.iter().rev().map(|one| format!("{:?} at {:?}", one.state, one.stamp));
                let expected = format!("one of [{}]", all.collect::<Vec<_>>().join(", "));
                Wrong { voxel, expected, found: format!("{state:?} at {stamp:?}") }
            })
        })
    }

    /// The first of some voxels of which a layer has something older than what the received packages say. It may have
    /// nothing where it says that something as old was dropped; and anything where a later package, up to `changed_upto`,
    /// that was not received says something of the voxel.
    pub(super) fn find_older(
        &self,
        mut voxels: impl Iterator<Item = Voxel>,
        layer: Option<&Layer>,
        received: &IntervalSet,
        changed_upto: u32,
    ) -> Option<Wrong> {
        voxels.find_map(|voxel| {
            let published = self.observations.get(&voxel)?;
            let Observation { index, stamp, state } =
                *published.iter().rev().find(|one| received.contains(one.index))?;
            let is_later = |one: &Observation| one.index > index && one.index <= changed_upto;
            if published.iter().any(is_later) {
                return None;
            }
            let found = layer.and_then(|layer| layer.get(voxel));
            let is_right = match found {
                Some((is, at)) => at > stamp || (at == stamp && is == state),
                None => layer.and_then(Layer::lost_upto).is_some_and(|lost| stamp <= lost),
            };
            (!is_right).then(|| Wrong {
                voxel,
                expected: format!("{state:?} at {stamp:?}, as package {index} says, or newer"),
                found: found
                    .map_or_else(|| "Unknown".to_owned(), |(state, stamp)| format!("{state:?} at {stamp:?}")),
            })
        })
    }

    /// All voxels that were ever published.
    pub(super) fn voxels(&self) -> impl Iterator<Item = Voxel> {
        self.observations.keys().copied()
    }
}
