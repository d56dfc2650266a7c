//! What is published: each file makes one message of the map.

mod cloud;
mod diagnostics;
mod field;
mod grid;
mod octomap;
mod outlet;
mod robots;

pub(crate) use cloud::Cloud;
pub(crate) use diagnostics::Diagnostics;
pub(crate) use field::Field;
pub(crate) use grid::Grid;
pub(crate) use octomap::Tree;
pub(crate) use outlet::{Outlet, Output, Shot};
pub(crate) use robots::Robots;
