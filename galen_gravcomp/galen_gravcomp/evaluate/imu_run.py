# SPDX-License-Identifier: Apache-2.0
"""An IMU's inertial forces on tables: wrench, IMU and orientation, each at its own rate.

The load comes from still poses, which also determine how the IMU is mounted
(`galen_model.load.inertia.fit_imu`). In motion the IMU reads the specific force that the load
feels, s = g - a = -R (u - b) / k, so

    wrench = m s,  h x s  + offset

without any derivative: what it lacks are terms of turning (al x h, w x (w x h), I al), which need
a gyroscope. The lag between the clocks is found on one half of the run and used on the other.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy  # its parts are loaded when they are used
from galen_bags.arrays.tables import MotionTable, OrientationTable, moving
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.load.identification import plain_least_squares
from galen_model.load.inertia import ImuFit, fit_imu
from galen_model.load.model import gravity_regressor
from galen_model.rotation import rotvec_to_matrix
from rich.table import Table

from galen_gravcomp.evaluate.report import Report, axes_table, axis_cells, by_axis
from galen_gravcomp.evaluate.residual import rms

WEIGHT, WITH_IMU, REST = "weight only", "with the IMU", "at rest"
_LAG_STEP_S = 5e-4
_LAGS_S = np.arange(-0.02, 0.0201, _LAG_STEP_S)
_EDGE_S = 0.05
_FEWEST_REST = 20
_FEWEST = 100


def imu_run_report(still: OrientationTable, specific: Array, run: MotionTable) -> Report:
    """Calibrate on still poses, score on the run: residuals in motion by model, noise at rest.

    Args:
        still: n still poses.
        specific: (n, 3) the IMU's readings in these poses, m/s^2 in its axes.
        run: wrench, IMU and gravity in motion.

    Returns:
        The report.

    Raises:
        GalenError: the run holds too little motion or rest, or the clocks are too far apart.
        IdentificationError: the poses don't determine the IMU's mounting or the load.

    """
    imu = fit_imu(still.gravity, specific)
    moments, offset = plain_least_squares(still.gravity, still.wrench)
    mount = imu.mount
    back = rotvec_to_matrix(mount.rotvec_rad)
    felt = -((run.specific - mount.bias_m_s2) / mount.scale) @ back.T
    spread = float(np.abs(_LAGS_S).max()) + _EDGE_S
    first = max(run.wrench_s[0], run.imu_s[0] + spread, run.gravity_s[0])
    last = min(run.wrench_s[-1], run.imu_s[-1] - spread, run.gravity_s[-1])
    inside = (run.wrench_s > first) & (run.wrench_s < last)
    time_s, wrench = run.wrench_s[inside], run.wrench[inside]
    if len(time_s) < _FEWEST:
        raise GalenError(
            f"wrench, IMU and orientations lie together in fewer than {_FEWEST} readings"
        )
    gravity = scipy.interpolate.CubicSpline(run.gravity_s, run.gravity)
    at = scipy.interpolate.CubicSpline(run.imu_s, felt)
    in_motion = moving(time_s, gravity)
    if np.count_nonzero(~in_motion) < _FEWEST_REST or np.count_nonzero(in_motion) < _FEWEST:
        raise GalenError("the run must hold motion, and rest to tare in")

    def left(lag_s: float) -> Array:
        return np.asarray(wrench - gravity_regressor(at(time_s + lag_s)) @ moments - offset)

    half = time_s < np.median(time_s[in_motion])
    lags = [_best_lag(left, in_motion & rows, moments) for rows in (half, ~half)]
    weight = wrench - gravity_regressor(gravity(time_s)) @ moments - offset
    with_imu = np.where(half[:, None], left(lags[1]), left(lags[0]))
    residuals = {
        name: rms((values - values[~in_motion].mean(axis=0))[in_motion])
        for name, values in ((WEIGHT, weight), (WITH_IMU, with_imu))
    }
    residuals[REST] = np.std(weight[~in_motion], axis=0)
    rest_s = float(np.count_nonzero(~in_motion) * np.median(np.diff(time_s)))
    return _report(imu, (lags[0], lags[1]), rest_s, residuals)


def _best_lag(left: Callable[[float], Array], rows: np.ndarray, moments: Array) -> float:
    # Force and torque in one unit: a torque is the load's lever arm times a force.
    arm_m = max(float(np.linalg.norm(moments[1:]) / moments[0]), 0.01)
    scale = np.repeat([1.0, 1.0 / arm_m], 3)
    costs = [float(np.sum((left(lag)[rows] * scale) ** 2)) for lag in _LAGS_S]
    best = int(np.argmin(costs))
    if best in (0, len(costs) - 1):
        raise GalenError(
            f"the IMU's clock is off by more than {1e3 * _LAGS_S[-1]:.0f} ms against the wrench's,"
            " or it is not the same motion"
        )
    low, middle, high = costs[best - 1 : best + 2]
    return float(_LAGS_S[best] + 0.5 * (low - high) / (low - 2 * middle + high) * _LAG_STEP_S)


def _report(
    imu: ImuFit, lag_s: tuple[float, float], rest_s: float, residuals: dict[str, Array]
) -> Report:
    """lag_s: of each half; residuals (6,): N and N.m."""
    mount = imu.mount
    content = {
        "imu": {
            "rotvec_rad": mount.rotvec_rad.tolist(),
            "bias_m_s2": mount.bias_m_s2.tolist(),
            "scale": mount.scale,
            "std_m_s2": imu.std_m_s2.tolist(),
        },
        "lag_of_halves_s": list(lag_s),
        "rest_s": rest_s,
        "rms": {name: by_axis(values) for name, values in residuals.items()},
    }
    shown: list[str | Table] = [
        f"{name}: {' '.join(f'{value:.4f}' for value in values)}"
        for name, values in (
            ("imu_rotvec_rad", mount.rotvec_rad),
            ("imu_bias_m_s2", mount.bias_m_s2),
            ("residual of the still poses, m/s^2", imu.std_m_s2),
        )
    ]
    first, second = (1e3 * lag for lag in lag_s)
    shown.append(
        f"imu_scale: {mount.scale:.5f}; the IMU's stamps are {first:.2f} ms (first half), "
        f"{second:.2f} ms (second half) late; each is used on the other"
    )
    made = axes_table("Residual in motion, root mean square, tared at rest", "model")
    for name, values in residuals.items():
        made.add_row(name, *axis_cells(values, 1))
    return Report(content, [*shown, made])
