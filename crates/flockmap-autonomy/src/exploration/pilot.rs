//! One robot's planner: what to look at next, and how to get there.

use super::frontier::{DIRECTIONS_MAX, Frontiers, GAIN_MIN, Viewpoint};
use super::mates::{Mate, cells_near, dense, metres_to_path};
use super::regions::{Regions, tour, work};
use super::sight::Sight;
use super::start::ROOM_M;
use crate::{
    Motion, MotionLimits, NavigationConfig, NavigationError, NavigationGrid, NoRoute, RouteQuery, Router,
};
use flockmap_grid::{MapView, Stamp};
use flockmap_worlds::curve::{distance, wrapped};
use libm::atan2;

/// Time between two plans, at least.
const PLAN_PAUSE_MICROS: i64 = 300_000;

/// Time after which the goal is thought over even if nothing has happened.
const PLAN_PERIOD_MICROS: i64 = 1_500_000;

/// The same for a robot that has nothing to do.
const IDLE_PAUSE_MICROS: i64 = 1_000_000;

/// A robot that knows of something to look at but of no path there for so long makes do with less clearance.
const SHUT_IN_MICROS: i64 = 2_000_000;

/// Metres by which it does, and the least clearance: that of its body.
const CLEARANCE_STEP_M: f64 = 0.1;
const CLEARANCE_MIN_M: f64 = 0.2;

/// Time between two looks round that count.
const LOOK_PERIOD_MICROS: i64 = 300_000;

/// Time at a viewpoint: five scans.
const STAY_MICROS: i64 = 500_000;

/// A goal counts as seen when this share of its frontier is left, or this share of what was to be seen from
/// there.
const SEEN_SHARE: f64 = 0.3;

/// Metres around the robot within which paths are searched first.
const NEAR_M: f64 = 30.0;

/// The present goal counts for so much more than others, and so do those in the region that comes first.
const LOYALTY: f64 = 1.5;
const FIRST_REGION: f64 = 1.5;

/// Seconds that every goal costs beside the path.
const STOP_S: f64 = 1.5;

/// Seconds to turn by one radian in flight.
const TURN_S: f64 = 0.6;

/// Cells to be seen for each second of flight, at least: for less nobody sets out.
const WORTH_MIN: f64 = 5.0;

/// Goals whose gain is worked out anew before one is chosen.
const SHORT_LIST: usize = 16;

/// Metres ahead within which the path is watched.
const WATCH_M: f64 = 8.0;

/// Distance beyond the separation at which paths lead past others, in metres.
const DETOUR_M: f64 = 0.3;

/// Cells looked at by a search for one path.
const EXPANSIONS_MAX: usize = 2_000_000;

/// What a robot flies to.
#[derive(Clone, Debug)]
struct Goal {
    /// From where, and how much was to be seen from there when it was chosen.
    viewpoint: Viewpoint,
    /// The frontier that is to be seen; empty: it only lets another pass.
    cells: Vec<u32>,
}

/// Which robot a pilot flies, and how.
pub(super) struct PilotConfig {
    pub(super) number: usize,
    pub(super) start: [f64; 3],
    pub(super) navigation: NavigationConfig,
    pub(super) sight: Sight,
    pub(super) regions: Regions,
    pub(super) limits: MotionLimits,
    pub(super) heights_m: [f64; 2],
    pub(super) separation_m: f64,
}

/// Plans and flies one robot.
pub(super) struct Pilot {
    pub(super) config: PilotConfig,
    pub(super) motion: Motion,
    grid: NavigationGrid,
    router: Router,
    frontiers: Frontiers,
    /// The regions that this robot takes for its own.
    pub(super) own: Vec<bool>,
    /// Seconds of work in each region, as far as it knows.
    pub(super) work: Vec<f64>,
    goal: Option<Goal>,
    intended: Option<Vec<[f64; 3]>>,
    planned: Option<Stamp>,
    looked: Option<Stamp>,
    arrived: Option<Stamp>,
    /// Since when it has found nothing to do.
    pub(super) idle_since: Option<Stamp>,
    pub(super) path_m: f64,
}

impl Pilot {
    pub(super) fn new(config: PilotConfig) -> Result<Self, NavigationError> {
        let count = config.regions.count();
        let mut grid = NavigationGrid::new(&config.navigation)?;
        grid.assume_free(config.start, ROOM_M);
        Ok(Self {
            motion: Motion::new(config.start, 0.0),
            router: Router::new(&grid),
            frontiers: Frontiers::new(&grid),
            grid,
            own: vec![true; count],
            work: vec![0.0; count],
            goal: None,
            intended: None,
            planned: None,
            looked: None,
            arrived: None,
            idle_since: None,
            path_m: 0.0,
            config,
        })
    }

    pub(super) fn mate(&self) -> Mate {
        Mate {
            number: self.config.number,
            stopping_path: self.motion.stopping_path(&self.config.limits),
            intended: self.intended.clone(),
        }
    }

    /// Number of frontiers that it can look at from somewhere.
    pub(super) fn frontier_count(&self) -> usize {
        self.frontiers.list.iter().filter(|f| !f.viewpoints.is_empty()).count()
    }

    /// Takes in the map, and plans if it is time to.
    pub(super) fn plan(&mut self, now: Stamp, map: &MapView, mates: &[Mate]) {
        if self.is_shut_in(now) {
            self.squeeze();
        }
        self.grid.update(map);
        let looks = self.looked.is_none_or(|at| now.micros_since(at) >= LOOK_PERIOD_MICROS);
        if looks {
            self.looked = Some(now);
            self.frontiers.look(&self.grid, &self.config.sight, self.motion.position(), self.motion.yaw());
        }
        let mut due = self.planned.is_none_or(|at| now.micros_since(at) >= PLAN_PERIOD_MICROS);
        if !self.path_is_clear() {
            self.motion.brake(&self.config.limits);
            self.goal = None;
            due = true;
        }
        if let Some(goal) = &self.goal {
            let there = self.motion.is_at_end();
            let reached = there && distance(self.motion.position(), goal.viewpoint.place) < 0.3;
            if goal.cells.is_empty() {
                due |= reached;
            } else if looks && self.is_seen(goal) {
                self.frontiers.count_visit(&self.grid, &goal.cells, 1);
                self.goal = None;
                due = true;
            } else if reached {
                let since = *self.arrived.get_or_insert(now);
                // Nothing better to do than to stay until it has been looked at.
                due = false;
                if now.micros_since(since) >= STAY_MICROS {
                    self.frontiers.count_visit(&self.grid, &goal.cells, DIRECTIONS_MAX);
                    self.goal = None;
                    due = true;
                }
            } else {
                due |= there;
            }
        } else {
            due = true;
        }
        let pause = if self.idle_since.is_some() { IDLE_PAUSE_MICROS } else { PLAN_PAUSE_MICROS };
        let rested = self.planned.is_none_or(|at| now.micros_since(at) >= pause);
        if due && rested {
            self.planned = Some(now);
            self.arrived = None;
            self.choose(now, mates);
        }
    }

    /// Where it looks while it flies: ahead, and near its goal to where there is something to see.
    pub(super) fn yaw_target(&self) -> f64 {
        let v = self.motion.velocity();
        let flies = (v[0] * v[0] + v[1] * v[1]).sqrt() > 0.2;
        match &self.goal {
            Some(goal) if self.motion.remaining_m() < 1.5 => goal.viewpoint.yaw,
            _ if flies => atan2(v[1], v[0]),
            _ => self.motion.yaw(),
        }
    }

    /// Whether there is something to look at in its regions, be there a path or not.
    fn has_targets(&self) -> bool {
        let is_own = |centre| self.own[self.config.regions.at(centre)];
        self.frontiers.list.iter().any(|frontier| !frontier.viewpoints.is_empty() && is_own(frontier.centre))
    }

    /// Whether it has had nothing to do for a while though there is something to look at in its regions.
    fn is_shut_in(&self, now: Stamp) -> bool {
        self.idle_since.is_some_and(|since| now.micros_since(since) >= SHUT_IN_MICROS)
            && self.config.navigation.clearance_m - CLEARANCE_STEP_M >= CLEARANCE_MIN_M - 1e-9
            && self.has_targets()
    }

    /// Makes do with less clearance from now on: what was a path when less of it was known may have turned
    /// out too narrow.
    fn squeeze(&mut self) {
        self.config.navigation.clearance_m -= CLEARANCE_STEP_M;
        // The same region as before, so it works, and cells keep their numbers.
        if let Ok(mut grid) = NavigationGrid::new(&self.config.navigation) {
            grid.assume_free(self.config.start, ROOM_M);
            self.grid = grid;
            self.idle_since = None;
            self.planned = None;
        }
    }

    /// Whether the path ahead leads through passable cells, once it has come to the first of them.
    fn path_is_clear(&self) -> bool {
        let mut entered = false;
        let mut ahead = 0.0;
        let path = self.motion.path();
        for (i, &point) in path.iter().enumerate() {
            if i > 0 {
                ahead += distance(path[i - 1], point);
            }
            if ahead > WATCH_M {
                break;
            }
            let open = self.grid.cells.cell_at(point).is_some_and(|cell| self.grid.is_passable(cell, false));
            if entered && !open {
                return false;
            }
            entered |= open;
        }
        true
    }

    /// Chooses the next goal and sets out for it.
    fn choose(&mut self, now: Stamp, mates: &[Mate]) {
        let (grid, heights) = (&self.grid, self.config.heights_m);
        self.frontiers.update(grid, &self.config.sight, |cell| {
            grid.is_passable(cell, false) && !is_closed(grid, heights, &[], cell)
        });
        let mut cells = vec![0; self.config.regions.count()];
        for frontier in self.frontiers.list.iter().filter(|f| !f.viewpoints.is_empty()) {
            cells[self.config.regions.at(frontier.centre)] += frontier.cells.len();
        }
        self.work = work(&self.config.regions.unknown_shares(grid), &cells);

        let from = self.motion.stopping_point(&self.config.limits);
        let near_mates = cells_near(&self.grid, mates, self.config.separation_m + DETOUR_M);
        self.intended = None;
        let mut goal = None;
        let has_targets = self.has_targets();
        // Near first: most of the time that is enough, and far cheaper.
        for metres_max in [NEAR_M, f64::INFINITY] {
            if goal.is_none() && has_targets {
                self.flood(from, metres_max, &near_mates);
                goal = self.best_goal(from);
            }
        }
        if let Some(goal) = goal {
            self.idle_since = None;
            self.go(from, goal, &near_mates);
            return;
        }
        // Perhaps somebody blocks the path.
        if has_targets && !near_mates.is_empty() {
            self.flood(from, f64::INFINITY, &[]);
            if let Some(goal) = self.best_goal(from) {
                self.idle_since = None;
                self.intended = self.route(from, goal.viewpoint.place, &[]).ok();
            }
        }
        if self.intended.is_none() {
            self.idle_since.get_or_insert(now);
        }
        self.goal = None;
        self.let_pass(from, mates, &near_mates);
    }

    /// Finds the paths to all places within a distance, clear of cells near others.
    fn flood(&mut self, from: [f64; 3], metres_max: f64, near_mates: &[usize]) {
        let (grid, heights) = (&self.grid, self.config.heights_m);
        self.router.flood(grid, from, metres_max, |cell| is_closed(grid, heights, near_mates, cell));
    }

    /// The path to a place, clear of cells near others.
    fn route(
        &mut self,
        from: [f64; 3],
        to: [f64; 3],
        near_mates: &[usize],
    ) -> Result<Vec<[f64; 3]>, NoRoute> {
        let query = RouteQuery { from, to, unknown_ok: false, expansions_max: EXPANSIONS_MAX };
        let (grid, heights) = (&self.grid, self.config.heights_m);
        self.router.route(grid, &query, |cell| is_closed(grid, heights, near_mates, cell))
    }

    /// How much is to be seen from a viewpoint now.
    fn gain(&self, viewpoint: &Viewpoint) -> f64 {
        self.frontiers.gain(&self.grid, &self.config.sight, viewpoint)
    }

    fn is_seen(&self, goal: &Goal) -> bool {
        self.frontiers.share_left(&self.grid, &goal.cells) <= SEEN_SHARE
            || self.gain(&goal.viewpoint) <= SEEN_SHARE * goal.viewpoint.gain
    }

    /// The goal in the own regions with the most to see for the time it takes; those in the first region of a
    /// tour through all own regions count more. Only what the last flood reached. What turns out to have been
    /// seen meanwhile is dropped.
    fn best_goal(&mut self, from: [f64; 3]) -> Option<Goal> {
        loop {
            let (viewpoints, goal) = self.short_list(from)?;
            viewpoints.iter().for_each(|viewpoint| self.frontiers.note_gain(viewpoint));
            if goal.is_some() {
                return goal;
            }
        }
    }

    /// The best goals by what was known of them, each with what is to be seen from there now, and the best of
    /// those. `None` if there are none.
    fn short_list(&self, from: [f64; 3]) -> Option<(Vec<Viewpoint>, Option<Goal>)> {
        struct Candidate {
            viewpoint: Viewpoint,
            seconds: f64,
            frontier: usize,
            region: usize,
        }
        let velocity = self.motion.velocity();
        let heading = (self.motion.speed() > 0.3).then(|| atan2(velocity[1], velocity[0]));
        let mut candidates: Vec<Candidate> = Vec::new();
        for (number, frontier) in self.frontiers.list.iter().enumerate() {
            let region = self.config.regions.at(frontier.centre);
            if !self.own[region] {
                continue;
            }
            for viewpoint in &frontier.viewpoints {
                let cell = self.grid.cells.cell_at(viewpoint.place);
                let Some(metres) = cell.and_then(|cell| self.router.metres_to(&self.grid, cell)) else {
                    continue;
                };
                let ahead = atan2(viewpoint.place[1] - from[1], viewpoint.place[0] - from[0]);
                let turn = heading.map_or(0.0, |heading| wrapped(ahead - heading).abs());
                let seconds = metres / self.config.limits.speed_m_s + TURN_S * turn + STOP_S;
                if viewpoint.gain >= WORTH_MIN * seconds {
                    candidates.push(Candidate { viewpoint: *viewpoint, seconds, frontier: number, region });
                }
            }
        }
        // Regions in the order in which they are to be visited.
        let mut nearest: Vec<(usize, f64)> = Vec::new();
        for candidate in &candidates {
            match nearest.iter_mut().find(|(known, _)| *known == candidate.region) {
                Some((_, seconds)) => *seconds = seconds.min(candidate.seconds),
                None => nearest.push((candidate.region, candidate.seconds)),
            }
        }
        let first: Vec<f64> =
            nearest.iter().map(|(_, seconds)| seconds * self.config.limits.speed_m_s).collect();
        let centre = |i: usize| self.config.regions.centre(nearest[i].0);
        let order = tour(&first, |a, b| 1.2 * distance(centre(a), centre(b)));
        let first_region = nearest.get(*order.first()?)?.0;
        let present = self.goal.as_ref().map(|goal| goal.viewpoint.place);
        let worth = |candidate: &Candidate| {
            let first = if candidate.region == first_region { FIRST_REGION } else { 1.0 };
            let loyal = if present == Some(candidate.viewpoint.place) { LOYALTY } else { 1.0 };
            // Less than in proportion to the gain: what is left behind has to be come back for.
            candidate.viewpoint.gain.sqrt() * first * loyal / candidate.seconds
        };
        candidates.sort_by(|a, b| worth(b).total_cmp(&worth(a)));
        candidates.truncate(SHORT_LIST);
        for candidate in &mut candidates {
            candidate.viewpoint.gain = self.gain(&candidate.viewpoint);
        }
        let viewpoints = candidates.iter().map(|candidate| candidate.viewpoint).collect();
        let is_worth = |gain: f64, seconds: f64| gain >= GAIN_MIN && gain >= WORTH_MIN * seconds;
        let worthy = candidates.iter().filter(|c| is_worth(c.viewpoint.gain, c.seconds));
        let best = worthy.max_by(|a, b| worth(a).total_cmp(&worth(b)));
        let cells = |frontier: usize| self.frontiers.list[frontier].cells.clone();
        let goal = best.map(|best| Goal { viewpoint: best.viewpoint, cells: cells(best.frontier) });
        Some((viewpoints, goal))
    }

    fn go(&mut self, from: [f64; 3], goal: Goal, near_mates: &[usize]) {
        let unchanged = self.goal.as_ref().is_some_and(|old| old.viewpoint.place == goal.viewpoint.place);
        if unchanged && !self.motion.is_at_end() && !self.path_meets(near_mates) {
            self.goal = Some(goal);
            return;
        }
        match self.route(from, goal.viewpoint.place, near_mates) {
            Ok(line) => {
                let (grid, heights) = (&self.grid, self.config.heights_m);
                self.motion.follow(&line, &self.config.limits, |a, b| {
                    grid.cells.line_fits(a, b, |cell| {
                        grid.is_passable(cell, false) && !is_closed(grid, heights, near_mates, cell)
                    })
                });
                self.goal = Some(goal);
            }
            Err(_) => {
                self.motion.brake(&self.config.limits);
                self.goal = None;
            }
        }
    }

    /// Flies off the path of a robot that wants to pass and comes before this one, or finds this one idle.
    fn let_pass(&mut self, from: [f64; 3], mates: &[Mate], near_mates: &[usize]) {
        let wide = self.config.separation_m + DETOUR_M;
        let before = |mate: &&Mate| self.idle_since.is_some() || mate.number < self.config.number;
        let intended = mates.iter().filter(before).filter_map(|mate| mate.intended.as_ref());
        let paths: Vec<Vec<[f64; 3]>> = intended.map(|path| dense(path)).collect();
        let in_path = |place: [f64; 3]| paths.iter().any(|path| metres_to_path(place, path) < wide + 0.2);
        if !in_path(from) {
            return;
        }
        self.flood(from, NEAR_M, near_mates);
        let grid = &self.grid;
        let passable = (0..grid.count()).filter(|cell| grid.is_passable(*cell, false));
        let mut reached: Vec<(f64, usize)> =
            passable.filter_map(|cell| Some((self.router.metres_to(grid, cell)?, cell))).collect();
        reached.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut places = reached.into_iter().map(|(_, cell)| grid.cells.centre(cell));
        if let Some(place) = places.find(|place| !in_path(*place)) {
            let viewpoint = Viewpoint { place, yaw: self.motion.yaw(), gain: 0.0 };
            self.go(from, Goal { viewpoint, cells: Vec::new() }, near_mates);
        }
    }

    /// Whether the path ahead leads through these cells.
    fn path_meets(&self, cells: &[usize]) -> bool {
        let mut path = self.motion.path().into_iter().filter_map(|point| self.grid.cells.cell_at(point));
        path.any(|cell| cells.binary_search(&cell).is_ok())
    }
}

/// Whether a cell is not to be flown in for other reasons than the map: its height, or others (cells in
/// ascending order).
fn is_closed(grid: &NavigationGrid, heights_m: [f64; 2], near_mates: &[usize], cell: usize) -> bool {
    let z = grid.cells.centre(cell)[2];
    z < heights_m[0] || z > heights_m[1] || near_mates.binary_search(&cell).is_ok()
}
