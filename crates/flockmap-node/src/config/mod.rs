//! The configuration of a node: a TOML file, as [`EXAMPLE`] shows it in full.

mod convert;
mod key;
mod parse;

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;

use serde::Deserialize;

pub(crate) use convert::{seconds, value};
pub use key::{FoundKey, KEY_VARIABLE, Secret};
pub use parse::ConfigError;

/// A configuration with every key, its meaning and its default: `robot.example.toml`.
pub const EXAMPLE: &str = include_str!("../../robot.example.toml");

/// A whole configuration. Only `id` and `[map] resolution_m` and `range_m` must be given.
#[derive(Clone, PartialEq, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NodeConfig {
    /// Number of the robot, 0 to 65,535, unique in the swarm.
    pub id: u16,
    /// Name in logs. Default `robotID`.
    pub name: Option<String>,
    /// In place of the seconds since 1970 that the machine's clock shows, from which the epoch of a run is made. If a former run is known
    /// that had as much or more, one more than that counts.
    pub epoch: Option<u32>,
    /// The mapper.
    pub map: MapSection,
    /// When changes are packed.
    #[serde(default)]
    pub batch: BatchSection,
    /// How they are coded.
    #[serde(default)]
    pub codec: CodecSection,
    /// How robots talk.
    #[serde(default)]
    pub session: SessionSection,
    /// How layers become one map.
    #[serde(default)]
    pub fusion: FusionSection,
    /// What survives a reboot.
    #[serde(default)]
    pub store: StoreSection,
    /// Where the epoch is kept.
    #[serde(default)]
    pub state: StateSection,
    /// Sockets.
    #[serde(default)]
    pub network: NetworkSection,
    /// Where scans come from.
    #[serde(default)]
    pub sensor: SensorSection,
    /// Counters.
    #[serde(default)]
    pub metrics: MetricsSection,
    /// How the frames of other robots lie in the own one, by id.
    #[serde(default)]
    pub alignment: BTreeMap<String, AlignmentSection>,
    /// How far the clocks of other robots are ahead of the own one, in milliseconds, by id. By the own id: that of former runs, 0 if the
    /// clock goes on through a restart.
    #[serde(default)]
    pub clock_offset_ms: BTreeMap<String, f64>,
    /// Team-mates in view of the sensor.
    #[serde(default)]
    pub teammates: TeammatesSection,
    /// The end, and what is left behind then.
    #[serde(default)]
    pub output: OutputSection,
}

/// `[map]`
#[derive(Clone, PartialEq, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapSection {
    /// Side of a voxel in metres. The same for all robots of the swarm.
    pub resolution_m: f64,
    /// Longest ray in metres; longer ones are cut there.
    pub range_m: f64,
    /// Points nearer than this are ignored. Metres.
    #[serde(default)]
    pub range_min_m: f64,
    /// `rog-map`, `racer` or `octomap`.
    #[serde(default = "default_mapper")]
    pub mapper: String,
    /// Memory of the own map in MiB; blocks farthest from the robot are forgotten beyond it.
    #[serde(default = "default_memory_mb")]
    pub memory_mb: u32,
    /// Half extents of a box around the sensor beyond which rays are cut. Metres.
    pub update_box_m: Option<[f64; 3]>,
    /// In place of the mapper's own value.
    pub p_hit: Option<f64>,
    /// In place of the mapper's own value.
    pub p_miss: Option<f64>,
    /// In place of the mapper's own value.
    pub p_min: Option<f64>,
    /// In place of the mapper's own value.
    pub p_max: Option<f64>,
    /// In place of the mapper's own value.
    pub p_occupied: Option<f64>,
    /// In place of the mapper's own value.
    pub p_free: Option<f64>,
}

fn default_mapper() -> String {
    "rog-map".into()
}

const fn default_memory_mb() -> u32 {
    512
}

/// `[batch]`: what is not given is as in [`flockmap::BatchConfig`].
#[derive(Clone, PartialEq, Eq, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatchSection {
    /// Longest time until changes are packed.
    pub publish_period_ms: Option<u32>,
    /// The same for obstacles alone.
    pub obstacle_period_ms: Option<u32>,
    /// Most voxels that may have changed until they are packed.
    pub voxels_max: Option<usize>,
}

/// `[codec]`
#[derive(Clone, PartialEq, Eq, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CodecSection {
    /// `flock`, `paper`, `nested-zlib`, `raw` or `racer`.
    pub name: Option<String>,
    /// `flock` tells changes against what the others hold, and for so long at most they may lack a part of it: where repair takes
    /// longer, batches are told alone. 0: they never are.
    pub repair_delay_max_ms: Option<u32>,
}

/// `[session]`: what is not given is as in [`flockmap::SessionConfig`].
#[derive(Clone, PartialEq, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SessionSection {
    /// Where the values start from: `default`, or `paper` for the paper's own behaviour.
    pub behaviour: Option<String>,
    /// Robots of other swarms are ignored.
    pub swarm: Option<u16>,
    /// The secret of the swarm: 64 hex digits, or base64. Here, in a file, or in the environment variable [`KEY_VARIABLE`].
    pub swarm_key: Option<Secret>,
    /// A file with nothing but the key.
    pub swarm_key_file: Option<PathBuf>,
    /// `unicast` or `broadcast`.
    pub cast: Option<String>,
    /// KiB that may go out in a second over all links, at least 0.49; 0: no limit.
    pub budget_kb_s: Option<f64>,
    /// KiB that may go out to one robot in a second; 0: no limit.
    pub link_budget_kb_s: Option<f64>,
    /// How much of a second's budget may go out at once.
    pub burst_ms: Option<u32>,
    /// Pause between requests while packages flow.
    pub request_period_active_ms: Option<u32>,
    /// Pause between requests when nothing flows.
    pub request_period_idle_ms: Option<u32>,
    /// Packages count as flowing for so long after the last one.
    pub active_for_ms: Option<u32>,
    /// Whether a gap is asked for at once.
    pub gap_requests: Option<bool>,
    /// How long to wait for reordered datagrams.
    pub reorder_patience_ms: Option<u32>,
    /// Least pause between requests for gaps.
    pub gap_request_pause_ms: Option<u32>,
    /// Whether new packages are sent without waiting for a request.
    pub push: Option<bool>,
    /// `newest-first` or `oldest-first`.
    pub order: Option<String>,
    /// `ranked`, `always` or `never`.
    pub relay: Option<String>,
    /// How long a package stays missing before the next robot in line sends it.
    pub relay_delay_ms: Option<u32>,
    /// `round-trip` or `previous-request`.
    pub in_flight: Option<String>,
    /// Round trip taken until one is measured.
    pub round_trip_initial_ms: Option<u32>,
    /// The snapshot is offered from so many missing KiB on; 0: only in place of what is not stored any more.
    pub snapshot_kb_min: Option<u32>,
    /// The snapshot is sent when the missing indices span more than this; 0: never for that reason.
    pub snapshot_range_max: Option<u32>,
    /// A peer not heard for so long is forgotten.
    pub peer_timeout_ms: Option<u32>,
    /// Peers known at once.
    pub peers_max: Option<usize>,
    /// Streams known at once.
    pub streams_max: Option<usize>,
    /// Runs kept of one robot.
    pub epochs_max: Option<usize>,
    /// Memory of stored packages in MiB.
    pub store_mb: Option<u32>,
}

/// `[fusion]`: what is not given is as in [`flockmap::FusionConfig`].
#[derive(Clone, PartialEq, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FusionSection {
    /// An own observation wins over a team-mate's that is newer by up to this.
    pub own_priority_ms: Option<u32>,
    /// Memory of the layers of others, and of what they add to the map, in MiB.
    pub layers_mb: Option<u32>,
    /// Memory of the own layer in MiB.
    pub own_layer_mb: Option<u32>,
    /// Robots whose layers are left out of the map.
    #[serde(default)]
    pub muted: Vec<u16>,
}

/// `[store]`
#[derive(Clone, PartialEq, Eq, Debug, Deserialize)]
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
#[derive(Clone, PartialEq, Eq, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StateSection {
    /// Folder for the epoch of the newest run, a small file; made if need be. Default: [`NodeConfig::state_folder`].
    pub path: Option<PathBuf>,
}

/// `[network]`
#[derive(Clone, PartialEq, Eq, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetworkSection {
    /// Own address and port.
    pub bind: SocketAddr,
    /// Robots to send to from the start, as `ADDRESS:PORT` or `NAME:PORT`.
    pub peers: Vec<String>,
    /// Address and port for what is for everyone.
    pub broadcast: Option<SocketAddr>,
    /// Group and port for what is for everyone.
    pub multicast: Option<SocketAddr>,
    /// IPv4 address of the interface for the group.
    pub multicast_interface: Option<Ipv4Addr>,
    /// Index of the interface for an IPv6 group.
    pub multicast_interface_index: u32,
    /// How many networks a datagram to the group may cross.
    pub multicast_ttl: u32,
    /// Room for received datagrams in KiB.
    pub receive_buffer_kb: u32,
    /// Room for datagrams to send in KiB.
    pub send_buffer_kb: u32,
}

impl Default for NetworkSection {
    fn default() -> Self {
        Self {
            bind: SocketAddr::from(([0, 0, 0, 0], 7700)),
            peers: Vec::new(),
            broadcast: None,
            multicast: None,
            multicast_interface: None,
            multicast_interface_index: 0,
            multicast_ttl: 1,
            receive_buffer_kb: 4_096,
            send_buffer_kb: 1_024,
        }
    }
}

/// `[sensor]`: at most one of `record`, `listen_tcp` and `listen_unix`.
#[derive(Clone, PartialEq, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorSection {
    /// An `.mcap`, or a folder of scans, played in real time.
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
    /// A scan whose stamp is off the system clock by more than this, when it is received, is refused.
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
            poses: None,
            listen_tcp: None,
            listen_unix: None,
            unix_mode: "0600".into(),
            scan_points_max: 1 << 20,
            stamp_error_max_s: 10.0,
        }
    }
}

/// `[metrics]`
#[derive(Clone, PartialEq, Debug, Deserialize)]
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
#[derive(Clone, PartialEq, Debug, Default, Deserialize)]
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

/// `[teammates]`
#[derive(Clone, PartialEq, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TeammatesSection {
    /// Returns so near to a team-mate are no obstacle.
    pub radius_m: Option<f64>,
    /// A position counts for this long.
    pub timeout_ms: Option<u32>,
}

/// `[output]`. None of these files is a secret: they get the permissions that the umask leaves.
#[derive(Clone, PartialEq, Debug, Deserialize)]
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
    /// At the end, give others so long to get the last packages.
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
