"""Two nodes play a recorded walk of two robots over a radio that loses 20 %. Mirrors in Python, one over a thin reading, one that
comes back after it was closed, equal what the node saves at its end, voxel by voxel.

Needs the program (FLOCKMAP) and the recordings (FLOCKMAP_DATA); `scripts/mirrors.sh` does the same with the mirror in Rust.
"""

import socket
import subprocess
import time

import numpy as np

import flockmap
from flockmap import Mirror


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def two_free_ports_in_a_row() -> int:
    """The first of two: `flockmap radio` takes one for each node from a port on, after its own."""
    while True:
        first = free_port()
        try:
            for port in range(first, first + 3):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
                    one.bind(("127.0.0.1", port))
        except OSError:
            continue
        return first


def rows(voxels):
    indices, states = voxels
    table = np.column_stack([indices, states])
    return table[np.lexsort(table.T)]


def test_mirrors_equal_the_map_that_the_node_saves(program, recordings, tmp_path):
    radio_port, node_ports, tcp = two_free_ports_in_a_row(), [free_port(), free_port()], free_port(socket.SOCK_STREAM)
    for n in (1, 2):
        output = f'[map_output]\nlisten_unix = "map.sock"\nlisten_tcp = "127.0.0.1:{tcp}"\n' if n == 1 else ""
        (tmp_path / f"{n}.toml").write_text(
            f"""id = {n}
[map]
resolution_m = 0.2
range_m = 30.0
[state]
path = "state"
[network]
bind = "127.0.0.1:{node_ports[n - 1]}"
peers = ["127.0.0.1:{radio_port + 3 - n}"]
[sensor]
record = "{recordings / "hku_mb" / f"robot{n}.mcap"}"
speed = 4.0
{output}
[metrics]
status_period_s = 0
[output]
save_map_at_end = "{n}.ply"
save_free = true
report_json = "{n}.json"
end_when_quiet_s = 8
"""
        )
    radio = [program, "radio", *[f"127.0.0.1:{port}" for port in node_ports], "--listen", f"127.0.0.1:{radio_port}", "--loss", "0.2"]
    running = []
    try:
        with open(tmp_path / "log", "wb") as log:
            for command in (radio, *[[program, "node", "--config", str(tmp_path / f"{n}.toml")] for n in (1, 2)]):
                running.append(
                    subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
                )
        mirrors = [Mirror(f"unix:{tmp_path}/map.sock"), Mirror(f"127.0.0.1:{tcp}", receive_buffer=4096)]
        comes_back = Mirror(f"unix:{tmp_path}/map.sock")
        assert comes_back.wait(100, complete=False, timeout=60), comes_back.last_error
        comes_back.close()
        mirrors.append(Mirror(f"unix:{tmp_path}/map.sock"))
        # What a reader sees while the map grows never goes back.
        versions = []
        end = time.monotonic() + 400
        while running[1].poll() is None:
            assert time.monotonic() < end, "the node does not end"
            versions.append(mirrors[0].version)
            time.sleep(0.2)
        assert versions == sorted(versions) and len(set(versions)) > 5
        assert running[1].returncode == 0, (tmp_path / "log").read_text()[-2000:]
        saved = flockmap.MapView.load(tmp_path / "1.ply")
        expected = rows(saved.voxels())
        assert len(expected) > 100_000
        for mirror in mirrors:
            while mirror.is_connected and time.monotonic() < end:
                time.sleep(0.05)
            shown = mirror.map()
            assert shown.is_complete and shown.robot == 1
            assert np.array_equal(rows(shown.voxels()), expected)
            low, high = shown.bounding_box()
            points = np.random.default_rng(1).uniform(low, high, (200_000, 3))
            assert np.array_equal(shown.states(points), saved.states(points))
            print(f"{len(expected)} voxels equal, {mirror.bytes_received} bytes, {mirror.connections} connections")
            mirror.close()
    finally:
        for process in running:
            process.kill()
            process.wait()
