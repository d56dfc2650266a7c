//! Where the scans of a node come from.

mod connections;
mod fields;
mod message;
mod play;
mod repeat;
mod socket;
mod states;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use flockmap::{Pose, RobotId, Stamp};
use flockmap_io::{Frame, Frames, SubmapPoses};

pub(crate) use connections::serve;
pub use fields::{MESSAGE_VERSION, MessageError};
pub use message::{MessageLimits, SensorMessage};
pub(crate) use play::play;
pub(crate) use repeat::repeated;
pub(crate) use socket::SensorSocket;
pub use states::{OwnedStates, StatesMessage};

/// Where the scans of a node come from.
#[derive(Debug)]
pub enum Sensor {
    /// The node has no sensor: it only listens, and passes on what it hears.
    None,
    /// A recording or a simulation. It is played in real time: the first frame comes at once, the others as
    /// far apart as their stamps, and each gets the time at which it is played as its stamp. Where the stamps
    /// go back, since a clock was stepped, it is played on at once. Read on a thread of its own.
    Play {
        /// The frames.
        frames: Frames,
        /// How the submaps of the recording lie, and from when on; empty: it says nothing of submaps.
        submaps: SubmapPoses,
        /// How fast they are played: 2.0 is twice as fast as recorded.
        speed: f64,
        /// Frames of the first so many seconds of the recording are left out.
        skip: Duration,
        /// When the first frame is played, on the node's clock; default: as soon as the node runs. So the
        /// robots of a swarm begin together.
        begin: Option<Stamp>,
    },
    /// Frames as they come, with stamps on the node's clock. A frame that finds more than four waiting makes the
    /// sender wait.
    Channel(tokio::sync::mpsc::Receiver<Frame>),
    /// Any program sends messages over TCP, see `docs/sensor-input.md`.
    Tcp(SocketAddr, MessageLimits),
    /// The same over a Unix socket.
    Unix {
        /// Its file. One that a killed node left behind is replaced; where somebody listens, the node does
        /// not start. It is removed at the end if it is still the node's own.
        path: PathBuf,
        /// Permissions of the file, such as `0o600`, whatever the umask is: who may write to it may feed scans.
        mode: u32,
        /// What a message may be.
        limits: MessageLimits,
    },
}

impl Sensor {
    /// [`Self::Play`] from the beginning, as soon as the node runs, without submaps.
    pub fn play(frames: Frames, speed: f64) -> Self {
        Self::Play { frames, submaps: SubmapPoses::default(), speed, skip: Duration::ZERO, begin: None }
    }

    /// Where it listens, for errors.
    pub(crate) fn place(&self) -> String {
        match self {
            Self::Tcp(address, _) => address.to_string(),
            Self::Unix { path, .. } => path.display().to_string(),
            Self::None | Self::Play { .. } | Self::Channel(_) => String::new(),
        }
    }
}

/// What reaches the node from its sensor.
#[derive(Debug)]
pub(crate) enum Input {
    /// A scan to insert now.
    Frame(Frame),
    /// States of voxels to insert now.
    States(StatesMessage),
    /// How another robot's frame lies in the own one.
    Alignment(RobotId, Pose),
    /// Where a team-mate is.
    Teammate(RobotId, [f64; 3]),
    /// A submap of the own run begins.
    BeginSubmap,
    /// How a submap of the own run lies in the own map; `None`: the newest one.
    SubmapPose(Option<u16>, Pose),
    /// Something was wrong: one line. It is counted.
    Fault(String),
    /// A silent connection was closed, since there was no room for another program: one line. It is counted.
    Yielded(String),
    /// Something worth a line in the log.
    Note(String),
}

/// Inputs that may wait for the node.
pub(crate) const INPUTS_WAITING_MAX: usize = 4;
