//! The ROS 2 messages that make a record: `sensor_msgs/msg/PointCloud2`, `nav_msgs/msg/Odometry`,
//! `tf2_msgs/msg/TFMessage`.

use flockmap_grid::{Pose, Stamp};
use serde::Serialize;

use crate::cdr::{CdrReader, Octets, encode};
use crate::error::Fault;
use crate::number::Number;

pub(crate) const POINT_CLOUD: &str = "sensor_msgs/msg/PointCloud2";
pub(crate) const ODOMETRY: &str = "nav_msgs/msg/Odometry";
pub(crate) const TRANSFORMS: &str = "tf2_msgs/msg/TFMessage";
/// Ending of the topic of rays that came back with nothing, beside the topic of the points.
pub(crate) const NO_RETURNS: &str = "/no_returns";

/// The namespace of a topic: all before its last slash.
pub(crate) fn namespace(topic: &str) -> &str {
    topic.rsplit_once('/').map_or("", |(namespace, _)| namespace)
}

/// Whether a namespace is another one, or lies within it.
pub(crate) fn is_within(namespace: &str, outer: &str) -> bool {
    namespace.strip_prefix(outer).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

/// How many names at the start of the namespaces of two topics are the same.
pub(crate) fn shared_names(a: &str, b: &str) -> usize {
    let names = |topic| namespace(topic).split('/').filter(|name| !name.is_empty());
    names(a).zip(names(b)).take_while(|(a, b)| a == b).count()
}

/// `std_msgs/msg/Header`.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Header {
    pub(crate) stamp: Stamp,
    pub(crate) frame: String,
}

impl Header {
    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, Fault> {
        let (seconds, nanoseconds): (i32, u32) = cdr.read("the stamp")?;
        let stamp = Stamp(i64::from(seconds) * 1_000_000 + i64::from(nanoseconds) / 1_000);
        Ok(Self { stamp, frame: frame_name(cdr)? })
    }

    /// As it is written: seconds, nanoseconds, frame.
    fn parts(&self) -> (i32, u32, &str) {
        let micros = self.stamp.0;
        (micros.div_euclid(1_000_000) as i32, micros.rem_euclid(1_000_000) as u32 * 1_000, &self.frame)
    }
}

/// Frames are the same with and without the slash in front that ROS 1 used to put there.
fn frame_name(cdr: &mut CdrReader<'_>) -> Result<String, Fault> {
    let name = cdr.string("the frame")?;
    Ok(name.strip_prefix('/').map(str::to_owned).unwrap_or(name))
}

/// The header of a point cloud message and the number of its points: cheap to read.
pub(crate) fn decode_cloud_header(message: &[u8]) -> Result<(Header, u64), Fault> {
    let mut cdr = CdrReader::new(message)?;
    let header = Header::read(&mut cdr)?;
    let (height, width): (u32, u32) = cdr.read("the height and width")?;
    Ok((header, u64::from(height) * u64::from(width)))
}

/// The points of a point cloud message.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct CloudPoints {
    pub(crate) points: Vec<[f32; 3]>,
    /// Points left out because a coordinate was not a finite number.
    pub(crate) dropped: u64,
}

/// Reads the points of a cloud of at most `points_max` points, whatever the layout of its fields, and takes
/// them through `transform` where one is given.
pub(crate) fn decode_points(
    message: &[u8],
    points_max: u64,
    transform: Option<&Pose>,
) -> Result<CloudPoints, Fault> {
    let mut cdr = CdrReader::new(message)?;
    Header::read(&mut cdr)?;
    let (height, width): (u32, u32) = cdr.read("the height and width")?;
    let count = u64::from(height) * u64::from(width);
    if count > points_max {
        return Err(Fault::too_large(cdr.place(), "the number of points in a scan", count, points_max));
    }
    let mut axes: [Option<(u32, Number)>; 3] = [None; 3];
    let place = cdr.place();
    let mut names = Vec::new();
    for _ in 0..cdr.read::<u32>("the number of fields")? {
        let name = cdr.string("the name of a field")?;
        let (offset, datatype, _count): (u32, u8, u32) = cdr.read("a field")?;
        let number = match datatype {
            7 => Some(Number::F32),
            8 => Some(Number::F64),
            _ => None,
        };
        for (axis, slot) in ["x", "y", "z"].iter().zip(&mut axes) {
            if let Some(number) = number.filter(|_| *axis == name) {
                *slot = Some((offset, number));
            }
        }
        if names.len() < 16 {
            names.push(format!("{name} (type {datatype})"));
        }
    }
    let [Some(x), Some(y), Some(z)] = axes else {
        let expected = "fields x, y, z of type 7 (FLOAT32) or 8 (FLOAT64)";
        return Err(Fault::foreign(place, expected, names.join(", ")));
    };
    let big_endian = cdr.read::<u8>("the byte order")? != 0;
    let place = cdr.place();
    let (point_step, row_step): (u32, u32) = cdr.read("the bytes of a point and of a row")?;
    let data: &[u8] = cdr.read("point data")?;
    for (offset, number) in [x, y, z] {
        let end = u64::from(offset) + number.size();
        if end > u64::from(point_step) {
            let expected = format!("fields within the {point_step} bytes of a point");
            return Err(Fault::damaged(place, expected, format!("a field that ends at byte {end}")));
        }
    }
    let row_bytes = u64::from(width) * u64::from(point_step);
    let row_step = if height <= 1 { row_bytes } else { u64::from(row_step) };
    if count == 0 {
        return Ok(CloudPoints::default());
    }
    let needed = row_step.saturating_mul(u64::from(height) - 1).saturating_add(row_bytes);
    if row_step < row_bytes || needed > data.len() as u64 {
        let expected = format!("{needed} bytes for {height} rows of {width} points of {point_step} bytes");
        let found = format!("{} bytes in rows of {row_step}", data.len());
        return Err(Fault::damaged(place, expected, found));
    }
    let mut cloud = CloudPoints { points: Vec::with_capacity(count as usize), dropped: 0 };
    for row in data.chunks(row_step as usize).take(height as usize) {
        for point in row.chunks_exact(point_step as usize).take(width as usize) {
            let mut p = [x, y, z].map(|(offset, number)| {
                let bytes = point.get(offset as usize..).unwrap_or_default();
                // Deciding between these two here, and not between all types at each number, takes half the time.
                match number {
                    Number::F32 => Number::F32.read(bytes, big_endian),
                    _ => Number::F64.read(bytes, big_endian),
                }
            });
            if let Some(transform) = transform {
                p = transform.transform(p);
            }
            let p = p.map(|v| v as f32);
            if p.iter().all(|v| v.is_finite()) {
                cloud.points.push(p);
            } else {
                cloud.dropped += 1;
            }
        }
    }
    Ok(cloud)
}

/// A point cloud of x, y, z as `f32`, unorganised.
pub(crate) fn encode_points(header: &Header, points: &[[f32; 3]]) -> Vec<u8> {
    let mut data = Vec::with_capacity(12 * points.len());
    points.as_flattened().iter().for_each(|v| data.extend_from_slice(&v.to_le_bytes()));
    encode_cloud(header, &["x", "y", "z"], &data)
}

/// The same with a colour at each point, as viewers of ROS know it: `rgb`, the bytes blue, green, red, 0 in
/// the place of an `f32`.
pub(crate) fn encode_coloured_points(header: &Header, points: &[([f32; 3], [u8; 3])]) -> Vec<u8> {
    let mut data = Vec::with_capacity(16 * points.len());
    for (point, [red, green, blue]) in points {
        point.iter().for_each(|v| data.extend_from_slice(&v.to_le_bytes()));
        data.extend_from_slice(&[*blue, *green, *red, 0]);
    }
    encode_cloud(header, &["x", "y", "z", "rgb"], &data)
}

/// Points with fields of four bytes each.
fn encode_cloud(header: &Header, fields: &[&str], data: &[u8]) -> Vec<u8> {
    let point_bytes = 4 * fields.len() as u32;
    let bytes = data.len() as u32;
    // Offset, type FLOAT32, one number.
    let fields: Vec<_> =
        fields.iter().zip((0u32..).step_by(4)).map(|(name, at)| (name, at, 7u8, 1u32)).collect();
    let size = (1u32, bytes / point_bytes);
    // Little-endian before the sizes, and no point missing behind the data.
    let cloud = (header.parts(), size, fields, (0u8, point_bytes, bytes), Octets(data), 1u8);
    encode(&cloud, data.len() + 256)
}

/// A pose of one frame in another.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Transform {
    pub(crate) header: Header,
    pub(crate) child: String,
    pub(crate) pose: Pose,
}

impl Transform {
    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, Fault> {
        let header = Header::read(cdr)?;
        let child = frame_name(cdr)?;
        let place = cdr.place();
        let numbers: [f64; 7] = cdr.read("a pose")?;
        let [x, y, z, quaternion @ ..] = numbers;
        let pose = Pose::new([x, y, z], quaternion).ok_or_else(|| {
            let expected = "a finite position and a quaternion that is not zero";
            Fault::damaged(place, expected, format!("{numbers:?}"))
        })?;
        Ok(Self { header, child, pose })
    }

    /// As it is written: header, child, position, quaternion.
    fn parts(&self) -> impl Serialize {
        (self.header.parts(), &self.child, self.pose.translation(), self.pose.quaternion_xyzw())
    }
}

pub(crate) fn decode_odometry(message: &[u8]) -> Result<Transform, Fault> {
    Transform::read(&mut CdrReader::new(message)?)
}

/// An odometry message with no covariance and no velocity.
pub(crate) fn encode_odometry(transform: &Transform) -> Vec<u8> {
    // The covariance of the pose, the velocity and its covariance.
    encode(&(transform.parts(), [[0.0f64; 6]; 6], [0.0f64; 6], [[0.0f64; 6]; 6]), 1024)
}

pub(crate) fn decode_transforms(message: &[u8]) -> Result<Vec<Transform>, Fault> {
    let mut cdr = CdrReader::new(message)?;
    let place = cdr.place();
    let count: u32 = cdr.read("the number of transforms")?;
    // A transform takes at least 72 bytes: more cannot follow than fit.
    let most = cdr.left() / 72;
    if count as usize > most {
        let expected = format!("at most {most} transforms in {} bytes", cdr.left());
        return Err(Fault::damaged(place, expected, count.to_string()));
    }
    (0..count).map(|_| Transform::read(&mut cdr)).collect()
}

pub(crate) fn encode_transforms(transforms: &[Transform]) -> Vec<u8> {
    encode(&transforms.iter().map(Transform::parts).collect::<Vec<_>>(), 256 * transforms.len())
}

/// Whether this is a stamp that ROS 2 can write: seconds from 0 to 2³¹ − 1.
pub(crate) fn can_be_written(stamp: Stamp) -> bool {
    (0..1i64 << 31).contains(&stamp.0.div_euclid(1_000_000))
}

/// Text of a message definition with all it uses, as MCAP's schema encoding `ros2msg` asks for.
pub(crate) fn definition(message: &str) -> &'static str {
    match message {
        POINT_CLOUD => include_str!("ros/PointCloud2.txt"),
        ODOMETRY => include_str!("ros/Odometry.txt"),
        _ => include_str!("ros/TFMessage.txt"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn header() -> Header {
        Header { stamp: Stamp(1_500_000_007), frame: "robot1/lidar".into() }
    }

    /// A cloud in a layout that our own writer does not use.
    fn foreign_cloud(
        big: bool,
        doubles: bool,
        rows: &[Vec<[f64; 3]>],
        lead: usize,
        row_gap: usize,
    ) -> Vec<u8> {
        let width = rows.first().map_or(0, Vec::len);
        let size = if doubles { 8 } else { 4 };
        let float = if doubles { 8 } else { 7 };
        let fields = [
            ("intensity", 0, 4u8, 1u32),
            ("z", lead as u32, float, 1),
            ("x", (lead + size) as u32, float, 1),
            ("y", (lead + 2 * size) as u32, float, 1),
        ];
        let step = lead + 3 * size + 3;
        let mut data = Vec::new();
        for row in rows {
            for p in row {
                data.extend(std::iter::repeat_n(0xee, lead));
                for v in [p[2], p[0], p[1]] {
                    match (doubles, big) {
                        (true, true) => data.extend(v.to_be_bytes()),
                        (true, false) => data.extend(v.to_le_bytes()),
                        (false, true) => data.extend((v as f32).to_be_bytes()),
                        (false, false) => data.extend((v as f32).to_le_bytes()),
                    }
                }
                data.extend([0xdd; 3]);
            }
            data.extend(std::iter::repeat_n(0xcc, row_gap));
        }
        let size = (rows.len() as u32, width as u32);
        let steps = (u8::from(big), step as u32, (step * width + row_gap) as u32);
        encode(&(header().parts(), size, fields.to_vec(), steps, Octets(&data), 0u8), 0)
    }

    proptest! {
        #[test]
        fn any_layout_gives_the_same_points(
            big in any::<bool>(), doubles in any::<bool>(), lead in 2..9usize, gap in 0..5usize,
            rows in (1..4usize, 1..5usize).prop_flat_map(|(h, w)|
                prop::collection::vec(prop::collection::vec([-100i32..100, -100i32..100, -100i32..100], w), h)),
        ) {
            let rows: Vec<Vec<[f64; 3]>> = rows.into_iter()
                .map(|row| row.into_iter().map(|p| p.map(|v| f64::from(v) / 4.0)).collect()).collect();
            let cloud = decode_points(&foreign_cloud(big, doubles, &rows, lead, gap), 1000, None).unwrap();
            let expected: Vec<[f32; 3]> = rows.concat().into_iter().map(|p| p.map(|v| v as f32)).collect();
            prop_assert_eq!(cloud, CloudPoints { points: expected, dropped: 0 });
        }

        #[test]
        fn damaged_messages_never_panic(
            cut in any::<prop::sample::Index>(), flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
        ) {
            let pose = Pose::from_yaw([1.0, 2.0, 3.0], 0.5);
            let transform = Transform { header: header(), child: "b".into(), pose };
            let messages = [
                encode_points(&header(), &[[1.0, 2.0, 3.0]; 5]),
                encode_odometry(&transform),
                encode_transforms(&[transform.clone(), transform]),
                foreign_cloud(true, true, &[vec![[1.0; 3]; 3], vec![[2.0; 3]; 3]], 4, 2),
            ];
            for mut message in messages {
                for (at, value) in &flips {
                    let at = at.index(message.len());
                    message[at] = *value;
                }
                message.truncate(cut.index(message.len() + 1));
                if let Ok(cloud) = decode_points(&message, 1000, None) {
                    prop_assert!(cloud.points.len() <= 1000);
                }
                let _ = decode_cloud_header(&message);
                let _ = decode_odometry(&message);
                let _ = decode_transforms(&message);
            }
        }
    }

    #[test]
    fn messages_are_read_as_they_were_written() {
        let points = [[1.0, 2.0, 3.0], [f32::NAN, 0.0, 0.0], [-4.5, 5.0, 6.0]];
        let message = encode_points(&header(), &points);
        let cloud = decode_points(&message, 3, None).unwrap();
        assert_eq!(cloud, CloudPoints { points: vec![points[0], points[2]], dropped: 1 });
        assert_eq!(decode_cloud_header(&message).unwrap(), (header(), 3));
        let pose = Pose::new([1.0, -2.0, 3.0], [0.1, 0.5, -0.7, 0.3]).unwrap();
        let transform = Transform { header: header(), child: "robot1/lidar".into(), pose };
        assert_eq!(decode_odometry(&encode_odometry(&transform)).unwrap(), transform);
        assert_eq!(
            decode_transforms(&encode_transforms(core::slice::from_ref(&transform))).unwrap(),
            [transform]
        );
    }

    #[test]
    fn coloured_points_are_points() {
        let message = encode_coloured_points(&header(), &[([1.0, 2.0, 3.0], [255, 120, 7])]);
        assert_eq!(decode_points(&message, 1, None).unwrap().points, [[1.0, 2.0, 3.0]]);
        assert!(message.windows(4).any(|w| w == 0x00ff_7807u32.to_le_bytes()));
    }

    #[test]
    fn too_many_points_are_refused_before_they_are_held() {
        let message = encode_points(&header(), &[[0.0; 3]; 4]);
        let fault = decode_points(&message, 3, None).unwrap_err();
        assert!(fault.problem.to_string().contains("is 4, the limit is 3"), "{}", fault.problem);
    }

    #[test]
    fn points_in_the_map_are_taken_back_to_the_sensor() {
        let pose = Pose::from_yaw([10.0, 0.0, 0.0], core::f64::consts::FRAC_PI_2);
        let message = encode_points(&header(), &[[10.0, 2.0, 0.0]]);
        let cloud = decode_points(&message, 10, Some(&pose.inverse())).unwrap();
        assert!((cloud.points[0][0] - 2.0).abs() < 1e-6 && cloud.points[0][1].abs() < 1e-6);
    }

    #[test]
    fn a_cloud_without_float_coordinates_is_told_by_its_fields() {
        let message = encode_points(&header(), &[[0.0; 3]]);
        let at = message.windows(2).position(|w| w == b"z\0").unwrap();
        let mut renamed = message;
        renamed[at] = b'w';
        let fault = decode_points(&renamed, 10, None).unwrap_err();
        assert!(fault.problem.to_string().contains("w (type 7)"), "{}", fault.problem);
    }
}
