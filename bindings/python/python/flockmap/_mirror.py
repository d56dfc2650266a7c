"""A mirror of a node's map, kept up to date by a thread."""

from __future__ import annotations

import os
import selectors
import socket
import threading
import time
from dataclasses import dataclass
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._blocks import FREE, OCCUPIED, BlockMap
from ._flockmap import ClosedError, Error
from ._frames import MirrorError, RobotPose, RunSubmaps
from ._mirror_state import BLOCKS_MAX, Growing, MirrorState

#: The node says something each second.
_SILENCE_MAX_S = 10.0
_PAUSE_MIN_S, _PAUSE_MAX_S = 0.1, 5.0
_READ_BYTES = 1 << 16


@dataclass(frozen=True)
class MirrorMap:
    """A node's map as a mirror had it at one moment. It stays as it is while the mirror goes on.

    Positions are metres in the frame of the node's map; voxel (i, j, k) is the cube from (i, j, k) · resolution on.
    """

    #: The version of the node's map upto which everything is in it.
    version: int
    #: Whether it is the node's map at that version, voxel by voxel. Until then newer blocks may stand beside older ones.
    is_complete: bool
    #: When the node's map came to its newest version, in seconds on the node's clock.
    stamp: float
    #: Id and name of the node's robot.
    robot: int
    name: str
    #: Name of the frame that the map is in.
    map_frame: str
    _blocks: BlockMap

    @property
    def resolution(self) -> float:
        """Side of a voxel in metres."""
        return self._blocks.resolution

    def states(self, xyz: ArrayLike) -> NDArray[np.uint8]:
        """States at points (N, 3) of metres: (N,) uint8, 0 Unknown, 1 Free, 2 Occupied."""
        return self._blocks.states(xyz)

    def count(self) -> tuple[int, int]:
        """Number of Free and of Occupied voxels."""
        return self._blocks.count()

    def voxels(self) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
        """All known voxels: indices (N, 3) int32 and states (N,) uint8, in no particular order."""
        free, occupied = self._blocks.voxels(FREE), self._blocks.voxels(OCCUPIED)
        states = np.repeat(np.array([FREE, OCCUPIED], np.uint8), [len(free), len(occupied)])
        return np.concatenate([free, occupied]), states

    def occupied_points(self) -> NDArray[np.float64]:
        """Centres of the Occupied voxels: (N, 3), metres."""
        return self._centres(OCCUPIED)

    def free_points(self) -> NDArray[np.float64]:
        """Centres of the Free voxels: (N, 3), metres."""
        return self._centres(FREE)

    def _centres(self, state: int) -> NDArray[np.float64]:
        return (self._blocks.voxels(state).astype(np.float64) + 0.5) * self.resolution

    def bounding_box(self) -> tuple[tuple[float, float, float], tuple[float, float, float]] | None:
        """Corners in metres of the smallest box that holds every known voxel; None if nothing is known."""
        low, high = None, None
        for plane in (0, 1):
            for voxels in self._blocks.slabs(plane):
                if len(voxels):
                    low = voxels.min(0) if low is None else np.minimum(low, voxels.min(0))
                    high = voxels.max(0) if high is None else np.maximum(high, voxels.max(0))
        if low is None or high is None:
            return None
        a, b = low * self.resolution, (high + 1) * self.resolution
        return (float(a[0]), float(a[1]), float(a[2])), (float(b[0]), float(b[1]), float(b[2]))

    @property
    def blocks(self) -> tuple[NDArray[np.int32], NDArray[np.uint64], NDArray[np.uint64]]:
        """Blocks of 8 × 8 × 8 voxels as bit planes: indices (N, 3), Free (N, 8), Occupied (N, 8). Voxel (x, y, z) is bit
        8 · (y % 8) + x % 8 of word z % 8."""
        return self._blocks.index, self._blocks.free, self._blocks.occupied


class Mirror:
    """A mirror of the map of a running node, in this process: `[map_output]` of the node, and its address here.

    It reads on a thread of its own, connects again when the connection ends, and goes on from what it has. A map that was
    complete is shown until a new one is.

    address: "unix:PATH" or "HOST:PORT", as the node's log and `Node.map_addresses` say it.
    blocks_max: a map of more blocks of 8³ voxels is refused; each takes some 280 bytes here, twice that while a new map comes.
    receive_buffer: bytes that the system keeps; make it small on a thin link.
    submaps: whether to ask how submaps lie.
    """

    def __init__(
        self,
        address: str,
        *,
        blocks_max: int = BLOCKS_MAX,
        receive_buffer: int | None = None,
        submaps: bool = False,
    ) -> None:
        self.address = address
        self._target = _target(address)
        self._receive_buffer = receive_buffer
        self._state = MirrorState(blocks_max, submaps=submaps)
        self._changed = threading.Condition()
        self._is_closed = False
        self._is_connected = False
        self._connections = 0
        self._last_error: str | None = None
        self._bytes = 0
        # Wakes the thread that reads.
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._run, name=f"mirror of {address}", daemon=True)
        self._thread.start()

    # What it has.

    def map(self) -> MirrorMap | None:
        """The map now, which stays as it is. None until the first part of it has come. O(blocks)."""
        with self._changed:
            self._check_open()
            shown = self._state.copy_of_shown()
        return None if shown is None else _map_of(shown)

    def states(self, xyz: ArrayLike) -> NDArray[np.uint8]:
        """States at points (N, 3) of metres, now: (N,) uint8, 0 Unknown, 1 Free, 2 Occupied. Unknown until a map has come.

        Who plans over several calls takes one `map()`.
        """
        with self._changed:
            self._check_open()
            blocks = BlockMap(1) if self._state.shown is None else self._state.shown.blocks
            return blocks.states(xyz)

    @property
    def version(self) -> int:
        """The version of the node's map upto which all of it is here; 0: nothing is."""
        with self._changed:
            return 0 if self._state.shown is None else self._state.shown.upto

    @property
    def is_complete(self) -> bool:
        """Whether it is the node's map at `version`, voxel by voxel, as far as is known here."""
        with self._changed:
            return self._state.shown is not None and self._state.shown.is_complete

    @property
    def is_connected(self) -> bool:
        """Whether the node is heard."""
        with self._changed:
            return self._is_connected

    @property
    def poses(self) -> dict[int, RobotPose]:
        """Where the robots are, by id, as the node said it last."""
        with self._changed:
            return dict(self._state.poses)

    @property
    def submaps(self) -> tuple[RunSubmaps, ...]:
        """The submaps of each run of a robot and how they lie in the map, as the node said it last, by robot and epoch. Empty
        unless they were asked for."""
        with self._changed:
            return self._state.submaps

    @property
    def counters(self) -> dict[str, int]:
        """What the node counted, by name, as it said it last."""
        with self._changed:
            return dict(self._state.counters)

    @property
    def connections(self) -> int:
        """How often it has connected."""
        with self._changed:
            return self._connections

    @property
    def bytes_received(self) -> int:
        """Bytes that were read."""
        with self._changed:
            return self._bytes

    @property
    def last_error(self) -> str | None:
        """Why the last connection ended, or could not be made."""
        with self._changed:
            return self._last_error

    # Waiting.

    def wait(self, after: int | None = None, *, complete: bool = True, timeout: float | None = None) -> bool:
        """Waits until the map is complete (or has anything, if not `complete`) and its version is more than `after`.

        Returns whether it is; False: `timeout` seconds were over.
        """

        def is_there() -> bool:
            self._check_open()
            shown = self._state.shown
            if shown is None or not shown.has_frame:
                return False
            return (shown.is_complete or not complete) and (after is None or shown.upto > after)

        with self._changed:
            return self._changed.wait_for(is_there, timeout)

    # Its end.

    def close(self) -> None:
        """Ends the connection and the thread. Maps that it gave stay."""
        with self._changed:
            was_closed, self._is_closed = self._is_closed, True
            self._changed.notify_all()
        if not was_closed:
            self._wake.close()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def __enter__(self) -> Mirror:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Mirror({self.address!r}, version={self.version}, is_complete={self.is_complete})"

    def _check_open(self) -> None:
        if self._is_closed:
            raise ClosedError("this mirror was closed: make a new one")

    # The thread.

    def _run(self) -> None:
        pause = _PAUSE_MIN_S
        while not self._is_closed:
            try:
                got_something = self._connect_and_read()
            except (OSError, MirrorError) as error:
                got_something = False
                self._note_end(str(error))
            pause = _PAUSE_MIN_S if got_something else min(2 * pause, _PAUSE_MAX_S)
            if not self._is_closed:
                _readable([self._woken], pause)
        self._woken.close()

    def _note_end(self, why: str) -> None:
        with self._changed:
            self._is_connected, self._last_error = False, why
            self._changed.notify_all()

    def _connect_and_read(self) -> bool:
        """One connection, until it ends. Whether anything of a map came."""
        family, address = self._target
        before = self._state.changes
        with socket.socket(family, socket.SOCK_STREAM) as connection:
            if self._receive_buffer is not None:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._receive_buffer)
            connection.settimeout(_SILENCE_MAX_S)
            connection.connect(address)
            connection.sendall(self._state.connect())
            with self._changed:
                self._connections += 1
            heard = time.monotonic()
            while True:
                left = heard + _SILENCE_MAX_S - time.monotonic()
                ready = _readable([connection, self._woken], max(left, 0.0))
                if self._is_closed:
                    return True
                if connection not in ready:
                    self._note_end(f"nothing was heard for {_SILENCE_MAX_S:.0f} s")
                    break
                data = connection.recv(_READ_BYTES)
                if not data:
                    self._note_end(self._state.end or "the connection broke")
                    break
                heard = time.monotonic()
                with self._changed:
                    self._is_connected = True
                    self._bytes += len(data)
                    if self._state.push(data):
                        self._changed.notify_all()
        return self._state.changes != before


def _map_of(shown: Growing) -> MirrorMap:
    hello = shown.hello
    return MirrorMap(
        shown.upto, shown.is_complete, shown.stamp, hello.robot, hello.name, hello.map_frame, shown.blocks
    )


def _target(address: str) -> tuple[socket.AddressFamily, str | tuple[str, int]]:
    if address.startswith("unix:"):
        return socket.AF_UNIX, os.path.expanduser(address[len("unix:") :])
    host, colon, port = address.rpartition(":")
    if not colon or not host or not port.isascii() or not port.isdigit() or not 1 <= int(port) <= 65_535:
        raise Error(f'address is "{address}", expected "unix:PATH" or "HOST:PORT"')
    if host.startswith("[") and host.endswith("]"):
        return socket.AF_INET6, (host[1:-1], int(port))
    return socket.AF_INET, (host, int(port))


def _readable(sockets: list[socket.socket], timeout: float) -> list[socket.socket]:
    """Those that have something to read, or have ended. Not by `select`, which takes no file numbers beyond 1,023."""
    with selectors.DefaultSelector() as selector:
        for one in sockets:
            selector.register(one, selectors.EVENT_READ)
        return [key.fileobj for key, _ in selector.select(timeout)]  # type: ignore[misc]
