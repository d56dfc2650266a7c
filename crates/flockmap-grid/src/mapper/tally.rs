//! How many rays of one scan pass through the voxels of a block, or end there, as far as the rules tell it apart.

use crate::BLOCK_VOXELS;
use fearless_simd::prelude::*;
use fearless_simd::{i16x16, mask16x16};

/// Most steps of rays that are counted at a time.
pub(super) const STEPS_MAX: usize = 32;
/// Rays whose places are counted at a time.
pub(super) const LANES: usize = 8;

/// Counts of the voxels of a block, up to the most that makes a difference.
pub(super) trait Tally: Copy + Send + Sync {
    const ZERO: Self;
    /// One ray more.
    fn add(&mut self, bit: usize);
    /// Those of another thread too.
    fn merge(&mut self, other: &Self);
    /// Sixteen voxels, the n-th time, each up to `most`.
    fn sixteen<S: Simd>(&self, simd: S, n: usize, most: u16) -> i16x16<S>;
}

/// Counts of a scan, by places of voxels ([`Window`](super::window::Window)).
pub(super) trait Tallies: Default + Send + Sync {
    type Block: Tally;
    /// Steps that rays walk before their places are counted, at most [`STEPS_MAX`].
    const STEPS: usize;
    /// All zero, for so many blocks.
    fn begin(&mut self, blocks: usize);
    fn add(&mut self, place: u32);
    fn add_all(&mut self, places: &[[u32; LANES]]);
    /// The numbers of the blocks in which anything was counted are appended to `to`.
    fn end(&mut self, to: &mut Vec<u32>);
    /// What was counted in a block.
    fn block(&self, block: u32) -> Option<&Self::Block>;
}

/// Of a voxel that changes once a scan only whether any ray came.
pub(super) type Once = [u32; 16];

impl Tally for Once {
    const ZERO: Self = [0; 16];

    #[inline(always)]
    fn add(&mut self, bit: usize) {
        self[bit >> 5 & 15] |= 1 << (bit & 31);
    }

    fn merge(&mut self, other: &Self) {
        for (word, other) in self.iter_mut().zip(other) {
            *word |= other;
        }
    }

    #[inline(always)]
    fn sixteen<S: Simd>(&self, simd: S, n: usize, _: u16) -> i16x16<S> {
        let bits = u64::from(self[n / 2] >> (n % 2 * 16) & 0xffff);
        mask16x16::from_bitmask(simd, bits).select(i16x16::splat(simd, 1), i16x16::splat(simd, 0))
    }
}

macro_rules! saturating {
    ($($count:ty),*) => {$(
        impl Tally for [$count; BLOCK_VOXELS] {
            const ZERO: Self = [0; BLOCK_VOXELS];

            #[inline(always)]
            fn add(&mut self, bit: usize) {
                let count = &mut self[bit & (BLOCK_VOXELS - 1)];
                let (more, is_over) = count.overflowing_add(1);
                *count = more.wrapping_sub(<$count>::from(is_over));
            }

            fn merge(&mut self, other: &Self) {
                for (count, other) in self.iter_mut().zip(other) {
                    *count = count.saturating_add(*other);
                }
            }

            #[inline(always)]
            fn sixteen<S: Simd>(&self, simd: S, n: usize, most: u16) -> i16x16<S> {
                let counts: [i16; 16] = core::array::from_fn(|i| u16::from(self[n * 16 + i]).min(most) as i16);
                i16x16::from_slice(simd, &counts)
            }
        }
    )*};
}

saturating!(u8, u16);

/// Bits for all blocks of the window: at 64 bytes a block, that is less than to look up where a block has its counts.
#[derive(Default)]
pub(super) struct Bits {
    words: Vec<u32>,
    blocks: usize,
    touched: Vec<u32>,
}

impl Tallies for Bits {
    type Block = Once;
    const STEPS: usize = 1;

    fn begin(&mut self, blocks: usize) {
        for block in self.touched.drain(..) {
            self.words[block as usize * 16..][..16].fill(0);
        }
        self.blocks = blocks;
        if self.words.len() < blocks * 16 {
            self.words = Vec::new();
            self.words = vec![0; blocks * 16];
        }
    }

    #[inline(always)]
    fn add(&mut self, place: u32) {
        self.words[(place >> 5) as usize] |= 1 << (place & 31);
    }

    #[inline(always)]
    fn add_all(&mut self, places: &[[u32; LANES]]) {
        let words = self.words.as_mut_slice();
        for step in places {
            // Vector instructions as far as that goes.
            let (index, bit) = (step.map(|place| place >> 5), step.map(|place| 1 << (place & 31)));
            for (index, bit) in index.into_iter().zip(bit) {
                words[index as usize] |= bit;
            }
        }
    }

    fn end(&mut self, to: &mut Vec<u32>) {
        let (blocks, _) = self.words[..self.blocks * 16].as_chunks::<16>();
        let touched =
            (0..).zip(blocks).filter(|(_, words)| words.iter().fold(0, |all, word| all | word) != 0);
        self.touched.extend(touched.map(|(block, _)| block));
        to.extend_from_slice(&self.touched);
    }

    fn block(&self, block: u32) -> Option<&Once> {
        self.words.as_chunks().0.get(block as usize)
    }
}

/// Counts of the blocks that are touched, in the order of their first touch, so that memory follows what the scan sees and
/// not the cube around it.
pub(super) struct Pool<T> {
    /// For each block of the window the place of its counts; 0 = not touched yet.
    table: Vec<u32>,
    /// The first is never used, so that 0 means "none".
    counts: Vec<T>,
    touched: Vec<u32>,
}

impl<T> Default for Pool<T> {
    fn default() -> Self {
        Self { table: Vec::new(), counts: Vec::new(), touched: Vec::new() }
    }
}

impl<T: Tally> Tallies for Pool<T> {
    type Block = T;
    const STEPS: usize = 32;

    fn begin(&mut self, blocks: usize) {
        let used = self.counts.len().min(self.touched.len() + 1);
        self.counts[..used].fill(T::ZERO);
        for block in self.touched.drain(..) {
            self.table[block as usize] = 0;
        }
        if self.table.len() < blocks {
            self.table = Vec::new();
            self.table = vec![0; blocks];
        }
    }

    #[inline(always)]
    fn add(&mut self, place: u32) {
        let slot = match self.table[(place >> 9) as usize] {
            0 => self.touch(place),
            slot => slot,
        };
        self.counts[slot as usize].add((place & 511) as usize);
    }

    #[inline(always)]
    fn add_all(&mut self, places: &[[u32; LANES]]) {
        // Slices in locals, so that the loop need not look them up again after every store.
        let (mut table, mut counts) = (self.table.as_slice(), self.counts.as_mut_slice());
        for step in places {
            for place in step {
                let mut slot = table[(place >> 9) as usize];
                if slot == 0 {
                    slot = self.touch(*place);
                    (table, counts) = (self.table.as_slice(), self.counts.as_mut_slice());
                }
                counts[slot as usize].add((place & 511) as usize);
            }
        }
    }

    fn end(&mut self, to: &mut Vec<u32>) {
        to.extend_from_slice(&self.touched);
    }

    fn block(&self, block: u32) -> Option<&T> {
        match self.table.get(block as usize)? {
            0 => None,
            slot => self.counts.get(*slot as usize),
        }
    }
}

impl Pool<Once> {
    pub(super) fn contains(&self, place: u32) -> bool {
        self.block(place >> 9).is_some_and(|bits| bits[(place >> 5 & 15) as usize] >> (place & 31) & 1 == 1)
    }
}

impl<T: Tally> Pool<T> {
    #[cold]
    #[inline(never)]
    fn touch(&mut self, place: u32) -> u32 {
        let block = place >> 9;
        self.touched.push(block);
        let slot = self.touched.len();
        // A quarter at a time: twice of what is used would be waste.
        let (len, capacity) = (self.counts.len(), self.counts.capacity());
        if slot >= len {
            if slot >= capacity {
                self.counts.reserve_exact((slot + 1).max(capacity + capacity / 4) - len);
            }
            self.counts.resize(slot + 1, T::ZERO);
        }
        self.table[block as usize] = slot as u32;
        slot as u32
    }
}
