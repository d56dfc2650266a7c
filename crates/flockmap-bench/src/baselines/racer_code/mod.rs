//! RACER's map sharing as its code does it, in place of how papers describe it: a session of its own, with
//! every habit kept.
//!
//! Facts from reading the public code (SYSU-STAR/RACER, `plan_env`); nothing of it is used here. What is kept:
//!
//! - A voxel is listed **once, ever**: when this robot's own ray touches it while it is unknown. Flips
//!   between Free and Occupied are never sent, and nothing is listed that a team-mate's chunk made known
//!   before.
//! - Lists are cut to chunks of 200 voxels, and only while **more than** 200 are pending: 1 to 200 always
//!   stay behind.
//! - The states of a chunk are taken when it is **first sent**, and frozen: later sends and relays repeat them.
//! - Everyone announces the chunks it holds every 0.1 s, also when idle. Who hears that, and has not answered
//!   the same robot in the last 0.3 s of that robot's clock, sends **all** that is missing back to back: no
//!   budget, no order by age, and what is still in flight is sent again.
//! - Everyone holds the chunks of all robots for ever and answers for all of them, but not for the
//!   requester's own.
//! - The receiver overwrites what it had. There are no stamps, and no runs: a robot that starts again begins
//!   at chunk 1, and its new chunks are taken for known.
//!
//! What is not kept: a datagram that is damaged is refused, where the code would write outside of its arrays.

mod config;
mod message;
mod robot;
#[cfg(test)]
mod tests;

pub use config::{RacerCast, RacerConfig};
#[cfg(test)]
pub use robot::RacerCounters;
pub use robot::RacerRobot;
