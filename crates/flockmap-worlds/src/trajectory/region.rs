//! The parts of the space that the robots have to themselves.

use super::space::{BLOCKED, Space, area_m2, distances, largest_part};
use super::{TrajectoryError, TrajectoryOptions};
use flockmap_plan::lattice::flood;
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
    for _ in 0..ROUNDS {
        seeds = centres(space, &flood_from(space, &seeds).1, robots);
    }
    let apart = separate(space, &flood_from(space, &seeds).1, robots, options)?;

    let mut owner = vec![NOBODY; space.lattice.count()];
    for (robot, cells) in apart.iter().enumerate() {
        for &cell in cells {
            owner[cell as usize] = robot as u8;
        }
    }
    let owner = Rc::new(owner);
    let middle = space.lattice.middle(&space.cells);
    let region = |(robot, cells): (usize, Vec<u32>)| {
        let start = nearest_cell(space, &cells, middle);
        Region { owner: Rc::clone(&owner), robot: robot as u8, cells, start }
    };
    Ok(apart.into_iter().enumerate().map(region).collect())
}

/// As many cells as robots, each far from the others.
fn spread(space: &Space, robots: usize) -> Vec<usize> {
    let mut seeds: Vec<usize> = Vec::new();
    let first = space.cells.first().map_or(0, |cell| *cell as usize);
    while seeds.len() < robots {
        let from = if seeds.is_empty() { vec![first] } else { seeds.clone() };
        seeds.push(flood_from(space, &from).0.last().map_or(first, |cell| *cell as usize));
    }
    seeds
}

/// Cells of the space in the order in which they are reached from the seeds, and for each cell the number of
/// the seed that reached it first.
fn flood_from(space: &Space, seeds: &[usize]) -> (Vec<u32>, Vec<u8>) {
    let mut owner = vec![NOBODY; space.lattice.count()];
    let mut first = Vec::new();
    for (number, &seed) in seeds.iter().enumerate() {
        if owner[seed] == NOBODY {
            owner[seed] = number as u8;
            first.push(seed as u32);
        }
    }
    let enter = |from: usize, next: usize| {
        let is_new = owner[next] == NOBODY && space.openness(next) != BLOCKED;
        if is_new {
            owner[next] = owner[from];
        }
        is_new
    };
    let order = flood(first, |cell| space.lattice.beside(cell), enter);
    (order, owner)
}

/// For each part its cell nearest to its middle.
fn centres(space: &Space, owner: &[u8], robots: usize) -> Vec<usize> {
    (0..robots)
        .map(|robot| {
            let own = |cell: &u32| owner[*cell as usize] == robot as u8;
            let cells: Vec<u32> = space.cells.iter().copied().filter(own).collect();
            nearest_cell(space, &cells, space.lattice.middle(&cells))
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
    let reach = ((options.separation_m / space.lattice.side_m()).ceil() as usize + 1).min(255);
    let lattice = &space.lattice;
    let mut taken = vec![false; lattice.count()];
    let mut parts = Vec::with_capacity(robots);
    for robot in 0..robots {
        let distance = distances(lattice, &taken, reach);
        let cells = largest_part(lattice, &space.cells, |cell| {
            let away = f64::from(distance[cell]).sqrt() * lattice.side_m();
            owner[cell] == robot as u8 && (robot == 0 || away >= options.separation_m)
        });
        // Less than one square metre is no place to fly.
        if area_m2(lattice, &cells) < 1.0 {
            return Err(TrajectoryError::Crowded {
                robot,
                robots,
                area_m2: area_m2(lattice, &space.cells),
                clearance_m: space.clearance_m,
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

/// The cell nearest to a point; of two as near the lower. Cell 0 if there are none.
fn nearest_cell(space: &Space, cells: &[u32], point: [f64; 3]) -> usize {
    let square = |cell: &u32| {
        let centre = space.lattice.centre(*cell as usize);
        (0..3).map(|a| (centre[a] - point[a]) * (centre[a] - point[a])).sum::<f64>()
    };
    let nearest = cells.iter().map(|cell| (square(cell), *cell)).min_by(|a, b| a.0.total_cmp(&b.0));
    nearest.map_or(0, |(_, cell)| cell as usize)
}
