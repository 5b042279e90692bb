"""What is left over in the still phases, taken apart: load, offset, drift, the rest.

With u_k gravity in the sensor's frame in phase k, the mean residual there is fitted by

    r_k = G(u_k) d + b + c (t_k - t_mean) + rest

d: what the load (mass, first moment) differs from the file's, in which the reading is linear (see
`galen_model.load`); b: an offset, as a sensor zeroed anew or wandered leaves it, which a tare takes
off; c: its drift; robustly, so that a few touched phases don't count (`galen_model.robust_fit`).
Poses that can't tell d from b are refused by the same gate as a calibration's
(`galen_model.excitation`); then only the offset and the drift are fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from galen_model.arm import GRAVITY_M_S2, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.excitation import LOAD_PARAMETERS, check_excitation
from galen_model.kinematics import gravity_in_sensor
from galen_model.load import gravity_regressor
from galen_model.robust_fit import RobustFit, fit_robust
from galen_model.tool_file import ToolFile
from scipy.stats import chi2

from galen_gravcomp.still_cells import StillPhases

_FEWEST_PHASES = 4
# Drift needs phases before and after; with fewer it takes up whatever is left.
_FEWEST_FOR_DRIFT = 8
_SHORTEST_DRIFT_S = 30.0
_SIGNIFICANT = 1e-3
# A part is the reason if leaving it out makes the residual so many times smaller.
_WORTH = 2.0
# In units of the limits: what is worth a word, though the file fits.
_WORTH_SAYING = 0.5
_ABOVE_NOISE = 3.0
_FEWEST_A_SIDE = 6
_CHANGE = 5.0


class Verdict(Enum):
    """Whether the tool's file still fits the recording, and what would mend it."""

    FITS = "fits"
    OFFSET = "offset"
    DRIFT = "drift"
    LOAD = "load"
    CHANGED = "changed"
    UNEXPLAINED = "unexplained"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Limits:
    """Residuals up to which a file fits: each axis' RMSE of the still phases' means."""

    force_n: float = 0.05
    torque_nm: float = 0.002

    @property
    def axes(self) -> Array:
        """By axis (6,), N and N.m."""
        return np.repeat([self.force_n, self.torque_nm], 3)


@dataclass(frozen=True)
class Misfit:
    """What the residual is made of, by root mean square over the phases, (6,) N and N.m each.

    load, offset, drift: the parts; rest: what none of them explains; rate_per_hour and
    rate_std (6,): N/h and N.m/h, None where drift was not asked for. mass_kg, mass_std_kg and
    moment_kgm (3,): true less file's. used (n,): phases that agree with the rest.
    """

    load: Array | None
    offset: Array
    drift: Array | None
    rest: Array
    offset_value: Array
    offset_std: Array
    rate_per_hour: Array | None
    rate_std: Array | None
    mass_kg: float
    mass_std_kg: float
    moment_kgm: Array
    moment_std_kgm: Array
    used: np.ndarray
    why_no_load: str
    significant: frozenset[str]


def take_apart(phases: StillPhases, tool: ToolFile) -> Misfit | None:
    """Take the phases' residuals apart; None when there are too few phases to say anything."""
    if len(phases) < _FEWEST_PHASES:
        return None
    gravity = _gravity(phases, tool)
    time_h = (phases.start_ns + phases.end_ns - 2 * int(phases.start_ns[0])) / 2 / 3.6e12
    centred_h = time_h - time_h.mean()
    blocks = {"offset": np.broadcast_to(np.eye(6), (len(phases), 6, 6))}
    if len(phases) >= _FEWEST_FOR_DRIFT and np.ptp(time_h) * 3600.0 >= _SHORTEST_DRIFT_S:
        blocks["drift"] = centred_h[:, None, None] * np.eye(6)
    why_no_load = ""
    try:
        design = np.concatenate([gravity_regressor(gravity), *blocks.values()], axis=2)
        check_excitation(design, LOAD_PARAMETERS[:4])
        fit = fit_robust(design, phases.mean)
        check_excitation(design[fit.used], LOAD_PARAMETERS[:4])
        blocks = {"load": gravity_regressor(gravity), **blocks}
    except NotExcitedError as error:
        why_no_load = str(error)
    except IdentificationError as error:
        why_no_load = f"the phases agree on nothing: {error}"
    if why_no_load:
        try:
            fit = fit_robust(np.concatenate(list(blocks.values()), axis=2), phases.mean)
        except IdentificationError:
            return None
    return _misfit(fit, blocks, phases, why_no_load)


def _gravity(phases: StillPhases, tool: ToolFile) -> Array:
    """Gravity (n, 3) in the sensor's frame, m/s^2, as large as the tool's file has it."""
    gravity = gravity_in_sensor(phases.angles[:, 0], phases.angles[:, 1])
    return np.asarray(gravity * (tool.gravity_m_s2[2] / GRAVITY_M_S2[2]))


def _misfit(
    fit: RobustFit, blocks: dict[str, Array], phases: StillPhases, why_no_load: str
) -> Misfit:
    parts, values, stds, significant = {}, {}, {}, set()
    at = 0
    for name, design in blocks.items():
        columns = slice(at, at + design.shape[2])
        at = columns.stop
        values[name] = fit.values[columns]
        covariance = fit.covariance[columns, columns]
        stds[name] = np.sqrt(np.diag(covariance))
        parts[name] = _rms(design[fit.used] @ values[name])
        distance = values[name] @ np.linalg.pinv(covariance, hermitian=True) @ values[name]
        if chi2.sf(distance, design.shape[2]) < _SIGNIFICANT:
            significant.add(name)
    load = values.get("load", np.full(4, np.nan))
    load_std = stds.get("load", np.full(4, np.nan))
    return Misfit(
        load=parts.get("load"),
        offset=parts["offset"],
        drift=parts.get("drift"),
        rest=_rms(fit.residuals[fit.used]),
        offset_value=values["offset"],
        offset_std=stds["offset"],
        rate_per_hour=values.get("drift"),
        rate_std=stds.get("drift"),
        mass_kg=float(load[0]),
        mass_std_kg=float(load_std[0]),
        moment_kgm=load[1:],
        moment_std_kgm=load_std[1:],
        used=fit.used,
        why_no_load=why_no_load,
        significant=frozenset(significant),
    )


@dataclass(frozen=True)
class LoadChange:
    """The load changed between two still phases: `time_ns` is between them.

    first_after: the first phase after it; mass_kg: what the mass differs from the file's, before
    and after.
    """

    time_ns: int
    first_after: int
    mass_kg: tuple[float, float]


def find_change(phases: StillPhases, tool: ToolFile, limits: Limits) -> LoadChange | None:
    """Where one load gave way to another, as in a recording in which a tool was put on.

    Each border between two phases is tried, with a load and an offset of its own on either side
    (least squares, the channels weighted by their limits). The best one counts if what is left is
    then less than a fifth of what one load leaves, and that is beyond the limits.
    """
    if len(phases) < 2 * _FEWEST_A_SIDE:
        return None
    gravity = _gravity(phases, tool)
    design = np.concatenate(
        [gravity_regressor(gravity), np.broadcast_to(np.eye(6), (len(phases), 6, 6))], axis=2
    )
    design = design / limits.axes[None, :, None]
    scale = np.array([10.0] + [100.0] * 3 + [1.0] * 6)  # kg and kg.m beside N: balance
    rows = design / scale
    values = phases.mean / limits.axes
    matrices = np.cumsum(np.einsum("nkp,nkq->npq", rows, rows), axis=0)
    rights = np.cumsum(np.einsum("nkp,nk->np", rows, values), axis=0)
    squares = np.cumsum(np.sum(values**2, axis=1))

    def cost(matrix: Array, right: Array, square: float) -> tuple[float, Array]:
        # The pseudo-inverse: a side's poses need not tell all of its load.
        solution = np.linalg.pinv(matrix, rcond=1e-9, hermitian=True) @ right
        return max(float(square - right @ solution), 0.0), solution

    whole, _ = cost(matrices[-1], rights[-1], float(squares[-1]))
    if whole <= len(phases):
        return None
    best: tuple[float, int, float, float] | None = None
    for k in range(_FEWEST_A_SIDE, len(phases) - _FEWEST_A_SIDE + 1):
        before, first = cost(matrices[k - 1], rights[k - 1], float(squares[k - 1]))
        after, second = cost(
            matrices[-1] - matrices[k - 1],
            rights[-1] - rights[k - 1],
            float(squares[-1] - squares[k - 1]),
        )
        if best is None or before + after < best[0]:
            best = (before + after, k, first[0] / scale[0], second[0] / scale[0])
    assert best is not None
    if best[0] * _CHANGE**2 > whole:
        return None
    k = best[1]
    time_ns = (int(phases.end_ns[k - 1]) + int(phases.start_ns[k])) // 2
    return LoadChange(time_ns, k, (best[2], best[3]))


def judge(
    phases: StillPhases,
    misfit: Misfit | None,
    change: LoadChange | None,
    limits: Limits,
    moving: Array,
) -> tuple[Verdict, str]:
    """The verdict and a sentence for a person; `moving` (6,): RMSE of the cells' means in motion.

    Without a still phase a small `moving` is a fit as well; a large one may be forces of motion.
    """
    if not len(phases):
        if not np.all(np.isfinite(moving)):
            return Verdict.UNKNOWN, "no still phase in it: nothing can be said of the file's fit"
        worst, ratio, size = _worst(moving, limits)
        if ratio <= 1.0:
            return Verdict.FITS, f"the file fits in motion, to {size}; no still phase in it"
        return Verdict.UNKNOWN, f"no still phase in it; in motion {size} is left over"
    if change is not None:
        time_s = (change.time_ns - int(phases.start_ns[0])) * 1e-9
        before, after = (1e3 * mass for mass in change.mass_kg)
        return Verdict.CHANGED, (
            f"the load changes {time_s:.1f} s after the first still phase: before, it differs by"
            f" {before:+.1f} g from the file's, then by {after:+.1f} g; evaluate the parts on their"
            " own (--start-offset, --duration)"
        )
    worst, ratio, size = _worst(_rms(phases.mean), limits)
    if misfit is None:
        few = f"{len(phases)} still phases, too few to take it apart"
        if ratio <= 1.0:
            return Verdict.FITS, f"the file fits, to {size}; only {few}"
        return Verdict.UNKNOWN, f"{size} is left over; only {few}"
    worst, ratio, size = _worst(_rms(phases.mean[misfit.used]), limits)
    notes = ""
    unexplained = _unexplained(phases, misfit, limits)
    outside = int(np.count_nonzero(~misfit.used))
    if outside:
        notes = f"; {outside} of {len(phases)} still phases stand out (a hand? see the worst)"
    verdict, why = _reason(misfit, worst)
    if ratio <= 1.0:
        if verdict is not Verdict.UNEXPLAINED and ratio > _WORTH_SAYING:
            notes = f", most of it {why}{notes}"
        return Verdict.FITS, f"the file fits, to {size}{notes}"
    if verdict is not Verdict.UNEXPLAINED and unexplained:
        notes = f"; besides, {unexplained} is left that this does not explain{notes}"
    return verdict, f"{size} is left over: {why}{notes}"


def _worst(values: Array, limits: Limits) -> tuple[int, float, str]:
    """The axis that is largest in units of its limit, how large, and that in words."""
    over = values / limits.axes
    axis = int(np.argmax(over))
    return axis, float(over[axis]), f"{_size(axis, values[axis])} in {WRENCH_AXES[axis]}"


def _unexplained(phases: StillPhases, misfit: Misfit, limits: Limits) -> str:
    """The rest in words where it is well above the noise and near a limit, else empty."""
    noise = np.sqrt(np.mean(phases.std_of_mean**2, axis=0))
    rest = np.where(misfit.rest > _ABOVE_NOISE * noise, misfit.rest, 0.0)
    _, ratio, size = _worst(rest, limits)
    return size if ratio > _WORTH_SAYING else ""


def _reason(misfit: Misfit, axis: int) -> tuple[Verdict, str]:
    parts = {"offset": misfit.offset, "drift": misfit.drift, "load": misfit.load}
    sizes = {
        name: float(part[axis])
        for name, part in parts.items()
        if part is not None and name in misfit.significant
    }
    largest = max(sizes, key=lambda name: sizes[name], default="")
    if not largest or sizes[largest] * _WORTH < misfit.rest[axis]:
        return (
            Verdict.UNEXPLAINED,
            "neither another load nor an offset nor drift explains it (a cable, a loose tool,"
            " wrong angles, a hand?)",
        )
    if largest == "load":
        return (
            Verdict.LOAD,
            f"as of a load that differs by {1e3 * misfit.mass_kg:+.1f} +-"
            f" {1e3 * misfit.mass_std_kg:.1f} g or in its centre (recalibrate; or another tool?)",
        )
    hint = "" if not misfit.why_no_load else " (these poses can't tell it from another load)"
    if largest == "offset":
        return Verdict.OFFSET, f"a constant offset, which a tare takes off{hint}"
    assert misfit.rate_per_hour is not None
    unit = "N/h" if axis < 3 else "mN.m/h"
    rate = misfit.rate_per_hour[axis] * (1.0 if axis < 3 else 1e3)
    return Verdict.DRIFT, f"the sensor drifts, here by {rate:+.3g} {unit}{hint}"


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _size(axis: int, value: float) -> str:
    return f"{value:.3f} N" if axis < 3 else f"{1e3 * value:.2f} mN.m"
