"""A run in motion: wrench, orientation and perhaps an IMU, each at its own rate.

The load comes from a table of still poses, with its covariance; constants are the run's own. Rows
are means over short windows, blocks are stretches of time. An IMU that still poses have mounted
(`galen_model.load.inertia.imu_mount`) tells the acceleration of the sensor's origin,

    a = g - felt - al x r - w x (w x r),

with w and al from the orientation, its lever r and its clock's lag open. Without an IMU forces of
acceleration can't be told.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from galen_bags.arrays.motion_table import MotionTable, moving
from galen_bags.arrays.orientation_table import OrientationTable
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arm.sensor_motion import SensorMotion
from galen_model.arrays import Array
from galen_model.evidence.blocks import BlockRows, Columns, Effects
from galen_model.load.identification import identify_single_load
from galen_model.load.inertia.imu_mount import fit_imu
from galen_model.load.model import Load
from galen_model.rotation import rotvec_to_matrix
from galen_sim_driver.effects.registry import EFFECTS
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.tables.table_effects import delay_columns, in_time, table_effects
from galen_diagnosis.tables.table_plant import TablePlant
from galen_diagnosis.tables.table_rows import UNITS, Prepared, floor_of_windows, load_columns

BLOCKS = 8
_LAGS_S = np.arange(-0.008, 0.0081, 0.001)
_LEVER_M = 0.05
_MEMORIES_S = (0.01, 0.05, 0.3)
_RATE_WINDOW_S = 0.07
_EDGE_S = 0.05
_CONSTANTS = np.array([*[100.0] * 3, *[10.0] * 3])
_FEWEST_READINGS = 200


def prepare_run(
    still: OrientationTable,
    still_specific: Array | None,
    run: MotionTable,
    rotation: Array | None,
    window_s: float = 0.01,
) -> Prepared:
    """Rows and effects of a run.

    still_specific (n, 3): the IMU's readings in the still poses, m/s^2, or None without an IMU
    (`run.imu_s` is then empty). rotation (m, 3, 3): R_base_sensor at `run.gravity_s`, or None.
    Raises GalenError where the tables can't be used.
    """
    identified = identify_single_load(still.gravity, still.wrench)
    load = Load(identified.load.mass_kg, np.asarray(identified.load.com_m))
    margin = _EDGE_S + float(_LAGS_S.max())
    ends = [run.wrench_s, run.gravity_s] + ([run.imu_s] if still_specific is not None else [])
    first, last = max(end[0] for end in ends) + margin, min(end[-1] for end in ends) - margin
    inside = (run.wrench_s > first) & (run.wrench_s < last)
    time_s, wrench = run.wrench_s[inside], run.wrench[inside]
    if len(time_s) < _FEWEST_READINGS:
        raise DiagnosisError(
            f"wrench and orientations lie together in {len(time_s)} readings;"
            f" {_FEWEST_READINGS} are needed"
        )
    course = CubicSpline(run.gravity_s, run.gravity)
    gravity = course(time_s)
    turned = None if rotation is None else _rotation_at(time_s, run.gravity_s, rotation)
    window = np.floor((time_s - time_s[0]) / window_s).astype(int)
    _, window = np.unique(window, return_inverse=True)
    count = np.bincount(window)

    def mean(values: Array) -> Array:
        sums = np.zeros((len(count), *values.shape[1:]))
        np.add.at(sums, window, values)
        return sums / count.reshape(-1, *[1] * (values.ndim - 1))

    plant = TablePlant(gravity, turned, time_s, load, np.zeros(6))
    offset = (wrench - plant.reading()).mean(axis=0)
    plant = TablePlant(gravity, turned, time_s, load, offset)
    nominal = load_columns(gravity, mean, _prior(identified.load.covariance, load))
    rest = ~moving(time_s, course)
    if rest.sum() < _FEWEST_READINGS // 2:
        raise DiagnosisError("the run holds no rest, which tells the noise floor")
    step_s = float(np.median(np.diff(time_s)))
    pieces = np.split(np.flatnonzero(rest), np.flatnonzero(np.diff(np.flatnonzero(rest)) > 1) + 1)
    stretches = [(time_s[rows], wrench[rows]) for rows in pieces if len(rows) > 30]
    floor = floor_of_windows(stretches, window_s, step_s, "what scatters at rest in the run")
    effects = table_effects(plant, mean, nominal, known_load=False)
    of = {**effects.of, **in_time(plant, mean), "wrench_delay": [delay_columns(plant, mean)]}
    cannot = effects.cannot_tell
    if still_specific is None:
        cannot = (*cannot, "inertial_load: no IMU tells the acceleration")
    elif turned is None:
        cannot = (*cannot, "inertial_load: needs the orientation's r11 ... r33 or qx ... qw")
    else:
        of["inertial_load"] = _inertial(still, still_specific, run, plant, mean)
    at_s = mean(time_s)
    block = np.minimum((at_s - at_s[0]) / (at_s[-1] - at_s[0]) * BLOCKS, BLOCKS - 1).astype(int)
    edges = np.linspace(at_s[0], at_s[-1], BLOCKS + 1)
    rows = BlockRows(
        channels=WRENCH_AXES,
        units=UNITS,
        residual=mean(wrench - plant.reading()),
        floor=floor.std,
        at_s=at_s - at_s[0],
        block=block,
        labels=tuple(f"{a:.1f} to {b:.1f} s" for a, b in pairwise(edges)),
        alike=floor.alike,
        memory_s=floor.memory_s,
        memories_s=_MEMORIES_S,
    )
    words = (
        f"{len(at_s)} means over {1e3 * window_s:g} ms of a run; load from {len(still)} still"
        f" readings, {load.mass_kg:.3f} kg",
        f"floor: {floor.source}",
    )
    return Prepared(rows, Effects(nominal, of, cannot), words)


def _prior(covariance: Array, load: Load) -> Array:
    """Standard deviations (10,) of moments and constants, from those of mass and centre."""
    mass_and_centre = np.sqrt(np.diag(covariance))
    com = np.asarray(load.com_m)
    moments = np.hypot(load.mass_kg * mass_and_centre[1:], com * mass_and_centre[0])
    return np.concatenate([[mass_and_centre[0]], moments, _CONSTANTS])


def _rotation_at(time_s: Array, known_s: Array, rotation: Array) -> Array:
    """Rotations (n, 3, 3) at times, from (m, 3, 3): linear, and made orthogonal again."""
    flat = CubicSpline(known_s, rotation.reshape(-1, 9))(time_s).reshape(-1, 3, 3)
    left, _, right = np.linalg.svd(flat)
    return np.asarray(left @ right)


def _turning(known_s: Array, rotation: Array) -> tuple[Callable[[Array], Array], ...]:
    """Angular velocity and acceleration in the sensor's axes: R^T dR/dt is its cross matrix."""
    step_s = float(np.median(np.diff(known_s)))
    even = np.arange(known_s[0], known_s[-1], step_s)
    matrices = _rotation_at(even, known_s, rotation)
    window = max(5, 2 * round(0.5 * _RATE_WINDOW_S / step_s) + 1)
    rate = savgol_filter(matrices, window, 3, deriv=1, delta=step_s, axis=0)
    cross = np.swapaxes(matrices, 1, 2) @ rate
    velocity = np.stack([cross[:, 2, 1], cross[:, 0, 2], cross[:, 1, 0]], axis=1)
    acceleration = savgol_filter(velocity, window, 3, deriv=1, delta=step_s, axis=0)
    return CubicSpline(even, velocity), CubicSpline(even, acceleration)


def _inertial(
    still: OrientationTable,
    still_specific: Array,
    run: MotionTable,
    plant: TablePlant,
    mean: Callable[[Array], Array],
) -> Sequence[Columns]:
    """The simulator's inertial load with the IMU's acceleration, for lags of the IMU's clock."""
    assert plant.rotation is not None
    mount = fit_imu(still.gravity, still_specific).mount
    turn = rotvec_to_matrix(mount.rotvec_rad)
    # R (u - b) / k is the specific force a - g
    felt = -((run.specific - mount.bias_m_s2) / mount.scale) @ turn.T
    at = CubicSpline(run.imu_s, felt)
    velocity_at, acceleration_at = _turning(plant.at_s, plant.rotation)
    velocity, turning = velocity_at(plant.at_s), acceleration_at(plant.at_s)
    mass = plant.load.mass_kg
    typical = max(mass, float(EFFECTS["inertial_load"].fitted[0].typicals[0]))

    def pulled(acceleration: Array, kg: float) -> Array:
        motion = SensorMotion(velocity, turning, acceleration)
        moved = TablePlant(
            plant.gravity, plant.rotation, plant.at_s, plant.load, plant.offset, motion
        )
        return moved.change(EFFECTS["inertial_load"](mass_kg=kg))  # type: ignore[call-arg]

    # An IMU at r feels al x r + w x (w x r) more than the origin does.
    nothing = pulled(np.zeros_like(velocity), mass)
    lever = np.stack(
        [
            pulled(-(np.cross(turning, unit) + np.cross(velocity, np.cross(velocity, unit))), mass)
            - nothing
            for unit in _LEVER_M * np.eye(3)
        ],
        axis=2,
    )
    ways = []
    for lag_s in _LAGS_S:
        main = pulled(plant.gravity - at(plant.at_s + lag_s), typical)
        for with_lever in (False, True):
            parts = [main[:, :, None]] + ([lever] if with_lever else [])
            parameters: dict[str, Callable[[Array], Array]] = {"mass_kg": lambda w: typical * w[0]}
            if with_lever:
                parameters["imu_lever_m"] = lambda w: _LEVER_M * w[1:]
            ways.append(
                Columns(
                    mean(np.concatenate(parts, axis=2)),
                    parameters,
                    {"imu_lag_s": float(round(lag_s, 4))},
                    allowed=lambda w: w[0] > 0.0,
                    beyond=("imu_lever_m",),
                )
            )
    return ways
