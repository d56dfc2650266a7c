"""What flockmap-ros does with faults of its surroundings: in words (its log) and in counters (/diagnostics).

Run by ros/scripts/faults.sh, in a network namespace with a loopback alone. FLOCKMAP_ROS is the program; FLOCKMAP_DATA the recordings.
"""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from rosbags.rosbag2 import Reader as BagReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from messages import (DomainParticipant, Reader, Writer, cloud, dds_name, ddspy_write, floats, header, message, qos, store, time_message,
                      transform)
from peer import wall
from play import shifted

HERE = Path(__file__).parent
FLOCKMAP_ROS = os.environ.get("FLOCKMAP_ROS")
DATA = Path(os.environ.get("FLOCKMAP_DATA", HERE.parent.parent.parent / "shared/data"))
# What is promised: whoever comes back is found again in so long.
DISCOVERED_S = 2.0

RECEIVED, MAPPED = "clouds received", "clouds mapped"
NO_POSE, DAMAGED = "left out: no pose", "left out: damaged or too large"
NO_NUMBERS = "points that are no numbers"

pytestmark = pytest.mark.skipif(not FLOCKMAP_ROS, reason="FLOCKMAP_ROS is not set")


class Node:
    """flockmap-ros, and a participant of Cyclone beside it."""

    def __init__(self, folder: Path, *arguments: str, ros: str = "", namespace: str = "/robot1", points_qos="best_effort,volatile,5"):
        self.folder, self.arguments, self.namespace = folder, arguments, namespace
        (folder / "robot.toml").write_text(f"""
id = 1
[map]
resolution_m = 0.2
range_m = 10.0
[state]
path = "state"
[network]
bind = "127.0.0.1:7701"
[ros]
diagnostics_period_s = 0.1
all_period_s = 0.1
{ros}
[output]
report_json = "report.json"
""")
        self.process = None
        self.starts = 0
        self.participant = DomainParticipant()
        self.points = Writer(self.participant, f"{namespace}/points", "PointCloud2", points_qos)
        self.tf = Writer(self.participant, "/tf", "TFMessage", "reliable,volatile,100")
        self.diagnostics = Reader(self.participant, "/diagnostics", "DiagnosticArray", "reliable,volatile,100")
        self.map = Reader(self.participant, f"{namespace}/flockmap/occupied_points_all", "PointCloud2", "reliable,transient_local,1")
        self.values: dict = {}
        self.start()

    def start(self) -> None:
        self.starts += 1
        with open(self.folder / f"{self.starts}.log", "w") as log:
            self.process = subprocess.Popen(
                [FLOCKMAP_ROS, "--config", str(self.folder / "robot.toml"), "--ros-args", "-r", f"__ns:={self.namespace}",
                 "-r", "__node:=flockmap", *self.arguments], stdout=log, stderr=log, stdin=subprocess.DEVNULL)
        self.values = {}
        while self.diagnostics.take_cdr():
            pass

    def log(self) -> str:
        return (self.folder / f"{self.starts}.log").read_text()

    def poll(self) -> dict:
        """All values of the newest diagnostics."""
        for cdr in self.diagnostics.take_cdr():
            for status in self.diagnostics.decode(cdr).status:
                self.values.update({v.key: v.value for v in status.values})
                self.values[f"{status.name} says"] = f"{int(status.level)} {status.message}"
        return self.values

    def count(self, key: str) -> int:
        return int(self.poll().get(key, 0))

    def wait(self, what, seconds: float = 5.0, then=None) -> float:
        """How long it took until something was so; `then` is done meanwhile, ten times a second."""
        begun, turn = time.monotonic(), 0
        while not what():
            passed = time.monotonic() - begun
            if passed > seconds:
                raise AssertionError(f"not so after {seconds} s; counters {self.values}; log:\n{self.log()[-3000:]}")
            assert self.process.poll() is None, f"flockmap-ros ended:\n{self.log()[-3000:]}"
            if then and passed >= turn / 10:
                then()
                turn += 1
            time.sleep(0.002)
        return time.monotonic() - begun

    def ready(self) -> None:
        self.wait(lambda: self.poll() and self.points.matched(), 10.0)

    def send(self, points=None, *, stamp=None, pose=True, frame="lidar") -> int:
        stamp = stamp or time.time_ns()
        if pose:
            self.tf.write(transform(stamp, "map", frame))
        self.points.write(cloud(stamp, frame, wall(0) if points is None else points))
        return stamp

    def must_map(self, seconds: float = 5.0) -> None:
        """It still maps what comes."""
        before = self.count(MAPPED)
        self.wait(lambda: self.count(MAPPED) > before, seconds, self.send)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def node(tmp_path, request):
    given = getattr(request, "param", {})
    made = Node(tmp_path, *given.get("arguments", ()), **{k: v for k, v in given.items() if k != "arguments"})
    yield made
    print("counters:", {k: v for k, v in made.poll().items() if v != "0"})
    made.kill()
    print("log, its warnings:", *[line for line in made.log().splitlines() if re.search("(?i)warn|error", line)][:10], sep="\n  ")


def test_the_other_side_is_killed_and_comes_back(node):
    node.ready()
    node.must_map()
    took = []
    for _ in range(5):
        peer = subprocess.Popen([sys.executable, str(HERE / "peer.py"), node.namespace], stdout=subprocess.PIPE, text=True)
        try:
            found = [json.loads(peer.stdout.readline()) for _ in range(2)]
            before = node.count(MAPPED)
            node.wait(lambda: node.count(MAPPED) > before + 5)
        finally:
            peer.kill()
            peer.wait()
        took.append({of["what"]: of["s"] for of in found})
        time.sleep(0.5)
    print("seconds until the other side was found again, and had a map:", took)
    assert max(of["matched"] for of in took) < DISCOVERED_S
    assert max(of["map"] for of in took) < DISCOVERED_S


def test_the_node_is_killed_and_comes_back(node):
    node.ready()
    node.must_map()
    took = []
    for _ in range(5):
        node.kill()
        time.sleep(0.5)
        while node.map.take_cdr():
            pass
        node.start()
        begun = time.monotonic()
        diagnostics = node.wait(lambda: node.poll(), 10.0)
        node.wait(lambda: node.count(RECEIVED) > 0, 10.0, node.send)
        cloud_came = time.monotonic() - begun
        node.wait(lambda: node.map.take_cdr(), 10.0, node.send)
        took.append((round(diagnostics, 3), round(cloud_came, 3), round(time.monotonic() - begun, 3)))
    print("seconds from the start of the program to its first diagnostics, its first cloud, its first map:", took)
    assert max(of[1] for of in took) < DISCOVERED_S


def test_qos_that_does_not_fit_is_said(node):
    node.ready()
    tf = Writer(node.participant, "/tf", "TFMessage", "best_effort,volatile,100")
    static = Writer(node.participant, "/tf_static", "TFMessage", "reliable,volatile,100")
    node.wait(lambda: tf.incompatible.count and static.incompatible.count)
    node.wait(lambda: re.search("(?i)qos|reliab|best.effort", node.log()))
    print("said:", [line for line in node.log().splitlines() if re.search("(?i)qos|reliab|durab|best.effort|transient", line)])
    node.wait(lambda: "/tf_static" in node.log())
    node.must_map()


def test_every_subscriber_is_served(node):
    """All that fits a reliable, transient local writer: what RViz, Nav2 and a script ask for."""
    node.ready()
    topic = f"{node.namespace}/flockmap/occupied_points_all"
    readers = [Reader(node.participant, topic, "PointCloud2", f"{reliability},{durability},5")
               for reliability in ("reliable", "best_effort") for durability in ("transient_local", "volatile")]
    got = [0] * len(readers)
    turn = [0]

    def send():
        turn[0] += 1
        node.send(wall(turn[0]))

    def all_have():
        for i, reader in enumerate(readers):
            got[i] += len(reader.take_cdr())
        return all(got)

    node.wait(all_have, 10.0, send)
    assert not any(reader.incompatible.count for reader in readers)


def test_no_tf(node):
    node.ready()
    for _ in range(5):
        node.send(pose=False)
        time.sleep(0.1)
    node.wait(lambda: node.count(NO_POSE) == 5)
    assert node.count(MAPPED) == 0
    print("says:", [v for k, v in node.poll().items() if k.endswith("says")])
    assert any("pose" in v and v[0] != "0" for k, v in node.poll().items() if k.endswith("says"))
    # A fixed sensor, said late.
    static = Writer(node.participant, "/tf_static", "TFMessage", "reliable,transient_local,1")
    static.write(transform(0, "map", "lidar"))
    before = node.count(MAPPED)
    node.wait(lambda: node.count(MAPPED) > before, 5.0, lambda: node.send(pose=False))


@pytest.mark.parametrize("node", [{"arguments": ("-p", "use_sim_time:=true")}], indirect=True)
def test_the_clock_jumps(node):
    clock = Writer(node.participant, "/clock", "Clock", "best_effort,volatile,1")
    at = 1_000_000_000 * 1_000_000_000

    def play(seconds: float) -> int:
        """As a player does: the time, and scans with it."""
        nonlocal at
        sent = 0
        for turn in range(int(seconds * 50)):
            clock.write(message("Clock", clock=time_message(at)))
            if turn % 5 == 4:
                node.send(wall(sent), stamp=at)
                sent += 1
            at += 20_000_000
            time.sleep(0.02)
            node.poll()
        return sent

    node.wait(lambda: node.poll() and node.points.matched(), 10.0, lambda: clock.write(message("Clock", clock=time_message(at))))
    for jump in (0, 3600, -7200, 0.3, -0.3):
        at += int(jump * 1e9)
        before, size = node.count(MAPPED), len(node.log())
        sent = play(3.0)
        time.sleep(0.8)
        mapped = node.count(MAPPED) - before
        print(f"jump of {jump} s: {mapped} of {sent} scans mapped; said: {node.log()[size:].strip()[:300]!r}")
        # Half of them at least: it goes on with the new time.
        assert mapped * 2 > sent
    # A map has the stamp of a scan of the new time.
    came = [node.map.decode(cdr) for cdr in node.map.take_cdr()]
    assert came and abs(came[-1].header.stamp.sec * 10**9 - at) < 10 * 10**9


def test_clouds_without_points_and_without_numbers(node):
    node.ready()
    node.must_map()
    damaged = node.count(DAMAGED)
    before = node.count(RECEIVED)
    node.send(np.zeros((0, 3)))
    node.wait(lambda: node.count(RECEIVED) > before)
    points = wall(0).copy()
    points[::2] = np.nan
    points[1::8] = np.inf
    none = int((~np.isfinite(points).all(axis=1)).sum())
    numbers, before = node.count(NO_NUMBERS), node.count(MAPPED)
    node.send(points)
    node.wait(lambda: node.count(MAPPED) > before)
    assert node.count(NO_NUMBERS) - numbers == none
    node.send(np.full((1000, 3), np.nan))
    time.sleep(0.5)
    assert node.count(DAMAGED) == damaged
    node.must_map()


def test_damaged_clouds(node):
    node.ready()
    node.must_map()
    before, received = node.count(DAMAGED), node.count(RECEIVED)

    def of(**changes):
        one = cloud(time.time_ns(), "lidar", wall(0))
        for name, value in changes.items():
            setattr(one, name, value)
        return one

    fields = of().fields
    bad = [of(data=np.zeros(7, np.uint8)), of(width=10**9), of(point_step=0), of(point_step=2**32 - 1), of(fields=fields[:2]),
           of(height=2**31, width=2**31), of(is_bigendian=True, width=10**6)]
    for one in bad:
        node.tf.write(transform(time.time_ns(), "map", "lidar"))
        node.points.write(one)
        time.sleep(0.1)
    node.must_map()
    print(f"{len(bad)} damaged clouds: {node.count(DAMAGED) - before} counted as such, of {node.count(RECEIVED) - received} received")
    assert node.count(DAMAGED) - before == len(bad)


def test_bytes_that_are_no_cloud(node):
    """Cyclone writes only what fits a type, so this is another type with the same name."""
    node.ready()
    node.must_map()
    lie = make_idl_struct("Lie", "sensor_msgs.msg.dds_.PointCloud2_", {"a": types.sequence[types.uint32], "b": str})
    other = DomainParticipant()
    writer = DataWriter(other, Topic(other, dds_name(f"{node.namespace}/points"), lie), qos("best_effort,volatile,5"))
    node.wait(lambda: writer.get_matched_subscriptions())

    def write():
        assert ddspy_write(writer._ref, lie(a=[7, 2**32 - 1, 3], b="no cloud").serialize().ljust(64, b"\0")) >= 0

    node.wait(lambda: node.count(DAMAGED) >= 5, then=write)
    node.must_map()
    print("damaged:", node.count(DAMAGED))


@pytest.mark.parametrize("points", [200_000, 500_000, 1_000_000, 2_000_000])
def test_large_clouds(node, points):
    node.ready()
    node.must_map()
    y, z = np.random.default_rng(1).uniform(-5, 5, (2, points))
    large = np.c_[np.full(points, 4.0), y, z]
    received, mapped, damaged = node.count(RECEIVED), node.count(MAPPED), node.count(DAMAGED)
    for _ in range(3):
        node.send(large)
        time.sleep(1.0)
    time.sleep(1.0)
    resident = re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{node.process.pid}/status").read_text()).group(1)
    print(f"3 clouds of {points} points, {large.size * 4 / 1e6:.1f} MB: {node.count(RECEIVED) - received} received, "
          f"{node.count(MAPPED) - mapped} mapped, {node.count(DAMAGED) - damaged} too large; most memory {resident} kB")
    # However that went, it goes on with others. Whether so large ones come through best effort is up to the system's buffers.
    node.must_map()
    if points <= 200_000:
        assert node.count(MAPPED) - mapped >= 4


RELIABLE = {"ros": "points_reliable = true", "points_qos": "reliable,volatile,5"}


@pytest.mark.parametrize("node", [RELIABLE, {**RELIABLE, "arguments": ["-p", "sensor.scan_points_max:=4000000"]}], indirect=True)
def test_two_million_points_arrive_where_clouds_are_reliable(node):
    """And are mapped, or counted as too large for the node's limit of 1,048,576 points."""
    node.ready()
    node.must_map()
    y, z = np.random.default_rng(1).uniform(-5, 5, (2, 2_000_000))
    large = np.c_[np.full(y.size, 4.0), y, z]
    counted = MAPPED if node.arguments else DAMAGED
    for _ in range(3):
        before = node.count(counted)
        node.send(large)
        took = node.wait(lambda: node.count(counted) > before, 20.0)
        print(f"a cloud of {large.size * 4 / 1e6:.1f} MB: {counted} after {took:.2f} s")
    node.must_map()
    if counted == DAMAGED:
        assert "the number of points in a scan" in node.log()


def pose_stamped(stamp: int, x: float):
    of = store.types
    pose = of["geometry_msgs/msg/Pose"](
        position=of["geometry_msgs/msg/Point"](x, 0.0, 0.0), orientation=of["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
    return message("PoseStamped", header=header(stamp, "map"), pose=pose)


def occupied_x(node) -> set[float]:
    """Where walls are in the newest map, along x."""
    came = node.map.take_cdr()
    return {round(float(x), 1) for x in floats(node.map.decode(came[-1]))[:, 0]} if came else set()


@pytest.mark.parametrize("node", [{"ros": 'poses = "odometry"'}], indirect=True)
def test_poses_by_odometry_and_tf_static(node):
    odometry = Writer(node.participant, f"{node.namespace}/odom", "Odometry", "best_effort,volatile,5")
    fixed = Writer(node.participant, "/tf_static", "TFMessage", "reliable,transient_local,1")
    fixed.write(transform(0, "base", "lidar", (0.5, 0.0, 0.0)))
    node.ready()
    of = store.types
    none = np.zeros(36)
    zero = of["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    seen: set[float] = set()

    def send():
        stamp = node.send(pose=False)
        twist = of["geometry_msgs/msg/TwistWithCovariance"](of["geometry_msgs/msg/Twist"](zero, zero), none)
        odometry.write(message("Odometry", header=header(stamp, "map"), child_frame_id="base", twist=twist,
                               pose=of["geometry_msgs/msg/PoseWithCovariance"](pose_stamped(stamp, 10.0).pose, none)))
        seen.update(occupied_x(node))

    node.wait(lambda: seen, 10.0, send)
    # The wall is 3 m before the sensor, this 0.5 m before the robot at 10 m; voxels have 0.2 m.
    assert seen <= {13.3, 13.5, 13.7}, seen


@pytest.mark.parametrize("node", [{"ros": "teammates = { 2 = '/robot2/pose' }\nalignments = { 2 = '/robot2/alignment' }"}], indirect=True)
def test_a_team_mate_is_no_obstacle_and_an_alignment_that_is_none_is_said(node):
    poses = Writer(node.participant, "/robot2/pose", "PoseStamped", "reliable,volatile,5")
    alignments = Writer(node.participant, "/robot2/alignment", "PoseStamped", "reliable,volatile,5")
    node.ready()
    node.wait(lambda: poses.matched() and alignments.matched())
    alignments.write(pose_stamped(time.time_ns(), float("nan")))
    node.wait(lambda: "the alignment of robot 2 is no pose" in node.log())
    alignments.write(pose_stamped(time.time_ns(), 5.0))
    # It stands in the middle of the wall, a little before it.
    mate, beside = (2.9, 0.0, 0.5), (3.1, -0.9, -0.4)
    for _ in range(5):
        poses.write(pose_stamped(time.time_ns(), mate[0]))
        time.sleep(0.1)
        node.send(np.array([(3.1, 0.0, 0.1), beside]))
        node.send(np.array([(3.1, 0.0, 0.1), beside]))
    node.wait(lambda: node.count(MAPPED) >= 10)
    time.sleep(0.5)
    points = floats(node.map.decode(node.map.take_cdr()[-1]))
    assert len(points) == 1 and np.abs(points[0][:3] - beside).max() <= 0.11, points


def test_parameters_alone_are_enough(tmp_path):
    (tmp_path / "robot.yaml").write_text("""
/**/flockmap:
  ros__parameters:
    id: 7
    name: by_yaml
    map: {resolution_m: 0.2, range_m: 10.0}
    state.path: state
    network.bind: "127.0.0.1:7702"
    output: {report_json: report.json, end_after_s: 1.0}
""")
    run = subprocess.run([FLOCKMAP_ROS, "--ros-args", "-r", "__ns:=/a", "--params-file", "robot.yaml"], cwd=tmp_path,
                         capture_output=True, text=True, timeout=30)
    print(run.stderr)
    assert run.returncode == 0 and json.loads((tmp_path / "report.json").read_text())["name"] == "by_yaml"
    wrong = subprocess.run([FLOCKMAP_ROS, "--ros-args", "--params-file", "robot.yaml", "-r", "__ns:=/a", "-p", "map.rang_m:=3.0"],
                           cwd=tmp_path, capture_output=True, text=True, timeout=30)
    assert wrong.returncode == 1 and "the parameters: `rang_m` is no key of [map], did you mean `range_m`?" in wrong.stderr, wrong.stderr


def test_a_bag_of_two_robots_with_namespaces(tmp_path):
    """A rosbag2 folder with both robots in it, each in its namespace; the node takes the second by a remapping."""
    records = [DATA / f"hku_mb/robot{n}.mcap" for n in (1, 2)]
    if not all(record.exists() for record in records):
        pytest.skip(f"no data in {DATA}")
    seconds, clouds = 10.0, 0
    with BagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {}
        for record in records:
            with BagReader(record) as reader:
                # Both at once, though they walked one after the other.
                start, first = None, 1_700_000_000 * 10**9
                for connection, at, cdr in reader.messages():
                    start = start or at
                    if at - start > seconds * 1e9:
                        break
                    key = connection.topic, connection.msgtype
                    if key not in connections:
                        connections[key] = bag.add_connection(*key, typestore=store)
                    clouds += connection.topic == "/robot2/points"
                    bag.write(connections[key], at - start + first, shifted(bytes(cdr), connection.msgtype, first - start))
    made = Node(tmp_path, "-r", "points:=/robot2/points", "-p", "use_sim_time:=true", namespace="/second")
    try:
        played = subprocess.run(
            [sys.executable, str(HERE / "play.py"), str(tmp_path / "bag"), "--clock", "--wait", "10", "--sent", str(tmp_path / "sent")],
            capture_output=True, text=True)
        assert played.returncode == 0, played.stderr
        made.wait(lambda: made.count(MAPPED) == clouds)
        found = [made.map.decode(cdr) for cdr in made.map.take_cdr()]
        print(f"{clouds} clouds of /robot2/points, all mapped; {len(floats(found[-1]))} occupied voxels")
    finally:
        made.kill()
