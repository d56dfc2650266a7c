"""The same work from Python and in Rust, in turns, in one run: medians and their ratio.

usage: python bench/beside_rust.py PROGRAM [ROUNDS]
PROGRAM is the Rust side: cargo build --release --example beside_rust
exit: 0 if both targets are met, 1 if not.
"""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import flockmap

QUERIES, SCAN_POINTS = 1_000_000, 60_000


def room(count: int) -> np.ndarray:
    """Points on the walls of a room of 24 × 24 × 6 m, in the directions of a LiDAR's turn."""
    random = np.random.default_rng(1)
    turn, rise = random.uniform(0, 2 * np.pi, count), random.uniform(-0.4, 0.7, count)
    ways = np.stack([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)], 1)
    return ways * np.min(np.array([12.0, 12.0, 3.0]) / np.abs(ways), axis=1, keepdims=True)


def measured(work) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def main() -> int:
    rounds = int(sys.argv[2]) if len(sys.argv) > 2 else 25
    scan64 = room(SCAN_POINTS)
    scan32 = scan64.astype(np.float32)
    asked = np.random.default_rng(2).uniform([-13, -13, -4], [13, 13, 4], (QUERIES, 3))
    # As a planner asks: near each other.
    walk = np.cumsum(np.random.default_rng(3).normal(0, 0.02, (QUERIES, 3)), 0) % [24, 24, 6] - [12, 12, 3]

    def robot() -> flockmap.Robot:
        return flockmap.Robot(1, resolution=0.1, range=20.0, epoch=1)

    mapped = robot()
    mapped.insert_scan(scan32, np.eye(4), 0.0)
    view = mapped.view()

    def insert(scan: np.ndarray) -> float:
        fresh = robot()
        return measured(lambda: fresh.insert_scan(scan, np.eye(4), 0.0))

    is_met = True
    with tempfile.TemporaryDirectory() as folder:
        (scan_file := Path(folder) / "scan").write_bytes(scan32.tobytes())
        for name, points in (("scattered", asked), ("along a walk", walk)):
            (asked_file := Path(folder) / "asked").write_bytes(points.tobytes())
            cases = {
                f"states of 1,000,000 float64 points, {name}": ("ask", lambda: measured(lambda: view.states(points)), 1.5),
                f"the same beside a loop over state_at, {name}": ("loop", lambda: measured(lambda: view.states(points)), 1.5),
            }
            if points is asked:
                cases["insert_scan of 60,000 float32 points"] = ("scan", lambda: insert(scan32), 1.1)
                cases["insert_scan of 60,000 float64 points"] = ("scan", lambda: insert(scan64), 1.1)
            command = [sys.argv[1], str(asked_file), str(scan_file)]
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as rust:

                def in_rust(what: str) -> tuple[float, int]:
                    rust.stdin.write(what + "\n")
                    rust.stdin.flush()
                    seconds, occupied = rust.stdout.readline().split()
                    return float(seconds), int(occupied)

                assert in_rust("ask")[1] == (view.states(points) == flockmap.OCCUPIED).sum()
                for case, (what, in_python, limit) in cases.items():
                    times: tuple[list[float], list[float]] = ([], [])
                    # Not the first time of anything.
                    in_python(), in_rust(what)
                    for turn in range(rounds):
                        # In both orders.
                        for side in ((0, 1), (1, 0))[turn % 2]:
                            times[side].append(in_python() if side == 0 else in_rust(what)[0])
                    python, in_rs = (statistics.median(side) for side in times)
                    ratio = python / in_rs
                    is_met &= ratio <= limit
                    print(f"{case}: Python {python * 1e3:.1f} ms, Rust {in_rs * 1e3:.1f} ms, × {ratio:.2f} (target {limit})")
                rust.stdin.close()
    return 0 if is_met else 1


if __name__ == "__main__":
    sys.exit(main())
