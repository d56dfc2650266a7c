//! Options of an application.

use flockmap::codec::Codec;
use flockmap_grid::Resolution;
use flockmap_worlds::Lidar;

/// How the two maps are kept in sync.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum MapSync {
    /// Not at all: each robot has what it sees itself.
    None,
    /// Over an emulated radio.
    Radio {
        /// Bytes a second that each robot can send, 28 bytes of IP and UDP counted for each datagram. The
        /// session has the same budget. `None`: no limit (the session keeps its default of 2,000,000).
        rate_bytes_per_s: Option<u32>,
        /// Share of datagrams that are lost, 0 to 1.
        loss: f64,
        /// Delay of a datagram in milliseconds.
        delay_ms: u32,
    },
}

/// How the robots see, map, send and fly. The defaults are the paper's where it gives a value.
#[derive(Clone, PartialEq, Debug)]
pub struct ApplicationOptions {
    /// Seed of the radio and the sessions. The course has its own.
    pub seed: u64,
    /// How the maps are kept in sync. Default a radio without limit or loss, 20 ms of delay.
    pub sync: MapSync,
    /// Side of a voxel. Default 0.1 m (paper).
    pub resolution: Resolution,
    /// Rays are cut at this length, in metres. Default 7.5.
    pub range_m: f64,
    /// Half extents of the update box of the mapper in metres. Default 7.5, 7.5, 1.5 (paper).
    pub update_box_m: [f64; 3],
    /// Milliseconds after which a batch of mapping is sent. Default 200 (paper).
    pub publish_period_ms: u32,
    /// The same for obstacles, ahead of free space. Default `None`: with everything else (paper).
    pub obstacle_period_ms: Option<u32>,
    /// Codec of the packages. Default `paper`.
    pub codec: Codec,
    /// The LiDAR of both robots. Default Avia (paper). Every beam that meets nothing within `range_m` carves
    /// free space up to there: the real device sees 190 m and more, and in a forest nearly every beam comes
    /// back from somewhere.
    pub lidar: Lidar,
    /// Highest speed in m/s. Default 1.5 (paper).
    pub speed_m_s: f64,
    /// Highest acceleration in m/s². Default 2.
    pub acceleration_m_s2: f64,
    /// How far behind the leader the follower keeps, in metres. Default 2.5.
    pub distance_m: f64,
    /// The flight ends after so many seconds. Default 90.
    pub seconds_max: f64,
}

impl Default for ApplicationOptions {
    fn default() -> Self {
        Self {
            seed: 1,
            sync: MapSync::Radio { rate_bytes_per_s: None, loss: 0.0, delay_ms: 20 },
            resolution: Resolution::from_micrometres(100_000).expect("0.1 m is a resolution"),
            range_m: 7.5,
            update_box_m: [7.5, 7.5, 1.5],
            publish_period_ms: 200,
            obstacle_period_ms: None,
            codec: Codec::Paper,
            lidar: Lidar::Avia,
            speed_m_s: 1.5,
            acceleration_m_s2: 2.0,
            distance_m: 2.5,
            seconds_max: 90.0,
        }
    }
}
