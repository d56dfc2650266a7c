//! The generated office floor.

mod furniture;
mod rooms;

use super::World;
use super::draw::Canvas;
use crate::random::Random;
use rooms::{CEILING, Door, FLOOR, HALF_WALL, OUTER_WALL, Rect, Room, SIZE, Use};

const DOOR_HEIGHT: f64 = 2.15;

const PURPOSE_PLAN: u64 = 21;
const PURPOSE_ROOM: u64 = 22;

impl World {
    /// A generated office floor, 35 × 30 × 4 m about the origin with z from 0, cells of 5 cm: corridors,
    /// rooms with doors and furniture, a hall with pillars. The same seed gives the same world on every
    /// machine.
    pub fn indoor(seed: u64) -> Self {
        let (hx, hy) = (SIZE[0] / 2.0, SIZE[1] / 2.0);
        let mut canvas = Canvas::new([-hx, -hy, 0.0], [hx, hy, SIZE[2]]);
        let mut random = Random::new(seed, PURPOSE_PLAN);
        let plan = Plan::new(&mut random);
        plan.draw(&mut canvas, &mut random);
        for (number, room) in plan.rooms.iter().enumerate() {
            let mut random = Random::new(seed, PURPOSE_ROOM + (number as u64) * 256);
            furniture::furnish(&mut canvas, room, &plan.doors, &mut random);
        }
        canvas.into_world()
    }
}

/// Rooms that tile the floor, and the doors between them. Every room can be reached from every other.
struct Plan {
    rooms: Vec<Room>,
    doors: Vec<Door>,
}

impl Plan {
    fn new(random: &mut Random) -> Self {
        let (hx, hy) = (SIZE[0] / 2.0, SIZE[1] / 2.0);
        // A corridor along x, and one along y from it to either side; four quarters remain.
        let (low_y, wide_y) = (random.range(-3.0, 0.5), random.range(2.2, 2.8));
        let (low_x, wide_x) = (random.range(-4.0, 2.0), random.range(2.0, 2.4));
        let (high_y, high_x) = (low_y + wide_y, low_x + wide_x);
        let rect = |x0, y0, x1, y1| Rect { min: [x0, y0], max: [x1, y1] };
        let mut rooms = vec![
            Room { rect: rect(-hx, low_y, hx, high_y), kind: Use::Corridor },
            Room { rect: rect(low_x, -hy, high_x, low_y), kind: Use::Corridor },
            Room { rect: rect(low_x, high_y, high_x, hy), kind: Use::Corridor },
        ];
        let quarters = [
            rect(-hx, -hy, low_x, low_y),
            rect(high_x, -hy, hx, low_y),
            rect(-hx, high_y, low_x, hy),
            rect(high_x, high_y, hx, hy),
        ];
        let hall = random.below(4) as usize;
        for (number, quarter) in quarters.into_iter().enumerate() {
            if number == hall {
                rooms.push(Room { rect: quarter, kind: Use::Hall });
            } else {
                split(quarter, random, &mut rooms);
            }
        }
        let doors = doors(&rooms, random);
        Self { rooms, doors }
    }

    fn draw(&self, canvas: &mut Canvas, random: &mut Random) {
        let (hx, hy) = (SIZE[0] / 2.0, SIZE[1] / 2.0);
        canvas.slab([-hx, -hy, 0.0], [hx, hy, FLOOR]);
        canvas.slab([-hx, -hy, CEILING], [hx, hy, SIZE[2]]);
        for room in &self.rooms {
            let Rect { min, max } = room.rect;
            for (axis, place) in [(0, min[0]), (0, max[0]), (1, min[1]), (1, max[1])] {
                let along = [min[1 - axis] - HALF_WALL, max[1 - axis] + HALF_WALL];
                let across = [place - HALF_WALL, place + HALF_WALL];
                let (low, high) = boxed(axis, across, along, [FLOOR, CEILING]);
                canvas.slab(low, high);
            }
        }
        for (axis, half) in [(0, hx), (1, hy)] {
            for side in [-1.0, 1.0] {
                let across = if side < 0.0 { [-half, -half + OUTER_WALL] } else { [half - OUTER_WALL, half] };
                let reach = SIZE[1 - axis] / 2.0;
                let (low, high) = boxed(axis, across, [-reach, reach], [FLOOR, CEILING]);
                canvas.slab(low, high);
                self.windows(canvas, axis, side * half, random);
            }
        }
        // The corridors meet without walls between them.
        if let [main, south, north, ..] = self.rooms.as_slice() {
            for (branch, y) in [(south, main.rect.min[1]), (north, main.rect.max[1])] {
                canvas.carve(
                    [branch.rect.min[0] + HALF_WALL, y - 0.2, FLOOR],
                    [branch.rect.max[0] - HALF_WALL, y + 0.2, CEILING - 0.3],
                );
            }
        }
        for door in &self.doors {
            door.draw(canvas, random);
        }
    }

    /// Windows as niches in an outer wall, a sill below, a radiator under every other one.
    fn windows(&self, canvas: &mut Canvas, axis: usize, wall: f64, random: &mut Random) {
        let reach = SIZE[1 - axis] / 2.0;
        let inward = if wall < 0.0 { 1.0 } else { -1.0 };
        let mut along = -reach + 1.2;
        while along + 1.6 < reach - 1.0 {
            let mut span = |from: f64, to: f64, low: f64, high: f64, start: f64, end: f64, carve: bool| {
                let (a, b) = (wall + inward * from, wall + inward * to);
                let (min, max) = boxed(axis, [a.min(b), a.max(b)], [start, end], [low, high]);
                let draw = if carve { Canvas::carve } else { Canvas::slab };
                draw(canvas, min, max);
            };
            span(0.1, OUTER_WALL, 1.0, 2.6, along, along + 1.5, true);
            span(0.1, OUTER_WALL, 1.0, 2.6, along + 0.72, along + 0.78, false);
            span(OUTER_WALL, OUTER_WALL + 0.1, 0.95, 1.0, along - 0.1, along + 1.6, false);
            if random.happens(0.5) {
                span(OUTER_WALL, OUTER_WALL + 0.12, 0.2, 0.75, along + 0.1, along + 1.4, false);
            }
            along += random.range(2.2, 3.4);
        }
    }
}

impl Door {
    /// Carves the opening and hangs an open leaf into it, if it is not a wide passage.
    fn draw(&self, canvas: &mut Canvas, random: &mut Random) {
        let half = self.width / 2.0;
        let (min, max) = boxed(
            self.axis,
            [self.place - 0.2, self.place + 0.2],
            [self.along - half, self.along + half],
            [FLOOR, DOOR_HEIGHT],
        );
        canvas.carve(min, max);
        let (leaf, side, hinge) = (random.happens(0.6), random.happens(0.5), random.happens(0.5));
        if leaf && self.width < 1.5 {
            let across = if side { [self.place, self.place + 1.0] } else { [self.place - 1.0, self.place] };
            let along = if hinge {
                [self.along - half - 0.06, self.along - half]
            } else {
                [self.along + half, self.along + half + 0.06]
            };
            let (min, max) = boxed(self.axis, across, along, [FLOOR + 0.02, DOOR_HEIGHT - 0.05]);
            canvas.slab(min, max);
        }
    }
}

/// Lowest and highest corner of a box across a wall of constant x (`axis` 0) or y, along it, and up.
fn boxed(axis: usize, across: [f64; 2], along: [f64; 2], up: [f64; 2]) -> ([f64; 3], [f64; 3]) {
    let Rect { min, max } = Rect::across(axis, across, along);
    ([min[0], min[1], up[0]], [max[0], max[1], up[1]])
}

/// Divides a rectangle into rooms of 3.4 m or more on each side.
fn split(rect: Rect, random: &mut Random, rooms: &mut Vec<Room>) {
    let size = rect.size();
    let axis = usize::from(size[1] > size[0]);
    let small = rect.area() < 24.0 || (rect.area() < 45.0 && random.happens(0.4));
    if small || size[axis] < 7.0 {
        let kind = match random.below(10) {
            0..=4 => Use::Office,
            5..=6 => Use::Meeting,
            7..=8 => Use::Storage,
            _ => Use::Lounge,
        };
        rooms.push(Room { rect, kind });
        return;
    }
    let at = rect.min[axis] + (size[axis] * random.range(0.38, 0.62)).clamp(3.4, size[axis] - 3.4);
    split(rect.part(axis, rect.min[axis], at), random, rooms);
    split(rect.part(axis, at, rect.max[axis]), random, rooms);
}

/// Doors that make a tree over all rooms, preferring doors to corridors, and a few more for loops.
fn doors(rooms: &[Room], random: &mut Random) -> Vec<Door> {
    let mut candidates = Vec::new();
    for (i, a) in rooms.iter().enumerate() {
        for (j, b) in rooms.iter().enumerate().skip(i + 1) {
            let wide = a.kind == Use::Hall || b.kind == Use::Hall;
            if let Some(door) = shared_wall(&a.rect, &b.rect, wide, random) {
                let to_corridor = a.kind == Use::Corridor || b.kind == Use::Corridor;
                let rank = random.unit() + if to_corridor { 0.0 } else { 1.0 };
                candidates.push((rank, i, j, door));
            }
        }
    }
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Corridors 0, 1 and 2 are one space.
    let mut group: Vec<usize> = (0..rooms.len()).map(|room| if room < 3 { 0 } else { room }).collect();
    let mut doors = Vec::new();
    for (_, i, j, door) in candidates {
        let (from, to) = (group[i], group[j]);
        if from != to {
            for g in &mut group {
                if *g == to {
                    *g = from;
                }
            }
            doors.push(door);
        } else if i >= 3 && random.happens(0.25) {
            doors.push(door);
        }
    }
    doors
}

/// A door somewhere in the wall that two rooms share, if that is long enough.
fn shared_wall(a: &Rect, b: &Rect, wide: bool, random: &mut Random) -> Option<Door> {
    for axis in 0..2 {
        let place = if a.max[axis] == b.min[axis] {
            a.max[axis]
        } else if b.max[axis] == a.min[axis] {
            b.max[axis]
        } else {
            continue;
        };
        let low = a.min[1 - axis].max(b.min[1 - axis]) + 0.5;
        let high = a.max[1 - axis].min(b.max[1 - axis]) - 0.5;
        let width: f64 = if wide { 2.0 } else { random.range(1.1, 1.35) };
        if high - low >= width {
            let along = random.range(low + width / 2.0, high - width / 2.0 + 1e-6);
            return Some(Door { axis, place, along, width });
        }
    }
    None
}
