"""What your own bags take on the radio: each is played into a robot, over a link that loses a part, and the bytes are counted by the
second, IP and UDP headers too.

usage: python examples/bag_bytes.py BAG1 BAG2 [--resolution 0.2] [--range 30] [--loss 0.2] [--seconds 60] [--out bytes.png]

A bag is an .mcap, a folder that `ros2 bag record` made, or a folder of scans. `flockmap replay` does more of this, faster.
"""

import argparse
import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import flockmap

STEP = 0.02


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("bag", nargs=2)
    for name, default in (("resolution", 0.2), ("range", 30.0), ("loss", 0.2), ("seconds", 60.0)):
        options.add_argument(f"--{name}", type=float, default=default)
    options.add_argument("--out", default="bytes.png")
    given = options.parse_args()
    random = np.random.default_rng(1)
    records = [flockmap.open_record(path) for path in given.bag]
    begins = [record.poses()[0][0] for record in records]
    robots = [flockmap.Robot(n, resolution=given.resolution, range=given.range) for n in (1, 2)]
    seconds = int(given.seconds)
    sent, changed = np.zeros((2, seconds + 6)), np.zeros((2, seconds + 6))
    frames = [iter(record) for record in records]
    following = [next(each) for each in frames]
    for step in range(int((seconds + 6) / STEP)):
        now = step * STEP
        for n, robot in enumerate(robots):
            while following[n] is not None and following[n].stamp - begins[n] <= min(now, seconds):
                frame = following[n]
                report = robot.insert_scan(frame.points, frame.T_map_sensor, now, frame.no_returns)
                changed[n, int(now)] += report.changed
                following[n] = next(frames[n], None)
            robot.handle_timeout(now)
        for n, robot in enumerate(robots):
            for _to, data in robot.transmits(now):
                sent[n, int(now)] += len(data) + 28
                if random.random() >= given.loss:
                    robots[1 - n].handle_datagram(now, data)
    tables = [np.column_stack(robot.view().voxels()) for robot in robots]
    print(f"{len(tables[0])} and {len(tables[1])} voxels known, {sum(robot.unpublished() for robot in robots)} unpublished")
    for n, record in enumerate(records):
        print(f"{record.name}: {sent[n, :seconds].mean() / 1024:.2f} KiB/s, {changed[n].sum():.0f} changes")

    figure, (above, below) = plt.subplots(2, 1, figsize=(10, 7), sharex=True, constrained_layout=True)
    for n, record in enumerate(records):
        above.step(range(len(sent[n])), sent[n] / 1024, where="post", label=f"robot {n + 1}: {record.name}")
        below.step(range(len(sent[n])), changed[n] / 1000, where="post")
    above.set(title=f"On the wire, {given.loss:.0%} lost, voxels of {given.resolution} m", ylabel="KiB in a second", ylim=(0, None))
    above.legend()
    below.set(xlabel="time, s", ylabel="changed voxels, thousands a second", ylim=(0, None))
    figure.savefig(given.out, dpi=110)
    print(f"picture in {given.out}")
    if not sent.sum():
        sys.exit("nothing was sent")


if __name__ == "__main__":
    main()
