//! Where the known meets the unknown, and from where to look at it.

use super::sight::Sight;
use crate::{CellState, NavigationGrid};
use flockmap_plan::{Cluster, Clusters, FrontierConfig};
use flockmap_worlds::curve::distance;
use libm::atan2;

/// A frontier reaches no further than this from its first cell, in metres.
const REACH_M: f64 = 1.5;

/// Fewer cells are no frontier.
const CELLS_MIN: usize = 6;

/// An Unknown cell that was in view from so many directions (of eight) stays unknown: nothing comes back from
/// there.
pub(super) const DIRECTIONS_MAX: u32 = 3;

/// How likely something comes back from an Unknown cell that was in view from none, one or two directions in
/// vain.
const PROBABILITIES: [f64; DIRECTIONS_MAX as usize] = [1.0, 0.5, 0.25];

/// A viewpoint from which fewer cells are expected to be seen is not worth the flight.
pub(super) const GAIN_MIN: f64 = 40.0;

/// Cells of a frontier that viewpoints are judged by.
const SAMPLES_MAX: usize = 24;

/// Viewpoints kept of each frontier.
const VIEWPOINTS_MAX: usize = 4;

/// Plans after which a frontier without a viewpoint is looked at again.
const PATIENCE: u32 = 6;

/// A place to look at a frontier from.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Viewpoint {
    pub(super) place: [f64; 3],
    pub(super) yaw: f64,
    /// About how many cells are to be seen from there.
    pub(super) gain: f64,
}

/// Free cells beside Unknown ones, near each other.
#[derive(Clone, Debug)]
pub(super) struct Frontier {
    pub(super) cells: Vec<u32>,
    /// Number of cells when it was found.
    found: usize,
    pub(super) centre: [f64; 3],
    /// Best first. Empty: there is no place to see it from.
    pub(super) viewpoints: Vec<Viewpoint>,
    /// Plans until viewpoints are searched again.
    patience: u32,
}

/// All frontiers of a robot's grid.
#[derive(Clone, Debug)]
pub(super) struct Frontiers {
    pub(super) list: Vec<Frontier>,
    /// The directions, an octant each, in which each cell was looked at while Unknown.
    looks: Vec<u8>,
    /// The cells of the list.
    clusters: Clusters,
}

impl Frontiers {
    pub(super) fn new(grid: &NavigationGrid) -> Self {
        let config = FrontierConfig { reach_m: REACH_M, cells_min: CELLS_MIN };
        let clusters = Clusters::new(grid.cells, config);
        Self { list: Vec::new(), looks: vec![0; grid.count()], clusters }
    }

    /// How likely something comes back from an Unknown cell that is looked at in a direction of this octant:
    /// 0 if it was looked at from there before, or from too many sides in vain.
    fn probability(&self, cell: usize, octant: u8) -> f64 {
        let looks = self.looks[cell];
        let is_new = looks >> octant & 1 == 0;
        PROBABILITIES.get(looks.count_ones() as usize).copied().filter(|_| is_new).unwrap_or(0.0)
    }

    /// How much is to be seen from a viewpoint now.
    pub(super) fn gain(&self, grid: &NavigationGrid, sight: &Sight, from: &Viewpoint) -> f64 {
        sight.gain(grid, from.place, from.yaw, |cell, octant| self.probability(cell, octant))
    }

    /// Takes down what is to be seen from a viewpoint now, and drops it if that is not worth the flight any more.
    pub(super) fn note_gain(&mut self, now: &Viewpoint) {
        for frontier in &mut self.list {
            frontier.viewpoints.retain_mut(|viewpoint| {
                if viewpoint.place == now.place {
                    viewpoint.gain = now.gain;
                }
                viewpoint.gain >= GAIN_MIN
            });
        }
    }

    /// Drops what has been seen, finds what is new, and viewpoints for it. `is_open` says where one can fly.
    pub(super) fn update(&mut self, grid: &NavigationGrid, sight: &Sight, is_open: impl Fn(usize) -> bool) {
        let mut list = core::mem::take(&mut self.list);
        list.retain_mut(|frontier| {
            self.clusters.release(&frontier.cells);
            frontier.cells.retain(|cell| is_frontier(&self.looks, grid, *cell as usize));
            let stays = frontier.cells.len() >= CELLS_MIN && frontier.cells.len() * 4 >= frontier.found * 3;
            if stays {
                self.clusters.claim(&frontier.cells);
            }
            stays
        });
        for frontier in &mut list {
            frontier.viewpoints.retain(|v| grid.cells.cell_at(v.place).is_some_and(&is_open));
            if frontier.viewpoints.is_empty() {
                frontier.patience = frontier.patience.saturating_sub(1);
                if frontier.patience == 0 {
                    self.find_viewpoints(frontier, grid, sight, &is_open);
                }
            }
        }
        let looks = &self.looks;
        let found = self.clusters.find(0..grid.count(), |cell| is_frontier(looks, grid, cell));
        for Cluster { cells, centroid_m: centre } in found {
            let (found, viewpoints) = (cells.len(), Vec::new());
            let mut frontier = Frontier { cells, found, centre, viewpoints, patience: 0 };
            self.find_viewpoints(&mut frontier, grid, sight, &is_open);
            list.push(frontier);
        }
        self.list = list;
    }

    /// Counts a look from a place at all cells that can be seen from there; call it some times a second.
    pub(super) fn look(&mut self, grid: &NavigationGrid, sight: &Sight, place: [f64; 3], yaw: f64) {
        for (cell, octant) in sight.first_unknown(grid, place, yaw) {
            self.looks[cell] |= 1 << octant;
        }
    }

    /// Counts a visit to a frontier with these cells as so many looks in new directions at what is still
    /// Unknown beside them, whatever the map says: nobody goes to the same place for ever.
    pub(super) fn count_visit(&mut self, grid: &NavigationGrid, cells: &[u32], looks: u32) {
        let mut beside: Vec<usize> =
            cells.iter().flat_map(|cell| grid.cells.beside(*cell as usize)).collect();
        beside.sort_unstable();
        beside.dedup();
        for cell in beside {
            if grid.cell_state(cell) == CellState::Unknown {
                for _ in 0..looks {
                    self.looks[cell] |= self.looks[cell].wrapping_add(1);
                }
            }
        }
    }

    /// Share of these cells that are still frontiers.
    pub(super) fn share_left(&self, grid: &NavigationGrid, cells: &[u32]) -> f64 {
        let left = cells.iter().filter(|cell| is_frontier(&self.looks, grid, **cell as usize)).count();
        left as f64 / cells.len().max(1) as f64
    }

    /// Judges places on rings round the centre of a frontier: those that see a good part of it, and of these
    /// the ones from which most is to be seen.
    fn find_viewpoints(
        &self,
        frontier: &mut Frontier,
        grid: &NavigationGrid,
        sight: &Sight,
        is_open: &impl Fn(usize) -> bool,
    ) {
        frontier.patience = PATIENCE;
        let stride = frontier.cells.len().div_ceil(SAMPLES_MAX);
        let samples: Vec<usize> = frontier.cells.iter().step_by(stride).map(|cell| *cell as usize).collect();
        let wanted = (samples.len() as f64 * 0.3).max(2.0);
        let centre = frontier.centre;
        let mut found: Vec<(usize, Viewpoint)> = Vec::new();
        for ring in [0.15, 0.3, 0.5, 0.75] {
            let radius = ring * sight.range_m;
            for step in 0..12 {
                let angle = f64::from(step) * core::f64::consts::PI / 6.0;
                for height in [-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5] {
                    let place = [
                        centre[0] + radius * libm::cos(angle),
                        centre[1] + radius * libm::sin(angle),
                        centre[2] + height,
                    ];
                    let Some(cell) = grid.cells.cell_at(place).filter(|cell| is_open(*cell)) else {
                        continue;
                    };
                    let place = grid.cells.centre(cell);
                    let yaw = atan2(centre[1] - place[1], centre[0] - place[0]);
                    let sees = |cell: &&usize| {
                        sight.sees_beyond(grid, place, Some(yaw), **cell, |c, octant| {
                            grid.cell_state(c) == CellState::Unknown && self.probability(c, octant) > 0.0
                        })
                    };
                    let seen = samples.iter().filter(sees).count();
                    if seen as f64 >= wanted {
                        found.push((seen, Viewpoint { place, yaw, gain: 0.0 }));
                    }
                }
            }
        }
        // A stable sort: of equals the nearer ring comes first.
        found.sort_by_key(|(seen, _)| core::cmp::Reverse(*seen));
        for (_, mut viewpoint) in found {
            let apart = |other: &Viewpoint| distance(other.place, viewpoint.place) > 0.9;
            if frontier.viewpoints.len() < VIEWPOINTS_MAX && frontier.viewpoints.iter().all(apart) {
                viewpoint.gain = self.gain(grid, sight, &viewpoint);
                frontier.viewpoints.push(viewpoint);
            }
        }
        frontier.viewpoints.retain(|viewpoint| viewpoint.gain >= GAIN_MIN);
    }
}

/// Whether a cell is Unknown and was not looked at in vain.
fn is_worth(looks: &[u8], grid: &NavigationGrid, cell: usize) -> bool {
    looks[cell].count_ones() < DIRECTIONS_MAX && grid.cell_state(cell) == CellState::Unknown
}

/// Whether a cell is Free and has an Unknown one beside it that is worth looking at.
fn is_frontier(looks: &[u8], grid: &NavigationGrid, cell: usize) -> bool {
    grid.cell_state(cell) == CellState::Free
        && grid.cells.beside(cell).any(|next| is_worth(looks, grid, next))
}
