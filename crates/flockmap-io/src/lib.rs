//! What Flockmap reads and writes of other people's formats: records of robots (MCAP, folders of scans),
//! point clouds (PCD, PLY, LAS, LAZ), OctoMaps, and exports of a map in three and in two dimensions.
//!
//! A damaged or foreign file is an error that names the file, the place in it, what was expected and what was
//! found ([`ReadError`]). No file makes a reader panic or hold more than the limit that its documentation
//! states.
//!
//! | what | read | written |
//! |---|---|---|
//! | record | [`open_record`]: `.mcap` with ROS 2 PointCloud2 + Odometry or tf; rosbag2 folder with such files; folder with `Scans/*.pcd`, poses, `times.txt` | [`RecordWriter`]: `.mcap` |
//! | flight of a node | [`open_flight`]: its feed | [`FlightRecorder`]: `.mcap`, for Foxglove and Rerun too; [`FlightView`]: the same messages, to an app |
//! | point cloud | [`read_cloud`]: `.pcd`, `.ply`, `.las`, `.laz` | [`write_cloud`]: `.pcd`, `.ply` |
//! | plane or band of a map | – | [`export_occupancy`]: `.pgm` or `.png` and a `.yaml`, for Nav2's `map_server`; [`export_heights`], [`export_values`]: `.png` |
//! | occupancy map | [`read_map`]: `.bt`, and what is written here; [`OctoMap::read`]: `.bt` | [`export_map`]: `.ply`, `.pcd`, `.bt` |
//! | message of ROS 2 | [`ros::decode`], or serde: clouds, poses, grids, OctoMaps, markers, diagnostics | [`ros::encode`], or serde |
//!
//! [`ros`] has the messages and the frames that they speak of, also for programs that get them over the network.
#![forbid(unsafe_code)]

mod bytes;
mod cloud;
mod cloud_reader;
mod describe;
mod error;
mod export;
mod export_flat;
mod file;
mod flight_file;
mod flight_reader;
mod flight_recorder;
mod flight_view;
mod foxglove;
mod header_lines;
mod image;
mod las;
mod lzf;
mod map_reader;
mod mcap_file;
mod mcap_frames;
mod mcap_index;
mod mcap_parts;
mod number;
mod octomap;
mod pcd;
mod ply;
mod protobuf;
mod record;
mod record_folder;
mod record_mcap;
mod record_reader;
mod record_scan;
mod record_submaps;
mod record_view;
mod record_writer;
pub mod ros;
mod rosbag;
mod writable;

pub use cloud::{CLOUD_BYTES_MAX, CLOUD_POINTS_MAX, PointCloud};
pub use cloud_reader::read_cloud;
pub use describe::{Content, Description, Topic, describe};
pub use error::{Fault, Place, Problem, ReadError, TopicOf, WriteError};
pub use export::{ExportOptions, export_map, write_cloud};
pub use export_flat::{Scale, export_heights, export_occupancy, export_values, occupancy_yaml};
pub use flight_reader::{FeedFrame, FlightFrames, open_flight};
pub use flight_recorder::{FlightOptions, FlightRecorder};
pub use flight_view::{FlightView, ViewOptions, ViewSink};
pub use map_reader::{MapFile, read_map};
pub use octomap::{Cube, OCTOMAP_BYTES_MAX, OctoMap, octomap_tree, read_octomap_tree};
pub use record::{Frame, Frames, Record, RecordOptions, RecordSummary};
pub use record_reader::{RecordKind, open_record};
pub use record_submaps::{SubmapPose, SubmapPoses};
pub use record_writer::RecordWriter;
pub use writable::{Unwritable, check_writable};
