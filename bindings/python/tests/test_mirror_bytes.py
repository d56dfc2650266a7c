"""The mirror reads the bytes of docs/map-output.md, however they are cut, and refuses what is no map output."""

import re
import struct

import numpy as np
import pytest
from conftest import REPOSITORY

from flockmap import MirrorError
from flockmap._blocks import FREE, OCCUPIED, BlockMap
from flockmap._mirror_state import MirrorState


@pytest.fixture
def example() -> list[bytes]:
    """The frames of the page's example, the reader's hello first."""
    text = (REPOSITORY / "docs" / "map-output.md").read_text()
    lines = re.search(r"```hex\n(.*?)```", text, re.S).group(1).splitlines()
    data = bytes.fromhex(" ".join(line for line in lines if not line.startswith("#")))
    frames = []
    while data:
        length = 4 + struct.unpack_from("<I", data)[0]
        frames.append(data[:length])
        data = data[length:]
    return frames


def frame(kind: int, body: bytes) -> bytes:
    return struct.pack("<IB", len(body) + 1, kind) + body


def hello(feed=9, flags=0, micrometres=200_000) -> bytes:
    return frame(1, struct.pack("<4sBBHIQ", b"FLKM", 1, flags, 7, micrometres, feed) + b"\1a\1m")


def begin(version=0) -> bytes:
    return frame(3, struct.pack("<Q", version))


def blocks(upto, newest, *given) -> bytes:
    body = struct.pack("<QQqBI", upto, newest, 0, 0, len(given))
    for index, free, occupied in given:
        body += struct.pack("<3i8Q8Q", *index, *[free] * 8, *[occupied] * 8)
    return frame(2, body)


def submaps(*runs, poses=((0, 0.0, 1.0),)) -> bytes:
    """Runs of these robots, whose newest submap is 9; of each pose the submap, x, and the w of its quaternion."""
    body = struct.pack("<H", len(runs))
    for robot in runs:
        body += struct.pack("<HQHHH", robot, 5, 9, 0, len(poses))
        body += b"".join(struct.pack("<H7d", number, x, 0, 0, 0, 0, 0, w) for number, x, w in poses)
    return frame(10, body)


@pytest.mark.parametrize("step", [1, 7, 1 << 20])
def test_the_example_of_the_page(example, step):
    state = MirrorState()
    assert state.connect() == example[0]
    data = b"".join(example[1:])
    for at in range(0, len(data), step):
        state.push(data[at : at + step])
    shown = state.shown
    assert (shown.hello.robot, shown.hello.name, shown.hello.map_frame) == (7, "alpha", "map")
    assert shown.is_complete and (shown.upto, shown.stamp) == (5, 1_700_000_000.0)
    assert shown.blocks.resolution == 0.2
    assert sorted(map(tuple, shown.blocks.voxels(OCCUPIED))) == [(8, 0, -8), (15, 7, -1)]
    assert sorted(map(tuple, shown.blocks.voxels(FREE))) == [(9, 0, -8), (10, 0, -8)]
    at = (np.array([[8, 0, -8], [9, 0, -8], [11, 0, -8], [0, 0, 0]]) + 0.5) * 0.2
    assert shown.blocks.states(at).tolist() == [2, 1, 0, 0]
    pose = state.poses[7]
    assert (pose.epoch, pose.position, pose.quaternion, pose.age) == (3, (1.0, -2.0, 0.5), (0.0, 0.0, 0.0, 1.0), 1.5)
    assert state.counters == {"node_frames": 300}
    (run,) = state.submaps
    assert (run.robot, run.epoch, run.newest, run.left_out) == (7, 3, 4, 0)
    expected = np.eye(4)
    assert (run.pose(0) == expected).all() and (run.pose(1) == expected).all() and run.pose(5) is None
    expected[:3, 3] = 0, 0.5, -0.25
    assert (run.pose(2) == expected).all() and (run.pose(4) == expected).all()
    assert state.end == "the node ends"


def test_submaps_are_asked_for_only_if_they_are_wanted():
    assert MirrorState().connect()[10] == 0
    state = MirrorState(submaps=True)
    assert state.connect()[10] == 16
    # A quarter turn about z; and those older ones of which nothing is told.
    half = 0.5**0.5
    body = struct.pack("<H HQHHH H7d", 1, 2, 5, 9, 3, 1, 4, 1, 2, 3, 0, 0, half, half)
    state.push(hello() + frame(10, body))
    (run,) = state.submaps
    assert np.allclose(run.pose(9), [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert run.pose(3) is None and run.left_out == 3


def test_a_mirror_that_comes_back_says_what_it_has_and_goes_on():
    state = MirrorState()
    state.connect()
    state.push(hello() + begin(3) + blocks(5, 5, ((0, 0, 0), 1, 2)))
    said = state.connect()
    assert struct.unpack("<QQQ", said[-24:]) == (9, 3, 5)
    state.push(hello(flags=2) + blocks(6, 6, ((1, 0, 0), 1, 0)))
    assert len(state.shown.blocks) == 2 and state.shown.upto == 6


def test_a_whole_map_is_shown_until_the_new_one_is_whole():
    state = MirrorState()
    state.connect()
    state.push(hello() + begin() + blocks(5, 5, ((0, 0, 0), 1, 0)))
    state.connect()
    state.push(hello(feed=10, micrometres=100_000) + begin(2) + blocks(3, 8, ((4, 0, 0), 1, 0)))
    assert state.shown.hello.feed == 9 and state.shown.is_complete
    # What comes is what it says that it has.
    assert struct.unpack("<QQQ", state.connect()[-24:]) == (10, 2, 3)
    state.push(hello(feed=10, flags=2, micrometres=100_000) + blocks(8, 8, ((5, 0, 0), 0, 1)))
    assert state.shown.hello.feed == 10 and len(state.shown.blocks) == 2 and state.shown.blocks.resolution == 0.1


def test_an_emptied_block_is_forgotten_and_the_others_stay():
    state = MirrorState()
    state.connect()
    state.push(hello() + begin() + blocks(5, 5, *[((n, n, -n), 1 << n, 0) for n in range(9)]))
    state.push(blocks(6, 6, ((0, 0, 0), 0, 0), ((4, 4, -4), 0, 0), ((77, 0, 0), 0, 0)))
    assert len(state.shown.blocks) == 7
    for n in (1, 2, 3, 5, 6, 7, 8):
        at = [[(8 * n + n + 0.5) * 0.2, (8 * n + 0.5) * 0.2, (-8 * n + 0.5) * 0.2]] if n < 8 else None
        if at:
            assert state.shown.blocks.states(at) == [FREE], n


def test_kinds_flags_and_bytes_that_are_not_known_are_skipped():
    state = MirrorState()
    state.connect()
    state.push(frame(1, hello(flags=0xFC)[5:] + b"more"))
    state.push(frame(200, b"of a later version") + begin() + frame(3, bytes(8) + b"more"))
    body = blocks(1, 1, ((0, 0, 0), 1, 0))[5:]
    state.push(frame(2, body[:24] + b"\xfe" + body[25:] + b"more"))
    assert len(state.shown.blocks) == 1


def test_origins_are_read_over():
    state = MirrorState()
    state.connect()
    body = struct.pack("<QQqBI", 1, 1, 0, 1, 3)
    for n, origins in enumerate([b"\0\0", struct.pack("<HH", 1, 7), struct.pack("<HH8QH8Q", 2, 7, *[1] * 8, 8, *[2] * 8)]):
        body += struct.pack("<3i8Q8Q", n, 0, 0, *[1] * 8, *[2] * 8) + origins
    state.push(hello(flags=1) + begin() + frame(2, body))
    assert len(state.shown.blocks) == 3


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"HTTP/1.1 400 Bad Request", "a frame of 1347703880 bytes"),
        (struct.pack("<I", 0), "a frame of 0 bytes"),
        (begin(), "expected a hello"),
        (frame(1, b"FLKS" + bytes(40)), "expected b'FLKM'"),
        (frame(1, b"FLKM\2" + bytes(40)), "version 2, expected 1"),
        (frame(1, b"FLKM\1"), "the frame ends at byte 5"),
        (hello(feed=0), "id of the feed is 0"),
        (hello(micrometres=0), "0 micrometres"),
        (frame(1, struct.pack("<4sBBHIQ", b"FLKM", 1, 0, 7, 1000, 9) + b"\2\xff\xff\0"), "no UTF-8"),
        (hello() + hello(), "a second hello"),
        (hello(flags=2), "that this mirror does not have"),
        (hello() + blocks(1, 1), "begins anew"),
        (hello() + begin() + blocks(2, 1), "newest 1 is less than upto 2"),
        (hello() + begin() + blocks(2, 2) + blocks(1, 2), "upto 1, and there was 2"),
        (hello() + begin() + blocks(1, 1, ((0, 0, 0), 1, 1)), "both Free and Occupied"),
        (hello() + begin() + blocks(1, 1, ((33_554_433, 0, 0), 1, 0)), "beyond"),
        (hello() + begin() + blocks(1, 1, ((-(2**31), 0, 0), 1, 0)), "beyond"),
        (hello() + begin() + frame(2, struct.pack("<QQqBI", 1, 1, 0, 0, 2**32 - 1)), "4294967295 blocks"),
        (hello() + begin() + frame(2, struct.pack("<QQqBI", 1, 1, 0, 1, 2**32 - 1)), "4294967295 blocks"),
        (hello() + frame(4, struct.pack("<H", 2)), "poses: the frame ends"),
        (hello() + frame(5, struct.pack("<qH", 0, 1) + b"\5ab"), "counters: the frame ends"),
        (hello() + frame(10, struct.pack("<H", 2)), "submaps: the frame ends"),
        (hello() + frame(10, struct.pack("<H", 1_025)), "1025 runs"),
        (hello() + frame(10, struct.pack("<HHQHHH", 1, 1, 5, 9, 0, 8_193)), "more than there may be"),
        (hello() + frame(10, struct.pack("<HHQHHH", 1, 1, 5, 4_096, 0, 0)), "more than there may be"),
        (hello() + submaps(1, 1), "runs that do not ascend"),
        (hello() + submaps(1, poses=((0, 0.0, 1.0), (0, 0.0, 1.0))), "numbers that do not ascend to 9"),
        (hello() + submaps(1, poses=((10, 0.0, 1.0),)), "numbers that do not ascend to 9"),
        (hello() + submaps(1, poses=((0, 0.0, 2.0),)), "a pose that is none"),
        (hello() + submaps(1, poses=((0, 0.0, float("nan")),)), "a pose that is none"),
        (hello() + submaps(1, poses=((0, float("inf"), 1.0),)), "a pose that is none"),
        (frame(6, b"over") + hello(), "behind the end"),
    ],
)
def test_what_is_no_map_output_is_refused(data, text):
    state = MirrorState()
    state.connect()
    with pytest.raises(MirrorError, match=text):
        state.push(data)


def test_a_mirror_holds_no_more_blocks_than_allowed():
    state = MirrorState(blocks_max=10)
    state.connect()
    state.push(hello() + begin() + blocks(1, 1, *[((n, 0, 0), 1, 0) for n in range(10)]))
    # Those that are there may change.
    state.push(blocks(2, 2, *[((n, 0, 0), 3, 0) for n in range(10)]))
    with pytest.raises(MirrorError, match="more than 10 blocks: ask for more with blocks_max"):
        state.push(blocks(3, 3, ((10, 0, 0), 1, 0)))


def test_damaged_streams_never_do_more_than_refuse(example):
    """Every byte of the example is changed in turn, and the stream is cut after each."""
    data = b"".join(example[1:])
    for at in range(len(data)):
        for damaged in (data[:at], data[:at] + bytes([data[at] ^ 0xA5]) + data[at + 1 :]):
            state = MirrorState()
            state.connect()
            try:
                state.push(damaged)
            except MirrorError:
                pass


def test_a_block_map_equals_a_dictionary_of_voxels():
    random = np.random.default_rng(11)
    blocks, expected = BlockMap(100_000), {}
    far = np.array([-33_554_432, -5, -1, 0, 3, 33_554_432])
    for _ in range(60):
        index = random.choice(far, (random.integers(0, 20), 3)).astype(np.int32)
        planes = random.integers(0, 1 << 63, (len(index), 2, 8), np.uint64)
        planes[:, 0] &= ~planes[:, 1]
        planes[random.random(len(index)) < 0.4] = 0
        blocks.replace(index, planes)
        for at, plane in zip(index, planes):
            expected.pop(tuple(at), None)
            if plane.any():
                expected[tuple(at)] = plane
        assert len(blocks) == len(expected)
        found = {tuple(at): (free, occupied) for at, free, occupied in zip(blocks.index, blocks.free, blocks.occupied)}
        assert found.keys() == expected.keys()
        assert all((np.array(found[at]) == expected[at]).all() for at in found)
        # Asked at the centres of some voxels, there or not.
        asked = random.choice(far, (50, 3))
        voxels = asked * 8 + random.integers(0, 8, (50, 3))
        states = blocks.states((voxels + 0.5) * 0.1)
        for at, voxel, state in zip(asked, voxels, states):
            x, y, z = voxel % 8
            bit = np.uint64(8 * y + x)
            free, occupied = expected.get(tuple(at), np.zeros((2, 8), np.uint64))[:, z] >> bit & np.uint64(1)
            is_within = (np.abs(voxel) <= 2**28).all()
            assert state == (2 * occupied + free if is_within else 0)
