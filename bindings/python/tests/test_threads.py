"""Robots, views and fields are used from several threads at once, and others run meanwhile."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from conftest import wall

import flockmap
from flockmap import Robot


def test_two_threads_use_one_robot():
    robot = Robot(1, resolution=0.1, range=7.0)
    before = robot.view()
    start = threading.Barrier(2)

    def scans():
        start.wait(30)
        for n in range(20):
            robot.insert_scan(wall(2.0 + n / 10, seed=n), np.eye(4), n / 10)

    def asks():
        start.wait(30)
        versions = []
        for n in range(200):
            view = robot.view()
            versions.append(view.version)
            robot.handle_timeout(n / 100)
            list(robot.transmits(n / 100))
            robot.counters()
        return versions

    with ThreadPoolExecutor(2) as pool:
        scanning, asking = pool.submit(scans), pool.submit(asks)
        scanning.result(120)
        versions = asking.result(120)
    assert versions == sorted(versions)
    assert robot.counters()["robot"]["scans"] == 20
    assert before.count() == (0, 0)


def test_a_robot_is_closed_while_another_thread_uses_it():
    robot = Robot(1, resolution=0.1, range=7.0)
    begun = threading.Event()

    def scans():
        n = 0
        try:
            while True:
                robot.insert_scan(wall(2.0, count=20_000), np.eye(4), float(n))
                begun.set()
                n += 1
        except flockmap.ClosedError:
            return n

    with ThreadPoolExecutor(1) as pool:
        scanning = pool.submit(scans)
        assert begun.wait(60)
        robot.close()
        assert scanning.result(60) >= 1


def test_python_goes_on_while_a_scan_is_inserted():
    """With the GIL held nothing would be counted in that time but at its ends."""
    robot = Robot(1, resolution=0.05, range=20.0)
    points = wall(15.0, count=400_000)
    is_over = threading.Event()
    counted = []

    def count():
        while not is_over.is_set():
            counted.append(time.perf_counter())

    with ThreadPoolExecutor(1) as pool:
        counting = pool.submit(count)
        while not counted:
            time.sleep(0.001)
        begin = time.perf_counter()
        robot.insert_scan(points, np.eye(4), 0.0)
        end = time.perf_counter()
        is_over.set()
        counting.result(60)
    middle = [at for at in counted if begin + 0.25 * (end - begin) < at < begin + 0.75 * (end - begin)]
    assert len(middle) > 10


def test_an_array_that_is_written_to_meanwhile_does_no_harm(random_map):
    view = flockmap.MapView.from_voxels(0.1, *random_map)
    points = np.zeros((200_000, 3))
    is_over = threading.Event()

    def write():
        random = np.random.default_rng(3)
        while not is_over.is_set():
            points[:] = random.normal(size=(1, 3)) * 10.0 ** random.integers(-3, 300)

    with ThreadPoolExecutor(1) as pool:
        writing = pool.submit(write)
        for _ in range(20):
            assert view.states(points).max() <= 2
        is_over.set()
        writing.result(60)


def test_many_threads_ask_a_field_that_is_brought_up_to_date(random_map):
    indices, states = random_map
    view = flockmap.MapView.from_voxels(0.1, indices, states)
    empty = flockmap.MapView.from_voxels(0.1, indices, np.ones(len(indices), np.uint8))
    field = view.distance_field(((-1.3, -1.3, -1.3), (1.4, 1.4, 1.4)))
    points = np.random.default_rng(1).uniform(-1.3, 1.4, (5000, 3))

    def ask(_):
        return field.clearances(points)[0]

    with ThreadPoolExecutor(4) as pool:
        answers = [pool.submit(ask, n) for n in range(20)]
        updates = [pool.submit(field.update, empty if n % 2 else view) for n in range(10)]
        for answer in answers:
            found = answer.result(60)
            # Of one map or of the other, never of both.
            assert np.isinf(found).all() or (found < 2).all()
        for update in updates:
            assert update.result(60) in ("unchanged", "partly", "anew")
