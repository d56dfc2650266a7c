//! The generated forest.

use super::World;
use super::draw::{CELL_M, Canvas};
use crate::curve::between;
use crate::random::{Random, hash_at, unit};
use core::f64::consts::TAU;
use libm::{cos, sin};

/// Metres along x, y, z.
const SIZE: [f64; 3] = [60.0, 25.0, 10.0];

const PURPOSE_PLACES: u64 = 1;
const PURPOSE_TREE: u64 = 2;
const PURPOSE_GROUND_COVER: u64 = 3;

impl World {
    /// A generated forest, 60 × 25 × 10 m about the origin with z from 0, cells of 5 cm: gentle relief,
    /// conifers and broad-leaved trees that lean and branch, undergrowth, rocks, stumps and fallen logs. The
    /// same seed gives the same world on every machine. Takes about half a second in a release build.
    pub fn forest(seed: u64) -> Self {
        let half = [SIZE[0] / 2.0, SIZE[1] / 2.0];
        let mut canvas = Canvas::new([-half[0], -half[1], 0.0], [half[0], half[1], SIZE[2]]);
        let ground = Ground { seed };
        ground.draw(&mut canvas, half);
        let trees = places(seed, half);
        for (number, tree) in trees.iter().enumerate() {
            let mut random = Random::new(seed, PURPOSE_TREE + (number as u64) * 256);
            let base = [tree.x, tree.y, ground.height(tree.x, tree.y) - 0.1];
            (tree.draw)(&mut canvas, base, &mut random);
        }
        ground_cover(&mut canvas, &ground, seed, half, &trees);
        canvas.into_world()
    }
}

/// Gentle relief: three octaves of value noise.
struct Ground {
    seed: u64,
}

impl Ground {
    /// Height above z = 0, at least 0.1 m and at most 1.35 m.
    fn height(&self, x: f64, y: f64) -> f64 {
        0.1 + 0.9 * noise(self.seed, x / 14.0, y / 14.0)
            + 0.28 * noise(self.seed ^ 1, x / 4.0, y / 4.0)
            + 0.07 * noise(self.seed ^ 2, x / 0.8, y / 0.8)
    }

    fn draw(&self, canvas: &mut Canvas, half: [f64; 2]) {
        let (nx, ny) = ((2.0 * half[0] / CELL_M) as i32, (2.0 * half[1] / CELL_M) as i32);
        for i in 0..nx {
            for j in 0..ny {
                let (x, y) = (f64::from(i) * CELL_M - half[0], f64::from(j) * CELL_M - half[1]);
                let top = self.height(x + 0.5 * CELL_M, y + 0.5 * CELL_M);
                // 25 cm thick: no ray finds a hole even on the steepest step.
                canvas.slab([x, y, top - 0.25], [x + CELL_M, y + CELL_M, top]);
            }
        }
    }
}

/// How open the forest is at a place, 0 (thicket) … 1 (clearing). A trail winds along x.
fn openness(seed: u64, x: f64, y: f64) -> f64 {
    let clearing = noise(seed ^ 11, x / 9.0, y / 9.0);
    let middle = 9.0 * (noise(seed ^ 12, x / 16.0, 0.5) - 0.5);
    let off_trail = (y - middle).abs();
    if off_trail < 1.1 { 1.0 } else { ((clearing - 0.62) * 3.0).clamp(0.0, 1.0) }
}

struct Tree {
    x: f64,
    y: f64,
    /// Draws one of its kind from the base up.
    draw: fn(&mut Canvas, [f64; 3], &mut Random),
}

/// Where trees stand: never too close to each other, few on clearings, none on the trail, kinds in groups.
fn places(seed: u64, half: [f64; 2]) -> Vec<Tree> {
    let mut random = Random::new(seed, PURPOSE_PLACES);
    let mut trees: Vec<Tree> = Vec::new();
    for _ in 0..2_600 {
        let (x, y) = (random.range(-half[0], half[0]), random.range(-half[1], half[1]));
        let open = openness(seed, x, y);
        let spacing = random.range(1.5, 2.5) + 2.0 * open;
        let fits =
            open < 1.0 && trees.iter().all(|t| (t.x - x).powi(2) + (t.y - y).powi(2) >= spacing * spacing);
        let grove = noise(seed ^ 13, x / 11.0, y / 11.0) + random.range(-0.15, 0.15);
        let is_snag = random.happens(0.05);
        if fits {
            let living = if grove < 0.52 { conifer } else { broadleaf };
            trees.push(Tree { x, y, draw: if is_snag { snag } else { living } });
        }
    }
    trees
}

/// A stem that leans and bows: the point at height share `s` (0 … 1).
struct Stem {
    base: [f64; 3],
    height: f64,
    lean: [f64; 2],
    bow: [f64; 2],
    radius: f64,
}

impl Stem {
    fn new(base: [f64; 3], height: f64, radius: f64, random: &mut Random) -> Self {
        let (lean_to, bow_to) = (random.range(0.0, TAU), random.range(0.0, TAU));
        // Most stand nearly upright, a few lean by up to 8°.
        let lean = height * 0.14 * random.unit() * random.unit();
        let bow = height * 0.03 * random.unit();
        Self {
            base,
            height,
            lean: [lean * cos(lean_to), lean * sin(lean_to)],
            bow: [bow * cos(bow_to), bow * sin(bow_to)],
            radius,
        }
    }

    fn at(&self, s: f64) -> [f64; 3] {
        let arch = 4.0 * s * (1.0 - s);
        [
            self.base[0] + self.lean[0] * s + self.bow[0] * arch,
            self.base[1] + self.lean[1] * s + self.bow[1] * arch,
            self.base[2] + self.height * s,
        ]
    }

    fn radius_at(&self, s: f64) -> f64 {
        // The foot flares out.
        let foot = (1.0 - s * self.height / 0.5).max(0.0);
        self.radius * (1.0 - 0.85 * s) * (1.0 + 0.45 * foot * foot)
    }

    fn draw(&self, canvas: &mut Canvas, to: f64) {
        let pieces = (self.height * to / 0.4).ceil().max(1.0) as u32;
        for piece in 0..pieces {
            let (a, b) =
                (to * f64::from(piece) / f64::from(pieces), to * f64::from(piece + 1) / f64::from(pieces));
            canvas.limb(self.at(a), self.at(b), self.radius_at(a), self.radius_at(b));
        }
    }

    /// The height share at which the world ends (nothing above needs to be drawn).
    fn cut(&self) -> f64 {
        ((SIZE[2] + 0.5 - self.base[2]) / self.height).min(1.0)
    }
}

/// A conifer: whorls of drooping branches, longest low in the crown, dead stubs below it.
fn conifer(canvas: &mut Canvas, base: [f64; 3], random: &mut Random) {
    let height = random.range(6.0, 15.0);
    let radius = 0.04 + 0.013 * height * random.range(0.6, 1.3);
    let stem = Stem::new(base, height, radius, random);
    stem.draw(canvas, stem.cut());
    let crown_from = random.range(0.18, 0.45);
    let reach = random.range(0.11, 0.17) * height;
    let mut up = 1.0 + random.range(0.0, 0.4);
    while up < height * stem.cut() {
        let s = up / height;
        let in_crown = s >= crown_from;
        let count = if in_crown { 4 + random.below(3) } else { random.below(3) };
        let turn = random.range(0.0, TAU);
        for k in 0..count {
            let heading = turn + TAU * (k as f64) / (count.max(1) as f64) + random.range(-0.3, 0.3);
            let length = if in_crown {
                reach * ((1.0 - s) / (1.0 - crown_from)).sqrt() * random.range(0.7, 1.1)
            } else {
                random.range(0.15, 0.9)
            };
            let droop = if in_crown { random.range(-0.35, 0.05) } else { random.range(-0.3, 0.15) };
            let from = stem.at(s);
            let to = away(from, heading, length, length * droop);
            canvas.limb(from, to, 0.03, 0.01);
            if in_crown && length > 0.15 {
                let sprays = (length / 0.28).ceil() as u32;
                for i in 1..=sprays {
                    let f = f64::from(i) / f64::from(sprays);
                    let place = between(from, to, f);
                    let size = random.range(0.14, 0.24);
                    canvas.foliage(place, [size, size, 0.6 * size], 0.3, random.next_u64());
                }
            }
        }
        up += random.range(0.3, 0.55);
    }
}

/// A broad-leaved tree: the stem divides into rising limbs, these into twigs with leaves.
fn broadleaf(canvas: &mut Canvas, base: [f64; 3], random: &mut Random) {
    let height = random.range(5.5, 12.0);
    let radius = 0.04 + 0.014 * height * random.range(0.6, 1.3);
    let stem = Stem::new(base, height, radius, random);
    stem.draw(canvas, stem.cut());
    let limbs = 5 + random.below(5);
    let spread = random.range(0.16, 0.26) * height;
    for k in 0..limbs {
        let s = random.range(0.32, 0.9);
        if s > stem.cut() {
            continue;
        }
        let from = stem.at(s);
        let heading = 2.4 * (k as f64) + random.range(-0.5, 0.5);
        let length = spread * (1.25 - s) * random.range(0.8, 1.3);
        let rise = random.range(0.35, 1.1);
        let to = away(from, heading, length, length * rise);
        let thick = (stem.radius_at(s) * 0.6).max(0.03);
        canvas.limb(from, to, thick, 0.025);
        let twigs = 2 + random.below(4);
        for _ in 0..twigs {
            let f = random.range(0.45, 1.0);
            let start = between(from, to, f);
            let side = heading + random.range(-1.2, 1.2);
            let reach = random.range(0.4, 1.0);
            let end = away(start, side, reach, reach * random.range(-0.2, 0.7));
            canvas.limb(start, end, 0.02, 0.01);
            for place in [0.55, 1.0] {
                let centre = between(start, end, place);
                let size = random.range(0.28, 0.6);
                canvas.foliage(centre, [size, size, 0.7 * size], random.range(0.08, 0.2), random.next_u64());
            }
        }
    }
}

/// A dead stem, broken off, with a few bare branches.
fn snag(canvas: &mut Canvas, base: [f64; 3], random: &mut Random) {
    let height = random.range(1.0, 6.0);
    let stem = Stem::new(base, height, random.range(0.08, 0.2), random);
    stem.draw(canvas, stem.cut());
    for _ in 0..random.below(7) {
        let from = stem.at(random.range(0.3, 1.0));
        let heading = random.range(0.0, TAU);
        let length = random.range(0.3, 1.2);
        let to = away(from, heading, length, length * random.range(-0.3, 0.4));
        canvas.limb(from, to, 0.03, 0.01);
    }
}

/// Bushes, saplings, ferns, rocks, stumps and fallen logs.
fn ground_cover(canvas: &mut Canvas, ground: &Ground, seed: u64, half: [f64; 2], trees: &[Tree]) {
    let mut random = Random::new(seed, PURPOSE_GROUND_COVER);
    let spot = |random: &mut Random| {
        let (x, y) = (random.range(-half[0], half[0]), random.range(-half[1], half[1]));
        ([x, y, ground.height(x, y)], openness(seed, x, y))
    };
    for _ in 0..150 {
        let (place, open) = spot(&mut random);
        let size = random.range(0.35, 1.0);
        let on_trail = open >= 1.0;
        for _ in 0..3 + random.below(5) {
            let heading = random.range(0.0, TAU);
            let length = size * random.range(0.5, 1.3);
            let out = length * random.range(0.2, 0.8);
            let tip = away(place, heading, out, length);
            let (leaf, density) = (random.range(0.2, 0.5) * size, random.range(0.15, 0.35));
            let leaf_seed = random.next_u64();
            if !on_trail {
                canvas.limb(place, tip, 0.02, 0.01);
                canvas.foliage(tip, [leaf, leaf, 0.8 * leaf], density, leaf_seed);
            }
        }
    }
    for _ in 0..1_600 {
        let (place, open) = spot(&mut random);
        let size = random.range(0.08, 0.32) * (1.0 - 0.5 * open);
        canvas.foliage(place, [size, size, 1.2 * size], 0.25, random.next_u64());
    }
    for _ in 0..70 {
        let (place, _) = spot(&mut random);
        let size = 0.12 + 0.6 * random.unit() * random.unit();
        let radii =
            [size * random.range(0.7, 1.3), size * random.range(0.7, 1.3), size * random.range(0.5, 0.9)];
        canvas.boulder(place, radii, 0.35, random.next_u64());
    }
    for _ in 0..14 {
        let (place, _) = spot(&mut random);
        canvas.limb(
            [place[0], place[1], place[2] - 0.1],
            [place[0], place[1], place[2] + random.range(0.2, 0.6)],
            random.range(0.15, 0.3),
            0.15,
        );
    }
    for _ in 0..16 {
        let (place, _) = spot(&mut random);
        let (heading, length, thick) =
            (random.range(0.0, TAU), random.range(2.0, 7.0), random.range(0.07, 0.22));
        let [x, y, _] = away(place, heading, length, 0.0);
        // Some hang in the branches of others.
        let lift = if random.happens(0.3) { random.range(0.3, 1.6) } else { 0.0 };
        let to = [x, y, ground.height(x, y) + thick + lift];
        canvas.limb([place[0], place[1], place[2] + thick], to, thick, 0.6 * thick);
    }
    // Roots and litter at the foot of each tree.
    for tree in trees {
        for _ in 0..3 {
            let (heading, length) = (random.range(0.0, TAU), random.range(0.3, 0.9));
            let foot = [tree.x, tree.y, ground.height(tree.x, tree.y) + 0.12];
            let [x, y, _] = away(foot, heading, length, 0.0);
            canvas.limb(foot, [x, y, ground.height(x, y)], 0.07, 0.03);
        }
    }
}

/// The point this far from another, in a direction over the ground and up.
fn away(from: [f64; 3], heading: f64, length: f64, up: f64) -> [f64; 3] {
    [from[0] + length * cos(heading), from[1] + length * sin(heading), from[2] + up]
}

/// Value noise: random at whole coordinates, smooth between, 0 … 1.
fn noise(seed: u64, x: f64, y: f64) -> f64 {
    let (i, j) = (x.floor(), y.floor());
    let ease = |f: f64| f * f * (3.0 - 2.0 * f);
    let (u, v) = (ease(x - i), ease(y - j));
    let at = |di: i64, dj: i64| unit(hash_at(seed, i as i64 + di, j as i64 + dj, 0));
    let low = at(0, 0) + (at(1, 0) - at(0, 0)) * u;
    let high = at(0, 1) + (at(1, 1) - at(0, 1)) * u;
    low + (high - low) * v
}
