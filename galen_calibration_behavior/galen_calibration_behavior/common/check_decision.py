# SPDX-License-Identifier: Apache-2.0
"""Does the tool's file still fit? Decided from the mean readings at a few still poses. No ROS.

With u_k gravity in ft_sensor at pose k, the reading there less the file's expected one is

    r_k = G(u_k) d + b + e_k,

d (4,) what the load's moments (mass, first moment) differ from the file's
(`galen_model.load.model`), b (6,) an offset, as a sensor zeroed anew or drifted leaves it.
Expected without any change:

    Cov e_k = S, the same at all poses: by axis the largest of the file's rmse^2, of the variance of
              the mean by the samples' scatter, and of that by the averages' two halves, which sees
              coloured noise as well; and with a learned cable what isn't known of its pull there;
    Cov d   = C, the calibration's: that of the tool's (m, h), by the file's of (m, p) with h = m p;
    Cov b   = O = rmse^2 / poses_used, the calibration's offset's.

Least squares weighted by S^-1 gives (d, b) with the covariance (X^T S^-1 X)^-1 + diag(C, O),
X = [G, I]: C and O act within X's columns, and so neither change the estimate nor the rest. Tests:

    the rest of 6 n - 10 degrees   sum_k rest_k^T S^-1 rest_k         chi^2(6 n - 10)
    another load                   d^T (Cov d)^-1 d                   chi^2(4)
    an offset alone, d = 0         b^T (S / n + O + G_m C G_m^T)^-1 b chi^2(6), b and G_m the means

What a difference matters is another question: how far would a compensation by this file be off,
at worst, anywhere in the range of its angles? Only what is beyond a limit there and can't
be noise is called a change. Where noise alone could be beyond a limit, nothing can be told.
Two poses tell (d, b) at best; the more there are beyond, the more is told of what is neither.

A cause (`galen_model.calibrated.columns`) explains the rest if, fitted beside load and offset, it
leaves only noise; what all three then make of a compensation decides whether it matters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded when they are used
from galen_model.arrays import Array
from galen_model.calibrated import columns
from galen_model.calibrated.columns import moment_covariance
from galen_model.distributions import chi2_isf, chi2_sf, noncentral_chi2_sf, normal_ppf
from galen_model.estimation.evidence import chance
from galen_model.estimation.least_squares import least_squares
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import gravity_regressor, gravity_wrench
from galen_model.load.mounting import Mounting
from galen_model.load.readings import single_load_design
from galen_model.load.verdict import (
    MESSAGES,
    Cause,
    CheckAnswer,
    Limits,
    load_text,
    wrench_text,
)
from galen_model.poses.design import workspace
from galen_model.rest.segments import PoseRecord

from galen_calibration_behavior.common.sweep import stack


@dataclass(frozen=True)
class CheckLimits(Limits):
    """What a compensation may be off by, anywhere, and how often chance may call a change."""

    false_alarm: float = 0.05


@dataclass(frozen=True)
class Differences:
    """Load and offset that the readings at still poses differ by, all in ft_sensor, SI.

    moments (4,): mass and first moment, true less file's, with covariance (4, 4); offset (6,), its
    std (6,): beside another load where that is significant, else without; rest (n, 6): what neither
    explains; sigma (6,): noise of one pose's mean. rest_p, load_p, offset_p: how often chance alone
    does as much. load_effect, effect (6,): by how much a compensation is off at worst, by the load
    and by all; effect_std (6,): its largest standard deviation.
    """

    moments: Array
    moments_covariance: Array
    offset: Array
    offset_std: Array
    rest: Array
    sigma: Array
    rest_p: float
    load_p: float
    offset_p: float
    load_effect: Array
    effect: Array
    effect_std: Array


@dataclass(frozen=True)
class QuickCheck:
    """What the readings differ by, and in words.

    found_mass_kg, found_offset (6,): the smallest changes that are found beyond noise with 95 %.
    """

    cause: Cause
    text: str
    found: Differences
    poses: int
    found_mass_kg: float
    found_offset: Array

    @property
    def answer(self) -> CheckAnswer:
        """What to do."""
        return self.cause.answer


@dataclass(frozen=True)
class Explanation:
    """A cause beside load and offset: by how much a compensation is off at worst, (6,) each.

    effect: by all three; load_effect: by the load that is then left.
    """

    name: str
    effect: Array
    load_effect: Array


def explain_rest(
    angles: Array,
    residual: Array,
    sigma: Array,
    tool: CalibrationFile,
    anywhere: Array,
    p_noise: float,
) -> tuple[Explanation, ...]:
    """Find the causes that leave only noise of the residual.

    Args:
        angles: (n, k) of the turning joints, rad.
        residual: (n, 6) reading less the file's, N and N.m in ft_sensor.
        sigma: (6,) noise of one pose's mean.
        tool: the file that is checked.
        anywhere: angles (w, k), rad, over the arm's range, for the effect on a compensation.
        p_noise: what is likelier than this by chance counts as noise.

    Returns:
        The causes, the best first; none where nothing explains it.

    """
    count = len(residual)
    found = []
    here, there = _causes(angles, tool), _causes(anywhere, tool)
    for name in here:
        rows = np.concatenate([load_and_offset(angles, tool), here[name]], axis=2)
        values, _, rest = least_squares(rows, residual, sigma)
        p_value = float(chi2_sf(np.sum((rest / sigma) ** 2), 6 * count - rows.shape[2]))
        if p_value > p_noise:
            known = load_and_offset(anywhere, tool)
            by_all = known @ values[:10] + there[name] @ values[10:]
            explanation = Explanation(
                name,
                np.max(np.abs(by_all), axis=0),
                np.max(np.abs(known[:, :, :4] @ values[:4]), axis=0),
            )
            found.append((p_value, explanation))
    return tuple(explanation for _, explanation in sorted(found, key=lambda one: -one[0]))


def load_and_offset(angles: Array, tool: CalibrationFile) -> Array:
    """Return the columns [G, I] of another load and an offset.

    Args:
        angles: (n, k) of the turning joints, rad.
        tool: the file, whose gravity is taken.

    Returns:
        (n, 6, 10), in ft_sensor, SI: mass, first moment (3), offset (6).

    """
    return single_load_design(tool.gravity_in_sensor(angles))


def zero_lost(offset: Array, tool: CalibrationFile, limit: Array) -> str:
    """Describe how the sensor's zero went, if an offset is just as that would leave it.

    What the zeroing took for nothing is Z = W(zeroing; adapter) - offset, the file's own offset
    included: none if there was no zeroing, the adapter's wrench under another direction of gravity
    if it was elsewhere, that of tool and adapter if the tool was on.

    Args:
        offset: (6,) beside the file's, N and N.m in ft_sensor.
        tool: the file that is checked.
        limit: (6,) how near, N and N.m; an offset within twice of it is none.

    Returns:
        The end of a sentence; empty where no such zero explains the offset.

    """
    if np.all(np.abs(offset) <= 2.0 * limit):
        return ""
    at_zero = tool.gravity_at_zeroing
    zero = gravity_wrench(at_zero, tool.adapter.load) - tool.residual_offset - offset
    if np.all(np.abs(zero) <= limit):
        return "it was not zeroed since it was switched on"
    adapter, own = tool.adapter.load.moments, tool.load.load.moments
    gravity = zero[:3] / np.linalg.norm(zero[:3]) * np.linalg.norm(tool.gravity_m_s2)
    for moments, how in (
        (adapter + own, "it was zeroed with the tool on"),
        (adapter, "it was zeroed in another pose than the file's"),
    ):
        if np.all(np.abs(gravity_regressor(gravity) @ moments - zero) <= limit):
            return how
    return ""


def _causes(angles: Array, tool: CalibrationFile) -> dict[str, Array]:
    """Columns (n, 6, k) of each cause, by its name."""
    gravity = tool.gravity_in_sensor(angles)
    return {
        "a loose tool": columns.loose_tool(gravity, tool.load.mass_kg),
        "a joint's zero that has moved": columns.joint_zeros(angles, tool),
        "a sensor that has turned in its mount": columns.turned_sensor(gravity, tool),
        "a cable that pulls": columns.constant_pull(angles, tool),
    }


FEWEST_POSES = 4
# Standard deviations after the default grid, over those after as many ideal poses.
_GRID_INFLATION = 4.0
_STEPS = 13
# What no load and no offset explains is the cause, not a remark, where it is so unlikely ...
_UNEXPLAINED = 1e-3
# ... and so large a part of the load that would be significant besides (as in
# `galen_gravcomp.evaluate.residual`).
_WORTH = 4.0


def quick_check(
    records: Sequence[PoseRecord],
    tool: CalibrationFile,
    limits: CheckLimits,
    *,
    others: Mapping[str, CalibrationFile] | None = None,
    known_offset: Array | None = None,
) -> QuickCheck:
    """Decide whether a tool's file still fits.

    Args:
        records: mean readings at FEWEST_POSES still poses or more.
        tool: the file that is checked.
        limits: what a compensation may be off by, and the rate of false alarms.
        others: files of other tools by name, which the load is compared with.
        known_offset: (6,) what a tare already subtracts, N and N.m; None: nothing.

    Returns:
        The cause, in words too, with what was found and the smallest changes that would be.

    """
    taken_off = np.zeros(6) if known_offset is None else known_offset
    found = differences(records, tool, limits, taken_off)
    explained: tuple[Explanation, ...] = ()
    if found.rest_p < _UNEXPLAINED:
        angles, residual, sigma = _readings(records, tool, taken_off)
        anywhere = workspace(_STEPS, tool.arm)
        explained = explain_rest(angles, residual, sigma, tool, anywhere, _UNEXPLAINED)
    hints = tuple(one.name for one in explained)
    cause = _decide(found, limits, explained)
    if cause is Cause.UNEXPLAINED:
        stands_out = _one_that_stands_out(records, tool, limits, taken_off)
        if stands_out is not None:
            cause, hints = Cause.CONTACT, (stands_out,)
    elif cause is Cause.LOAD:
        cause, hints = _which_load(found, tool, limits, others or {})
    # The sensor's zero knows nothing of a tare.
    elif cause is Cause.OFFSET and (how := zero_lost(found.offset + taken_off, tool, limits.axes)):
        cause, hints = Cause.ZERO_LOST, (how,)
    information = _load_information(records, tool, found.sigma)
    return QuickCheck(
        cause=cause,
        text=in_words(cause, found, tool, limits, hints, len(records)),
        found=found,
        poses=len(records),
        found_mass_kg=smallest_mass_kg(information, tool, limits.false_alarm),
        found_offset=_noncentrality(6, limits.false_alarm) ** 0.5 * found.offset_std,
    )


def differences(
    records: Sequence[PoseRecord], tool: CalibrationFile, limits: CheckLimits, known_offset: Array
) -> Differences:
    """Estimate what the readings differ by, with the tests of the module's text.

    Args:
        records: mean readings at still poses.
        tool: the file that is checked.
        limits: the rate of false alarms makes a load significant.
        known_offset: (6,) what a tare already subtracts, N and N.m.

    Returns:
        Load, offset and rest, with their tests and their effect on a compensation.

    """
    angles, residual, sigma = _readings(records, tool, known_offset)
    count = len(residual)
    rows = load_and_offset(angles, tool)
    values, fit_covariance, rest = least_squares(rows, residual, sigma)
    by_file = _file_covariance(tool)
    covariance = fit_covariance[:4, :4] + by_file[:4, :4]
    moments = values[:4]
    load_p = chance(moments, covariance)

    mean_rows = rows[:, :, :4].mean(axis=0)
    alone = residual.mean(axis=0)
    alone_covariance = (
        np.diag(sigma**2) / count + by_file[4:, 4:] + mean_rows @ by_file[:4, :4] @ mean_rows.T
    )
    significant = load_p < limits.false_alarm
    everywhere = load_and_offset(workspace(_STEPS, tool.arm), tool)
    both = fit_covariance + by_file
    variance = np.sum((everywhere @ both) * everywhere, axis=2)
    return Differences(
        moments=moments,
        moments_covariance=covariance,
        offset=values[4:] if significant else alone,
        offset_std=np.sqrt(np.diag(both)[4:] if significant else np.diag(alone_covariance)),
        rest=rest,
        sigma=sigma,
        rest_p=float(chi2_sf(np.sum((rest / sigma) ** 2), 6 * count - 10)),
        load_p=load_p,
        offset_p=chance(alone, alone_covariance),
        load_effect=np.max(np.abs(everywhere[:, :, :4] @ moments), axis=0),
        effect=np.max(np.abs(everywhere @ values), axis=0) if significant else np.abs(alone),
        effect_std=np.sqrt(np.max(variance, axis=0)),
    )


def smallest_mass_kg(load_information: Array, tool: CalibrationFile, false_alarm: float) -> float:
    """Find the least mass that, put on at the tool's own centre, is found beyond noise with 95 %.

    By the test's noncentrality m^2 (1, p)^T (Cov d)^-1 (1, p); p = 0 where the tool has no mass of
    its own.

    Args:
        load_information: (Cov d)^-1 (4, 4) of mass and first moment, SI.
        tool: the file, with the centre p.
        false_alarm: the test's level.

    Returns:
        Mass, kg.

    """
    direction = np.array([1.0, *tool.load.com_m])
    size = direction @ load_information @ direction
    return float(np.sqrt(_noncentrality(4, false_alarm) / size))


def _noncentrality(freedom: int, false_alarm: float, power: float = 0.95) -> float:
    threshold = chi2_isf(false_alarm, freedom)
    return float(
        scipy.optimize.brentq(
            lambda size: noncentral_chi2_sf(threshold, freedom, size) - power, 1e-3, 1e3
        )
    )


def _decide(found: Differences, limits: CheckLimits, explained: tuple[Explanation, ...]) -> Cause:
    # The fit takes ten values, and so freedom of the rest's mean square, in six axes.
    rest = np.sqrt(np.sum(found.rest**2, axis=0) / (len(found.rest) - 10.0 / 6.0))
    load_size = limits.size(found.load_effect)
    load_significant = found.load_p < limits.false_alarm and load_size > 1.0
    if found.rest_p < _UNEXPLAINED:
        by_cause = [limits.size(one.effect) for one in explained[:1]]
        no_load_then = any(limits.size(one.load_effect) <= 1.0 for one in explained[:1])
        instead = no_load_then or _WORTH * limits.size(rest) > load_size
        if max([limits.size(rest), *by_cause]) > 1.0 and (not load_significant or instead):
            return Cause.UNEXPLAINED
    if load_significant:
        return Cause.LOAD
    if limits.size(found.effect) > 1.0 and found.offset_p < limits.false_alarm:
        return Cause.OFFSET
    two_sided = normal_ppf(1.0 - limits.false_alarm / 2.0)
    if np.any(two_sided * found.effect_std > limits.axes):
        return Cause.NOISE
    return Cause.FITS


def _which_load(
    found: Differences,
    tool: CalibrationFile,
    limits: CheckLimits,
    others: Mapping[str, CalibrationFile],
) -> tuple[Cause, tuple[str, ...]]:
    """Another tool whose file fits within the limits, or no tool at all."""
    everywhere = load_and_offset(workspace(_STEPS, tool.arm), tool)[:, :, :4]
    own = tool.load.load.moments

    def fits(moments: Array) -> bool:
        off = np.max(np.abs(everywhere @ (own + found.moments - moments)), axis=0)
        spread = normal_ppf(1.0 - limits.false_alarm / 2.0) * found.effect_std
        return bool(np.all(off <= limits.axes + spread))

    if fits(np.zeros(4)):
        return Cause.NO_TOOL, ()
    same = [name for name, other in sorted(others.items()) if fits(other.load.load.moments)]
    return (Cause.OTHER_TOOL, tuple(same)) if same else (Cause.LOAD, ())


def _one_that_stands_out(
    records: Sequence[PoseRecord], tool: CalibrationFile, limits: CheckLimits, known_offset: Array
) -> str | None:
    """Name the pose without which the rest is noise: a likely contact."""
    if len(records) <= FEWEST_POSES:
        return None
    p_values = []
    for k in range(len(records)):
        others = [*records[:k], *records[k + 1 :]]
        p_values.append(differences(others, tool, limits, known_offset).rest_p)
    best = int(np.argmax(p_values))
    if p_values[best] < limits.false_alarm:
        return None
    angles = zip(tool.arm.turning_names, tool.arm.angles(records[best].joints), strict=True)
    return f"that at {', '.join(f'{name} {angle:.2f}' for name, angle in angles)} rad"


def _readings(
    records: Sequence[PoseRecord], tool: CalibrationFile, known_offset: Array
) -> tuple[Array, Array, Array]:
    """Angles (n, k), rad, residual (n, 6) in ft_sensor, a mean's noise sigma (6,)."""
    angles, wrench, std_of_mean = stack(list(records), tool.arm)
    expected = tool.predict(angles)
    unknown = np.zeros(6)
    if tool.cable is not None:
        joints = np.array([record.joints for record in records])
        pull = tool.cable.posterior
        expected = expected + pull.readings(joints)
        unknown = np.mean([np.diag(pull.covariance(q)) for q in joints], axis=0)
    to_wrench = (tool.mounting or Mounting.of(tool.arm)).wrench_from_reading
    residual = (wrench - expected) @ to_wrench.T - known_offset
    halves = np.array([record.half_difference for record in records]) / 2.0
    seen = np.maximum(np.mean(std_of_mean**2, axis=0), np.mean(halves**2, axis=0))
    sigma = np.sqrt(np.maximum(tool.rmse**2, seen) + unknown)
    return angles, residual, sigma


def _file_covariance(tool: CalibrationFile) -> Array:
    """Of the load's moments and the offset (10, 10), as the calibration knows them.

    The tool's own covariance bounds that of tool and adapter together, which the readings show:
    two sweeps of the same poses tell the sum twice as well as the tool. One sweep that could not
    take the two apart tells the sum all the same; its own covariance says nothing of it, and that
    of as many ideal poses (`galen_model.load.identifiability`), inflated as by the default grid,
    stands in.
    """
    whole = np.diag(np.concatenate([np.zeros(4), tool.rmse**2 / tool.poses_used]))
    if tool.unresolved:
        gravity = float(np.linalg.norm(tool.gravity_m_s2))
        force, torque = np.max(tool.rmse[:3]), np.max(tool.rmse[3:])
        ideal = np.array([force, *[np.sqrt(1.5) * torque] * 3]) / gravity
        whole[:4, :4] = np.diag(_GRID_INFLATION**2 * ideal**2 / tool.poses_used)
        return whole
    whole[:4, :4] = moment_covariance(tool.load, np.zeros(4))
    return whole


def _load_information(records: Sequence[PoseRecord], tool: CalibrationFile, sigma: Array) -> Array:
    regressor = load_and_offset(stack(list(records), tool.arm)[0], tool)[:, :, :4]
    free = (regressor - regressor.mean(axis=0)) / sigma[:, None]
    rows = free.reshape(-1, 4)
    covariance = np.linalg.inv(rows.T @ rows) + _file_covariance(tool)[:4, :4]
    return np.asarray(np.linalg.inv(covariance))


def in_words(
    cause: Cause,
    found: Differences,
    tool: CalibrationFile,
    limits: CheckLimits,
    hints: tuple[str, ...],
    poses: int,
) -> str:
    """Return the cause in words.

    Args:
        cause: what was decided.
        found: what the readings differ by.
        tool: the file that is checked.
        limits: what a compensation may be off by.
        hints: what the cause was found by: names of other causes or tools, the pose that stands
            out, how the zero was lost; none is needed for an offset, a load and noise.
        poses: number of poses.

    Returns:
        One sentence, without its stop.

    """
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
    """Find by how much the tool's centre moved.

    p = h / m, so that dp = (dh - p dm) / m for its covariance.

    Args:
        found: what the readings differ by.
        tool: the file that is checked.

    Returns:
        Change and its standard deviation, (3,) each, m in ft_sensor; None where the mass is less
        than five of its own.

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
