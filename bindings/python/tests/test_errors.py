"""What is wrong is said by an exception that names it; nothing has changed then."""

import numpy as np
import pytest
from conftest import wall

import flockmap
from flockmap import MapView, Mirror, Robot


@pytest.fixture
def robot():
    return Robot(1, resolution=0.1, range=7.0)


@pytest.mark.parametrize(
    ("points", "text"),
    [
        (np.zeros((4, 2)), r"points: an array of shape \(4, 2\), expected float32 or float64 numbers of shape \(N, 3\)"),
        (np.zeros(3), r"shape \(3,\)"),
        (np.zeros((2, 3, 1)), r"shape \(2, 3, 1\)"),
        (np.zeros((4, 3), np.int64), "array of int64"),
        (np.zeros((4, 3), ">f4"), "array of >f4"),
        (np.zeros((4, 3), complex), "array of complex128"),
        ("nothing", "points: .*expected numbers"),
        (None, "points"),
        ([[1, 2], [3]], "points: .*expected numbers"),
    ],
)
def test_points_of_a_wrong_shape_or_kind(robot, points, text):
    with pytest.raises(flockmap.Error, match=text):
        robot.insert_scan(points, np.eye(4), 0.0)
    assert robot.counters()["robot"]["scans"] == 0


def no_rotation(change):
    pose = np.eye(4)
    change(pose)
    return pose


@pytest.mark.parametrize(
    ("pose", "text"),
    [
        (np.eye(3), r"shape \(3, 3\), expected \(4, 4\)"),
        (np.full((4, 4), np.nan), "T_map_sensor has a number that is not finite"),
        (no_rotation(lambda pose: pose.__setitem__((0, 3), np.inf)), "not finite"),
        (2 * np.eye(4), "last row"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "no rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "no rotation.*no mirroring"),
        (np.eye(4).T + np.eye(4, k=-3), "last row"),
        (no_rotation(lambda pose: pose.__setitem__((0, 3), 1e300)), "beyond the grid, which at voxels of 0.1 m goes to"),
        (np.array([["x"] * 4] * 4), "expected float64 numbers"),
    ],
)
def test_poses_that_are_none(robot, pose, text):
    with pytest.raises(flockmap.Error, match=text):
        robot.insert_scan(wall(2.0), pose, 0.0)
    assert robot.view().version == 0


@pytest.mark.parametrize("stamp", [True, "now", None, float("nan"), float("inf"), 1e300, 1 << 70])
def test_stamps_that_are_none(robot, stamp):
    with pytest.raises(flockmap.Error, match="expected seconds as a float or nanoseconds as an int"):
        robot.handle_timeout(stamp)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"resolution": 0.0}, "resolution is 0.*expected the side of a voxel in metres, 0.001 to 100"),
        ({"resolution": float("nan")}, "resolution is NaN"),
        ({"range": -1.0}, "range_m"),
        ({"range": 1000.0}, "range_m"),
        ({"key": "secret"}, "key: a text of 6 characters, expected 64 hex digits"),
        ({"key": b"short"}, "key: 5 bytes, expected 32"),
        ({"codec": "zip"}, 'codec is "zip"'),
        ({"mapper": "none"}, 'unknown mapper "none"'),
        ({"publish_period": 0.0}, "publish_period is 0"),
        ({"budget": 10}, "budget|radio_bytes_per_s"),
    ],
)
def test_options_that_cannot_work(options, text):
    with pytest.raises(flockmap.ConfigError, match=text):
        Robot(1, **{"resolution": 0.1, "range": 7.0, **options})


def test_a_configuration_names_its_line():
    with pytest.raises(flockmap.ConfigError, match="line 3.*range_mm"):
        Robot.from_toml("id = 1\n[map]\nrange_mm = 2\nresolution_m = 0.1\nrange_m = 3.0\n")
    with pytest.raises(flockmap.ConfigError, match="cannot read .*nowhere.toml"):
        Robot.from_toml("nowhere.toml")
    with pytest.raises(flockmap.ConfigError, match="expected the path of a TOML file"):
        Robot.from_toml(7)


def test_datagrams_that_are_none(robot):
    for data in (b"", b"x" * 40, bytes(2000)):
        with pytest.raises(flockmap.DatagramError, match="datagram"):
            robot.handle_datagram(1.0, data)
    with pytest.raises(TypeError):
        robot.handle_datagram(1.0, "text")


def test_a_robot_after_its_end(robot):
    transmits = robot.transmits(0.0)
    with robot:
        pass
    robot.close()
    for call in (robot.view, robot.events, robot.poll_timeout, robot.counters, robot.poses):
        with pytest.raises(flockmap.ClosedError, match="this robot was closed: make a new one"):
            call()
    with pytest.raises(flockmap.ClosedError):
        next(transmits)
    with pytest.raises(flockmap.ClosedError):
        robot.insert_scan(wall(2.0), np.eye(4), 0.0)


def test_states_that_are_none(robot):
    with pytest.raises(flockmap.Error, match="a state of 3, expected 0 for Unknown"):
        robot.insert_states([[0, 0, 0]], [3], 0.0)
    with pytest.raises(flockmap.Error, match=r"shape \[2\], expected \[1\]"):
        robot.insert_states([[0, 0, 0]], [1, 1], 0.0)
    with pytest.raises(flockmap.Error, match="array of float64, expected whole numbers"):
        robot.insert_states([[0.5, 0, 0]], [1], 0.0)
    with pytest.raises(flockmap.Error, match="beyond the grid"):
        robot.insert_states([[2**30, 0, 0]], [1], 0.0)
    with pytest.raises(flockmap.Error, match="an index of 1099511627776"):
        robot.insert_states([[2**40, 0, 0]], [1], 0.0)
    with pytest.raises(flockmap.Error, match="voxels of 0.2 m, expected 0.1 m"):
        robot.insert_states([[0, 0, 0]], [1], 0.0, resolution=0.2)
    with pytest.raises(flockmap.Error, match="at least 1 voxel each"):
        robot.insert_box([0, 0, 0], np.zeros((2, 0, 2), int), 0.0)
    with pytest.raises(flockmap.Error, match="at least 1 voxel each"):
        robot.insert_box([0, 0, 0], np.zeros((2, 2), int), 0.0)
    assert robot.view().version == 0


def test_boxes_that_are_none(random_map):
    view = MapView.from_voxels(0.1, *random_map)
    for box in (((0, 0, 0), (1, 1, 0)), ((0, 0, 0), (np.nan, 1, 1)), ((0, 0, 0),), 7, ((0, 0), (1, 1)), "ab"):
        with pytest.raises(flockmap.Error, match="box"):
            view.voxels(box)
    with pytest.raises(flockmap.Error, match="ask for a smaller box"):
        view.distance_field(((-1e4, -1e4, -1e4), (1e4, 1e4, 1e4)))
    with pytest.raises(flockmap.Error, match="memory_max allows 100"):
        view.distance_field(((0, 0, 0), (1, 1, 1)), memory_max=100)
    with pytest.raises(flockmap.Error, match="take a smaller part of the map"):
        view.occupancy_grid(0.0, 1.0, ((-1e4, -1e4), (1e4, 1e4)))
    with pytest.raises(flockmap.Error, match="nothing of the map is known"):
        MapView.from_voxels(0.1, [], []).height_map()
    with pytest.raises(flockmap.Error, match='obstacles is "all"'):
        view.collision("all")
    with pytest.raises(flockmap.Error, match="not finite, negative"):
        view.collision().sphere([0, 0, 0], -1.0)
    with pytest.raises(flockmap.Error, match="a has 2 points and b has 3"):
        view.cast_rays(np.zeros((2, 3)), np.zeros((3, 3)))


def test_files_that_are_none(tmp_path, random_map):
    with pytest.raises(flockmap.FileError, match="nowhere.mcap"):
        flockmap.open_mcap(tmp_path / "nowhere.mcap")
    (tmp_path / "damaged.mcap").write_bytes(b"no record")
    with pytest.raises(flockmap.FileError, match="damaged.mcap"):
        flockmap.open_record(tmp_path / "damaged.mcap")
    (tmp_path / "damaged.bt").write_bytes(b"no map")
    with pytest.raises(flockmap.FileError, match="damaged.bt"):
        MapView.load(tmp_path / "damaged.bt")
    view = MapView.from_voxels(0.1, *random_map)
    with pytest.raises(flockmap.FileError, match="nowhere"):
        view.save(tmp_path / "nowhere" / "map.ply")
    with pytest.raises(flockmap.FileError, match=".ply, .pcd or .bt can be written"):
        view.save(tmp_path / "map.txt")
    with pytest.raises(flockmap.FileError, match=".pgm or .png"):
        view.occupancy_grid(0.0, 1.0).save(tmp_path / "map.jpg")


def test_a_node_that_cannot_start(tmp_path):
    with pytest.raises(flockmap.ConfigError, match="cannot read .*nowhere.toml"):
        flockmap.Node(tmp_path / "nowhere.toml")
    (tmp_path / "node.toml").write_text("id = 1\n[map]\nresolution_m = 0.1\nrange_m = 7.0\n[sensor]\nrecord = 'no.mcap'\n")
    with pytest.raises(flockmap.ConfigError, match="no.mcap"):
        flockmap.Node(tmp_path / "node.toml", quiet=True)


def test_an_address_that_is_none():
    for address in ("here", "127.0.0.1:", ":80", "127.0.0.1:port", "127.0.0.1:70000"):
        with pytest.raises(flockmap.Error, match='expected "unix:PATH" or "HOST:PORT"'):
            Mirror(address)
