"""What else, instead of a cable, may stand behind what a sweep reads beyond a calibration file.

Smooth in the pose are many errors. Each is fitted beside a load and offsets (mass, first moment,
six offsets) to the poses that `learning` fits a cable to, and scored on the same blocks held
out; one that isn't clearly worse there than the cable can't be told from it by this sweep:

    a joint's zero, a turned sensor, an inclined base     `reading_model`, by Gauss-Newton
    a drift of the sensor                                 `drifting`: straight, or a walk
    a loose tool                                          tau = s (a x u)

with u gravity in ft_sensor, a the x and y parts of u / |u| and s mass times shift: a tool with play
in its coupling hangs to the lower side.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.bias.curve import BiasShape, Shape
from galen_model.load.bias.drifting import Problem, Sweeps
from galen_model.load.cable.fit import CableSweep
from galen_model.load.cable.learning import (
    CableScore,
    LearnedCable,
    clearly_better,
    least_squares,
    linear_held_out,
    scored,
)
from galen_model.load.inertia.identification import OTHER_MASS
from galen_model.load.model import gravity_regressor
from galen_model.load.mounting.mounting import entities
from galen_model.load.mounting.reading_model import JointPoses, MountedSweep, ReadingModel

_MOUNTINGS = {
    "a joint's wrong zero": "joint_zero",
    "a turned sensor": "sensor_rotation",
    "an inclined base": "base_inclination",
}
_DRIFTS = (BiasShape(Shape.LINEAR), BiasShape(Shape.WALK, 10.0))
DRIFT, LOOSE = "a drift of the sensor", "a loose tool"
# Quadratic convergence: angles of 0.3 rad settle to 1e-9 in five.
_STEPS = 6
# Of the mean square that another tool leaves a load leaves less; of a cable's pull mostly more.
_LOAD_LEAVES = 0.06


def check_same_tool(tool: CalibrationFile, sweep: CableSweep) -> list[str]:
    """Compare the load that the sweep's wrenches show with the file's; return warnings.

    Raises IdentificationError where another load explains nearly all of them.
    """
    columns = np.concatenate(
        [
            gravity_regressor(gravity_in_sensor(sweep.joints[:, 3], sweep.joints[:, 4])),
            np.broadcast_to(np.eye(6), (len(sweep), 6, 6)),
        ],
        axis=2,
    )
    found = least_squares(columns, sweep.wrench, sweep.std_of_mean)
    mass = tool.load.mass_kg + tool.adapter.mass_kg
    if abs(found[0]) <= OTHER_MASS * mass:
        return []
    file = scored(sweep, np.zeros_like(sweep.wrench))
    left = (scored(sweep, columns @ found).chi / file.chi) ** 2
    text = (
        f"the recording is of {1e3 * (mass + found[0]):.1f} g, the file of {1e3 * mass:.1f} g on"
        f" the sensor, more than {100.0 * OTHER_MASS:.0f} % apart"
    )
    if left < _LOAD_LEAVES:
        raise IdentificationError(
            f"{text}, and another load leaves only {100.0 * left:.1g} % of what the file leaves:"
            " another tool is on (or the cable pulls straight up or down, as a load does); name the"
            " tool that is on, or calibrate it without the cable first"
        )
    return [f"{text}: if that is not the cable, another tool is on"]


def rivals(
    tool: CalibrationFile, sweep: CableSweep, learned: LearnedCable
) -> dict[str, CableScore]:
    """How well each other explanation predicts the blocks held out that the cable was scored on.

    tool: the file whose predictions the sweep's wrenches are beyond.
    """
    found = {
        name: _mounting(tool, sweep, learned.block, group) for name, group in _MOUNTINGS.items()
    }
    drifts = [_drift(sweep, learned.block, shape) for shape in _DRIFTS]
    found[DRIFT] = min(drifts, key=lambda predicted: scored(sweep, predicted).chi)
    found[LOOSE] = _loose(sweep, learned.block)
    return {name: scored(sweep, predicted) for name, predicted in found.items()}


def doubts(sweep: CableSweep, learned: LearnedCable, others: dict[str, CableScore]) -> list[str]:
    """A warning for each of `rivals` that the cable isn't clearly better than, the best first."""
    left = [
        name
        for name, other in others.items()
        if not clearly_better(sweep, learned.block, learned.held_out, other)
    ]
    return [
        f"this may be no cable: {name} explains it as well or better (it leaves"
        f" {others[name].chi:.2g} times the noise on poses held out, the cable"
        f" {learned.held_out.chi:.2g} times); look there first if nothing that pulls was put on"
        for name in sorted(left, key=lambda name: others[name].chi)
    ]


def _mounting(tool: CalibrationFile, sweep: CableSweep, block: np.ndarray, group: str) -> Array:
    # The file's own mounting aside: what comes on top of it is small, and looks the same there.
    bare = replace(tool, mounting=None)
    roll, tilt = sweep.joints[:, 3], sweep.joints[:, 4]
    beyond = bare.predict(roll, tilt)
    asked = entities((group,))
    model = ReadingModel(
        [MountedSweep(JointPoses(roll, tilt), slice(0, 4), None, slice(4, 10))],
        JointPoses(np.zeros(1), np.zeros(1)),
        asked,
        10,
    )
    start = np.zeros(10 + len(asked))
    start[:4] = tool.load.load.moments + tool.adapter.load.moments
    predicted = np.zeros_like(sweep.wrench)
    for part in np.unique(block):
        out = block == part
        values = start
        for _ in range(_STEPS):
            reading, jacobian = model.evaluate(values)
            miss = sweep.wrench + beyond - reading
            values = values + least_squares(jacobian[~out], miss[~out], sweep.std_of_mean[~out])
        predicted[out] = (model.evaluate(values)[0] - beyond)[out]
    return predicted


def _loose(sweep: CableSweep, block: np.ndarray) -> Array:
    gravity = gravity_in_sensor(sweep.joints[:, 3], sweep.joints[:, 4])
    aside = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    aside[:, 2] = 0.0
    column = np.zeros((len(sweep), 6, 1))
    column[:, 3:, 0] = np.cross(aside, gravity)
    return linear_held_out(sweep, block, column)


def _drift(sweep: CableSweep, block: np.ndarray, shape: BiasShape) -> Array:
    gravity = gravity_in_sensor(sweep.joints[:, 3], sweep.joints[:, 4])
    segment = np.zeros(len(sweep), dtype=int)
    sweeps = Sweeps(gravity_regressor(gravity), sweep.wrench, sweep.time_s, segment)
    predicted = np.zeros_like(sweep.wrench)
    for part in np.unique(block):
        out = block == part
        problem = Problem(sweeps, (shape, shape), (~out).astype(float))
        values = problem.solve(np.median(sweep.std_of_mean, axis=0))[0]
        predicted[out] = (sweeps.design @ values + problem.bias(values))[out]
    return predicted
