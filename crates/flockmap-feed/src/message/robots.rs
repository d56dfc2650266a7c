//! Where robots are, how they hear each other, and what one sees.

use core::time::Duration;

use flockmap_grid::{RobotId, Stamp, Stream};

use super::{FRAME_BYTES_MAX, field};
use crate::FeedError;
use crate::bytes::Fields;

/// A robot in a poses frame.
const POSE_BYTES: usize = 2 + 8 + 3 * 8 + 1 + 4 * 8 + 8;
/// A robot in a links frame.
const LINK_BYTES: usize = 2 + 8 + 1 + 4 + 4 + 8 + 8 + 4 + 4 + 8;

/// Flags of a link.
const HEARS_US: u8 = 1;
const ROUND_TRIP: u8 = 2;

const ROUND_TRIP_MAX: Duration = Duration::from_secs(3_600);
/// All is lost.
const LOSS_ONE: u32 = 1 << 16;

/// Where a robot is, as far as the node knows.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct RobotPose {
    /// The robot and its run.
    pub stream: Stream,
    /// Where its sensor was, in metres in the frame of the map.
    pub position: [f64; 3],
    /// How its sensor was turned in the map: a quaternion x, y, z, w. Known of the node's own robot.
    pub orientation: Option<[f64; 4]>,
    /// How long ago that was when the frame was made.
    pub age: Duration,
}

/// How another robot is heard.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Link {
    /// The other robot and its run.
    pub stream: Stream,
    /// Whether it hears this one, as far as its last request says.
    pub hears_us: bool,
    /// Smoothed round trip, once measured; at most an hour.
    pub round_trip: Option<Duration>,
    /// Share of the packages sent to it that were lost, of the last 64 or so, in parts of 65,536.
    pub loss: u32,
    /// Bytes heard from it, UDP payload.
    pub bytes_in: u64,
    /// Bytes sent to it alone.
    pub bytes_out: u64,
    /// Packages of its run that are known to exist and have not come.
    pub missing: u32,
    /// Packages of this robot's run that it has not confirmed.
    pub unconfirmed: u32,
    /// How long before the frame was made it was last heard.
    pub silence: Duration,
}

/// What the sensor saw, thinned for people.
#[derive(Clone, PartialEq, Debug)]
pub struct SeenScan {
    /// Of the scan, on the node's clock.
    pub stamp: Stamp,
    /// Where the sensor was, in metres in the frame of the map.
    pub position: [f64; 3],
    /// How it was turned: a quaternion x, y, z, w.
    pub orientation: [f64; 4],
    /// Points that the scan had.
    pub points_all: u32,
    /// Some of them in the frame of the sensor, in metres: at most [`Self::POINTS_MAX`].
    pub points: Vec<[f32; 3]>,
}

impl SeenScan {
    /// Most points that are given.
    pub const POINTS_MAX: usize = 2_048;

    pub(super) fn put(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.stamp.0.to_le_bytes());
        put_f64s(bytes, &self.position);
        put_f64s(bytes, &self.orientation);
        bytes.extend_from_slice(&self.points_all.to_le_bytes());
        let points = &self.points[..self.points.len().min(Self::POINTS_MAX)];
        bytes.extend_from_slice(&(points.len() as u32).to_le_bytes());
        points.as_flattened().iter().for_each(|at| bytes.extend_from_slice(&at.to_le_bytes()));
    }

    pub(super) fn parse(body: &[u8]) -> Result<Self, FeedError> {
        let mut fields = Fields::new("scan", body);
        let stamp = Stamp(fields.i64("stamp")?);
        let (position, orientation) = (fields.finite("position")?, fields.finite("orientation")?);
        let (points_all, count) = (fields.u32("number of points")?, fields.u32("count")? as usize);
        if count > Self::POINTS_MAX {
            return Err(field("scan", "count", count as u64, "2,048 points at most"));
        }
        let count = fields.check_count("points", count, 3 * 4)?;
        let mut points = Vec::with_capacity(count);
        for _ in 0..count {
            let point = [fields.f32("point")?, fields.f32("point")?, fields.f32("point")?];
            if !point.iter().all(|at| at.is_finite()) {
                return Err(field("scan", "point", points.len() as u64, "finite numbers"));
            }
            points.push(point);
        }
        Ok(Self { stamp, position, orientation, points_all, points })
    }
}

impl Link {
    pub(super) fn put_all(links: &[Self], bytes: &mut Vec<u8>) {
        put_list(bytes, links, LINK_BYTES, Self::put);
    }

    pub(super) fn parse_all(body: &[u8]) -> Result<Vec<Self>, FeedError> {
        parse_list(body, "links", LINK_BYTES, Self::parse)
    }

    fn put(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.stream.origin.0.to_le_bytes());
        bytes.extend_from_slice(&self.stream.epoch.to_le_bytes());
        let round_trip = self.round_trip.map(|time| time.min(ROUND_TRIP_MAX).as_micros() as u32);
        let flags = [(self.hears_us, HEARS_US), (round_trip.is_some(), ROUND_TRIP)];
        bytes.push(flags.iter().filter(|(is_set, _)| *is_set).map(|(_, flag)| flag).sum());
        bytes.extend_from_slice(&round_trip.unwrap_or_default().to_le_bytes());
        bytes.extend_from_slice(&self.loss.min(LOSS_ONE).to_le_bytes());
        bytes.extend_from_slice(&self.bytes_in.to_le_bytes());
        bytes.extend_from_slice(&self.bytes_out.to_le_bytes());
        bytes.extend_from_slice(&self.missing.to_le_bytes());
        bytes.extend_from_slice(&self.unconfirmed.to_le_bytes());
        bytes.extend_from_slice(&micros(self.silence).to_le_bytes());
    }

    fn parse(fields: &mut Fields<'_>) -> Result<Self, FeedError> {
        let stream = Stream { origin: RobotId(fields.u16("robot id")?), epoch: fields.u64("epoch")? };
        let flags = fields.u8("flags")?;
        let round_trip = Duration::from_micros(fields.u32("round trip")?.into()).min(ROUND_TRIP_MAX);
        let loss = fields.u32("loss")?;
        if loss > LOSS_ONE {
            return Err(field("links", "loss", loss.into(), "65,536 at most"));
        }
        Ok(Self {
            stream,
            hears_us: flags & HEARS_US != 0,
            round_trip: (flags & ROUND_TRIP != 0).then_some(round_trip),
            loss,
            bytes_in: fields.u64("bytes in")?,
            bytes_out: fields.u64("bytes out")?,
            missing: fields.u32("missing")?,
            unconfirmed: fields.u32("unconfirmed")?,
            silence: Duration::from_micros(fields.u64("silence")?),
        })
    }
}

impl RobotPose {
    pub(super) fn put_all(poses: &[Self], bytes: &mut Vec<u8>) {
        put_list(bytes, poses, POSE_BYTES, Self::put);
    }

    pub(super) fn parse_all(body: &[u8]) -> Result<Vec<Self>, FeedError> {
        parse_list(body, "poses", POSE_BYTES, Self::parse)
    }

    fn put(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.stream.origin.0.to_le_bytes());
        bytes.extend_from_slice(&self.stream.epoch.to_le_bytes());
        put_f64s(bytes, &self.position);
        bytes.push(u8::from(self.orientation.is_some()));
        put_f64s(bytes, &self.orientation.unwrap_or_default());
        bytes.extend_from_slice(&micros(self.age).to_le_bytes());
    }

    fn parse(fields: &mut Fields<'_>) -> Result<Self, FeedError> {
        let stream = Stream { origin: RobotId(fields.u16("robot id")?), epoch: fields.u64("epoch")? };
        let position = fields.finite("position")?;
        let is_known = fields.u8("orientation")? != 0;
        let orientation = if is_known { Some(fields.finite("orientation")?) } else { None };
        if !is_known {
            fields.bytes("orientation", 4 * 8)?;
        }
        let age = Duration::from_micros(fields.u64("age")?);
        Ok(Self { stream, position, orientation, age })
    }
}

fn micros(span: Duration) -> u64 {
    u64::try_from(span.as_micros()).unwrap_or(u64::MAX)
}

fn put_f64s(bytes: &mut Vec<u8>, numbers: &[f64]) {
    numbers.iter().for_each(|number| bytes.extend_from_slice(&number.to_le_bytes()));
}

/// A count and as many as a frame has room for.
fn put_list<T>(bytes: &mut Vec<u8>, list: &[T], bytes_each: usize, put: impl Fn(&T, &mut Vec<u8>)) {
    let list = &list[..list.len().min((FRAME_BYTES_MAX - 3) / bytes_each)];
    bytes.extend_from_slice(&(list.len() as u16).to_le_bytes());
    list.iter().for_each(|item| put(item, bytes));
}

fn parse_list<T>(
    body: &[u8],
    kind: &'static str,
    bytes_each: usize,
    parse: impl Fn(&mut Fields<'_>) -> Result<T, FeedError>,
) -> Result<Vec<T>, FeedError> {
    let mut fields = Fields::new(kind, body);
    let count = fields.u16("count")?;
    let count = fields.check_count("robots", count.into(), bytes_each)?;
    (0..count).map(|_| parse(&mut fields)).collect()
}
