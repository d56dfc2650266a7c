//! The commands of `flockmap`, each with its options.

pub mod demo;
pub mod export;
mod export_flat;
mod hidden;
pub mod info;
pub mod key;
pub mod mirror;
pub mod node;
pub mod plan_radio;
pub mod radio;
pub mod render;
pub mod replay;
pub mod sim;
pub mod view;
mod voxels_of;
