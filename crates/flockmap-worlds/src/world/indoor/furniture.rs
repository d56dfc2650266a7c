//! What stands, hangs and lies in the rooms.

use super::rooms::{CEILING, Door, FLOOR, HALF_WALL, OUTER_WALL, Rect, Room, SIZE, Use};
use crate::random::Random;
use crate::world::draw::Canvas;

/// Furnishes a room; nothing stands in front of a door.
pub(super) fn furnish(canvas: &mut Canvas, room: &Room, doors: &[Door], random: &mut Random) {
    let is_outer = (0..2).any(|a| room.rect.min[a] <= -SIZE[a] / 2.0 || room.rect.max[a] >= SIZE[a] / 2.0);
    let walls = if is_outer { OUTER_WALL + 0.12 } else { HALF_WALL };
    let mut site = Site {
        canvas,
        random,
        inside: room.rect.shrunk(walls),
        taken: doors.iter().map(Door::zone).filter(|zone| zone.overlaps(&room.rect)).collect(),
    };
    site.ceiling(room.kind);
    match room.kind {
        Use::Corridor => {
            site.against_walls(4, [0.9, 0.4], |site, rect| site.block(rect, 0.0, 1.3));
            site.against_walls(3, [0.4, 0.4], Site::plant);
        }
        Use::Hall => {
            site.pillars();
            site.cubicles();
            for _ in 0..4 {
                site.against_wall([1.2, 0.45], Site::shelf);
                site.against_wall([0.5, 0.5], Site::plant);
            }
        }
        Use::Office => {
            let desks = 2 + (room.rect.area() / 9.0) as u32;
            for number in 0..desks {
                if number % 3 == 2 {
                    site.anywhere([1.6, 1.7], Site::desk);
                } else {
                    site.against_wall([1.6, 1.7], Site::desk);
                }
            }
            site.against_walls(3, [1.0, 0.4], Site::shelf);
            site.against_wall([0.45, 0.45], Site::plant);
            site.against_wall([0.3, 0.3], |site, rect| site.block(rect, 0.0, 0.4));
        }
        Use::Meeting => {
            let [x, y] = site.inside.size();
            let size = if x > y { [(x * 0.5).min(4.0), 1.3] } else { [1.3, (y * 0.5).min(4.0)] };
            site.middle(size, Site::meeting_table);
            site.against_wall([1.6, 0.5], |site, rect| site.block(rect, 0.0, 0.8));
            site.against_wall([0.45, 0.45], Site::plant);
        }
        Use::Storage => {
            site.against_walls(7, [1.3, 0.5], Site::shelf);
            for _ in 0..8 {
                site.anywhere([0.6, 0.5], Site::boxes);
            }
        }
        Use::Lounge => {
            site.against_walls(2, [2.0, 0.9], Site::sofa);
            site.anywhere([1.0, 0.6], |site, rect| site.table(rect, 0.42));
            site.against_wall([2.4, 0.65], |site, rect| site.block(rect, 0.0, 0.95));
            site.against_wall([0.75, 0.7], |site, rect| site.block(rect, 0.0, 1.9));
            site.against_walls(2, [0.5, 0.5], Site::plant);
        }
    }
}

/// A room with what already stands in it.
struct Site<'a> {
    canvas: &'a mut Canvas,
    random: &'a mut Random,
    inside: Rect,
    taken: Vec<Rect>,
}

impl Site<'_> {
    /// Places something of this size along a wall and deep into the room, turned to fit, if there is room for
    /// it.
    fn against_wall(&mut self, size: [f64; 2], draw: impl Fn(&mut Self, Rect)) {
        for _ in 0..12 {
            let axis = self.random.below(2) as usize;
            let mut extent = [0.0; 2];
            (extent[axis], extent[1 - axis]) = (size[1], size[0]);
            let mut min = [0.0; 2];
            let far = self.random.happens(0.5);
            min[axis] = if far { self.inside.max[axis] - extent[axis] } else { self.inside.min[axis] };
            let free = self.inside.size()[1 - axis] - extent[1 - axis];
            min[1 - axis] = self.inside.min[1 - axis] + self.random.unit() * free.max(0.0);
            if self.place(min, extent, &draw) {
                return;
            }
        }
    }

    /// So many of the same, one after the other.
    fn against_walls(&mut self, count: usize, size: [f64; 2], draw: impl Fn(&mut Self, Rect)) {
        (0..count).for_each(|_| self.against_wall(size, &draw));
    }

    /// Places something of this size, turned by 0 or 90°, anywhere with room around it.
    fn anywhere(&mut self, size: [f64; 2], draw: impl Fn(&mut Self, Rect)) {
        for _ in 0..12 {
            let extent = if self.random.happens(0.5) { size } else { [size[1], size[0]] };
            let min = core::array::from_fn(|a| {
                let free = self.inside.size()[a] - extent[a];
                self.inside.min[a] + self.random.unit() * free.max(0.0)
            });
            if self.place(min, extent, &draw) {
                return;
            }
        }
    }

    fn middle(&mut self, extent: [f64; 2], draw: impl Fn(&mut Self, Rect)) {
        let min = core::array::from_fn(|a| (self.inside.min[a] + self.inside.max[a] - extent[a]) / 2.0);
        self.place(min, extent, &draw);
    }

    fn place(&mut self, min: [f64; 2], extent: [f64; 2], draw: &impl Fn(&mut Self, Rect)) -> bool {
        let rect = Rect { min, max: [min[0] + extent[0], min[1] + extent[1]] };
        let within = (0..2).all(|a| rect.max[a] <= self.inside.max[a] + 1e-9);
        if !within || self.taken.iter().any(|other| other.overlaps(&rect)) {
            return false;
        }
        self.taken.push(rect);
        draw(self, rect);
        true
    }

    /// A box over the rectangle, from and to a height above the floor.
    fn block(&mut self, rect: Rect, from: f64, to: f64) {
        self.canvas.slab([rect.min[0], rect.min[1], FLOOR + from], [rect.max[0], rect.max[1], FLOOR + to]);
    }

    fn part(&mut self, x: [f64; 2], y: [f64; 2], z: [f64; 2]) {
        self.block(Rect { min: [x[0], y[0]], max: [x[1], y[1]] }, z[0], z[1]);
    }

    fn legs(&mut self, rect: Rect, height: f64) {
        for x in [rect.min[0], rect.max[0] - 0.06] {
            for y in [rect.min[1], rect.max[1] - 0.06] {
                self.part([x, x + 0.06], [y, y + 0.06], [0.0, height]);
            }
        }
    }

    fn table(&mut self, rect: Rect, height: f64) {
        self.block(rect, height - 0.06, height);
        self.legs(rect, height);
    }

    fn chair(&mut self, x: f64, y: f64) {
        let (seat, turn) = (0.46, self.random.below(4));
        self.part([x - 0.03, x + 0.03], [y - 0.03, y + 0.03], [0.0, seat]);
        self.part([x - 0.25, x + 0.25], [y - 0.03, y + 0.03], [0.0, 0.07]);
        self.part([x - 0.03, x + 0.03], [y - 0.25, y + 0.25], [0.0, 0.07]);
        self.part([x - 0.23, x + 0.23], [y - 0.23, y + 0.23], [seat - 0.06, seat]);
        let back = match turn {
            0 => [x - 0.23, y - 0.23, x - 0.17, y + 0.23],
            1 => [x + 0.17, y - 0.23, x + 0.23, y + 0.23],
            2 => [x - 0.23, y - 0.23, x + 0.23, y - 0.17],
            _ => [x - 0.23, y + 0.17, x + 0.23, y + 0.23],
        };
        self.part([back[0], back[2]], [back[1], back[3]], [seat + 0.1, seat + 0.5]);
    }

    /// A desk with monitor, drawers and a chair in a rectangle of 1.6 × 1.7 m.
    fn desk(&mut self, rect: Rect) {
        let [x, y] = rect.min;
        let [wide, deep] = rect.size();
        // The axis along its top, and the one from its back to the chair.
        let (along, away) = if wide < deep { (0, 1) } else { (1, 0) };
        let back = rect.min[away];
        let top = rect.part(away, back, back + 0.8);
        self.table(top, 0.74);
        let [cx, cy] = top.centre();
        let monitor = top.centre()[along] + self.random.range(-0.3, 0.3);
        for (half, low, high) in [(0.28, 0.84, 1.2), (0.04, 0.74, 0.84)] {
            let thin = rect.part(away, back + 0.15, back + 0.21);
            self.block(thin.part(along, monitor - half, monitor + half), low, high);
        }
        let drawers = rect.part(along, rect.min[along] + 0.1, rect.min[along] + 0.5);
        self.block(drawers.part(away, back + 0.1, back + 0.65), 0.0, 0.6);
        if wide < deep {
            let (dx, dy) = (self.random.range(-0.2, 0.3), self.random.range(0.95, 1.4));
            self.chair(cx + dx, y + dy);
        } else {
            let (dx, dy) = (self.random.range(0.95, 1.3), self.random.range(-0.2, 0.3));
            self.chair(x + dx, cy + dy);
        }
        // Papers and cups.
        for _ in 0..3 {
            let (px, py) = (
                self.random.range(top.min[0] + 0.1, top.max[0] - 0.2),
                self.random.range(top.min[1] + 0.1, top.max[1] - 0.2),
            );
            let high = self.random.range(0.05, 0.2);
            self.part([px, px + 0.12], [py, py + 0.12], [0.74, 0.74 + high]);
        }
    }

    /// A shelf with boards and things on them.
    fn shelf(&mut self, rect: Rect) {
        let high = self.random.range(1.5, 2.3);
        let axis = usize::from(rect.size()[1] > rect.size()[0]);
        for place in [rect.min[axis], rect.max[axis] - 0.05] {
            self.block(rect.part(axis, place, place + 0.05), 0.0, high);
        }
        let mut board = 0.1;
        while board < high {
            self.block(rect, board - 0.05, board);
            let mut at = rect.min[axis] + 0.08;
            while at < rect.max[axis] - 0.15 {
                let (width, tall) = (self.random.range(0.1, 0.4), self.random.range(0.12, 0.32));
                if self.random.happens(0.7) {
                    let thing = rect.shrunk(0.05).part(axis, at, (at + width).min(rect.max[axis] - 0.06));
                    self.block(thing, board, (board + tall).min(high));
                }
                at += width + 0.05;
            }
            board += 0.4;
        }
    }

    fn boxes(&mut self, rect: Rect) {
        let mut base = 0.0;
        let mut layer = rect;
        for _ in 0..1 + self.random.below(4) {
            let high = self.random.range(0.25, 0.5);
            self.block(layer, base, base + high);
            base += high;
            layer = layer.shrunk(self.random.range(0.0, 0.06));
        }
    }

    fn sofa(&mut self, rect: Rect) {
        self.block(rect.shrunk(0.1), 0.1, 0.42);
        let axis = usize::from(rect.size()[1] < rect.size()[0]);
        let near = (rect.min[axis] - self.inside.min[axis]).abs() < 0.1;
        let back = if near { rect.min[axis] } else { rect.max[axis] - 0.2 };
        self.block(rect.part(axis, back, if near { back + 0.2 } else { rect.max[axis] }), 0.05, 0.85);
        for place in [rect.min[1 - axis], rect.max[1 - axis] - 0.18] {
            self.block(rect.part(1 - axis, place, place + 0.18), 0.05, 0.62);
        }
    }

    fn meeting_table(&mut self, rect: Rect) {
        self.table(rect, 0.76);
        let long = usize::from(rect.size()[1] > rect.size()[0]);
        let mut at = rect.min[long] + 0.45;
        while at < rect.max[long] - 0.3 {
            for (side, out) in [(rect.min[1 - long], -0.35), (rect.max[1 - long], 0.35)] {
                let mut place = [0.0; 2];
                place[long] = at + self.random.range(-0.08, 0.08);
                place[1 - long] = side + out * self.random.range(0.4, 1.5);
                self.chair(place[0], place[1]);
            }
            at += 0.8;
        }
        // Chairs need room as well.
        let room = rect.shrunk(-0.9);
        self.taken.push(room);
    }

    fn plant(&mut self, rect: Rect) {
        self.block(rect.shrunk(0.08), 0.0, 0.35);
        let [x, y] = rect.centre();
        let high = self.random.range(0.9, 1.7);
        self.canvas.limb([x, y, FLOOR + 0.3], [x, y, FLOOR + high], 0.03, 0.02);
        for _ in 0..5 {
            let (dx, dy) = (self.random.range(-0.2, 0.2), self.random.range(-0.2, 0.2));
            let up = self.random.range(0.6, 1.0) * high;
            let size = self.random.range(0.15, 0.3);
            let seed = self.random.next_u64();
            self.canvas.foliage([x + dx, y + dy, FLOOR + up], [size, size, size], 0.35, seed);
        }
    }

    /// Pillars on a grid of about 5 m.
    fn pillars(&mut self) {
        let [nx, ny] = self.inside.size().map(|v| (v / 5.0).round().max(1.0) as u32);
        for i in 1..nx {
            for j in 1..ny {
                let x = self.inside.min[0] + self.inside.size()[0] * f64::from(i) / f64::from(nx);
                let y = self.inside.min[1] + self.inside.size()[1] * f64::from(j) / f64::from(ny);
                let rect = Rect { min: [x - 0.22, y - 0.22], max: [x + 0.22, y + 0.22] };
                self.taken.push(rect);
                self.block(rect, 0.0, CEILING - FLOOR);
            }
        }
    }

    /// Groups of four desks behind 1.4 m partitions, with aisles.
    fn cubicles(&mut self) {
        let group = [3.6, 3.6];
        let mut x = self.inside.min[0] + 1.4;
        while x + group[0] < self.inside.max[0] - 0.8 {
            let mut y = self.inside.min[1] + 1.4;
            while y + group[1] < self.inside.max[1] - 0.8 {
                let rect = Rect { min: [x, y], max: [x + group[0], y + group[1]] };
                let free = !self.taken.iter().any(|t| t.area() > 1.0 && t.overlaps(&rect));
                if free && self.random.happens(0.8) {
                    self.cubicle_group(rect);
                }
                y += group[1] + 1.7;
            }
            x += group[0] + 1.7;
        }
    }

    fn cubicle_group(&mut self, rect: Rect) {
        let [cx, cy] = rect.centre();
        self.block(rect.part(0, cx - 0.03, cx + 0.03), 0.0, 1.4);
        self.block(rect.part(1, cy - 0.03, cy + 0.03), 0.0, 1.4);
        for y in [rect.min[1], cy + 0.05] {
            for x in [rect.min[0], cx + 0.05] {
                self.desk(Rect { min: [x, y], max: [x + 1.6, y + 1.7] });
            }
        }
        self.taken.push(rect);
    }

    /// Lamps in rows, a beam here and there, a duct along corridors.
    fn ceiling(&mut self, kind: Use) {
        let top = CEILING - FLOOR;
        let [w, d] = self.inside.size();
        let (nx, ny) = ((w / 2.6).ceil().max(1.0) as u32, (d / 2.6).ceil().max(1.0) as u32);
        let drop = self.random.range(0.05, 0.6);
        for i in 0..nx {
            for j in 0..ny {
                let x = self.inside.min[0] + w * (f64::from(i) + 0.5) / f64::from(nx);
                let y = self.inside.min[1] + d * (f64::from(j) + 0.5) / f64::from(ny);
                self.part([x - 0.6, x + 0.6], [y - 0.08, y + 0.08], [top - drop - 0.1, top - drop]);
                if drop > 0.15 {
                    for end in [-0.5, 0.5] {
                        self.part([x + end - 0.03, x + end + 0.03], [y - 0.03, y + 0.03], [top - drop, top]);
                    }
                }
            }
        }
        match kind {
            Use::Corridor => {
                let long = usize::from(d > w);
                let side = self.inside.max[1 - long];
                self.block(self.inside.part(1 - long, side - 0.5, side), top - 0.45, top - 0.05);
            }
            Use::Hall => {
                let mut x = self.inside.min[0] + 2.5;
                while x < self.inside.max[0] {
                    self.block(self.inside.part(0, x - 0.15, x + 0.15), top - 0.35, top);
                    x += 5.0;
                }
            }
            _ => {}
        }
    }
}
