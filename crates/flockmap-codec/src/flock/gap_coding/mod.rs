//! Gap coding: changes that lie anywhere in a box, each given by how far it is from the one before.
//!
//! A set of changes without any pattern cannot cost less than h(r) + h(s) · r bits a voxel, where r is the
//! share of voxels that changed, s the share of these that became Occupied and h the binary entropy. No
//! context helps there and each one costs time, so there is none here: the number of changes, then for each
//! the voxels between it and the one before ([`law`]), along a fixed order of the box ([`places`]), and its
//! state, with a probability that follows from the states before it.
//!
//! Time goes with the number of changes, whatever the box; decoding takes memory for the blocks it has found
//! and nothing else. What the receiver holds already is not looked at.

mod cut;
mod judge;
mod law;
mod limits;
mod payload;
mod places;
#[cfg(test)]
mod tests;

pub(crate) use cut::cut;
pub(crate) use judge::has_no_pattern;
pub(crate) use payload::{decode, encode};
