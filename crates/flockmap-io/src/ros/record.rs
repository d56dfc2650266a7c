//! What a record of MCAP needs of its messages: of each only the part that is used, as cheaply as it goes.

use flockmap_grid::{Pose, Stamp, SubmapId};
use serde::Deserialize;

use super::cdr::{CdrReader, decode};
use super::cloud::PointCloud2;
use super::geometry::{self, Odometry, PoseArray, TFMessage};
use super::message::RosMessage;
use super::parts;
use super::points::{CloudPoints, points_of};
use super::time::Header;
use crate::error::Fault;

pub(crate) const POINT_CLOUD: &str = PointCloud2::<&[u8]>::SCHEMA;
pub(crate) const ODOMETRY: &str = Odometry::SCHEMA;
pub(crate) const TRANSFORMS: &str = TFMessage::SCHEMA;
pub(crate) const POSES: &str = PoseArray::SCHEMA;
/// Ending of the topic of rays that came back with nothing, beside the topic of the points.
pub(crate) const NO_RETURNS: &str = "/no_returns";

/// The header of a point cloud message and the number of its points: cheap to read.
pub(crate) fn decode_cloud_header(message: &[u8]) -> Result<(Header, u64), Fault> {
    let mut cdr = CdrReader::new(message)?;
    let header = cdr.read("the header")?;
    let (height, width): (u32, u32) = cdr.read("the height and width")?;
    Ok((header, u64::from(height) * u64::from(width)))
}

/// The points of a point cloud message: [`points_of`].
pub(crate) fn decode_points(
    message: &[u8],
    points_max: u64,
    transform: Option<&Pose>,
) -> Result<CloudPoints, Fault> {
    points_of(&decode::<PointCloud2<&[u8]>>(message)?, points_max, transform)
}

/// A pose of one frame in another.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct StampedPose {
    pub(crate) stamp: Stamp,
    pub(crate) parent: String,
    pub(crate) child: String,
    pub(crate) pose: Pose,
}

/// What odometry and transforms begin with. A pose follows.
#[derive(Deserialize)]
struct Frames {
    header: Header,
    #[serde(with = "parts::frame")]
    child_frame_id: String,
}

impl StampedPose {
    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, Fault> {
        let Frames { header, child_frame_id: child } = cdr.read("the header and the child frame")?;
        let pose = read_pose(cdr)?;
        Ok(Self { stamp: header.stamp.into(), parent: header.frame_id, child, pose })
    }
}

fn read_pose(cdr: &mut CdrReader<'_>) -> Result<Pose, Fault> {
    let place = cdr.place();
    let pose: geometry::Pose = cdr.read("a pose")?;
    pose.checked().ok_or_else(|| {
        let expected = "a finite position and a quaternion that is not zero";
        Fault::damaged(place, expected, format!("{:?}, {:?}", pose.position, pose.orientation))
    })
}

/// The pose of an odometry message, which may end behind it.
pub(crate) fn decode_odometry(message: &[u8]) -> Result<StampedPose, Fault> {
    StampedPose::read(&mut CdrReader::new(message)?)
}

/// The poses of a transform message; one that is none is an error that names its byte.
pub(crate) fn decode_transforms(message: &[u8]) -> Result<Vec<StampedPose>, Fault> {
    let mut cdr = CdrReader::new(message)?;
    let place = cdr.place();
    let count: u32 = cdr.read("the number of transforms")?;
    // A transform takes at least 72 bytes: more cannot follow than fit.
    let most = cdr.left() / 72;
    if count as usize > most {
        let expected = format!("at most {most} transforms in {} bytes", cdr.left());
        return Err(Fault::damaged(place, expected, count.to_string()));
    }
    (0..count).map(|_| StampedPose::read(&mut cdr)).collect()
}

/// The poses of all submaps of a run, rounded as a robot rounds them, and the stamp of the message: a `PoseArray`.
pub(crate) fn decode_submaps(message: &[u8]) -> Result<(Stamp, Vec<Pose>), Fault> {
    let mut cdr = CdrReader::new(message)?;
    let header: Header = cdr.read("the header")?;
    let place = cdr.place();
    let count: u32 = cdr.read("the number of poses")?;
    if u64::from(count) > SubmapId::COUNT as u64 {
        let what = "the number of submaps";
        return Err(Fault::too_large(place, what, u64::from(count), SubmapId::COUNT as u64));
    }
    let read = |cdr: &mut CdrReader<'_>| {
        let place = cdr.place();
        let rounded = read_pose(cdr)?.rounded();
        rounded
            .map_err(|error| Fault::damaged(place, "a pose of a submap, within ±214 km", error.to_string()))
    };
    let poses = (0..count).map(|_| read(&mut cdr)).collect::<Result<_, _>>()?;
    Ok((header.stamp.into(), poses))
}

/// Text of a message definition with all it uses, as MCAP's schema encoding `ros2msg` asks for.
pub(crate) fn definition(message: &str) -> &'static str {
    match message {
        POINT_CLOUD => include_str!("PointCloud2.txt"),
        ODOMETRY => include_str!("Odometry.txt"),
        POSES => include_str!("PoseArray.txt"),
        _ => include_str!("TFMessage.txt"),
    }
}
