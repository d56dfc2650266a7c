//! Every voxel once and without jumps, as a plain version of the same walk has it.

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
    let sizes =
        [[37, 52, 19], [64, 64, 64], [101, 33, 5], [1, 90, 77], [5_000, 1, 1], [21, 35, 49], [1, 1, 9_999]];
    for size in sizes {
        let volume: usize = size.iter().map(|side| *side as usize).product();
        let mut wanted: Vec<usize> = (1..40).map(|n| n * n * 7_919 % volume).chain([0, volume - 1]).collect();
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
