# SPDX-License-Identifier: Apache-2.0
"""Every message of the project's recordings, compared with what rosbags makes of it."""

import json
from pathlib import Path

import pytest
from bags_samples import assert_arrays_are_those_of_rosbags, read, read_by_rosbags
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
        assert_arrays_are_those_of_rosbags(recording, expected)
