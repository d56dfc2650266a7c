"""Nodes in this process, and mirrors of their maps."""

import os
import signal
import socket
import struct
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest
from conftest import wall

import flockmap
from flockmap import Mirror, Node


def configuration(tmp_path, more: str = "", output: str = "") -> str:
    path = tmp_path / "node.toml"
    path.write_text(
        f"""id = 4
name = "alpha"
[map]
resolution_m = 0.1
range_m = 10.0
[state]
path = "{tmp_path}/state"
[network]
bind = "127.0.0.1:0"
[sensor]
listen_unix = "{tmp_path}/sensor.sock"
[map_output]
listen_unix = "{tmp_path}/map.sock"
listen_tcp = "127.0.0.1:0"
[metrics]
status_period_s = 0
[output]
linger_ms = 0
{output}
{more}
"""
    )
    return str(path)


def feed(node: Node, points: np.ndarray, position=(0.0, 0.0, 0.0)) -> None:
    """Sends a scan as docs/sensor-input.md says."""
    body = struct.pack("<4sBBH", b"FLKS", 1, 1, 0) + struct.pack("<q7dII", 0, *position, 0, 0, 0, 1, len(points), 0)
    body += points.astype("<f4").tobytes()
    with socket.socket(socket.AF_UNIX) as sensor:
        sensor.connect(node.sensor_address.removeprefix("unix:"))
        sensor.sendall(struct.pack("<I", len(body)) + body)


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.02)


def rows(voxels) -> np.ndarray:
    indices, states = voxels
    table = np.column_stack([indices, states])
    return table[np.lexsort(table.T)]


def test_a_node_maps_what_a_program_feeds_and_a_mirror_has_it(tmp_path):
    with Node(configuration(tmp_path), quiet=True) as node:
        assert node.name == "alpha" and len(node.map_addresses) == 2
        mirrors = [Mirror(address) for address in node.map_addresses]
        feed(node, wall(3.05))
        until(lambda: node.view().count()[1] > 0)
        view = node.view()
        for mirror in mirrors:
            assert mirror.wait(view.version - 1, timeout=60)
            shown = mirror.map()
            assert (shown.robot, shown.name, shown.is_complete) == (4, "alpha", True)
            assert np.array_equal(rows(shown.voxels()), rows(view.voxels())) and shown.count() == view.count()
            points = np.random.default_rng(1).uniform(-4, 4, (5000, 3))
            assert np.array_equal(mirror.states(points), view.states(points))
            assert np.allclose(shown.bounding_box(), view.bounding_box())
            until(lambda mirror=mirror: "node_frames" in mirror.counters and 4 in mirror.poses)
            mirror.close()
            with pytest.raises(flockmap.ClosedError):
                mirror.map()
        status = node.status()
        assert status["counters"]["node"]["frames"] == 1 and status["map_occupied"] == view.count()[1]
    with pytest.raises(flockmap.ClosedError, match="this node was closed"):
        node.view()
    assert shown.count() == view.count()


def test_a_mirror_waits_for_a_node_and_shows_the_map_until_the_next_node_has_one(tmp_path):
    with Mirror(f"unix:{tmp_path}/map.sock") as mirror:
        assert mirror.map() is None and mirror.states([[0.0, 0.0, 0.0]]).tolist() == [0]
        assert not mirror.wait(timeout=0.2) and not mirror.is_connected
        for x in (3.05, 4.05):
            with Node(configuration(tmp_path), quiet=True) as node:
                feed(node, wall(x))
                until(lambda: node.view().count()[1] > 0)
                expected = rows(node.view().voxels())
                until(lambda: mirror.map() and np.array_equal(rows(mirror.map().voxels()), expected))
            until(lambda: not mirror.is_connected)
            assert "end" in mirror.last_error or mirror.last_error
            assert np.array_equal(rows(mirror.map().voxels()), expected)
        assert mirror.connections == 2


def test_a_mirror_reads_a_node_again_that_sent_garbage():
    """A server that says nonsense to the first, and a map to the second."""
    from test_mirror_bytes import begin, blocks, hello

    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def serve():
            for data in (b"garbage garbage garbage", hello() + begin() + blocks(3, 3, ((0, 0, 0), 1, 0))):
                connection, _ = server.accept()
                with connection:
                    connection.recv(256)
                    connection.sendall(data)

        serving = threading.Thread(target=serve)
        serving.start()
        with Mirror(f"127.0.0.1:{port}") as mirror:
            assert mirror.wait(timeout=60) and mirror.version == 3
            assert mirror.connections >= 2
        serving.join(60)


def test_a_node_writes_its_map_when_it_is_stopped(tmp_path):
    node = Node(configuration(tmp_path, output='save_map_at_end = "map.bt"'), quiet=True)
    feed(node, wall(3.05))
    until(lambda: node.view().count()[1] > 0)
    expected = rows(node.view().voxels())
    assert not node.wait(timeout=0.1) and not node.has_ended()
    summary = node.stop()
    assert summary["name"] == "alpha" and summary["map_occupied"] > 0
    assert np.array_equal(rows(flockmap.MapView.load(tmp_path / "map.bt").voxels()), expected)
    with pytest.raises(flockmap.ClosedError):
        node.stop()


def test_ctrl_c_ends_a_node_cleanly(tmp_path):
    program = f"""
        import flockmap, signal
        # Also where the tests run in the background, where a shell has children ignore it.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            with flockmap.Node({configuration(tmp_path, output='save_map_at_end = "map.bt"')!r}, quiet=True) as node:
                print("started", flush=True)
                node.wait()
        except KeyboardInterrupt:
            print("interrupted", flush=True)
    """
    command = [sys.executable, "-c", textwrap.dedent(program)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "started\n"
        os.kill(process.pid, signal.SIGINT)
        try:
            assert process.communicate(timeout=60)[0] == "interrupted\n"
        finally:
            process.kill()
        assert process.returncode == 0
    assert (tmp_path / "map.bt").is_file()
