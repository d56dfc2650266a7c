#!/usr/bin/env python3
"""Looks into the record of a flight (docs/flights.md) with the tools of Foxglove, and prints what is there.

Every message is decoded with the schema that the file carries, by Foxglove's readers from PyPI (mcap,
mcap-protobuf-support, mcap-ros2-support). Point clouds are made once more with Foxglove's own SDK (foxglove-sdk) of
what was decoded, and must have the same bytes. Exit: 0 all as it should be, 1 not.

usage: flight.py FILE NAME    NAME: of the robot that recorded it
"""

import sys
from collections import Counter

import numpy as np
from foxglove import messages as sdk
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as Protobuf
from mcap_ros2.decoder import DecoderFactory as Ros2


def remade(cloud) -> bytes:
    """A point cloud as Foxglove's SDK writes it."""
    def pose(of):
        at, turned = of.position, of.orientation
        return sdk.Pose(
            position=sdk.Vector3(x=at.x, y=at.y, z=at.z),
            orientation=sdk.Quaternion(x=turned.x, y=turned.y, z=turned.z, w=turned.w),
        )

    kinds = {1: sdk.PackedElementFieldNumericType.Uint8, 7: sdk.PackedElementFieldNumericType.Float32}
    return sdk.PointCloud(
        timestamp=sdk.Timestamp(sec=cloud.timestamp.seconds, nsec=cloud.timestamp.nanos),
        frame_id=cloud.frame_id,
        pose=pose(cloud.pose),
        point_stride=cloud.point_stride,
        fields=[sdk.PackedElementField(name=f.name, offset=f.offset, type=kinds[f.type]) for f in cloud.fields],
        data=cloud.data,
    ).encode()


def main(path: str, name: str) -> int:
    faults = []
    counts, raw, last, frames = Counter(), Counter(), {}, set()
    feed = b""
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[Protobuf(), Ros2()])
        summary = reader.get_summary()
        times = [summary.statistics.message_start_time, summary.statistics.message_end_time]
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            raw[channel.topic] += len(message.data)
            last[channel.topic] = (schema.name, decoded)
            if not times[0] <= message.log_time <= times[1]:
                faults.append(f"{channel.topic}: a time outside those of the summary")
            if schema.name == "foxglove.PointCloud" and remade(decoded) != message.data:
                faults.append(f"{channel.topic}: Foxglove's SDK writes this cloud in other bytes")
            if schema.name == "tf2_msgs/msg/TFMessage":
                frames |= {t.child_frame_id for t in decoded.transforms}
            if schema.name == "flockmap.FeedFrame":
                feed += decoded.frame
    file_bytes = open(path, "rb").seek(0, 2)
    minutes = (times[1] - times[0]) / 60e9
    print(f"{path}: {file_bytes} bytes, {minutes * 60:.1f} s, {file_bytes / minutes / 1e6:.2f} MB a minute")
    for topic in sorted(counts):
        print(f"  {topic}: {counts[topic]} x {last[topic][0]}, {raw[topic]} bytes before they are packed")
    print(f"  frames of tf: {', '.join(sorted(frames))}")

    # The feed is a chain of frames, each with its length before it.
    at, kinds = 0, Counter()
    while at + 5 <= len(feed):
        length = int.from_bytes(feed[at : at + 4], "little")
        kinds[feed[at + 4]] += 1
        at += 4 + length
    if at != len(feed) or kinds[1] < 1:
        faults.append("the feed is no chain of frames")
    print("  kinds of frames of the feed: " + ", ".join(f"{kind}: {count}" for kind, count in sorted(kinds.items())))

    schema, cloud = last[f"/{name}/viewer/map"]
    points = np.frombuffer(cloud.data, dtype=[("at", "<f4", 3), ("colour", "u1", 4)])
    low, high = points["at"].min(0), points["at"].max(0)
    colours = len(np.unique(points["colour"], axis=0))
    print(f"  last picture: {len(points)} voxels from {low} to {high} m in {colours} colours")
    if len(points) == 0 or not np.isfinite(points["at"]).all():
        faults.append("the last picture is empty, or not finite")
    counters = last[f"/{name}/counters"][1]
    fields = [f.name for f in counters.DESCRIPTOR.fields]
    print(f"  {len(fields)} counters, among them node_frames {counters.node_frames:.0f}, node_map_bytes_out {counters.node_map_bytes_out:.0f}")
    for topic in sorted(t for t in last if t.startswith(f"/{name}/links/")):
        link = last[topic][1]
        print(f"  {topic}: loss {link.loss:.3f}, round trip {link.round_trip_s * 1e3:.1f} ms, {link.bytes_in:.0f} bytes in")
    for fault in faults:
        print(f"FAULT: {fault}")
    return 1 if faults else 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:]))
