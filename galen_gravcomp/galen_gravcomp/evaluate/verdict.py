"""Judge whether the calibration file still fits: a word, and a sentence."""

from __future__ import annotations

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.evidence.verdict import Cause, Limits, Verdict
from galen_model.files.calibration_file import CalibrationFile
from galen_model.rest.binned import StillPhases

from galen_gravcomp.evaluate.residual_decomposition import (
    LoadChange,
    ResidualParts,
    decompose,
    rms,
)

# The parts are the reason if leaving them out makes the residual so many times smaller ...
_WORTH = 2.0
# ... or so many times, where what they leave is beyond the limits.
_WORTH_BEYOND = 4.0
# In units of the limits: what is worth a word, though the file fits.
_WORTH_SAYING = 0.5
_ABOVE_NOISE = 3.0
# A centre can be told only of a load that is there: in parts of the file's mass.
_NO_LOAD = 0.05
_SURE = 5.0


def judge(
    phases: StillPhases,
    parts: ResidualParts | None,
    change: LoadChange | None,
    tool: CalibrationFile,
    limits: Limits,
    *,
    moving: Array,
    start_ns: int,
    stamps_jump: bool = False,
) -> Verdict:
    """Return the verdict, with times from `start_ns` on.

    `moving` (6,): RMSE of the cells' means in motion. Without a still phase a small one is a fit
    as well; a large one may be inertial forces.
    """
    if not len(phases):
        return _judge_motion(limits, moving)
    if change is not None:
        sides = (slice(change.first_after), slice(change.first_after, None))
        before, after = (
            _judge_still(side, decompose(side, tool, stamps_jump=stamps_jump), tool, limits).text
            for side in (phases.part(rows) for rows in sides)
        )
        time_s = (change.time_ns - start_ns) * 1e-9
        what = "the load changes"
        if change.mass_kg is None:
            axis, _, size = _worst(np.abs(change.offset_step), limits)
            sign = "-" if change.offset_step[axis] < 0.0 else "+"
            what = f"the reading's offset jumps by {sign}{size}"
        return Verdict(Cause.CHANGED, f"{what} at {time_s:.1f} s. Before: {before}. After: {after}")
    return _judge_still(phases, parts, tool, limits)


def _judge_motion(limits: Limits, moving: Array) -> Verdict:
    none = "no rest segment in it"
    if not np.all(np.isfinite(moving)):
        return Verdict(Cause.UNKNOWN, f"{none}: nothing can be said of the file's fit")
    _, ratio, size = _worst(moving, limits)
    if ratio <= 1.0:
        return Verdict(Cause.FITS, f"the file fits in motion, to {size}; {none}")
    text = f"the residual in motion is {size}, which may be inertial forces; {none}"
    return Verdict(Cause.UNKNOWN, text)


def _judge_still(
    phases: StillPhases, parts: ResidualParts | None, tool: CalibrationFile, limits: Limits
) -> Verdict:
    if parts is None:
        _, ratio, size = _worst(rms(phases.mean), limits)
        plural = "" if len(phases) == 1 else "s"
        few = f"only {len(phases)} rest segment{plural}, too few to decompose it"
        if ratio <= 1.0:
            return Verdict(Cause.FITS, f"the file fits, to {size}; {few}")
        return Verdict(Cause.UNKNOWN, f"the residual is {size}; {few}")
    total = rms(phases.mean[parts.used])
    worst, ratio, size = _worst(total, limits)
    notes = ""
    # One that is out by its noise alone, but by nothing that matters, is not worth a word.
    size_of_each = np.max(np.abs(phases.mean) / limits.axes, axis=1)
    outside = int(np.count_nonzero(~parts.used & (size_of_each > _WORTH_SAYING)))
    if outside:
        plural = "an outlier" if outside == 1 else "outliers"
        notes = f"; {outside} of {len(phases)} rest segments: {plural} (contact? see the worst)"
    unexplained = _unexplained(phases, parts, limits)
    cause = _reason(parts, worst, float(total[worst]), ratio, limits)
    why = _in_words(cause, parts, worst, tool, unexplained, limits)
    if ratio <= 1.0:
        if cause is not Cause.UNEXPLAINED and ratio > _WORTH_SAYING:
            notes = f", most of it {why}{notes}"
        return Verdict(Cause.FITS, f"the file fits, to {size}{notes}")
    return Verdict(cause, f"the residual is {size}: {why}{notes}")


def _reason(parts: ResidualParts, axis: int, total: float, ratio: float, limits: Limits) -> Cause:
    """The largest part in `axis`, if the parts together explain enough of `total` there."""
    by_cause = {
        Cause.OFFSET: parts.offset,
        Cause.DRIFT: parts.drift,
        Cause.LOAD: parts.load,
    }
    sizes = {
        cause: float(part[axis])
        for cause, part in by_cause.items()
        if part is not None and cause.word in parts.significant
    }
    rest = _worst(parts.rest, limits)[1]
    beyond = rest > 1.0 and rest * _WORTH_BEYOND > ratio
    # A drift that began at zero has a mean 1.7 times as large as what it scatters by.
    if 2.0 * sizes.get(Cause.DRIFT, 0.0) > sizes.get(Cause.OFFSET, 0.0):
        sizes.pop(Cause.OFFSET, None)
    if not sizes or parts.rest[axis] * _WORTH > total or beyond:
        return Cause.UNEXPLAINED
    return max(sizes, key=lambda cause: sizes[cause])


def _in_words(
    cause: Cause,
    parts: ResidualParts,
    axis: int,
    tool: CalibrationFile,
    unexplained: str,
    limits: Limits,
) -> str:
    others = "a cable, a loose tool, wrong angles, contact?"
    if cause is Cause.UNEXPLAINED:
        rest = _worst(parts.rest, limits)[2]
        return f"load, offset and drift leave {rest} unexplained ({others})"
    besides = f"; besides, {unexplained} stays unexplained ({others})"
    hint = ""
    if cause is Cause.LOAD:
        text, hint = _load_in_words(parts, tool)
    elif cause is Cause.OFFSET:
        text = "a constant offset"
        if not parts.why_no_load and not parts.why_no_drift:
            hint = ", which a tare subtracts"
        may_be = ["another load"] * bool(parts.why_no_load)
        may_be += ["drift"] * bool(parts.why_no_drift)
        if may_be:
            text += f" (or {' or '.join(may_be)}, not distinguishable by these rest segments)"
    else:
        assert parts.rate_per_hour is not None
        unit = "N/h" if axis < 3 else "mN.m/h"
        rate = parts.rate_per_hour[axis] * (1.0 if axis < 3 else 1e3)
        text = f"drift of the sensor, here by {rate:+.3g} {unit}"
        if parts.why_no_load:
            text += " (or another load, not distinguishable by these rest segments)"
    # What fixes one part alone is no advice where another is left.
    return text + (besides if unexplained else hint)


def _load_in_words(parts: ResidualParts, tool: CalibrationFile) -> tuple[str, str]:
    """The other load, and what to do about it."""
    mass = tool.load.mass_kg + parts.mass_kg
    sure = _SURE * parts.mass_std_kg
    text = f"as of another load, by {1e3 * parts.mass_kg:+.1f} +- {1e3 * parts.mass_std_kg:.1f} g"
    if mass + tool.adapter.mass_kg < -sure:
        return text, ", less than nothing (are the signs or axes of the readings others?)"
    if mass < max(sure, _NO_LOAD * tool.load.mass_kg):
        return text, " (no tool on it?)"
    moved = (tool.load.mass_kg * tool.load.com_m + parts.moment_kgm) / mass - tool.load.com_m
    # h / m: what the mass is not known by moves the centre as well.
    std = np.max(np.hypot(parts.moment_std_kgm, tool.load.com_m * parts.mass_std_kg)) / mass
    centre = ", ".join(f"{1e3 * value:+.1f}" for value in moved)
    return (
        f"{text}, its centre by ({centre}) +- {1e3 * std:.1f} mm",
        " (recalibrate; or another tool?)",
    )


def _unexplained(phases: StillPhases, parts: ResidualParts, limits: Limits) -> str:
    """The rest in words where it is well above the noise and near a limit, else empty."""
    noise = np.sqrt(np.mean(phases.std_of_mean**2, axis=0))
    rest = np.where(parts.rest > _ABOVE_NOISE * noise, parts.rest, 0.0)
    _, ratio, size = _worst(rest, limits)
    return size if ratio > _WORTH_SAYING else ""


def _worst(values: Array, limits: Limits) -> tuple[int, float, str]:
    """The axis that is largest in units of its limit, how large, and that in words."""
    over = values / limits.axes
    axis = int(np.argmax(over))
    value = f"{values[axis]:.3f} N" if axis < 3 else f"{1e3 * values[axis]:.2f} mN.m"
    return axis, float(over[axis]), f"{value} in {WRENCH_AXES[axis]}"
