"""Voxels in blocks of 8 × 8 × 8, as bit planes in numpy arrays."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._flockmap import Error

UNKNOWN, FREE, OCCUPIED = 0, 1, 2

#: Blocks whose bits are spread out at a time: 2 MiB.
_SLAB = 4096
#: Points that are looked up at a time, so that what is held meanwhile is bounded: some 10 MiB.
_POINTS = 1 << 16


class BlockMap:
    """The known blocks of a map. A row of each array is a block.

    Voxel (x, y, z) is in the block (x, y, z) // 8. There its word is z % 8, and its bit 8 · (y % 8) + x % 8.
    """

    def __init__(self, micrometres: int) -> None:
        self._micrometres = micrometres
        self._rows: dict[bytes, int] = {}
        self._count = 0
        self._index: NDArray[np.int32] = np.zeros((0, 3), np.int32)
        self._planes: NDArray[np.uint64] = np.zeros((0, 2, 8), np.uint64)
        self._lookup: _Lookup | None = None

    def __len__(self) -> int:
        """Number of blocks in which something is known."""
        return self._count

    @property
    def resolution(self) -> float:
        """Side of a voxel in metres."""
        return self._micrometres / 1e6

    @property
    def index(self) -> NDArray[np.int32]:
        """(N, 3): the index of each block."""
        return self._index[: self._count]

    @property
    def free(self) -> NDArray[np.uint64]:
        """(N, 8): the voxels that are Free."""
        return self._planes[: self._count, 0]

    @property
    def occupied(self) -> NDArray[np.uint64]:
        """(N, 8): the voxels that are Occupied."""
        return self._planes[: self._count, 1]

    def new_blocks(self, index: NDArray[np.int32]) -> int:
        """How many different blocks of these it does not have."""
        return len({key for key in _keys(index) if key not in self._rows})

    def replace(self, index: NDArray[np.int32], planes: NDArray[np.uint64]) -> None:
        """Sets blocks as they are now: (K, 3), and (K, 2, 8) of Free and Occupied. Of two of one block the later counts.
        Blocks without known voxels are forgotten."""
        if not len(index):
            return
        keys = _keys(index)
        before = self._count
        rows = np.empty(len(keys), np.intp)
        for at, key in enumerate(keys):
            row = self._rows.get(key)
            if row is None:
                row = self._rows[key] = self._count
                self._count += 1
            rows[at] = row
        self._make_room()
        # numpy: of several values for one row the last one counts.
        self._index[rows] = index
        self._planes[rows] = planes
        is_same = self._count == before
        touched = np.unique(rows)
        empty = touched[~self._planes[touched].any(axis=(1, 2))]
        for row in empty[::-1]:
            self._remove(int(row))
        if not is_same or len(empty):
            self._lookup = None

    def _make_room(self) -> None:
        room = len(self._index)
        if self._count > room:
            room = max(self._count, 2 * room, 64)
            index, planes = np.zeros((room, 3), np.int32), np.zeros((room, 2, 8), np.uint64)
            index[: len(self._index)], planes[: len(self._planes)] = self._index, self._planes
            self._index, self._planes = index, planes

    def _remove(self, row: int) -> None:
        """Puts the last block in the place of this one."""
        self._count -= 1
        del self._rows[self._index[row].tobytes()]
        if row != self._count:
            self._index[row], self._planes[row] = self._index[self._count], self._planes[self._count]
            self._rows[self._index[row].tobytes()] = row

    def copy(self) -> BlockMap:
        """The same blocks, on their own."""
        other = BlockMap(self._micrometres)
        other._rows, other._count = dict(self._rows), self._count
        other._index, other._planes = self.index.copy(), self._planes[: self._count].copy()
        return other

    def count(self) -> tuple[int, int]:
        """Number of Free and of Occupied voxels."""
        return int(np.bitwise_count(self.free).sum()), int(np.bitwise_count(self.occupied).sum())

    def states(self, xyz: ArrayLike) -> NDArray[np.uint8]:
        """States at points, see :meth:`flockmap.MirrorMap.states`."""
        points = np.asarray(xyz)
        if points.shape == (0,):
            points = points.reshape(0, 3)
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
            raise Error(f"xyz: an array of {points.dtype} of shape {points.shape}, expected numbers of shape (N, 3)")
        states = np.zeros(len(points), np.uint8)
        if self._count:
            if self._lookup is None:
                self._lookup = _Lookup(self.index)
            for first in range(0, len(points), _POINTS):
                part = slice(first, first + _POINTS)
                states[part] = self._states(self._lookup, points[part])
        return states

    def _states(self, lookup: _Lookup, points: NDArray[Any]) -> NDArray[np.uint8]:
        # Beyond this there are no voxels; what is no number is there as well.
        with np.errstate(invalid="ignore", over="ignore"):
            place = np.floor(points.astype(np.float64) * (1e6 / self._micrometres))
            is_voxel: NDArray[np.bool_] = np.all(np.abs(place) <= 2.0**28, axis=1)
        voxels = np.where(is_voxel[:, None], place, 0.0).astype(np.int64)
        rows = lookup.rows(voxels >> 3)
        is_known = is_voxel & (rows >= 0)
        rows, inside = np.where(is_known, rows, 0), voxels & 7
        words = self._planes[rows, :, inside[:, 2]]
        bits = (8 * inside[:, 1] + inside[:, 0]).astype(np.uint64)
        free, occupied = ((words >> bits[:, None]) & np.uint64(1)).T.astype(np.uint8)
        return np.where(is_known, np.where(occupied == 1, OCCUPIED, free), UNKNOWN).astype(np.uint8)

    def slabs(self, plane: int) -> Iterator[NDArray[np.int32]]:
        """Indices (K, 3) of the voxels of a plane (0 Free, 1 Occupied), some thousand blocks at a time."""
        for first in range(0, self._count, _SLAB):
            part = slice(first, min(first + _SLAB, self._count))
            octets = np.ascontiguousarray(self._planes[part, plane]).astype("<u8").view(np.uint8)
            rows, bits = np.nonzero(np.unpackbits(octets, axis=1, bitorder="little"))
            inside = np.stack([bits & 7, (bits >> 3) & 7, bits >> 6], axis=1).astype(np.int32)
            yield self._index[part][rows] * 8 + inside

    def voxels(self, state: int) -> NDArray[np.int32]:
        """Indices (N, 3) of the voxels of a state, FREE or OCCUPIED."""
        parts = list(self.slabs(state - FREE))
        return np.concatenate(parts) if parts else np.zeros((0, 3), np.int32)


class _Lookup:
    """Finds the rows of blocks, for many at once.

    Each axis is ranked on its own: the ranks are less than the number of blocks, so that three of them fit a word, wherever
    the blocks are.
    """

    def __init__(self, index: NDArray[np.int32]) -> None:
        self._axes = [np.unique(index[:, axis]) for axis in range(3)]
        keys = self._key([np.searchsorted(self._axes[axis], index[:, axis]) for axis in range(3)])
        self._order = np.argsort(keys)
        self._keys = keys[self._order]

    def _key(self, ranks: list[NDArray[np.intp]]) -> NDArray[np.int64]:
        _, y, z = (len(values) for values in self._axes)
        key: NDArray[np.int64] = ((ranks[0].astype(np.int64) * y) + ranks[1]) * z + ranks[2]
        return key

    def rows(self, blocks: NDArray[np.int64]) -> NDArray[np.intp]:
        """The row of each block (N, 3), -1 where it is not there."""
        ranks, is_there = [], np.ones(len(blocks), bool)
        for axis, values in enumerate(self._axes):
            wanted = blocks[:, axis]
            rank = np.minimum(np.searchsorted(values, wanted), len(values) - 1)
            is_there &= values[rank] == wanted
            ranks.append(rank)
        key = self._key(ranks)
        at = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
        is_there &= self._keys[at] == key
        return np.where(is_there, self._order[at], -1)


def _keys(index: NDArray[np.int32]) -> list[bytes]:
    data = np.ascontiguousarray(index, np.int32).tobytes()
    return [data[at : at + 12] for at in range(0, len(data), 12)]
