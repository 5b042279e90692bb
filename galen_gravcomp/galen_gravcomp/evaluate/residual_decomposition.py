"""Decompose the residual of the rest segments: load, offset, drift, unexplained; find changes.

With u_k gravity in the sensor's frame in rest segment k, the mean residual there is fitted by

    r_k = G(u_k) d + b + c (t_k - t_mean) + rest

d: what the load (mass, first moment) differs from the file's, in which the reading is linear (see
`galen_model.load.model`); b: an offset, as a sensor zeroed anew or drifted leaves it, which a
tare subtracts; c: its drift; robustly, so that a few segments with contact don't count
(`galen_model.load.robust_fit`). Poses that don't distinguish d from b are rejected by the gate of
a calibration (`galen_model.load.identifiability`); then only the offset and the drift are fitted. The
standard deviations come from the rest's scatter from phase to phase, so a sensor's coloured noise
is in them, but not a bias drift over many phases, which offset and drift follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.arrays import Array
from galen_model.distributions import chi2_sf
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.evidence.verdict import Limits
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.identifiability import LOAD_PARAMETERS, check_excitation
from galen_model.load.model import gravity_regressor
from galen_model.load.robust_fit import RobustFit, fit_robust
from galen_model.rest.binned import StillPhases

_FEWEST_PHASES = 4
# Drift needs phases before and after; with fewer it takes up whatever is left.
_FEWEST_FOR_DRIFT = 8
_SHORTEST_DRIFT_S = 30.0
_SIGNIFICANT = 1e-3
_FEWEST_A_SIDE = 6
_CHANGE = 5.0


@dataclass(frozen=True)
class ResidualParts:
    """Parts of the residual, root mean square over the rest segments, (6,) N and N.m each.

    load, offset, drift: the parts; rest: what none of them explains; rate_per_hour and
    rate_std (6,): N/h and N.m/h, None where drift was not asked for. mass_kg, mass_std_kg and
    moment_kgm (3,): true less file's. used (n,): phases that agree with the rest. significant:
    the parts that noise does not make; why_no_load, why_no_drift: why they were not asked for.
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
    why_no_drift: str
    significant: frozenset[str]


def decompose(
    phases: StillPhases, tool: CalibrationFile, *, stamps_jump: bool = False
) -> ResidualParts | None:
    """Decompose the segments' residuals; None where they are too few.

    `stamps_jump`: their times are not reliable, and drift is not identifiable.
    """
    if len(phases) < _FEWEST_PHASES:
        return None
    gravity = phase_gravity(phases, tool)
    time_h = (phases.start_ns + phases.end_ns - 2 * int(phases.start_ns[0])) / 2 / 3.6e12
    centred_h = time_h - time_h.mean()
    blocks = {"offset": np.broadcast_to(np.eye(6), (len(phases), 6, 6))}
    why_no_drift = ""
    if stamps_jump:
        why_no_drift = "the time stamps jump"
    elif len(phases) < _FEWEST_FOR_DRIFT:
        why_no_drift = f"{len(phases)} rest segments are too few"
    elif np.ptp(time_h) * 3600.0 < _SHORTEST_DRIFT_S:
        why_no_drift = f"the rest segments span less than {_SHORTEST_DRIFT_S:.0f} s"
    else:
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
        why_no_load = f"the rest segments agree on nothing: {error}"
    if why_no_load:
        try:
            fit = fit_robust(np.concatenate(list(blocks.values()), axis=2), phases.mean)
        except IdentificationError:
            return None
    return _parts(fit, blocks, phases, why_no_load, why_no_drift)


def phase_gravity(phases: StillPhases, tool: CalibrationFile) -> Array:
    """Gravity (n, 3) in the sensor's frame, m/s^2, as large as the tool's file has it."""
    gravity = GALEN.gravity_in_sensor(phases.angles)
    return np.asarray(gravity * (tool.gravity_m_s2[2] / GRAVITY_M_S2[2]))


def _parts(
    fit: RobustFit,
    blocks: dict[str, Array],
    phases: StillPhases,
    why_no_load: str,
    why_no_drift: str,
) -> ResidualParts:
    parts, values, stds, significant = {}, {}, {}, set()
    at = 0
    for name, design in blocks.items():
        columns = slice(at, at + design.shape[2])
        at = columns.stop
        values[name] = fit.values[columns]
        covariance = fit.covariance[columns, columns]
        stds[name] = np.sqrt(np.diag(covariance))
        parts[name] = rms(design[fit.used] @ values[name])
        distance = values[name] @ np.linalg.pinv(covariance, hermitian=True) @ values[name]
        if chi2_sf(distance, design.shape[2]) < _SIGNIFICANT:
            significant.add(name)
    load = values.get("load", np.full(4, np.nan))
    load_std = stds.get("load", np.full(4, np.nan))
    return ResidualParts(
        load=parts.get("load"),
        offset=parts["offset"],
        drift=parts.get("drift"),
        rest=rms(fit.residuals[fit.used]),
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
        why_no_drift=why_no_drift,
        significant=frozenset(significant),
    )


@dataclass(frozen=True)
class LoadChange:
    """A change between two rest segments: `time_ns` is between them.

    first_after: the first phase after it. mass_kg: what the mass differs from the file's, before
    and after; None where one load explains both sides and only the reading's offset changed, by
    offset_step (6,), N and N.m.
    """

    time_ns: int
    first_after: int
    mass_kg: tuple[float, float] | None
    offset_step: Array


def find_change(phases: StillPhases, tool: CalibrationFile, limits: Limits) -> LoadChange | None:
    """Find where the recording falls in two: a tool was put on, or the sensor zeroed.

    Each border between two phases is tried, with a load and an offset of its own on either side
    (least squares, the channels weighted by their limits). The best one counts if the root mean
    square left is then less than a fifth of what one load and offset leave, and that is beyond
    the limits. If offsets of its own with one load for both sides do as well, it is the offset
    that changed.
    """
    if len(phases) < 2 * _FEWEST_A_SIDE:
        return None
    loads = gravity_regressor(phase_gravity(phases, tool)) / limits.axes[None, :, None]
    offsets = np.broadcast_to(np.diag(1.0 / limits.axes), (len(phases), 6, 6))
    values = phases.mean / limits.axes
    # kg and kg.m beside N and N.m: balance
    scale = np.array([10.0] + [100.0] * 3 + [1.0] * 6)
    rows = np.concatenate([loads, offsets], axis=2) / scale
    matrices = np.cumsum(np.einsum("nkp,nkq->npq", rows, rows), axis=0)
    rights = np.cumsum(np.einsum("nkp,nk->np", rows, values), axis=0)
    squares = np.cumsum(np.sum(values**2, axis=1))

    def cost(matrix: Array, right: Array, square: float) -> tuple[float, Array]:
        # The pseudo-inverse: a side's poses need not tell all of its load.
        solution = np.linalg.pinv(matrix, rcond=1e-9, hermitian=True) @ right
        return max(float(square - right @ solution), 0.0), solution / scale

    whole, _ = cost(matrices[-1], rights[-1], float(squares[-1]))
    if whole <= len(phases):
        return None
    best: tuple[float, int, Array, Array] | None = None
    for k in range(_FEWEST_A_SIDE, len(phases) - _FEWEST_A_SIDE + 1):
        before, first = cost(matrices[k - 1], rights[k - 1], float(squares[k - 1]))
        after, second = cost(
            matrices[-1] - matrices[k - 1],
            rights[-1] - rights[k - 1],
            float(squares[-1] - squares[k - 1]),
        )
        if best is None or before + after < best[0]:
            best = (before + after, k, first, second)
    assert best is not None
    least, k, first, second = best
    if least * _CHANGE**2 > whole:
        return None
    time_ns = (int(phases.end_ns[k - 1]) + int(phases.start_ns[k])) // 2
    later = np.arange(len(phases)) >= k
    stepped = np.concatenate([rows, later[:, None, None] * offsets], axis=2).reshape(-1, 16)
    solution = np.linalg.lstsq(stepped, values.ravel(), rcond=1e-9)[0]
    left = float(np.sum((values.ravel() - stepped @ solution) ** 2))
    if left * _CHANGE**2 <= whole:
        return LoadChange(time_ns, k, None, solution[-6:])
    return LoadChange(time_ns, k, (float(first[0]), float(second[0])), second[4:] - first[4:])


def rms(values: Array) -> Array:
    """Root mean square (6,) of rows (n, 6); NaN where there are none."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0))) if len(values) else np.full(6, np.nan)
