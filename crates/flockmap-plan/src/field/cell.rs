//! The number that holds a squared distance.

/// Voxels that are worked on at a time: neighbours along x.
pub(super) const LANES: usize = 16;

/// One number for each of [`LANES`] neighbours along x.
pub(super) type Group<T> = [T; LANES];

/// A squared distance in voxels: a whole number, or [`Cell::NONE`].
pub(super) trait Cell: Copy + PartialEq + PartialOrd + Send + Sync + 'static {
    /// Of a line without an obstacle. More than any other.
    const NONE: Self;
    /// The square of a number of voxels; [`Cell::NONE`] if there is no room for it.
    fn square(voxels: u16) -> Self;
    /// The sum; [`Cell::NONE`] stays what it is.
    fn plus(self, other: Self) -> Self;
    /// The lesser of both.
    fn lesser(self, other: Self) -> Self;
    /// As a whole number, `None` for [`Cell::NONE`].
    fn whole(self) -> Option<u32>;
    /// From a whole number that fits.
    fn from_whole(whole: u32) -> Self;
}

/// Boxes whose diagonal squared is less than 2¹⁶ − 1, for example 147³ voxels or 180 × 180 × 20.
impl Cell for u16 {
    const NONE: Self = Self::MAX;

    #[inline(always)]
    fn square(voxels: u16) -> Self {
        let low = voxels & 0xFF;
        if voxels > 0xFF { Self::NONE } else { low.wrapping_mul(low) }
    }

    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self.saturating_add(other)
    }

    #[inline(always)]
    fn lesser(self, other: Self) -> Self {
        self.min(other)
    }

    fn whole(self) -> Option<u32> {
        (self != Self::NONE).then(|| self.into())
    }

    fn from_whole(whole: u32) -> Self {
        whole as Self
    }
}

/// All other boxes. Whole numbers below 2²⁴ are exact in an `f32`, and there are instructions for its minimum and
/// its sum on every machine, which there are not for `u32`.
impl Cell for f32 {
    const NONE: Self = Self::INFINITY;

    #[inline(always)]
    fn square(voxels: u16) -> Self {
        let voxels = if voxels == u16::MAX { Self::INFINITY } else { voxels.into() };
        voxels * voxels
    }

    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self + other
    }

    #[inline(always)]
    fn lesser(self, other: Self) -> Self {
        if self < other { self } else { other }
    }

    fn whole(self) -> Option<u32> {
        (self != Self::INFINITY).then_some(self as u32)
    }

    fn from_whole(whole: u32) -> Self {
        whole as Self
    }
}
