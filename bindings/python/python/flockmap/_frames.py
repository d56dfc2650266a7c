"""The frames of a node's map output: `docs/map-output.md`, "Frames". What is wrong with them is a :class:`MirrorError`."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._flockmap import Error

FRAME_BYTES_MAX = 1 << 20
INDEX_MAX = 33_554_432
MAGIC = b"FLKM"
VERSION = 1
HAS_ORIGINS, GOES_ON = 1, 2
WANTS_SUBMAPS = 16
RUNS_MAX, SUBMAP_POSES_MAX, SUBMAPS_MAX = 1_024, 8_192, 4_096


class MirrorError(Error):
    """What came from a node is no map output, or asks for more than a mirror may hold."""


@dataclass(frozen=True)
class Hello:
    """Who gives the map."""

    goes_on: bool
    robot: int
    micrometres: int
    feed: int
    name: str
    map_frame: str


@dataclass(frozen=True)
class BeginAnew:
    """The reader has nothing of the map."""

    version: int


@dataclass(frozen=True)
class Blocks:
    """Blocks as they are now."""

    upto: int
    newest: int
    stamp: float
    index: NDArray[np.int32]
    #: (N, 2, 8): Free and Occupied.
    planes: NDArray[np.uint64]


@dataclass(frozen=True)
class RobotPose:
    """Where the sensor of a robot was, in the frame of the map."""

    epoch: int
    #: x, y, z in metres.
    position: tuple[float, float, float]
    #: x, y, z, w; None: not known.
    quaternion: tuple[float, float, float, float] | None
    #: How long before the frame was made that was, in seconds.
    age: float


@dataclass(frozen=True)
class Poses:
    """All robots that are known, by id."""

    robots: dict[int, RobotPose] = field(default_factory=dict)


@dataclass(frozen=True)
class Counters:
    """What the node counted, by name, at a time in seconds on its clock."""

    time: float
    counters: dict[str, int]


@dataclass(frozen=True)
class RunSubmaps:
    """The submaps of one run of a robot, 0 to `newest`, and how they lie in the map of the node."""

    robot: int
    epoch: int
    #: The newest that is known to have begun.
    newest: int
    #: Poses of older submaps for which there was no room.
    left_out: int
    #: (N,) uint16, ascending: those that do not lie as the one before them.
    submaps: NDArray[np.uint16]
    #: (N, 4, 4): T_own_submap of each, metres.
    poses: NDArray[np.float64]

    def pose(self, submap: int) -> NDArray[np.float64] | None:
        """T_own_submap (4, 4) of a submap. None: it has not begun, or its pose was left out."""
        at = int(np.searchsorted(self.submaps, submap, "right")) - 1
        return self.poses[at] if at >= 0 and submap <= self.newest else None


@dataclass(frozen=True)
class Submaps:
    """All runs that are known."""

    runs: tuple[RunSubmaps, ...]


@dataclass(frozen=True)
class End:
    """The last frame."""

    why: str


Frame = Hello | BeginAnew | Blocks | Poses | Counters | Submaps | End


def hello(feed: int, began: int, upto: int, *, submaps: bool = False) -> bytes:
    """What the reader sends: the feed from which it has something (0: none), the version at which that began anew, and that
    upto which it has all. It wants no origins."""
    flags = WANTS_SUBMAPS if submaps else 0
    body = struct.pack("<B4sBBQQQ", 1, MAGIC, VERSION, flags, feed, began, upto)
    return struct.pack("<I", len(body)) + body


class Splitter:
    """Cuts a stream of bytes into frames, wherever it was cut before. Holds what has come of one frame, and one reading."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def push(self, data: bytes) -> list[tuple[int, bytes]]:
        """Kind and body of each frame that is there as a whole now."""
        self._buffer += data
        frames, at = [], 0
        while len(self._buffer) - at >= 4:
            (length,) = struct.unpack_from("<I", self._buffer, at)
            if not 1 <= length <= FRAME_BYTES_MAX:
                raise MirrorError(f"a frame of {length} bytes, expected 1 to {FRAME_BYTES_MAX}: this is no map output")
            if len(self._buffer) - at - 4 < length:
                break
            body = bytes(self._buffer[at + 4 : at + 4 + length])
            frames.append((body[0], body[1:]))
            at += 4 + length
        del self._buffer[:at]
        return frames


def parse(kind: int, body: bytes) -> Frame | None:
    """A frame; None if it is of a kind that is not known here."""
    parsers: dict[int, Callable[[_Reader], Frame]] = {
        1: _hello,
        2: _blocks,
        3: _begin_anew,
        4: _poses,
        5: _counters,
        6: _end,
        10: _submaps,
    }
    return parsers[kind](_Reader(body)) if kind in parsers else None


class _Reader:
    """Takes values from the front of a body. What lies behind them is ignored."""

    def __init__(self, body: bytes) -> None:
        self.body, self.at = body, 0

    def take(self, form: str, what: str) -> tuple[Any, ...]:
        form = "<" + form
        end = self.at + struct.calcsize(form)
        if end > len(self.body):
            raise MirrorError(f"{what}: the frame ends at byte {len(self.body)}, expected {end} at least")
        values = struct.unpack_from(form, self.body, self.at)
        self.at = end
        return values

    def text(self, length: int, what: str) -> str:
        (data,) = self.take(f"{length}s", what)
        try:
            return str(data, "utf-8")
        except UnicodeDecodeError as error:
            raise MirrorError(f"{what} is no UTF-8: {error}") from None


def _hello(body: _Reader) -> Hello:
    magic, version, flags, robot, micrometres, feed = body.take("4sBBHIQ", "hello")
    if magic != MAGIC:
        raise MirrorError(f"hello begins with {magic!r}, expected {MAGIC!r}: this is no map output")
    if version != VERSION:
        raise MirrorError(f"map output of version {version}, expected {VERSION}: use the same version of Flockmap")
    if not micrometres:
        raise MirrorError("hello: voxels of 0 micrometres")
    if not feed:
        raise MirrorError("hello: the id of the feed is 0")
    (length,) = body.take("B", "hello: name")
    name = body.text(length, "hello: name")
    (length,) = body.take("B", "hello: frame")
    return Hello(
        bool(flags & GOES_ON), robot, micrometres, feed, name, body.text(length, "hello: frame")
    )


def _begin_anew(body: _Reader) -> BeginAnew:
    return BeginAnew(*body.take("Q", "begin anew"))


_BLOCK = np.dtype([("index", "<i4", 3), ("planes", "<u8", (2, 8))])


def _blocks(body: _Reader) -> Blocks:
    upto, newest, stamp, flags, count = body.take("QQqBI", "blocks")
    if newest < upto:
        raise MirrorError(f"blocks: newest {newest} is less than upto {upto}")
    if count * _BLOCK.itemsize > len(body.body) - body.at:
        raise MirrorError(f"blocks: {count} blocks in a frame of {len(body.body)} bytes")
    if flags & HAS_ORIGINS:
        # Not asked for, so nobody should send them; who saw a voxel is not kept.
        found = np.zeros(count, _BLOCK)
        for at in range(count):
            (block,) = body.take(f"{_BLOCK.itemsize}s", "block")
            found[at] = np.frombuffer(block, _BLOCK)[0]
            _skip_origins(body)
    else:
        found = np.frombuffer(body.body, _BLOCK, count, body.at)
    index, planes = found["index"].astype(np.int32), found["planes"].astype(np.uint64)
    if (planes[:, 0] & planes[:, 1]).any():
        raise MirrorError("blocks: a voxel that is both Free and Occupied")
    if count and np.abs(index.astype(np.int64)).max() > INDEX_MAX:
        raise MirrorError(f"blocks: an index beyond ±{INDEX_MAX}")
    return Blocks(upto, newest, stamp / 1e6, index, planes)


def _skip_origins(body: _Reader) -> None:
    (count,) = body.take("H", "origins")
    body.take("2x" if count == 1 else f"{count * 66}x", "origins")


def _poses(body: _Reader) -> Poses:
    (count,) = body.take("H", "poses")
    robots = {}
    for _ in range(count):
        robot, epoch, x, y, z, is_turned, a, b, c, d, age = body.take("HQ3dB4dQ", "poses")
        robots[robot] = RobotPose(epoch, (x, y, z), (a, b, c, d) if is_turned == 1 else None, age / 1e6)
    return Poses(robots)


def _counters(body: _Reader) -> Counters:
    time, count = body.take("qH", "counters")
    counters = {}
    for _ in range(count):
        (length,) = body.take("B", "counters")
        name = body.text(length, "counters")
        (counters[name],) = body.take("Q", "counters")
    return Counters(time / 1e6, counters)


_SUBMAP = np.dtype([("submap", "<u2"), ("position", "<f8", 3), ("quaternion", "<f8", 4)])


def _submaps(body: _Reader) -> Submaps:
    (count,) = body.take("H", "submaps")
    if count > RUNS_MAX:
        raise MirrorError(f"submaps of {count} runs, expected {RUNS_MAX} at most")
    runs: list[RunSubmaps] = []
    room = SUBMAP_POSES_MAX
    for _ in range(count):
        robot, epoch, newest, left_out, poses = body.take("HQHHH", "submaps")
        if newest >= SUBMAPS_MAX or poses > room:
            raise MirrorError(f"submaps: the newest is {newest}, and {poses} poses follow: more than there may be")
        room -= poses
        if runs and (runs[-1].robot, runs[-1].epoch) >= (robot, epoch):
            raise MirrorError("submaps: runs that do not ascend")
        (data,) = body.take(f"{poses * _SUBMAP.itemsize}s", "submaps")
        found = np.frombuffer(data, _SUBMAP)
        numbers = found["submap"].astype(np.uint16)
        if (numbers[1:] <= numbers[:-1]).any() or (numbers > newest).any():
            raise MirrorError(f"submaps: numbers that do not ascend to {newest}")
        runs.append(RunSubmaps(robot, epoch, newest, left_out, numbers, _matrices(found)))
    return Submaps(tuple(runs))


def _matrices(found: NDArray[np.void]) -> NDArray[np.float64]:
    quaternion = found["quaternion"].astype(np.float64)
    with np.errstate(all="ignore"):
        length = np.sqrt((quaternion**2).sum(1))
        # Written so that what is no number is refused too.
        is_unit = np.abs(length - 1.0) <= 1e-3
    if not (is_unit.all() and np.isfinite(found["position"]).all()):
        raise MirrorError("submaps: a pose that is none")
    x, y, z, w = (quaternion / length[:, None]).T
    poses = np.zeros((len(found), 4, 4))
    poses[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1)
    poses[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1)
    poses[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1)
    poses[:, :3, 3] = found["position"]
    poses[:, 3, 3] = 1
    return poses


def _end(body: _Reader) -> End:
    return End(body.text(len(body.body), "end"))
