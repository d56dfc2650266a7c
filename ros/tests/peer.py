#!/usr/bin/env python3
"""The other side, to be killed: sends a cloud with its tf ten times a second and listens to the map that comes of it.

usage: peer.py NAMESPACE [SECONDS]
On standard output, a line of JSON for each first: matched, when both directions are; map, when a map came. `s` is the time since this
program had Cyclone.
"""

import json
import sys
import time

import numpy as np

from messages import DomainParticipant, Reader, Writer, cloud, transform


def main() -> None:
    namespace, seconds = sys.argv[1], float(sys.argv[2]) if len(sys.argv) > 2 else 1e9
    begun = time.monotonic()
    participant = DomainParticipant()
    points = Writer(participant, f"{namespace}/points", "PointCloud2", "best_effort,volatile,5")
    tf = Writer(participant, "/tf", "TFMessage", "reliable,volatile,100")
    maps = Reader(participant, f"{namespace}/flockmap/occupied_points_all", "PointCloud2", "reliable,transient_local,1")

    said = set()

    def say(what: str) -> None:
        if what not in said:
            said.add(what)
            print(json.dumps({"what": what, "s": round(time.monotonic() - begun, 3)}), flush=True)

    turn = 0
    while time.monotonic() - begun < seconds:
        if time.monotonic() - begun >= turn / 10:
            stamp = time.time_ns()
            tf.write(transform(stamp, "map", "lidar"))
            points.write(cloud(stamp, "lidar", wall(turn)))
            turn += 1
        if points.matched() and maps.matched():
            say("matched")
        if maps.take_cdr():
            say("map")
        time.sleep(0.005)


def wall(turn: int) -> np.ndarray:
    """A wall 3 m ahead, a little nearer each time, so that the map changes."""
    y, z = np.meshgrid(np.arange(-1.0, 1.0, 0.05), np.arange(-0.5, 1.5, 0.05))
    return np.c_[np.full(y.size, 3.0 - 0.2 * (turn % 8)), y.ravel(), z.ravel()]


if __name__ == "__main__":
    main()
