#!/usr/bin/env bash
# What flockmap-ros does with faults: ros/tests/test_faults.py in a network namespace with a loopback alone.
#
# usage: faults.sh FLOCKMAP_ROS [what else pytest is to be given, such as -k clock]
#   needs root, ip, g++, liboctomap-dev.
# environment: MULTICAST=on, or off, the loopback as Linux has it: then Cyclone is set as ROS sets it for
#   ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST; FLOCKMAP_DATA, PYTHON: see environment.sh
# exit: that of pytest.
set -euo pipefail

[ $# -ge 1 ] || { sed -n '2,8p' "$0" >&2; exit 1; }
FLOCKMAP_ROS=$(realpath "$1")
shift
. "$(dirname "$0")/environment.sh"
if [ "${MULTICAST:-on}" = off ]; then
    CYCLONEDDS_URI='<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
fi
export FLOCKMAP_ROS CYCLONEDDS_URI
name=rosfault$$
trap 'ip netns del "$name" 2> /dev/null || true' EXIT
ip netns add "$name"
ip -n "$name" link set lo up
ip -n "$name" link set lo multicast "${MULTICAST:-on}"
cd "$TESTS"
ip netns exec "$name" "$PYTHON" -m pytest -p no:cacheprovider -rP -v "$@" test_faults.py
