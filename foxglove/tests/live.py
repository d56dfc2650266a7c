#!/usr/bin/env python3
"""Two nodes fly, flockmap-foxglove follows one of them, and a WebSocket client of another author takes what it serves.

Every message of every topic is decoded with the schema that the server advertises, by Foxglove's readers. Point clouds
are made once more with Foxglove's SDK and must have the same bytes. The last picture must have the voxels of the map
that the node saves. Exit: 0 all as it should be, 1 not.

usage: live.py FLOCKMAP FLOCKMAP_FOXGLOVE RECORD1 RECORD2 FOLDER    environment: SPEED=1, of the records
"""

import asyncio
import base64
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import websockets
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory as Protobuf
from mcap_ros2.decoder import DecoderFactory as Ros2

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
from flight import remade  # noqa: E402

SPEED = float(os.environ.get("SPEED", "1"))
RESOLUTION = 0.2
PORT = 20_000 + os.getpid() % 120 * 100
URL = f"ws://127.0.0.1:{PORT + 9}"
TOPICS = {
    "/robot1/viewer/map": "foxglove.PointCloud",
    "/robot1/viewer/paths": "foxglove.PointCloud",
    "/robot1/viewer/scan": "foxglove.PointCloud",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/robot1/counters": "flockmap.Counters",
    "/robot1/links/robot2": "flockmap.Link",
}
faults = []


def expect(is_right: bool, what: str) -> None:
    print(f"{'ok   ' if is_right else 'FAULT'}: {what}", flush=True)
    if not is_right:
        faults.append(what)


class App:
    """Subscribes to all topics and decodes all that comes."""

    def __init__(self) -> None:
        self.decoders, self.topics, self.schemas = {}, {}, {}
        self.counts, self.bytes, self.last, self.frames = Counter(), Counter(), {}, set()
        self.map_times = []
        self.has_connected, self.is_closed = asyncio.Event(), False

    async def run(self) -> None:
        async with websockets.connect(URL, subprotocols=["foxglove.sdk.v1"], max_size=64 << 20) as socket:
            self.has_connected.set()
            try:
                async for message in socket:
                    await self.take(socket, message)
            except websockets.ConnectionClosed:
                pass
        self.is_closed = True

    async def take(self, socket, message) -> None:
        if isinstance(message, str):
            message = json.loads(message)
            if message["op"] == "advertise":
                for channel in message["channels"]:
                    self.add(channel)
                wanted = [{"id": c["id"], "channelId": c["id"]} for c in message["channels"]]
                await socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            return
        # 1: a message of a subscription, its id (u32), nanoseconds (u64), and its bytes.
        if message[0] != 1:
            return
        channel, stamp = int.from_bytes(message[1:5], "little"), int.from_bytes(message[5:13], "little")
        topic, data = self.topics[channel], message[13:]
        decoded = self.decoders[channel](data)
        self.counts[topic] += 1
        self.bytes[topic] += len(data)
        self.last[topic] = decoded
        if abs(stamp / 1e9 - time.time()) > 60:
            faults.append(f"{topic}: a time that is not now")
        if self.schemas[topic] == "foxglove.PointCloud" and remade(decoded) != data:
            faults.append(f"{topic}: Foxglove's SDK writes this cloud in other bytes")
        if topic == "/tf":
            self.frames |= {t.child_frame_id for t in decoded.transforms}
        if topic.endswith("/viewer/map"):
            # Of the server: what this client does with a picture takes a while too.
            self.map_times.append(stamp / 1e9)

    def add(self, channel) -> None:
        data = channel["schema"]
        data = data.encode() if channel["schemaEncoding"] == "ros2msg" else base64.b64decode(data)
        schema = Schema(id=channel["id"], data=data, encoding=channel["schemaEncoding"], name=channel["schemaName"])
        factory = Ros2() if channel["encoding"] == "cdr" else Protobuf()
        self.decoders[channel["id"]] = factory.decoder_for(channel["encoding"], schema)
        self.topics[channel["id"]], self.schemas[channel["topic"]] = channel["topic"], channel["schemaName"]

    def points(self):
        return np.frombuffer(self.last["/robot1/viewer/map"].data, dtype=[("at", "<f4", 3), ("colour", "u1", 4)])


def configuration(folder: Path, number: int, record: str) -> Path:
    path = folder / f"{number}.toml"
    path.write_text(f"""
id = {number}
[map]
resolution_m = {RESOLUTION}
range_m = 30
[state]
path = "state"
[network]
bind = "127.0.0.1:{PORT + number}"
peers = ["127.0.0.1:{PORT + 3 - number}"]
[sensor]
record = "{record}"
speed = {SPEED}
[map_output]
listen_tcp = "127.0.0.1:{PORT + 10 + number}"
[output]
save_map_at_end = "{number}.ply"
end_when_quiet_s = 4
""")
    return path


def voxels_of(points: np.ndarray) -> np.ndarray:
    return np.unique(np.floor(points / RESOLUTION).astype(int), axis=0)


def voxels_of_ply(path: Path) -> np.ndarray:
    """The middles of voxels in a binary PLY of floats, as the node saves it."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names, count = [], 0
    for line in head.decode().splitlines():
        words = line.split()
        if words[:2] == ["element", "vertex"]:
            count = int(words[2])
        elif words[:1] == ["property"]:
            names.append((words[2], {"float": "<f4", "double": "<f8", "uchar": "u1"}[words[1]]))
    points = np.frombuffer(body, dtype=names, count=count)
    return voxels_of(np.stack([points[axis] for axis in "xyz"], axis=1))


async def until(condition, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        await asyncio.sleep(0.05)
    return bool(condition())


def status_of(process, key: str) -> int:
    for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
        if line.startswith(key):
            return int(line.split()[1])
    return 0


async def main(flockmap: str, program: str, record1: str, record2: str, folder: Path) -> None:
    processes = []

    def start(*command: str, log: str):
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=(folder / log).open("a")
        )
        processes.append(process)
        return process

    def said(log: str) -> str:
        return (folder / log).read_text()

    try:
        server = start(
            program, f"127.0.0.1:{PORT + 11}", "--listen", f"127.0.0.1:{PORT + 9}", "--origins", "--scans", log="server.log"
        )
        heard = await until(lambda: "[map_output]" in said("server.log"), 5)
        expect(heard, "without a node it says what is missing, and goes on trying")
        expect(said("server.log").count("[map_output]") == 1, "and says so once")
        taken = subprocess.run([program, "127.0.0.1:1", "--listen", f"127.0.0.1:{PORT + 9}"], capture_output=True, text=True)
        expect(taken.returncode == 1 and "another port" in taken.stderr, "a port that is taken is told with what helps")

        app = App()
        running = asyncio.create_task(app.run())
        await app.has_connected.wait()
        first = configuration(folder, 1, record1)
        nodes = [start(flockmap, "node", "--config", str(first), log="1.log")]
        nodes.append(start(flockmap, "node", "--config", str(configuration(folder, 2, record2)), log="2.log"))
        expect(await until(lambda: nodes[0].poll() is not None, 600), "the node has ended")
        await asyncio.sleep(3)
        for topic in sorted(app.counts):
            print(f"  {topic}: {app.counts[topic]} x {app.schemas[topic]}, {app.bytes[topic]} bytes")
        print(f"  frames of tf: {', '.join(sorted(app.frames))}")
        print(f"  memory of flockmap-foxglove: {status_of(server, 'VmHWM')} kB at the most")
        expect({t: s for t, s in app.schemas.items() if t in app.counts} == TOPICS, "every topic came and was decoded")
        expect(app.frames == {"robot1", "robot1/robot2"}, "both robots are frames")
        expect(app.last["/robot1/counters"].node_frames > 0, "scans are counted")
        gaps = np.diff(app.map_times)
        expect(len(gaps) > 3 and gaps.min() > 0.99, f"{len(gaps) + 1} pictures, {gaps.min():.2f} s apart or more")
        saved = voxels_of_ply(folder / "1.ply")
        shown = voxels_of(app.points()["at"])
        expect(
            len(app.points()) == len(saved) and np.array_equal(saved, shown),
            f"the last picture has the {len(saved)} occupied voxels of the map that the node saved",
        )
        expect(len(np.unique(app.points()["colour"], axis=0)) > 10, "in many colours")

        # Who comes later sees a map that does not change any more.
        late = App()
        late_running = asyncio.create_task(late.run())
        came = await until(lambda: "/robot1/viewer/map" in late.last, 5)
        expect(came and len(late.points()) == len(saved), "an app that comes late has the whole map")

        # What is no protocol ends at most the connection that sent it.
        async with websockets.connect(URL, subprotocols=["foxglove.sdk.v1"]) as socket:
            for bad in ["", "no JSON", '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99}]}', b"", b"\x01", b"\xff" * 4000]:
                await socket.send(bad)
            await asyncio.sleep(0.5)
        expect(server.poll() is None, "garbage of an app does nothing")
        crowd = [await websockets.connect(URL, subprotocols=["foxglove.sdk.v1"]) for _ in range(4)]
        expect(await until(lambda: "more than 4 apps" in said("server.log"), 5), "a fifth app is told on standard error")
        for socket in crowd:
            await socket.close()

        # The node comes back, with the map that it had.
        before = app.counts["/robot1/counters"]
        start(flockmap, "node", "--config", str(first), log="1.log")
        expect(await until(lambda: app.counts["/robot1/counters"] > before, 30), "a node that comes back is followed again")
        server.send_signal(signal.SIGINT)
        expect(await until(lambda: server.poll() is not None, 5) and server.returncode == 0, "Ctrl-C ends it well")
        expect(await until(lambda: app.is_closed and late.is_closed, 5), "and the apps are told")
        await asyncio.gather(running, late_running)
    finally:
        for process in processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    if len(sys.argv) != 6:
        sys.exit(__doc__)
    asyncio.run(main(*sys.argv[1:5], Path(sys.argv[5])))
    for fault in faults:
        print(f"FAULT: {fault}")
    sys.exit(1 if faults else 0)
