# SPDX-License-Identifier: Apache-2.0
"""Bags for tests: messages made by the library rosbags, and files of every kind that hold them."""

from __future__ import annotations

import struct
from typing import NamedTuple
from zlib import crc32

import lz4.frame
import numpy as np
from galen_bags.formats.bag import open_bag
from galen_bags.formats.errors import BagError
from galen_bags.formats.mcap_records import zstd
from galen_model.arm.galen import GALEN
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
WRENCH = "geometry_msgs/msg/WrenchStamped"
POSE = "geometry_msgs/msg/PoseStamped"
T0 = 1_700_000_000_000_000_000


class Sample(NamedTuple):
    """A message of a bag, as it is written and as it should be read."""

    topic: str
    log_time_ns: int
    data: bytes


def header(stamp_ns, frame_id=""):
    stamp = TYPES.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return TYPES.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def joint_state(head, names, position, velocity=(), effort=()):
    runs = [np.array(values, dtype=float) for values in (position, velocity, effort)]
    return TYPES.types[JOINT_STATE](head, list(names), *runs)


def wrench(head, values):
    vector = TYPES.types["geometry_msgs/msg/Vector3"]
    force, torque = vector(*values[:3]), vector(*values[3:])
    return TYPES.types[WRENCH](head, TYPES.types["geometry_msgs/msg/Wrench"](force, torque))


def pose(head, values):
    kinds = [TYPES.types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion", "Pose")]
    return TYPES.types[POSE](head, kinds[2](kinds[0](*values[:3]), kinds[1](*values[3:])))


def cdr(message, *, little_endian=True):
    return bytes(TYPES.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))


def arm_samples(count=40, seed=1):
    """Joint states and wrenches in turn, log times 2 ms apart, and a pose at times."""
    rng = np.random.default_rng(seed)
    samples = []
    for k in range(count):
        stamp = T0 + k * 2_000_000
        q = rng.normal(size=10)
        samples += [
            Sample(
                "/joint_states",
                stamp + 50_000,
                cdr(joint_state(header(stamp), GALEN.joint_names, q[:5], q[5:])),
            ),
            Sample("/wrench_raw", stamp + 90_000, cdr(wrench(header(stamp, "ft_sensor"), q[:6]))),
        ]
        if k % 7 == 0:
            data = cdr(pose(header(stamp, "tracker"), q[:7]))
            samples.append(Sample("/tracker/tool_pose", stamp + 90_001, data))
    return samples


def type_of(topic):
    """The type that a topic of `arm_samples` has."""
    if topic.endswith("joint_states"):
        return JOINT_STATE
    return POSE if topic.endswith("pose") else WRENCH


def write_rosbag2(path, samples, storage=StoragePlugin.MCAP, mode=CompressionMode.NONE, silent=()):
    """A directory, by the library; `silent` topics have no messages."""
    writer = Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    writer.open()
    known = {t: writer.add_connection(t, type_of(t), typestore=TYPES) for t in silent}
    for topic, log_time_ns, data in samples:
        if topic not in known:
            known[topic] = writer.add_connection(topic, type_of(topic), typestore=TYPES)
        writer.write(known[topic], log_time_ns, data)
    writer.close()
    return path


# --- MCAP by hand: what no writer makes, or not on demand ------------------------------------

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX = range(1, 8)
STATISTICS, DATA_END = 0x0B, 0x0F
_COMPRESSORS = {"": bytes, "zstd": zstd.compress, "lz4": lz4.frame.compress}


def text(value):
    return struct.pack("<I", len(value.encode())) + value.encode()


def record(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


def schema(number, type_name):
    content = struct.pack("<H", number) + text(type_name) + text("ros2msg") + text("")
    return record(SCHEMA, content)


def channel(number, schema_number, topic, encoding="cdr"):
    content = struct.pack("<HH", number, schema_number) + text(topic) + text(encoding)
    return record(CHANNEL, content + struct.pack("<I", 0))


def message(number, log_time_ns, data):
    time = log_time_ns % 2**64
    return record(MESSAGE, struct.pack("<HIQQ", number, 0, time, time) + data)


def chunk(records, first_ns, last_ns, compression="", *, crc=True, size=None, packed=None):
    """A chunk; `size` and `packed` may lie."""
    packed = _COMPRESSORS[compression](records) if packed is None else packed
    content = struct.pack(
        "<QQQI",
        first_ns % 2**64,
        last_ns % 2**64,
        len(records) if size is None else size,
        crc32(records) if crc else 0,
    )
    return record(CHUNK, content + text(compression) + struct.pack("<Q", len(packed)) + packed)


def index(number, entries):
    pairs = b"".join(struct.pack("<QQ", time % 2**64, at) for time, at in entries)
    return record(INDEX, struct.pack("<HI", number, len(pairs)) + pairs)


def statistics(counts):
    pairs = b"".join(struct.pack("<HQ", number, count) for number, count in counts.items())
    head = struct.pack("<QHIIIIQQ", sum(counts.values()), 1, len(counts), 0, 0, 1, 0, 0)
    return record(STATISTICS, head + struct.pack("<I", len(pairs)) + pairs)


def mcap(*records, end=True):
    """A file of these records."""
    head = MAGIC + record(HEADER, text("ros2") + text("test"))
    foot = record(DATA_END, bytes(4)) + record(FOOTER, bytes(20)) + MAGIC
    return head + b"".join(records) + (foot if end else b"")


def mcap_of(samples, compression="", *, chunk_of=10, indexed=True, summary=True, crc=True):
    """A file of chunks of so many messages (None: without chunks), in the samples' order."""
    numbers = {name: k + 1 for k, name in enumerate(dict.fromkeys(s.topic for s in samples))}
    described = b"".join(
        schema(k, type_of(name)) + channel(k, k, name) for name, k in numbers.items()
    )
    data, chunk_indexes = mcap(end=False), b""
    step = chunk_of or 1
    for first in range(0, len(samples), step):
        content = b"" if first else described
        entries: dict[int, list[tuple[int, int]]] = {}
        for sample in samples[first : first + step]:
            number = numbers[sample.topic]
            entries.setdefault(number, []).append((sample.log_time_ns, len(content)))
            content += message(number, sample.log_time_ns, sample.data)
        if chunk_of is None:
            data += content
            continue
        times = [sample.log_time_ns for sample in samples[first : first + step]]
        start, body = len(data), chunk(content, min(times), max(times), compression, crc=crc)
        data += body
        offsets, indexes = b"", b""
        for number, found in entries.items() if indexed else ():
            offsets += struct.pack("<HQ", number, len(data) + len(indexes))
            indexes += index(number, found)
        data += indexes
        head = struct.pack("<QQQQI", min(times), max(times), start, len(body), len(offsets))
        sizes = text(compression) + struct.pack(
            "<QQ", len(body) - 49 - len(compression), len(content)
        )
        chunk_indexes += record(8, head + offsets + struct.pack("<Q", len(indexes)) + sizes)
    data += record(DATA_END, bytes(4))
    start = len(data) if summary else 0
    if summary:
        counts = {k: sum(s.topic == name for s in samples) for name, k in numbers.items()}
        data += described + (chunk_indexes if indexed else b"") + statistics(counts)
    return data + record(FOOTER, struct.pack("<QQI", start, 0, 0)) + MAGIC


# --- reading ----------------------------------------------------------------------------------


def read(path, topics=None):
    """All messages of a bag, and what is wrong with it."""
    with open_bag(path) as bag:
        names = list(bag.topics) if topics is None else list(topics)
        found = [
            Sample(names[block.topic[k]], int(block.log_time_ns[k]), block.message(k))
            for block in bag.blocks(names)
            for k in range(len(block))
        ]
        return found, bag.problems


def read_or_reject(path):
    """The same; a bag that is rejected has no messages, and the reason as its problem."""
    try:
        return read(path)
    except BagError as error:
        return [], [str(error)]


def read_by_rosbags(path):
    """The same, by the library's own reader."""
    with Reader(path) as reader:
        return [Sample(c.topic, time_ns, bytes(data)) for c, time_ns, data in reader.messages()]


def messages_by_topic(path):
    """The same, each topic's for itself."""
    found: dict[str, list[bytes]] = {}
    for topic, _, data in read_by_rosbags(path):
        found.setdefault(topic, []).append(data)
    return found


def assert_arrays_are_those_of_rosbags(recording, samples):
    """Every joint state and wrench of the samples, with its times, as rosbags decodes it."""
    for topic, type_name, stamps, logs in (
        ("/joint_states", JOINT_STATE, recording.joint_stamp_ns, recording.joint_log_ns),
        ("/wrench_raw", WRENCH, recording.wrench_stamp_ns, recording.wrench_log_ns),
    ):
        rows = [sample for sample in samples if sample.topic == topic]
        sent = [TYPES.deserialize_cdr(sample.data, type_name) for sample in rows]
        assert logs.tolist() == [sample.log_time_ns for sample in rows]
        at = [message.header.stamp for message in sent]
        assert stamps.tolist() == [stamp.sec * 10**9 + stamp.nanosec for stamp in at]
        if type_name == JOINT_STATE:
            assert np.array_equal(recording.joints, [m.position for m in sent], equal_nan=True)
            velocities = [m.velocity for m in sent]
            assert np.array_equal(recording.joint_velocities, velocities, equal_nan=True)
        else:
            parts = [(m.wrench.force, m.wrench.torque) for m in sent]
            values = [[getattr(p, axis) for p in both for axis in "xyz"] for both in parts]
            assert np.array_equal(recording.wrenches, values, equal_nan=True)
