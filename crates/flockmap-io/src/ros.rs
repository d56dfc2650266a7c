//! The ROS 2 messages that make a record: `sensor_msgs/msg/PointCloud2`, `nav_msgs/msg/Odometry`,
//! `tf2_msgs/msg/TFMessage`.

use flockmap_grid::{Pose, Stamp};

use crate::cdr::{CdrReader, CdrWriter};
use crate::error::{Fault, Place};

pub(crate) const POINT_CLOUD: &str = "sensor_msgs/msg/PointCloud2";
pub(crate) const ODOMETRY: &str = "nav_msgs/msg/Odometry";
pub(crate) const TRANSFORMS: &str = "tf2_msgs/msg/TFMessage";

/// `std_msgs/msg/Header`.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Header {
    pub(crate) stamp: Stamp,
    pub(crate) frame: String,
}

impl Header {
    fn read(cdr: &mut CdrReader<'_>) -> Result<Self, Fault> {
        let seconds = i64::from(cdr.i32("the stamp")?);
        let nanoseconds = i64::from(cdr.u32("the stamp")?);
        let stamp = Stamp(seconds * 1_000_000 + nanoseconds / 1_000);
        Ok(Self { stamp, frame: frame_name(cdr)? })
    }

    fn write(&self, cdr: &mut CdrWriter) {
        cdr.i32(self.stamp.0.div_euclid(1_000_000) as i32);
        cdr.u32(self.stamp.0.rem_euclid(1_000_000) as u32 * 1_000);
        cdr.string(&self.frame);
    }
}

/// Frames are the same with and without the slash in front that ROS 1 used to put there.
fn frame_name(cdr: &mut CdrReader<'_>) -> Result<String, Fault> {
    let name = cdr.string("the frame")?;
    Ok(name.strip_prefix('/').map(str::to_owned).unwrap_or(name))
}

/// A point cloud message without its points: cheap to read.
pub(crate) struct CloudHeader {
    pub(crate) header: Header,
    pub(crate) points: u64,
}

impl CloudHeader {
    pub(crate) fn decode(message: &[u8]) -> Result<Self, Fault> {
        let mut cdr = CdrReader::new(message)?;
        let header = Header::read(&mut cdr)?;
        let height = cdr.u32("the height")?;
        let width = cdr.u32("the width")?;
        Ok(Self { header, points: u64::from(height) * u64::from(width) })
    }
}

/// The points of a point cloud message.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct CloudPoints {
    pub(crate) points: Vec<[f32; 3]>,
    /// Points left out because a coordinate was not a finite number.
    pub(crate) dropped: u64,
}

#[derive(Clone, Copy)]
enum Number {
    F32,
    F64,
}

/// Reads the points of a cloud of at most `points_max` points, whatever the layout of its fields, and takes them through
/// `transform` where one is given.
pub(crate) fn decode_points(
    message: &[u8],
    points_max: u64,
    transform: Option<&Pose>,
) -> Result<CloudPoints, Fault> {
    let mut cdr = CdrReader::new(message)?;
    Header::read(&mut cdr)?;
    let height = cdr.u32("the height")?;
    let width = cdr.u32("the width")?;
    let count = u64::from(height) * u64::from(width);
    if count > points_max {
        return Err(Fault::too_large(cdr.place(), "the number of points in a scan", count, points_max));
    }
    let mut axes: [Option<(u32, Number)>; 3] = [None; 3];
    let place = cdr.place();
    let mut names = Vec::new();
    for _ in 0..cdr.sequence(13, "fields")? {
        let name = cdr.string("the name of a field")?;
        let offset = cdr.u32("the offset of a field")?;
        let datatype = cdr.u8("the type of a field")?;
        cdr.u32("the count of a field")?;
        let number = match datatype {
            7 => Some(Number::F32),
            8 => Some(Number::F64),
            _ => None,
        };
        if let (Some(axis), Some(number)) = (["x", "y", "z"].iter().position(|a| *a == name), number)
            && let Some(slot) = axes.get_mut(axis)
        {
            *slot = Some((offset, number));
        }
        if names.len() < 16 {
            names.push(format!("{name} (type {datatype})"));
        }
    }
    let [Some(x), Some(y), Some(z)] = axes else {
        let expected = "fields x, y, z of type 7 (FLOAT32) or 8 (FLOAT64)";
        return Err(Fault::foreign(place, expected, names.join(", ")));
    };
    let big_endian = cdr.u8("the byte order")? != 0;
    let place = cdr.place();
    let point_step = cdr.u32("the bytes of a point")?;
    let row_step = cdr.u32("the bytes of a row")?;
    let data = cdr.bytes("point data")?;
    for (offset, number) in [x, y, z] {
        let end = u64::from(offset) + if matches!(number, Number::F32) { 4 } else { 8 };
        if end > u64::from(point_step) {
            return Err(Fault::damaged(
                place,
                format!("fields within the {point_step} bytes of a point"),
                format!("a field that ends at byte {end}"),
            ));
        }
    }
    let row_bytes = u64::from(width) * u64::from(point_step);
    let row_step = if height <= 1 { row_bytes } else { u64::from(row_step) };
    let needed =
        if count == 0 { 0 } else { row_step.saturating_mul(u64::from(height) - 1).saturating_add(row_bytes) };
    if row_step < row_bytes || needed > data.len() as u64 {
        return Err(Fault::damaged(
            place,
            format!("{needed} bytes of data for {height} rows of {width} points of {point_step} bytes"),
            format!("{} bytes in rows of {row_step}", data.len()),
        ));
    }
    let mut cloud = CloudPoints { points: Vec::with_capacity(count as usize), dropped: 0 };
    if count == 0 {
        return Ok(cloud);
    }
    for row in data.chunks(row_step as usize).take(height as usize) {
        for point in row.chunks_exact(point_step as usize).take(width as usize) {
            let mut p = [x, y, z].map(|field| coordinate(point, field, big_endian));
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

/// The number at a field; not a number if the field lies outside of the point.
fn coordinate(point: &[u8], (offset, number): (u32, Number), big_endian: bool) -> f64 {
    let bytes = point.get(offset as usize..).unwrap_or_default();
    match number {
        Number::F32 => bytes.first_chunk().map_or(f64::NAN, |&b| {
            f64::from(if big_endian { f32::from_be_bytes(b) } else { f32::from_le_bytes(b) })
        }),
        Number::F64 => bytes
            .first_chunk()
            .map_or(f64::NAN, |&b| if big_endian { f64::from_be_bytes(b) } else { f64::from_le_bytes(b) }),
    }
}

/// A point cloud of x, y, z as `f32`, unorganised.
pub(crate) fn encode_points(header: &Header, points: &[[f32; 3]]) -> Vec<u8> {
    let data = points.iter().map(|p| {
        let mut bytes = [0; 12];
        put_point(&mut bytes, p);
        bytes
    });
    encode_cloud(header, &["x", "y", "z"], data)
}

/// The same with a colour at each point, as viewers of ROS know it: `rgb`, the bytes blue, green, red, 0 in the place of an `f32`.
pub(crate) fn encode_coloured_points(header: &Header, points: &[([f32; 3], [u8; 3])]) -> Vec<u8> {
    let data = points.iter().map(|(p, [red, green, blue])| {
        let mut bytes = [0; 16];
        put_point(&mut bytes, p);
        bytes[12..].copy_from_slice(&[*blue, *green, *red, 0]);
        bytes
    });
    encode_cloud(header, &["x", "y", "z", "rgb"], data)
}

fn put_point(bytes: &mut [u8], point: &[f32; 3]) {
    for (place, v) in bytes.chunks_exact_mut(4).zip(point) {
        place.copy_from_slice(&v.to_le_bytes());
    }
}

/// Points of `N` bytes with fields of four bytes each.
fn encode_cloud<const N: usize>(
    header: &Header,
    fields: &[&str],
    points: impl ExactSizeIterator<Item = [u8; N]>,
) -> Vec<u8> {
    let mut cdr = CdrWriter::new();
    header.write(&mut cdr);
    let count = points.len();
    cdr.u32(1);
    cdr.u32(count as u32);
    cdr.u32(fields.len() as u32);
    for (name, offset) in fields.iter().zip((0..).step_by(4)) {
        cdr.string(name);
        cdr.u32(offset);
        cdr.u8(7);
        cdr.u32(1);
    }
    cdr.u8(0);
    cdr.u32(N as u32);
    cdr.u32((N * count) as u32);
    let data: Vec<[u8; N]> = points.collect();
    cdr.bytes(N * count, data.iter().map(<[u8; N]>::as_slice));
    cdr.u8(1);
    cdr.finish()
}

/// A pose of one frame in another.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Transform {
    pub(crate) header: Header,
    pub(crate) child: String,
    pub(crate) pose: Pose,
}

fn read_pose(cdr: &mut CdrReader<'_>) -> Result<Pose, Fault> {
    let place = cdr.place();
    let mut numbers = [0.0; 7];
    for number in &mut numbers {
        *number = cdr.f64("a pose")?;
    }
    let [x, y, z, qx, qy, qz, qw] = numbers;
    Pose::new([x, y, z], [qx, qy, qz, qw]).ok_or_else(|| {
        Fault::damaged(place, "a finite position and a quaternion that is not zero", format!("{numbers:?}"))
    })
}

fn write_pose(cdr: &mut CdrWriter, pose: &Pose) {
    for v in pose.translation().into_iter().chain(pose.quaternion_xyzw()) {
        cdr.f64(v);
    }
}

pub(crate) fn decode_odometry(message: &[u8]) -> Result<Transform, Fault> {
    let mut cdr = CdrReader::new(message)?;
    let header = Header::read(&mut cdr)?;
    let child = frame_name(&mut cdr)?;
    Ok(Transform { header, child, pose: read_pose(&mut cdr)? })
}

/// An odometry message with no covariance and no velocity.
pub(crate) fn encode_odometry(transform: &Transform) -> Vec<u8> {
    let mut cdr = CdrWriter::new();
    transform.header.write(&mut cdr);
    cdr.string(&transform.child);
    write_pose(&mut cdr, &transform.pose);
    for _ in 0..36 + 6 + 36 {
        cdr.f64(0.0);
    }
    cdr.finish()
}

pub(crate) fn decode_transforms(message: &[u8]) -> Result<Vec<Transform>, Fault> {
    let mut cdr = CdrReader::new(message)?;
    let count = cdr.sequence(72, "transforms")?;
    let mut transforms = Vec::with_capacity(count as usize);
    for _ in 0..count {
        let header = Header::read(&mut cdr)?;
        let child = frame_name(&mut cdr)?;
        transforms.push(Transform { header, child, pose: read_pose(&mut cdr)? });
    }
    Ok(transforms)
}

pub(crate) fn encode_transforms(transforms: &[Transform]) -> Vec<u8> {
    let mut cdr = CdrWriter::new();
    cdr.u32(transforms.len() as u32);
    for transform in transforms {
        transform.header.write(&mut cdr);
        cdr.string(&transform.child);
        write_pose(&mut cdr, &transform.pose);
    }
    cdr.finish()
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

/// What to say of a message in a place that is not known better.
pub(crate) fn wrong_encoding(topic: &str, schema: &str, encoding: &str) -> Fault {
    Fault::foreign(
        Place::Whole,
        format!("messages of {topic} ({schema}) in the encoding \"cdr\" of ROS 2"),
        format!("the encoding \"{encoding}\""),
    )
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
        let mut cdr = CdrWriter::new();
        header().write(&mut cdr);
        let width = rows.first().map_or(0, Vec::len);
        cdr.u32(rows.len() as u32);
        cdr.u32(width as u32);
        let size = if doubles { 8 } else { 4 };
        cdr.u32(4);
        for (name, offset, datatype) in [
            ("intensity", 0, 4u8),
            ("z", lead, if doubles { 8 } else { 7 }),
            ("x", lead + size, if doubles { 8 } else { 7 }),
            ("y", lead + 2 * size, if doubles { 8 } else { 7 }),
        ] {
            cdr.string(name);
            cdr.u32(offset as u32);
            cdr.u8(datatype);
            cdr.u32(1);
        }
        cdr.u8(u8::from(big));
        let step = lead + 3 * size + 3;
        cdr.u32(step as u32);
        cdr.u32((step * width + row_gap) as u32);
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
        cdr.bytes(data.len(), std::iter::once(data.as_slice()));
        cdr.u8(0);
        cdr.finish()
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
                let _ = CloudHeader::decode(&message);
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
        let head = CloudHeader::decode(&message).unwrap();
        assert_eq!((head.header, head.points), (header(), 3));
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
