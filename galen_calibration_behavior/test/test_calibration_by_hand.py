# SPDX-License-Identifier: Apache-2.0
"""A calibration by hand: an operator who turns the six-axis arm as the feedback asks."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from galen_calibration_behavior.calibration.by_hand import (
    ByHandProcedure,
    down_text,
    missing_direction,
)
from galen_calibration_behavior.calibration.estimate import estimate
from galen_calibration_behavior.calibration.procedure import CalibrationRequest
from galen_calibration_behavior.common.commands import (
    AttachTool,
    CalibrationCode,
    CalibrationState,
    Measurements,
    PoseFeedback,
    PosesEnd,
    ZeroSensor,
)
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_common.goal.procedure import MoveTo, Stop
from galen_model.arm.description import read_arm
from galen_model.arm.galen import SENSOR
from galen_model.load.model import ADAPTER, TOOLS, gravity_wrench
from galen_model.load.readings import single_load_design
from galen_model.poses.design import compensation_std_under

ARM = read_arm((Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf").read_text())
SETTINGS = CalibrationParameters(
    arm=ARM, settle_s=0.1, average_s=0.4, by_hand_std_n=0.002, by_hand_std_nm=0.0001
)
TOOL = TOOLS["retractor"].load


class Operator:
    """Turns the arm to the orientation that is asked for, at 100 Hz, and changes the tool."""

    def __init__(self, *, settings=SETTINGS, one_sweep=False, zero=True, seed=1) -> None:
        self.procedure = ByHandProcedure(
            settings, CalibrationRequest("retractor", one_sweep, False, np.zeros((0, 6)), zero=zero)
        )
        self.rng = np.random.default_rng(seed)
        self.samples = self.rng.uniform(ARM.lower, ARM.upper, (3000, 6))
        self.directions = ARM.gravity_in_sensor(self.samples) / 9.80665
        self.joints = np.array([0.0, -1.2, 1.4, 0.2, 0.3, 0.0])  # not at home
        self.stamp_ns, self.offset = 10**11, np.full(6, 0.7)
        self.tool_on, self.seen, self.measured = True, [], None
        self.procedure.start()

    def run(self, limit_s=300.0, until=lambda _: False) -> PosesEnd | None:
        """Feed samples until the end, or `until(self)`."""
        end_ns, heard_ns = self.stamp_ns + limit_s * 1e9, self.stamp_ns
        while self.stamp_ns < end_ns:
            if self.stamp_ns - heard_ns > 2e9:  # an orientation that was there already
                self.turn(self.rng.standard_normal(3))
            for command in self.procedure.take_commands():
                heard_ns = self.stamp_ns
                if isinstance(command, PosesEnd):
                    return command
                self.obey(command)
            if until(self):
                return None
            self.stamp_ns += 10_000_000
            noise = SENSOR.noise_std * self.rng.standard_normal(6)
            self.procedure.on_joints(self.stamp_ns, self.joints, np.zeros(6))
            self.procedure.on_wrench(self.stamp_ns, self.reading() + noise)
        raise AssertionError(self.seen[-1])

    def reading(self) -> np.ndarray:
        gravity = ARM.gravity_in_sensor(self.joints)
        load = gravity_wrench(gravity, ADAPTER)
        return load + (gravity_wrench(gravity, TOOL) if self.tool_on else 0.0) + self.offset

    def obey(self, command) -> None:
        self.seen.append(command)
        match command:
            case PoseFeedback(state=CalibrationState.REMOVE_TOOL | CalibrationState.ATTACH_TOOL):
                self.tool_on = command.state == CalibrationState.ATTACH_TOOL
                assert self.procedure.confirm()
            case ZeroSensor():
                self.offset = self.offset - self.reading()
                self.procedure.on_service(True, "")
            case PoseFeedback(message=message):
                if asked := re.search(r"missing: (.*) of ft_sensor down", message):
                    axes = re.findall(r"([+-])([xyz])", asked[1])
                    down = sum((1 if s == "+" else -1) * np.eye(3)["xyz".index(a)] for s, a in axes)
                    self.turn(down / np.linalg.norm(down))
                elif command.angles:
                    self.turn(self.rng.standard_normal(3))
            case Measurements():
                self.measured = command
                self.procedure.on_estimated()

    def turn(self, down: np.ndarray) -> None:
        near = self.directions @ (down + 0.3 * self.rng.standard_normal(3))
        self.joints = self.samples[int(np.argmax(near))]


@pytest.mark.parametrize(("one_sweep", "zero"), [(False, False), (True, True)])
def test_finishes_at_the_wanted_precision_and_commands_no_motion(tmp_path, one_sweep, zero):
    operator = Operator(one_sweep=one_sweep, zero=zero)
    end = operator.run()
    assert end.error_code == CalibrationCode.NONE
    assert not any(isinstance(command, MoveTo | Stop | AttachTool) for command in operator.seen)
    assert zero == any(isinstance(command, ZeroSensor) for command in operator.seen)
    found = estimate(tmp_path / "t.json", "retractor", np.zeros(3), operator.measured, []).content
    measured = operator.measured
    assert 12 <= len(measured.tool) <= 40
    std = compensation_std_under(
        measured.tool.gravity, np.median(measured.tool.std_of_mean, axis=0), ARM
    )
    assert np.all(std <= 1.2 * SETTINGS.by_hand_std)
    if one_sweep:
        mass = found.load.mass_kg + found.adapter.mass_kg
        assert mass == pytest.approx(TOOL.mass_kg + ADAPTER.mass_kg, abs=0.002)
        return
    for name, true in (("load", TOOL), ("adapter", ADAPTER)):
        estimated = getattr(found, name)
        assert abs(estimated.mass_kg - true.mass_kg) < 4.0 * estimated.mass_std_kg, name
        assert np.all(np.abs(estimated.com_m - true.com_m) < 4.5 * estimated.com_std_m), name
    found = replace(found, arm=ARM)
    operator.joints = np.array([0.4, -1.0, 1.2, -0.3, 0.8, 0.1])
    np.testing.assert_allclose(
        found.predict(ARM.angles(operator.joints)), operator.reading(), atol=0.004
    )


def test_an_orientation_counts_once_and_a_confirmation_ends_a_sweep():
    operator = Operator(one_sweep=True, settings=replace(SETTINGS, by_hand_std_n=1e-4))
    operator.run(until=lambda o: o.procedure.progress[0] == 1)
    operator.turn = lambda down: None
    with pytest.raises(AssertionError):
        operator.run(2.0)
    poses = operator.procedure.progress[0]
    with pytest.raises(AssertionError):
        operator.run(5.0)
    assert operator.procedure.progress[0] == poses
    assert not operator.procedure.confirm()  # too few poses to end with
    del operator.turn
    operator.joints = operator.samples[0]
    operator.run(until=lambda o: o.procedure.waiting_for_person)
    assert operator.procedure.progress[0] >= 12
    assert operator.procedure.confirm()
    assert operator.run().error_code == CalibrationCode.NONE


def test_no_new_orientation_for_long_ends_it():
    operator = Operator(one_sweep=True, settings=replace(SETTINGS, confirm_timeout_s=1.0))
    operator.run(until=lambda o: o.procedure.progress[0] == 3)
    for k in range(40):
        operator.procedure.on_joints(operator.stamp_ns, operator.joints, np.zeros(6))
        operator.procedure.on_wrench(operator.stamp_ns, operator.reading())
        operator.stamp_ns += 2_000_000
        operator.procedure.on_wall(0.1 * k)
    (end,) = (c for c in operator.procedure.take_commands() if isinstance(c, PosesEnd))
    assert end.error_code == CalibrationCode.CONFIRM_TIMEOUT
    assert "no pose in a new orientation in 1 s; the tool sweep has" in end.error_msg


def test_the_predicted_precision_is_that_of_least_squares():
    rng = np.random.default_rng(3)
    gravity = ARM.gravity_in_sensor(rng.uniform(ARM.lower, ARM.upper, (15, 6)))
    sigma = np.array([0.02, 0.02, 0.03, 4e-4, 4e-4, 4e-4])
    design = single_load_design(gravity)
    weight = 1.0 / np.tile(sigma, 15)
    everywhere = single_load_design(
        ARM.gravity_in_sensor(rng.uniform(ARM.lower, ARM.upper, (3000, 6)))
    )
    errors = []
    for _ in range(400):
        noise = np.tile(sigma, 15) * rng.standard_normal(90)
        found = np.linalg.lstsq(weight[:, None] * design.reshape(90, 10), weight * noise)[0]
        errors.append(np.mean((everywhere @ found) ** 2, axis=0))
    np.testing.assert_allclose(
        compensation_std_under(gravity, sigma, ARM), np.sqrt(np.mean(errors, axis=0)), rtol=0.12
    )
    one_axis = ARM.gravity_in_sensor(np.zeros((20, 6)))
    assert np.all(np.isinf(compensation_std_under(one_axis, sigma, ARM)))


def test_the_missing_orientation_is_away_from_those_there_are():
    down = np.tile([0.0, 0.0, -9.80665], (6, 1)) + np.linspace(0, 2, 6)[:, None] * [1.0, 0, 0]
    missing = missing_direction(down, np.full(6, 0.01), ARM)
    assert abs(missing[1]) > 0.7 or missing[2] > 0.7
    assert down_text(np.array([0.1, -0.9, 0.2]), "tool0") == "-y of tool0 down"
    assert down_text(np.array([0.7, 0.0, -0.7]), "tool0") == "+x and -z of tool0 down alike"
