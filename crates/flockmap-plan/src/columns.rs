//! The columns of a box, seen from above: in tiles of 8 × 8, each a word, as the slices of blocks are.

use core::ops::Range;

use flockmap_grid::{BlockIndex, VoxelBox, plane_within};

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
        let (z, [nx, ny]) = (self.region.min().z, self.tiles);
        for ty in 0..ny {
            // Between the first and the last tile of a row that is all inside there is nothing to trim.
            let step = if ty == 0 || ty + 1 == ny { 1 } else { nx.max(2) - 1 };
            for tx in (0..nx).step_by(step) {
                let index = BlockIndex::new(self.low[0] + tx as i32, self.low[1] + ty as i32, z >> 3);
                let inside = plane_within(index, self.region.min(), self.region.max());
                words[ty * nx + tx] &= inside[(z & 7) as usize];
            }
        }
    }
}
