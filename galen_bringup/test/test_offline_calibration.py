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


def calibrate_and_record(folder, poses, *, rate_hz, start, touch):
    """Return the live calibration's measurements and its recording."""
    push = HandPush(start_s=0.05, duration_s=0.5, force_n=(0.0, 0.4, 0.0), ramp_s=0.05)
    config = PlantConfig(rate_hz=rate_hz, start_ns=START_NS, hand=(push,), arm=GALEN)
    if start is not None:
        config = dataclasses.replace(config, start_joints=start)
    plant = Plant(config, np.random.default_rng(1))
    listeners = []
    if touch is not None:
        touch.plant = plant
        listeners.append(touch)
    with BagWriter(folder / "bag") as bag:
        cell = OfflineCell(plant, [*listeners, CellBag(bag)])
        cell.run(2.0)
        live = cell.calibrate(PARAMETERS, CalibrationRequest("retractor", False, True, poses))
    return live, read_arm(folder / "bag", arm=GALEN)


def offline(recording):
    sweeps = SweepSorter(PARAMETERS, (PARAMETERS.Rhome, PARAMETERS.Thome))
    return sweeps.two_sweeps(find_visits(recording, PARAMETERS)).measurements


def same(live, again):
    """Whether both sweeps hold the same averages to the last bit, in whatever order."""
    for name in ("bare", "tool"):
        rows = [
            np.column_stack([getattr(getattr(each, name), number) for number in NUMBERS])
            for each in (live, again)
        ]
        assert sorted(map(tuple, rows[0])) == sorted(map(tuple, rows[1]))


@pytest.mark.parametrize(
    ("grid", "rate_hz", "start", "touched"),
    [
        # Nothing of where it began is left in the sweeps; a pose is measured again at their end.
        ({"itersT": 2, "itersR": 3}, 125.0, (0.02, 0.01, 0.42, 0.3, -0.2), 3),
        # Home is among the poses.
        ({"itersT": 3, "itersR": 3, "tstart": -0.8, "tend": 0.8}, 100.0, None, None),
    ],
    ids=["elsewhere and touched", "over home"],
)
def test_a_recording_gives_the_live_averages_to_the_last_bit(
    tmp_path, grid, rate_hz, start, touched
):
    """The driver's sensor begins zeroed."""
    poses = dataclasses.replace(PARAMETERS, **grid).grid_poses(grid["itersT"], grid["itersR"])
    touch = None if touched is None else Toucher(*poses[touched], tool="retractor")
    live, recording = calibrate_and_record(
        tmp_path, poses, rate_hz=rate_hz, start=start, touch=touch
    )
    again = offline(recording)
    same(live, again)
    assert live.rejected == again.rejected == []
    assert again.bare_indices == live.bare_indices
    if touched is None:
        assert again.tool_indices == live.tool_indices
    else:
        assert again.tool_indices[-1] == touched
        assert sorted(again.tool_indices) == live.tool_indices
    files = [identify_two_sweeps(one.bare, one.tool, one.zero_angles) for one in (live, again)]
    # The fit's last bits hang on where its arrays lie in memory.
    assert files[0].load.mass_kg == pytest.approx(files[1].load.mass_kg, rel=1e-12)
    np.testing.assert_allclose(files[0].load.covariance, files[1].load.covariance, rtol=1e-9)
