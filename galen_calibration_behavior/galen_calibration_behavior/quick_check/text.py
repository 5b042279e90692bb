"""A quick check's answer as a sentence for a person, with what to do."""

from __future__ import annotations

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile

from galen_calibration_behavior.quick_check.answer import Cause, CheckLimits, Differences

TARE_COMMAND = "ros2 service call /gravcomp/tare std_srvs/srv/Trigger"


def in_words(
    cause: Cause,
    found: Differences,
    tool: CalibrationFile,
    limits: CheckLimits,
    hints: tuple[str, ...],
    poses: int,
) -> str:
    """The answer in words; `hints` are what the cause was told by."""
    size = _worst(found.effect, limits)
    if cause is Cause.NOTHING:
        text = f"the file fits: a compensation by it is off by at most {size}, within the limits"
        text += f" ({limits.force_n:g} N, {1e3 * limits.torque_nm:g} mN.m)"
        if found.load_p < limits.false_alarm:
            text += ", although noise alone does not explain the change of the load"
        return f"{text}; a little is left as of {' or '.join(hints)}" if hints else text
    if cause is Cause.NOISE:
        spread = _worst(2.0 * found.effect_std, limits)
        return (
            f"the readings are too noisy to tell: with {poses} poses, noise alone may be off by"
            f" {spread}; more poses or longer averages tell more"
        )
    if cause is Cause.TOUCHED:
        return f"one pose does not agree with the others, {hints[0]}: was the tool touched? repeat"
    if cause is Cause.UNEXPLAINED:
        rest = _worst(np.sqrt(np.mean(found.rest**2, axis=0)), limits)
        left = f"{rest} is left that neither another load nor an offset explains"
        if hints:
            return f"{left}; it is as of {' or '.join(hints)}: fix that, then calibrate again"
        return (
            f"{left}, nor a loose tool, a joint's zero, a turned sensor or a steady pull alone:"
            " repeat, in case it was touched; else see to the mount and the cables, then calibrate"
            " again"
        )
    if cause in (Cause.OFFSET, Cause.ZERO_LOST):
        text = f"a constant offset, {_values(found.offset)}"
        if cause is Cause.ZERO_LOST:
            text = f"the sensor's zero is lost, as if {hints[0]}: {text}"
        return f"{text}; a tare takes it off: {TARE_COMMAND}"
    return f"{_load(cause, found, tool, hints)}; {_offset_beside(found, limits)}"


def _load(cause: Cause, found: Differences, tool: CalibrationFile, hints: tuple[str, ...]) -> str:
    std = float(np.sqrt(found.moments_covariance[0, 0]))
    change = f"{1e3 * found.moments[0]:+.1f} +- {1e3 * std:.1f} g"
    if cause is Cause.NO_TOOL:
        return f"there is no tool on ({change}): put it on"
    if cause is Cause.OTHER_TOOL:
        names = " or ".join(f"'{name}'" for name in hints)
        return f"the tool on it is {names}, not '{tool.tool}' ({change}): set that tool"
    text = f"the load is another one, by {change}"
    moved = centre_change(found, tool)
    if moved is not None:
        centre, centre_std = moved
        numbers = ", ".join(f"{round(1e3 * value, 1) + 0.0:+.1f}" for value in centre)
        stds = ", ".join(f"{1e3 * value:.1f}" for value in centre_std)
        text += f", its centre by ({numbers}) +- ({stds}) mm"
    return f"{text}: calibrate again"


def centre_change(found: Differences, tool: CalibrationFile) -> tuple[Array, Array] | None:
    """By how much the tool's centre moved, m, and its std, (3,) each; None without a mass.

    p = h / m, so that dp = (dh - p dm) / m for its covariance.
    """
    mass = tool.load.mass_kg + found.moments[0]
    if mass < 5.0 * np.sqrt(found.moments_covariance[0, 0]):
        return None
    centre = (tool.load.mass_kg * tool.load.com_m + found.moments[1:]) / mass
    jacobian = np.column_stack([-centre, np.eye(3)]) / mass
    covariance = jacobian @ found.moments_covariance @ jacobian.T
    return centre - tool.load.com_m, np.sqrt(np.diag(covariance))


def _offset_beside(found: Differences, limits: CheckLimits) -> str:
    if np.any(np.abs(found.offset) > limits.axes + 2.0 * found.offset_std):
        return f"beside it an offset, {_values(found.offset)}"
    return "no offset beside it"


def _values(wrench: Array) -> str:
    force = ", ".join(f"{round(value, 3) + 0.0:+.3f}" for value in wrench[:3])
    torque = ", ".join(f"{round(1e3 * value, 1) + 0.0:+.1f}" for value in wrench[3:])
    return f"({force}) N and ({torque}) mN.m"


def _worst(values: Array, limits: CheckLimits) -> str:
    """The axis that is largest in units of its limit, in words."""
    axis = int(np.argmax(np.abs(values) / limits.axes))
    value = f"{values[axis]:.3f} N" if axis < 3 else f"{1e3 * values[axis]:.2f} mN.m"
    return f"{value} in {WRENCH_AXES[axis]}"
