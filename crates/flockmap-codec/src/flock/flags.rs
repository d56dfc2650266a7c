//! The flags of blocks: whether each changed.

use flockmap_grid::BlockIndex;

use super::block_box::{BlockBox, Places};
use super::known::KnownClasses;
use super::orientation::Orientation;

/// The flags of the blocks of a box, as far as they are coded.
pub(crate) struct Flags<'a> {
    places: Places,
    /// By place: 0 not coded yet, 1 no changes, 2 changes.
    coded: &'a mut [u8],
}

impl<'a> Flags<'a> {
    /// None is coded yet. `coded` is memory to use.
    pub(crate) fn new(region: BlockBox, coded: &'a mut Vec<u8>) -> Self {
        let places = Places::round(region);
        coded.clear();
        coded.resize(places.count, 0);
        Self { places, coded }
    }

    /// The context of the flag of a block of the box: how much of it was known, and which of its neighbours
    /// beyond have changes.
    pub(crate) fn context(&self, block: BlockIndex, orientation: Orientation, known: KnownClasses) -> usize {
        let (place, steps) = (self.places.of(block), self.places.steps);
        let [x, y, z]: [usize; 3] =
            core::array::from_fn(|a| if orientation.is_up[a] { steps[a] } else { steps[a].wrapping_neg() });
        let coded = |step: usize| self.coded.get(place.wrapping_add(step)).copied().unwrap_or(0);
        let is_changed = |step: usize| usize::from(coded(step) == 2);
        let [xy, xz, yz] = [x.wrapping_add(y), x.wrapping_add(z), y.wrapping_add(z)];
        let edges = (is_changed(xy) + is_changed(xz) + is_changed(yz)).min(2);
        let diagonals = edges + is_changed(xy.wrapping_add(z));
        let [x, y, z] = [x, y, z].map(|step| usize::from(coded(step)));
        ((x + 3 * y + 9 * z) * 4 + diagonals) * 21 + known.free * 3 + known.occupied
    }

    pub(crate) fn note(&mut self, block: BlockIndex, is_changed: bool) {
        if let Some(coded) = self.coded.get_mut(self.places.of(block)) {
            *coded = 1 + u8::from(is_changed);
        }
    }
}
