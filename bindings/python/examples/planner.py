"""A planner on the map of a live node, in another process' shoes: it reads the map through a Mirror and plans with A*, while the
robot drives, sees more, and the map grows. What is Unknown is not driven through unless nothing else leads to the goal.

usage: python examples/planner.py [OUT.png]
"""

import heapq
import socket
import struct
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import world

import flockmap

START, GOAL, HEIGHT, ROBOT_RADIUS = (2.0, 2.0), (21.5, 13.0), 1.1, 0.4
CONFIGURATION = """id = 1
[map]
resolution_m = 0.2
range_m = 8.0
[state]
path = "{folder}/state"
[network]
bind = "127.0.0.1:0"
[sensor]
listen_unix = "{folder}/sensor.sock"
[map_output]
listen_unix = "{folder}/map.sock"
[metrics]
status_period_s = 0
"""


def scan_message(points: np.ndarray, far: np.ndarray, place: np.ndarray) -> bytes:
    """docs/sensor-input.md, kind 1."""
    body = struct.pack("<4sBBH", b"FLKS", 1, 1, 0)
    body += struct.pack("<q7dII", 0, *place, 0, 0, 0, 1, len(points), len(far))
    body += points.astype("<f4").tobytes() + far.astype("<f4").tobytes()
    return struct.pack("<I", len(body)) + body


def costs(mirror: flockmap.MirrorMap | None) -> tuple[np.ndarray, np.ndarray]:
    """For each cell of the hall what a step onto it costs, infinity where the robot would hit something; and the states."""
    nx, ny = (round(metres / world.SIDE) for metres in world.SIZE[:2])
    x, y = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    states = np.zeros((nx, ny), np.uint8)
    if mirror is not None:
        for z in np.arange(HEIGHT - 0.4, HEIGHT + 0.4, world.SIDE):
            centres = np.stack([(x + 0.5) * world.SIDE, (y + 0.5) * world.SIDE, np.full(x.shape, z)], -1)
            states = np.maximum(states, mirror.states(centres.reshape(-1, 3)).reshape(nx, ny))
    cost = np.where(states == flockmap.UNKNOWN, 4.0, 1.0)
    # The robot has a width.
    reach = round(ROBOT_RADIUS / world.SIDE)
    for i, j in np.argwhere(states == flockmap.OCCUPIED):
        cost[max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1] = np.inf
    return cost, states


def a_star(cost: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]]:
    """The cheapest way over neighbours, without the corners of what is in the way; empty: there is none."""
    best, came, queue, done = {start: 0.0}, {}, [(0.0, start)], set()
    while queue:
        _, at = heapq.heappop(queue)
        if at == goal:
            way = [at]
            while way[-1] in came:
                way.append(came[way[-1]])
            return way[::-1]
        if at in done:
            continue
        done.add(at)
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                to = (at[0] + dx, at[1] + dy)
                if to == at or not (0 <= to[0] < cost.shape[0] and 0 <= to[1] < cost.shape[1]):
                    continue
                if np.isinf(cost[to]) or np.isinf(cost[at[0], to[1]]) or np.isinf(cost[to[0], at[1]]):
                    continue
                reached = best[at] + np.hypot(dx, dy) * cost[to]
                if reached < best.get(to, np.inf):
                    best[to], came[to] = reached, at
                    heapq.heappush(queue, (reached + np.hypot(goal[0] - to[0], goal[1] - to[1]), to))
    return []


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "planner.png")
    truth = world.hall()
    cell = lambda place: (int(place[0] / world.SIDE), int(place[1] / world.SIDE))  # noqa: E731
    place, driven, pictures = np.array([*START, HEIGHT]), [START], []
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "node.toml").write_text(CONFIGURATION.format(folder=folder))
        with (
            flockmap.Node(Path(folder) / "node.toml", quiet=True) as node,
            flockmap.Mirror(node.map_addresses[0]) as mirror,
            socket.socket(socket.AF_UNIX) as sensor,
        ):
            sensor.connect(node.sensor_address.removeprefix("unix:"))
            for turn in range(60):
                before = mirror.version
                sensor.sendall(scan_message(*world.scan(truth, place, seed=turn), place))
                mirror.wait(before, timeout=2.0)
                seen = mirror.map()
                cost, states = costs(seen)
                # It stands where it stands, however near a pillar that is.
                cost[cell(place)] = 1.0
                way = a_star(cost, cell(place), cell(GOAL))
                if not way:
                    sys.exit("no way to the goal")
                pictures.append((states, way, list(driven)))
                if cell(place) == cell(GOAL):
                    break
                # Only so far as was seen to be free.
                for step in way[1:9]:
                    if states[step] != flockmap.FREE:
                        break
                    place = np.array([(step[0] + 0.5) * world.SIDE, (step[1] + 0.5) * world.SIDE, HEIGHT])
                    driven.append((place[0], place[1]))
            true_states = truth.states([(x, y, HEIGHT) for x, y in driven])
    arrived = cell(place) == cell(GOAL)
    length = float(np.linalg.norm(np.diff(driven, axis=0), axis=1).sum())
    print(f"planned {len(pictures)} times, drove {length:.1f} m, arrived: {arrived}")
    print(f"steps into what is truly occupied: {(true_states == flockmap.OCCUPIED).sum()}")

    shades = matplotlib.colors.ListedColormap(["#cdcdcd", "#ffffff", "#20242c"])
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), constrained_layout=True)
    for axis, turn in zip(axes.flat, np.linspace(0, len(pictures) - 1, 4).astype(int)):
        states, way, gone = pictures[turn]
        axis.imshow(states.T, origin="lower", extent=(0, 24, 0, 16), cmap=shades, vmin=0, vmax=2)
        axis.plot(*(np.array(way).T + 0.5) * world.SIDE, "--", color="#2a6fdb", label="plan")
        axis.plot(*np.array(gone).T, color="#e07a1f", linewidth=2, label="driven")
        axis.plot(*GOAL, "*", color="#1b8a3a", markersize=14, label="goal")
        axis.set(title=f"plan {turn + 1} of {len(pictures)}", ylabel="y, m")
    axes[1, 0].set_xlabel("x, m")
    axes[1, 1].set_xlabel("x, m")
    axes[0, 0].legend(loc="upper left")
    figure.suptitle("A* on the mirror of a node's map, while the map grows")
    figure.savefig(out, dpi=110)
    print(f"picture in {out}")
    if not arrived or (true_states == flockmap.OCCUPIED).any():
        sys.exit(1)


if __name__ == "__main__":
    main()
