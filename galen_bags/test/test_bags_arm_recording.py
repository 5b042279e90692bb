# SPDX-License-Identifier: Apache-2.0
"""An arm's joint states and wrenches out of a bag: which topics, which samples, what is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from bags_samples import (
    JOINT_STATE,
    POSE,
    T0,
    WRENCH,
    Sample,
    arm_samples,
    assert_arrays_are_those_of_rosbags,
    cdr,
    channel,
    header,
    joint_state,
    mcap,
    mcap_of,
    message,
    schema,
    wrench,
    write_rosbag2,
)
from galen_bags.arrays.arm_recording import ArmReader, ArmTopics, find_topic, read_arm
from galen_bags.formats.bag import open_bag
from galen_bags.formats.errors import BagError
from galen_model.arm.galen import GALEN


@pytest.fixture
def bag_of(tmp_path):
    """Opens a bag with topics of these types."""

    def make(topics):
        parts = [
            schema(k, type_name) + channel(k, k, name)
            for k, (name, type_name) in enumerate(topics.items(), 1)
        ]
        path = tmp_path / "bag.mcap"
        path.write_bytes(mcap(*parts))
        return open_bag(path)

    return make


@pytest.mark.parametrize(
    ("there", "name", "found"),
    [
        (["/wrench_raw", "/other"], "wrench_raw", "/wrench_raw"),
        (["/wrench_raw", "/arm/wrench_raw"], "wrench_raw", "/wrench_raw"),
        (["/arm/wrench_raw", "/arm/wrench_compensated"], "wrench_raw", "/arm/wrench_raw"),
        (["wrench_raw"], "/wrench_raw", "wrench_raw"),
    ],
)
def test_topic_that_is_found(bag_of, there, name, found):
    assert find_topic(bag_of(dict.fromkeys(there, WRENCH)), name, WRENCH) == found


@pytest.mark.parametrize(
    ("there", "name", "words"),
    [
        (
            {"/a/wrench_raw": WRENCH, "/b/wrench_raw": WRENCH}, "wrench_raw",
            "several topics end with /wrench_raw: /a/wrench_raw, /b/wrench_raw",
        ),
        ({"/wrench_raw": POSE}, "wrench_raw", f"/wrench_raw is a {POSE}, not a {WRENCH}"),
        (
            {"/my_wrench_raw": WRENCH, "/x": POSE}, "wrench_raw",
            f"has no topic /wrench_raw; of type {WRENCH} it has /my_wrench_raw",
        ),
        ({"/x": POSE}, "wrench_raw", f"has no topic of type {WRENCH}; it has /x"),
        (
            {f"/t{k:02}": WRENCH for k in range(30)}, "wrench_raw",
            ", /t10, /t11, 18 more",
        ),
    ],
)  # fmt: skip
def test_topic_that_is_not_found(bag_of, there, name, words):
    """The sentence names the bag, the topic and what there is instead."""
    with pytest.raises(BagError) as raised:
        find_topic(bag_of(there), name, WRENCH)
    assert str(raised.value).endswith(words) and "bag.mcap: " in str(raised.value)


def test_arrays_are_those_of_rosbags(tmp_path):
    samples = arm_samples(500)
    recording = read_arm(write_rosbag2(tmp_path / "bag", samples), arm=GALEN)
    assert len(recording.joints) == len(recording.wrenches) == 500
    assert_arrays_are_those_of_rosbags(recording, samples)
    assert recording.frame_ids == ("ft_sensor",) and recording.problems == ()


def test_order_in_which_samples_were_received(tmp_path):
    """Blocks say whose sample comes next, by log time; a chunk's border changes nothing."""
    rng = np.random.default_rng(3)
    samples = [
        sample._replace(log_time_ns=T0 + int(rng.integers(50)))
        for sample in arm_samples(200)
        if sample.topic != "/tracker/tool_pose"
    ]
    path = tmp_path / "bag.mcap"
    path.write_bytes(mcap_of(samples, "zstd", chunk_of=13))
    with open_bag(path) as bag:
        reader = ArmReader(bag, arm=GALEN)
        blocks = list(reader.blocks())
    assert reader.message_count == 400
    assert len(blocks) > 5
    got = np.concatenate([block.is_wrench for block in blocks])
    expected = sorted(samples, key=lambda sample: sample.log_time_ns)
    assert got.tolist() == [sample.topic == "/wrench_raw" for sample in expected]


def test_other_names_and_a_namespace(tmp_path):
    names = ["x", "y", "z", "a", "b"]
    samples = [
        Sample("/arm/state", T0, cdr(joint_state(header(T0), names[::-1], range(5)))),
        Sample("/arm/ft", T0 + 1, cdr(wrench(header(T0, "tool0"), range(6)))),
    ]
    path = tmp_path / "bag.mcap"
    parts = schema(1, JOINT_STATE) + schema(2, WRENCH)
    parts += channel(1, 1, "/arm/state") + channel(2, 2, "/arm/ft")
    path.write_bytes(mcap(parts, *[message(k, *s[1:]) for k, s in enumerate(samples, 1)]))
    recording = read_arm(path, ArmTopics("state", "arm/ft", tuple(names)), arm=GALEN)
    assert recording.joints.tolist() == [[4, 3, 2, 1, 0]]
    assert np.isnan(recording.joint_velocities).all()
    assert recording.frame_ids == ("tool0",)
    with pytest.raises(BagError, match="lacks roll, tilt; it has b, a, z, y, x"):
        read_arm(path, ArmTopics("state", "arm/ft"), arm=GALEN)
    with pytest.raises(BagError, match="2 joint names; the arm has 5 joints"):
        read_arm(path, ArmTopics("state", "arm/ft", ("a", "b")), arm=GALEN)


def test_messages_that_can_not_be_used_are_left_out_and_counted(tmp_path):
    samples = arm_samples(10)
    bad = {
        4: Sample("/wrench_raw", samples[4].log_time_ns, samples[4].data[:30]),
        5: Sample("/joint_states", samples[5].log_time_ns,
                  cdr(joint_state(header(T0), GALEN.joint_names[:4], range(4)))),
    }  # fmt: skip
    mixed = [bad.get(k, sample) for k, sample in enumerate(samples)]
    recording = read_arm(write_rosbag2(tmp_path / "bag", mixed), arm=GALEN)
    assert len(recording.joints) == len(recording.joint_log_ns) == 9
    assert len(recording.wrenches) == len(recording.wrench_stamp_ns) == 9
    assert np.isfinite(recording.joints).all() and np.isfinite(recording.wrenches).all()
    assert recording.problems == (
        "/joint_states: 1 message can't be used: joint state lacks tilt; it has delta_x, delta_y,"
        " delta_z, roll",
        "/wrench_raw: 1 message can't be used: 30 bytes came that are not a readable"
        f" {WRENCH}: the message ends after 30 bytes, in a value",
    )


def test_topic_without_a_usable_message(tmp_path):
    wrenches = [sample for sample in arm_samples(3) if sample.topic == "/wrench_raw"]
    path = write_rosbag2(tmp_path / "bag", wrenches, silent=["/joint_states"])
    with pytest.raises(BagError, match="bag: /joint_states has no message"):
        read_arm(path, arm=GALEN)
    broken = [Sample("/joint_states", T0, b"\0\1\0\0"), *wrenches]
    path = write_rosbag2(tmp_path / "broken", broken)
    with pytest.raises(BagError, match="/joint_states has no usable message: 4 bytes came that"):
        read_arm(path, arm=GALEN)


def test_another_arm_has_other_joints(tmp_path):
    arm = replace(GALEN, joints=(GALEN.joints[0], GALEN.joints[4]), delta=None)
    samples = [
        Sample("/joint_states", T0, cdr(joint_state(header(T0), ["tilt", "x"], [2, 1], [4, 3]))),
        Sample("/wrench_raw", T0 + 1, cdr(wrench(header(T0, "ft_sensor"), range(6)))),
    ]
    path = write_rosbag2(tmp_path / "bag", samples)
    recording = read_arm(path, ArmTopics(joint_names=arm.joint_names), arm=arm)
    nan = np.nan  # a sliding joint may lack, a turning one not
    assert np.array_equal(recording.joints, [[nan, 2]], equal_nan=True)
    assert np.array_equal(recording.joint_velocities, [[nan, 4]], equal_nan=True)
    with pytest.raises(BagError, match="2 joint names; the arm has 5 joints"):
        read_arm(path, ArmTopics(joint_names=arm.joint_names), arm=GALEN)
