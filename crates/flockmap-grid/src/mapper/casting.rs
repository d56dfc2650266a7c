//! The rays of a scan, with counts as small as the rules allow.

use super::config::Rules;
use super::rays::Rays;
use super::tally::{Bits, Pool};
use crate::BLOCK_VOXELS;

/// By how often a voxel can count in one scan.
pub(super) enum Casting {
    Once(Rays<Bits>),
    Bytes(Rays<Pool<[u8; BLOCK_VOXELS]>>),
    Words(Rays<Pool<[u16; BLOCK_VOXELS]>>),
}

impl Casting {
    pub(super) fn new(rules: &Rules, threads: usize) -> Self {
        match rules.rays_max {
            0..=1 => Self::Once(Rays::new(threads)),
            2..=255 => Self::Bytes(Rays::new(threads)),
            _ => Self::Words(Rays::new(threads)),
        }
    }
}

/// What stands in its place while a scan is taken in: it can take in none.
impl Default for Casting {
    fn default() -> Self {
        Self::Once(Rays::new(0))
    }
}
