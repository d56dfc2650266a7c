"""Swarms beyond their radio, as their users have them: nodes, gateways, archives and ground stations in network namespaces,
with a router and clients of other people. usage: fleet.py FLOCKMAP FLOCKMAP_ZENOH OUT [NAME...]

Without a NAME all of it: flight, kills. Prints what was measured; exits with 1 where something is not as it should be.
"""

import pathlib
import signal
import sys
import time

import zenoh

from world import World, layers, wait_for

SECONDS, SPEED, LOSS = 40, 2, 0.3


def check(what, is_so):
    print(("ok    " if is_so else "FAULT ") + what, flush=True)
    if not is_so:
        raise AssertionError(what)


def fly(world, records, gateways=("gateway1", "gateway2")):
    """Starts the radio, a node for each record, and gateways without a sensor."""
    robots = [f"robot{number + 1}" for number in range(len(records))]
    everybody = [*robots, *gateways]
    for name in everybody:
        world.place(name, radio=True, fleet=name in gateways)
    world.radio([world.numbers[name] for name in everybody], LOSS)
    for at, name in enumerate(everybody):
        others = [other + 1 for other in range(len(everybody)) if other != at]
        is_robot = name in robots
        sensor = f'record = "{records[robots.index(name)]}"\nspeed = {SPEED}' if is_robot else ""
        world.node_config(name, world.numbers[name], others, sensor=sensor)
    return robots


def start_node(world, name):
    world.run(name, name, world.flockmap, "node", "--config", world.out / f"{name}.toml")


def start_gateway(world, name, *words, router="router"):
    world.run(name, name, world.fleet, "gateway", "--config", world.out / f"{name}.toml",
              "--connect", world.endpoint(router), "--name", name, "--period-s", 2, *words)


def start_archive(world, name, *words):
    world.run(name, name, world.fleet, "archive", "--store", world.out / f"{name}-store",
              "--connect", world.endpoint(), "--name", name, "--period-s", 2, *words)


def start_station(world, name, *words):
    world.run(name, name, world.fleet, "station", "--connect", world.endpoint(), "--name", name,
              "--period-s", 2, *words)


def held(session, swarm=7):
    """What each holder holds: streams with the intervals of their packages."""
    answers = {}
    for reply in session.get(f"flockmap/{swarm}/4/@holder/*/held", target=zenoh.QueryTarget.ALL, timeout=3.0):
        if reply.ok:
            name = str(reply.ok.key_expr).split("/")[4]
            said = zenoh_json(reply.ok.payload)
            answers[name] = {(s["origin"], s["epoch"]): s["held"] for s in said["streams"]}
    return answers


def zenoh_json(payload):
    import json

    return json.loads(payload.to_string())


def client(world, place):
    """A client of other people. It lives in the namespace of the router, by a thread that has gone there."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{world.endpoint(place)}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    return zenoh.open(config)


def enter(world, place):
    """This process goes to a namespace, and stays there."""
    import ctypes
    import os

    libc = ctypes.CDLL(None, use_errno=True)
    with open(f"/run/netns/{world.prefix}-{place}", "rb") as space:
        if libc.setns(space.fileno(), 0x40000000) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def all_agree(session, names, swarm=7):
    said = held(session, swarm)
    lists = [said.get(name) for name in names]
    return None not in lists and lists[0] and all(one == lists[0] for one in lists)


def flight(world, records, kills=False):
    """Three nodes under 30 % loss, two gateways, two archives, a ground station from the start and a late one."""
    for name in ("router", "archive1", "archive2", "station1", "station2", "stranger"):
        world.place(name, fleet=True)
    robots = fly(world, records)
    world.router()
    time.sleep(1)
    for name in ("gateway1", "gateway2"):
        start_gateway(world, name)
    for name in ("archive1", "archive2"):
        start_archive(world, name)
    start_station(world, "station1")
    for name in robots:
        start_node(world, name)
    length = SECONDS / SPEED
    if kills:
        time.sleep(length * 0.3)
        for name in ("gateway1", "archive1"):
            world.stop(name, signal.SIGKILL)
        time.sleep(length * 0.15)
        world.stop("router", signal.SIGKILL)
        time.sleep(length * 0.15)
        world.router()
        start_gateway(world, "gateway1")
        start_archive(world, "archive1")
        time.sleep(length * 0.4 + 1)
    else:
        time.sleep(length + 1)
    enter(world, "stranger")
    with client(world, "router") as session:
        wait_for("all that the robots have, at both gateways and both archives",
                 lambda: all_agree(session, ["gateway1", "gateway2", "archive1", "archive2"]), 120)
        # All is merged where it is held; what the robots still send each other is another matter.
        time.sleep(6)
        start_station(world, "station2")
        time.sleep(1)
        began = time.monotonic()
        stranger = [len(r.ok.payload) for r in session.get("flockmap/7/4/**", timeout=30.0) if r.ok]
        print(f"      a stranger gets {len(stranger)} packages and chunks, {sum(stranger)} B, in "
              f"{time.monotonic() - began:.2f} s")
    time.sleep(6)
    for name in robots:
        check(f"{name} ends well", world.stop(name) == 0)
    for name in ("station1", "station2", "gateway1", "gateway2", "archive1", "archive2"):
        check(f"{name} ends well", world.stop(name) == 0)
    of_robots = [layers(world.report(name)) for name in robots]
    check(f"the robots agree on {len(of_robots[0])} layers", len(of_robots[0]) == len(robots)
          and all(one == of_robots[0] for one in of_robots))
    for name in ("station1", "station2", "gateway1", "gateway2", "archive1", "archive2"):
        said = world.fleet_report(name)["7"]
        check(f"{name} has every layer, voxel by voxel", layers(said["node"]) == of_robots[0])
        print("      " + ", ".join(f"{key[6:]} {value}" for key, value in said["zenoh"].items() if value))
    late = world.fleet_report("station2")["7"]["zenoh"]
    payload = late["zenoh_fetched_bytes"] + late["zenoh_taken_bytes"]
    print(f"      the late one got {payload} B of payload")
    return payload, sum(stranger)


def kills(world, records):
    """The same with one gateway, one archive and the router killed and started again in between."""
    return flight(world, records, kills=True)


def main():
    flockmap, fleet, out, *names = sys.argv[1:]
    import subprocess

    out = pathlib.Path(out).resolve()
    records = [out / "records" / f"robot{number}.mcap" for number in (1, 2, 3)]
    if not all(record.exists() for record in records):
        subprocess.run([flockmap, "sim", "fly", "--scene", "forest", "--robots", "3", "--seconds", str(SECONDS),
                        "--out", str(out / "records")], check=True, stdout=subprocess.DEVNULL)
    tests = {test.__name__: test for test in (flight, kills)}
    for name in names or tests:
        print(f"== {name}: {tests[name].__doc__}", flush=True)
        with World(out / name, flockmap, fleet) as world:
            world.resolution, world.range = 0.1, 7.0
            tests[name](world, records)


if __name__ == "__main__":
    main()
