#!/usr/bin/env python3
"""Listens to topics with Cyclone DDS and keeps what came, as CDR and decoded by rosbags.

usage: listen.py TOPIC[=TYPE]... --out DIR [--qos reliable,transient_local,5] [--for SECONDS]
The type of what flockmap-ros publishes is known by the last part of the topic, and that of /diagnostics. Ends after --for seconds, or
with SIGTERM. In DIR, by the last part of each topic: NAME.cdr, the last message; NAME.jsonl, a line for each with its stamp and the time
at which it came; values.jsonl, all diagnostics; summary.json: how many came, when the first one did, and the QoS that did not fit.
"""

import argparse
import json
import signal
import sys
import time
from pathlib import Path

from cyclonedds.core import WaitSet
from cyclonedds.util import duration

from messages import OUTPUTS, DomainParticipant, Reader, stamp_ns


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("topics", nargs="+", metavar="TOPIC[=TYPE]")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--qos", default="reliable,transient_local,5")
    parser.add_argument("--for", dest="seconds", type=float, default=float("inf"))
    options = parser.parse_args()
    stopped = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.append(1))
    options.out.mkdir(parents=True, exist_ok=True)

    participant = DomainParticipant()
    begun = time.monotonic()
    waitset = WaitSet(participant)
    listened = []
    for given in options.topics:
        topic, _, name = given.partition("=")
        last = topic.rsplit("/", 1)[-1]
        is_diagnostics = last == "diagnostics"
        name = name or ("DiagnosticArray" if is_diagnostics else OUTPUTS[last])
        reader = Reader(participant, topic, name, "reliable,volatile,100" if is_diagnostics else options.qos)
        waitset.attach(reader.condition)
        listened.append(Listened(reader, last, options.out))
    while not stopped and time.monotonic() - begun < options.seconds:
        waitset.wait(duration(milliseconds=100))
        for one in listened:
            one.take(begun)
    summary = {one.name: one.end() for one in listened}
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    for name, found in summary.items():
        print(f"listened to {name}:", found)
    return 0


class Listened:
    def __init__(self, reader: Reader, name: str, out: Path):
        self.reader, self.name, self.out = reader, name, out
        self.lines = open(out / f"{name}.jsonl", "w")
        self.values = open(out / "values.jsonl", "w") if name == "diagnostics" else None
        self.last, self.count, self.first_s, self.bytes_max, self.matched_s = None, 0, None, 0, None

    def take(self, begun: float) -> None:
        if self.matched_s is None and self.reader.matched():
            self.matched_s = round(time.monotonic() - begun, 3)
        for cdr in self.reader.take_cdr():
            wall = time.time()
            if self.first_s is None:
                self.first_s = round(time.monotonic() - begun, 3)
            self.last, self.count, self.bytes_max = cdr, self.count + 1, max(self.bytes_max, len(cdr))
            message = self.reader.decode(cdr)
            # A MarkerArray has no header of its own.
            of = message if hasattr(message, "header") else next(iter(message.markers), None)
            line = {"wall": wall, "bytes": len(cdr)}
            if of is not None:
                line.update(stamp=stamp_ns(of.header.stamp), frame=of.header.frame_id)
            self.lines.write(json.dumps(line) + "\n")
            if self.values:
                values = {status.name: {v.key: v.value for v in status.values} | {"level": int(status.level), "message": status.message}
                          for status in message.status}
                self.values.write(json.dumps({"wall": wall, "status": values}) + "\n")
                self.values.flush()

    def end(self) -> dict:
        self.lines.close()
        if self.last is not None:
            (self.out / f"{self.name}.cdr").write_bytes(self.last)
        return {"count": self.count, "matched_s": self.matched_s, "first_s": self.first_s, "bytes_max": self.bytes_max,
                "incompatible": self.reader.incompatible.count}


if __name__ == "__main__":
    sys.exit(main())
