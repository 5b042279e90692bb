# SPDX-License-Identifier: Apache-2.0
"""Residual of the rest segments of a recording: its parts, changes, and whether the file fits.

With u_k gravity in the sensor's frame in rest segment k, the mean residual there is fitted by

    r_k = G(u_k) d + b + c (t_k - t_mean) + rest

d: what the load (mass, first moment) differs from the file's, in which the reading is linear (see
`galen_model.load.model`); b: an offset, as a sensor zeroed anew or drifted leaves it, which a
tare subtracts; c: its drift; robustly, so that a few segments with contact don't count
(`galen_model.estimation.problem`). Poses that don't distinguish d from b are rejected by a
calibration's gate (`galen_model.load.identifiability`); then only offset and drift are fitted. The
standard deviations come from the rest's scatter from segment to segment, so a sensor's coloured
noise is in them, but not a bias drift over many segments, which offset and drift follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.distributions import chi2_sf
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.estimation.least_squares import Information, least_squares
from galen_model.estimation.problem import Fit, Problem
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.identifiability import LOAD_PARAMETERS, check_excitation
from galen_model.load.model import gravity_regressor
from galen_model.load.readings import with_offsets
from galen_model.load.verdict import Cause, Limits, Verdict
from galen_model.rest.binned import StillPhases

from galen_gravcomp.evaluate.report import by_axis

_FEWEST_PHASES = 4
# Drift needs segments before and after; with fewer it takes up whatever is left.
_FEWEST_FOR_DRIFT = 8
_SHORTEST_DRIFT_S = 30.0
_SIGNIFICANT = 1e-3
_FEWEST_A_SIDE = 6
_CHANGE = 5.0
# The parts are the reason if leaving them out makes the residual so many times smaller ...
_WORTH = 2.0
# ... or so many times, where what they leave is beyond the limits.
_WORTH_BEYOND = 4.0
# In units of the limits: worth a note, though the file fits.
_WORTH_SAYING = 0.5
_ABOVE_NOISE = 3.0
# A centre is identifiable only of a load that is there: in parts of the file's mass.
_NO_LOAD = 0.05
_SURE = 5.0
_OTHERS = "a cable, a loose tool, wrong angles, contact?"


@dataclass(frozen=True)
class ResidualParts:
    """Parts of the residual by name: load, offset, drift, where they were fitted; rest.

    rms: root mean square over the rest segments (6,), N and N.m; rest: unexplained. values, stds:
    load (4,): mass (kg) and first moment (kg.m), true less file's; offset (6,), N and N.m; drift
    (6,), an hour. used (n,): segments that agree with the rest. significant: the parts that noise
    does not make; why_no_load, why_no_drift: why they were not fitted.
    """

    rms: dict[str, Array]
    values: dict[str, Array]
    stds: dict[str, Array]
    used: np.ndarray
    why_no_load: str
    why_no_drift: str
    significant: frozenset[str]

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, SI; None where a part was not fitted."""
        load, load_std = (part.get("load") for part in (self.values, self.stds))
        return {
            **{name: by_axis(self.rms.get(name)) for name in ("load", "offset", "drift", "rest")},
            "offset_value": by_axis(self.values["offset"]),
            "offset_std": by_axis(self.stds["offset"]),
            "rate_per_hour": by_axis(self.values.get("drift")),
            "rate_std": by_axis(self.stds.get("drift")),
            "mass_kg": None if load is None else float(load[0]),
            "mass_std_kg": None if load_std is None else float(load_std[0]),
            "moment_kgm": [None] * 3 if load is None else load[1:].tolist(),
            "moment_std_kgm": [None] * 3 if load_std is None else load_std[1:].tolist(),
            "outliers": int(np.count_nonzero(~self.used)),
            "why_no_load": self.why_no_load,
            "why_no_drift": self.why_no_drift,
            "significant": sorted(self.significant),
        }


def decompose(
    phases: StillPhases, tool: CalibrationFile, *, stamps_jump: bool = False
) -> ResidualParts | None:
    """Decompose the segments' residuals.

    Args:
        phases: n rest segments, with the compensated wrench's means.
        tool: the calibration file that compensated them.
        stamps_jump: their times are not reliable, and drift is not identifiable.

    Returns:
        The parts; None where segments are too few or agree on nothing.

    """
    if len(phases) < _FEWEST_PHASES:
        return None
    gravity = _gravity(phases, tool)
    time_h = (phases.start_ns + phases.end_ns - 2 * int(phases.start_ns[0])) / 2 / 3.6e12
    centred_h = time_h - time_h.mean()
    drift = {}
    why_no_drift = ""
    if stamps_jump:
        why_no_drift = "the time stamps jump"
    elif len(phases) < _FEWEST_FOR_DRIFT:
        why_no_drift = f"{len(phases)} rest segments are too few"
    elif np.ptp(time_h) * 3600.0 < _SHORTEST_DRIFT_S:
        why_no_drift = f"the rest segments span less than {_SHORTEST_DRIFT_S:.0f} s"
    else:
        drift = {"drift": centred_h[:, None, None] * np.eye(6)}
    why_no_load = ""
    try:
        columns = {"load": gravity_regressor(gravity), **drift}
        design = np.concatenate(list(columns.values()), axis=2)
        check_excitation(with_offsets(design), LOAD_PARAMETERS[:4])
        fit = Problem.untimed(design, phases.mean).robust()
        check_excitation(with_offsets(design)[fit.used], LOAD_PARAMETERS[:4])
    except NotExcitedError as error:
        why_no_load = str(error)
    except IdentificationError as error:
        why_no_load = f"the rest segments agree on nothing: {error}"
    if why_no_load:
        columns = drift
        design = np.concatenate([np.zeros((len(phases), 6, 0)), *drift.values()], axis=2)
        try:
            fit = Problem.untimed(design, phases.mean).robust()
        except IdentificationError:
            return None
    columns["offset"] = np.broadcast_to(np.eye(6), (len(phases), 6, 6))
    return _parts(fit, columns, why_no_load, why_no_drift)


def _gravity(phases: StillPhases, tool: CalibrationFile) -> Array:
    """Gravity (n, 3) in the sensor's frame, m/s^2, as large as the tool's file has it."""
    size = np.linalg.norm(tool.gravity_m_s2) / np.linalg.norm(tool.arm.gravity_m_s2)
    return np.asarray(tool.arm.gravity_in_sensor(phases.angles) * size)


def _parts(
    fit: Fit, columns: dict[str, Array], why_no_load: str, why_no_drift: str
) -> ResidualParts:
    parts, values, stds, significant = {}, {}, {}, set()
    at = 0
    for name, design in columns.items():
        places = slice(at, at + design.shape[2])
        at = places.stop
        values[name] = fit.values[places]
        covariance = fit.covariance[places, places]
        stds[name] = np.sqrt(np.diag(covariance))
        parts[name] = rms(design[fit.used] @ values[name])
        distance = values[name] @ np.linalg.pinv(covariance, hermitian=True) @ values[name]
        if chi2_sf(distance, design.shape[2]) < _SIGNIFICANT:
            significant.add(name)
    parts["rest"] = rms(fit.residuals[fit.used])
    return ResidualParts(
        parts, values, stds, fit.used, why_no_load, why_no_drift, frozenset(significant)
    )


@dataclass(frozen=True)
class LoadChange:
    """A change between two rest segments: `time_ns` is between them.

    first_after: the first segment after it. mass_kg: what the mass differs from the file's, before
    and after; None where one load explains both sides and only the reading's offset changed, by
    offset_step (6,), N and N.m.
    """

    time_ns: int
    first_after: int
    mass_kg: tuple[float, float] | None
    offset_step: Array


def find_change(phases: StillPhases, tool: CalibrationFile, limits: Limits) -> LoadChange | None:
    """Find where the recording falls in two: a tool was put on, or the sensor zeroed.

    Each border with at least six segments on either side is tried, with a load and an offset of its
    own on either side (least squares, the channels weighted by their limits). The best one counts
    if the root mean square left is then less than a fifth of what one load and offset leave, and
    that is beyond the limits. If offsets of its own with one load for both sides do as well, it is
    the offset that changed.

    Args:
        phases: n rest segments, with the compensated wrench's means.
        tool: the calibration file that compensated them.
        limits: what a file that fits may be off by.

    Returns:
        The change; None where there is none, or segments are too few.

    """
    if len(phases) < 2 * _FEWEST_A_SIDE:
        return None
    loads = gravity_regressor(_gravity(phases, tool)) / limits.axes[None, :, None]
    offsets = np.broadcast_to(np.diag(1.0 / limits.axes), (len(phases), 6, 6))
    values = phases.mean / limits.axes
    # kg and kg.m beside N and N.m: balance
    scale = np.array([10.0] + [100.0] * 3 + [1.0] * 6)
    rows = np.concatenate([loads, offsets], axis=2) / scale
    blocks = Information.of_blocks(zip(rows, values, strict=True))
    before = Information(*(np.cumsum(part, axis=0) for part in blocks))
    whole = blocks.total()

    def cost(side: Information) -> tuple[float, Array]:
        # The pseudo-inverse: a side's poses need not identify all of its load.
        solution = np.linalg.pinv(side.matrix, rcond=1e-9, hermitian=True) @ side.right
        return max(float(side.rest - side.right @ solution), 0.0), solution / scale

    together, _ = cost(whole)
    if together <= len(phases):
        return None
    best: tuple[float, int, Array, Array] | None = None
    for k in range(_FEWEST_A_SIDE, len(phases) - _FEWEST_A_SIDE + 1):
        first_side = before.part(k - 1)
        left_before, first = cost(first_side)
        left_after, second = cost(
            Information(*(all_of - part for all_of, part in zip(whole, first_side, strict=True)))
        )
        if best is None or left_before + left_after < best[0]:
            best = (left_before + left_after, k, first, second)
    assert best is not None
    least, k, first, second = best
    if least * _CHANGE**2 > together:
        return None
    time_ns = (int(phases.end_ns[k - 1]) + int(phases.start_ns[k])) // 2
    later = np.arange(len(phases)) >= k
    stepped = np.concatenate([rows, later[:, None, None] * offsets], axis=2)
    solution, _, rest = least_squares(stepped, values)
    left = float(np.sum(rest**2))
    if left * _CHANGE**2 <= together:
        return LoadChange(time_ns, k, None, solution[-6:])
    return LoadChange(time_ns, k, (float(first[0]), float(second[0])), second[4:] - first[4:])


def rms(values: Array) -> Array:
    """Return the root mean square of rows.

    Args:
        values: (n, 6), N and N.m.

    Returns:
        (6,); NaN where there are no rows.

    """
    return np.asarray(np.sqrt(np.mean(values**2, axis=0))) if len(values) else np.full(6, np.nan)


# Verdict


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
    """Judge whether the file fits.

    Without a rest segment a small residual in motion is a fit as well; a large one may be inertial
    forces.

    Args:
        phases: rest segments, with the compensated wrench's means.
        parts: of their residual; None: too few segments. With a change, each side is decomposed
            here.
        change: where the recording falls in two; None: nowhere.
        tool: the calibration file that is judged.
        limits: what a file that fits may be off by.
        moving: (6,) RMSE of the cells' means in motion, N and N.m; NaN without motion.
        start_ns: stamp that the sentence counts time from.
        stamps_jump: the segments' times are not reliable.

    Returns:
        The verdict.

    """
    if not len(phases):
        return _judge_motion(limits, moving)
    if change is None:
        return _judge_rest(phases, parts, tool, limits)
    sides = (slice(change.first_after), slice(change.first_after, None))
    before, after = (
        _judge_rest(side, decompose(side, tool, stamps_jump=stamps_jump), tool, limits).text
        for side in (phases.part(rows) for rows in sides)
    )
    time_s = (change.time_ns - start_ns) * 1e-9
    what = "the load changes"
    if change.mass_kg is None:
        axis, _, size = _worst(np.abs(change.offset_step), limits)
        sign = "-" if change.offset_step[axis] < 0.0 else "+"
        what = f"the reading's offset jumps by {sign}{size}"
    return Verdict(Cause.CHANGED, f"{what} at {time_s:.1f} s. Before: {before}. After: {after}")


def _judge_motion(limits: Limits, moving: Array) -> Verdict:
    none = "no rest segment in it"
    if not np.all(np.isfinite(moving)):
        return Verdict(Cause.UNKNOWN, f"{none}: nothing can be said of the file's fit")
    _, ratio, size = _worst(moving, limits)
    if ratio <= 1.0:
        return Verdict(Cause.FITS, f"the file fits in motion, to {size}; {none}")
    text = f"the residual in motion is {size}, which may be inertial forces; {none}"
    return Verdict(Cause.UNKNOWN, text)


def _judge_rest(
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
    axis, ratio, size = _worst(total, limits)
    notes = ""
    # One that is out by its noise alone, but within the limits, needs no note.
    size_of_each = np.max(np.abs(phases.mean) / limits.axes, axis=1)
    outside = int(np.count_nonzero(~parts.used & (size_of_each > _WORTH_SAYING)))
    if outside:
        plural = "an outlier" if outside == 1 else "outliers"
        notes = f"; {outside} of {len(phases)} rest segments: {plural} (contact? see the worst)"
    cause = _reason(parts, axis, float(total[axis]), ratio, limits)
    why = _in_words(cause, parts, axis, tool, _unexplained(phases, parts, limits), limits)
    if ratio <= 1.0:
        if cause is not Cause.UNEXPLAINED and ratio > _WORTH_SAYING:
            notes = f", most of it {why}{notes}"
        return Verdict(Cause.FITS, f"the file fits, to {size}{notes}")
    return Verdict(cause, f"the residual is {size}: {why}{notes}")


def _reason(parts: ResidualParts, axis: int, total: float, ratio: float, limits: Limits) -> Cause:
    sizes = {
        cause: float(parts.rms[cause.word][axis])
        for cause in (Cause.OFFSET, Cause.DRIFT, Cause.LOAD)
        if cause.word in parts.significant
    }
    rest = _worst(parts.rms["rest"], limits)[1]
    beyond = rest > 1.0 and rest * _WORTH_BEYOND > ratio
    # A drift that began at zero has a mean 1.7 times as large as what it scatters by.
    if 2.0 * sizes.get(Cause.DRIFT, 0.0) > sizes.get(Cause.OFFSET, 0.0):
        sizes.pop(Cause.OFFSET, None)
    if not sizes or parts.rms["rest"][axis] * _WORTH > total or beyond:
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
    if cause is Cause.UNEXPLAINED:
        rest = _worst(parts.rms["rest"], limits)[2]
        return f"load, offset and drift leave {rest} unexplained ({_OTHERS})"
    hint = ""
    may_be = ["another load"] * bool(parts.why_no_load)
    if cause is Cause.LOAD:
        may_be = []
        text, hint = _load_in_words(parts, tool)
    elif cause is Cause.OFFSET:
        text = "a constant offset"
        may_be += ["drift"] * bool(parts.why_no_drift)
        if not may_be:
            hint = ", which a tare subtracts"
    else:
        unit, scale = ("N/h", 1.0) if axis < 3 else ("mN.m/h", 1e3)
        text = f"drift of the sensor, here by {parts.values['drift'][axis] * scale:+.3g} {unit}"
    if may_be:
        text += f" (or {' or '.join(may_be)}, not distinguishable by these rest segments)"
    # What fixes one part alone is no advice where another is left.
    besides = f"; besides, {unexplained} stays unexplained ({_OTHERS})"
    return text + (besides if unexplained else hint)


def _load_in_words(parts: ResidualParts, tool: CalibrationFile) -> tuple[str, str]:
    more, std = parts.values["load"], parts.stds["load"]
    mass = tool.load.mass_kg + more[0]
    sure = _SURE * std[0]
    text = f"as of another load, by {1e3 * more[0]:+.1f} +- {1e3 * std[0]:.1f} g"
    if mass + tool.adapter.mass_kg < -sure:
        return text, ", less than nothing (are the signs or axes of the readings others?)"
    if mass < max(sure, _NO_LOAD * tool.load.mass_kg):
        return text, " (no tool on it?)"
    moved = (tool.load.mass_kg * tool.load.com_m + more[1:]) / mass - tool.load.com_m
    # h / m: the mass's uncertainty moves the centre as well.
    moved_std = np.max(np.hypot(std[1:], tool.load.com_m * std[0])) / mass
    centre = ", ".join(f"{1e3 * value:+.1f}" for value in moved)
    return (
        f"{text}, its centre by ({centre}) +- {1e3 * moved_std:.1f} mm",
        " (recalibrate; or another tool?)",
    )


def _unexplained(phases: StillPhases, parts: ResidualParts, limits: Limits) -> str:
    noise = np.sqrt(np.mean(phases.std_of_mean**2, axis=0))
    rest = np.where(parts.rms["rest"] > _ABOVE_NOISE * noise, parts.rms["rest"], 0.0)
    _, ratio, size = _worst(rest, limits)
    return size if ratio > _WORTH_SAYING else ""


def _worst(values: Array, limits: Limits) -> tuple[int, float, str]:
    axis = int(np.argmax(values / limits.axes))
    return axis, limits.size(values), limits.worst(values)
