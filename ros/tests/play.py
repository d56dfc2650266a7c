#!/usr/bin/env python3
"""Plays bags as `ros2 bag play --clock` does, with Cyclone DDS: PointCloud2, Odometry, tf and tf_static at the recorded speed.

usage: play.py BAG... [--rate 1] [--clock] [--now] [--namespace /robot1] [--remap FROM:=TO]... [--sent FILE.jsonl]
A BAG is an .mcap, a .db3 or a rosbag2 folder. All bags play together, each message when it was recorded. CDR goes out as it is in
the bag, so nothing is lost by a decoder. With --sent: a line of JSON for each cloud with the time at which it was sent, and at the
end one with what was sent.
"""

import argparse
import json
import sys
import time

from rosbags.rosbag2 import Reader as BagReader

from messages import DomainParticipant, Writer, decode, header, message, stamp_ns, store, time_message

PLAYED = {
    "sensor_msgs/msg/PointCloud2": "best_effort,volatile,5",
    "nav_msgs/msg/Odometry": "reliable,volatile,100",
    "tf2_msgs/msg/TFMessage": "reliable,volatile,100",
    "geometry_msgs/msg/PoseStamped": "reliable,volatile,10",
}
STATIC = "reliable,transient_local,100"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", nargs="+")
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end so far into the bags")
    parser.add_argument("--clock", action="store_true", help="publish /clock, 100 times a second")
    parser.add_argument("--now", action="store_true", help="stamps as if it were recorded now, for nodes without /clock")
    parser.add_argument("--namespace", default="", help="before each topic but /tf and /tf_static")
    parser.add_argument("--remap", action="append", default=[], metavar="FROM:=TO")
    parser.add_argument("--points-qos", default=PLAYED["sensor_msgs/msg/PointCloud2"])
    parser.add_argument("--wait", type=float, default=30.0, help="wait so long for readers of clouds and of /clock")
    parser.add_argument("--linger", type=float, default=1.0, help="stay so long after the last message")
    parser.add_argument("--sent", help="file of JSON lines")
    options = parser.parse_args()

    messages = read(options)
    start = messages[0][0]
    messages = [m for m in messages if m[0] - start <= options.seconds * 1e9]
    participant = DomainParticipant()
    writers = {}
    for _, topic, name, _ in messages:
        if topic not in writers:
            policies = options.points_qos if name.endswith("PointCloud2") else PLAYED[name]
            writers[topic] = Writer(participant, topic, name, STATIC if topic == "/tf_static" else policies)
    clock = Writer(participant, "/clock", "Clock", "best_effort,volatile,1") if options.clock else None
    clouds = [w for w in writers.values() if w.name.endswith("PointCloud2")]
    deadline = time.monotonic() + options.wait
    while not all(w.matched() for w in clouds + ([clock] if clock else [])) and time.monotonic() < deadline:
        # Who waits for the time before it does anything must not wait for ever.
        if clock:
            clock.write(message("Clock", clock=time_message(start)))
        time.sleep(0.01)
    if clock:
        # Topics do not wait for each other: the time must be known before the first cloud has come.
        for _ in range(30):
            clock.write(message("Clock", clock=time_message(start)))
            time.sleep(0.01)
    if not all(w.matched() for w in clouds):
        print(f"play: no reader of some clouds after {options.wait} s", file=sys.stderr)

    sent = open(options.sent, "w") if options.sent else None
    begun, late, ticks = time.monotonic(), 0.0, 0
    # With --now the first message is from now on.
    shift = time.time_ns() - start if options.now else 0
    pose = None
    for at, topic, name, cdr in messages:
        due = begun + (at - start) / 1e9 / options.rate
        while (left := due - time.monotonic()) > 0:
            if clock:
                tick = begun + ticks * 0.01
                if tick <= time.monotonic():
                    clock.write(message("Clock", clock=time_message(start + int((tick - begun) * options.rate * 1e9))))
                    ticks += 1
                    continue
                left = min(left, tick - time.monotonic())
            time.sleep(max(0.0, left))
        late = max(late, time.monotonic() - due)
        if shift:
            cdr = shifted(cdr, name, shift)
        wall = time.time()
        writers[topic].write_cdr(cdr)
        if name.endswith("PointCloud2") and sent:
            stamp = int.from_bytes(cdr[4:8], "little") * 1_000_000_000 + int.from_bytes(cdr[8:12], "little")
            sent.write(json.dumps({"topic": topic, "stamp": stamp, "wall": wall, "bytes": len(cdr)}) + "\n")
        if name.endswith("TFMessage"):
            pose = (topic, cdr)
    counts = {}
    for _, topic, _, _ in messages:
        counts[topic] = counts.get(topic, 0) + 1
    print(f"played {(messages[-1][0] - start) / 1e9:.1f} s at rate {options.rate:g}, at most {late * 1e3:.1f} ms late:", counts)
    if sent:
        last = None
        if pose:
            of = decode(pose[1], "TFMessage").transforms[-1].transform.translation
            last = [of.x, of.y, of.z]
        incompatible = {topic: w.incompatible.count for topic, w in writers.items() if w.incompatible.count}
        sent.write(json.dumps({"counts": counts, "late_ms": late * 1e3, "position": last, "incompatible": incompatible}) + "\n")
        sent.close()
    time.sleep(options.linger)
    return 0


def read(options) -> list[tuple[int, str, str, bytes]]:
    remap = dict(rule.split(":=") for rule in options.remap)
    messages = []
    for bag in options.bags:
        with BagReader(bag) as reader:
            for connection, at, cdr in reader.messages():
                if connection.msgtype in PLAYED:
                    topic = connection.topic
                    if topic not in ("/tf", "/tf_static"):
                        topic = options.namespace.rstrip("/") + topic
                    messages.append((at, remap.get(topic, topic), connection.msgtype, bytes(cdr)))
    if not messages:
        raise SystemExit("play: nothing to play")
    messages.sort(key=lambda m: m[0])
    return messages


def shifted(cdr: bytes, name: str, by: int) -> bytes:
    """With all stamps later by so many nanoseconds."""
    if name.endswith("TFMessage"):
        decoded = decode(cdr, name)
        for one in decoded.transforms:
            one.header = header(stamp_ns(one.header.stamp) + by, one.header.frame_id)
        return bytes(store.serialize_cdr(decoded, name))
    # The others begin with the stamp of their header, behind the 4 bytes of CDR's.
    stamp = int.from_bytes(cdr[4:8], "little") * 1_000_000_000 + int.from_bytes(cdr[8:12], "little") + by
    return cdr[:4] + (stamp // 1_000_000_000).to_bytes(4, "little") + (stamp % 1_000_000_000).to_bytes(4, "little") + cdr[12:]


if __name__ == "__main__":
    sys.exit(main())
