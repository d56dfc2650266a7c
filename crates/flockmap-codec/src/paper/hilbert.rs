//! The Hilbert walk over a box of any size (Sec. III-C of the paper): every voxel once, each step to a direct
//! neighbour, no enclosing cube of a power of two.
//!
//! The paper does not say how its curve fits a box whose sides are no powers of two. This is the subdivision
//! of "gilbert++", the generalised Hilbert curve by Jakub Červený and abetusk
//! (github.com/jakubcerveny/gilbert), with the axes ordered so that a walk without jumps exists
//! ("Hamiltonian"): the walk goes from one corner to the next along its first axis, and by the colours of a
//! chessboard that is possible only if this side is even or all sides are odd.
//!
//! Written for speed: positions are linear indices into a dense grid, directions are index strides, and where
//! all sides are at most [`LEAF_SIDE`] the steps come from a table.

use std::sync::OnceLock;

use crate::limits::BOX_VOXELS_MAX;

/// Sub-boxes with no side longer than this are walked by table.
const LEAF_SIDE: usize = 8;

/// The order in which the Hilbert walk visits a box of `size` voxels along x, y, z: for each step the voxel's
/// place in the box. For tests, pictures and other implementations; the codecs walk without making this list.
///
/// Holds 12 bytes a voxel. Empty if a side is zero or the box has more than [`BOX_VOXELS_MAX`] voxels.
pub fn hilbert_order(size: [u32; 3]) -> Vec<[u32; 3]> {
    let volume: u128 = size.iter().map(|&side| u128::from(side)).product();
    if volume > u128::from(BOX_VOXELS_MAX) {
        return Vec::new();
    }
    let size = size.map(|side| side as usize);
    let mut order = Vec::with_capacity(volume as usize);
    walk(size, |leaf| {
        leaf.for_each(|index| {
            let (xy, x) = (index / size[0], index % size[0]);
            order.push([x as u32, (xy % size[1]) as u32, (xy / size[1]) as u32]);
        });
    });
    order
}

/// A piece of the walk: a first voxel and the steps from it, in linear indices with x fastest, then y, then
/// z.
#[derive(Clone, Copy)]
pub(crate) struct Leaf<'t> {
    first: usize,
    walk: &'t Walk,
    /// Index difference of each step number. Two of the eight are not used; so no step can be out of range.
    strides: [usize; 8],
}

impl Leaf<'_> {
    /// Number of voxels.
    pub(crate) fn len(&self) -> usize {
        self.walk.places.len()
    }

    /// Calls `visit` with the linear index of each voxel in turn.
    #[inline]
    pub(crate) fn for_each(&self, mut visit: impl FnMut(usize)) {
        let mut index = self.first;
        visit(index);
        for &step in &self.walk.steps {
            index = index.wrapping_add(self.strides[usize::from(step & 7)]);
            visit(index);
        }
    }

    /// The voxel that [`Self::for_each`] gives after so many others.
    #[inline]
    pub(crate) fn voxel(&self, step: usize) -> usize {
        let place = self.walk.places.get(step).copied().unwrap_or(0) as usize;
        let along = |axis: usize| (place >> (3 * axis) & 7).wrapping_mul(self.strides[2 * axis]);
        self.first.wrapping_add(along(0)).wrapping_add(along(1)).wrapping_add(along(2))
    }
}

/// Walks a box of `size` voxels along x, y, z; gives the pieces of the walk in order.
/// `size` must have at most 2³¹ voxels; a side of zero gives no piece.
pub(crate) fn walk(size: [usize; 3], visit: impl FnMut(Leaf<'_>)) {
    let strides = [1, size[0] as isize, (size[0] * size[1]) as isize];
    walk_with(size, strides, &mut All(visit));
}

/// The same, with voxels as [`Places`] has them.
pub(crate) fn walk_places(size: [usize; 3], visit: impl FnMut(Leaf<'_>)) {
    walk_with(size, Places::of(size).strides(), &mut All(visit));
}

/// Walks the parts of a box in which `pick` wants a voxel; it gets the pieces of the walk in order, with
/// voxels as [`Places`] has them. What lies between takes no time that goes with its size.
pub(crate) fn walk_some(size: [usize; 3], pick: &mut impl Pick) {
    walk_with(size, Places::of(size).strides(), pick);
}

fn walk_with(size: [usize; 3], strides: [isize; 3], pick: &mut impl Pick) {
    if size.contains(&0) {
        return;
    }
    let axes = [0, 1, 2].map(|axis| Axis { len: size[axis], stride: strides[axis] });
    let [a, b, c] = order_axes(axes);
    Walker { tables: tables(), pick, passed: 0 }.solid(0, a, b, c);
}

/// Who goes along the walk.
pub(crate) trait Pick {
    /// The first step from `step` on, numbered from 0, that is wanted. `step` never descends.
    fn next(&mut self, step: usize) -> usize;
    /// A piece of the walk that has a wanted step, and the number of its first.
    fn leaf(&mut self, step: usize, leaf: &Leaf<'_>);
}

/// Every step.
struct All<F>(F);

impl<F: FnMut(Leaf<'_>)> Pick for All<F> {
    #[inline(always)]
    fn next(&mut self, step: usize) -> usize {
        step
    }

    #[inline(always)]
    fn leaf(&mut self, _: usize, leaf: &Leaf<'_>) {
        (self.0)(*leaf);
    }
}

/// The voxels of a box as numbers from which their places are read without dividing: x in the lowest bits,
/// above it y, then z.
#[derive(Clone, Copy)]
pub(crate) struct Places {
    bits: [u32; 2],
}

impl Places {
    pub(crate) fn of(size: [usize; 3]) -> Self {
        Self { bits: [size[0], size[1]].map(|side| usize::BITS - side.leading_zeros()) }
    }

    fn strides(self) -> [isize; 3] {
        [1, 1 << self.bits[0], 1 << (self.bits[0] + self.bits[1])]
    }

    #[inline(always)]
    pub(crate) fn place(self, number: usize) -> [i32; 3] {
        let [x, y] = self.bits;
        let low = |number: usize, bits: u32| number & ((1 << bits) - 1);
        [low(number, x), low(number >> x, y), number >> (x + y)].map(|at| at as i32)
    }
}

/// Puts the axis along which the walk as a whole goes first: the longest even one, else (all odd) the
/// longest. Of the others the longer one comes first. Ties: x before y before z.
fn order_axes(mut axes: [Axis; 3]) -> [Axis; 3] {
    axes.sort_by_key(|axis| core::cmp::Reverse(axis.len));
    if let Some(even) = axes.iter().position(|axis| axis.is_even()) {
        axes[..=even].rotate_right(1);
    }
    axes
}

/// No side.
const POINT: Axis = Axis { len: 1, stride: 0 };

/// A side of a sub-box: how many voxels, and the index difference of a step along it. The walk begins at the
/// corner from which all three strides lead into the sub-box, and ends at the far end of the first axis.
#[derive(Clone, Copy)]
struct Axis {
    len: usize,
    stride: isize,
}

impl Axis {
    /// The first `len` voxels along the axis.
    fn head(self, len: usize) -> Self {
        Self { len, ..self }
    }

    /// What is left after the first `len` voxels.
    fn tail(self, len: usize) -> Self {
        Self { len: self.len - len, ..self }
    }

    /// The same side walked backwards.
    fn back(self) -> Self {
        Self { stride: -self.stride, ..self }
    }

    /// Index difference from the first voxel to number `place`.
    fn at(self, place: usize) -> isize {
        place as isize * self.stride
    }

    /// Index difference from the first voxel to the last.
    fn end(self) -> isize {
        self.at(self.len - 1)
    }

    fn is_even(self) -> bool {
        self.len.is_multiple_of(2)
    }
}

/// About one of so many parts, with this remainder by two where it can be.
fn part(len: usize, parts: usize, parity: usize) -> usize {
    let part = len / parts;
    if len > 2 && part % 2 != parity { part + 1 } else { part }
}

fn half_even(len: usize) -> usize {
    part(len, 2, 0)
}

fn half_odd(len: usize) -> usize {
    part(len, 2, 1)
}

fn third_even(len: usize) -> usize {
    part(len, 3, 0)
}

struct Walker<'t, 'p, P> {
    tables: &'t Tables,
    pick: &'p mut P,
    /// Steps of the walk so far.
    passed: usize,
}

impl<P: Pick> Walker<'_, '_, P> {
    /// Goes by so many voxels if none of them is wanted.
    #[inline(always)]
    fn passes(&mut self, voxels: usize) -> bool {
        let passes = self.pick.next(self.passed) >= self.passed + voxels;
        if passes {
            self.passed += voxels;
        }
        passes
    }

    /// A sub-box: by table if it is small, else cut into two to five parts whose walks join.
    fn solid(&mut self, from: isize, a: Axis, b: Axis, c: Axis) {
        if self.passes(a.len * b.len * c.len) {
            return;
        }
        if let Some(walk) = self.tables.walk(a.len, b.len, c.len) {
            return self.leaf(from, walk, a, b, c);
        }
        self.divide(from, a, b, c);
    }

    fn leaf(&mut self, from: isize, walk: &Walk, a: Axis, b: Axis, c: Axis) {
        let strides =
            [a.stride, -a.stride, b.stride, -b.stride, c.stride, -c.stride, 0, 0].map(|s| s as usize);
        let leaf = Leaf { first: from as usize, walk, strides };
        self.pick.leaf(self.passed, &leaf);
        self.passed += leaf.len();
    }

    fn divide(&mut self, from: isize, a: Axis, b: Axis, c: Axis) {
        if a.len == 1 {
            self.flat(from, b, c);
        } else if b.len == 1 {
            self.flat(from, a, c);
        } else if c.len == 1 {
            self.flat(from, a, b);
        } else if 3 * a.len > 5 * b.len && 3 * a.len > 5 * c.len {
            self.long_first(from, a, b, c);
        } else if 2 * b.len > 3 * c.len || 2 * b.len > 3 * a.len {
            self.long_second(from, a, b, c);
        } else if 2 * c.len > 3 * b.len {
            self.long_third(from, a, b, c);
        } else if c.is_even() {
            self.bulk_third_even(from, a, b, c);
        } else if a.is_even() || b.is_even() {
            self.bulk_third_odd(from, a, b, c);
        } else {
            self.bulk_all_odd(from, a, b, c);
        }
    }

    fn long_first(&mut self, from: isize, a: Axis, b: Axis, c: Axis) {
        let a2 = half_even(a.len);
        self.solid(from, a.head(a2), b, c);
        self.solid(from + a.at(a2), a.tail(a2), b, c);
    }

    fn long_second(&mut self, from: isize, a: Axis, b: Axis, c: Axis) {
        let (a2, b3) = (half_even(a.len), third_even(b.len));
        self.solid(from, b.head(b3), c, a.head(a2));
        self.solid(from + b.at(b3), a, b.tail(b3), c);
        self.solid(from + a.end() + b.at(b3 - 1), b.head(b3).back(), c, a.tail(a2).back());
    }

    fn long_third(&mut self, from: isize, a: Axis, b: Axis, c: Axis) {
        let (a2, c3) = (half_even(a.len), third_even(c.len));
        self.solid(from, c.head(c3), a.head(a2), b);
        self.solid(from + c.at(c3), a, b, c.tail(c3));
        self.solid(from + a.end() + c.at(c3 - 1), c.head(c3).back(), a.tail(a2).back(), b);
    }

    fn bulk_third_even(&mut self, from: isize, a: Axis, b: Axis, c: Axis) {
        let (a2, b2, c2) = (half_even(a.len), half_even(b.len), half_even(c.len));
        self.solid(from, b.head(b2), c.head(c2), a.head(a2));
        self.solid(from + b.at(b2), c, a.head(a2), b.tail(b2));
        self.solid(from + b.at(b2 - 1) + c.end(), a, b.head(b2).back(), c.tail(c2).back());
        self.solid(from + a.end() + b.at(b2) + c.end(), c.back(), a.tail(a2).back(), b.tail(b2));
        self.solid(from + a.end() + b.at(b2 - 1), b.head(b2).back(), c.head(c2), a.tail(a2).back());
    }

    fn bulk_third_odd(&mut self, from: isize, a: Axis, b: Axis, c: Axis) {
        let (a2, b2, c2) = (half_odd(a.len), half_even(b.len), half_even(c.len));
        self.solid(from, c.head(c2), a.head(a2), b.head(b2));
        self.solid(from + c.at(c2), b, c.tail(c2), a.head(a2));
        self.solid(from + c.at(c2 - 1) + b.end(), a, b.tail(b2).back(), c.head(c2).back());
        self.solid(from + a.end() + b.end() + c.at(c2), b.back(), c.tail(c2), a.tail(a2).back());
        self.solid(from + a.end() + c.at(c2 - 1), c.head(c2).back(), a.tail(a2).back(), b.head(b2));
    }

    fn bulk_all_odd(&mut self, from: isize, a: Axis, b: Axis, c: Axis) {
        let (a2, b2, c2) = (half_odd(a.len), half_even(b.len), half_even(c.len));
        self.solid(from, b.head(b2), c, a.head(a2));
        self.solid(from + b.at(b2), c.head(c2), a, b.tail(b2));
        self.solid(from + b.at(b2) + c.at(c2), a, b.tail(b2), c.tail(c2));
        self.solid(
            from + a.end() + b.at(b2 - 1) + c.at(c2),
            b.head(b2).back(),
            c.tail(c2),
            a.tail(a2).back(),
        );
        self.solid(from + a.end() + c.at(c2 - 1), c.head(c2).back(), a.tail(a2).back(), b.head(b2));
    }

    /// A sub-box with one side of 1: the walk in the plane of the other two.
    fn flat(&mut self, from: isize, a: Axis, b: Axis) {
        if self.passes(a.len * b.len) {
            return;
        }
        if let Some(walk) = self.tables.walk(a.len, b.len, 1) {
            return self.leaf(from, walk, a, b, POINT);
        }
        if b.len == 1 {
            return self.line(from, a);
        }
        if a.len == 1 {
            return self.line(from, b);
        }
        if 2 * a.len > 3 * b.len {
            let a2 = half_even(a.len);
            self.flat(from, a.head(a2), b);
            self.flat(from + a.at(a2), a.tail(a2), b);
        } else {
            let (a2, b2) = (a.len / 2, half_even(b.len));
            self.flat(from, b.head(b2), a.head(a2));
            self.flat(from + b.at(b2), a, b.tail(b2));
            self.flat(from + a.end() + b.at(b2 - 1), b.head(b2).back(), a.tail(a2).back());
        }
    }

    fn line(&mut self, from: isize, a: Axis) {
        let mut start = 0;
        while start < a.len {
            // Straight to the next that is wanted: a line may be as long as the largest box.
            let ahead = self.pick.next(self.passed).saturating_sub(self.passed).min(a.len - start);
            let ahead = ahead - if ahead < a.len - start { ahead % LEAF_SIDE } else { 0 };
            (start, self.passed) = (start + ahead, self.passed + ahead);
            let part = a.head(LEAF_SIDE.min(a.len - start));
            if part.len == 0 {
                break;
            }
            if let Some(walk) = self.tables.walk(part.len, 1, 1) {
                self.leaf(from + a.at(start), walk, part, POINT, POINT);
            }
            start += part.len;
        }
    }
}

/// The walks of every size of small box. About 150 KB, made at first use in about a millisecond.
struct Tables {
    walks: Vec<Option<Walk>>,
}

/// A walk of a small box.
struct Walk {
    /// From each voxel to the next: 0, 1 forward and back along the first axis, 2, 3 along the second, 4, 5
    /// along the third.
    steps: Box<[u8]>,
    /// Each voxel: its places along the three axes, three bits each, that of the first lowest.
    places: Box<[u16]>,
}

fn tables() -> &'static Tables {
    static TABLES: OnceLock<Tables> = OnceLock::new();
    TABLES.get_or_init(Tables::new)
}

impl Tables {
    /// Every table is made from those of smaller boxes by the same rules as a large box: first lines, then
    /// planes, then solids, each in order of volume.
    fn new() -> Self {
        let walks = std::iter::repeat_with(|| None).take(LEAF_SIDE * LEAF_SIDE * LEAF_SIDE);
        let mut tables = Self { walks: walks.collect() };
        for len in 1..=LEAF_SIDE {
            let (steps, places) = (vec![0; len - 1].into(), (0..len as u16).collect());
            tables.walks[Self::place(len, 1, 1)] = Some(Walk { steps, places });
        }
        let sides = || 1..=LEAF_SIDE;
        let mut sizes: Vec<[usize; 3]> =
            sides().flat_map(|a| sides().flat_map(move |b| sides().map(move |c| [a, b, c]))).collect();
        sizes.sort_by_key(|&[a, b, c]| (c > 1, a * b * c));
        for [a, b, c] in sizes {
            if (b, c) != (1, 1) {
                tables.walks[Self::place(a, b, c)] = tables.make([a, b, c]);
            }
        }
        tables
    }

    /// `None` for the sizes that have no walk without jumps; no such part is ever cut from a box that has
    /// one.
    fn make(&self, size: [usize; 3]) -> Option<Walk> {
        const STRIDES: [isize; 3] = [1, 64, 64 * 64];
        let [a, b, c] = [0, 1, 2].map(|axis| Axis { len: size[axis], stride: STRIDES[axis] });
        let mut order = Vec::new();
        Walker {
            tables: self,
            pick: &mut All(|leaf: Leaf<'_>| leaf.for_each(|index| order.push(index as isize))),
            passed: 0,
        }
        .divide(0, a, b, c);
        let step_number = |pair: &[isize]| {
            let axis = STRIDES.iter().position(|stride| (pair[1] - pair[0]).abs() == *stride)?;
            Some(2 * axis as u8 + u8::from(pair[1] < pair[0]))
        };
        let steps = order.windows(2).map(step_number).collect::<Option<_>>()?;
        // Six bits an axis become three.
        let places = order.iter().map(|&at| (at & 7 | at >> 3 & 7 << 3 | at >> 6 & 7 << 6) as u16).collect();
        Some(Walk { steps, places })
    }

    /// The walk of a box of these sides; `None` if it is too large for a table.
    fn walk(&self, a: usize, b: usize, c: usize) -> Option<&Walk> {
        if a.max(b).max(c) > LEAF_SIDE {
            return None;
        }
        self.walks.get(Self::place(a, b, c)).and_then(Option::as_ref)
    }

    const fn place(a: usize, b: usize, c: usize) -> usize {
        ((a - 1) * LEAF_SIDE + (b - 1)) * LEAF_SIDE + (c - 1)
    }
}

#[cfg(test)]
mod tests;
