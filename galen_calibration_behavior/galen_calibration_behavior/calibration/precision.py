"""How precise a sweep's poses so far make the compensation, and whether that is enough.

The error's standard deviation follows from the poses and the noise of an averaged reading
(`galen_model.poses.design.compensation_std`). The noise is what the scatter within the poses tells,
or what the residuals of one load and six offsets tell, whichever is larger: a filtered sensor
scatters too little within a pose, a cable or a wrong joint zero only shows between them. Residuals
are held against the scatter, force and torque each as a kind, so that few poses have many degrees
of freedom: nu = 3 n - 4 for force (a mass, three offsets), 3 n - 6 for torque.

Who looks after every pose and stops at the first estimate that is small enough takes the noise for
smaller than it is: it stops where chance has made the residuals small (Anscombe, *J. R. Stat. Soc.
B* 15, 1953). So not their mean square counts but its upper confidence limit, s^2 nu / chi^2_a(nu);
`test_calibration_sweep_plan.py` holds what that leaves, over many simulated sweeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from galen_model.errors import IdentificationError
from galen_model.load.identification import single_load_design
from galen_model.load.robust_fit import fit_robust
from galen_model.poses.design import compensation_std
from galen_model.rest.pose import PoseRecord

from galen_calibration_behavior.calibration.sweep import stack

_CHANCE = 0.2  # that the noise is larger than the limit taken
_FORCE_PARAMETERS, _TORQUE_PARAMETERS = 4, 6


@dataclass(frozen=True)
class Precision:
    """Std of the compensation's error, root mean square over workspace and the three axes."""

    force_std_n: float
    torque_std_nm: float

    def reaches(self, force_std_n: float, torque_std_nm: float) -> bool:
        """Whether it is as small as these, of which 0 asks for nothing."""
        return (force_std_n <= 0.0 or self.force_std_n <= force_std_n) and (
            torque_std_nm <= 0.0 or self.torque_std_nm <= torque_std_nm
        )

    def __str__(self) -> str:
        """Return it for a person."""
        return f"{self.force_std_n * 1e3:.2g} mN and {self.torque_std_nm * 1e3:.2g} mN.m"


_UNKNOWN = Precision(np.inf, np.inf)


def sweep_precision(records: Sequence[PoseRecord]) -> Precision:
    """What the poses of a sweep, averaged, make of one load; infinite where they can't tell."""
    roll, tilt, wrench, scatter = stack(list(records))
    design = single_load_design(gravity_in_sensor(roll, tilt))
    try:
        fit = fit_robust(design, wrench)
    except IdentificationError:
        return _UNKNOWN
    used = fit.used
    noise = averaged_noise(fit.residuals[used], scatter[used])
    std = compensation_std(np.column_stack([roll, tilt])[used], noise)
    return Precision(_rms(std[:3]), _rms(std[3:]))


def averaged_noise(residuals: Array, scatter: Array, chance: float = _CHANCE) -> Array:
    """Noise of one averaged reading (6,): N and N.m; residuals and std of the means (n, 6)."""
    inside = np.sqrt(np.mean(scatter**2, axis=0))
    noise = inside.copy()
    for axes, parameters in (
        (slice(0, 3), _FORCE_PARAMETERS),
        (slice(3, 6), _TORQUE_PARAMETERS),
    ):
        squares = float(np.sum((residuals[:, axes] / inside[axes]) ** 2))
        freedom = 3 * len(residuals) - parameters
        if freedom < 1:
            return np.full(6, np.inf)
        noise[axes] *= np.sqrt(max(1.0, squares / chi2_ppf(chance, freedom)))
    return noise


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
