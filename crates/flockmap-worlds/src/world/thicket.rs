//! The generated thicket: a small dense forest to find a path through.

use super::World;
use super::draw::Canvas;
use crate::random::Random;
use core::f64::consts::TAU;
use libm::{cos, sin};

/// Metres along x, y, z; y is about 0.
const SIZE: [f64; 3] = [36.0, 12.0, 4.0];
/// Along x, where plants stand.
const GROWN: [f64; 2] = [6.5, 32.0];
/// Open space between any two plants, in metres, at least.
const GAP_MIN: f64 = 1.2;
/// Most open space that a plant asks for around itself.
const GAP_MAX: f64 = 1.9;
/// Top of the ground.
const GROUND_M: f64 = 0.1;

const PURPOSE: u64 = 0x7c1;

impl World {
    /// A generated thicket, 36 × 12 × 4 m with x from 0, y about 0 and z from 0, cells of 5 cm: level ground,
    /// stems of 0.2 to 0.5 m and bushes, with gaps of at least 1.2 m between any two and nothing within 6.5 m
    /// of the low and 4 m of the high end of x, where a flight begins and ends. The same seed gives the same
    /// world on every machine.
    pub fn thicket(seed: u64) -> Self {
        let half = SIZE[1] / 2.0;
        let mut canvas = Canvas::new([0.0, -half, 0.0], [SIZE[0], half, SIZE[2]]);
        canvas.slab([0.0, -half, 0.0], [SIZE[0], half, GROUND_M]);
        let mut random = Random::new(seed, PURPOSE);
        for plant in plants(&mut random) {
            if plant.is_bush {
                bush(&mut canvas, &plant, &mut random);
            } else {
                stem(&mut canvas, &plant, &mut random);
            }
        }
        canvas.into_world()
    }
}

struct Plant {
    x: f64,
    y: f64,
    /// No part of it is farther from its place than this.
    radius: f64,
    is_bush: bool,
}

/// Places drawn until no more fit: each plant asks for a gap of its own, so that dense and open parts mix.
fn plants(random: &mut Random) -> Vec<Plant> {
    let mut plants: Vec<Plant> = Vec::new();
    for _ in 0..3_000 {
        let (x, y) = (random.range(GROWN[0], GROWN[1]), random.range(-SIZE[1] / 2.0, SIZE[1] / 2.0));
        let is_bush = random.happens(0.15);
        let radius = if is_bush { random.range(0.3, 0.6) } else { random.range(0.1, 0.25) };
        let gap = random.range(GAP_MIN, GAP_MAX);
        // A stem leans by up to LEAN_M: its foot and its top lie within this much more of its place.
        let reach = if is_bush { radius } else { radius + LEAN_M };
        let apart = |p: &Plant| ((p.x - x) * (p.x - x) + (p.y - y) * (p.y - y)).sqrt();
        if plants.iter().all(|p| apart(p) >= p.radius + reach + gap) {
            plants.push(Plant { x, y, radius: reach, is_bush });
        }
    }
    plants
}

/// How far the ends of a stem are off its place, at most.
const LEAN_M: f64 = 0.1;

/// An upright stem that leans a little.
fn stem(canvas: &mut Canvas, plant: &Plant, random: &mut Random) {
    let heading = random.range(0.0, TAU);
    let lean = random.range(0.0, LEAN_M);
    let (dx, dy) = (lean * cos(heading), lean * sin(heading));
    let radius = plant.radius - LEAN_M;
    let foot = [plant.x - dx, plant.y - dy, 0.0];
    let top = [plant.x + dx, plant.y + dy, SIZE[2] + 0.2];
    canvas.limb(foot, top, radius, 0.9 * radius);
}

/// A bush: dense leaves on a short stem, from knee-high to above where a robot flies.
fn bush(canvas: &mut Canvas, plant: &Plant, random: &mut Random) {
    let height = random.range(0.6, 2.4);
    let half = 0.5 * height;
    canvas.limb([plant.x, plant.y, 0.0], [plant.x, plant.y, GROUND_M + half], 0.05, 0.03);
    let radii = [plant.radius, plant.radius, half];
    canvas.boulder([plant.x, plant.y, GROUND_M + half], radii, 0.35, random.next_u64());
}
