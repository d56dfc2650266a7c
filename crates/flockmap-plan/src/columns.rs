//! The columns of a box, seen from above: in tiles of 8 × 8, each a word, as the slices of blocks are.

use core::ops::Range;

use flockmap_grid::{BlockIndex, VoxelBox};

use crate::space::TooLarge;

/// The tiles of a box. The bit of a column in the word of its tile is that of its voxels in the slices of a block.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Columns {
    region: VoxelBox,
    /// The lowest tile.
    low: [i32; 2],
    /// Tiles along x and y.
    tiles: [usize; 2],
}

impl Columns {
    /// The columns of a box. At most `max` in whole tiles.
    pub(crate) fn new(what: &'static str, region: &VoxelBox, max: u64) -> Result<Self, TooLarge> {
        let (low, high) = (region.min().block(), region.max().block());
        let tiles = [(low.x, high.x), (low.y, high.y)].map(|(low, high)| high.abs_diff(low) + 1);
        TooLarge::check(what, region, u128::from(tiles[0]) * u128::from(tiles[1]) * 64, max)?;
        Ok(Self { region: *region, low: [low.x, low.y], tiles: tiles.map(|n| n as usize) })
    }

    /// The box.
    pub(crate) const fn region(&self) -> &VoxelBox {
        &self.region
    }

    /// Columns along x and y.
    pub(crate) const fn size(&self) -> [usize; 2] {
        let [width, height, _] = self.region.size();
        [width as usize, height as usize]
    }

    /// Tiles along x and y.
    pub(crate) const fn tiles(&self) -> [usize; 2] {
        self.tiles
    }

    /// The columns of the first tile that lie before the box, along x and y.
    pub(crate) const fn before(&self) -> [usize; 2] {
        [(self.region.min().x & 7) as usize, (self.region.min().y & 7) as usize]
    }

    /// The number of the tile above and below a block of the box.
    pub(crate) const fn tile_of(&self, block: BlockIndex) -> usize {
        (block.y - self.low[1]) as usize * self.tiles[0] + (block.x - self.low[0]) as usize
    }

    /// The number of the tile of a column and its bit; `None` outside of the box.
    pub(crate) fn bit_of(&self, x: usize, y: usize) -> Option<(usize, u32)> {
        let [width, height] = self.size();
        (x < width && y < height).then(|| {
            let [before_x, before_y] = self.before();
            let (x, y) = (before_x + x, before_y + y);
            (y / 8 * self.tiles[0] + x / 8, (y % 8 * 8 + x % 8) as u32)
        })
    }

    /// The slices of a block that lie in the box.
    pub(crate) fn slices(&self, block: BlockIndex) -> Range<usize> {
        let corner = block.corner().z;
        let [from, to] = [self.region.min().z - corner, self.region.max().z - corner + 1];
        from.clamp(0, 8) as usize..to.clamp(0, 8) as usize
    }

    /// Layers of blocks in the box.
    pub(crate) const fn layers(&self) -> u32 {
        self.region.max().block().z.abs_diff(self.region.min().block().z) + 1
    }

    /// Takes the columns outside of the box out of the words.
    pub(crate) fn trim(&self, words: &mut [u64]) {
        /// The first column of each row of a tile.
        const FIRST_X: u64 = 0x0101_0101_0101_0101;
        let ([nx, ny], before, size) = (self.tiles, self.before(), self.size());
        let after = [nx * 8 - before[0] - size[0], ny * 8 - before[1] - size[1]];
        for row in words.chunks_exact_mut(nx) {
            row[0] &= FIRST_X * (0xff << before[0] & 0xff);
            row[nx - 1] &= FIRST_X * (0xff >> after[0]);
        }
        words[..nx].iter_mut().for_each(|word| *word &= u64::MAX << (8 * before[1]));
        words[nx * (ny - 1)..].iter_mut().for_each(|word| *word &= u64::MAX >> (8 * after[1]));
    }
}
