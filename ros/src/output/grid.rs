//! A band of heights as a `nav_msgs/OccupancyGrid`, and what changed of it as `map_msgs/OccupancyGridUpdate`s.
//!
//! An update has all that changed since the last full grid, and all that an update changed since, also where it is as
//! before again. So the newest grid and the newest update are all that a subscriber needs, also one that comes late or
//! missed some; and behind a full grid an update of one cell takes the place of the older ones.

use std::time::Instant;

use flockmap::grid::VoxelBox;
use flockmap::{MapView, Voxel};
use flockmap_io::ros::{Header, MapMetaData, OccupancyGrid, OccupancyGridUpdate, Pose};
use flockmap_plan::{ColumnRule, box_between};
use ros2_client::Publisher;

use super::outlet::{Outlet, Output, Shot};

/// The grid grows by so many voxels at once, so that it seldom does.
const GROWTH: i32 = 128;

/// The band as a grid.
pub(crate) struct Grid {
    outlet: Outlet<OccupancyGrid>,
    updates: Publisher<OccupancyGridUpdate>,
    band_m: [f64; 2],
    sent: Sent,
    /// How many listened when something was published last.
    listeners: usize,
}

/// What subscribers have.
#[derive(Default, Debug)]
struct Sent {
    /// The last full grid.
    full: Option<Cells>,
    /// Where updates since then may have changed it.
    patched: Option<Rectangle>,
}

/// What is to be published.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Step {
    Nothing,
    Update(Rectangle),
    Full,
}

/// Cells, row by row.
#[derive(Clone, PartialEq, Debug)]
struct Cells {
    region: VoxelBox,
    width: usize,
    cells: Vec<i8>,
}

/// Columns and rows, from the first to the one behind the last.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
struct Rectangle {
    x: [usize; 2],
    y: [usize; 2],
}

impl Grid {
    pub(crate) const fn new(
        outlet: Outlet<OccupancyGrid>,
        updates: Publisher<OccupancyGridUpdate>,
        band_m: [f64; 2],
    ) -> Self {
        Self { outlet, updates, band_m, sent: Sent { full: None, patched: None }, listeners: 0 }
    }

    fn update(&self, header: Header, cells: &Cells, of: Rectangle) -> Result<(), String> {
        let rows = (of.y[0]..of.y[1]).flat_map(|y| &cells.cells[y * cells.width..][of.x[0]..of.x[1]]);
        let update = OccupancyGridUpdate {
            header,
            x: of.x[0] as i32,
            y: of.y[0] as i32,
            width: (of.x[1] - of.x[0]) as u32,
            height: (of.y[1] - of.y[0]) as u32,
            data: rows.copied().collect(),
        };
        self.updates
            .publish(update)
            .map_err(|error| format!("an update of the grid was not published: {error}"))
    }
}

impl Output for Grid {
    fn publish(&mut self, shot: &Shot, now: Instant) -> Result<(), String> {
        if !self.outlet.wants(shot.view.version(), None, now) {
            return Ok(());
        }
        let is_joined = self.outlet.listeners() > self.listeners;
        self.listeners = self.outlet.listeners();
        let full = self.sent.full.as_ref();
        let Some(cells) = Cells::of(&shot.view, self.band_m, full)? else { return Ok(()) };
        let published = match self.sent.step(&cells, is_joined) {
            Step::Nothing => Ok(()),
            Step::Update(of) => self.update(shot.header.clone(), &cells, of),
            Step::Full => {
                let first = Rectangle { x: [0, 1], y: [0, 1] };
                let sent = self.outlet.send(cells.message(shot));
                let sent = sent.and_then(|()| self.update(shot.header.clone(), &cells, first));
                // Without its update the old one would be taken for its own.
                self.sent = Sent { full: sent.is_ok().then_some(cells), patched: None };
                sent
            }
        };
        if published.is_err() {
            self.outlet.forget();
        }
        published
    }

    fn due(&self) -> Instant {
        self.outlet.due()
    }
}

impl Sent {
    /// What makes these cells of all that subscribers may have. `anew`: somebody has nothing.
    fn step(&mut self, cells: &Cells, anew: bool) -> Step {
        let Some(full) = self.full.as_ref().filter(|full| !anew && full.region == cells.region) else {
            return Step::Full;
        };
        let changed = full.difference(cells).into_iter().chain(self.patched).reduce(Rectangle::union);
        match changed {
            None => Step::Nothing,
            Some(of) if 2 * of.area() > cells.cells.len() => Step::Full,
            Some(of) => {
                self.patched = Some(of);
                Step::Update(of)
            }
        }
    }
}

impl Cells {
    /// The band of a view: all that is known, and all that was in the grid before. `None` if nothing is known.
    fn of(view: &MapView, band_m: [f64; 2], before: Option<&Self>) -> Result<Option<Self>, String> {
        let Some(known) = view.bounding_box() else { return Ok(None) };
        let known = before.map_or(known, |before| known.union(&before.region));
        let side = view.resolution().metres();
        // Only the heights count of these corners.
        let band = box_between(view.resolution(), [0.0, 0.0, band_m[0]], [side, side, band_m[1]]);
        let Some(band) = band else {
            return Err(format!(
                "no grid: [ros] grid_band_m is {band_m:?}, expected the lower height first, and a voxel between both"
            ));
        };
        let down = |v: i32| v.div_euclid(GROWTH) * GROWTH;
        let up = |v: i32| down(v) + GROWTH - 1;
        let low = Voxel::new(down(known.min().x), down(known.min().y), band.min().z);
        let high = Voxel::new(up(known.max().x), up(known.max().y), band.max().z);
        let region = VoxelBox::spanning(low, high).ok_or("no grid: the map ends where voxels end")?;
        let grid = flockmap_plan::OccupancyGrid::new(view, &region, ColumnRule::AnyFree)
            .map_err(|error| format!("no grid: {error}"))?;
        Ok(Some(Self { region, width: grid.size()[0], cells: grid.to_ros() }))
    }

    /// What is different in another grid of the same region.
    fn difference(&self, other: &Self) -> Option<Rectangle> {
        let mut found: Option<Rectangle> = None;
        let rows = self.cells.chunks(self.width).zip(other.cells.chunks(self.width));
        for (y, (old, new)) in rows.enumerate() {
            let differs = |(a, b): (&i8, &i8)| a != b;
            let Some(first) = old.iter().zip(new).position(differs) else { continue };
            let last = old.iter().zip(new).rposition(differs).unwrap_or(first);
            let row = found.get_or_insert(Rectangle { x: [first, last + 1], y: [y, y + 1] });
            row.x = [row.x[0].min(first), row.x[1].max(last + 1)];
            row.y[1] = y + 1;
        }
        found
    }

    fn message(&self, shot: &Shot) -> OccupancyGrid {
        let side = shot.view.resolution().metres();
        let low = self.region.min();
        let origin =
            Pose { position: [f64::from(low.x) * side, f64::from(low.y) * side, 0.0], ..Pose::default() };
        OccupancyGrid {
            header: shot.header.clone(),
            info: MapMetaData {
                map_load_time: shot.header.stamp,
                resolution: side as f32,
                width: self.width as u32,
                height: (self.cells.len() / self.width) as u32,
                origin,
            },
            data: self.cells.clone(),
        }
    }
}

impl Rectangle {
    /// The smallest rectangle that has both.
    fn union(self, other: Self) -> Self {
        let both = |a: [usize; 2], b: [usize; 2]| [a[0].min(b[0]), a[1].max(b[1])];
        Self { x: both(self.x, other.x), y: both(self.y, other.y) }
    }

    const fn area(&self) -> usize {
        (self.x[1] - self.x[0]) * (self.y[1] - self.y[0])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn cells(width: usize, cells: Vec<i8>) -> Cells {
        let size = [width as u32, (cells.len() / width) as u32, 1];
        Cells { region: VoxelBox::new(Voxel::new(0, 0, 0), size).unwrap(), width, cells }
    }

    fn patch(grid: &mut [i8], width: usize, from: &Cells, of: Rectangle) {
        for y in of.y[0]..of.y[1] {
            for x in of.x[0]..of.x[1] {
                grid[y * width + x] = from.cells[y * width + x];
            }
        }
    }

    proptest! {
        #[test]
        fn a_difference_is_the_smallest_rectangle_that_makes_one_grid_of_the_other(
            (width, old, new) in (1..9usize, 1..9usize).prop_flat_map(|(w, h)| {
                let row = || prop::collection::vec(prop_oneof![8 => Just(0i8), 1 => Just(100), 1 => Just(-1)], w * h);
                (Just(w), row(), row())
            })
        ) {
            let (before, after) = (cells(width, old.clone()), cells(width, new.clone()));
            let mut patched = old;
            if let Some(of) = before.difference(&after) {
                patch(&mut patched, width, &after, of);
                // No smaller one would do.
                let differs = |x: usize, y: usize| before.cells[y * width + x] != after.cells[y * width + x];
                prop_assert!((of.x[0]..of.x[1]).any(|x| differs(x, of.y[0]) ));
                prop_assert!((of.x[0]..of.x[1]).any(|x| differs(x, of.y[1] - 1)));
                prop_assert!((of.y[0]..of.y[1]).any(|y| differs(of.x[0], y)));
                prop_assert!((of.y[0]..of.y[1]).any(|y| differs(of.x[1] - 1, y)));
            }
            prop_assert_eq!(patched, new);
        }

        #[test]
        fn whoever_has_the_newest_grid_and_the_newest_update_has_the_map(
            // Few cells change at a time, and many change back.
            steps in prop::collection::vec(
                (prop::collection::vec((0..64usize, prop_oneof![Just(0i8), Just(100)]), 0..3), any::<bool>(), prop::bool::weighted(0.05)),
                1..40,
            )
        ) {
            let (mut map, mut sent) = (cells(8, vec![0; 64]), Sent::default());
            // One got every message, one missed some updates, and one comes now.
            let (mut every, mut some, mut full) = (Vec::new(), Vec::new(), Vec::new());
            let mut newest: Option<(Cells, Rectangle)> = None;
            for (changes, is_missed, anew) in steps {
                changes.into_iter().for_each(|(at, state)| map.cells[at] = state);
                match sent.step(&map, anew) {
                    Step::Nothing => {}
                    Step::Update(of) => {
                        patch(&mut every, 8, &map, of);
                        if !is_missed {
                            patch(&mut some, 8, &map, of);
                        }
                        newest = Some((map.clone(), of));
                    }
                    Step::Full => {
                        for has in [&mut every, &mut some, &mut full] {
                            has.clone_from(&map.cells);
                        }
                        newest = None;
                        sent = Sent { full: Some(map.clone()), patched: None };
                    }
                }
                prop_assert_eq!(&every, &map.cells);
                for has in [&full, &some] {
                    let mut has = has.clone();
                    if let Some((from, of)) = &newest {
                        patch(&mut has, 8, from, *of);
                    }
                    prop_assert_eq!(&has, &map.cells);
                }
            }
        }
    }
}
