#!/usr/bin/env python3
"""Compares what a listener got with a map, voxel by voxel. Messages are decoded by rosbags, octrees by OctoMap's own library
(octomap_voxels.cpp), and what a message should hold is worked out here anew, in the plainest way.

usage: compare.py map MAP.bt LISTENED [--band 0.2 2] [--near 10] [--field-range 5 5 2] [--field-max 2] [--position X Y Z]
       compare.py layer REFERENCE.bt GOT.bt      equal where the reference knows; what is only in the other is counted
       compare.py share A.bt B.bt                how many of the voxels that both know are equal
       compare.py streams REPORT.json...         each layer is the same wherever it is held, and nothing is missing
       compare.py counts SENT.jsonl LISTENED     every cloud that was sent has been mapped, as /diagnostics says
       compare.py position SENT.jsonl            where the sensor was at the end
       compare.py latency SENT.jsonl RECEIVED.jsonl...  from sending a cloud to the first map with its stamp or a later one
environment: OCTOMAP_VOXELS, the program (default: octomap_voxels beside this file, built where it is missing)
exit: 0 equal, 1 not.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from messages import OUTPUTS, decode, floats, stamp_ns

FREE, OCCUPIED = 1, 2
HERE = Path(__file__).parent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    of = commands.add_parser("map")
    of.add_argument("map")
    of.add_argument("listened", type=Path)
    of.add_argument("--band", type=float, nargs=2, default=[0.2, 2.0])
    of.add_argument("--near", type=float, default=10.0)
    of.add_argument("--field-range", type=float, nargs=3, default=[5.0, 5.0, 2.0])
    of.add_argument("--field-max", type=float, default=2.0)
    of.add_argument("--position", type=float, nargs=3, help="of the sensor at the end")
    of.add_argument("--frame", default="map")
    of.add_argument("--need", nargs="*", default=[], help="outputs that must be there")
    for name, first, second in (("layer", "reference", "got"), ("share", "a", "b"), ("counts", "sent", "listened")):
        of = commands.add_parser(name)
        of.add_argument(first)
        of.add_argument(second)
    of = commands.add_parser("latency")
    of.add_argument("sent")
    of.add_argument("received", nargs="+", help="a grid and its updates are one")
    commands.add_parser("streams").add_argument("reports", nargs="+")
    commands.add_parser("position").add_argument("sent")
    options = parser.parse_args()
    return {"streams": streams, "counts": counts, "position": position, "map": compare_map, "layer": compare_layer, "share": compare_share, "latency": latency}[options.command](options)


# Voxels -------------------------------------------------------------------------------------------------------------------------


def octomap_voxels(*args: str, data: bytes | None = None) -> tuple[float, np.ndarray]:
    program = os.environ.get("OCTOMAP_VOXELS", str(HERE / "octomap_voxels"))
    if not os.path.exists(program):
        source = str(HERE / "octomap_voxels.cpp")
        subprocess.run(["g++", "-O2", "-std=c++17", source, "-loctomap", "-loctomath", "-o", program], check=True)
    done = subprocess.run([program, *args], input=data, capture_output=True)
    if done.returncode != 0:
        raise SystemExit(f"octomap_voxels {' '.join(args)}: {done.stderr.decode()}")
    return float(np.frombuffer(done.stdout[:8], "<f8")[0]), np.frombuffer(done.stdout[8:], "<i4").reshape(-1, 4)


def keys(voxels: np.ndarray) -> np.ndarray:
    """Each voxel as one number, which sorts."""
    v = voxels[:, :3].astype(np.int64) + (1 << 20)
    return (v[:, 0] << 42) | (v[:, 1] << 21) | v[:, 2]


class Map:
    def __init__(self, voxels: np.ndarray):
        every = keys(voxels)
        order = np.argsort(every)
        self.keys, self.voxels = every[order], voxels[order]
        self.states = self.voxels[:, 3]
        assert (np.diff(self.keys) > 0).all(), "a voxel twice"

    def states_at(self, at: np.ndarray) -> np.ndarray:
        """0 where nothing is known."""
        wanted = keys(at)
        found = np.searchsorted(self.keys, wanted)
        found[found == len(self.keys)] = 0
        return np.where(self.keys[found] == wanted, self.states[found], 0)


def read_map(path: str) -> tuple[float, Map]:
    resolution, voxels = octomap_voxels(path)
    return resolution, Map(voxels)


def compare(got: Map, expected: Map) -> tuple[int, int, int]:
    """Equal, different (also where nothing is), and only in the first."""
    there = got.states_at(expected.voxels)
    equal = int((there == expected.states).sum())
    only = int((expected.states_at(got.voxels) == 0).sum())
    return equal, len(expected.keys) - equal, only


def compare_layer(options) -> int:
    (side, expected), (other, got) = read_map(options.reference), read_map(options.got)
    equal, different, only = compare(got, expected)
    print(f"{options.got}: {equal} voxels of {len(expected.keys)} equal, {different} different, {only} only here")
    # What was published and has become unknown since stays in a layer; it must stay little.
    return 0 if side == other and equal > 0 and different == 0 and only * 50 < equal else 1


def compare_share(options) -> int:
    (_, a), (_, b) = read_map(options.a), read_map(options.b)
    there = b.states_at(a.voxels)
    both, equal = int((there != 0).sum()), int((there == a.states).sum())
    print(f"fused maps: {100 * equal / max(both, 1):.4f} % of {both} voxels that both know are equal; "
          f"{len(a.keys) - both} only in the first, {len(b.keys) - both} only in the second")
    return 0 if both else 1


# Messages ------------------------------------------------------------------------------------------------------------------------


class Report:
    def __init__(self):
        self.is_good = True

    def say(self, name: str, is_equal: bool, text: str) -> None:
        print(f"{'equal ' if is_equal else 'DIFFERS'} {name}: {text}")
        self.is_good &= is_equal


def compare_map(options) -> int:
    side, whole = read_map(options.map)
    got = {}
    for name, kind in OUTPUTS.items():
        path = options.listened / f"{name}.cdr"
        if path.exists():
            got[name] = decode(path.read_bytes(), kind)
    report = Report()
    for name in options.need:
        if name not in got:
            report.say(name, False, "never came")
    for name, message in got.items():
        frames = {m.header.frame_id for m in message.markers} if name == "robots" else {message.header.frame_id}
        if frames - {options.frame}:
            report.say(name, False, f"frame {frames}, expected {options.frame}")
    occupied = whole.voxels[whole.states == OCCUPIED]
    if "occupied_points_all" in got:
        check_points(report, "occupied_points_all", got["occupied_points_all"], occupied, side)
    if "occupied_points" in got:
        if options.position:
            expected = occupied[inside(occupied, np.array(options.position), np.full(3, options.near), side)]
            check_points(report, "occupied_points", got["occupied_points"], expected, side)
        else:
            points, _ = voxels_of(floats(got["occupied_points"]), side)
            are = whole.states_at(points) == OCCUPIED
            report.say("occupied_points", bool(are.all()), f"{are.sum()} of {len(are)} points are occupied voxels; position unknown")
    if "grid" in got:
        check_grid(report, got["grid"], got.get("grid_updates"), whole, side, options.band)
    if "octomap_binary" in got:
        message = got["octomap_binary"]
        resolution, voxels = octomap_voxels("message", repr(float(message.resolution)), data=message.data.tobytes())
        equal, different, only = compare(Map(voxels), whole)
        is_right = message.binary and message.id == "OcTree" and abs(message.resolution - side) < 1e-9
        report.say("octomap_binary", bool(is_right) and different + only == 0 and equal > 0,
                   f"{equal} voxels equal, {different} different, {only} only in the message ({message.id}, {resolution} m)")
    if "distance_field" in got:
        check_field(report, got["distance_field"], whole, occupied, side, options)
    if "robots" in got:
        where = [(m.ns, m.id, round(m.pose.position.x, 2), round(m.pose.position.y, 2), round(m.pose.position.z, 2))
                 for m in got["robots"].markers]
        near = options.position is None or any(np.abs(np.array(w[2:]) - options.position).max() < 0.6 for w in where)
        report.say("robots", near and bool(where), f"{where}")
    return 0 if report.is_good and got else 1


def voxels_of(points: np.ndarray, side: float) -> tuple[np.ndarray, float]:
    """The voxels of points, and how far the worst point is from its voxel's centre, in voxels."""
    if len(points) == 0:
        return np.zeros((0, 3), np.int64), 0.0
    voxels = np.floor(points[:, :3].astype(np.float64) / side).astype(np.int64)
    return voxels, float(np.abs(points[:, :3] / side - (voxels + 0.5)).max())


def inside(voxels: np.ndarray, centre: np.ndarray, half: np.ndarray, side: float) -> np.ndarray:
    """Which voxels are in a box, as soon as a millionth of their side is."""
    low = np.floor((centre - half) / side + 1e-6)
    high = np.floor((centre + half) / side - 1e-6)
    return ((voxels[:, :3] >= low) & (voxels[:, :3] <= high)).all(axis=1)


def check_points(report: Report, name: str, message, expected: np.ndarray, side: float) -> None:
    points = floats(message)
    voxels, off = voxels_of(points, side)
    got, wanted = np.unique(keys(voxels)), np.sort(keys(expected))
    missing, only = len(np.setdiff1d(wanted, got)), len(np.setdiff1d(got, wanted))
    is_equal = missing + only == 0 and len(got) == len(points) and off < 0.01 and [f.name for f in message.fields] == ["x", "y", "z"]
    report.say(name, is_equal, f"{len(points)} points, {len(wanted)} occupied voxels; {missing} missing, {only} only in the message, "
               f"{len(points) - len(got)} twice, off the centre by {off:.4f} voxels")


def check_grid(report: Report, grid, update, whole: Map, side: float, band) -> None:
    width, height = grid.info.width, grid.info.height
    cells = np.array(grid.data, dtype=np.int8).reshape(height, width)
    patched = 0
    # An update of the grid itself or of one before has nothing to add, but is no older than its grid where it does.
    if update is not None and stamp_ns(update.header.stamp) >= stamp_ns(grid.header.stamp):
        new = np.array(update.data, dtype=np.int8).reshape(update.height, update.width)
        there = cells[update.y:update.y + update.height, update.x:update.x + update.width]
        assert there.shape == new.shape, "an update that is not inside the grid"
        patched = int((there != new).sum())
        there[:] = new
    origin = np.array([grid.info.origin.position.x, grid.info.origin.position.y])
    low = np.round(origin / side).astype(int)
    of_band = np.floor(band[0] / side + 1e-6), np.floor(band[1] / side - 1e-6)
    v = whole.voxels[(whole.voxels[:, 2] >= of_band[0]) & (whole.voxels[:, 2] <= of_band[1])]
    at = v[:, :2] - low
    is_inside = ((at >= 0) & (at < [width, height])).all(axis=1)
    expected = np.full((height, width), -1, np.int8)
    v, at, outside = v[is_inside], at[is_inside], int((~is_inside).sum())
    free, full = at[v[:, 3] == FREE], at[v[:, 3] == OCCUPIED]
    expected[free[:, 1], free[:, 0]] = 0
    expected[full[:, 1], full[:, 0]] = 100
    wrong = int((cells != expected).sum())
    off = float(np.abs(origin - low * side).max())
    is_right = abs(grid.info.resolution - side) < 1e-6 and off < 1e-6 and (expected != -1).any()
    report.say("grid", bool(is_right) and wrong + outside == 0,
               f"{width} x {height}, {(expected == 100).sum()} occupied, {(expected == 0).sum()} free; {wrong} cells wrong, {outside} voxels "
               f"outside, {patched} cells from the newest update")


def check_field(report: Report, message, whole: Map, occupied: np.ndarray, side: float, options) -> None:
    rows = floats(message)
    assert [f.name for f in message.fields] == ["x", "y", "z", "distance"], message.fields
    voxels, off = voxels_of(rows, side)
    are_free = whole.states_at(voxels) == FREE
    distance, _ = cKDTree((occupied[:, :3] + 0.5) * side).query((voxels + 0.5) * side)
    error = np.abs(np.minimum(distance, options.field_max) - rows[:, 3]) if len(rows) else np.zeros(1)
    missing = 0
    if options.position:
        free = whole.voxels[whole.states == FREE]
        wanted = keys(free[inside(free, np.array(options.position), np.array(options.field_range), side)])
        missing = len(np.setdiff1d(wanted, keys(voxels))) + len(np.setdiff1d(keys(voxels), wanted))
    is_right = bool(are_free.all()) and error.max() < 1e-3 and missing == 0 and off < 0.01 and len(rows) > 0
    report.say("distance_field", is_right, f"{len(rows)} points, {int((~are_free).sum())} not free, {missing} missing or too many in the box, "
               f"largest error {error.max():.5f} m, mean distance {rows[:, 3].mean() if len(rows) else 0:.3f} m")


# Reports -----------------------------------------------------------------------------------------------------------------------


def streams(options) -> int:
    """Digests are of states and stamps, so equal ones are equal voxel by voxel."""
    held: dict[tuple, dict] = {}
    result = 0
    for path in options.reports:
        for stream in json.loads(Path(path).read_text())["streams"]:
            if stream["voxels"]:
                held.setdefault((stream["origin"], stream["epoch"]), {})[path] = stream
    for (origin, epoch), by in sorted(held.items()):
        digests = {s["digest"] for s in by.values()}
        missing = sum(s["missing"] for s in by.values())
        is_good = len(digests) == 1 and missing == 0 and len(by) > 1
        result |= not is_good
        voxels = "/".join(str(v) for v in sorted({s["voxels"] for s in by.values()}))
        print(f"{'equal ' if is_good else 'DIFFERS'} layer of robot {origin}: {voxels} voxels, held by {len(by)}, {missing} packages missing")
    return int(result or not held)


def counts(options) -> int:
    sent = [json.loads(line) for line in open(options.sent)]
    clouds = sum("stamp" in line for line in sent)
    values = {}
    for line in open(Path(options.listened) / "values.jsonl"):
        for of_part in json.loads(line)["status"].values():
            values.update(of_part)
    shown = {k: v for k, v in values.items() if "cloud" in k or "left out" in k or "pose" in k or "no numbers" in k}
    mapped = int(values.get("clouds mapped", -1))
    print(f"{'equal ' if mapped == clouds else 'DIFFERS'} clouds: {clouds} sent, {mapped} mapped: {shown}")
    return int(mapped != clouds)


def position(options) -> int:
    print(*[json.loads(line) for line in open(options.sent)][-1]["position"])
    return 0


# Latency -----------------------------------------------------------------------------------------------------------------------


def latency(options) -> int:
    sent = [json.loads(line) for line in open(options.sent)]
    # Flockmap keeps stamps in microseconds.
    sent = sorted((line["stamp"] // 1000, line["wall"]) for line in sent if "stamp" in line)
    received = [json.loads(line) for path in options.received for line in open(path)]
    received.sort(key=lambda m: m["wall"])
    stamps = {stamp for stamp, _ in sent}
    newest = [(m["stamp"] // 1000, m["wall"]) for m in received if "stamp" in m]
    # Each scan until the first message that has it, or a later one.
    waits, exact = [], []
    for stamp, wall in sent:
        came = [w for s, w in newest if s >= stamp and w >= wall]
        if came:
            waits.append(min(came) - wall)
    of = dict(sent)
    seen = set()
    for stamp, wall in newest:
        if stamp in of and stamp not in seen:
            seen.add(stamp)
            exact.append(wall - of[stamp])
    foreign = sum(stamp not in stamps for stamp, _ in newest)
    print(f"{' and '.join(options.received)}: {len(newest)} messages, {foreign} with a stamp of no scan that was sent")
    for name, values in (("from a scan to the map with its stamp", exact), ("from a scan to the first map that has it", waits)):
        if values:
            p = np.percentile(np.array(values) * 1e3, [50, 99, 100])
            print(f"  {name}: median {p[0]:.1f} ms, 99 % {p[1]:.1f} ms, largest {p[2]:.1f} ms, of {len(values)}")
    return 0 if waits else 1


if __name__ == "__main__":
    sys.exit(main())
