//! Messages of ROS 2: as another program writes them, there and back, and damaged.

use byteorder::{BigEndian, LittleEndian};
use flockmap_grid::{Pose as GridPose, Stamp};
use flockmap_io::ros::{
    Bytes, Clock, CloudPoints, ColorRGBA, CompressedImage, DiagnosticArray, DiagnosticStatus, Duration,
    Header, KeyValue, MapMetaData, Marker, MarkerArray, MeshFile, OccupancyGrid, OccupancyGridUpdate,
    Octomap, Odometry, PointCloud2, PointField, Pose, PoseArray, PoseStamped, PoseWithCovariance, RosMessage,
    TFMessage, Time, TransformStamped, Twist, TwistWithCovariance, UVCoordinate, cloud_of_coloured_points,
    cloud_of_floats, cloud_of_points, decode, encode, points_of,
};
use proptest::prelude::*;
use serde::Serialize;
use serde::de::DeserializeOwned;

/// What is written of each message is what it was written from, here and with a decoder as DDS libraries use it.
fn there_and_back<T>(message: &T)
where
    T: RosMessage + Serialize + DeserializeOwned + PartialEq + std::fmt::Debug,
{
    let bytes = encode(message);
    assert_eq!(&decode::<T>(&bytes).unwrap(), message);
    let (read, length) = cdr_encoding::from_bytes::<T, LittleEndian>(&bytes[4..]).unwrap();
    assert_eq!((&read, length), (message, bytes.len() - 4));
    let big = cdr_encoding::to_vec::<T, BigEndian>(message).unwrap();
    let big = [&[0, 0, 0, 0], big.as_slice()].concat();
    assert_eq!(&decode::<T>(&big).unwrap(), message);
}

/// Damage may be found or not; nothing else happens, and no list is longer than the bytes allow.
fn read_damaged<T: RosMessage + DeserializeOwned + Serialize>(
    message: &T,
    cut: prop::sample::Index,
    flips: &[(prop::sample::Index, u8)],
) {
    let mut bytes = encode(message);
    for (at, value) in flips {
        let at = at.index(bytes.len());
        bytes[at] = *value;
    }
    bytes.truncate(cut.index(2 * bytes.len()));
    match decode::<T>(&bytes) {
        // Closing zeros, padding, and signs in place of what is no text may come on top of what was there.
        Ok(message) => assert!(encode(&message).len() <= 4 * bytes.len(), "{}", T::SCHEMA),
        Err(fault) => assert!(fault.to_string().contains("expected"), "{fault}"),
    }
    if let Ok(cloud) = decode::<PointCloud2<&[u8]>>(&bytes) {
        let points = points_of(&cloud, 1_000, None).map_or(0, |cloud| cloud.points.len());
        assert!(points <= 1_000);
    }
}

fn header() -> Header {
    Header { stamp: Time { sec: 12, nanosec: 345_678_000 }, frame_id: "map".into() }
}

fn pose() -> Pose {
    Pose { position: [1.0, -2.0, 3.5], orientation: [0.5, -0.5, 0.5, 0.5] }
}

fn transform() -> TransformStamped {
    TransformStamped { header: header(), child_frame_id: "base".into(), transform: pose() }
}

fn marker() -> Marker {
    Marker {
        header: header(),
        ns: "robots".into(),
        id: -4,
        r#type: Marker::SPHERE,
        action: Marker::ADD,
        pose: pose(),
        scale: [0.5, 0.25, 2.0],
        color: ColorRGBA { r: 1.0, g: 0.5, b: 0.25, a: 0.75 },
        lifetime: Duration { sec: 3, nanosec: 500 },
        frame_locked: true,
        points: vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
        colors: vec![ColorRGBA { r: 0.0, g: 1.0, b: 0.0, a: 1.0 }],
        texture_resource: "embedded://t".into(),
        texture: CompressedImage { header: header(), format: "png".into(), data: Bytes(vec![1, 2, 255]) },
        uv_coordinates: vec![UVCoordinate { u: 0.5, v: 0.25 }],
        text: "robot 2".into(),
        mesh_resource: "embedded://m".into(),
        mesh_file: MeshFile { filename: "m.stl".into(), data: Bytes(vec![1, 2, 255]) },
        mesh_use_embedded_materials: true,
    }
}

/// Calls a check with one message of each type, the same that `rosbags` wrote.
macro_rules! with_each {
    ($check:expr) => {
        $check(header());
        $check(Clock { clock: header().stamp });
        $check(PoseStamped { header: header(), pose: pose() });
        $check(PoseArray { header: header(), poses: vec![pose(), pose()] });
        $check(transform());
        $check(TFMessage { transforms: vec![transform(), transform()] });
        let covariance = std::array::from_fn(|row| std::array::from_fn(|column| (6 * row + column) as f64));
        $check(Odometry {
            header: header(),
            child_frame_id: "base".into(),
            pose: PoseWithCovariance { pose: pose(), covariance },
            twist: TwistWithCovariance {
                twist: Twist { linear: [0.5, 1.5, 2.5], angular: [3.5, 4.5, 5.5] },
                covariance,
            },
        });
        let map_load_time = Time { sec: 7, nanosec: 0 };
        $check(OccupancyGrid {
            header: header(),
            info: MapMetaData { map_load_time, resolution: 0.25, width: 3, height: 1, origin: pose() },
            data: vec![-1, 0, 100],
        });
        $check(OccupancyGridUpdate {
            header: header(),
            x: -3,
            y: 4,
            width: 3,
            height: 1,
            data: vec![-1, 0, 100],
        });
        $check(Octomap {
            header: header(),
            binary: true,
            id: "OcTree".into(),
            resolution: 0.125,
            data: vec![-1, 0, 100],
        });
        $check(cloud_of_points(header(), &[[1.0, 2.0, 3.0], [-4.0, 5.0, 6.0]]));
        $check(marker());
        $check(MarkerArray { markers: vec![marker()] });
        let values = vec![KeyValue { key: "scans".into(), value: "5".into() }, KeyValue::default()];
        $check(DiagnosticArray {
            header: header(),
            status: vec![DiagnosticStatus {
                level: DiagnosticStatus::WARN,
                name: "flockmap".into(),
                message: "slow".into(),
                hardware_id: "robot1".into(),
                values,
            }],
        });
    };
}

/// Lines of a type and its bytes, written by `serialize_cdr` of the Python package rosbags 0.11.9 with its
/// definitions of ROS 2 Jazzy.
const GOLDEN: &str = include_str!("golden/rosbags_jazzy.txt");

fn golden() -> impl Iterator<Item = (&'static str, Vec<u8>)> {
    GOLDEN.lines().map(|line| {
        let (schema, hex) = line.split_once(' ').unwrap();
        let byte = |at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap();
        (schema, (0..hex.len()).step_by(2).map(byte).collect())
    })
}

#[test]
fn messages_are_read_and_written_as_another_program_does() {
    fn check<T>(message: T)
    where
        T: RosMessage + Serialize + DeserializeOwned + PartialEq + std::fmt::Debug,
    {
        assert_eq!(T::SCHEMA, format!("{}/msg/{}", T::PACKAGE, T::NAME));
        let mut written: Vec<Vec<u8>> =
            golden().filter(|(schema, _)| *schema == T::SCHEMA).map(|(_, bytes)| bytes).collect();
        assert!(!written.is_empty(), "no {}", T::SCHEMA);
        for bytes in &written {
            assert_eq!(decode::<T>(bytes).unwrap(), message);
        }
        written.truncate(1);
        assert_eq!([encode(&message)], *written, "{}", T::SCHEMA);
    }
    with_each!(check);
}

/// The messages of all kinds, each with its own strategy.
fn any_header() -> impl Strategy<Value = Header> {
    (any::<(i32, u32)>(), any_frame())
        .prop_map(|((sec, nanosec), frame_id)| Header { stamp: Time { sec, nanosec }, frame_id })
}

fn any_frame() -> impl Strategy<Value = String> {
    "([a-zä_0-9][a-z/_0-9]{0,20})?"
}

fn any_text() -> impl Strategy<Value = String> {
    ".{0,20}"
}

/// Numbers that equal themselves.
fn number() -> impl Strategy<Value = f64> {
    any::<f32>().prop_map(f64::from)
}

fn any_pose() -> impl Strategy<Value = Pose> {
    (prop::array::uniform3(number()), prop::array::uniform4(number()))
        .prop_map(|(position, orientation)| Pose { position, orientation })
}

fn any_transform() -> impl Strategy<Value = TransformStamped> {
    (any_header(), any_frame(), any_pose()).prop_map(|(header, child_frame_id, transform)| TransformStamped {
        header,
        child_frame_id,
        transform,
    })
}

fn any_matrix() -> impl Strategy<Value = [[f64; 6]; 6]> {
    number()
        .prop_map(|first| std::array::from_fn(|row| std::array::from_fn(|at| first * (row * 6 + at) as f64)))
}

fn any_bytes() -> impl Strategy<Value = Bytes> {
    prop::collection::vec(any::<u8>(), 0..30).prop_map(Bytes)
}

fn any_cells() -> impl Strategy<Value = Vec<i8>> {
    prop::collection::vec(any::<i8>(), 0..30)
}

fn any_colour() -> impl Strategy<Value = ColorRGBA> {
    any::<(f32, f32, f32, f32)>().prop_map(|(r, g, b, a)| ColorRGBA { r, g, b, a })
}

fn any_cloud() -> impl Strategy<Value = PointCloud2<Bytes>> {
    let field = (any_text(), any::<(u32, u8, u32)>())
        .prop_map(|(name, (offset, datatype, count))| PointField { name, offset, datatype, count });
    let fields = prop::collection::vec(field, 0..4);
    (any_header(), any::<(u32, u32, u32, u32)>(), fields, any::<(bool, bool)>(), any_bytes()).prop_map(
        |(header, (height, width, point_step, row_step), fields, (is_bigendian, is_dense), data)| {
            PointCloud2 { header, height, width, fields, is_bigendian, point_step, row_step, data, is_dense }
        },
    )
}

fn any_marker() -> impl Strategy<Value = Marker> {
    let lists = (
        prop::collection::vec(prop::array::uniform3(number()), 0..4),
        prop::collection::vec(any_colour(), 0..4),
        prop::collection::vec(any::<(f32, f32)>().prop_map(|(u, v)| UVCoordinate { u, v }), 0..4),
    );
    let texts = prop::array::uniform5(any_text());
    let numbers = any::<(i32, i32, i32, i32, u32, bool, bool)>();
    let files = (any_header(), any_bytes(), any_bytes());
    (any_header(), texts, numbers, any_pose(), any_colour(), lists, files).prop_map(
        |(
            header,
            texts,
            numbers,
            pose,
            color,
            (points, colors, uv_coordinates),
            (of_texture, image, mesh),
        )| {
            let [ns, texture_resource, text, mesh_resource, format] = texts;
            let (id, r#type, action, sec, nanosec, frame_locked, mesh_use_embedded_materials) = numbers;
            Marker {
                header,
                ns,
                id,
                r#type,
                action,
                pose,
                scale: pose.position,
                color,
                lifetime: Duration { sec, nanosec },
                frame_locked,
                points,
                colors,
                texture_resource,
                texture: CompressedImage { header: of_texture, format: format.clone(), data: image },
                uv_coordinates,
                text,
                mesh_resource,
                mesh_file: MeshFile { filename: format, data: mesh },
                mesh_use_embedded_materials,
            }
        },
    )
}

fn any_diagnostics() -> impl Strategy<Value = DiagnosticArray> {
    let value = (any_text(), any_text()).prop_map(|(key, value)| KeyValue { key, value });
    let status = (any::<u8>(), prop::array::uniform3(any_text()), prop::collection::vec(value, 0..3))
        .prop_map(|(level, [name, message, hardware_id], values)| DiagnosticStatus {
            level,
            name,
            message,
            hardware_id,
            values,
        });
    (any_header(), prop::collection::vec(status, 0..3))
        .prop_map(|(header, status)| DiagnosticArray { header, status })
}

proptest! {
    #[test]
    fn every_message_comes_back(
        header in any_header(), child in any_frame(), pose in any_pose(), of_pose in any_matrix(), of_twist in any_matrix(),
        transforms in prop::collection::vec(any_transform(), 0..4), cloud in any_cloud(),
        cells in any_cells(), (x, y, width, height) in any::<(i32, i32, u32, u32)>(), resolution in any::<f32>(),
        (binary, id) in (any::<bool>(), any_text()), markers in prop::collection::vec(any_marker(), 0..3),
        diagnostics in any_diagnostics(),
    ) {
        there_and_back(&header);
        there_and_back(&Clock { clock: header.stamp });
        there_and_back(&PoseStamped { header: header.clone(), pose });
        let poses = transforms.iter().map(|transform| transform.transform).collect();
        there_and_back(&PoseArray { header: header.clone(), poses });
        transforms.iter().for_each(there_and_back);
        there_and_back(&TFMessage { transforms });
        there_and_back(&Odometry {
            header: header.clone(),
            child_frame_id: child,
            pose: PoseWithCovariance { pose, covariance: of_pose },
            twist: TwistWithCovariance {
                twist: Twist { linear: pose.position, angular: [1.0, f64::MIN, pose.position[1]] },
                covariance: of_twist,
            },
        });
        let info = MapMetaData { map_load_time: header.stamp, resolution, width, height, origin: pose };
        there_and_back(&OccupancyGrid { header: header.clone(), info, data: cells.clone() });
        there_and_back(&OccupancyGridUpdate { header: header.clone(), x, y, width, height, data: cells.clone() });
        there_and_back(&Octomap { header, binary, id, resolution: f64::from(resolution), data: cells });
        let bytes = encode(&cloud);
        let borrowed: PointCloud2<&[u8]> = decode(&bytes).unwrap();
        prop_assert_eq!(borrowed.data, cloud.data.as_ref());
        prop_assert_eq!(encode(&borrowed), bytes);
        there_and_back(&cloud);
        markers.iter().for_each(there_and_back);
        there_and_back(&MarkerArray { markers });
        there_and_back(&diagnostics);
    }

    #[test]
    fn damaged_messages_are_errors_or_other_messages(
        cut in any::<prop::sample::Index>(),
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
    ) {
        with_each!(|message| read_damaged(&message, cut, &flips));
    }

    #[test]
    fn stamps_come_back_to_the_microsecond(micros in -(1i64 << 50)..1i64 << 50, extreme in any::<i64>()) {
        prop_assert_eq!(Stamp::from(Time::from(Stamp(micros))), Stamp(micros));
        let time = Time::from(Stamp(extreme));
        prop_assert!(time.nanosec < 1_000_000_000);
        let held = extreme.clamp(i64::from(i32::MIN) * 1_000_000, i64::from(i32::MAX) * 1_000_000 + 999_999);
        prop_assert_eq!(Stamp::from(time), Stamp(held));
    }

    #[test]
    fn clouds_that_are_built_have_their_points(
        points in prop::collection::vec(prop::array::uniform3(-1e6f32..1e6), 0..20), other in any::<f32>(),
    ) {
        let read = |cloud: &PointCloud2<Bytes>| points_of(cloud, 20, None).unwrap();
        let expected = CloudPoints { points: points.clone(), dropped: 0 };
        prop_assert_eq!(&read(&cloud_of_points(header(), &points)), &expected);
        let coloured: Vec<_> = points.iter().map(|point| (*point, [255, 120, 7])).collect();
        let coloured = cloud_of_coloured_points(header(), &coloured);
        prop_assert_eq!(&read(&coloured), &expected);
        let values: Vec<f32> = points.iter().flat_map(|[x, y, z]| [*z, other, *x, *y]).collect();
        let general = cloud_of_floats(header(), &["z", "distance", "x", "y"], &values);
        prop_assert_eq!(general.count(), points.len() as u64);
        prop_assert_eq!(general.row_step as usize, general.data.0.len());
        prop_assert_eq!(read(&general), expected);
        if !points.is_empty() {
            prop_assert_eq!(&coloured.data.0[12..16], &[7, 120, 255, 0]);
        }
    }

    #[test]
    fn any_layout_gives_the_same_points(
        big in any::<bool>(), doubles in any::<bool>(), lead in 2..9usize, gap in 0..5usize,
        rows in (1..4usize, 1..5usize).prop_flat_map(|(h, w)|
            prop::collection::vec(prop::collection::vec([-100i32..100, -100i32..100, -100i32..100], w), h)),
    ) {
        let rows: Vec<Vec<[f64; 3]>> = rows.into_iter()
            .map(|row| row.into_iter().map(|p| p.map(|v| f64::from(v) / 4.0)).collect()).collect();
        let cloud = foreign_cloud(big, doubles, &rows, lead, gap);
        let cloud = points_of(&cloud, 1000, None).unwrap();
        let expected: Vec<[f32; 3]> = rows.concat().into_iter().map(|p| p.map(|v| v as f32)).collect();
        prop_assert_eq!(cloud, CloudPoints { points: expected, dropped: 0 });
    }
}

/// A cloud in a layout that our own writer does not use.
fn foreign_cloud(
    big: bool,
    doubles: bool,
    rows: &[Vec<[f64; 3]>],
    lead: usize,
    gap: usize,
) -> PointCloud2<Bytes> {
    let width = rows.first().map_or(0, Vec::len);
    let (size, float) = if doubles { (8, PointField::FLOAT64) } else { (4, PointField::FLOAT32) };
    let field = |name: &str, offset: usize, datatype: u8| PointField {
        name: name.into(),
        offset: offset as u32,
        datatype,
        count: 1,
    };
    let point_step = lead + 3 * size + 3;
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
        data.extend(std::iter::repeat_n(0xcc, gap));
    }
    PointCloud2 {
        header: header(),
        height: rows.len() as u32,
        width: width as u32,
        fields: vec![
            field("intensity", 0, 4),
            field("z", lead, float),
            field("x", lead + size, float),
            field("y", lead + 2 * size, float),
        ],
        is_bigendian: big,
        point_step: point_step as u32,
        row_step: (point_step * width + gap) as u32,
        data: Bytes(data),
        is_dense: false,
    }
}

#[test]
fn points_that_are_no_numbers_are_counted_and_those_in_the_map_are_taken_back() {
    let cloud = cloud_of_points(header(), &[[1.0, 2.0, 3.0], [f32::NAN, 0.0, 0.0], [-4.5, 5.0, 6.0]]);
    let points = vec![[1.0, 2.0, 3.0], [-4.5, 5.0, 6.0]];
    assert_eq!(points_of(&cloud, 3, None).unwrap(), CloudPoints { points, dropped: 1 });
    let pose = GridPose::from_yaw([10.0, 0.0, 0.0], core::f64::consts::FRAC_PI_2);
    let cloud = cloud_of_points(header(), &[[10.0, 2.0, 0.0]]);
    let cloud = points_of(&cloud, 10, Some(&pose.inverse())).unwrap();
    assert!((cloud.points[0][0] - 2.0).abs() < 1e-6 && cloud.points[0][1].abs() < 1e-6);
}

#[test]
fn clouds_that_cannot_be_read_say_why() {
    let cloud = cloud_of_points(header(), &[[0.0; 3]; 4]);
    let refused = |cloud: &PointCloud2<Bytes>| points_of(cloud, 3, None).unwrap_err().to_string();
    assert_eq!(refused(&cloud), "the number of points in a scan is 4, the limit is 3");
    let mut renamed = cloud_of_points(header(), &[[0.0; 3]]);
    renamed.fields[2].name = "w".into();
    assert!(refused(&renamed).contains("x (type 7), y (type 7), w (type 7)"), "{}", refused(&renamed));
    let mut beyond = cloud_of_points(header(), &[[0.0; 3]]);
    beyond.fields[2].offset = u32::MAX;
    assert!(refused(&beyond).contains("a field that ends at byte 4294967299"), "{}", refused(&beyond));
    let mut short = cloud_of_points(header(), &[[0.0; 3]; 3]);
    short.data.0.pop();
    assert!(refused(&short).contains("expected 36 bytes for 1 rows of 3 points"), "{}", refused(&short));
}

#[test]
fn a_pose_that_is_none_is_told() {
    assert_eq!(Pose::default().checked(), Some(GridPose::IDENTITY));
    assert_eq!(Pose { orientation: [0.0; 4], ..Pose::default() }.checked(), None);
    let pose = GridPose::new([1.0, -2.0, 3.0], [0.1, 0.5, -0.7, 0.3]).unwrap();
    assert_eq!(Pose::from(pose).checked(), Some(pose));
}
