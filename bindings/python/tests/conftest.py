"""What tests share. FLOCKMAP: the program; FLOCKMAP_DATA: real recordings (default: ../shared/data beside the repository)."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture
def program() -> str:
    """The program `flockmap`."""
    found = os.environ.get("FLOCKMAP") or shutil.which("flockmap")
    if not found:
        pytest.skip("no program flockmap: set FLOCKMAP to it")
    return found


@pytest.fixture
def recordings() -> Path:
    """Folder with hku_mb/robot1.mcap and robot2.mcap."""
    folder = Path(os.environ.get("FLOCKMAP_DATA", REPOSITORY.parent / "shared" / "data"))
    if not (folder / "hku_mb" / "robot1.mcap").is_file():
        pytest.skip(f"no recordings in {folder}: set FLOCKMAP_DATA")
    return folder


@pytest.fixture
def random_map():
    """A map in which each third voxel of a box is Unknown, Free or Occupied: indices (N, 3), states (N,), as a dict too."""
    random = np.random.default_rng(7)
    indices = np.stack(np.meshgrid(*[np.arange(-13, 14)] * 3, indexing="ij"), -1).reshape(-1, 3)
    states = random.integers(0, 3, len(indices)).astype(np.uint8)
    return indices, states


def wall(x: float, seed: int = 1, count: int = 4000) -> np.ndarray:
    """Points of a wall at x metres, 4 m wide and 2 m high, in the frame of the sensor."""
    random = np.random.default_rng(seed)
    y, z = random.uniform(-2, 2, count), random.uniform(-1, 1, count)
    return np.stack([np.full(count, x), y, z], 1)
