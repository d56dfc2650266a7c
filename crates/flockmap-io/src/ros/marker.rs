//! Pictures for people, as RViz draws them.

use serde::{Deserialize, Serialize};

use super::geometry::Pose;
use super::parts::{self, Bytes};
use super::time::{Duration, Header};

/// `std_msgs/msg/ColorRGBA`: each from 0 to 1.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Debug, Default)]
pub struct ColorRGBA {
    /// Red.
    pub r: f32,
    /// Green.
    pub g: f32,
    /// Blue.
    pub b: f32,
    /// 0 cannot be seen, 1 hides what is behind.
    pub a: f32,
}

/// `sensor_msgs/msg/CompressedImage`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Eq, Debug, Default)]
pub struct CompressedImage {
    /// Stamp and frame.
    pub header: Header,
    /// For example `png`.
    #[serde(with = "parts::text")]
    pub format: String,
    /// The file.
    pub data: Bytes,
}

/// `visualization_msgs/msg/UVCoordinate`: a place in a texture, each from 0 to 1.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Debug, Default)]
pub struct UVCoordinate {
    /// Along the width.
    pub u: f32,
    /// Along the height.
    pub v: f32,
}

/// `visualization_msgs/msg/MeshFile`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Eq, Debug, Default)]
pub struct MeshFile {
    /// Its ending says its format.
    #[serde(with = "parts::text")]
    pub filename: String,
    /// The file.
    pub data: Bytes,
}

/// `visualization_msgs/msg/Marker`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct Marker {
    /// Stamp and frame.
    pub header: Header,
    /// With `id` the name of the marker.
    #[serde(with = "parts::text")]
    pub ns: String,
    /// With `ns` the name of the marker.
    pub id: i32,
    /// What is drawn: [`Self::SPHERE`] and others.
    pub r#type: i32,
    /// [`Self::ADD`], [`Self::DELETE`] or [`Self::DELETEALL`].
    pub action: i32,
    /// Pose in the frame of the header.
    pub pose: Pose,
    /// Size along x, y, z in metres; what it means depends on the type.
    pub scale: [f64; 3],
    /// Colour of the whole.
    pub color: ColorRGBA,
    /// How long it is shown; 0: until it is deleted.
    pub lifetime: Duration,
    /// Whether it moves with its frame.
    #[serde(with = "parts::flag")]
    pub frame_locked: bool,
    /// x, y, z in metres, for types of many points.
    pub points: Vec<[f64; 3]>,
    /// None, or one for each point.
    pub colors: Vec<ColorRGBA>,
    /// Where the texture is.
    #[serde(with = "parts::text")]
    pub texture_resource: String,
    /// The texture, if it is embedded.
    pub texture: CompressedImage,
    /// The place in the texture for each vertex.
    pub uv_coordinates: Vec<UVCoordinate>,
    /// For [`Self::TEXT_VIEW_FACING`].
    #[serde(with = "parts::text")]
    pub text: String,
    /// Where the mesh is.
    #[serde(with = "parts::text")]
    pub mesh_resource: String,
    /// The mesh, if it is embedded.
    pub mesh_file: MeshFile,
    /// Whether the mesh brings its materials.
    #[serde(with = "parts::flag")]
    pub mesh_use_embedded_materials: bool,
}

impl Marker {
    /// From the origin along x, or from the first point to the second.
    pub const ARROW: i32 = 0;
    /// A box.
    pub const CUBE: i32 = 1;
    /// A sphere.
    pub const SPHERE: i32 = 2;
    /// A cylinder about z.
    pub const CYLINDER: i32 = 3;
    /// A line through the points.
    pub const LINE_STRIP: i32 = 4;
    /// A line between each two points.
    pub const LINE_LIST: i32 = 5;
    /// A box at each point.
    pub const CUBE_LIST: i32 = 6;
    /// A sphere at each point.
    pub const SPHERE_LIST: i32 = 7;
    /// The points.
    pub const POINTS: i32 = 8;
    /// The text, turned to who looks.
    pub const TEXT_VIEW_FACING: i32 = 9;
    /// A mesh.
    pub const MESH_RESOURCE: i32 = 10;
    /// A triangle of each three points.
    pub const TRIANGLE_LIST: i32 = 11;

    /// Draws the marker, or changes it.
    pub const ADD: i32 = 0;
    /// Takes the marker away.
    pub const DELETE: i32 = 2;
    /// Takes all markers away, or those of `ns` if it is not empty.
    pub const DELETEALL: i32 = 3;
}

/// `visualization_msgs/msg/MarkerArray`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Debug, Default)]
pub struct MarkerArray {
    /// The markers.
    pub markers: Vec<Marker>,
}
