//! What became of an application.

/// How a flight ended.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Ending {
    /// The leader reached the goal and nobody touched anything.
    Goal,
    /// The leader touched something solid: its centre came nearer than [`BODY_RADIUS_M`](super::BODY_RADIUS_M).
    LeaderHit,
    /// The follower touched something solid.
    FollowerHit,
    /// The robots touched each other.
    RobotsTouched,
    /// The time was over, or a robot found no path on until then.
    TimeOut,
}

/// What one robot sent and received: UDP payload; IP and UDP headers take 28 bytes more for each datagram.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct RobotTraffic {
    /// Bytes sent.
    pub sent_bytes: u64,
    /// Datagrams sent.
    pub sent_datagrams: u64,
    /// Most bytes sent within any second.
    pub sent_bytes_per_s_max: u64,
    /// Bytes received.
    pub received_bytes: u64,
    /// Datagrams received.
    pub received_datagrams: u64,
    /// Most bytes received within any second.
    pub received_bytes_per_s_max: u64,
}

/// What became of a flight.
#[derive(Clone, PartialEq, Debug)]
pub struct ApplicationOutcome {
    /// How it ended.
    pub ending: Ending,
    /// Virtual time from the first scan to the end, in seconds; the robots hover for the first two.
    pub seconds: f64,
    /// Where the leader was at the end, in metres.
    pub leader_at: [f64; 3],
    /// Metres that the leader flew.
    pub leader_path_m: f64,
    /// The leader's traffic (the paper's Table III and Fig. 9 are of this robot).
    pub leader: RobotTraffic,
    /// The follower's traffic.
    pub follower: RobotTraffic,
    /// Age of the follower's obstacle voxels when they came into the leader's map, from the scan that saw
    /// them: median, in seconds. 0 if none came.
    pub obstacle_age_median_s: f64,
    /// The same: 99 of 100 are not older.
    pub obstacle_age_p99_s: f64,
}

impl ApplicationOutcome {
    /// Whether the leader reached the goal and nobody touched anything.
    pub const fn is_success(&self) -> bool {
        matches!(self.ending, Ending::Goal)
    }
}
