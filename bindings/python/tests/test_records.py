"""Records come as arrays."""

import numpy as np
import pytest

import flockmap


def folder_of_scans(tmp_path, count=3):
    """A record as a folder: Scans/*.pcd, poses in KITTI's form, times.txt."""
    (tmp_path / "Scans").mkdir()
    random = np.random.default_rng(1)
    scans = []
    for n in range(count):
        points = random.uniform(-5, 5, (100 + n, 3)).astype(np.float32)
        header = (
            "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
            f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
        )
        (tmp_path / "Scans" / f"{n}.pcd").write_bytes(header.encode() + points.tobytes())
        scans.append(points)
    (tmp_path / "poses.txt").write_text("".join(f"1 0 0 {n} 0 1 0 0 0 0 1 0\n" for n in range(count)))
    (tmp_path / "times.txt").write_text("".join(f"{n / 10}\n" for n in range(count)))
    return scans


def test_a_folder_of_scans(tmp_path):
    scans = folder_of_scans(tmp_path)
    record = flockmap.open_record(tmp_path)
    assert len(record) == 3 and record.path == pytest.approx(2.0)
    stamps, poses = record.poses()
    assert stamps == pytest.approx([0.0, 0.1, 0.2]) and poses.shape == (3, 4, 4)
    robot = flockmap.Robot(1, resolution=0.2, range=10.0)
    for frame, points, pose in zip(record, scans, poses):
        assert frame.points.dtype == np.float32 and np.array_equal(frame.points, points)
        assert np.array_equal(frame.T_map_sensor, pose) and pose[0, 3] == pytest.approx(frame.stamp * 10)
        robot.insert_scan(frame.points, frame.T_map_sensor, frame.stamp)
    assert robot.view().count()[1] > 100
    assert list(record) == []
    record.close()
    with pytest.raises(flockmap.ClosedError, match="this record was closed"):
        next(iter(record))


def test_a_damaged_scan_is_an_error_and_the_next_one_comes(tmp_path):
    scans = folder_of_scans(tmp_path)
    (tmp_path / "Scans" / "1.pcd").write_bytes(b"damaged")
    frames = iter(flockmap.open_record(tmp_path))
    assert len(next(frames).points) == len(scans[0])
    with pytest.raises(flockmap.FileError, match="1.pcd"):
        next(frames)
    assert len(next(frames).points) == len(scans[2])


def test_a_recorded_walk(recordings):
    with flockmap.open_mcap(recordings / "hku_mb" / "robot1.mcap") as record:
        assert len(record) > 100 and record.path > 10 and not record.damages
        frame = next(record)
    assert frame.points.shape[0] > 1000 and frame.points.shape[1] == 3
    rotation = frame.T_map_sensor[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
