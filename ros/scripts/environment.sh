# For the other scripts here, to be read with `.`: a Python environment with what ros/tests/requirements.txt names, and the programs
# that it needs. Sets PYTHON, TESTS and OCTOMAP_VOXELS.
# environment: PYTHON, one that has it all already; FLOCKMAP_DATA, recordings (default: ../shared/data beside the repository)
ros=$(cd "$(dirname "$0")/.." && pwd)
TESTS=$ros/tests
FLOCKMAP_DATA=${FLOCKMAP_DATA:-$(cd "$ros/.." && pwd)/../shared/data}
if [ -z "${PYTHON:-}" ]; then
    PYTHON=$TESTS/build/venv/bin/python
    if ! cmp -s "$TESTS/requirements.txt" "$TESTS/build/installed.txt"; then
        rm -rf "$TESTS/build"
        mkdir -p "$TESTS/build"
        python3 -m venv "$TESTS/build/venv"
        "$TESTS/build/venv/bin/pip" install -q --disable-pip-version-check -r "$TESTS/requirements.txt"
        cp "$TESTS/requirements.txt" "$TESTS/build/installed.txt"
    fi
fi
if [ ! -e /usr/include/octomap/octomap.h ]; then
    echo "OctoMap is not installed: apt install g++ liboctomap-dev" >&2
    exit 1
fi
mkdir -p "$TESTS/build"
OCTOMAP_VOXELS=$TESTS/build/octomap_voxels
g++ -O2 -std=c++17 -Wall -Wextra "$TESTS/octomap_voxels.cpp" -loctomap -loctomath -o "$OCTOMAP_VOXELS"
# Cyclone takes the network that leads out if it is not told; these tests, as a robot does, keep DDS on the machine.
CYCLONEDDS_URI='<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces></General></Domain></CycloneDDS>'
export PYTHON OCTOMAP_VOXELS CYCLONEDDS_URI FLOCKMAP_DATA
