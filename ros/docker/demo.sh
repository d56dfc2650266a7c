#!/usr/bin/env bash
# Plays the bag in /bag into flockmap-ros with /robot.toml, and shows how often the map comes.
set -euo pipefail
set +u
. /opt/ros/jazzy/setup.bash
set -u
flockmap-ros --config /robot.toml --ros-args -p use_sim_time:=true &
sleep 2
ros2 topic hz /flockmap/occupied_points &
ros2 bag play --clock 100 /bag
kill -TERM %1
wait %1
