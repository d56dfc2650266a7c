//! A Flockmap node with ROS 2 topics, without ROS in the build. `docs/ros2.md` is its manual.

mod arguments;
mod clock;
mod intake;
mod links;
mod names;
mod output;
mod parameters;
mod publishing;
mod run;
mod scans;
mod team;
mod topics;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;

use crate::arguments::RosArguments;

/// A Flockmap robot on ROS 2: takes point clouds and poses from topics, keeps the map in sync with the other robots,
/// and publishes it.
///
/// Takes: points (sensor_msgs/PointCloud2), /tf and /tf_static or odom (nav_msgs/Odometry), /clock.
/// Publishes: ~/occupied_points, ~/occupied_points_all, ~/grid, ~/grid_updates, ~/octomap_binary, ~/distance_field,
/// ~/robots, /diagnostics.
#[derive(Parser)]
#[command(
    version,
    after_help = "Behind --ros-args, as for every node of ROS 2:
  -r points:=/lidar/points   another name for a topic; -r __ns:=/robot1, -r __node:=mapper
  -p NAME:=VALUE             a value of the configuration: -p map.resolution_m:=0.1, -p use_sim_time:=true
  --params-file FILE.yaml    the same as a YAML file of ROS

Examples:
  flockmap-ros --config robot1.toml
  flockmap-ros --ros-args --params-file robot1.yaml -r points:=/velodyne_points
  flockmap-ros --config robot1.toml --ros-args -r __ns:=/robot1 -r /tf:=tf -r /tf_static:=tf_static

crates/flockmap-node/robot.example.toml has every key with its default; those of ROS are in [ros]. DDS uses the loopback
interface alone unless `[ros] interfaces` says others, so that it stays off the radio: docs/ros2.md."
)]
struct Options {
    /// Configuration of the node, as of `flockmap node`. Not needed where parameters say all of it.
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
}

fn main() -> ExitCode {
    let (own, ros) = match RosArguments::split(std::env::args()) {
        Ok(split) => split,
        Err(error) => {
            eprintln!("error: {error:#}");
            return ExitCode::from(2);
        }
    };
    let options = Options::parse_from(own);
    match run::run(options.config.as_deref(), &ros) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
