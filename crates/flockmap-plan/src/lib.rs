//! What planners ask of a map: how far the next obstacle is, whether a body collides, what lies in a plane, where
//! the unknown begins. All of it is a function of a [`MapView`](flockmap_grid::MapView).
#![forbid(unsafe_code)]

mod batch;
mod collision;
mod error;
mod field;
mod obstacles;

pub use batch::{cast_rays, states};
pub use collision::{Collision, Hit};
pub use error::{QUESTION_BLOCKS_MAX, QuestionError};
pub use field::{Clearance, DistanceField, FIELD_DIAGONAL_MAX, FieldConfig, FieldError, Updated, grown};
pub use obstacles::Obstacles;
