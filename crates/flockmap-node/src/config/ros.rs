//! `[ros]`: what the program `flockmap-ros` does beside a node. Here, so that one file serves both programs.

use std::collections::BTreeMap;

use flockmap::RobotId;
use schemars::JsonSchema;
use serde::Deserialize;

use super::convert::{seconds, within};
use super::error::ConfigError;

/// `[ros]`: the topics of ROS 2, for the program `flockmap-ros`. `flockmap node` has none.
///
/// A period of 0 means that this is not published.
#[derive(Clone, PartialEq, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RosSection {
    /// Frame of tf that the map is in.
    pub map_frame: String,
    /// Whether scans are asked for again where parts of them are lost. Their publisher must offer it.
    pub points_reliable: bool,
    /// Where the pose of a scan comes from.
    pub poses: RosPoses,
    /// A scan waits so long for its pose.
    pub pose_wait_s: f64,
    /// Between two poses that are further apart than this none is made up.
    pub pose_gap_max_s: f64,
    /// Whether `/clock` tells the time.
    pub use_sim_time: bool,
    /// Addresses of the network interfaces that DDS uses.
    pub interfaces: Vec<String>,
    /// Domain of DDS. Where it is not given the environment variable `ROS_DOMAIN_ID` counts, else 0.
    pub domain_id: Option<u16>,
    /// Topics of positions of team-mates in the frame of the map, `geometry_msgs/PoseStamped`, by robot.
    pub teammates: BTreeMap<RobotId, String>,
    /// Topics of alignments `T_own_origin`, `geometry_msgs/PoseStamped`, by robot.
    pub alignments: BTreeMap<RobotId, String>,
    /// Topic of how the submaps lie in the frame of the map, `geometry_msgs/PoseArray`: pose n is `T_map_submap` of
    /// submap n, and where there are more than have begun, more begin. None if it is empty.
    pub submaps: String,
    /// `occupied_points` has what is so near to the robot.
    pub near_range_m: f64,
    /// `occupied_points` is published so often at most.
    pub near_period_s: f64,
    /// `occupied_points_all` is published so often at most.
    pub all_period_s: f64,
    /// `grid` and `grid_updates` are published so often at most.
    pub grid_period_s: f64,
    /// Lowest and highest height of the band that `grid` shows, in the frame of the map.
    pub grid_band_m: [f64; 2],
    /// `octomap_binary` is published so often at most.
    pub octomap_period_s: f64,
    /// `distance_field` is published so often at most.
    pub field_period_s: f64,
    /// It has a box that goes so far from the robot, along each axis.
    pub field_range_m: [f64; 3],
    /// Distances are known up to this.
    pub field_distance_max_m: f64,
    /// `robots` is published so often.
    pub robots_period_s: f64,
    /// `/diagnostics` is published so often.
    pub diagnostics_period_s: f64,
}

/// Where the pose of a scan comes from.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum RosPoses {
    /// `/tf` and `/tf_static`: the frame of the scan in that of the map.
    #[default]
    Tf,
    /// `odom`, a `nav_msgs/Odometry` in any frame, which is that of the map; from its child frame to the
    /// scan's by `/tf_static`.
    Odometry,
}

impl Default for RosSection {
    fn default() -> Self {
        Self {
            map_frame: "map".into(),
            points_reliable: false,
            poses: RosPoses::Tf,
            pose_wait_s: 0.5,
            pose_gap_max_s: 0.5,
            use_sim_time: false,
            interfaces: vec!["127.0.0.1".into()],
            domain_id: None,
            teammates: BTreeMap::new(),
            alignments: BTreeMap::new(),
            submaps: String::new(),
            near_range_m: 10.0,
            near_period_s: 0.2,
            all_period_s: 1.0,
            grid_period_s: 0.5,
            grid_band_m: [0.2, 2.0],
            octomap_period_s: 5.0,
            field_period_s: 0.5,
            field_range_m: [5.0, 5.0, 2.0],
            field_distance_max_m: 2.0,
            robots_period_s: 0.5,
            diagnostics_period_s: 1.0,
        }
    }
}

impl RosSection {
    /// Checks all that can be known without ROS.
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        for (key, value) in [
            ("[ros] pose_wait_s", self.pose_wait_s),
            ("[ros] pose_gap_max_s", self.pose_gap_max_s),
            ("[ros] near_period_s", self.near_period_s),
            ("[ros] all_period_s", self.all_period_s),
            ("[ros] grid_period_s", self.grid_period_s),
            ("[ros] octomap_period_s", self.octomap_period_s),
            ("[ros] field_period_s", self.field_period_s),
            ("[ros] robots_period_s", self.robots_period_s),
            ("[ros] diagnostics_period_s", self.diagnostics_period_s),
        ] {
            seconds(key, value)?;
        }
        let [low, high] = self.grid_band_m;
        within("[ros] grid_band_m", low, -1e6..=1e6, "two heights of -1,000,000 to 1,000,000 m")?;
        within("[ros] grid_band_m", high, low..=1e6, "the lower height first")?;
        for (key, value) in [
            ("[ros] near_range_m", self.near_range_m),
            ("[ros] field_range_m", self.field_range_m[0]),
            ("[ros] field_range_m", self.field_range_m[1]),
            ("[ros] field_range_m", self.field_range_m[2]),
            ("[ros] field_distance_max_m", self.field_distance_max_m),
        ] {
            within(key, value, 0.0..=1e4, "metres, 0 to 10,000")?;
        }
        Ok(())
    }
}
