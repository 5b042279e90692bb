# SPDX-License-Identifier: Apache-2.0
"""Every message of the project's recordings, compared with what rosbags makes of it."""

import json
from pathlib import Path

import numpy as np
import pytest
from bags_samples import JOINT_STATE, TYPES, WRENCH, read, read_by_rosbags
from galen_bags.arrays.arm_recording import read_arm
from galen_model.arm.arm import Arm
from galen_model.arm.description import read_arm as read_description
from galen_model.arm.galen import GALEN

RECORDINGS = Path(__file__).parents[3] / "shared" / "recordings"
BAGS = sorted(path.parent for path in RECORDINGS.glob("*/*/*/metadata.yaml"))


def arm_of(recording: Path) -> Arm:
    urdf = recording / "arm.urdf"
    if not urdf.exists():
        return GALEN
    frame = json.loads((recording / "tool.json").read_text())["sensor_frame"]
    return read_description(urdf.read_text(), sensor_frame=frame)


@pytest.mark.timeout(600)
@pytest.mark.skipif(not BAGS, reason="the project's recordings are not here")
@pytest.mark.parametrize(
    "bags",
    [
        pytest.param(BAGS[::8], id="some", marks=pytest.mark.slow),
        pytest.param(BAGS, id="all", marks=pytest.mark.soak),
    ],
)
def test_every_message_of_the_recordings(bags):
    for path in bags:
        expected = read_by_rosbags(path)
        found, problems = read(path)
        assert found == expected and problems == [], path
        recording = read_arm(path, arm=arm_of(path.parent))
        for topic, type_name, stamps, logs in (
            ("/joint_states", JOINT_STATE, recording.joint_stamp_ns, recording.joint_log_ns),
            ("/wrench_raw", WRENCH, recording.wrench_stamp_ns, recording.wrench_log_ns),
        ):
            rows = [sample for sample in expected if sample.topic == topic]
            sent = [TYPES.deserialize_cdr(sample.data, type_name) for sample in rows]
            assert logs.tolist() == [sample.log_time_ns for sample in rows]
            assert stamps.tolist() == [
                m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in sent
            ]
            if type_name == JOINT_STATE:
                assert np.array_equal(recording.joints, [m.position for m in sent], equal_nan=True)
                velocities = [m.velocity for m in sent]
                assert np.array_equal(recording.joint_velocities, velocities, equal_nan=True)
            else:
                parts = [(m.wrench.force, m.wrench.torque) for m in sent]
                values = [[getattr(p, axis) for p in both for axis in "xyz"] for both in parts]
                assert np.array_equal(recording.wrenches, values, equal_nan=True)
