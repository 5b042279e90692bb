# SPDX-License-Identifier: Apache-2.0
"""The cell without ROS: a calibration from the plant's samples, its ends, what a bag gets."""

import dataclasses

import numpy as np
import pytest
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_calibration_behavior.calibration.procedure import CalibrationRequest
from galen_calibration_behavior.common.commands import CalibrationState
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_model.arm.galen import GALEN
from galen_model.load.identification import identify_two_sweeps
from galen_model.load.model import ADAPTER, TOOLS, Load, nominal_reading
from galen_sim_driver.plant.cell import Plant
from galen_sim_driver.plant.config import PlantConfig
from offline_cell import CellBag, OfflineCalibrationError, OfflineCell

PARAMETERS = CalibrationParameters(settle_s=0.1, average_s=0.3)
POSES = PARAMETERS.grid_poses(2, 3)


def cell(*listeners, **config):
    config = PlantConfig(arm=GALEN, rate_hz=100.0, **config)
    return OfflineCell(Plant(config, np.random.default_rng(1)), listeners)


def calibrate(offline, **changes):
    settings = dataclasses.replace(PARAMETERS, **changes.pop("settings", {}))
    values = {"tool": "pointer", "one_sweep": False, "attach_by_service": True, "poses": POSES}
    states = []
    found = offline.calibrate(
        settings,
        CalibrationRequest(**values | changes),
        on_feedback=lambda feedback, stamp_ns: states.append((feedback.state, stamp_ns)),
    )
    return found, states


def test_a_calibration_finds_the_plants_loads_and_tells_its_states():
    offline = cell()
    found, states = calibrate(offline)
    for still, tool in ((found.bare, Load(0.0)), (found.tool, TOOLS["pointer"].load)):
        expected = nominal_reading(still.angles, tool, ADAPTER, arm=GALEN)
        assert still.wrench == pytest.approx(expected, abs=0.03)
    load = identify_two_sweeps(found.bare, found.tool, found.zero_angles).load
    assert load.mass_kg == pytest.approx(0.060, abs=5 * load.mass_std_kg)
    order = list(dict.fromkeys(state for state, _ in states))
    assert order == list(CalibrationState)
    stamps = [stamp for _, stamp in states]
    assert stamps == sorted(stamps)
    assert stamps[-1] == offline.plant.now_ns


def test_every_sample_reaches_every_listener_once_and_in_order():
    first, second = [], []
    offline = cell(
        lambda sample: first.append(sample.stamp_ns), lambda s: second.append(len(first))
    )
    offline.run(0.5)
    assert first == [1_000_000_000 + k * 10_000_000 for k in range(1, 51)]
    assert second == list(range(1, 51))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tool": "spoon"}, "SERVICE_FAILED: attach_tool failed: no tool 'spoon' here"),
        ({"attach_by_service": False}, "attach it by service"),
        ({"settings": {"motion_timeout_s": -5.0}}, "MOTION_TIMEOUT"),
    ],
)
def test_a_calibration_that_fails_says_why(changes, message):
    with pytest.raises(OfflineCalibrationError, match=message):
        calibrate(cell(), **changes)


@pytest.mark.parametrize("tool", ["", "retractor"])
def test_a_bag_gets_what_the_driver_publishes_in_its_order(tmp_path, tool):
    with BagWriter(tmp_path / "bag") as writer:
        offline = cell(CellBag(writer, tracker=True))
        offline.plant.attach_tool(tool)
        offline.run(0.1)
    with open_bag(tmp_path / "bag") as bag:
        names = sorted(bag.topics)
        (block,) = bag.blocks(names)
        topics = [names[k] for k in block.topic.tolist()]
    seen = ["/tracker/tool_pose"] if tool else []
    assert topics == ["/joint_states", "/wrench_raw", *seen, "/tracker/base_pose"] * 10
    assert np.all(np.diff(block.log_time_ns) > 0)
    assert block.log_time_ns[0] == 1_010_000_000 + 200_000
