"""What a mirror does with what it reads, without sockets: `docs/map-output.md`."""

from __future__ import annotations

from dataclasses import dataclass, replace

from . import _frames as frames
from ._blocks import BlockMap
from ._frames import MirrorError

#: A map of more blocks is refused: 2²⁰ take 150 MB and some 130 MB for their names.
BLOCKS_MAX = 1 << 20


@dataclass
class Growing:
    """A map and how far it has come."""

    hello: frames.Hello
    #: The version of the node's map at which this one began anew.
    began: int
    blocks: BlockMap
    upto: int = 0
    newest: int = 0
    #: When the node's map came to `newest`, in seconds on the node's clock.
    stamp: float = 0.0
    has_frame: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether it is the node's map at one version, voxel by voxel."""
        return self.has_frame and self.upto == self.newest


class MirrorState:
    """The map of a node, made of the bytes that it sends. Not for several threads at once."""

    def __init__(self, blocks_max: int = BLOCKS_MAX, *, submaps: bool = False) -> None:
        self.blocks_max = blocks_max
        self._wants_submaps = submaps
        self.submaps: tuple[frames.RunSubmaps, ...] = ()
        self.poses: dict[int, frames.RobotPose] = {}
        self.counters: dict[str, int] = {}
        #: Why the node ended the connection, if it said so.
        self.end: str | None = None
        #: Goes up with each frame of blocks.
        self.changes = 0
        self._splitter = frames.Splitter()
        self._hello: frames.Hello | None = None
        #: The map that is shown.
        self.shown: Growing | None = None
        #: A new one that comes while an old one is shown.
        self._coming: Growing | None = None

    def connect(self) -> bytes:
        """Begins a connection; returns what is to be sent."""
        self._splitter, self._hello, self.end = frames.Splitter(), None, None
        newest = self._coming or self.shown
        if newest is None:
            return frames.hello(0, 0, 0, submaps=self._wants_submaps)
        has = newest.hello.feed, newest.began, newest.upto
        return frames.hello(*has, submaps=self._wants_submaps)

    def push(self, data: bytes) -> bool:
        """Takes in what was read. Whether the map that is shown changed.

        Raises MirrorError if something is wrong: end the connection then, and connect again.
        """
        before = self.changes
        for kind, body in self._splitter.push(data):
            if self.end is not None:
                raise MirrorError("a frame behind the end")
            if self._hello is None and kind not in (1, 6):
                raise MirrorError(f"the first frame is of kind {kind}, expected a hello (1)")
            frame = frames.parse(kind, body)
            if frame is not None:
                self._take(frame)
        return self.changes != before

    def _take(self, frame: frames.Frame) -> None:
        match frame:
            case frames.Hello():
                self._take_hello(frame)
            case frames.BeginAnew():
                self._begin(frame.version)
            case frames.Blocks():
                self._take_blocks(frame)
            case frames.Poses():
                self.poses = frame.robots
            case frames.Counters():
                self.counters = frame.counters
            case frames.Submaps():
                self.submaps = frame.runs
            case frames.End():
                self.end = frame.why

    def _take_hello(self, hello: frames.Hello) -> None:
        if self._hello is not None:
            raise MirrorError("a second hello")
        self._hello = hello
        if not hello.goes_on:
            return
        newest = self._coming or self.shown
        said = newest.hello if newest else None
        if said is None or (said.feed, said.micrometres) != (hello.feed, hello.micrometres):
            raise MirrorError("the node goes on from a map that this mirror does not have")

    def _begin(self, version: int) -> None:
        assert self._hello is not None
        begun = Growing(self._hello, version, BlockMap(self._hello.micrometres))
        if self.shown is None or not len(self.shown.blocks):
            self.shown, self._coming = begun, None
            self.changes += 1
        else:
            self._coming = begun

    def _take_blocks(self, frame: frames.Blocks) -> None:
        assert self._hello is not None
        growing = self._coming or self.shown
        if growing is None or growing.hello.feed != self._hello.feed:
            raise MirrorError("blocks before the node said that the map begins anew")
        if frame.upto < growing.upto:
            raise MirrorError(f"blocks upto {frame.upto}, and there was {growing.upto} already")
        room = self.blocks_max - len(growing.blocks)
        if len(frame.index) > room and growing.blocks.new_blocks(frame.index) > room:
            raise MirrorError(f"the map has more than {self.blocks_max} blocks: ask for more with blocks_max")
        growing.blocks.replace(frame.index, frame.planes)
        growing.upto, growing.newest, growing.stamp = frame.upto, frame.newest, frame.stamp
        growing.has_frame = True
        if growing is self._coming and growing.is_complete:
            self.shown, self._coming = growing, None
        self.changes += growing is self.shown

    def copy_of_shown(self) -> Growing | None:
        """The map that is shown, on its own."""
        return None if self.shown is None else replace(self.shown, blocks=self.shown.blocks.copy())
