"""What is left over in the still phases, taken apart: load, offset, drift, the rest.

With u_k gravity in the sensor's frame in phase k, the mean residual there is fitted by

    r_k = G(u_k) d + b + c (t_k - t_mean) + rest

d: what the load (mass, first moment) differs from the file's, in which the reading is linear (see
`galen_model.load.model`); b: an offset, as a sensor zeroed anew or drifted leaves it, which a
tare takes off; c: its drift; robustly, so that a few touched phases don't count
(`galen_model.load.robust_fit`). Poses that can't tell d from b are rejected by the same gate as a
calibration's (`galen_model.load.excitation`); then only the offset and the drift are fitted. The
standard deviations come from the rest's scatter from phase to phase, so a sensor's coloured noise
is in them, but not a bias drift over many phases, which offset and drift follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.distributions import chi2_sf
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.excitation import LOAD_PARAMETERS, check_excitation
from galen_model.load.model import gravity_regressor
from galen_model.load.robust_fit import RobustFit, fit_robust
from galen_model.rest.binned import StillPhases

_FEWEST_PHASES = 4
# Drift needs phases before and after; with fewer it takes up whatever is left.
_FEWEST_FOR_DRIFT = 8
_SHORTEST_DRIFT_S = 30.0
_SIGNIFICANT = 1e-3


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


def take_apart(
    phases: StillPhases, tool: CalibrationFile, *, stamps_jump: bool = False
) -> Misfit | None:
    """Take the phases' residuals apart; None when there are too few phases to say anything.

    `stamps_jump`: their times are not to be relied on, so that drift can't be told.
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
        why_no_drift = f"{len(phases)} still phases are too few"
    elif np.ptp(time_h) * 3600.0 < _SHORTEST_DRIFT_S:
        why_no_drift = f"the still phases span less than {_SHORTEST_DRIFT_S:.0f} s"
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
        why_no_load = f"the phases agree on nothing: {error}"
    if why_no_load:
        try:
            fit = fit_robust(np.concatenate(list(blocks.values()), axis=2), phases.mean)
        except IdentificationError:
            return None
    return _misfit(fit, blocks, phases, why_no_load, why_no_drift)


def phase_gravity(phases: StillPhases, tool: CalibrationFile) -> Array:
    """Gravity (n, 3) in the sensor's frame, m/s^2, as large as the tool's file has it."""
    gravity = gravity_in_sensor(phases.angles[:, 0], phases.angles[:, 1])
    return np.asarray(gravity * (tool.gravity_m_s2[2] / GRAVITY_M_S2[2]))


def _misfit(
    fit: RobustFit,
    blocks: dict[str, Array],
    phases: StillPhases,
    why_no_load: str,
    why_no_drift: str,
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
        if chi2_sf(distance, design.shape[2]) < _SIGNIFICANT:
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
        why_no_drift=why_no_drift,
        significant=frozenset(significant),
    )


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))
