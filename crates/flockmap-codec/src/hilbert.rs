//! The Hilbert walk over a box of any size (Sec. III-C of the paper): every voxel once, each step to a direct
//! neighbour, no enclosing cube of a power of two.
//!
//! The paper does not say how its curve fits a box whose sides are no powers of two. This is the subdivision of
//! "gilbert++", the generalised Hilbert curve by Jakub Červený and abetusk (github.com/jakubcerveny/gilbert), with the
//! axes ordered so that a walk without jumps exists ("Hamiltonian"): the walk goes from one corner to
//! the next along its first axis, and by the colours of a chessboard that is possible only if this side is even
//! or all sides are odd.
//!
//! Written for speed: positions are linear indices into a dense grid, directions are index strides, and where all
//! sides are at most [`LEAF_SIDE`] the steps come from a table.

use std::sync::OnceLock;

/// Sub-boxes with no side longer than this are walked by table.
const LEAF_SIDE: usize = 8;

/// The order in which the Hilbert walk visits a box of `size` voxels along x, y, z: for each step the voxel's
/// place in the box. For tests, pictures and other implementations; the codecs walk without making this list.
///
/// Holds 12 bytes a voxel. Empty if a side is zero or the box has more than [`crate::BOX_VOXELS_MAX`] voxels.
pub fn hilbert_order(size: [u32; 3]) -> Vec<[u32; 3]> {
    let volume: u128 = size.iter().map(|&side| u128::from(side)).product();
    if volume > u128::from(crate::BOX_VOXELS_MAX) {
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

/// A piece of the walk: a first voxel and the steps from it, in linear indices with x fastest, then y, then z.
#[derive(Clone, Copy)]
pub(crate) struct Leaf<'t> {
    first: usize,
    way: &'t Way,
    /// Index difference of each step number. Two of the eight are not used; so no step can be out of range.
    strides: [usize; 8],
}

impl Leaf<'_> {
    /// Number of voxels.
    pub(crate) fn len(&self) -> usize {
        self.way.places.len()
    }

    /// Calls `visit` with the linear index of each voxel in turn.
    #[inline]
    pub(crate) fn for_each(&self, mut visit: impl FnMut(usize)) {
        let mut index = self.first;
        visit(index);
        for &step in &self.way.steps {
            index = index.wrapping_add(self.strides[usize::from(step & 7)]);
            visit(index);
        }
    }

    /// The voxel that [`Self::for_each`] gives after so many others.
    #[inline]
    pub(crate) fn voxel(&self, step: usize) -> usize {
        let place = self.way.places.get(step).copied().unwrap_or(0) as usize;
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

/// Walks the parts of a box in which `pick` wants a voxel; it gets the pieces of the walk in order, with voxels as [`Places`] has
/// them. What lies between takes no time that goes with its size.
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

/// The voxels of a box as numbers from which their places are read without dividing: x in the lowest bits, above it y, then z.
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

/// Puts the axis along which the walk as a whole goes first: the longest even one, else (all odd) the longest.
/// Of the others the longer one comes first. Ties: x before y before z.
fn order_axes(mut axes: [Axis; 3]) -> [Axis; 3] {
    axes.sort_by_key(|axis| core::cmp::Reverse(axis.len));
    if let Some(even) = axes.iter().position(|axis| axis.is_even()) {
        axes[..=even].rotate_right(1);
    }
    axes
}

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

    /// The same side walked the other way.
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

/// About half, even where it can be.
fn half_even(len: usize) -> usize {
    let half = len / 2;
    if len > 2 { half + half % 2 } else { half }
}

/// About half, odd where it can be.
fn half_odd(len: usize) -> usize {
    let half = len / 2;
    if len > 2 { half + 1 - half % 2 } else { half }
}

/// About a third, even where it can be.
fn third_even(len: usize) -> usize {
    let third = len / 3;
    if len > 2 { third + third % 2 } else { third }
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
        if let Some(way) = self.tables.way(a.len, b.len, c.len) {
            return self.leaf(from, way, a, b, c);
        }
        self.divide(from, a, b, c);
    }

    fn leaf(&mut self, from: isize, way: &Way, a: Axis, b: Axis, c: Axis) {
        let strides =
            [a.stride, -a.stride, b.stride, -b.stride, c.stride, -c.stride, 0, 0].map(|s| s as usize);
        let leaf = Leaf { first: from as usize, way, strides };
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
        const POINT: Axis = Axis { len: 1, stride: 0 };
        if self.passes(a.len * b.len) {
            return;
        }
        if let Some(way) = self.tables.way(a.len, b.len, 1) {
            return self.leaf(from, way, a, b, POINT);
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
        const POINT: Axis = Axis { len: 1, stride: 0 };
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
            if let Some(way) = self.tables.way(part.len, 1, 1) {
                self.leaf(from + a.at(start), way, part, POINT, POINT);
            }
            start += part.len;
        }
    }
}

/// The walks of every size of small box. About 150 KB, made at first use in about a millisecond.
struct Tables {
    ways: Vec<Option<Way>>,
}

/// A walk of a small box.
struct Way {
    /// From each voxel to the next: 0, 1 forward and back along the first axis, 2, 3 along the second, 4, 5 along the third.
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
        let ways = std::iter::repeat_with(|| None).take(LEAF_SIDE * LEAF_SIDE * LEAF_SIDE);
        let mut tables = Self { ways: ways.collect() };
        for len in 1..=LEAF_SIDE {
            let (steps, places) = (vec![0; len - 1].into(), (0..len as u16).collect());
            tables.ways[Self::place(len, 1, 1)] = Some(Way { steps, places });
        }
        let sides = || 1..=LEAF_SIDE;
        let mut sizes: Vec<[usize; 3]> =
            sides().flat_map(|a| sides().flat_map(move |b| sides().map(move |c| [a, b, c]))).collect();
        sizes.sort_by_key(|&[a, b, c]| (c > 1, a * b * c));
        for [a, b, c] in sizes {
            if (b, c) != (1, 1) {
                tables.ways[Self::place(a, b, c)] = tables.make([a, b, c]);
            }
        }
        tables
    }

    /// `None` for the sizes that have no walk without jumps; no such part is ever cut from a box that has one.
    fn make(&self, size: [usize; 3]) -> Option<Way> {
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
        Some(Way { steps, places })
    }

    /// The walk of a box of these sides; `None` if it is too large for a table.
    fn way(&self, a: usize, b: usize, c: usize) -> Option<&Way> {
        if a.max(b).max(c) > LEAF_SIDE {
            return None;
        }
        self.ways.get(Self::place(a, b, c)).and_then(Option::as_ref)
    }

    const fn place(a: usize, b: usize, c: usize) -> usize {
        ((a - 1) * LEAF_SIDE + (b - 1)) * LEAF_SIDE + (c - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each voxel once, every step to a direct neighbour, from a corner.
    fn check(size: [u32; 3]) {
        let order = hilbert_order(size);
        let place = |v: [u32; 3]| ((v[2] * size[1] + v[1]) * size[0] + v[0]) as usize;
        let mut seen = vec![false; (size[0] * size[1] * size[2]) as usize];
        assert_eq!(order.len(), seen.len(), "{size:?}");
        assert_eq!(order[0], [0; 3]);
        for v in &order {
            assert!(!core::mem::replace(&mut seen[place(*v)], true), "{v:?} twice in {size:?}");
        }
        for pair in order.windows(2) {
            let step: u32 = (0..3).map(|axis| pair[0][axis].abs_diff(pair[1][axis])).sum();
            assert_eq!(step, 1, "{pair:?} in {size:?}");
        }
    }

    #[test]
    fn every_box_up_to_16_is_walked_without_jumps() {
        for x in 1..=16 {
            for y in 1..=16 {
                for z in 1..=16 {
                    check([x, y, z]);
                }
            }
        }
    }

    #[test]
    fn large_odd_and_thin_boxes_are_walked_without_jumps() {
        let mut seed = 1u64;
        let mut random = |limit: u64| {
            seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            ((seed >> 33) % limit) as u32 + 1
        };
        for _ in 0..60 {
            check([random(70), random(70), random(40)]);
            check([random(45) * 2 - 1, random(45) * 2 - 1, random(20) * 2 - 1]);
            check([random(300), random(5), random(40)]);
            check([random(3), random(3), random(2000)]);
        }
        for size in [[151, 149, 31], [150, 150, 30], [1, 1, 100_000], [1, 333, 257], [7, 1001, 2]] {
            check(size);
        }
    }

    /// The same subdivision, plain: vectors in place of indices and no tables.
    mod plain {
        type V = [i32; 3];

        fn add(parts: &[V]) -> V {
            parts.iter().fold([0; 3], |sum, v| [sum[0] + v[0], sum[1] + v[1], sum[2] + v[2]])
        }

        fn neg(v: V) -> V {
            v.map(|c| -c)
        }

        fn sub(a: V, b: V) -> V {
            add(&[a, neg(b)])
        }

        fn unit(v: V) -> V {
            v.map(i32::signum)
        }

        fn len(v: V) -> i32 {
            v.iter().map(|c| c.abs()).sum()
        }

        /// `v` divided by `q`, then one longer if its length has not the wanted remainder by 2.
        fn part(v: V, q: i32, odd: i32) -> V {
            let p = v.map(|c| c / q);
            if len(v) > 2 && len(p) % 2 != odd { add(&[p, unit(v)]) } else { p }
        }

        pub(super) fn order(size: [u32; 3]) -> Vec<[u32; 3]> {
            let mut axes: Vec<V> = (0..3)
                .map(|axis| core::array::from_fn(|i| if i == axis { size[axis] as i32 } else { 0 }))
                .collect();
            axes.sort_by_key(|v| -len(*v));
            if let Some(even) = axes.iter().position(|v| len(*v) % 2 == 0) {
                let first = axes.remove(even);
                axes.insert(0, first);
            }
            let mut out = Vec::new();
            solid([0; 3], axes[0], axes[1], axes[2], &mut out);
            out.iter().map(|v: &V| v.map(|c| c as u32)).collect()
        }

        fn solid(p: V, a: V, b: V, c: V, out: &mut Vec<V>) {
            let (la, lb, lc) = (len(a), len(b), len(c));
            let (ua, ub, uc) = (unit(a), unit(b), unit(c));
            let (a2, b2, c2) = (part(a, 2, 0), part(b, 2, 0), part(c, 2, 0));
            let (b3, c3) = (part(b, 3, 0), part(c, 3, 0));
            let a_end = sub(a, ua);
            let mut go = |p: &[V], a: V, b: V, c: V| solid(add(p), a, b, c, out);
            if la == 1 {
                flat(p, b, c, out);
            } else if lb == 1 {
                flat(p, a, c, out);
            } else if lc == 1 {
                flat(p, a, b, out);
            } else if 3 * la > 5 * lb && 3 * la > 5 * lc {
                go(&[p], a2, b, c);
                go(&[p, a2], sub(a, a2), b, c);
            } else if 2 * lb > 3 * lc || 2 * lb > 3 * la {
                go(&[p], b3, c, a2);
                go(&[p, b3], a, sub(b, b3), c);
                go(&[p, a_end, sub(b3, ub)], neg(b3), c, neg(sub(a, a2)));
            } else if 2 * lc > 3 * lb {
                go(&[p], c3, a2, b);
                go(&[p, c3], a, b, sub(c, c3));
                go(&[p, a_end, sub(c3, uc)], neg(c3), neg(sub(a, a2)), b);
            } else if lc % 2 == 0 {
                let (b_rest, c_end) = (sub(b, b2), sub(c, uc));
                go(&[p], b2, c2, a2);
                go(&[p, b2], c, a2, b_rest);
                go(&[p, sub(b2, ub), c_end], a, neg(b2), neg(sub(c, c2)));
                go(&[p, a_end, b2, c_end], neg(c), neg(sub(a, a2)), b_rest);
                go(&[p, a_end, sub(b2, ub)], neg(b2), c2, neg(sub(a, a2)));
            } else if la % 2 == 0 || lb % 2 == 0 {
                let a2 = part(a, 2, 1);
                let (b_end, c_rest) = (sub(b, ub), sub(c, c2));
                go(&[p], c2, a2, b2);
                go(&[p, c2], b, c_rest, a2);
                go(&[p, sub(c2, uc), b_end], a, neg(sub(b, b2)), neg(c2));
                go(&[p, a_end, b_end, c2], neg(b), c_rest, neg(sub(a, a2)));
                go(&[p, a_end, sub(c2, uc)], neg(c2), neg(sub(a, a2)), b2);
            } else {
                let a2 = part(a, 2, 1);
                let (b_rest, c_rest) = (sub(b, b2), sub(c, c2));
                go(&[p], b2, c, a2);
                go(&[p, b2], c2, a, b_rest);
                go(&[p, b2, c2], a, b_rest, c_rest);
                go(&[p, a_end, sub(b2, ub), c2], neg(b2), c_rest, neg(sub(a, a2)));
                go(&[p, a_end, sub(c2, uc)], neg(c2), neg(sub(a, a2)), b2);
            }
        }

        fn flat(p: V, a: V, b: V, out: &mut Vec<V>) {
            let (la, lb) = (len(a), len(b));
            if la == 1 || lb == 1 {
                let step = if lb == 1 { unit(a) } else { unit(b) };
                out.extend((0..la.max(lb)).map(|i| add(&[p, step.map(|c| c * i)])));
            } else if 2 * la > 3 * lb {
                let a2 = part(a, 2, 0);
                flat(p, a2, b, out);
                flat(add(&[p, a2]), sub(a, a2), b, out);
            } else {
                let (a2, b2) = (a.map(|c| c / 2), part(b, 2, 0));
                flat(p, b2, a2, out);
                flat(add(&[p, b2]), a, sub(b, b2), out);
                flat(add(&[p, sub(a, unit(a)), sub(b2, unit(b))]), neg(b2), sub(a2, a), out);
            }
        }
    }

    /// Wants some steps of a walk, and looks at what it gets.
    struct Some<'a> {
        wanted: &'a [usize],
        order: &'a [[u32; 3]],
        places: Places,
        leaves: usize,
        found: usize,
    }

    impl Pick for Some<'_> {
        fn next(&mut self, step: usize) -> usize {
            let later = self.wanted.partition_point(|wanted| *wanted < step);
            self.wanted.get(later).copied().unwrap_or(usize::MAX)
        }

        fn leaf(&mut self, step: usize, leaf: &Leaf<'_>) {
            let mut step = step;
            let before = self.found;
            let first = step;
            leaf.for_each(|number| {
                assert_eq!(self.places.place(number).map(|at| at as u32), self.order[step]);
                assert_eq!(leaf.voxel(step - first), number);
                self.found += usize::from(self.wanted.contains(&step));
                step += 1;
            });
            assert!(self.found > before, "a leaf without a wanted step");
            self.leaves += 1;
        }
    }

    fn check_some(size: [u32; 3], wanted: &[usize]) {
        let order = hilbert_order(size);
        let size = size.map(|side| side as usize);
        let mut some = Some { wanted, order: &order, places: Places::of(size), leaves: 0, found: 0 };
        walk_some(size, &mut some);
        assert_eq!(some.found, wanted.len(), "{size:?}");
        assert!(some.leaves <= wanted.len());
    }

    #[test]
    fn the_walk_goes_straight_to_the_steps_that_are_wanted() {
        for x in 1..=12u32 {
            for y in 1..=12 {
                for z in 1..=12 {
                    let volume = (x * y * z) as usize;
                    check_some([x, y, z], &[volume * 5 / 7]);
                    check_some([x, y, z], &[]);
                }
            }
        }
        let sizes = [
            [37, 52, 19],
            [64, 64, 64],
            [101, 33, 5],
            [1, 90, 77],
            [5_000, 1, 1],
            [21, 35, 49],
            [1, 1, 9_999],
        ];
        for size in sizes {
            let volume: usize = size.iter().map(|side| *side as usize).product();
            let mut wanted: Vec<usize> =
                (1..40).map(|n| n * n * 7_919 % volume).chain([0, volume - 1]).collect();
            wanted.sort_unstable();
            wanted.dedup();
            check_some(size, &wanted);
        }
    }

    #[test]
    fn the_fast_walk_equals_the_plain_one() {
        for x in 1..=12 {
            for y in 1..=12 {
                for z in 1..=12 {
                    assert_eq!(hilbert_order([x, y, z]), plain::order([x, y, z]), "{x} {y} {z}");
                }
            }
        }
        for size in [[37, 52, 19], [64, 64, 64], [101, 33, 5], [1, 90, 77], [40, 1, 1], [21, 35, 49]] {
            assert_eq!(hilbert_order(size), plain::order(size), "{size:?}");
        }
    }
}
