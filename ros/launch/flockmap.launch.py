"""Starts flockmap-ros on a robot: ros2 launch flockmap.launch.py config:=robot1.toml namespace:=robot1 points:=velodyne_points

flockmap-ros is a plain program and no package of ROS; it must be in PATH.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration


def generate_launch_description():
    def argument(name, default, what):
        return DeclareLaunchArgument(name, default_value=default, description=what)

    def rule(name, value):
        return ["-r", [name, ":=", value]]

    value = LaunchConfiguration
    return LaunchDescription(
        [
            argument("config", "robot.toml", "configuration of the node, as of `flockmap node`"),
            argument("namespace", "/", "namespace of the node and of its topics"),
            argument("points", "points", "topic of the scans, sensor_msgs/PointCloud2"),
            argument("tf", "/tf", "/tf, or tf where each robot has its own"),
            argument("tf_static", "/tf_static", "the same for /tf_static"),
            argument("use_sim_time", "false", "whether /clock tells the time, as for a bag"),
            ExecuteProcess(
                cmd=[
                    "flockmap-ros",
                    "--config",
                    value("config"),
                    "--ros-args",
                    *rule("__ns", value("namespace")),
                    *rule("points", value("points")),
                    *rule("/tf", value("tf")),
                    *rule("/tf_static", value("tf_static")),
                    "-p",
                    ["use_sim_time:=", value("use_sim_time")],
                ],
                output="screen",
                sigterm_timeout="10",
            ),
        ]
    )
