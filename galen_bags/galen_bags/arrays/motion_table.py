"""Tables of one run in motion: wrench, IMU and orientation, each at its own rate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_model.arrays import Array
from scipy.interpolate import CubicSpline

from galen_bags.arrays.orientation_table import read_orientations, read_wrenches
from galen_bags.arrays.text_table import TableError, read_text_table

_IMU = ("ax", "ay", "az")
_REST_RAD_S = 0.01
_REST_S = 0.1
_SETTLED_S = 0.25


@dataclass(frozen=True)
class MotionTable:
    """One run: times (s, one clock more or less) and values of wrench, IMU and gravity."""

    wrench_s: Array
    wrench: Array
    imu_s: Array
    specific: Array
    gravity_s: Array
    gravity: Array


def read_motion(
    wrench_file: Path,
    imu_file: Path | None,
    orientations_file: Path,
    time_unit_s: float,
    imu_unit_m_s2: float,
) -> MotionTable:
    """Return a run's tables; without an IMU its arrays are empty. Raises TableError."""
    wrench_t, wrench = read_wrenches(wrench_file)
    gravity_t, gravity = read_orientations(orientations_file)
    imu_t, specific = np.zeros(0), np.zeros((0, 3))
    if imu_file is not None:
        imu_t = read_text_table(imu_file, {"t", *_IMU}).require("t")
        specific = read_specific(imu_file, imu_unit_m_s2)
        _check_times(imu_file, imu_t)
    _check_times(wrench_file, wrench_t)
    _check_times(orientations_file, gravity_t)
    start = wrench_t[0]
    return MotionTable(
        (wrench_t - start) * time_unit_s,
        wrench,
        (imu_t - start) * time_unit_s,
        specific,
        (gravity_t - start) * time_unit_s,
        gravity,
    )


def _check_times(path: Path, times: Array) -> None:
    late = np.flatnonzero(np.diff(times) <= 0.0)
    if len(late):
        row = int(late[0]) + 1
        raise TableError(
            f"{path}: reading {row + 1} has t = {times[row]:.15g} after {times[row - 1]:.15g};"
            " a run's times increase"
        )


def read_specific(path: Path, unit_m_s2: float) -> Array:
    """Specific force (n, 3), m/s^2, of a table of ax ay az; raises TableError."""
    text = read_text_table(path, set(_IMU))
    return unit_m_s2 * np.column_stack([text.require(name) for name in _IMU])


def moving(time_s: Array, gravity: CubicSpline) -> np.ndarray:
    """Whether gravity turns, or has or will within a quarter of a second, at each moment."""
    around = [gravity(time_s + shift) for shift in (-_REST_S / 2.0, _REST_S / 2.0)]
    change = np.linalg.norm(around[1] - around[0], axis=1) / 9.8
    turning = time_s[change > _REST_RAD_S * _REST_S]
    if not len(turning):
        return np.zeros(len(time_s), dtype=bool)
    after = np.clip(np.searchsorted(turning, time_s), 1, max(len(turning) - 1, 1))
    last = len(turning) - 1
    nearest = np.minimum(
        np.abs(turning[np.minimum(after, last)] - time_s), np.abs(turning[after - 1] - time_s)
    )
    return np.asarray(nearest < _SETTLED_S)
