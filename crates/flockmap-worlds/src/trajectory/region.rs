//! The parts of the space that the robots have to themselves.

use super::space::Space;
use super::{TrajectoryError, TrajectoryOptions};
use std::rc::Rc;

/// Rounds in which the parts are evened out.
const ROUNDS: usize = 8;

const NOBODY: u8 = u8::MAX;

/// The connected part of the space in which one robot flies.
pub(super) struct Region {
    /// For each cell of the grid the robot whose region it is.
    owner: Rc<Vec<u8>>,
    robot: u8,
    /// The cells of the region, ascending.
    pub(super) cells: Vec<u32>,
    /// Where the robot starts.
    pub(super) start: usize,
}

impl Region {
    pub(super) fn contains(&self, cell: usize) -> bool {
        self.owner[cell] == self.robot
    }
}

/// Divides the space into connected parts of about the same size, at least the wanted separation apart from
/// each other.
pub(super) fn divide(
    space: &Space,
    robots: usize,
    options: &TrajectoryOptions,
) -> Result<Vec<Region>, TrajectoryError> {
    let mut seeds = spread(space, robots);
    let mut owner = nearest_seed(space, &seeds);
    for _ in 0..ROUNDS {
        seeds = centres(space, &owner, robots);
        owner = nearest_seed(space, &seeds);
    }
    let apart = separate(space, &owner, robots, options)?;

    let mut owner = vec![NOBODY; space.count()];
    for (robot, cells) in apart.iter().enumerate() {
        for &cell in cells {
            owner[cell as usize] = robot as u8;
        }
    }
    let owner = Rc::new(owner);
    let middle = centroid(space, space.cells());
    let region = |(robot, cells): (usize, Vec<u32>)| {
        let start = nearest_cell(space, &cells, middle);
        Region { owner: Rc::clone(&owner), robot: robot as u8, cells, start }
    };
    Ok(apart.into_iter().enumerate().map(region).collect())
}

/// As many cells as robots, each far from the others.
fn spread(space: &Space, robots: usize) -> Vec<usize> {
    let mut seeds: Vec<usize> = Vec::new();
    let first = space.cells().first().map_or(0, |cell| *cell as usize);
    while seeds.len() < robots {
        let from = if seeds.is_empty() { vec![first] } else { seeds.clone() };
        seeds.push(flood(space, &from).last().map_or(first, |(cell, _)| *cell as usize));
    }
    seeds
}

/// Cells of the space in the order in which they are reached from the seeds, each with the seed that reached
/// it first.
fn flood(space: &Space, seeds: &[usize]) -> Vec<(u32, u8)> {
    let mut reached = vec![false; space.count()];
    let mut order = Vec::with_capacity(space.cells().len());
    for (number, &seed) in seeds.iter().enumerate() {
        if !reached[seed] {
            reached[seed] = true;
            order.push((seed as u32, number as u8));
        }
    }
    let mut done = 0;
    while let Some(&(cell, seed)) = order.get(done) {
        for next in space.lattice().beside(cell as usize) {
            if !reached[next] && space.openness(next) != super::space::BLOCKED {
                reached[next] = true;
                order.push((next as u32, seed));
            }
        }
        done += 1;
    }
    order
}

fn nearest_seed(space: &Space, seeds: &[usize]) -> Vec<u8> {
    let mut owner = vec![NOBODY; space.count()];
    for (cell, seed) in flood(space, seeds) {
        owner[cell as usize] = seed;
    }
    owner
}

/// For each part its cell nearest to its middle.
fn centres(space: &Space, owner: &[u8], robots: usize) -> Vec<usize> {
    (0..robots)
        .map(|robot| {
            let own = |cell: &u32| owner[*cell as usize] == robot as u8;
            let cells: Vec<u32> = space.cells().iter().copied().filter(own).collect();
            nearest_cell(space, &cells, centroid(space, &cells))
        })
        .collect()
}

/// The parts without the cells that lie too close to a part before, each reduced to its largest connected
/// piece.
fn separate(
    space: &Space,
    owner: &[u8],
    robots: usize,
    options: &TrajectoryOptions,
) -> Result<Vec<Vec<u32>>, TrajectoryError> {
    let reach = ((options.separation_m / space.step_m()).ceil() as usize + 1).min(255);
    let mut taken = vec![false; space.count()];
    let mut parts = Vec::with_capacity(robots);
    for robot in 0..robots {
        let distance = space.distances(&taken, reach);
        let cells = space.largest_component(space.cells(), |cell| {
            let away = f64::from(distance[cell]).sqrt() * space.step_m();
            owner[cell] == robot as u8 && (robot == 0 || away >= options.separation_m)
        });
        // Less than one square metre is no place to fly.
        if space.area_m2(&cells) < 1.0 {
            return Err(TrajectoryError::Crowded {
                robot,
                robots,
                area_m2: space.area_m2(space.cells()),
                clearance_m: space.clearance_m(),
                separation_m: options.separation_m,
            });
        }
        for &cell in &cells {
            taken[cell as usize] = true;
        }
        parts.push(cells);
    }
    Ok(parts)
}

fn centroid(space: &Space, cells: &[u32]) -> [f64; 3] {
    let mut sum = [0.0; 3];
    for &cell in cells {
        let centre = space.centre(cell as usize);
        for a in 0..3 {
            sum[a] += centre[a];
        }
    }
    sum.map(|v| v / cells.len().max(1) as f64)
}

/// The cell nearest to a point; of two as near the lower. Cell 0 if there are none.
fn nearest_cell(space: &Space, cells: &[u32], point: [f64; 3]) -> usize {
    let mut best = (f64::INFINITY, 0);
    for &cell in cells {
        let centre = space.centre(cell as usize);
        let square = (0..3).map(|a| (centre[a] - point[a]) * (centre[a] - point[a])).sum();
        if square < best.0 {
            best = (square, cell as usize);
        }
    }
    best.1
}
