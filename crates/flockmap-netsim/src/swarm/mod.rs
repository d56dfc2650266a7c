//! A whole swarm in virtual time: real robots (mapper, codec, session, layers, fusion) on one queue of
//! events, over an emulated radio. One seed decides everything, and checkers look at every event.
//!
//! ```
//! use flockmap_netsim::swarm::{SwarmOptions, fly};
//!
//! let report = fly(&SwarmOptions::new(1));
//! assert!(report.is_good(), "{}", report.failure.unwrap());
//! assert!(report.agreement_s.is_some());
//! ```

mod broken;
mod check;
mod clock;
mod costly;
mod crowd;
mod datagram;
mod engine;
mod member;
mod moves;
mod options;
mod outsider;
mod plan;
mod preset;
mod purpose;
mod report;
mod seen;
mod session;
mod settings;
mod sim_disk;
pub mod table;
mod table_row;
mod trouble;
mod truth;
mod world;

pub use check::Failure;
pub use engine::{describe, fly};
pub use options::SwarmOptions;
pub use preset::{BUDGET_MIN, RadioNumbers, RadioPreset, Topology};
pub use report::{Report, RobotFigures, Seen};
pub use table_row::{TableRow, rows as table_rows};
