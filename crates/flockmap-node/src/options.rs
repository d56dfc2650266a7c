//! The options of a node.

use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use flockmap::{Event, Pose, Robot, RobotConfig, RobotId, Scan, ScanReport, Stamp};

use crate::sensor::Sensor;
use crate::store::{EpochFile, Store};
use crate::{Clock, Log, MapOutput, Recording, ViewOptions};

/// When a node ends by itself.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct EndOptions {
    /// After so long. Default: never.
    pub after: Option<Duration>,
    /// When the sensor has ended and nothing new has come or gone for so long. Default: never.
    pub when_quiet: Option<Duration>,
    /// At the end, however it comes, the last packages are sent and repaired for up to so long. Default 500 ms.
    pub linger: Duration,
}

impl Default for EndOptions {
    fn default() -> Self {
        Self { after: None, when_quiet: None, linger: Duration::from_millis(500) }
    }
}

/// Something that has just happened in a node.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Observation<'a> {
    /// A scan was inserted.
    Scan {
        /// The scan, with its stamp on the node's clock.
        scan: &'a Scan,
        /// What it changed.
        report: &'a ScanReport,
    },
    /// States of voxels from a mapper elsewhere were inserted.
    States {
        /// What they changed.
        report: &'a ScanReport,
    },
    /// The robot reported an event.
    Event(&'a Event),
}

/// Called in the thread of the node with the time, the robot, and what has just happened. The node waits for
/// it, so it must not wait for the node: use the robot that is given, not the [`NodeHandle`](crate::NodeHandle).
pub type Observer = Box<dyn FnMut(Stamp, &Robot, Observation<'_>) + Send>;

/// All options of a node.
pub struct NodeOptions {
    /// The robot.
    pub robot: RobotConfig,
    /// Name for logs and metrics.
    pub name: String,
    /// The clock, and the system clock by which sensor programs stamp. Nodes of one process may share one.
    pub clock: Clock,
    /// Where scans come from.
    pub sensor: Sensor,
    /// `T_own_origin` of other robots.
    pub alignments: Vec<(RobotId, Pose)>,
    /// Clocks of other robots minus the own one, in microseconds; others are measured.
    pub clock_offsets: Vec<(RobotId, i64)>,
    /// Robots whose layers are left out of the fused map.
    pub muted: Vec<RobotId>,
    /// What the robot has from former runs, and where it stores this one. The epoch of the robot must be
    /// higher than all in it: [`next_epoch`](crate::store::next_epoch).
    pub store: Option<Store>,
    /// Where the epoch is kept if the robot begins anew while it runs; that of the start must be in it already.
    pub epoch_file: Option<EpochFile>,
    /// Where planners of other processes read the fused map; with the default, readers of this one alone.
    pub map_output: Option<MapOutput>,
    /// Where the flight is recorded.
    pub record: Option<Recording>,
    /// Counters of the program around the node, by name: given out with the node's own. The view shows
    /// `paper_bytes_out` and `racer_bytes_out`.
    pub counters_beside: Vec<(&'static str, Arc<AtomicU64>)>,
    /// Show the map in a browser. Needs [`Self::map_output`].
    pub view: Option<ViewOptions>,
    /// Serve counters as Prometheus text here.
    pub prometheus: Option<SocketAddr>,
    /// Log a line of counters each such time.
    pub status_period: Option<Duration>,
    /// When the node ends by itself.
    pub end: EndOptions,
    /// Called with every scan and event.
    pub observer: Option<Observer>,
    /// Where lines go.
    pub log: Log,
}

impl NodeOptions {
    /// A robot without a sensor that says nothing and never ends by itself.
    pub fn new(robot: RobotConfig) -> Self {
        Self {
            name: format!("robot{}", robot.id),
            robot,
            clock: Clock::new(),
            sensor: Sensor::None,
            alignments: Vec::new(),
            clock_offsets: Vec::new(),
            muted: Vec::new(),
            store: None,
            epoch_file: None,
            map_output: None,
            record: None,
            counters_beside: Vec::new(),
            view: None,
            prometheus: None,
            status_period: None,
            end: EndOptions::default(),
            observer: None,
            log: Log::silent(),
        }
    }
}

impl fmt::Debug for NodeOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, robot, sensor, end, .. } = self;
        f.debug_struct("NodeOptions")
            .field("name", name)
            .field("robot", robot)
            .field("sensor", sensor)
            .field("end", end)
            .finish_non_exhaustive()
    }
}
