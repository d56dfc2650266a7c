"""Robots exchange maps; scans and states come in as arrays of any kind."""

import numpy as np
import pytest
from conftest import wall

import flockmap
from flockmap import Robot


def same_map(a: flockmap.MapView, b: flockmap.MapView) -> bool:
    def of(view):
        indices, states = view.voxels()
        rows = np.column_stack([indices, states])
        return rows[np.lexsort(rows.T)]

    return np.array_equal(of(a), of(b))


def drive(robots: list[Robot], start: float, seconds: float, loss: float = 0.0, seed: int = 0) -> None:
    """Lets time pass for robots whose radio loses a part of the datagrams."""
    random = np.random.default_rng(seed)
    for step in range(round(seconds * 100)):
        now = start + step / 100
        for robot in robots:
            robot.handle_timeout(now)
        for robot in robots:
            for to, data in robot.transmits(now):
                for other in robots:
                    if other is not robot and to in (None, other.id) and random.random() >= loss:
                        other.handle_datagram(now, data)


def test_two_robots_have_the_same_map_over_a_radio_that_loses_a_third():
    alice, bob = (Robot(id, resolution=0.1, range=7.0, epoch=5) for id in (1, 2))
    alice.insert_scan(wall(2.05), np.eye(4), 0.1)
    turned = np.array([[0, -1, 0, 1.0], [1, 0, 0, 0.5], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    bob.insert_scan(wall(3.05, seed=2), turned, 0.1)
    drive([alice, bob], 0.1, 12, loss=0.33)
    assert alice.view().count()[1] > 1000
    assert same_map(alice.view(), bob.view())
    assert alice.peers()[2]["hears_us"]
    assert alice.counters()["robot"]["scans"] == 1
    kinds = {event.kind for event in bob.events()}
    assert {"batch-closed", "merged", "peer-seen"} <= kinds
    assert bob.poses()[1]["T_map_sensor"] is None
    assert np.allclose(bob.poses()[2]["T_map_sensor"], turned)


def test_a_key_keeps_others_out():
    key = bytes(range(32))
    alice = Robot(1, resolution=0.1, range=7.0, key=key)
    bob = Robot(2, resolution=0.1, range=7.0, key=key.hex())
    eve = Robot(3, resolution=0.1, range=7.0)
    alice.insert_scan(wall(2.05), np.eye(4), 0.1)
    refused = 0
    for step in range(600):
        now = 0.1 + step / 100
        for robot, other in ((alice, bob), (bob, alice)):
            robot.handle_timeout(now)
            for _, data in robot.transmits(now):
                other.handle_datagram(now, data)
                try:
                    eve.handle_datagram(now, data)
                except flockmap.DatagramError:
                    refused += 1
    assert same_map(alice.view(), bob.view())
    assert refused and eve.view().count() == (0, 0)


@pytest.mark.parametrize(
    "give",
    [
        lambda points: points,
        lambda points: points.astype(np.float32),
        lambda points: np.asfortranarray(points),
        lambda points: np.repeat(points, 2, axis=0)[::2],
        lambda points: points[::-1][::-1],
        lambda points: np.column_stack([points, np.zeros(len(points))])[:, :3],
        lambda points: points.astype(np.float32)[:, [2, 1, 0]][:, ::-1],
        lambda points: points.tolist(),
        lambda points: np.frombuffer(b"\0" + points.tobytes(), np.uint8)[1:].view(np.float64).reshape(-1, 3),
    ],
    ids=["f64", "f32", "fortran", "strided", "reversed twice", "columns", "negative stride", "list", "unaligned"],
)
def test_points_of_every_layout_make_the_same_map(give):
    points = wall(2.05).astype(np.float32).astype(np.float64)
    expected = Robot(1, resolution=0.1, range=7.0)
    expected.insert_scan(points, np.eye(4), 0.0)
    robot = Robot(1, resolution=0.1, range=7.0)
    report = robot.insert_scan(give(points), np.eye(4), 0.0)
    assert report.hits > 1000 and report.ignored == 0
    assert same_map(robot.view(), expected.view())


def test_no_returns_carve_free_space():
    robot = Robot(1, resolution=0.1, range=5.0)
    report = robot.insert_scan(np.zeros((0, 3)), np.eye(4), 0.0, no_returns=[[10.0, 0.0, 0.0]])
    assert (report.hits, report.cut) == (0, 1)
    assert robot.view().states([[3.05, 0.05, 0.05]]) == [flockmap.FREE]


def test_points_that_are_no_number_are_ignored_and_counted():
    robot = Robot(1, resolution=0.1, range=7.0)
    report = robot.insert_scan([[np.nan, 0, 0], [np.inf, 0, 0], [1.0, 0, 0]], np.eye(4), 0.0)
    assert (report.hits, report.ignored) == (1, 2)


def test_stamps_are_seconds_or_nanoseconds():
    robot = Robot(1, resolution=0.1, range=7.0)
    assert robot.insert_scan(wall(2.05), np.eye(4), 1.5).stamp == 1.5
    assert robot.insert_scan(wall(2.05), np.eye(4), 2_500_000_000).stamp == 2.5
    assert robot.insert_scan(wall(2.05), np.eye(4), np.int64(3_500_000_000)).stamp == 3.5


def test_states_of_a_mapper_elsewhere_are_the_map():
    robot = Robot(1, resolution=0.1, range=7.0)
    robot.insert_states([[20, 0, 0], [19, 0, 0]], [2, 1], 0.1, sensor=[0.05] * 3, resolution=0.1)
    box = np.zeros((3, 2, 1), np.uint8)
    box[:, 0, 0], box[1, 1, 0] = [1, 1, 2], 2
    report = robot.insert_box([18, 0, 0], box, 0.2)
    assert report.changed == 2
    view = robot.view()
    at = (np.array([[18, 0, 0], [19, 0, 0], [20, 0, 0], [19, 1, 0], [18, 1, 0]]) + 0.5) * 0.1
    assert view.states(at).tolist() == [1, 1, 2, 2, 0]


def test_a_robot_of_a_configuration(tmp_path):
    text = "id = 7\n[map]\nresolution_m = 0.2\nrange_m = 9.0\n[alignment.3]\ntranslation_m = [1.0, 0.0, 0.0]\n"
    (tmp_path / "robot.toml").write_text(text)
    for config in (text, tmp_path / "robot.toml", str(tmp_path / "robot.toml")):
        robot = Robot.from_toml(config)
        assert (robot.id, robot.resolution) == (7, 0.2)


def test_a_view_outlives_its_robot_and_does_not_change():
    robot = Robot(1, resolution=0.1, range=7.0)
    robot.insert_scan(wall(2.05), np.eye(4), 0.0)
    view = robot.view()
    count, version = view.count(), view.version
    robot.insert_scan(wall(3.05), np.eye(4), 1.0)
    newer = robot.view()
    assert newer.version > version and view.count() == count
    assert len(newer.changed_since(version)) > 0
    robot.close()
    del robot
    assert view.count() == count and newer.count() != count


def test_submaps_move_what_was_seen_in_them_on_every_robot():
    alice, bob = (Robot(id, resolution=0.1, range=7.0) for id in (1, 2))
    alice.insert_scan(wall(2.05), np.eye(4), 0.1)
    drive([alice, bob], 0.1, 3)
    before = bob.view().occupied_points()[:, 0].min()
    assert alice.begin_submap(3.0) == alice.submap == 1
    pose = np.eye(4)
    pose[:3, 3] = [0.5, 0.0, 0.0]
    alice.set_submap_pose(0, pose, 3.0)
    drive([alice, bob], 3.0, 5)
    for robot in (alice, bob):
        assert robot.view().occupied_points()[:, 0].min() == pytest.approx(before + 0.5)
    assert np.allclose(alice.submap_pose(0), pose) and np.allclose(alice.submap_pose(1), np.eye(4))
    with pytest.raises(flockmap.PoseError, match="submap 2 has not begun"):
        alice.set_submap_pose(2, pose, 5.0)
    with pytest.raises(flockmap.PoseError, match="expected 0 to 4095"):
        alice.set_submap_pose(4096, pose, 5.0)


def test_alignment_moves_what_others_saw():
    alice, bob = (Robot(id, resolution=0.1, range=7.0) for id in (1, 2))
    alice.insert_scan(wall(2.05), np.eye(4), 0.1)
    pose = np.eye(4)
    pose[:3, 3] = [1.0, 0.0, 0.0]
    bob.set_alignment(1, pose)
    drive([alice, bob], 0.1, 5)
    moved = bob.view().occupied_points()
    assert moved[:, 0].min() == pytest.approx(alice.view().occupied_points()[:, 0].min() + 1.0)
    # It comes into force a part with each call, and is due until it has.
    bob.set_muted(1, True)
    assert bob.poll_timeout() <= 6.0
    bob.handle_timeout(6.0)
    assert bob.view().count() == (0, 0)
