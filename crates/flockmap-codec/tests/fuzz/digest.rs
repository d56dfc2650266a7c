//! A digest of what codecs wrote and read.

use flockmap_codec::Content;
use flockmap_grid::{Changes, Stamp};

/// FNV-1a over 64 bits.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Digest(pub(crate) u64);

impl Default for Digest {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Digest {
    pub(crate) fn add(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }

    pub(crate) fn add_content(&mut self, content: &Content) {
        match content {
            Content::Changes(changes) => self.add_changes(changes),
            Content::Snapshot(state) => {
                for (Stamp(stamp), part) in &state.parts {
                    self.add(&stamp.to_le_bytes());
                    self.add_changes(part);
                }
            }
        }
    }

    fn add_changes(&mut self, changes: &Changes) {
        for (index, block) in changes.blocks() {
            for at in [index.x, index.y, index.z] {
                self.add(&at.to_le_bytes());
            }
            for word in block.free().iter().chain(block.occupied()) {
                self.add(&word.to_le_bytes());
            }
        }
    }
}
