//! What every origin told, taken down at the origin itself, to hold the others' layers against.

use flockmap::codec::{Content, Decoder, Package};
use flockmap::sync::IntervalSet;
use flockmap_grid::{BlockIndex, Changes, Layer, Stamp, State, Stream, Voxel, bit_of, voxel_bit};
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;

/// One word of an origin about a voxel.
#[derive(Clone, Copy, Debug)]
struct Observation {
    index: u32,
    stamp: Stamp,
    state: State,
    /// Number + 1 of the word before about the same voxel; 0: none.
    before: u32,
}

/// All that one stream told.
#[derive(Default)]
pub(super) struct Published {
    words: Vec<Observation>,
    /// Number + 1 of the newest word on each voxel of a block.
    newest: FxHashMap<BlockIndex, Box<[u32; 512]>>,
    /// What each batch changed, by its end.
    batches: BTreeMap<Stamp, Changes>,
    /// Packages made.
    last: u32,
    /// Bytes of these.
    pub(super) bytes: u64,
    /// All of it, in order: what the packages of a batch are told against.
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
    /// Takes down a batch: what changed, and the packages made of it. What is wrong with the packages, if something is.
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
            for (block, states) in content.blocks() {
                let heads = published.newest.entry(*block).or_insert_with(|| Box::new([0; 512]));
                let known = states.known();
                for (z, plane) in known.iter().enumerate() {
                    let mut bits = *plane;
                    while bits != 0 {
                        let bit = z * 64 + bits.trailing_zeros() as usize;
                        bits &= bits - 1;
                        let (index, stamp, state) = (header.index, header.batch_end, states.get(bit));
                        published.words.push(Observation { index, stamp, state, before: heads[bit] });
                        heads[bit] = published.words.len() as u32;
                    }
                }
            }
            together.extend_from_slice(content.blocks());
        }
        let together = Changes::from_blocks(together);
        if together != *changes {
            let (got, expected) = (together.len(), changes.len());
            return Err(format!("the packages of a batch of {expected} changes say {got}, or others"));
        }
        let end = first.header().batch_end;
        published.layer.apply(&together, end);
        published.batches.insert(end, together);
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
    /// The first voxel of some changes of the batch that ended at `stamp` that this batch did not tell.
    pub(super) fn find_unpublished(&self, changes: &Changes, stamp: Stamp) -> Option<Wrong> {
        let batch = self.batches.get(&stamp);
        for (block, states) in changes.blocks() {
            let at =
                batch.and_then(|batch| batch.blocks().binary_search_by_key(block, |(index, _)| *index).ok());
            let published = at.zip(batch).map(|(at, batch)| batch.blocks()[at].1).unwrap_or_default();
            let more = states.minus(&published);
            if let Some(bit) = (0..512).find(|bit| more.get(*bit) != State::Unknown) {
                let expected = match published.get(bit) {
                    State::Unknown => format!("nothing with stamp {stamp:?}"),
                    state => format!("{state:?} at {stamp:?}"),
                };
                return Some(Wrong {
                    voxel: voxel_at(*block, bit),
                    expected,
                    found: format!("{:?} at {stamp:?}", more.get(bit)),
                });
            }
        }
        None
    }

    /// The words about a voxel, newest first.
    fn words(&self, block: BlockIndex, bit: usize) -> impl Iterator<Item = &Observation> {
        let mut at = self.newest.get(&block).map_or(0, |heads| heads[bit]);
        core::iter::from_fn(move || {
            let word = self.words.get(at.checked_sub(1)? as usize)?;
            at = word.before;
            Some(word)
        })
    }

    /// The first voxel of a layer that holds a word which was never told.
    pub(super) fn find_untold_in(&self, layer: &Layer) -> Option<Wrong> {
        for (block, states) in layer.blocks() {
            let known = states.known();
            for bit in (0..512).filter(|bit| known[bit / 64] >> (bit % 64) & 1 == 1) {
                let voxel = voxel_at(block, bit);
                let Some((state, stamp)) = layer.get(voxel) else { continue };
                if !self.words(block, bit).any(|word| (word.state, word.stamp) == (state, stamp)) {
                    let all: Vec<String> = self
                        .words(block, bit)
                        .map(|word| format!("{:?} at {:?}", word.state, word.stamp))
                        .collect();
                    return Some(Wrong {
                        voxel,
                        expected: format!("one of [{}]", all.join(", ")),
                        found: format!("{state:?} at {stamp:?}"),
                    });
                }
            }
        }
        None
    }

    /// The first of some voxels of a layer that is older than what the packages held say of it.
    pub(super) fn find_older(
        &self,
        changes: &Changes,
        layer: Option<&Layer>,
        received: &IntervalSet,
    ) -> Option<Wrong> {
        for (block, states) in changes.blocks() {
            let known = states.known();
            for bit in (0..512).filter(|bit| known[bit / 64] >> (bit % 64) & 1 == 1) {
                if let Some(wrong) = self.older_at(*block, bit, layer, received) {
                    return Some(wrong);
                }
            }
        }
        None
    }

    /// The same of all voxels that were ever told.
    pub(super) fn find_older_in(&self, layer: Option<&Layer>, received: &IntervalSet) -> Option<Wrong> {
        for (block, heads) in &self.newest {
            for bit in (0..512).filter(|bit| heads[*bit] != 0) {
                if let Some(wrong) = self.older_at(*block, bit, layer, received) {
                    return Some(wrong);
                }
            }
        }
        None
    }

    fn older_at(
        &self,
        block: BlockIndex,
        bit: usize,
        layer: Option<&Layer>,
        received: &IntervalSet,
    ) -> Option<Wrong> {
        let word = self.words(block, bit).find(|word| received.contains(word.index))?;
        let voxel = voxel_at(block, bit);
        let found = layer.and_then(|layer| layer.get(voxel));
        let is_right = found
            .is_some_and(|(state, stamp)| stamp > word.stamp || (stamp == word.stamp && state == word.state));
        (!is_right).then(|| Wrong {
            voxel,
            expected: format!(
                "{:?} at {:?}, as package {} says, or newer",
                word.state, word.stamp, word.index
            ),
            found: found
                .map_or_else(|| "Unknown".to_owned(), |(state, stamp)| format!("{state:?} at {stamp:?}")),
        })
    }
}

fn voxel_at(block: BlockIndex, bit: usize) -> Voxel {
    let corner = block.corner();
    let [x, y, z] = bit_of(bit);
    let voxel = Voxel::new(corner.x + x, corner.y + y, corner.z + z);
    debug_assert_eq!(voxel_bit(voxel), bit);
    voxel
}
