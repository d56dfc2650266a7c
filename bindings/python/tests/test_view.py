"""Views and their products equal what numpy finds by brute force."""

import numpy as np
import pytest

import flockmap
from flockmap import MapView


@pytest.fixture
def side():
    return 0.1


@pytest.fixture
def grid(random_map):
    """States as an array [x, y, z], from voxel -13 on."""
    return random_map[1].reshape(27, 27, 27)


@pytest.fixture
def view(random_map, side):
    return MapView.from_voxels(side, *random_map)


def sorted_rows(array):
    array = np.asarray(array)
    return array[np.lexsort(array.T[::-1])]


BOX = ((-0.8, -1.3, 0.0), (1.1, 0.7, 1.2))
LOW, HIGH = (5, 0, 13), (24, 20, 25)


def inside(grid):
    return grid[tuple(slice(a, b) for a, b in zip(LOW, HIGH))]


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_states_of_points(view, grid, kind):
    points = np.random.default_rng(5).uniform(-1.6, 1.6, (20_000, 3)).astype(kind)
    index = np.floor(points.astype(float) * 10).astype(int) + 13
    is_there = ((index >= 0) & (index < 27)).all(1)
    expected = np.zeros(len(points), np.uint8)
    expected[is_there] = grid[tuple(index[is_there].T)]
    found = view.states(points)
    assert found.dtype == np.uint8 and np.array_equal(found, expected)
    assert np.array_equal(view.states(points[::-3]), expected[::-3])
    assert np.array_equal(view.states(np.asfortranarray(points)), expected)
    assert view.states([[np.nan, 0, 0], [np.inf, 0, 0], [1e300, 0, 0]]).tolist() == [0, 0, 0]
    assert view.states(np.zeros((0, 3))).shape == (0,) and view.states([]).shape == (0,)


def test_voxels_of_all_and_of_a_box(view, random_map, grid):
    indices, states = random_map
    known = np.column_stack([indices, states])[states > 0]
    found = np.column_stack(view.voxels())
    assert np.array_equal(sorted_rows(found), sorted_rows(known))
    assert view.count() == ((states == 1).sum(), (states == 2).sum())
    low, high = np.array(LOW) - 13, np.array(HIGH) - 13
    within = known[((known[:, :3] >= low) & (known[:, :3] < high)).all(1)]
    assert np.array_equal(sorted_rows(np.column_stack(view.voxels(BOX))), sorted_rows(within))
    assert np.array_equal(sorted_rows(np.column_stack(view.voxels(np.array(BOX)))), sorted_rows(within))
    for points, state in ((view.occupied_points(BOX), 2), (view.free_points(BOX), 1)):
        assert points.dtype == np.float64
        assert np.allclose(sorted_rows(points), sorted_rows((within[within[:, 3] == state][:, :3] + 0.5) * 0.1))
    assert np.allclose(view.bounding_box(), [[-1.3] * 3, [1.4] * 3])


def test_rays_end_where_a_walk_in_small_steps_ends(view, grid):
    random = np.random.default_rng(3)
    a, b = random.uniform(-1.2, 1.2, (2, 300, 3))
    for through in (False, True):
        states, voxels, metres = view.cast_rays(a, b, through_unknown=through)
        shares = np.linspace(0, 1, 40_001)[:, None]
        for ray in range(0, 300, 10):
            steps = np.floor((a[ray] + (b[ray] - a[ray]) * shares) * 10).astype(int)
            met = grid[tuple((steps + 13).T)]
            stop = (met == 2) | ((met == 0) & (not through))
            if not stop.any():
                assert (states[ray], metres[ray]) == (1, np.inf)
                continue
            first = stop.argmax()
            assert states[ray] == met[first]
            assert np.array_equal(voxels[ray], steps[first])
            assert metres[ray] == pytest.approx(shares[first, 0] * np.linalg.norm(b[ray] - a[ray]), abs=1e-3)
    one = view.cast_rays(a[0], b)
    many = view.cast_rays(np.repeat(a[:1], 300, 0), b)
    assert all(np.array_equal(x, y) for x, y in zip(one, many))


def test_the_distance_field_is_exact(view, grid):
    part = inside(grid)
    for obstacles, is_obstacle in (("occupied", part == 2), ("not-free", part != 1)):
        field = view.distance_field(BOX, obstacles)
        centres = np.argwhere(is_obstacle)
        cells = np.argwhere(np.ones(part.shape, bool))
        squared = np.full(len(cells), np.inf)
        for first in range(0, len(cells), 500):
            rows = cells[first : first + 500, None] - centres[None]
            squared[first : first + 500] = (rows**2).sum(2).min(1)
        expected = (np.sqrt(squared) * 0.1).reshape(part.shape)
        found = field.distances()
        assert found.dtype == np.float32 and np.allclose(found, expected, atol=1e-6)
        points = (cells + LOW - 13 + 0.5) * 0.1
        distances, gradients = field.clearances(points)
        assert np.allclose(distances, expected.ravel(), atol=1e-6) and gradients.shape == (len(cells), 3)
        distance, gradient = field.at(points[7])
        assert distance == distances[7] and np.array_equal(gradient, gradients[7])
        assert field.at([9.0, 0, 0]) is None and np.isnan(field.clearances([[9.0, 0, 0]])[0][0])
        assert np.array_equal(field.are_clear(points, 0.2), distances > 0.2 + 0.1 * np.sqrt(0.75))
        assert np.allclose(field.box, BOX) and field.low == [-8, -13, 0]


def test_a_field_is_brought_up_to_date(random_map):
    robot = flockmap.Robot(1, resolution=0.1, range=7.0)
    robot.insert_states(*random_map, 0.0)
    view = robot.view()
    field = view.distance_field(BOX)
    assert field.update(view) == "unchanged"
    changed = np.argwhere(np.random.default_rng(2).random((5, 5, 5)) < 0.5)
    robot.insert_states(changed, np.full(len(changed), 2), 1.0)
    assert field.update(robot.view()) == "partly"
    assert np.array_equal(field.distances(), robot.view().distance_field(BOX).distances())


def test_collision_of_spheres_and_boxes(view, random_map):
    indices, states = random_map
    low = indices[states == 2] * 0.1
    random = np.random.default_rng(4)
    centres = random.uniform(-1.5, 1.5, (500, 3))
    nearest = np.clip(centres[:, None], low[None], low[None] + 0.1)
    distance = np.linalg.norm(nearest - centres[:, None], axis=2).min(1)
    collision = view.collision()
    found = collision.spheres(centres, 0.06)
    assert np.array_equal(found, distance <= 0.06) and found.any() and not found.all()
    for centre, collides in zip(centres[:50], found):
        voxel = collision.sphere(centre, 0.06)
        assert (voxel is not None) == collides
    pose = np.eye(4)
    pose[:3, 3] = centres[0]
    half = np.array([0.02, 0.02, 0.02])
    meets = ((low <= centres[0] + half) & (low + 0.1 >= centres[0] - half)).all(1).any()
    assert (collision.oriented_box(pose, half) is not None) == meets
    assert (collision.aligned_box(centres[0] - half, centres[0] + half) is not None) == meets
    part, voxel, along = collision.path([[-3, 0, 0], [-2, 0, 0], [2, 0, 0]], 0.05)
    assert part == 1 and along == pytest.approx(1 + collision.swept_sphere([-2, 0, 0], [2, 0, 0], 0.05)[1])
    assert np.abs(np.array(voxel)).max() <= 13


def test_the_occupancy_grid_is_what_is_in_the_columns(view, grid, tmp_path):
    part = inside(grid)
    for all_free in (False, True):
        found = view.occupancy_grid(0.0, 1.2, ((-0.8, -1.3), (1.1, 0.7)), all_free=all_free)
        free = (part == 1).all(2) if all_free else (part == 1).any(2)
        expected = np.where((part == 2).any(2), 2, free)
        assert np.array_equal(found.states(), expected.T)
        assert np.array_equal(found.to_ros(), np.array([-1, 0, 100], np.int8)[expected.T])
        assert found.origin == pytest.approx([-0.8, -1.3]) and found.shape == [20, 19]
    thin = view.occupancy_grid(0.0, 0.1)
    assert thin.shape == [27, 27] and np.array_equal(thin.states(), grid[:, :, 13].T)
    thin.save(tmp_path / "map.pgm")
    assert "resolution: 0.1" in (tmp_path / "map.yaml").read_text()


def test_the_height_map_is_what_is_in_the_columns(view, grid, tmp_path):
    part = inside(grid)
    found = view.height_map(0.0, 1.2, ((-0.8, -1.3), (1.1, 0.7)))
    occupied = part == 2
    any_is = occupied.any(2)
    bottoms = np.where(any_is, occupied.argmax(2) * 0.1, np.nan)
    tops = np.where(any_is, (12 - occupied[:, :, ::-1].argmax(2)) * 0.1, np.nan)
    assert np.allclose(found.bottoms(), bottoms.T, equal_nan=True)
    assert np.allclose(found.tops(), tops.T, equal_nan=True)
    assert np.array_equal(found.known(), (part > 0).any(2).T)
    found.save(tmp_path / "heights.png")


def test_frontiers_are_free_beside_unknown(view, grid):
    part = inside(grid)
    beside = np.zeros(part.shape, bool)
    for axis in range(3):
        for step in (1, -1):
            moved = np.roll(part, step, axis) == 0
            edge = [slice(None)] * 3
            edge[axis] = 0 if step == 1 else -1
            moved[tuple(edge)] = False
            beside |= moved
    expected = np.argwhere((part == 1) & beside) + LOW - 13
    assert np.array_equal(sorted_rows(view.frontier_voxels(BOX)), sorted_rows(expected))
    clusters = view.frontiers(BOX, reach=0.5, cells_min=3)
    together = np.concatenate([cluster.voxels for cluster in clusters])
    assert len(np.unique(together, axis=0)) == len(together) == sum(len(cluster) for cluster in clusters)
    assert {tuple(row) for row in together} <= {tuple(row) for row in expected}
    for cluster in clusters:
        assert np.allclose(cluster.centroid, ((cluster.voxels + 0.5) * 0.1).mean(0))


@pytest.mark.parametrize("ending", [".ply", ".pcd", ".bt"])
def test_a_saved_map_is_read_back(view, tmp_path, ending):
    path = tmp_path / f"map{ending}"
    assert view.save(path) == sum(view.count())
    back = MapView.load(path)
    assert back.resolution == 0.1
    assert np.array_equal(sorted_rows(np.column_stack(back.voxels())), sorted_rows(np.column_stack(view.voxels())))
