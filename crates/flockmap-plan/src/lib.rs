//! What planners ask of a map: how far the next obstacle is, whether a body collides, what lies in a plane, where
//! the unknown begins. All of it is a function of a [`MapView`](flockmap_grid::MapView).
//!
//! Two-dimensional products and frontiers are functions of a box of voxels, which [`box_between`] makes of metres:
//!
//! ```
//! use flockmap_grid::{BlockIndex, MapView, Resolution, State, StateBlock};
//! use flockmap_plan::{ColumnRule, FrontierConfig, HeightMap, OccupancyGrid, box_between, frontiers};
//!
//! // A map: a block of free space, and an obstacle in it.
//! let resolution = Resolution::from_metres(0.1).unwrap();
//! let mut map = MapView::new(resolution);
//! let mut block = StateBlock::new([u64::MAX; 8], [0; 8]);
//! block.set(0, State::Occupied);
//! map.set_block(BlockIndex::new(0, 0, 0), &block);
//!
//! // What a robot meets that is between 0 and 0.5 m above the ground, as nav_msgs/OccupancyGrid has it.
//! let band = box_between(resolution, [0.0, 0.0, 0.0], [0.8, 0.8, 0.5]).unwrap();
//! let grid = OccupancyGrid::new(&map, &band, ColumnRule::AnyFree)?;
//! assert_eq!((grid.size(), grid.origin_m(), &grid.to_ros()[..2]), ([8, 8], [0.0, 0.0], &[100, 0][..]));
//!
//! // How high what stands there is, and where to look next.
//! let heights = HeightMap::new(&map, &band)?;
//! assert_eq!(heights.highest(0, 0), Some(0));
//! let around = box_between(resolution, [-0.4; 3], [1.2; 3]).unwrap();
//! let frontiers = frontiers(&map, &around, &FrontierConfig::default())?;
//! assert_eq!(frontiers[0].voxels.len(), 8 * 8 * 8 - 6 * 6 * 6 - 1);
//! # Ok::<(), flockmap_plan::TooLarge>(())
//! ```
//!
//! [`lattice`] and [`search`] are the grid and the A* of whatever plans on cells.
#![forbid(unsafe_code)]

mod batch;
mod collision;
mod columns;
mod error;
mod field;
mod frontier;
mod heights;
pub mod lattice;
mod obstacles;
mod occupancy;
pub mod search;
mod space;

pub use batch::{cast_rays, states};
pub use collision::{Collision, Hit};
pub use error::{QUESTION_BLOCKS_MAX, QuestionError};
pub use field::{Clearance, DistanceField, FIELD_DIAGONAL_MAX, FieldConfig, FieldError, Updated, grown};
pub use frontier::{Cluster, Clusters, Frontier, FrontierConfig, frontier_cells, frontiers};
pub use heights::HeightMap;
pub use obstacles::Obstacles;
pub use occupancy::{ColumnRule, OccupancyGrid};
pub use space::{TooLarge, box_between};

#[cfg(doctest)]
#[doc = include_str!("../../../docs/planner.md")]
struct PlanningOnTheMap;
