"""Network namespaces on two bridges: the radio of a swarm, which loses what it is told to lose, and the network beyond it.

Needs root, iproute2 and the kernel's bridges and veth pairs.
"""

import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time

RADIO, FLEET = "10.77.0", "10.78.0"
RADIO_PORT, ROUTER_PORT = 7600, 7447


def ip(*words):
    subprocess.run(["ip", *map(str, words)], check=True, stdout=subprocess.DEVNULL)


class World:
    """All namespaces, programs and files of a test. Use it in a `with`: nothing of it stays."""

    def __init__(self, out, flockmap, fleet):
        self.out = pathlib.Path(out)
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.mkdir(parents=True)
        self.flockmap, self.fleet = flockmap, fleet
        self.prefix = f"fleet{os.getpid()}"
        self.spaces, self.programs, self.numbers = [], {}, {}

    def __enter__(self):
        self.hub = self.space("hub")
        for bridge, net in (("radio", RADIO), ("fleet", FLEET)):
            ip("-n", self.hub, "link", "add", bridge, "type", "bridge")
            ip("-n", self.hub, "addr", "add", f"{net}.100/24", "dev", bridge)
            ip("-n", self.hub, "link", "set", bridge, "up")
        return self

    def __exit__(self, *_):
        for program in self.programs.values():
            if program.poll() is None:
                program.kill()
                program.wait()
        for space in self.spaces:
            subprocess.run(["ip", "netns", "del", space], check=False)

    def space(self, name):
        space = f"{self.prefix}-{name}"
        ip("netns", "add", space)
        self.spaces.append(space)
        ip("-n", space, "link", "set", "lo", "up")
        return space

    def place(self, name, radio=False, fleet=False):
        """A namespace with an address on the bridges."""
        number = self.numbers.setdefault(name, len(self.numbers) + 1)
        space = self.space(name)
        for bridge, net, wanted in (("radio", RADIO, radio), ("fleet", FLEET, fleet)):
            if wanted:
                outer = f"{bridge[0]}{number}"
                ip("-n", space, "link", "add", bridge, "type", "veth", "peer", "name", outer, "netns", self.hub)
                ip("-n", self.hub, "link", "set", outer, "master", bridge, "up")
                ip("-n", space, "addr", "add", f"{net}.{number}/24", "dev", bridge)
                ip("-n", space, "link", "set", bridge, "up")
        return number

    def run(self, name, place, *words, environment=None):
        """Starts a program in a namespace; what it says goes to NAME.log."""
        space = self.hub if place == "hub" else f"{self.prefix}-{place}"
        with open(self.out / f"{name}.log", "ab") as log, open(self.out / f"{name}.out", "wb") as out:
            self.programs[name] = subprocess.Popen(
                ["ip", "netns", "exec", space, *map(str, words)],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=log,
                env={**os.environ, **(environment or {})},
            )
        return self.programs[name]

    def router(self, name="router", place="router", config=None):
        path = self.out / f"{name}.json5"
        base = {
            "mode": "router",
            "listen": {"endpoints": [f"tcp/0.0.0.0:{ROUTER_PORT}"]},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {"shared_memory": {"enabled": False}},
        }
        path.write_text(json.dumps({**base, **(config or {})}))
        script = pathlib.Path(__file__).with_name("router.py")
        return self.run(name, place, sys.executable, script, path)

    def address(self, place):
        return f"{FLEET}.{self.numbers[place]}"

    def endpoint(self, place="router", protocol="tcp"):
        return f"{protocol}/{self.address(place)}:{ROUTER_PORT}"

    def radio(self, robots, loss):
        """Carries datagrams between the robots of these numbers: what is for the n-th goes to its n-th port."""
        addresses = [f"{RADIO}.{number}:7700" for number in robots]
        return self.run("radio", "hub", self.flockmap, "radio", *addresses, "--listen", f"{RADIO}.100:{RADIO_PORT}",
                        "--loss", loss)

    def node_config(self, name, number, others, swarm=7, sensor="", more=""):
        """The configuration of a node; `others` are places in the list of the radio, from 1."""
        peers = ", ".join(f'"{RADIO}.100:{RADIO_PORT + at}"' for at in others)
        path = self.out / f"{name}.toml"
        path.write_text(f"""id = {number}
name = "{name}"
[map]
resolution_m = {self.resolution}
range_m = {self.range}
[session]
swarm = {swarm}
[state]
path = "state"
[network]
bind = "{RADIO}.{number}:7700"
peers = [{peers}]
[batch]
obstacle_period_ms = 100
[sensor]
{sensor}
[metrics]
status_period_s = 5
[output]
report_json = "{name}.json"
{more}
""")
        return path

    def counter(self, name, counter, place=None, port=9464):
        """A counter of a program that serves them on the loopback of its namespace."""
        text = self.get(place or name, f"http://127.0.0.1:{port}/metrics")
        lines = [line for line in text.splitlines() if line.startswith(f"flockmap_{counter}_total{{")]
        return int(float(lines[0].rsplit(" ", 1)[1]))

    def get(self, place, address):
        """What is served there, as the namespace sees it."""
        read = f"import urllib.request; print(urllib.request.urlopen('{address}').read().decode())"
        return subprocess.run(
            ["ip", "netns", "exec", f"{self.prefix}-{place}", sys.executable, "-c", read],
            check=True, capture_output=True, text=True, timeout=10).stdout

    def said(self, name, word):
        """The last line of the log of a program that has this word."""
        lines = (self.out / f"{name}.log").read_text().splitlines()
        return next((line for line in reversed(lines) if word in line), "")

    def stop(self, name, how=signal.SIGTERM, timeout=60):
        program = self.programs[name]
        program.send_signal(how)
        program.wait(timeout)
        return program.returncode

    def report(self, name):
        return json.loads((self.out / f"{name}.json").read_text())

    def fleet_report(self, name):
        return json.loads((self.out / f"{name}.out").read_text())


def layers(report):
    """What a node has of each stream, by robot and run."""
    return {(s["origin"], s["epoch"]): (s["voxels"], s["digest"]) for s in report["streams"] if s["voxels"]}


def wait_for(what, check, seconds=60.0):
    """Waits until `check()` is true."""
    end = time.monotonic() + seconds
    while not check():
        if time.monotonic() > end:
            raise TimeoutError(f"{what} did not come within {seconds} s")
        time.sleep(0.1)
