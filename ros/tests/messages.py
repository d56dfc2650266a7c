"""The messages that flockmap-ros reads and writes, for two programs by others: Cyclone DDS carries them, `rosbags` encodes and
decodes them. Both get their fields from the one set of definitions that rosbags has for ROS 2 Jazzy; by hand there are only the two
messages that it lacks.

CDR bytes go in and out of Cyclone as they are: its Python encoder would take longer than the clouds may, and what it decodes would
not be decoded by another's code.
"""

import numpy as np
from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.core import DDSException, InstanceState, Listener, Policy, Qos, ReadCondition, SampleState, ViewState
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

# From the packages octomap_msgs and map_msgs.
LACKING = {
    "octomap_msgs/msg/Octomap": "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n",
    "map_msgs/msg/OccupancyGridUpdate":
        "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n",
}

store = get_typestore(Stores.ROS2_JAZZY)
for name, text in LACKING.items():
    store.register(get_types_from_msg(text, name))

# The last part of a name is enough where people type it.
USED = [
    "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "rosgraph_msgs/msg/Clock",
    "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/OccupancyGrid", "map_msgs/msg/OccupancyGridUpdate", "octomap_msgs/msg/Octomap",
    "visualization_msgs/msg/MarkerArray", "diagnostic_msgs/msg/DiagnosticArray",
]


def full_name(name: str) -> str:
    found = [used for used in USED if name == used or name == used.split("/")[-1]]
    if not found and name in store.fielddefs:
        found = [name]
    if len(found) != 1:
        raise SystemExit(f"no message {name}; known: {', '.join(USED)}")
    return found[0]


BASE = {
    "bool": bool, "string": str, "byte": types.byte, "octet": types.byte, "char": types.uint8,
    "int8": types.int8, "uint8": types.uint8, "int16": types.int16, "uint16": types.uint16, "int32": types.int32,
    "uint32": types.uint32, "int64": types.int64, "uint64": types.uint64, "float32": types.float32, "float64": types.float64,
}
made: dict[str, type[IdlStruct]] = {}


def dds_type(name: str) -> type[IdlStruct]:
    """The class of a message for Cyclone, with the name that ROS gives it in DDS."""
    name = full_name(name) if "/" not in name else name
    if name not in made:
        package, _, message = name.rpartition("/")
        made[name] = make_idl_struct(
            f"{message}_", f"{package.replace('/', '.')}.dds_.{message}_",
            {field: field_type(node) for field, node in store.fielddefs[name][1]})
    return made[name]


def field_type(node) -> object:
    kind, what = node
    if kind == Nodetype.BASE:
        return BASE[what[0]]
    if kind == Nodetype.NAME:
        return dds_type(what)
    of, length = what
    return types.sequence[field_type(of)] if kind == Nodetype.SEQUENCE else types.array[field_type(of), length]


def qos(text: str) -> Qos:
    """`reliable|best_effort,transient_local|volatile,DEPTH`, as ROS names them."""
    reliability, durability, depth = text.split(",")
    return Qos(
        {"reliable": Policy.Reliability.Reliable(duration(milliseconds=100)),
         "best_effort": Policy.Reliability.BestEffort}[reliability],
        {"transient_local": Policy.Durability.TransientLocal, "volatile": Policy.Durability.Volatile}[durability],
        Policy.History.KeepLast(int(depth)),
        # What ROS 2 speaks; of the two Cyclone would offer both.
        Policy.DataRepresentation(use_cdrv0_representation=True))


OUTPUT = "reliable,transient_local,1"


def dds_name(topic: str) -> str:
    return "rt/" + topic.lstrip("/")


class Incompatible(Listener):
    """Counts other sides with a QoS that does not fit."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def on_requested_incompatible_qos(self, reader, status):
        self.count = status.total_count

    def on_offered_incompatible_qos(self, writer, status):
        self.count = status.total_count


class Writer:
    def __init__(self, participant: DomainParticipant, topic: str, name: str, policies: str):
        self.name = full_name(name)
        self.incompatible = Incompatible()
        self.writer = DataWriter(
            participant, Topic(participant, dds_name(topic), dds_type(self.name)), qos(policies), self.incompatible)

    def write_cdr(self, cdr: bytes) -> None:
        """A message with its 4 bytes of CDR header, as bags keep them."""
        result = ddspy_write(self.writer._ref, bytes(cdr) + b"\0" * (-len(cdr) % 4))
        if result < 0:
            raise DDSException(result, f"writing {self.name}")

    def write(self, message) -> None:
        self.write_cdr(bytes(store.serialize_cdr(message, self.name)))

    def matched(self) -> int:
        return len(self.writer.get_matched_subscriptions())


class Reader:
    def __init__(self, participant: DomainParticipant, topic: str, name: str, policies: str):
        self.topic = topic
        self.name = full_name(name)
        self.incompatible = Incompatible()
        self.reader = DataReader(
            participant, Topic(participant, dds_name(topic), dds_type(self.name)), qos(policies), self.incompatible)
        self.condition = ReadCondition(self.reader, ViewState.Any | SampleState.Any | InstanceState.Any)

    def take_cdr(self) -> list[bytes]:
        taken = ddspy_take(self.reader._ref, SampleState.Any | ViewState.Any | InstanceState.Any, 100)
        if isinstance(taken, int):
            raise DDSException(taken, f"reading {self.topic}")
        return [data for data, info in taken if info.valid_data]

    def decode(self, cdr: bytes):
        return decode(cdr, self.name)

    def matched(self) -> int:
        return len(self.reader.get_matched_publications())


def decode(cdr: bytes, name: str):
    """By rosbags, not by Cyclone."""
    return store.deserialize_cdr(cdr, full_name(name))


def message(name: str, **fields):
    return store.types[full_name(name)](**fields)


def stamp_ns(stamp) -> int:
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def time_message(ns: int):
    return store.types["builtin_interfaces/msg/Time"](sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)


def header(ns: int, frame: str):
    return store.types["std_msgs/msg/Header"](stamp=time_message(ns), frame_id=frame)


# What flockmap-ros publishes below its own name, and with what type.
OUTPUTS = {
    "occupied_points": "PointCloud2", "occupied_points_all": "PointCloud2", "grid": "OccupancyGrid",
    "grid_updates": "OccupancyGridUpdate", "octomap_binary": "Octomap", "distance_field": "PointCloud2", "robots": "MarkerArray",
}


def cloud(stamp: int, frame: str, points: np.ndarray, fields: str = "xyz"):
    """An array of float32 rows as a PointCloud2."""
    points = np.ascontiguousarray(points, dtype=np.float32).reshape(-1, len(fields))
    field = store.types["sensor_msgs/msg/PointField"]
    return message(
        "PointCloud2", header=header(stamp, frame), height=1, width=len(points),
        fields=[field(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate(fields)],
        is_bigendian=False, point_step=points.itemsize * len(fields), row_step=points.nbytes,
        data=points.view(np.uint8).reshape(-1), is_dense=bool(np.isfinite(points).all()))


def floats(message) -> np.ndarray:
    """The rows of a PointCloud2 all of whose fields are float32."""
    assert all(f.datatype == 7 and f.offset == 4 * i and f.count == 1 for i, f in enumerate(message.fields)), message.fields
    assert message.point_step == 4 * len(message.fields) and not message.is_bigendian
    assert message.row_step == message.point_step * message.width and len(message.data) == message.row_step * message.height
    return np.frombuffer(message.data.tobytes(), dtype="<f4").reshape(-1, len(message.fields))


def transform(stamp: int, parent: str, child: str, translation=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0)):
    """A TFMessage of one transform."""
    of = store.types
    return message("TFMessage", transforms=[of["geometry_msgs/msg/TransformStamped"](
        header=header(stamp, parent), child_frame_id=child,
        transform=of["geometry_msgs/msg/Transform"](
            translation=of["geometry_msgs/msg/Vector3"](*map(float, translation)),
            rotation=of["geometry_msgs/msg/Quaternion"](*map(float, rotation))))])
