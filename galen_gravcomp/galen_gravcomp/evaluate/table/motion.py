"""An IMU's inertial forces on tables: wrench, IMU and orientation, each at its own rate.

The load comes from still poses, which also tell how the IMU is mounted (`imu_fit`). In motion the
IMU reads what the load feels, s = g - a = -R (u - b) / k, so

    wrench = m s,  h x s  + offset

without any derivative: what it lacks are terms of turning (al x h, w x (w x h), I al), which a
gyroscope would tell. The lag between the clocks is found on one half of the run and used on the
other. What no linear use of this IMU could better is told beside: a filter of all its axes, from
20 ms before to 30 ms after, fitted to all blocks but one and scored on that one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_bags.arrays.motion_table import MotionTable, moving
from galen_bags.arrays.orientation_table import OrientationTable
from galen_bags.arrays.text_table import TableError
from galen_model.arrays import Array
from galen_model.load.identification import plain_least_squares
from galen_model.load.inertia import ImuFit, fit_imu
from galen_model.load.model import gravity_regressor
from galen_model.rotation import rotvec_to_matrix
from rich.table import Table
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from galen_gravcomp.evaluate.report import Report, axes_table, axis_cells, by_axis
from galen_gravcomp.evaluate.residual_decomposition import rms

_LAGS_S = np.arange(-0.02, 0.0201, 0.0005)
_TAPS_S = np.arange(-0.02, 0.0301, 0.002)
_BLOCKS = 6
_EDGE_S = 0.05
_FEWEST_REST = 20
_RIDGE = 1e-5
# Below the sensor's usual filter, and below what an admittance controller follows.
_BANDS_HZ = (45.0, 10.0)


@dataclass(frozen=True)
class MotionScore:
    """RMS (6,) in motion by model, for each band (Hz; inf: all), and the rest's, N and N.m.

    lag_s: of each half; the IMU's stamps are so much later than the wrench's.
    """

    imu: ImuFit
    lag_s: tuple[float, float]
    rest_s: float
    bands: dict[float, dict[str, Array]]


WEIGHT, WITH_IMU, FILTER, REST = "weight only", "with the IMU", "any filter of the IMU", "at rest"


def score_motion(still: OrientationTable, specific: Array, run: MotionTable) -> MotionScore:
    """Calibrate on still poses, score on the run.

    specific (n, 3): the IMU's readings in the still poses, m/s^2. Raises TableError,
    IdentificationError.
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
    if len(time_s) < 100:
        raise TableError("wrench, IMU and orientations lie together in fewer than 100 readings")
    gravity = CubicSpline(run.gravity_s, run.gravity)
    at = CubicSpline(run.imu_s, felt)
    in_motion = moving(time_s, gravity)
    if np.count_nonzero(~in_motion) < _FEWEST_REST or np.count_nonzero(in_motion) < 100:
        raise TableError("the run must hold motion, and rest to tare in")
    weight = wrench - gravity_regressor(gravity(time_s)) @ moments - offset

    def left(lag_s: float) -> Array:
        return np.asarray(wrench - gravity_regressor(at(time_s + lag_s)) @ moments - offset)

    half = time_s < np.median(time_s[in_motion])
    lags = [_best_lag(left, in_motion & rows, moments) for rows in (half, ~half)]
    with_imu = np.where(half[:, None], left(lags[1]), left(lags[0]))
    taps = np.concatenate([at(time_s + t) - gravity(time_s) for t in _TAPS_S], axis=1)
    residuals = {
        WEIGHT: weight - weight[~in_motion].mean(axis=0),
        WITH_IMU: with_imu - with_imu[~in_motion].mean(axis=0),
        FILTER: _filtered(weight, taps, in_motion),
    }
    rate_hz = 1.0 / float(np.median(np.diff(time_s)))
    bands = {}
    for band_hz in (float("inf"), *_BANDS_HZ):
        if band_hz >= rate_hz / 2.0 and np.isfinite(band_hz):
            raise TableError(f"a band of {band_hz:g} Hz: readings come at {rate_hz:.0f} Hz")
        low = {name: _low_pass(part, band_hz, rate_hz) for name, part in residuals.items()}
        bands[band_hz] = {name: rms(part[in_motion]) for name, part in low.items()}
        bands[band_hz][REST] = np.std(low[WEIGHT][~in_motion], axis=0)
    rest_s = float(np.count_nonzero(~in_motion) / rate_hz)
    return MotionScore(imu, (float(lags[0]), float(lags[1])), rest_s, bands)


def _best_lag(left: Callable[[float], Array], rows: np.ndarray, moments: Array) -> float:
    # Force and torque in one unit: a torque is the load's lever arm times a force.
    arm_m = max(float(np.linalg.norm(moments[1:]) / moments[0]), 0.01)
    scale = np.repeat([1.0, 1.0 / arm_m], 3)
    costs = [float(np.sum((left(lag)[rows] * scale) ** 2)) for lag in _LAGS_S]
    best = int(np.argmin(costs))
    if best in (0, len(costs) - 1):
        raise TableError(
            f"the IMU's clock is off by more than {1e3 * _LAGS_S[-1]:.0f} ms against the wrench's,"
            " or it is not the same motion"
        )
    low, middle, high = costs[best - 1 : best + 2]
    return float(_LAGS_S[best] + 0.5 * (low - high) / (low - 2 * middle + high) * 5e-4)


def _filtered(weight: Array, taps: Array, moving: np.ndarray) -> Array:
    """What is left of `weight` (n, 6) by a linear filter, each block by a fit to the others."""
    design = np.column_stack([taps, np.ones(len(taps))])
    block = np.full(len(taps), -1)
    block[moving] = np.arange(np.count_nonzero(moving)) * _BLOCKS // np.count_nonzero(moving)
    left = weight - weight[~moving].mean(axis=0)
    for number in range(_BLOCKS):
        rows = moving & (block != number)
        information = design[rows].T @ design[rows]
        information += _RIDGE * np.count_nonzero(rows) * np.eye(len(information))
        values = np.linalg.solve(information, design[rows].T @ weight[rows])
        held = block == number
        left[held] = weight[held] - design[held] @ values
    return left


def _low_pass(values: Array, band_hz: float, rate_hz: float) -> Array:
    if not np.isfinite(band_hz):
        return values
    sections = butter(4, band_hz, fs=rate_hz, output="sos")
    return np.asarray(sosfiltfilt(sections, values, axis=0))


def report(score: MotionScore) -> Report:
    """Make the report of a run with an IMU."""
    mount = score.imu.mount
    shown: list[str | Table] = [
        f"{name}: {' '.join(f'{value:.4f}' for value in values)}"
        for name, values in (
            ("imu_rotvec_rad", mount.rotvec_rad),
            ("imu_bias_m_s2", mount.bias_m_s2),
            ("residual of the still poses, m/s^2", score.imu.std_m_s2),
        )
    ]
    first, second = (1e3 * lag for lag in score.lag_s)
    shown.append(
        f"imu_scale: {mount.scale:.5f}; the IMU's stamps are {first:.2f} ms (first half), "
        f"{second:.2f} ms (second half) late; each is used on the other"
    )
    made = axes_table("Residual in motion, root mean square, tared at rest", "band, model")
    for band, models in score.bands.items():
        made.add_row("[bold]all[/bold]" if np.isinf(band) else f"[bold]< {band:g} Hz[/bold]")
        for name, values in models.items():
            made.add_row(f"  {name}", *axis_cells(values, 1))
    return Report(_content(score), [*shown, made])


def _content(score: MotionScore) -> dict[str, Any]:
    mount = score.imu.mount
    return {
        "imu": {
            "rotvec_rad": mount.rotvec_rad.tolist(),
            "bias_m_s2": mount.bias_m_s2.tolist(),
            "scale": mount.scale,
            "std_m_s2": score.imu.std_m_s2.tolist(),
        },
        "lag_of_halves_s": list(score.lag_s),
        "rest_s": score.rest_s,
        "rms": {
            "all" if np.isinf(band) else f"below_{band:g}_hz": {
                name: by_axis(values) for name, values in models.items()
            }
            for band, models in score.bands.items()
        },
    }
