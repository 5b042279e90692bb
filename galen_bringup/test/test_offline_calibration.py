# SPDX-License-Identifier: Apache-2.0
"""A calibration and its recording: what is found live, and what the recording gives afterwards."""

import dataclasses

import numpy as np
import pytest
from galen_bags.arrays.arm_recording import read_arm
from galen_bags.formats.writer import BagWriter
from galen_calibration_behavior.calibration.procedure import CalibrationRequest
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.from_bag.sweeps import SweepSorter
from galen_calibration_behavior.from_bag.visits import find_visits
from galen_model.arm.galen import GALEN
from galen_model.load.identification import identify_two_sweeps
from galen_sim_driver.plant.cell import Plant
from galen_sim_driver.plant.config import HandPush, PlantConfig
from offline_cell import CellBag, OfflineCell

# Quicker than on a real arm, and with less of it to simulate.
PARAMETERS = CalibrationParameters(
    max_angle_velocity_rad_s=1.4,
    max_angle_acceleration_rad_s2=5.5,
    max_delta_velocity_m_s=0.15,
    max_delta_acceleration_m_s2=0.9,
)
# 2.5 ms off the grid on which a live sweep looks at the arm
START_NS = 1_700_000_000_002_500_000
NUMBERS = ("angles", "wrench", "std_of_mean")


class Toucher:
    """Plays the hand's script once, when the arm has stood still for a while in this pose."""

    def __init__(self, roll, tilt, tool):
        self.where, self.tool = np.array([roll, tilt]), tool
        self.plant = None
        self.still, self.done = 0, False

    def __call__(self, sample):
        here = np.abs(np.array(sample.positions[3:]) - self.where).max() < 1e-3
        self.still = self.still + 1 if here and self.plant.tool == self.tool else 0
        if self.still == 30 and not self.done:  # 0.3 s of 0.9 s
            self.done = True
            self.plant.start_hand()


def calibrate_and_record(folder, grid, *, rate_hz=100.0, seed=1, start=None, touch=None):
    """Return the live calibration's measurements and its recording."""
    push = HandPush(start_s=0.05, duration_s=0.5, force_n=(0.0, 0.4, 0.0), ramp_s=0.05)
    config = PlantConfig(rate_hz=rate_hz, start_ns=START_NS, hand=(push,), arm=GALEN)
    if start is not None:
        config = dataclasses.replace(config, start_joints=start)
    plant = Plant(config, np.random.default_rng(seed))
    listeners = []
    if touch is not None:
        touch.plant = plant
        listeners.append(touch)
    with BagWriter(folder / "bag") as bag:
        cell = OfflineCell(plant, [*listeners, CellBag(bag)])
        cell.run(2.0)
        poses = dataclasses.replace(PARAMETERS, **grid).grid_poses(grid["itersT"], grid["itersR"])
        live = cell.calibrate(PARAMETERS, CalibrationRequest("retractor", False, True, poses))
    return live, read_arm(folder / "bag", arm=GALEN)


def offline(recording):
    settings = PARAMETERS
    sweeps = SweepSorter(settings, (PARAMETERS.Rhome, PARAMETERS.Thome))
    return sweeps.two_sweeps(find_visits(recording, settings)).measurements


def same(live, again):
    """Whether both sweeps hold the same averages to the last bit, in whatever order."""
    for name in ("bare", "tool"):
        rows = [
            np.column_stack([getattr(getattr(each, name), number) for number in NUMBERS])
            for each in (live, again)
        ]
        assert sorted(map(tuple, rows[0])) == sorted(map(tuple, rows[1]))


SMALL = {"itersT": 3, "itersR": 3}


@pytest.mark.parametrize(
    ("grid", "rate_hz", "start"),
    [
        (SMALL, 125.0, (0.02, 0.01, 0.42, 0.3, -0.2)),  # nothing of that is left in the sweeps
        (SMALL | {"tstart": -0.8, "tend": 0.8}, 100.0, None),  # home is among its poses
    ],
)
def test_a_recording_gives_the_live_averages_to_the_last_bit(tmp_path, grid, rate_hz, start):
    """Where the arm begins elsewhere too; the driver's sensor begins zeroed."""
    live, recording = calibrate_and_record(tmp_path, grid, rate_hz=rate_hz, start=start)
    again = offline(recording)
    same(live, again)
    assert again.bare_indices == live.bare_indices
    assert again.tool_indices == live.tool_indices
    files = [identify_two_sweeps(one.bare, one.tool, one.zero_angles) for one in (live, again)]
    # The fit's last bits hang on where its arrays lie in memory.
    assert files[0].load.mass_kg == pytest.approx(files[1].load.mass_kg, rel=1e-12)
    np.testing.assert_allclose(files[0].load.covariance, files[1].load.covariance, rtol=1e-9)


def test_a_pose_that_was_touched_and_tried_again_live_is_so_offline(tmp_path):
    poses = dataclasses.replace(PARAMETERS, **SMALL).grid_poses(3, 3)
    touch = Toucher(*poses[6], tool="retractor")
    live, recording = calibrate_and_record(tmp_path, SMALL, touch=touch)
    again = offline(recording)
    same(live, again)
    assert live.rejected == again.rejected == []
    assert again.tool_indices[-1] == 6  # measured at the end of the sweep
    assert sorted(again.tool_indices) == live.tool_indices
    files = [identify_two_sweeps(one.bare, one.tool, one.zero_angles) for one in (live, again)]
    assert files[1].load.mass_kg == pytest.approx(files[0].load.mass_kg, rel=1e-9)
