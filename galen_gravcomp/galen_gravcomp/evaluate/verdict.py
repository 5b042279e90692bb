"""Does the tool's file still fit? A word for a program, and a sentence for a person."""

from __future__ import annotations

from enum import Enum

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.rest.binned import StillPhases

from galen_gravcomp.evaluate.load_change import LoadChange
from galen_gravcomp.evaluate.residual_decomposition import Limits, Misfit, take_apart

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


class Verdict(Enum):
    """Whether the tool's file still fits the recording, and what would fix it."""

    FITS = "fits"
    OFFSET = "offset"
    DRIFT = "drift"
    LOAD = "load"
    CHANGED = "changed"
    UNEXPLAINED = "unexplained"
    UNKNOWN = "unknown"


def judge(
    phases: StillPhases,
    misfit: Misfit | None,
    change: LoadChange | None,
    tool: CalibrationFile,
    limits: Limits,
    *,
    moving: Array,
    start_ns: int,
    stamps_jump: bool = False,
) -> tuple[Verdict, str]:
    """The verdict and a sentence for a person, with times from `start_ns` on.

    `moving` (6,): RMSE of the cells' means in motion. Without a still phase a small one is a fit
    as well; a large one may be inertial forces.
    """
    if not len(phases):
        return _judge_motion(limits, moving)
    if change is not None:
        parts = (slice(change.first_after), slice(change.first_after, None))
        before, after = (
            _judge_still(part, take_apart(part, tool, stamps_jump=stamps_jump), tool, limits)[1]
            for part in (phases.part(rows) for rows in parts)
        )
        time_s = (change.time_ns - start_ns) * 1e-9
        what = "the load changes"
        if change.mass_kg is None:
            axis, _, size = _worst(np.abs(change.offset_step), limits)
            sign = "-" if change.offset_step[axis] < 0.0 else "+"
            what = f"the reading's offset jumps by {sign}{size}"
        return Verdict.CHANGED, f"{what} at {time_s:.1f} s. Before: {before}. After: {after}"
    return _judge_still(phases, misfit, tool, limits)


def _judge_motion(limits: Limits, moving: Array) -> tuple[Verdict, str]:
    none = "no still phase in it (--still-rate-rad-s)"
    if not np.all(np.isfinite(moving)):
        return Verdict.UNKNOWN, f"{none}: nothing can be said of the file's fit"
    _, ratio, size = _worst(moving, limits)
    if ratio <= 1.0:
        return Verdict.FITS, f"the file fits in motion, to {size}; {none}"
    return Verdict.UNKNOWN, f"in motion {size} is left over, which may be inertial forces; {none}"


def _judge_still(
    phases: StillPhases, misfit: Misfit | None, tool: CalibrationFile, limits: Limits
) -> tuple[Verdict, str]:
    if misfit is None:
        _, ratio, size = _worst(_rms(phases.mean), limits)
        plural = "" if len(phases) == 1 else "s"
        few = f"only {len(phases)} still phase{plural}, too few to take it apart"
        if ratio <= 1.0:
            return Verdict.FITS, f"the file fits, to {size}; {few}"
        return Verdict.UNKNOWN, f"{size} is left over; {few}"
    total = _rms(phases.mean[misfit.used])
    worst, ratio, size = _worst(total, limits)
    notes = ""
    # One that is out by its noise alone, but by nothing that matters, is not worth a word.
    size_of_each = np.max(np.abs(phases.mean) / limits.axes, axis=1)
    outside = int(np.count_nonzero(~misfit.used & (size_of_each > _WORTH_SAYING)))
    if outside:
        verb = "stands" if outside == 1 else "stand"
        notes = f"; {outside} of {len(phases)} still phases {verb} out (a hand? see the worst)"
    unexplained = _unexplained(phases, misfit, limits)
    verdict = _reason(misfit, worst, float(total[worst]), ratio, limits)
    why = _in_words(verdict, misfit, worst, tool, unexplained, limits)
    if ratio <= 1.0:
        if verdict is not Verdict.UNEXPLAINED and ratio > _WORTH_SAYING:
            notes = f", most of it {why}{notes}"
        return Verdict.FITS, f"the file fits, to {size}{notes}"
    return verdict, f"{size} is left over: {why}{notes}"


def _reason(misfit: Misfit, axis: int, total: float, ratio: float, limits: Limits) -> Verdict:
    """The largest part in `axis`, if the parts together explain enough of `total` there."""
    parts = {
        Verdict.OFFSET: misfit.offset,
        Verdict.DRIFT: misfit.drift,
        Verdict.LOAD: misfit.load,
    }
    sizes = {
        verdict: float(part[axis])
        for verdict, part in parts.items()
        if part is not None and verdict.value in misfit.significant
    }
    rest = _worst(misfit.rest, limits)[1]
    beyond = rest > 1.0 and rest * _WORTH_BEYOND > ratio
    # A drift that began at zero has a mean 1.7 times as large as what it scatters by.
    if 2.0 * sizes.get(Verdict.DRIFT, 0.0) > sizes.get(Verdict.OFFSET, 0.0):
        sizes.pop(Verdict.OFFSET, None)
    if not sizes or misfit.rest[axis] * _WORTH > total or beyond:
        return Verdict.UNEXPLAINED
    return max(sizes, key=lambda verdict: sizes[verdict])


def _in_words(
    verdict: Verdict,
    misfit: Misfit,
    axis: int,
    tool: CalibrationFile,
    unexplained: str,
    limits: Limits,
) -> str:
    others = "a cable, a loose tool, wrong angles, a hand?"
    if verdict is Verdict.UNEXPLAINED:
        rest = _worst(misfit.rest, limits)[2]
        return f"whatever load, offset and drift are taken off, {rest} stays ({others})"
    besides = f"; besides, {unexplained} is left that this does not explain ({others})"
    hint = ""
    if verdict is Verdict.LOAD:
        text, hint = _load_in_words(misfit, tool)
    elif verdict is Verdict.OFFSET:
        text = "a constant offset"
        if not misfit.why_no_load and not misfit.why_no_drift:
            hint = ", which a tare takes off"
        may_be = ["another load"] * bool(misfit.why_no_load)
        may_be += ["drift"] * bool(misfit.why_no_drift)
        if may_be:
            text += f" (or {' or '.join(may_be)}, which these still phases can't tell from it)"
    else:
        assert misfit.rate_per_hour is not None
        unit = "N/h" if axis < 3 else "mN.m/h"
        rate = misfit.rate_per_hour[axis] * (1.0 if axis < 3 else 1e3)
        text = f"drift of the sensor, here by {rate:+.3g} {unit}"
        if misfit.why_no_load:
            text += " (or another load, which these still phases can't tell from it)"
    # What fixes one part alone is no advice where another is left.
    return text + (besides if unexplained else hint)


def _load_in_words(misfit: Misfit, tool: CalibrationFile) -> tuple[str, str]:
    """The other load, and what to do about it."""
    mass = tool.load.mass_kg + misfit.mass_kg
    sure = _SURE * misfit.mass_std_kg
    text = f"as of another load, by {1e3 * misfit.mass_kg:+.1f} +- {1e3 * misfit.mass_std_kg:.1f} g"
    if mass + tool.adapter.mass_kg < -sure:
        return text, ", less than nothing (are the signs or axes of the readings others?)"
    if mass < max(sure, _NO_LOAD * tool.load.mass_kg):
        return text, " (no tool on it?)"
    moved = (tool.load.mass_kg * tool.load.com_m + misfit.moment_kgm) / mass - tool.load.com_m
    # h / m: what the mass is not known by moves the centre as well.
    std = np.max(np.hypot(misfit.moment_std_kgm, tool.load.com_m * misfit.mass_std_kg)) / mass
    centre = ", ".join(f"{1e3 * value:+.1f}" for value in moved)
    return (
        f"{text}, its centre by ({centre}) +- {1e3 * std:.1f} mm",
        " (recalibrate; or another tool?)",
    )


def _unexplained(phases: StillPhases, misfit: Misfit, limits: Limits) -> str:
    """The rest in words where it is well above the noise and near a limit, else empty."""
    noise = np.sqrt(np.mean(phases.std_of_mean**2, axis=0))
    rest = np.where(misfit.rest > _ABOVE_NOISE * noise, misfit.rest, 0.0)
    _, ratio, size = _worst(rest, limits)
    return size if ratio > _WORTH_SAYING else ""


def _worst(values: Array, limits: Limits) -> tuple[int, float, str]:
    """The axis that is largest in units of its limit, how large, and that in words."""
    over = values / limits.axes
    axis = int(np.argmax(over))
    value = f"{values[axis]:.3f} N" if axis < 3 else f"{1e3 * values[axis]:.2f} mN.m"
    return axis, float(over[axis]), f"{value} in {WRENCH_AXES[axis]}"


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))
