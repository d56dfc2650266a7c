//! A Flockmap robot for real: a [`flockmap::Robot`] driven by sockets, a clock and a sensor.
//!
//! [`run`] is what `flockmap node --config robot.toml` does. [`Node::start`] is the same as a library: each
//! node has a thread of its own, and a process may have many; [`ConfiguredNode`] takes the file and leaves signals to
//! the program.
//!
//! ```
//! use flockmap::{Resolution, RobotConfig, RobotId};
//! use flockmap_node::{Node, NodeOptions, UdpOptions, UdpSockets};
//!
//! let sockets = UdpSockets::bind(&UdpOptions::new("127.0.0.1:0".parse()?))?;
//! let config = RobotConfig::new(RobotId(1), Resolution::from_metres(0.1).unwrap(), 7.0);
//! let node = Node::start(NodeOptions::new(config), move || sockets.into_transport())?;
//! let voxels = node.with_robot(|robot, _now| robot.map().count());
//! assert_eq!(voxels, Some((0, 0)));
//! node.stop();
//! assert_eq!(node.join()?.summary.streams.len(), 1);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! | part | what |
//! |---|---|
//! | [`NodeConfig`] | the configuration file; [`EXAMPLE`] shows every key |
//! | [`Transport`], [`UdpTransport`] | how datagrams travel; others can stand beside UDP |
//! | [`Sensor`] | a recording or simulation in real time, a channel, or a socket that any program feeds |
//! | [`MapOutput`] | sockets where planners of other processes read the fused map, `flockmap_feed` |
//! | [`Recording`] | the flight as an MCAP file, [`flockmap_io::FlightRecorder`] |
//! | [`ViewOptions`] | the same in a browser, `flockmap_view` |
//! | [`Node`], [`NodeHandle`] | the robot at work, and access to it while it runs |
//! | [`store`], [`StoreWriter`] | packages on disk, so that a rebooted robot has its map again, and the epoch of its run |
//! | [`NodeStatus`], [`Summary`] | counters while it runs, as a line and as Prometheus text; the summary at the end |
#![forbid(unsafe_code)]

mod advice;
mod alone;
mod clock;
mod command;
mod config;
mod driver;
mod kept;
mod log;
mod map_output;
mod node;
mod options;
mod outputs;
mod recorder;
mod run;
mod sensor;
mod signals;
mod status;
mod store_writer;
mod summary;
mod transport;
#[cfg(unix)]
mod unix_socket;
mod warnings;
mod web;

pub use clock::Clock;
pub use config::{
    AlignmentSection, Behaviour, CodecSection, ConfigError, Configuration, EXAMPLE, FoundKey, KEY_VARIABLE,
    MapOutputSection, MetricsSection, NodeConfig, OutputSection, RecordSection, RosPoses, RosSection, Secret,
    SensorSection, StateSection, StoreSection, TeammatesSection, ViewSection, schema,
};
pub use flockmap_io::{FlightOptions, Frame, Frames, SubmapPoses};
pub use flockmap_store as store;
pub use log::{Level, Log};
pub use map_output::{MapOutput, MapReaders, links_of, poses_of, submaps_of};
pub use node::{Ended, Node, NodeHandle, StartError};
pub use options::{EndOptions, NodeOptions, Observation, Observer};
pub use recorder::Recording;
pub use run::{ConfiguredNode, Embedding, run};
pub use sensor::{
    MESSAGE_VERSION, MessageError, MessageLimits, OwnedStates, Sensor, SensorMessage, StatesMessage,
};
pub use signals::Signals;
pub use status::{GivenUp, Histogram, NodeCounters, NodeStatus, StreamStatus, Timings};
pub use store_writer::StoreWriter;
pub use summary::{StreamSummary, Summary, TimingSummary};
pub use transport::{NoRadio, SendResult, Transport, UdpError, UdpOptions, UdpSockets, UdpTransport};
pub use web::ViewOptions;
