//! The points of point cloud messages.

use flockmap_grid::Pose;

use super::cloud::{PointCloud2, PointField};
use super::parts::Bytes;
use super::time::Header;
use crate::error::{Fault, Place};
use crate::number::Number;

/// The points of a point cloud message.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CloudPoints {
    /// x, y, z in metres, row by row.
    pub points: Vec<[f32; 3]>,
    /// Points left out because a coordinate was not a finite number.
    pub dropped: u64,
}

/// Reads the points of a cloud of at most `points_max` points, whatever the layout of its fields, and takes
/// them through `transform` where one is given. The data is not copied.
///
/// # Errors
/// A cloud of more points; one without fields `x`, `y`, `z` of type FLOAT32 or FLOAT64; one whose data is
/// shorter than its sizes say. The place is [`Place::Whole`].
pub fn points_of<D: AsRef<[u8]>>(
    cloud: &PointCloud2<D>,
    points_max: u64,
    transform: Option<&Pose>,
) -> Result<CloudPoints, Fault> {
    let (height, width, point_step) = (cloud.height, cloud.width, cloud.point_step);
    let count = cloud.count();
    if count > points_max {
        return Err(Fault::too_large(Place::Whole, "the number of points in a scan", count, points_max));
    }
    let [x, y, z] = axes(&cloud.fields)?;
    for (offset, number) in [x, y, z] {
        let end = u64::from(offset) + number.size();
        if end > u64::from(point_step) {
            let expected = format!("fields within the {point_step} bytes of a point");
            return Err(Fault::damaged(Place::Whole, expected, format!("a field that ends at byte {end}")));
        }
    }
    let (data, big_endian) = (cloud.data.as_ref(), cloud.is_bigendian);
    let row_bytes = u64::from(width) * u64::from(point_step);
    let row_step = if height <= 1 { row_bytes } else { u64::from(cloud.row_step) };
    if count == 0 {
        return Ok(CloudPoints::default());
    }
    let needed = row_step.saturating_mul(u64::from(height) - 1).saturating_add(row_bytes);
    if row_step < row_bytes || needed > data.len() as u64 {
        let expected = format!("{needed} bytes for {height} rows of {width} points of {point_step} bytes");
        let found = format!("{} bytes in rows of {row_step}", data.len());
        return Err(Fault::damaged(Place::Whole, expected, found));
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

/// Offset and type of x, y, z.
fn axes(fields: &[PointField]) -> Result<[(u32, Number); 3], Fault> {
    let find = |axis: &str| {
        // Of several of one name the last counts.
        let found = fields.iter().rev().filter(|field| field.name == axis);
        found
            .filter_map(|field| match field.datatype {
                PointField::FLOAT32 => Some((field.offset, Number::F32)),
                PointField::FLOAT64 => Some((field.offset, Number::F64)),
                _ => None,
            })
            .next()
    };
    let [Some(x), Some(y), Some(z)] = ["x", "y", "z"].map(find) else {
        let expected = "fields x, y, z of type 7 (FLOAT32) or 8 (FLOAT64)";
        let names = fields.iter().take(16).map(|field| format!("{} (type {})", field.name, field.datatype));
        return Err(Fault::foreign(Place::Whole, expected, names.collect::<Vec<_>>().join(", ")));
    };
    Ok([x, y, z])
}

impl<D> PointCloud2<D> {
    /// Number of its points, as it says.
    pub const fn count(&self) -> u64 {
        self.height as u64 * self.width as u64
    }
}

/// A cloud of x, y, z (metres), `f32` each, in no order. At most 2³² bytes of points fit into a message.
pub fn cloud_of_points(header: Header, points: &[[f32; 3]]) -> PointCloud2<Bytes> {
    cloud_of_floats(header, &["x", "y", "z"], points.as_flattened())
}

/// The same with a colour (red, green, blue) at each point, as viewers of ROS know it: `rgb`, the bytes blue,
/// green, red, 0 in the place of an `f32`.
pub fn cloud_of_coloured_points(header: Header, points: &[([f32; 3], [u8; 3])]) -> PointCloud2<Bytes> {
    let mut data = Vec::with_capacity(16 * points.len());
    for (point, [red, green, blue]) in points {
        point.iter().for_each(|v| data.extend_from_slice(&v.to_le_bytes()));
        data.extend_from_slice(&[*blue, *green, *red, 0]);
    }
    cloud_of_data(header, &["x", "y", "z", "rgb"], data)
}

/// A cloud of points in no order, with FLOAT32 fields of these names. `values` has the numbers of the first
/// point in the order of `fields`, then those of the second, and so on. It is marked dense: numbers should be
/// finite.
pub fn cloud_of_floats(header: Header, fields: &[&str], values: &[f32]) -> PointCloud2<Bytes> {
    let mut data = Vec::with_capacity(4 * values.len());
    values.iter().for_each(|v| data.extend_from_slice(&v.to_le_bytes()));
    cloud_of_data(header, fields, data)
}

/// Points with fields of four bytes each, little-endian.
fn cloud_of_data(header: Header, fields: &[&str], data: Vec<u8>) -> PointCloud2<Bytes> {
    let point_step = 4 * fields.len() as u32;
    let field = |(name, offset): (&&str, u32)| PointField {
        name: (*name).to_owned(),
        offset,
        datatype: PointField::FLOAT32,
        count: 1,
    };
    PointCloud2 {
        header,
        height: 1,
        width: (data.len() as u32).checked_div(point_step).unwrap_or(0),
        fields: fields.iter().zip((0..).step_by(4)).map(field).collect(),
        is_bigendian: false,
        point_step,
        row_step: data.len() as u32,
        data: Bytes(data),
        is_dense: true,
    }
}
