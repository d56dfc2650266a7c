//! Messages of Foxglove, which Rerun reads too: <https://docs.foxglove.dev/docs/sdk/schemas>.

use flockmap_grid::{Pose, Stamp};

use crate::protobuf::{Kind, Message, ProtoFile, Schema};
use crate::record_view::ColouredPoint;

pub(crate) const POINT_CLOUD: &str = "foxglove.PointCloud";

/// What a schema of [`POINT_CLOUD`] consists of: fields and numbers of Foxglove's `.proto` files, in one file.
pub(crate) fn point_cloud_schema() -> Vec<u8> {
    let [x, y, z, w] = ["x", "y", "z", "w"];
    let doubles = [(x, 1, Kind::Double), (y, 2, Kind::Double), (z, 3, Kind::Double), (w, 4, Kind::Double)];
    let times = "google/protobuf/timestamp.proto";
    let time = ProtoFile::new(times, "google.protobuf", &[])
        .message("Timestamp", &[("seconds", 1, Kind::Int64), ("nanos", 2, Kind::Int32)]);
    let names = ["UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"];
    let cloud = ProtoFile::new("foxglove/PointCloud.proto", "foxglove", &[times])
        .message_with_enum(
            "PackedElementField",
            &[
                ("name", 1, Kind::Text),
                ("offset", 2, Kind::Fixed32),
                ("type", 3, Kind::Enum(".foxglove.PackedElementField.NumericType")),
            ],
            "NumericType",
            &names,
        )
        .message("Vector3", &doubles[..3])
        .message("Quaternion", &doubles)
        .message(
            "Pose",
            &[
                ("position", 1, Kind::Message(".foxglove.Vector3")),
                ("orientation", 2, Kind::Message(".foxglove.Quaternion")),
            ],
        )
        .message(
            "PointCloud",
            &[
                ("timestamp", 1, Kind::Message(".google.protobuf.Timestamp")),
                ("frame_id", 2, Kind::Text),
                ("pose", 3, Kind::Message(".foxglove.Pose")),
                ("point_stride", 4, Kind::Fixed32),
                ("fields", 5, Kind::Messages(".foxglove.PackedElementField")),
                ("data", 6, Kind::Bytes),
            ],
        );
    Schema::default().file(time).file(cloud).into_bytes()
}

const UINT8: u64 = 1;
const FLOAT32: u64 = 7;
/// Three coordinates and a colour.
const POINT_BYTES: u32 = 16;

/// `foxglove.PointCloud`: points with a colour each, and where they are in the frame.
pub(crate) fn point_cloud(stamp: Stamp, frame: &str, at: &Pose, points: &[ColouredPoint]) -> Vec<u8> {
    let mut data = Vec::with_capacity(points.len() * POINT_BYTES as usize);
    for (point, [red, green, blue]) in points {
        point.iter().for_each(|at| data.extend_from_slice(&at.to_le_bytes()));
        data.extend_from_slice(&[*red, *green, *blue, u8::MAX]);
    }
    let mut message = Message::default();
    message.message(1, |time| {
        time.integer(1, stamp.0.div_euclid(1_000_000) as u64);
        time.integer(2, stamp.0.rem_euclid(1_000_000) as u64 * 1_000);
    });
    message.text(2, frame);
    message.message(3, |pose| {
        let doubles = |message: &mut Message, values: &[f64]| {
            (1..).zip(values).for_each(|(number, value)| message.double(number, *value));
        };
        pose.message(1, |position| doubles(position, &at.translation()));
        pose.message(2, |quaternion| doubles(quaternion, &at.quaternion_xyzw()));
    });
    message.fixed32(4, POINT_BYTES);
    for (name, offset, number) in [
        ("x", 0, FLOAT32),
        ("y", 4, FLOAT32),
        ("z", 8, FLOAT32),
        ("red", 12, UINT8),
        ("green", 13, UINT8),
        ("blue", 14, UINT8),
        ("alpha", 15, UINT8),
    ] {
        message.message(5, |field| {
            field.text(1, name);
            field.fixed32(2, offset);
            field.integer(3, number);
        });
    }
    message.bytes(6, &data);
    message.into_bytes()
}
