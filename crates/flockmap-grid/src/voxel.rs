//! Voxels, blocks of voxels, and axis-aligned boxes of voxels.

use core::fmt;

/// Side of a block in voxels: a block is 8 × 8 × 8 voxels.
pub const BLOCK_SIDE: i32 = 8;

/// Voxel indices are kept within ± this on each axis, so that sums and differences of two never overflow.
/// At 1 cm voxels this is ± 2,684 km.
pub const VOXEL_LIMIT: i32 = 1 << 28;

/// What is known of a voxel.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, Default)]
pub enum State {
    /// Never observed, or observed without a decision.
    #[default]
    Unknown,
    /// Observed to be empty.
    Free,
    /// Observed to hold an obstacle.
    Occupied,
}

/// Index of a voxel in its grid: `floor(position / resolution)` on each axis, in the frame of the grid.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Voxel {
    /// Index along x.
    pub x: i32,
    /// Index along y.
    pub y: i32,
    /// Index along z.
    pub z: i32,
}

impl Voxel {
    /// The voxel at these indices.
    pub const fn new(x: i32, y: i32, z: i32) -> Self {
        Self { x, y, z }
    }

    /// The block that holds this voxel.
    pub const fn block(self) -> BlockIndex {
        BlockIndex { x: self.x >> 3, y: self.y >> 3, z: self.z >> 3 }
    }

    /// The lower of both indices on each axis.
    #[must_use]
    pub fn lowest(self, other: Self) -> Self {
        Self { x: self.x.min(other.x), y: self.y.min(other.y), z: self.z.min(other.z) }
    }

    /// The higher of both indices on each axis.
    #[must_use]
    pub fn highest(self, other: Self) -> Self {
        Self { x: self.x.max(other.x), y: self.y.max(other.y), z: self.z.max(other.z) }
    }

    /// Whether every index is within ± [`VOXEL_LIMIT`].
    pub const fn in_limits(self) -> bool {
        const fn ok(v: i32) -> bool {
            -VOXEL_LIMIT <= v && v <= VOXEL_LIMIT
        }
        ok(self.x) && ok(self.y) && ok(self.z)
    }
}

impl fmt::Debug for Voxel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "({}, {}, {})", self.x, self.y, self.z)
    }
}

/// Index of a block of 8³ voxels: voxel index divided by 8, rounded down, on each axis.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct BlockIndex {
    /// Index along x.
    pub x: i32,
    /// Index along y.
    pub y: i32,
    /// Index along z.
    pub z: i32,
}

impl BlockIndex {
    /// The block at these indices.
    pub const fn new(x: i32, y: i32, z: i32) -> Self {
        Self { x, y, z }
    }

    /// The voxel at the block's lowest corner.
    pub const fn corner(self) -> Voxel {
        Voxel { x: self.x * BLOCK_SIDE, y: self.y * BLOCK_SIDE, z: self.z * BLOCK_SIDE }
    }

    /// The box of all 512 voxels of the block.
    pub const fn voxel_box(self) -> VoxelBox {
        VoxelBox { min: self.corner(), size: [BLOCK_SIDE as u32; 3] }
    }
}

impl fmt::Debug for BlockIndex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "block ({}, {}, {})", self.x, self.y, self.z)
    }
}

/// An axis-aligned box of voxels that holds at least one voxel and lies within ± [`VOXEL_LIMIT`].
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct VoxelBox {
    min: Voxel,
    size: [u32; 3],
}

impl VoxelBox {
    /// The box with its lowest voxel at `min` and `size` voxels along x, y, z.
    /// `None` if a size is zero or a corner lies outside ± [`VOXEL_LIMIT`].
    pub fn new(min: Voxel, size: [u32; 3]) -> Option<Self> {
        let limit = i64::from(VOXEL_LIMIT);
        let fits = |low: i32, size: u32| {
            size > 0 && i64::from(low) >= -limit && i64::from(low) + i64::from(size) - 1 <= limit
        };
        (fits(min.x, size[0]) && fits(min.y, size[1]) && fits(min.z, size[2])).then_some(Self { min, size })
    }

    /// The smallest box that holds both voxels. `None` if one lies outside ± [`VOXEL_LIMIT`].
    pub fn spanning(a: Voxel, b: Voxel) -> Option<Self> {
        (a.in_limits() && b.in_limits()).then(|| Self::between(a.lowest(b), a.highest(b)))
    }

    /// From the lowest to the highest voxel, both within ± [`VOXEL_LIMIT`].
    fn between(min: Voxel, max: Voxel) -> Self {
        let size = [(min.x, max.x), (min.y, max.y), (min.z, max.z)];
        Self { min, size: size.map(|(min, max)| (max - min) as u32 + 1) }
    }

    /// The lowest voxel.
    pub const fn min(&self) -> Voxel {
        self.min
    }

    /// The highest voxel; it belongs to the box.
    pub const fn max(&self) -> Voxel {
        Voxel {
            x: self.min.x + (self.size[0] as i32 - 1),
            y: self.min.y + (self.size[1] as i32 - 1),
            z: self.min.z + (self.size[2] as i32 - 1),
        }
    }

    /// Voxels along x, y, z.
    pub const fn size(&self) -> [u32; 3] {
        self.size
    }

    /// Number of voxels; at most 2⁸⁷, hence 128 bits.
    pub fn volume(&self) -> u128 {
        self.size.iter().map(|&s| u128::from(s)).product()
    }

    /// Whether the voxel belongs to the box.
    pub fn contains(&self, v: Voxel) -> bool {
        let (min, max) = (self.min, self.max());
        (min.x..=max.x).contains(&v.x) && (min.y..=max.y).contains(&v.y) && (min.z..=max.z).contains(&v.z)
    }

    /// The voxels that belong to both boxes.
    pub fn intersection(&self, other: &Self) -> Option<Self> {
        let (min, max) = (self.min.highest(other.min), self.max().lowest(other.max()));
        (min.x <= max.x && min.y <= max.y && min.z <= max.z).then(|| Self::between(min, max))
    }

    /// The smallest box that holds both boxes.
    pub fn union(&self, other: &Self) -> Self {
        Self::between(self.min.lowest(other.min), self.max().highest(other.max()))
    }

    /// All voxels in nested order: x slowest, z fastest (the paper's "nested iteration").
    pub fn voxels(&self) -> impl Iterator<Item = Voxel> + use<> {
        let (min, max) = (self.min, self.max());
        (min.x..=max.x).flat_map(move |x| {
            (min.y..=max.y).flat_map(move |y| (min.z..=max.z).map(move |z| Voxel { x, y, z }))
        })
    }

    /// All blocks that share voxels with the box, in ascending order.
    pub fn blocks(&self) -> impl Iterator<Item = BlockIndex> + use<> {
        let (min, max) = (self.min.block(), self.max().block());
        (min.x..=max.x).flat_map(move |x| {
            (min.y..=max.y).flat_map(move |y| (min.z..=max.z).map(move |z| BlockIndex { x, y, z }))
        })
    }
}

impl fmt::Debug for VoxelBox {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "box {:?} size {} × {} × {}", self.min, self.size[0], self.size[1], self.size[2])
    }
}

/// Side of a voxel. Held as a whole number of micrometres so that two robots always agree on it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(try_from = "f64", into = "f64"))]
pub struct Resolution {
    micrometres: u32,
}

impl Resolution {
    /// A side in micrometres, 1,000 (1 mm) to 100,000,000 (100 m). `None` outside of that.
    pub const fn from_micrometres(micrometres: u32) -> Option<Self> {
        if 1_000 <= micrometres && micrometres <= 100_000_000 { Some(Self { micrometres }) } else { None }
    }

    /// A side in metres, 0.001 to 100, rounded to a micrometre. `None` outside of that, or if not a number.
    pub fn from_metres(metres: f64) -> Option<Self> {
        if (0.001..=100.0).contains(&metres) {
            Self::from_micrometres((metres * 1e6).round() as u32)
        } else {
            None
        }
    }

    /// The side in micrometres.
    pub const fn micrometres(self) -> u32 {
        self.micrometres
    }

    /// The side in metres.
    pub fn metres(self) -> f64 {
        f64::from(self.micrometres) / 1e6
    }

    /// The voxel that holds a point (metres, in the frame of the grid).
    /// `None` if the point is not finite or lies outside ± [`VOXEL_LIMIT`] voxels.
    pub fn voxel_at(self, point: [f64; 3]) -> Option<Voxel> {
        let scale = 1e6 / f64::from(self.micrometres);
        let index = |p: f64| {
            let i = (p * scale).floor();
            (i.abs() <= f64::from(VOXEL_LIMIT)).then_some(i as i32)
        };
        Some(Voxel { x: index(point[0])?, y: index(point[1])?, z: index(point[2])? })
    }

    /// The centre of a voxel, in metres.
    pub fn centre(self, voxel: Voxel) -> [f64; 3] {
        let side = self.metres();
        [voxel.x, voxel.y, voxel.z].map(|i| (f64::from(i) + 0.5) * side)
    }
}

impl fmt::Debug for Resolution {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} m", self.metres())
    }
}
