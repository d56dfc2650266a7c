//! The measures of the office floor, and what it is made of.

/// Metres along x, y, z.
pub(super) const SIZE: [f64; 3] = [35.0, 30.0, 4.0];
/// Top of the floor slab and bottom of the ceiling slab.
pub(super) const FLOOR: f64 = 0.1;
pub(super) const CEILING: f64 = 3.9;
pub(super) const OUTER_WALL: f64 = 0.25;
/// Half the thickness of an inner wall.
pub(super) const HALF_WALL: f64 = 0.075;
/// A rectangle on the floor, in metres.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Rect {
    pub(super) min: [f64; 2],
    pub(super) max: [f64; 2],
}

impl Rect {
    /// From one end to the other along an axis, and along the other one.
    pub(super) const fn across(axis: usize, across: [f64; 2], along: [f64; 2]) -> Self {
        let empty = Self { min: [0.0; 2], max: [0.0; 2] };
        empty.part(axis, across[0], across[1]).part(1 - axis, along[0], along[1])
    }

    pub(super) fn size(&self) -> [f64; 2] {
        [self.max[0] - self.min[0], self.max[1] - self.min[1]]
    }

    pub(super) fn area(&self) -> f64 {
        self.size()[0] * self.size()[1]
    }

    pub(super) fn overlaps(&self, other: &Self) -> bool {
        (0..2).all(|a| self.min[a] < other.max[a] && other.min[a] < self.max[a])
    }

    pub(super) fn centre(&self) -> [f64; 2] {
        [0, 1].map(|a| (self.min[a] + self.max[a]) / 2.0)
    }

    /// Its part from one place to another along an axis.
    pub(super) const fn part(mut self, axis: usize, from: f64, to: f64) -> Self {
        (self.min[axis], self.max[axis]) = (from, to);
        self
    }

    /// Smaller by `margin` on each side.
    pub(super) fn shrunk(&self, margin: f64) -> Self {
        Self { min: self.min.map(|v| v + margin), max: self.max.map(|v| v - margin) }
    }
}

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Use {
    Corridor,
    Hall,
    Office,
    Meeting,
    Storage,
    Lounge,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Room {
    pub(super) rect: Rect,
    pub(super) kind: Use,
}

/// An opening in the wall that lies at `place` of axis `axis` (0: a wall of constant x), centred at `along`
/// on the other axis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Door {
    pub(super) axis: usize,
    pub(super) place: f64,
    pub(super) along: f64,
    pub(super) width: f64,
}

impl Door {
    /// What must stay free of furniture.
    pub(super) fn zone(&self) -> Rect {
        let half = self.width / 2.0 + 0.25;
        let across = [self.place - 1.3, self.place + 1.3];
        Rect::across(self.axis, across, [self.along - half, self.along + half])
    }
}
