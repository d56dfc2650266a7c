"""Swarms beyond their radio, as their users have them: nodes, gateways, archives and ground stations in network namespaces,
with a router and clients of other people. usage: fleet.py FLOCKMAP FLOCKMAP_ZENOH OUT [NAME...]

Without a NAME all of it: flight, kills, access, garbage, liar, joined; beside these `size`. Prints what was measured; exits with 1 where something is not as it should be.
"""

import ctypes
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import zenoh

from world import ROUTER_PORT, World, ip, layers, wait_for

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
    for reply in session.get(f"flockmap/{swarm}/5/@holder/*/held", target=zenoh.QueryTarget.ALL, timeout=3.0):
        if reply.ok:
            name = str(reply.ok.key_expr).split("/")[4]
            said = json.loads(reply.ok.payload.to_string())
            answers[name] = {(s["origin"], s["epoch"]): s["held"] for s in said["streams"]}
    return answers


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
        before = received(world, "station2")
        start_station(world, "station2")
        time.sleep(1)
        began = time.monotonic()
        stranger = [len(r.ok.payload) for r in session.get("flockmap/7/5/**", timeout=30.0) if r.ok]
        print(f"      a stranger gets {len(stranger)} packages and chunks, {sum(stranger)} B, in "
              f"{time.monotonic() - began:.2f} s")
        snapshots = sum(len(r.ok.payload) for origin, epoch in held(session)["archive1"] for r in session.get(
            f"flockmap/7/5/@holder/archive1/get/{origin}-{epoch}?as=snapshot", timeout=30.0,
            accept_replies=zenoh.ReplyKeyExpr.ANY) if r.ok)
    time.sleep(6)
    tcp = received(world, "station2") - before
    for name in robots:
        check(f"{name} ends well", world.stop(name) == 0)
    for name in ("station1", "station2", "gateway1", "gateway2", "archive1", "archive2"):
        check(f"{name} ends well", world.stop(name) == 0)
    of_robots = [layers(world.report(name)) for name in robots]
    check(f"the robots agree on {len(of_robots[0])} layers", len(of_robots[0]) == len(robots)
          and all(one == of_robots[0] for one in of_robots))
    for name in ("station1", "station2", "gateway1", "gateway2", "archive1", "archive2"):
        said = world.fleet_report(name)["7"]
        check(f"{name} has every layer, voxel by voxel", layers(said) == of_robots[0])
        print("      " + ", ".join(f"{key[6:]} {value}" for key, value in said["counters"]["beside"].items() if value))
    late = world.fleet_report("station2")["7"]["counters"]["beside"]
    payload = late["zenoh_fetched_bytes"] + late["zenoh_taken_bytes"]
    packages = sum(world.report(name)["counters"]["robot"]["package_bytes"] for name in robots)
    print(f"      what the robots have made: {packages} B of packages; as snapshots of their layers it is {snapshots} B")
    check(f"the late one got {payload} B of payload, {tcp} B by TCP: at most 1.1 times the maps coded once",
          snapshots > 0 and payload <= 1.1 * min(packages, snapshots))


def kills(world, records):
    """The same with one gateway, one archive and the router killed and started again in between."""
    return flight(world, records, kills=True)


CERTIFICATES = pathlib.Path(__file__).parent.parent / "scripts" / "certificates.sh"
EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"


def tls(world, name):
    """The configuration of a client by the example, with the certificate of somebody."""
    text = (EXAMPLES / "client.json5").read_text()
    text = text.replace("router.example:7447", f"{world.address('router')}:{ROUTER_PORT}")
    text = text.replace("certificates/station", f"{world.out}/certificates/{name}")
    path = world.out / f"{name}-client.json5"
    path.write_text(text.replace("certificates/ca", f"{world.out}/certificates/ca"))
    return path


def access(world, records):
    """TLS and access control by the examples. Who has no certificate, and who may only read, tries everything."""
    for name in ("router", "archive", "station", "stranger"):
        world.place(name, fleet=True)
    robots = fly(world, records[:1], gateways=("gateway",))
    subprocess.run([CERTIFICATES, world.out / "certificates", world.address("router"), "gateway", "archive", "station",
                    "guest"], check=True, stdout=subprocess.DEVNULL)
    text = (EXAMPLES / "router.json5").read_text().replace("certificates/", f"{world.out}/certificates/")
    (world.out / "router.json5").write_text(text)
    script = pathlib.Path(__file__).with_name("router.py")
    world.run("router", "router", sys.executable, script, world.out / "router.json5",
              environment={"RUST_LOG": "warn,zenoh::net::routing::interceptor::access_control=trace"})
    time.sleep(1)
    world.run("gateway", "gateway", world.fleet, "gateway", "--config", world.out / "gateway.toml",
              "--zenoh", tls(world, "gateway"), "--name", "gateway", "--period-s", 2)
    world.run("archive", "archive", world.fleet, "archive", "--store", world.out / "archive-store", "--swarm", 7,
              "--zenoh", tls(world, "archive"), "--name", "archive", "--period-s", 2, *METRICS)
    world.run("station", "station", world.fleet, "station", "--swarm", 7, "--zenoh", tls(world, "station"),
              "--name", "station", "--period-s", 2)
    start_node(world, robots[0])
    enter(world, "stranger")
    time.sleep(SECONDS / SPEED / 2)

    # Without a certificate, and with one of another authority.
    for what, config in (("no certificate", None), ("a certificate of another authority", "foreign")):
        if config:
            subprocess.run([CERTIFICATES, world.out / "foreign", world.address("router"), "archive"], check=True,
                           stdout=subprocess.DEVNULL)
        text = tls(world, "archive").read_text().replace("timeout_ms: -1", "timeout_ms: 3000")
        text = text.replace("exit_on_failure: false", "exit_on_failure: true")
        if config:
            text = text.replace(f"{world.out}/certificates/archive", f"{world.out}/foreign/archive")
        else:
            text = "\n".join(line for line in text.splitlines() if "connect_" not in line)
        path = world.out / "refused.json5"
        path.write_text(text)
        try:
            zenoh.open(zenoh.Config.from_file(str(path))).close()
            answer = "it was let in"
        except zenoh.ZError as error:
            answer = str(error)
        check(f"{what}: {answer.splitlines()[0][:110]}", answer != "it was let in")

    # As one who may only read; then with a certificate of the right authority, and no rule.
    for who in ("station", "guest"):
        seen = []
        with zenoh.open(zenoh.Config.from_file(str(tls(world, who)))) as session:
            session.declare_subscriber("flockmap/7/**", seen.append)
            session.declare_subscriber("flockmap/8/**", seen.append)
            time.sleep(3)
            replies = [r for r in session.get("flockmap/7/5/**", timeout=5.0) if r.ok]
            held_there = held(session)
            # What it puts itself it sees too.
            seen_there = len(seen)
            before = world.counter("archive", "zenoh_refused")
            for index in range(1, 200):
                session.put(f"flockmap/7/5/1-99/{index}", b"x" * 100)
                session.put(f"flockmap/7/5/@holder/{who}/held", b"{}")
                session.delete(f"flockmap/7/5/1-99/{index}")
            session.delete("flockmap/7/5/**")
            time.sleep(5)
            after = world.counter("archive", "zenoh_refused")
            if who == "guest":
                check(f"a guest reads nothing: {len(replies)} replies, {len(held_there)} holders, {seen_there} samples",
                      not replies and not held_there and not seen_there)
            else:
                check(f"a station reads: {len(replies)} replies, {len(held_there)} holders, {seen_there} samples",
                      replies and held_there and seen_there)
            check(f"a {who} writes and deletes nothing: the archive refused {after - before}", after == before)
    answers = [line for line in (world.out / "router.out").read_text().splitlines() if "unauthorized" in line.lower() or "not authorized" in line.lower()]
    print(f"      the router says so {len(answers)} times, such as: {answers[0][-160:] if answers else 'nothing'}")
    time.sleep(SECONDS / SPEED / 2)
    for name in (robots[0], "station", "archive", "gateway"):
        check(f"{name} ends well", world.stop(name) == 0)
    of_robot = layers(world.report(robots[0]))
    for name in ("station", "archive", "gateway"):
        check(f"{name} has every layer, voxel by voxel", layers(world.fleet_report(name)["7"]) == of_robot)


def memory(world, name):
    """Resident KiB of a program, now and at most."""
    pid = subprocess.run(["ip", "netns", "pids", f"{world.prefix}-{name}"], capture_output=True, text=True).stdout.split()
    for one in pid:
        status = pathlib.Path(f"/proc/{one}/status").read_text()
        if "flockmap-zenoh" in status:
            values = dict(line.split(":", 1) for line in status.splitlines())
            return int(values["VmRSS"].split()[0]), int(values["VmHWM"].split()[0])
    raise LookupError(f"{name} does not run")


def garbage(world, records):
    """Values of 0 B and 16 MB, packages under keys of others, bent ones, and a million keys of nobody."""
    for name in ("router", "archive", "station", "stranger"):
        world.place(name, fleet=True)
    robots = fly(world, records[:1], gateways=("gateway",))
    world.router()
    time.sleep(1)
    start_gateway(world, "gateway")
    start_archive(world, "archive", *METRICS)
    start_station(world, "station", *METRICS)
    start_node(world, robots[0])
    time.sleep(SECONDS / SPEED + 2)
    enter(world, "stranger")
    with client(world, "router") as session:
        wait_for("all of the flight", lambda: all_agree(session, ["gateway", "archive"]), 60)
        sound = {str(r.ok.key_expr): r.ok.payload.to_bytes() for r in session.get("flockmap/7/5/**", timeout=30.0) if r.ok}
        before = {name: memory(world, name) for name in ("archive", "station")}
        put, key = 0, next(iter(sound))
        stream = "/".join(key.split("/")[:4])

        def give(key, value):
            nonlocal put
            session.put(key, value, congestion_control=zenoh.CongestionControl.BLOCK)
            put += 1

        began = time.monotonic()
        for length in (0, 1, 13, 1150, 1151, 70_000, 16_000_000):
            for at in (f"{stream}/100000", f"{stream}/snapshot/00000001/0", f"{stream}/snapshot/00000001/contents",
                       "flockmap/7/5/9-9/1", "flockmap/7/5/nonsense", "flockmap/7/5/9-9/1/2/3"):
                give(at, b"\xff" * length)
        for index, (key, value) in enumerate(list(sound.items())[:200]):
            give(f"{stream}/{200_000 + index}", value)
            bent = bytearray(value)
            bent[index * 7 % len(bent)] ^= 1 << index % 8
            give(key, bytes(bent))
            session.delete(key)
        session.delete("flockmap/7/5/**")
        for number in range(1_000_000):
            give(f"flockmap/{number % 5 + 7}/5/{number % 60_000}-{number}/{number}", b"")
        print(f"      {put} values put in {time.monotonic() - began:.0f} s")
        wait_for("the end of it", lambda: world.counter("station", "zenoh_refused") > 0
                 and still(lambda: world.counter("station", "zenoh_refused")), 120)
        for name in ("archive", "station"):
            (resident, _), (now, most) = before[name], memory(world, name)
            refused = world.counter(name, "zenoh_refused")
            print(f"      {name}: refused {refused}; memory {resident >> 10} MiB before, {now >> 10} after, at most {most >> 10}")
            check(f"{name} has bounded memory", most < resident + (96 << 10))
        again = {str(r.ok.key_expr): r.ok.payload.to_bytes() for r in session.get("flockmap/7/5/**", timeout=30.0) if r.ok}
        check(f"what a stranger gets is as before: {len(again)} packages", again == sound)
        give(f"flockmap/7/5/@holder/stranger/held", b"{")
    for name in (robots[0], "station", "archive", "gateway"):
        check(f"{name} ends well", world.stop(name) == 0)
    of_robot = layers(world.report(robots[0]))
    for name in ("station", "archive", "gateway"):
        said = world.fleet_report(name)["7"]
        check(f"{name} has every layer, voxel by voxel", layers(said) == of_robot)
        print(f"      {name}: damaged {said['counters']['robot']['damaged']}, dropped {said['counters']['beside']['zenoh_dropped']}")


def liar(world, records):
    """A holder that gives bent packages, of more than there are, and turns honest later: nothing wrong stays."""
    for name in ("router", "station", "stranger"):
        world.place(name, fleet=True)
    robots = fly(world, records[:1], gateways=("gateway",))
    world.router()
    time.sleep(1)
    start_gateway(world, "gateway")
    start_node(world, robots[0])
    time.sleep(SECONDS / SPEED + 3)
    enter(world, "stranger")
    with client(world, "router") as session:
        (stream, intervals), = held(session)["gateway"].items()
        text = f"{stream[0]}-{stream[1]}"
        get = session.get(f"flockmap/7/5/@holder/gateway/get/{text}?_anyke", timeout=10.0,
                          consolidation=zenoh.ConsolidationMode.NONE)
        sound = [(str(r.ok.key_expr).replace("flockmap/7/", "flockmap/9/"), r.ok.payload.to_bytes()) for r in get if r.ok]
        check(f"a stranger asks a gateway for all of a run: {len(sound)} packages", len(sound) > 100)
        is_honest, asked = False, 0

        def answer(query):
            nonlocal asked
            key = str(query.key_expr)
            if key.endswith("/held"):
                more = "" if is_honest else ",1000000-4000000000"
                said = {"digest": f"{is_honest}", "now_us": 0, "resolution_um": 100_000,
                        "streams": [{"origin": stream[0], "epoch": stream[1], "held": intervals + more}]}
                query.reply("flockmap/9/5/@holder/liar/held", json.dumps(said))
                return
            asked += 1
            if is_honest:
                # What the gateway says, under other keys.
                there = f"{key.replace('flockmap/9/', 'flockmap/7/').replace('liar', 'gateway')}?{query.parameters}"
                for reply in session.get(there, timeout=10.0, consolidation=zenoh.ConsolidationMode.NONE):
                    if reply.ok:
                        query.reply(str(reply.ok.key_expr).replace("flockmap/7/", "flockmap/9/"), reply.ok.payload)
                return
            for index, (key, value) in enumerate(sound):
                bent = bytearray(value)
                if index % 3:
                    bent[-1 - index % 40] ^= 1 << index % 8
                query.reply(key, bytes(bent))

        queryable = session.declare_queryable("flockmap/9/5/@holder/liar/**", answer)
        token = session.liveliness().declare_token("flockmap/9/5/@holder/liar")
        start_station(world, "station", "--swarm", 9, *METRICS)
        wait_for("damaged packages", lambda: asked and world.counter("station", "robot_damaged") > 0, 60)
        time.sleep(30)
        damaged, times = world.counter("station", "robot_damaged"), asked
        is_honest = True
        time.sleep(60)
        print(f"      {damaged} damaged packages in {times} answers of the liar, {asked - times} honest answers after that")
        check("it is not asked all the time", times < 8)
        token.undeclare()
        queryable.undeclare()
    for name in (robots[0], "station", "gateway"):
        check(f"{name} ends well", world.stop(name) == 0)
    check("the station has the layer, voxel by voxel",
          layers(world.fleet_report("station")["9"]) == layers(world.report(robots[0])))


def still(value, seconds=2):
    """Whether a value stays as it is."""
    before = value()
    time.sleep(seconds)
    return value() == before


def received(world, place):
    """Bytes that came to a place from the network beyond the radio."""
    text = subprocess.run(["ip", "netns", "exec", f"{world.prefix}-{place}", "cat", "/sys/class/net/fleet/statistics/rx_bytes"],
                          check=True, capture_output=True, text=True).stdout
    return int(text)


def joined(world, records):
    """Two swarms over a link of 20 KB/s that is cut for 60 s in the middle."""
    rate = 20
    for name in ("router", "end1", "end2"):
        world.place(name, fleet=True)
    sites = {1: records[0], 2: records[1]}
    for site, record in sites.items():
        world.place(f"site{site}", fleet=True)
    # One list for the radio, though each site has its own: they do not hear each other.
    everybody = [f"{kind}{site}" for site in sites for kind in ("robot", "gateway")]
    for name in everybody:
        world.place(name, radio=True, fleet=name.startswith("gateway"))
    world.radio([world.numbers[name] for name in everybody], LOSS)
    for at, name in enumerate(everybody):
        site = int(name[-1])
        sensor = f'record = "{sites[site]}"\nspeed = 1.0' if name.startswith("robot") else ""
        world.node_config(name, world.numbers[name], [(at ^ 1) + 1], swarm=site, sensor=sensor)
    for end in ("end1", "end2"):
        subprocess.run(["tc", "-n", f"{world.prefix}-{end}", "qdisc", "add", "dev", "fleet", "root", "tbf", "rate", "160kbit",
                        "burst", "4kb", "latency", "400ms"], check=True)
    for site in sites:
        world.router(f"router{site}", f"site{site}")
    time.sleep(1)
    for site in sites:
        start_gateway(world, f"gateway{site}", "--take", router=f"site{site}")
        way = ("--link-listen", f"tcp/{world.address('end1')}:7448") if site == 1 else \
              ("--link-connect", f"tcp/{world.address('end1')}:7448")
        world.run(f"end{site}", f"end{site}", world.fleet, "join", "--swarm", site, "--id", 60_000 + site, "--link", "far",
                  "--rate-kb-s", rate * 0.9, "--connect", world.endpoint(f"site{site}"), *way, "--name", f"end{site}",
                  "--period-s", 2, *METRICS)
        start_node(world, f"robot{site}")
    length = SECONDS
    time.sleep(length * 0.3)
    ip("-n", world.hub, "link", "set", f"f{world.numbers['end2']}", "down")
    time.sleep(60)
    ip("-n", world.hub, "link", "set", f"f{world.numbers['end2']}", "up")
    most, last, end = 0, received(world, "end1"), time.monotonic() + 60
    while time.monotonic() < end:
        time.sleep(1)
        now = received(world, "end1")
        most, last = max(most, now - last), now
    for name in ("robot1", "robot2", "end1", "end2", "gateway1", "gateway2"):
        check(f"{name} ends well", world.stop(name) == 0)
    of = {name: layers(world.report(name)) for name in ("robot1", "robot2")}
    for name in ("gateway1", "gateway2", "end1", "end2"):
        of[name] = layers(next(iter(world.fleet_report(name).values())))
    print(f"      layers: {({name: len(one) for name, one in of.items()})}; at most {most} B a second came to an end, "
          "with what its own site sends it")
    check("all have equal maps of both sites", len(of["robot1"]) == 2 and all(one == of["robot1"] for one in of.values()))


METRICS = ("--metrics", "127.0.0.1:9464")


def fly_gateways(world, records, swarms):
    """Robots without a radio, each a gateway of its swarm with a sensor."""
    robots = [f"robot{number + 1}" for number in range(len(records))]
    for name, record, swarm in zip(robots, records, swarms):
        number = world.place(name, radio=True, fleet=True)
        world.node_config(name, number, [], swarm=swarm, sensor=f'record = "{record}"\nspeed = {SPEED}')
        path = world.out / f"{name}.toml"
        path.write_text(path.read_text().replace("[output]", f'[output]\nsave_map_at_end = "{name}.bt"'))
        start_gateway(world, name)
    return robots


def swarms(world, records):
    """A station that finds two swarms and mutes a robot: a map for planners, a file and a page of each."""
    for name in ("router", "station"):
        world.place(name, fleet=True)
    world.router()
    time.sleep(1)
    robots = fly_gateways(world, records, (7, 7, 8))
    (world.out / "muted.toml").write_text(f"[fusion]\nmuted = [{world.numbers['robot2']}]\n")
    start_station(world, "station", "--config", world.out / "muted.toml", "--map", world.out / "map{swarm}.sock",
                  "--save", world.out / "map{swarm}.bt", "--view", "127.0.0.1:7781")
    time.sleep(SECONDS / SPEED + 8)
    for swarm in (7, 8):
        subprocess.run([world.flockmap, "mirror", f"unix:{world.out}/map{swarm}.sock", "--once", "--out",
                        world.out / f"mirror{swarm}.bt"], check=True, stdout=subprocess.DEVNULL, timeout=60)
    pages = [world.get("station", f"http://127.0.0.1:{port}/") for port in (7781, 7782)]
    check("each swarm has a page", all("<html" in page for page in pages))
    for name in (*robots, "station"):
        check(f"{name} ends well", world.stop(name) == 0)
    said = world.fleet_report("station")
    of = {name: layers(next(iter(world.fleet_report(name).values()))) for name in robots}
    check("the station has the layers of swarm 7", layers(said["7"]) == of["robot1"] | of["robot2"])
    check("the station has the layer of swarm 8", layers(said["8"]) == of["robot3"])
    for swarm, robot in ((7, "robot1"), (8, "robot3")):
        files = [world.out / f"{name}.bt" for name in (f"map{swarm}", f"mirror{swarm}", robot)]
        check(f"swarm {swarm}: a planner reads what the file has", files[0].read_bytes() == files[1].read_bytes())
        ours, _, theirs = (facts(world, file) for file in files)
        # What a robot does not know any more it has told before.
        check(f"swarm {swarm}: that is the map of {robot}, {ours['occupied']} occupied and {ours['free']} free voxels",
              ours["bounds_m"] == theirs["bounds_m"]
              and all(0 <= ours[state] - theirs[state] <= theirs[state] // 50 for state in ("occupied", "free")))


def facts(world, file):
    """What a map file has, as the program tells it."""
    out = file.with_suffix(".json")
    subprocess.run([world.flockmap, "info", file, "--json", out], check=True, stdout=subprocess.DEVNULL)
    return json.loads(out.read_text())["content"]


def disk(world, records):
    """An archive whose disk is full, has room again, and loses its power."""
    for name in ("router", "archive", "stranger"):
        world.place(name, fleet=True)
    store = world.out / "archive-store"
    store.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=100k", "none", store], check=True)
    try:
        world.router()
        time.sleep(1)
        robots = fly_gateways(world, records, (7, 7, 7))
        start_archive(world, "archive")
        time.sleep(SECONDS / SPEED + 3)
        enter(world, "stranger")
        with client(world, "router") as session:
            wait_for("all that the robots have, in the archive", lambda: all_held(session, "archive", robots), 60)
            all_of_it = held(session)["archive"]
            packages = sorted(str(r.ok.key_expr) for r in session.get("flockmap/7/5/**", timeout=30.0) if r.ok)
            print(f"      a full disk: {len(packages)} packages are told all the same")
            print("      " + world.said("archive", "store"))
            subprocess.run(["mount", "-o", "remount,size=64m", store], check=True)
            wait_for("what lacks on disk", lambda: on_disk(store) > 200_000, 120)
            time.sleep(3)
            for name in (*robots, "archive"):
                world.stop(name, signal.SIGKILL)
            start_archive(world, "archive")
            wait_for("the archive once more", lambda: held(session).get("archive") is not None, 60)
            check("after its disk had room again and a SIGKILL the archive has all from its disk",
                  held(session)["archive"] == all_of_it)
        check("the archive ends well", world.stop("archive") == 0)
    finally:
        for name in world.programs:
            world.stop(name, signal.SIGKILL)
        subprocess.run(["umount", store], check=False)


def on_disk(folder):
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def all_held(session, name, by):
    """Whether a holder has what these have together."""
    said = held(session)
    union = {stream: have for one in by for stream, have in said.get(one, {}).items()}
    return len(union) == len(by) and said.get(name) == union


def size(world, records):
    """An archive of many packages, by ROBOTS, PACKAGES of each, STATIONS at once and CONFIG: rates, memory, a restart."""
    stations = [f"station{number + 1}" for number in range(int(os.environ.get("STATIONS", 0)))]
    for name in ("router", "archive", "maker", "station", "stranger", *stations):
        world.place(name, fleet=True)
    robots, packages = int(os.environ.get("ROBOTS", 10)), int(os.environ.get("PACKAGES", 1_000))
    world.router()
    time.sleep(1)
    # Somebody has to say what voxels there are before anything is taken.
    enter(world, "stranger")
    with client(world, "router") as session:
        said = json.dumps({"digest": "0", "now_us": 0, "resolution_um": 100_000, "streams": []})
        first = session.declare_queryable("flockmap/7/5/@holder/first/**",
                                          lambda query: query.reply("flockmap/7/5/@holder/first/held", said))
        token = session.liveliness().declare_token("flockmap/7/5/@holder/first")
        more = ["--config", os.environ["CONFIG"]] if "CONFIG" in os.environ else []
        start_archive(world, "archive", "--swarm", 7, *METRICS, *more)
        wait_for("the archive", lambda: "archive" in held(session), 30)
        token.undeclare()
        first.undeclare()
        began = time.monotonic()
        maker = world.run("maker", "maker", world.fleet.parent / "examples" / "many", world.endpoint(), robots, packages)
        count = 0
        wanted = robots * packages

        def is_there():
            nonlocal count
            streams = held(session).get("archive", {})
            count = sum(int(part.split("-")[1]) - int(part.split("-")[0]) + 1
                        for text in streams.values() for part in text.split(","))
            return maker.poll() is not None and count >= wanted

        try:
            wait_for("all packages", is_there, 3_000)
        except TimeoutError:
            print(f"      {count} of {wanted}, dropped {world.counter('archive', 'zenoh_dropped')}")
            raise
        took = time.monotonic() - began
        print(f"      in: {(world.out / 'maker.out').read_text().strip()}; {wanted / took:.0f} a second, made here too")
        resident, most = memory(world, "archive")
        print(f"      archive: memory {resident >> 10} MiB, at most {most >> 10}; "
              f"{on_disk(world.out / 'archive-store') >> 20} MiB on disk")
        for what in ("late", "once more"):
            come_late(world, what, ["station"], wanted, more)
        if stations:
            come_late(world, f"{len(stations)} at once", stations, wanted, more)
        check("the archive ends well", world.stop("archive", timeout=300) == 0)
        began = time.monotonic()
        start_archive(world, "archive", "--swarm", 7, *METRICS, *more)
        wait_for("the archive once more", lambda: sum(
            int(part.split("-")[1]) - int(part.split("-")[0]) + 1
            for text in held(session).get("archive", {}).values() for part in text.split(",")) >= wanted, 3_000)
        print(f"      restart: {time.monotonic() - began:.1f} s; memory {memory(world, 'archive')[0] >> 10} MiB")


def come_late(world, what, stations, wanted, more):
    """Stations that come all at once get all there is."""
    before, began = {name: received(world, name) for name in stations}, time.monotonic()
    for name in stations:
        start_station(world, name, "--swarm", 7, *METRICS, *more)
    time.sleep(1)

    def fetched():
        return [maybe(lambda: world.counter(name, "zenoh_fetched"), -1) for name in stations]

    wait_for("late ones", lambda: min(fetched()) >= 0 and still(fetched, 3), 3_000)
    took = time.monotonic() - began - 3
    most = max(memory(world, name)[1] for name in stations) >> 10
    payload = sum(world.counter(name, "zenoh_fetched_bytes") for name in stations)
    tcp = sum(received(world, name) - before[name] for name in stations)
    for name in stations:
        check(f"{name} ends well", world.stop(name) == 0)
    of_all = [world.fleet_report(name)["7"]["streams"] for name in stations]
    there = min(sum(high - low + 1 for s in streams for low, high in s["received"]) for streams in of_all)
    check(f"{what}: a station has {there} of {wanted} packages' worth in {took:.0f} s, {payload} B of payload, "
          f"{tcp} B came by TCP; memory at most {most} MiB", there == wanted)


def maybe(value, otherwise):
    """A value, if it is there yet."""
    try:
        return value()
    except subprocess.CalledProcessError:
        return otherwise


def main():
    flockmap, fleet, out, *names = sys.argv[1:]
    out = pathlib.Path(out).resolve()
    records = [out / "records" / f"robot{number}.mcap" for number in (1, 2, 3)]
    if not all(record.exists() for record in records):
        subprocess.run([flockmap, "sim", "fly", "--scene", "forest", "--robots", "3", "--seconds", str(SECONDS),
                        "--out", str(out / "records")], check=True, stdout=subprocess.DEVNULL)
    checks = (flight, kills, access, garbage, liar, joined, swarms, disk)
    tests = {test.__name__: test for test in (*checks, size)}
    for name in names or [check.__name__ for check in checks]:
        print(f"== {name}: {tests[name].__doc__}", flush=True)
        with World(out / name, flockmap, pathlib.Path(fleet).resolve()) as world:
            world.resolution, world.range = 0.1, 7.0
            tests[name](world, records)


if __name__ == "__main__":
    main()
