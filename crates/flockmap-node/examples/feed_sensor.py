#!/usr/bin/env python3
"""Feeds a Flockmap node with scans over TCP; needs nothing but Python. The layout is in docs/sensor-input.md.

usage: feed_sensor.py HOST PORT [SCANS]
"""
import math
import socket
import struct
import sys
import time


def scan_message(points, pose, stamp_us=0):
    """points: (x, y, z) in metres in the sensor's frame; pose: x y z qx qy qz qw of the sensor in the map."""
    body = struct.pack("<4sBBH", b"FLKS", 1, 1, 0)
    body += struct.pack("<q7dII", stamp_us, *pose, len(points), 0)
    body += b"".join(struct.pack("<3f", *point) for point in points)
    return struct.pack("<I", len(body)) + body


if __name__ == "__main__":
    host, port, scans = sys.argv[1], int(sys.argv[2]), int((sys.argv + ["20"])[3])
    # A round room of 3.1 m radius, seen by a robot that moves along x.
    ring = [(a * math.pi / 180, z / 10) for a in range(360) for z in range(-5, 6)]
    with socket.create_connection((host, port)) as node:
        for step in range(scans):
            x = 0.02 * step
            points = [(3.1 * math.cos(a) - x, 3.1 * math.sin(a), z) for a, z in ring]
            node.sendall(scan_message(points, (x, 0, 0, 0, 0, 0, 1)))
            time.sleep(0.1)
