"""Flockmap keeps the 3-D occupancy map of every robot of a swarm in sync over a thin, lossy radio.

`Robot` is a robot without sockets and threads, `Node` one with them, `MapView` the map of a robot at one moment, `Mirror` the
map of a node in another process, `open_record` reads bags. `docs/python.md` begins with a map in five minutes.

Everywhere: metres; stamps in seconds as a float or nanoseconds as an int; points (N, 3) float32 or float64; poses (4, 4)
float64, where T_a_b takes coordinates in b to coordinates in a; states 0 Unknown, 1 Free, 2 Occupied as uint8.
"""

from ._blocks import FREE, OCCUPIED, UNKNOWN
from ._flockmap import (
    ClosedError,
    Collision,
    ConfigError,
    DatagramError,
    DistanceField,
    Error,
    Event,
    FileError,
    Frame,
    Frontier,
    HeightMap,
    MapView,
    Node,
    OccupancyGrid,
    PoseError,
    Record,
    Robot,
    ScanReport,
    Transmits,
    open_record,
)
from ._frames import MirrorError, RobotPose, RunSubmaps
from ._mirror import Mirror, MirrorMap

#: A record that is an MCAP file: `open_record` takes those, and others.
open_mcap = open_record

__all__ = [
    "FREE",
    "OCCUPIED",
    "UNKNOWN",
    "ClosedError",
    "Collision",
    "ConfigError",
    "DatagramError",
    "DistanceField",
    "Error",
    "Event",
    "FileError",
    "Frame",
    "Frontier",
    "HeightMap",
    "MapView",
    "Mirror",
    "MirrorError",
    "MirrorMap",
    "Node",
    "OccupancyGrid",
    "PoseError",
    "Record",
    "Robot",
    "RobotPose",
    "RunSubmaps",
    "ScanReport",
    "Transmits",
    "open_mcap",
    "open_record",
]
