"""A calibration check's cause as a sentence for a person, with what to do."""

from __future__ import annotations

import numpy as np
from galen_model.arrays import Array
from galen_model.evidence.verdict import MESSAGES, Cause, load_text, wrench_text
from galen_model.files.calibration_file import CalibrationFile

from galen_calibration_behavior.quick_check.answer import CheckLimits, Differences


def in_words(
    cause: Cause,
    found: Differences,
    tool: CalibrationFile,
    limits: CheckLimits,
    hints: tuple[str, ...],
    poses: int,
) -> str:
    """The cause in words; `hints` are what it was found by."""
    if cause is Cause.FITS:
        return _fits(found, limits, hints)
    message = MESSAGES[cause]
    if cause is Cause.NOISE:
        spread = limits.worst(2.0 * found.effect_std)
        return message.text(f"with {poses} poses noise alone may be off by {spread}")
    if cause is Cause.CONTACT:
        return message.text(f"one pose does not agree with the others, {hints[0]}")
    if cause is Cause.UNEXPLAINED:
        rest = limits.worst(np.sqrt(np.mean(found.rest**2, axis=0)))
        left = f"{rest} is left that neither another load nor an offset explains"
        if hints:
            return f"{left}; it is as of {' or '.join(hints)}: fix that, then calibrate again"
        return f"{left}: {message.text()}"
    if cause is Cause.ZERO_LOST:
        return message.text(f"as if {hints[0]}: a constant offset, {wrench_text(found.offset)}")
    if cause is Cause.OFFSET:
        return message.text(wrench_text(found.offset))
    return f"{message.text(_load(cause, found, tool, hints))}; {_offset_beside(found, limits)}"


def _fits(found: Differences, limits: CheckLimits, hints: tuple[str, ...]) -> str:
    size = limits.worst(found.effect)
    text = f"the file fits: a compensation by it is off by at most {size}, within the limits"
    text += f" ({limits.force_n:g} N, {1e3 * limits.torque_nm:g} mN.m)"
    if found.load_p < limits.false_alarm:
        text += ", although noise alone does not explain the change of the load"
    return f"{text}; a little is left as of {' or '.join(hints)}" if hints else text


def _load(cause: Cause, found: Differences, tool: CalibrationFile, hints: tuple[str, ...]) -> str:
    change = (float(found.moments[0]), float(np.sqrt(found.moments_covariance[0, 0])))
    if cause is Cause.OTHER_TOOL:
        names = " or ".join(f"'{name}'" for name in hints)
        return f"{names}, not '{tool.tool}', {load_text(*change)}"
    moved = centre_change(found, tool) if cause is Cause.LOAD else None
    return load_text(*change, *(moved or ()))


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
        return f"beside it an offset, {wrench_text(found.offset)}"
    return "no offset beside it"
