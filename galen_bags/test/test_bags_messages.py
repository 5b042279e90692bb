# SPDX-License-Identifier: Apache-2.0
"""Messages are decoded as the library rosbags decodes them, to the last bit."""

import random
import struct

import numpy as np
import pytest
from bags_samples import (
    JOINT_STATE,
    POSE,
    T0,
    TYPES,
    WRENCH,
    cdr,
    header,
    joint_state,
    pose,
    wrench,
)
from galen_bags.arrays.arm_recording import Decoder
from galen_bags.formats.raw_block import pack
from galen_model.arm.galen import GALEN
from rosbags.serde import SerdeError

NAMES = GALEN.joint_names
ODD = [0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1.7976931348623157e308, 0.1]


ORDER = ["roll", "tilt", "delta_x", "delta_y", "delta_z"]


def decode(decoder, messages):
    block = pack([0] * len(messages), range(len(messages)), messages)
    return decoder.decode(block, np.arange(len(messages)))


def by_rosbags(data, type_name, names=()):
    """(stamp, frame_id, values) as a decoder should give them."""
    message = TYPES.deserialize_cdr(data, type_name)
    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    if type_name == JOINT_STATE:
        values = [np.nan] * 2 * len(names)
        for k, name in enumerate(names):
            if name in message.name:
                index = message.name.index(name)
                values[k] = message.position[index]
                if len(message.velocity):
                    values[len(names) + k] = message.velocity[index]
    else:
        parts = (
            [message.wrench.force, message.wrench.torque]
            if type_name == WRENCH
            else [message.pose.position, message.pose.orientation]
        )
        values = [getattr(part, axis) for part in parts for axis in "xyzw" if hasattr(part, axis)]
    return stamp, message.header.frame_id, values


def assert_row(samples, row, expected):
    """A sample is what rosbags makes of the message."""
    stamp_ns, frame_id, values = expected
    assert samples.stamp_ns[row] == stamp_ns
    assert samples.frame_ids[samples.frame[row]] == frame_id
    # Bit by bit: a NaN is a NaN, and -0 is not 0.
    assert samples.values[row].tobytes() == np.array(values, dtype=float).tobytes()


def assert_same(samples, messages, type_name, names=()):
    assert len(samples) == len(messages) and not samples.bad
    for row, data in enumerate(messages):
        assert_row(samples, row, by_rosbags(data, type_name, names))


@pytest.mark.parametrize("type_name", [WRENCH, POSE])
def test_stamped(type_name):
    rng = random.Random(1)
    make, width = (wrench, 6) if type_name == WRENCH else (pose, 7)
    messages = [
        cdr(
            make(
                header(rng.choice([0, T0, -(10**15), 2**31 * 10**9 - 1]), frame),
                [rng.choice([*ODD, rng.gauss(0, 1)]) for _ in range(width)],
            ),
            little_endian=rng.random() < 0.5,
        )
        for frame in ["", "ft_sensor", "f", "größe", "a/b", "x" * 300] * 30
    ]
    rng.shuffle(messages)
    samples = decode(Decoder(type_name), messages)
    assert_same(samples, messages, type_name)


def any_joint_state(rng):
    names = [*GALEN.joint_names, "gripper", "wrist"][: rng.choice([5, 6, 7])]
    if rng.random() < 0.5:
        rng.shuffle(names)
    if rng.random() < 0.2:
        names = [name for name in names if not name.startswith("delta")]
    runs = [[rng.choice([*ODD, rng.gauss(0, 1)]) for _ in names] for _ in range(3)]
    velocity, effort = (run if rng.random() < 0.6 else [] for run in runs[1:])
    head = header(T0 + rng.randrange(10**12), rng.choice(["", "base_link"]))
    message = joint_state(head, names, runs[0], velocity, effort)
    return cdr(message, little_endian=rng.random() < 0.8)


def test_joint_states():
    """Any order of names, other joints among them, with velocities, efforts or without."""
    rng = random.Random(0)
    decoder = Decoder(JOINT_STATE, ORDER, required=ORDER[:2])
    for _ in range(2):  # in the second block, the layouts are known
        messages = [any_joint_state(rng) for _ in range(300)]
        samples = decode(decoder, messages)
        assert_same(samples, messages, JOINT_STATE, ORDER)


@pytest.mark.parametrize("extra", range(1, 9))
def test_bytes_after_the_last_value(extra):
    """Fast CDR, as rclpy uses it, leaves up to 8 bytes after an empty last sequence.

    rosbags takes three of them at most and rejects the message else; every ROS 2 subscriber takes
    it, and so do we.
    """
    whole = cdr(joint_state(header(T0), GALEN.joint_names, range(5), range(5, 10)))
    rest = random.Random(extra).randbytes(extra)
    if extra > 3:
        with pytest.raises(SerdeError, match="size mismatch"):
            TYPES.deserialize_cdr(whole + rest, JOINT_STATE)
    samples = decode(
        Decoder(JOINT_STATE, GALEN.joint_names), [whole, whole + rest, whole + rest[::-1]]
    )
    assert not samples.bad
    assert np.array_equal(samples.values, [np.arange(10)] * 3)


@pytest.mark.parametrize("type_name", [WRENCH, JOINT_STATE, POSE])
def test_message_that_is_cut_anywhere(type_name):
    make = {WRENCH: lambda h: wrench(h, range(6)), POSE: lambda h: pose(h, range(7))}
    make[JOINT_STATE] = lambda h: joint_state(h, GALEN.joint_names, range(5), range(5), range(5))
    whole = cdr(make[type_name](header(T0, "ft_sensor")))
    messages = [whole[:length] for length in range(len(whole))]
    samples = decode(Decoder(type_name, GALEN.joint_names), [whole, *messages])
    assert sorted(samples.bad) == list(range(1, len(messages) + 1))
    assert np.isnan(samples.values[1:]).all() and not samples.stamp_ns[1:].any()
    assert samples.bad[1].startswith(f"0 bytes came that are not a readable {type_name}: ")


def damaged(rng, type_name):
    """A message of which up to four bytes are others."""
    fine = cdr(wrench(header(T0, "ft_sensor"), range(6)))
    data = bytearray(fine if type_name == WRENCH else any_joint_state(rng))
    for _ in range(rng.randint(1, 4)):
        data[rng.randrange(len(data))] = rng.choice([0, 1, 255, rng.randrange(256)])
    return bytes(data)


@pytest.mark.parametrize(("type_name", "names"), [(WRENCH, ()), (JOINT_STATE, GALEN.joint_names)])
def test_damaged_messages(type_name, names):
    """What rosbags reads is read the same; nothing raises."""
    rng = random.Random(1)
    messages = [damaged(rng, type_name) for _ in range(600)]
    samples = decode(Decoder(type_name, names), messages)
    read = 0
    for row, data in enumerate(messages):
        try:
            expected = by_rosbags(data, type_name, names)
        except (SerdeError, IndexError, ValueError, struct.error):
            continue
        if row in samples.bad:
            assert "joint state has" in samples.bad[row]  # counts that don't fit together
            continue
        read += 1
        assert_row(samples, row, expected)
    assert read > 200


def test_joint_states_that_can_not_be_used():
    fine = cdr(joint_state(header(T0), NAMES, range(5)))
    cases = {
        cdr(joint_state(header(T0 + 1), NAMES[:4], range(4))): "joint state lacks tilt; it has del",
        cdr(joint_state(header(T0 + 1), [], [])): "lacks roll, tilt; it has no joints",
        cdr(joint_state(header(T0 + 1), NAMES, range(4))): "5 names but 4 positions",
        cdr(joint_state(header(T0 + 1), NAMES, range(5), range(2))): "5 names but 2 veloc",
        b"": "0 bytes came",
        b"\0\3" + fine[2:]: "don't start as a serialised message",
    }
    decoder = Decoder(JOINT_STATE, ORDER, required=ORDER[:2])
    samples = decode(decoder, [fine, *cases, fine])
    assert sorted(samples.bad) == list(range(1, len(cases) + 1))
    for row, words in enumerate(cases.values(), 1):
        assert words in samples.bad[row]
    assert samples.values[[0, -1], :5].tolist() == [[3, 4, 0, 1, 2]] * 2
    # A platform's joints may lack, and are not known then.
    few = decode(decoder, [cdr(joint_state(header(T0), ["tilt", "roll"], [1, 2], [3, 4]))])
    nothing = [np.nan] * 3
    assert not few.bad
    assert np.array_equal(few.values[0], [2, 1, *nothing, 4, 3, *nothing], equal_nan=True)
