//! Voxels: their states as bytes, and their side.

use flockmap_core::{Resolution, State};

use crate::result::Failure;

/// What is known of a voxel, as an uint8_t in arrays.
#[repr(i32)]
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum VoxelState {
    /// Never observed, or observed without a decision.
    Unknown = 0,
    /// Observed to be empty.
    Free = 1,
    /// Observed to hold an obstacle.
    Occupied = 2,
}

/// As a byte.
pub(crate) const fn byte_of(state: State) -> u8 {
    match state {
        State::Unknown => 0,
        State::Free => 1,
        State::Occupied => 2,
    }
}

/// The state of a byte that came in, at this place of its array.
pub(crate) fn state_of(at: usize, byte: u8) -> Result<State, Failure> {
    match byte {
        0 => Ok(State::Unknown),
        1 => Ok(State::Free),
        2 => Ok(State::Occupied),
        _ => Err(Failure::argument(format_args!(
            "states[{at}] is {byte}, expected a flockmap_voxel_state, 0 to 2"
        ))),
    }
}

pub(crate) fn resolution(metres: f64) -> Result<Resolution, Failure> {
    Resolution::from_metres(metres).ok_or_else(|| {
        Failure::argument(format_args!(
            "resolution_m is {metres}, expected the side of a voxel, 0.001 to 100"
        ))
    })
}
