//! The configuration of a node: a TOML file, as [`EXAMPLE`] shows it in full.

mod applies;
mod convert;
mod error;
mod explain;
mod key;
mod parse;
mod places;
mod ros;
mod schema;
mod token;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;

use flockmap::{BatchConfig, Codec, FusionConfig, MapperConfig, Preset, RobotId, SessionConfig};
use schemars::JsonSchema;
use serde::Deserialize;

use flockmap_io::FlightOptions;

use crate::UdpOptions;

pub(crate) use applies::check_applies;
pub(crate) use convert::{seconds, speed, value, within};
pub use error::ConfigError;
pub use key::{FoundKey, KEY_VARIABLE, Secret};
pub use parse::Configuration;
pub use ros::{RosPoses, RosSection};
pub use schema::schema;

/// A configuration with every key, its meaning and its default: `robot.example.toml`.
pub const EXAMPLE: &str = include_str!("../../robot.example.toml");

/// A whole configuration. Only `id` and `[map] resolution_m` and `range_m` must be given.
///
/// A field with a dot in its name stands in the section before the dot, among the options of the robot.
#[derive(Clone, PartialEq, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NodeConfig {
    /// Number of the robot, 0 to 65,535, unique in the swarm.
    pub id: RobotId,
    /// Name in logs. Default `robotID`.
    pub name: Option<String>,
    /// In place of the seconds since 1970 that the machine's clock shows, from which the epoch of a run is
    /// made. If a former run is known that had as much or more, one more than that counts.
    pub epoch: Option<u32>,
    /// The mapper.
    pub map: MapperConfig,
    /// What `[map]` does not say is as in this preset.
    #[serde(default, rename = "map.mapper")]
    pub mapper: Preset,
    /// When changes are packed.
    #[serde(default)]
    pub batch: BatchConfig,
    /// How they are coded.
    #[serde(default)]
    pub codec: CodecSection,
    /// How robots exchange packages.
    #[serde(default)]
    pub session: SessionConfig,
    /// What `[session]` does not say is as in this preset.
    #[serde(default, rename = "session.behaviour")]
    pub behaviour: Behaviour,
    /// The secret of the swarm: 64 hex digits, or base64. Here, in a file, or in the environment variable
    /// `FLOCKMAP_SWARM_KEY`.
    #[serde(rename = "session.swarm_key")]
    pub swarm_key: Option<Secret>,
    /// A file with nothing but the secret of the swarm.
    #[serde(rename = "session.swarm_key_file")]
    pub swarm_key_file: Option<PathBuf>,
    /// How layers become one map.
    #[serde(default)]
    pub fusion: FusionConfig,
    /// Robots whose layers are left out of the map.
    #[serde(default, rename = "fusion.muted")]
    pub muted: Vec<RobotId>,
    /// What survives a reboot.
    #[serde(default)]
    pub store: StoreSection,
    /// Where the epoch is kept.
    #[serde(default)]
    pub state: StateSection,
    /// Sockets.
    #[serde(default)]
    pub network: UdpOptions,
    /// Where scans come from.
    #[serde(default)]
    pub sensor: SensorSection,
    /// Where planners read the map.
    #[serde(default)]
    pub map_output: MapOutputSection,
    /// The flight as a file.
    #[serde(default)]
    pub record: RecordSection,
    /// The map in a browser.
    #[serde(default)]
    pub view: ViewSection,
    /// Topics of ROS 2, for `flockmap-ros`.
    #[serde(default)]
    pub ros: RosSection,
    /// Counters.
    #[serde(default)]
    pub metrics: MetricsSection,
    /// How the frames of other robots lie in the own one, by id.
    #[serde(default)]
    pub alignment: BTreeMap<RobotId, AlignmentSection>,
    /// How far the clocks of other robots are ahead of the own one, in milliseconds, by id. By the own id:
    /// that of former runs, 0 if the clock goes on through a restart.
    #[serde(default)]
    pub clock_offset_ms: BTreeMap<RobotId, f64>,
    /// Parts of the map that are moved when a loop is closed.
    #[serde(default)]
    pub submaps: SubmapsSection,
    /// Team-mates in view of the sensor.
    #[serde(default)]
    pub teammates: TeammatesSection,
    /// The end, and what is left behind then.
    #[serde(default)]
    pub output: OutputSection,
}

/// Where the values of `[session]` start from.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Behaviour {
    /// As in [`SessionConfig::default`].
    #[default]
    Default,
    /// The paper's own behaviour: [`SessionConfig::paper`].
    Paper,
}

/// `[codec]`: what is not given is as in [`flockmap::RobotConfig`].
#[derive(Clone, PartialEq, Eq, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CodecSection {
    /// How packages are coded. Those of others are read in every codec.
    pub name: Option<Codec>,
    /// `flock` codes changes against what the others have received, and for so long at most they may lack a
    /// part of it: where repair takes longer, batches are coded independently. 0: they never are.
    pub repair_delay_max_ms: Option<u32>,
}

/// `[store]`
#[derive(Clone, PartialEq, Eq, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StoreSection {
    /// Folder of the store; made if need be.
    pub path: Option<PathBuf>,
    /// Bytes that it may take on disk.
    pub bytes_max: u64,
    /// What was written is made safe against a power failure after so long.
    pub sync_ms: u32,
}

impl Default for StoreSection {
    fn default() -> Self {
        Self { path: None, bytes_max: 256 << 20, sync_ms: 1_000 }
    }
}

/// `[state]`
#[derive(Clone, PartialEq, Eq, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StateSection {
    /// Folder for the epoch of the newest run, a small file; made if need be. Default:
    /// [`NodeConfig::state_folder`].
    pub path: Option<PathBuf>,
}

/// `[sensor]`: at most one of `record`, `listen_tcp` and `listen_unix`.
#[derive(Clone, PartialEq, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SensorSection {
    /// An `.mcap`, a rosbag2 folder, or a folder of scans, played in real time.
    pub record: Option<PathBuf>,
    /// How fast it is played.
    pub speed: f64,
    /// How far into the record to begin, in seconds.
    pub start_s: f64,
    /// How many times it is played, one after the other, with stamps that go on rising.
    pub repeat: u32,
    /// Topic of the scans in the record.
    pub points_topic: Option<String>,
    /// Topic of the odometry in the record.
    pub odometry_topic: Option<String>,
    /// Frame in which the poses of the record are wanted.
    pub map_frame: Option<String>,
    /// Topic of the poses of the robot's submaps in the record, `geometry_msgs/PoseArray`. It is played once then, and
    /// `[submaps] length_m` begins none.
    pub submaps_topic: Option<String>,
    /// Pose file of a folder of scans.
    pub poses: Option<PathBuf>,
    /// Listen here for scans over TCP.
    pub listen_tcp: Option<SocketAddr>,
    /// Listen here for scans over a Unix socket.
    pub listen_unix: Option<PathBuf>,
    /// Permissions of its file, in octal: who may write to it may feed scans.
    pub unix_mode: String,
    /// Most points in a scan.
    pub scan_points_max: u32,
    /// Most single voxels in a message of states.
    pub states_max: u32,
    /// Most voxels of a box in a message of states.
    pub box_states_max: u32,
    /// A scan or states whose stamp is off the system clock by more than this, when it is received, is refused.
    pub stamp_error_max_s: f64,
}

impl Default for SensorSection {
    fn default() -> Self {
        Self {
            record: None,
            speed: 1.0,
            start_s: 0.0,
            repeat: 1,
            points_topic: None,
            odometry_topic: None,
            map_frame: None,
            submaps_topic: None,
            poses: None,
            listen_tcp: None,
            listen_unix: None,
            unix_mode: "0600".into(),
            scan_points_max: 1 << 20,
            states_max: 1 << 20,
            box_states_max: 1 << 24,
            stamp_error_max_s: 10.0,
        }
    }
}

/// `[map_output]`: neither, one or both of `listen_unix` and `listen_tcp`.
#[derive(Clone, PartialEq, Eq, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MapOutputSection {
    /// Give the map out here over a Unix socket.
    pub listen_unix: Option<PathBuf>,
    /// Permissions of its file, in octal: who may write to it may read the map.
    pub unix_mode: String,
    /// Give the map out here over TCP.
    pub listen_tcp: Option<SocketAddr>,
    /// Most readers at once.
    pub readers_max: u32,
    /// A new state of the map is given out so often at most.
    pub period_ms: u32,
}

impl Default for MapOutputSection {
    fn default() -> Self {
        Self { listen_unix: None, unix_mode: "0600".into(), listen_tcp: None, readers_max: 16, period_ms: 20 }
    }
}

/// `[record]`
#[derive(Clone, PartialEq, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RecordSection {
    /// What the node sees and sends is recorded here, an `.mcap`. If there is one, the new one gets a number.
    pub path: Option<PathBuf>,
    /// Whether scans are recorded, so that the flight can be replayed.
    pub scans: bool,
    /// Whether it is recorded who saw each voxel last.
    pub origins: bool,
    /// The map is drawn so often at most, for Foxglove and Rerun; 0: never.
    pub picture_period_s: f64,
    /// Bytes that the file may have.
    pub bytes_max: u64,
}

impl Default for RecordSection {
    fn default() -> Self {
        let FlightOptions { scans, origins, picture_period, bytes_max } = FlightOptions::default();
        Self { path: None, scans, origins, picture_period_s: picture_period.as_secs_f64(), bytes_max }
    }
}

/// `[view]`
#[derive(Clone, PartialEq, Eq, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ViewSection {
    /// Show the map here to browsers, with the counters at `/metrics`.
    pub listen: Option<SocketAddr>,
    /// What a browser must know: 16 to 128 letters, digits, - and _. Needed beyond the loopback; where it is not
    /// given, one is drawn at each start. The log says what to open.
    pub token: Option<Secret>,
    /// A file with nothing but the token.
    pub token_file: Option<PathBuf>,
}

/// `[metrics]`
#[derive(Clone, PartialEq, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MetricsSection {
    /// Serve counters as Prometheus text at `http://ADDRESS:PORT/metrics`.
    pub prometheus: Option<SocketAddr>,
    /// A line of counters after each such time; 0: never.
    pub status_period_s: f64,
}

impl Default for MetricsSection {
    fn default() -> Self {
        Self { prometheus: None, status_period_s: 1.0 }
    }
}

/// `[alignment.ID]`: `T_own_origin`.
#[derive(Clone, PartialEq, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AlignmentSection {
    /// Where the origin of the other robot's frame lies, in metres.
    #[serde(default)]
    pub translation_m: [f64; 3],
    /// Rotation x, y, z, w. This or `yaw_deg`.
    pub quaternion_xyzw: Option<[f64; 4]>,
    /// Rotation about z in degrees.
    pub yaw_deg: Option<f64>,
}

/// `[submaps]`: a submap begins when the sensor program says so, or by the way.
#[derive(Clone, PartialEq, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SubmapsSection {
    /// A submap begins after so many metres of way of the sensor.
    pub length_m: Option<f64>,
}

/// `[teammates]`: what is not given is as in [`flockmap::RobotConfig`].
#[derive(Clone, PartialEq, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TeammatesSection {
    /// Returns so near to a team-mate are no obstacle.
    pub radius_m: Option<f64>,
    /// A position counts for this long.
    pub timeout_ms: Option<u32>,
}

/// `[output]`. None of these files is a secret: they get the permissions that the umask leaves.
#[derive(Clone, PartialEq, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OutputSection {
    /// The fused map is written here at the end: `.ply`, `.pcd` or `.bt`.
    pub save_map_at_end: Option<PathBuf>,
    /// Whether free voxels go into `.ply` and `.pcd` too.
    pub save_free: bool,
    /// The summary is written here as JSON at the end.
    pub report_json: Option<PathBuf>,
    /// End after so long.
    pub end_after_s: Option<f64>,
    /// End when the record has been played and nothing has come or gone for so long.
    pub end_when_quiet_s: Option<f64>,
    /// At the end, give others so long to get the last packages. It is over sooner if all that are heard have
    /// confirmed them.
    pub linger_ms: u32,
}

impl Default for OutputSection {
    fn default() -> Self {
        Self {
            save_map_at_end: None,
            save_free: false,
            report_json: None,
            end_after_s: None,
            end_when_quiet_s: None,
            linger_ms: 500,
        }
    }
}

#[cfg(test)]
mod tests;
