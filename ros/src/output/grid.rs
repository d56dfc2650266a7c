//! A band of heights as a `nav_msgs/OccupancyGrid`, and what changed of it as `map_msgs/OccupancyGridUpdate`s.
//!
//! An update has all that changed since the last full grid. So the newest grid and the newest update are all that a
//! subscriber needs, also one that comes late or missed some; and behind a full grid an update of one cell takes the
//! place of the older ones.

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
    /// What was published in full last.
    full: Option<Cells>,
    /// The update behind it: what it says in which rectangle.
    listeners: usize,
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
        Self { outlet, updates, band_m, full: None, listeners: 0 }
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
        if !self.outlet.wants(shot.view.version(), [0; 3], now) {
            return Ok(());
        }
        let is_joined = self.outlet.listeners() > self.listeners;
        self.listeners = self.outlet.listeners();
        let Some(cells) = Cells::of(&shot.view, self.band_m, self.full.as_ref())? else { return Ok(()) };
        let changed = self.full.as_ref().filter(|_| !is_joined).and_then(|full| full.difference(&cells));
        match changed {
            Some(None) => Ok(()),
            // Half of the grid or less.
            Some(Some(of)) if 2 * of.area() <= cells.cells.len() => {
                self.update(shot.header.clone(), &cells, of)
            }
            _ => {
                self.outlet.send(cells.message(shot))?;
                let first = Rectangle { x: [0, 1], y: [0, 1] };
                self.update(shot.header.clone(), &cells, first)?;
                self.full = Some(cells);
                Ok(())
            }
        }
    }

    fn due(&self) -> Instant {
        self.outlet.due()
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

    /// What is different in another grid: nothing, or a rectangle. `None` if it is of another region.
    fn difference(&self, other: &Self) -> Option<Option<Rectangle>> {
        if self.region != other.region {
            return None;
        }
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
        Some(found)
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

    proptest! {
        #[test]
        fn a_grid_with_its_update_is_the_new_grid(
            (width, old, new) in (1..9usize, 1..9usize).prop_flat_map(|(w, h)| {
                let row = || prop::collection::vec(prop_oneof![8 => Just(0i8), 1 => Just(100), 1 => Just(-1)], w * h);
                (Just(w), row(), row())
            })
        ) {
            let (before, after) = (cells(width, old.clone()), cells(width, new.clone()));
            let mut patched = old;
            match before.difference(&after).unwrap() {
                None => prop_assert_eq!(&patched, &new),
                Some(of) => {
                    for y in of.y[0]..of.y[1] {
                        for x in of.x[0]..of.x[1] {
                            patched[y * width + x] = new[y * width + x];
                        }
                    }
                    // No smaller one would do.
                    let differs = |x: usize, y: usize| before.cells[y * width + x] != after.cells[y * width + x];
                    prop_assert!((of.x[0]..of.x[1]).any(|x| differs(x, of.y[0])));
                    prop_assert!((of.y[0]..of.y[1]).any(|y| differs(of.x[1] - 1, y)));
                }
            }
            prop_assert_eq!(patched, new);
        }
    }
}
