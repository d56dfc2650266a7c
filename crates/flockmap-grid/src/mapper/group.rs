//! Eight rays that walk in step, by vector instructions.
//!
//! Where a ray is, is one number with interleaved fields, `[block z][block y][block x][z][y][x]`, three bits each for the
//! place in the block; a step adds to one field and lets the carry run through the bits between.

use super::ray::Ray;
use super::tally::LANES;
use super::window::Window;
use crate::Voxel;
use fearless_simd::prelude::*;
use fearless_simd::{f64x8, i32x8, u32x8};

/// Times along a ray are whole numbers: this is the end of the ray.
const ONE: f64 = (1u32 << 29) as f64;

/// Longer than any ray: the face of an axis that a ray does not move along. One step past the end of the ray
/// plus this still fits 32 bits.
const NEVER: f64 = (1u32 << 30) as f64;

/// Where all rays of a scan begin.
#[derive(Clone, Copy)]
pub(super) struct Start {
    at: [f64; 3],
    /// In the voxel, from its lower faces.
    fraction: [f64; 3],
    place: u32,
    pub(super) masks: [u32; 3],
}

impl Start {
    pub(super) fn new(at: [f64; 3], voxel: Voxel, window: &Window) -> Self {
        let from = [voxel.x, voxel.y, voxel.z];
        let [x, y, z] = window.place(voxel);
        Self {
            at,
            fraction: core::array::from_fn(|axis| at[axis] - f64::from(from[axis])),
            place: x | y | z,
            masks: window.masks,
        }
    }
}

/// 1.5 · 2⁵²: added to a whole number of 32 bits, it leaves that number in the low bits of the float.
const WHOLE: f64 = 6_755_399_441_055_744.0;

/// Whole numbers of at most 32 bits as integers; of others the low bits, or any.
#[inline(always)]
pub(super) fn integers<S: Simd>(simd: S, whole: f64x8<S>) -> [i32; LANES] {
    let mut shifted = [0.0; LANES];
    (whole + f64x8::splat(simd, WHOLE)).store_slice(&mut shifted);
    shifted.map(|value| value.to_bits() as i32)
}

/// Rays that walk in step.
pub(super) struct Group<S: Simd> {
    simd: S,
    place: u32x8<S>,
    /// Added to a field of the place for one step along its axis.
    step: [u32x8<S>; 3],
    /// When the ray next crosses a face of each axis.
    next: [i32x8<S>; 3],
    /// Time between two crossings of each axis.
    delta: [i32x8<S>; 3],
    masks: [u32x8<S>; 3],
}

impl<S: Simd> Group<S> {
    #[inline(always)]
    pub(super) fn new(simd: S, start: &Start, rays: [&Ray; LANES]) -> Self {
        let mut step = [u32x8::splat(simd, 0); 3];
        let mut next = [i32x8::splat(simd, 0); 3];
        let mut delta = next;
        let all = |value: f64| f64x8::splat(simd, value);
        for axis in 0..3 {
            let end = f64x8::from_slice(simd, &rays.map(|ray| ray.end[axis]));
            let direction = end - all(start.at[axis]);
            let is_up = direction.simd_gt(all(0.0));
            let inverse = all(ONE) / direction.abs();
            let to_face = is_up.select(all(1.0 - start.fraction[axis]), all(start.fraction[axis]));
            // A direction of zero gives an infinite inverse, and 0 · ∞ is not a number, and so not less.
            let time = |time: f64x8<S>| {
                let at_most = time.simd_lt(all(NEVER)).select(time, all(NEVER));
                i32x8::from_slice(simd, &integers(simd, (at_most + all(0.5)).floor()))
            };
            next[axis] = time(to_face * inverse);
            delta[axis] = time(inverse);
            let unit = 1u32 << (3 * axis);
            let (up, down) = ((!start.masks[axis]).wrapping_add(unit), unit.wrapping_neg());
            let is_up = is_up.to_bitmask();
            step[axis] = u32x8::from_slice(
                simd,
                &core::array::from_fn::<_, LANES, _>(|lane| if is_up >> lane & 1 == 1 { up } else { down }),
            );
        }
        let masks = start.masks.map(|mask| u32x8::splat(simd, mask));
        Self { simd, place: u32x8::splat(simd, start.place), step, next, delta, masks }
    }

    /// Says where the rays are, and walks them on by a voxel.
    #[inline(always)]
    pub(super) fn advance(&mut self, at: &mut [u32; LANES]) {
        let ([x, y, z], masks, step, place) = (self.next, self.masks, self.step, self.place);
        place.store_slice(at);
        let later_x = x.simd_gt(y.min(z));
        let later_y = y.simd_gt(z);
        let mask = later_x.select(later_y.select(masks[2], masks[1]), masks[0]);
        let by = later_x.select(later_y.select(step[2], step[1]), step[0]);
        self.place = place ^ ((place ^ ((place & mask) + by)) & mask);
        let none = i32x8::splat(self.simd, 0);
        self.next[0] = x + later_x.select(none, self.delta[0]);
        self.next[1] = y + (!later_y & later_x).select(self.delta[1], none);
        self.next[2] = z + (later_x & later_y).select(self.delta[2], none);
    }

    /// Each ray by itself.
    #[inline(always)]
    pub(super) fn walks(&self) -> [Walk; LANES] {
        let mut place = [0; LANES];
        self.place.store_slice(&mut place);
        let (mut step, mut next, mut delta) = ([[0; LANES]; 3], [[0; LANES]; 3], [[0; LANES]; 3]);
        for axis in 0..3 {
            self.step[axis].store_slice(&mut step[axis]);
            self.next[axis].store_slice(&mut next[axis]);
            self.delta[axis].store_slice(&mut delta[axis]);
        }
        core::array::from_fn(|lane| Walk {
            place: place[lane],
            step: step.map(|of| of[lane]),
            next: next.map(|of| of[lane]),
            delta: delta.map(|of| of[lane]),
        })
    }
}

/// One ray that walks.
#[derive(Clone, Copy)]
pub(super) struct Walk {
    place: u32,
    step: [u32; 3],
    next: [i32; 3],
    delta: [i32; 3],
}

impl Walk {
    /// Says where it is, and walks on by a voxel.
    #[inline(always)]
    pub(super) fn advance(&mut self, masks: &[u32; 3]) -> u32 {
        let at = self.place;
        let [x, y, z] = self.next;
        let axis = if x <= y && x <= z {
            0
        } else if y <= z {
            1
        } else {
            2
        };
        self.next[axis] = self.next[axis].wrapping_add(self.delta[axis]);
        let moved = (at & masks[axis]).wrapping_add(self.step[axis]);
        self.place = at ^ (at ^ moved) & masks[axis];
        at
    }
}
