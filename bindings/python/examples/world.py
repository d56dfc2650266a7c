"""A small world and a LiDAR in it, for the examples: a hall of 24 × 16 m with walls and pillars. The true world is a MapView too,
so its rays are cast by Flockmap."""

import numpy as np

from flockmap import FREE, OCCUPIED, MapView

SIDE = 0.2
SIZE = (24.0, 16.0, 3.0)


def hall() -> MapView:
    """The true world; nothing of it is Unknown."""
    nx, ny, nz = (round(metres / SIDE) for metres in SIZE)
    states = np.full((nx, ny, nz), FREE, np.uint8)

    def wall(x0: float, x1: float, y0: float, y1: float) -> None:
        a, b, c, d = (round(metres / SIDE) for metres in (x0, x1, y0, y1))
        states[a : max(b, a + 1), c : max(d, c + 1)] = OCCUPIED

    for edge in ((0, 24, 0, 0.2), (0, 24, 15.8, 16), (0, 0.2, 0, 16), (23.8, 24, 0, 16)):
        wall(*edge)
    wall(8, 8.2, 0, 11)
    wall(15, 15.2, 5, 16)
    for x, y in ((4, 5), (5, 11), (11, 4), (12, 9), (11, 13), (19, 4), (19, 11)):
        wall(x, x + 0.6, y, y + 0.6)
    states[:, :, 0] = OCCUPIED
    indices = np.argwhere(states > 0)
    return MapView.from_voxels(SIDE, indices, states[tuple(indices.T)])


def scan(world: MapView, position: np.ndarray, range_m: float = 8.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """What a LiDAR sees that does not turn: points where rays end on something, and points far out along the others."""
    random = np.random.default_rng(seed)
    turn, rise = random.uniform(0, 2 * np.pi, 6000), random.uniform(-0.35, 0.35, 6000)
    ways = np.stack([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)], 1)
    met, _, metres = world.cast_rays(position, position + ways * range_m, through_unknown=True)
    hits = met == OCCUPIED
    # A little into the voxel that the ray enters, so that rounding does not leave it before.
    return ways[hits] * (metres[hits, None] + 0.01), ways[~hits] * (range_m + 1.0)
