"""Two robots over UDP that loses every fifth datagram. Each maps with its own LiDAR, and has what the other saw.

usage: python examples/two_over_udp.py [OUT.png]
"""

import select
import socket
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import world

import flockmap

LOSS, SECONDS, STEP = 0.2, 24.0, 0.02
random = np.random.default_rng(4)


class UdpRobot:
    """A robot and its socket. What it sends to everyone goes to the one team-mate that there is."""

    def __init__(self, id: int) -> None:
        self.robot = flockmap.Robot(id, resolution=world.SIDE, range=8.0, budget=None)
        self.alone = flockmap.Robot(id, resolution=world.SIDE, range=8.0)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.sent = np.zeros(int(SECONDS))

    def send(self, now: float, other: "UdpRobot") -> None:
        for _to, data in self.robot.transmits(now):
            self.sent[min(int(now), len(self.sent) - 1)] += len(data) + 28  # IP and UDP
            if random.random() >= LOSS:
                self.socket.sendto(data, other.socket.getsockname())

    def receive(self, now: float) -> None:
        while select.select([self.socket], [], [], 0)[0]:
            try:
                self.robot.handle_datagram(now, self.socket.recv(2048))
            except flockmap.DatagramError as error:
                print(f"robot {self.robot.id}: {error}")


def places(now: float) -> list[np.ndarray]:
    """Alice goes up the left hall and down the middle one, Bob the right one."""
    share = np.clip(now / (SECONDS - 6), 0, 1)
    alice = np.array([[2, 2, 1.5], [3, 13.5, 1.5], [10, 13.5, 1.5], [10, 6, 1.5]])
    bob = np.array([[22, 14, 1.5], [21, 2.5, 1.5], [13.5, 2.5, 1.5], [13.5, 7, 1.5]])
    at = share * 3
    return [np.array([np.interp(at, range(4), line[:, axis]) for axis in range(3)]) for line in (alice, bob)]


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "two_over_udp.png")
    truth, robots = world.hall(), [UdpRobot(1), UdpRobot(2)]
    for step in range(int(SECONDS / STEP)):
        # Time of the robots: any clock will do that does not step back.
        now = step * STEP
        for robot, other, place in zip(robots, reversed(robots), places(now)):
            if step % 10 == 0 and now < SECONDS - 6:
                pose = np.eye(4)
                pose[:3, 3] = place
                points, far = world.scan(truth, place, seed=step)
                for each in (robot.robot, robot.alone):
                    each.insert_scan(points, pose, now, far)
            robot.robot.handle_timeout(now)
            robot.send(now, other)
        for robot, other in zip(robots, reversed(robots)):
            robot.receive(now)
            robot.send(now, other)

    views = [robot.robot.view() for robot in robots]
    # Where both looked within a second of each other, each believes its own eyes: there the maps may differ by a little.
    indices = np.unique(np.concatenate([view.voxels()[0] for view in views]), axis=0)
    centres = (indices + 0.5) * world.SIDE
    agreement = float((views[0].states(centres) == views[1].states(centres)).mean())
    unpublished = sum(robot.robot.unpublished() for robot in robots)
    print(f"{len(indices)} voxels known, {agreement:.2%} of them the same in both, {unpublished} still to be published")

    figure, axes = plt.subplots(2, 2, figsize=(11, 8), constrained_layout=True)
    titles = ("Alice, what she saw herself", "Bob, what he saw himself", "Alice, with what came from Bob")
    for axis, view, title in zip(axes.flat, [robots[0].alone.view(), robots[1].alone.view(), views[0]], titles):
        grid = view.occupancy_grid(0.4, 2.4, ((0.0, 0.0), (24.0, 16.0)))
        axis.imshow(grid.states(), origin="lower", extent=(0, 24, 0, 16), cmap=SHADES, vmin=0, vmax=2)
        axis.set(title=title, ylabel="y, m")
    axis = axes[1, 1]
    for robot, name, shift in zip(robots, ("Alice", "Bob"), (0.1, 0.5)):
        axis.bar(np.arange(len(robot.sent)) + shift, robot.sent / 1024, 0.4, align="edge", label=name)
    axis.set(title=f"Sent over a radio that loses {LOSS:.0%}", xlabel="time, s", ylabel="KiB in a second")
    axis.legend()
    figure.suptitle(f"{agreement:.2%} of the voxels are the same in both maps")
    figure.savefig(out, dpi=110)
    print(f"picture in {out}")
    if agreement < 0.99 or unpublished:
        sys.exit(1)


#: Unknown, Free, Occupied.
SHADES = matplotlib.colors.ListedColormap(["#cdcdcd", "#ffffff", "#20242c"])

if __name__ == "__main__":
    main()
