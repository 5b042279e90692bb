# SPDX-License-Identifier: Apache-2.0
"""A table with orientations as a recording: of a wrist that turns as the sensor does.

A table with time is cut into its rest segments, blocks of averages over short windows. One without
time is a row a reading; readings under the same gravity, where there are such, are a block, and
with a reference each visit to it: what shows under one direction alone no other predicts. The
load is fitted (mass, centre, constant part: what a calibration has) unless a file has it.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from galen_bags.arrays.tables import OrientationTable, average_still, without_repeats
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2, Arm, Joint, constant
from galen_model.arrays import Array
from galen_model.errors import GalenError, IdentificationError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.identification import identify_single_load, plain_least_squares
from galen_model.load.model import Load, LoadEstimate, gravity_regressor, gravity_wrench
from galen_model.rest.segments import DirectionRest, rest_by_direction
from galen_sim_driver.effects.joints import BaseInclination
from galen_sim_driver.effects.registry import limit_parts
from scipy.spatial.transform import Rotation

from galen_diagnosis.effects.registry import RECORDS
from galen_diagnosis.observation.noise import ChannelNoise, channel_noise
from galen_diagnosis.observation.observation import LEAST_NOISE
from galen_diagnosis.observation.recording import (
    DAY_TO_DAY,
    BagData,
    DiagnosticRecording,
    Readings,
)
from galen_diagnosis.observation.specification import DEFAULT, Specification, specification_of

_FEWEST_BLOCKS = 4
_LEAST_FREEDOM = 2
_MOST_NOISE, _USUAL_NOISE_N = 0.1, 0.05
"""Of how forces change, or as much: what is more is not taken for noise."""
_MANY = 20
"""Readings from which on a map of ten numbers is fitted to a channel."""
_MAPPED = "gravity", "wrench"
_SAME_GRAVITY_RAD = 0.03
_MOST_VISITS = 60
_MOST_COURSES = 8
_BY_ORDER = DirectionRest(max_rate_rad_s=1e-3, rim_s=2.0, min_duration_s=8.0)
_WINDOW = 4
"""Readings of a table without time."""
_WINDOWS = 3
_LEAST_AT_REST = 0.25
_SIGMAS = 3.0
"""Of an autocorrelation, by chance."""
_WIDE = np.array([10.0, 1.0, 1.0, 1.0, *[100.0] * 3, *[10.0] * 3])
"""Mass (kg), first moments (kg.m), constants: nothing is known of them."""
_LONGEST_CURVE_S = 3.0
_READING_S = 10.0
"""Of a reading where their order is all that is known of time."""
_WRIST = ("yaw", "pitch", "roll")
_NO_FLOOR = (
    "the noise isn't known (--noise): what no linear map of gravity explains is taken for it"
)


@dataclass(frozen=True)
class Floor:
    """Noise of a reading (6,), and how it goes on: correlation alike exp(-dt / memory_s).

    source: where it is from.
    """

    std: Array
    alike: float
    memory_s: float
    source: str

    def alone(self, step_s: float) -> float:
        """Return which part of readings is worth as much as independent ones.

        Args:
            step_s: Time between readings.

        Returns:
            A share, 0 ... 1.

        """
        return 1.0 / (1.0 + 2.0 * self.alike / np.expm1(step_s / self.memory_s))


def table_recording(
    table: OrientationTable,
    noise: Array | None = None,
    tool: CalibrationFile | None = None,
    window_s: float = 1.0,
    references: Sequence[OrientationTable] = (),
    specification: Specification | None = None,
) -> DiagnosticRecording:
    """Return a table as a recording, whose arm is a wrist that turns as the sensor does.

    Args:
        table: n readings with orientations; one with time and without blocks is cut into its rest
            segments.
        noise: Readings of the sensor, still and untouched, (m, 6), for the floor of a table without
            time.
        tool: Its load is that on the sensor; None where mass and centre are fitted.
        window_s: Of the averages of a table with time.
        references: Earlier tables of the same sensor and tool: what is nominal is their fit, and
            the floor what it leaves of them.
        specification: Limits of what is healthy; None for those of a usual sensor.

    Returns:
        One bag whose readings stand for themselves each.

    Raises:
        GalenError: The table or a reference can't be used.

    """
    run = _Stops.of(table, window_s)
    floor: Floor | None
    if run is not None:
        floor = _floor_at_rest(run)
        averaged = run.averaged()
        notes = [f"{len(averaged)} averages of {run.window_s:g} {run.unit} in rest segments"]
    else:
        single, repeats = without_repeats(table)
        averaged, notes = single.timed(), [f"{len(single)} readings"]
        if repeats:
            notes.append(f"{repeats} rows repeat another one: counted once")
        floor = _floor_of_readings(averaged, noise)
    if table.time is None:
        notes.append(f"the order of readings is taken for time, {_READING_S:g} s each")
    block, labels = _blocks(averaged, apart=bool(references))
    if len(labels) < _FEWEST_BLOCKS:
        raise GalenError(
            f"{table.path}: {len(labels)} blocks of readings; holding some out takes"
            f" {_FEWEST_BLOCKS}"
        )
    arm, joints = _wrist(averaged)
    limits = specification or specification_of([DEFAULT], limit_parts(arm))
    if references:
        earlier = [_averaged(one, window_s) for one in references]
        load, unknowns, floor, expected = _nominal_since(averaged, earlier)
        limits = limits.scaled(DAY_TO_DAY, "day-to-day changes of ")
    else:
        load, unknowns, expected = _nominal(averaged, tool)
    problems: tuple[str, ...] = ()
    if floor is None:
        floor, problems = _floor_of_a_map(averaged), (_NO_FLOOR,)
    notes.append(f"floor: {floor.source}")
    file = _file(averaged, load, tool, arm)
    residual = averaged.wrench - expected
    assert averaged.time is not None
    at_s = (averaged.time - averaged.time[0]) * (1.0 if table.time is not None else _READING_S)
    known_load = tool is not None or bool(references)
    hidden = {
        name: reason
        for name, record in RECORDS.items()
        if (reason := record.hidden_in_table(averaged, known_load))
    }
    names = tuple(Path(one.path).stem for one in references)
    # Neighbours that go together are worth less than as many independent ones.
    noise_std = np.maximum(floor.std / np.sqrt(floor.alone(_step_s(averaged))), LEAST_NOISE)
    readings = Readings(
        block, labels, noise_std, not problems, unknowns, hidden, tuple(notes), names
    )
    wrench = file.predict(arm.angles(joints)) + residual
    bag = BagData("sweep", 0.0, at_s, joints, at_s, wrench, None, None, readings)
    name = Path(table.path).stem
    return DiagnosticRecording(name, file, {"sweep": bag}, (), problems, arm, limits)


def _wrist(table: OrientationTable) -> tuple[Arm, Array]:
    """Return three joints that turn the sensor about one point, and their angles (n, 3)."""
    axes = zip(_WRIST, np.eye(3)[::-1], strict=True)
    zero = constant(0.0, 0.0, 0.0)
    joints = tuple(
        Joint(name, "revolute", constant(*axis), zero, -np.inf, np.inf) for name, axis in axes
    )
    size = float(np.linalg.norm(table.gravity, axis=1).mean())
    down = table.arm.gravity_m_s2 / np.linalg.norm(table.arm.gravity_m_s2)
    arm = Arm("wrist", joints, zero, np.eye(3), constant(*(size * down)),
              sensor_frame=table.arm.sensor_frame)  # fmt: skip
    rotation = table.rotation
    if rotation is None:
        unit = table.gravity / np.linalg.norm(table.gravity, axis=1, keepdims=True)
        rotation = np.stack([Rotation.align_vectors(down, one)[0].as_matrix() for one in unit])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where two axes are parallel one angle is free
        return arm, Rotation.from_matrix(rotation).as_euler("ZYX")


def _file(
    table: OrientationTable, load: Load, tool: CalibrationFile | None, arm: Arm
) -> CalibrationFile:
    """Return the tool's file for the wrist, or one of the load that was fitted."""
    if tool is not None:
        return replace(tool, arm=arm, zeroing=None, mounting=None, cable=None,
                       residual_offset=np.zeros(6))  # fmt: skip
    of = LoadEstimate(load.mass_kg, np.asarray(load.com_m, dtype=float), np.zeros((4, 4)))
    none = LoadEstimate(0.0, np.zeros(3), np.zeros((4, 4)))
    return CalibrationFile(
        "load", of, none, np.zeros(3), np.zeros(6), len(table), "", arm=arm, zeroing=None
    )


def _floor_of_a_map(table: OrientationTable) -> Floor:
    """Return what a linear map of gravity leaves of each channel or, with many poses, of R^T.

    With it gravity, and what else pulls, may have any direction in the base.
    """
    of, words = table.gravity, "gravity"
    if table.rotation is not None and len(table) >= _MANY:
        of, words = table.rotation.reshape(len(table), 9), "the orientation"
    design = np.column_stack([of, np.ones(len(table))])
    left = _left(design, table.wrench)
    freedom = len(table) - int(np.linalg.matrix_rank(design))
    if freedom < _LEAST_FREEDOM:
        raise GalenError(
            f"{table.path}: {len(table)} readings are too few to show their noise, which takes"
            f" {len(table) - freedom + _LEAST_FREEDOM} or more; give it with --noise"
        )
    std = np.sqrt(np.sum(left**2, axis=0) / freedom)
    changes = np.std(table.wrench[:, :3], axis=0)
    most = max(_MOST_NOISE * float(np.linalg.norm(changes)), _USUAL_NOISE_N)
    std *= min(1.0, most / max(float(np.linalg.norm(std[:3])), 1e-300))
    return Floor(std, 0.0, 1.0, f"what a linear map of {words} leaves of each channel")


def _left(design: Array, wrench: Array) -> Array:
    """Return what columns (n, p), fitted to each channel by itself, leave of wrenches (n, 6)."""
    return np.asarray(wrench - design @ np.linalg.lstsq(design, wrench, rcond=None)[0])


def _load_columns(gravity: Array, prior: Array) -> Array:
    """Return columns that are always fitted: moments and constants, by their prior (10,)."""
    values = np.zeros((len(gravity), 6, 10))
    values[:, :, :4] = gravity_regressor(gravity)
    values[:, :, 4:] = np.eye(6)
    return values * prior


@dataclass(frozen=True)
class _Stops:
    """A table that goes on while the arm moves and stops; without time, a reading is a second."""

    table: OrientationTable
    window_s: float
    rest: DirectionRest
    unit: str

    @classmethod
    def of(cls, table: OrientationTable, window_s: float) -> _Stops | None:
        """Return a table's stops; None where each reading stands for itself."""
        if table.block is not None:
            return None
        if table.time is not None:
            return cls(table, window_s, DirectionRest(), "s")
        stops = cls(without_repeats(table)[0].timed(), _WINDOW, _BY_ORDER, "readings")
        segments = stops.segments()
        sizes = [segment.stop - segment.start for segment in segments]
        if len(sizes) < _FEWEST_BLOCKS or sum(sizes) < _LEAST_AT_REST * len(table):
            return None
        return replace(stops, window_s=float(max(_WINDOW, min(sizes) // _WINDOWS)))

    def segments(self) -> list[slice]:
        """Return the readings of each stop."""
        assert self.table.time is not None
        return rest_by_direction(self.table.time, self.table.gravity, self.rest)

    def averaged(self) -> OrientationTable:
        """Return means over windows; a stop is a block."""
        return average_still(self.table, self.window_s, self.rest)[0]


def _averaged(table: OrientationTable, window_s: float) -> OrientationTable:
    run = _Stops.of(table, window_s)
    return run.averaged() if run is not None else without_repeats(table)[0].timed()


def _nominal_since(
    table: OrientationTable, earlier: Sequence[OrientationTable]
) -> tuple[Load, Array, Floor, Array]:
    """Return the load, how far nominal may be off, the floor, and nominal readings (n, 6).

    What is nominal is a map of gravity, w = A g + b, fitted to earlier tables channel by channel:
    the load with whatever a sensor's own gains, axes and mount make of it. Each table has its own
    b, since a sensor's zero changes from day to day. The floor is what that leaves of them, and
    how it goes on from reading to reading: a drift that earlier tables have is no change.
    """
    assert table.time is not None
    gravity, wrench = (np.concatenate([getattr(one, of) for one in earlier]) for of in _MAPPED)
    which = np.repeat(np.arange(len(earlier)), [len(one) for one in earlier])
    design = np.column_stack([gravity, which[:, None] == np.arange(len(earlier))])
    freedom = len(design) - design.shape[1]
    if freedom < _LEAST_FREEDOM:
        raise GalenError(
            f"{earlier[0].path}: {len(design)} readings are too few for a reference, which takes"
            f" {design.shape[1] + _LEAST_FREEDOM} or more"
        )
    if np.linalg.matrix_rank(design) < design.shape[1]:
        raise GalenError(
            f"{earlier[0].path}: the reference's readings lie in too few directions of gravity;"
            " they have to span all three"
        )
    cofactor = np.linalg.inv(design.T @ design)
    fitted = cofactor @ design.T @ wrench
    residual = wrench - design @ fitted
    own, own_freedom = _left_by_map_and_jump(table, np.sum(residual**2, axis=0) / freedom)
    residual, freedom = np.concatenate([residual, own]), freedom + own_freedom
    which = np.concatenate([which, np.full(len(own), len(earlier))])
    at_s = np.concatenate([_seconds(one) for one in (*earlier, table)])[: len(which)]
    alike, memory_s = _memory(residual, at_s, which)
    moments, _ = plain_least_squares(gravity, wrench)
    if not moments[0] > 0.0:
        raise GalenError(f"{earlier[0].path}: the load would weigh {moments[0]:.3g} kg")
    load = Load(float(moments[0]), moments[1:] / moments[0])
    expected = table.gravity @ fitted[:3]
    offset = (table.wrench - expected).mean(axis=0)
    source = f"what gravity leaves of {len(design)} readings of the reference"
    if own_freedom:
        source += f" and, with one jump, of these {len(table)}"
    floor = Floor(np.sqrt(np.sum(residual**2, axis=0) / freedom), alike, memory_s, source)
    std = floor.std / np.sqrt(floor.alone(_step_s(earlier[0])))
    drift, white = _drift(table.time, alike, memory_s)
    values = np.zeros((len(table), 6, 24 + 6 * drift.shape[1]))
    open_ = table.gravity @ np.linalg.cholesky(cofactor[:3, :3])
    for channel in range(6):
        values[:, channel, 3 * channel : 3 * channel + 3] = std[channel] * open_
        values[:, channel, 18 + channel] = _WIDE[4 + channel]
        values[:, channel, 24 + channel :: 6] = floor.std[channel] * drift
    floor = replace(floor, std=white * floor.std, alike=0.0)
    return load, values, floor, expected + offset


def _left_by_map_and_jump(table: OrientationTable, variance: Array) -> tuple[Array, int]:
    """Return what a map of gravity, w = A g + b, and a jump leave (n, 6), and degrees of freedom.

    The jump is where it leaves least, each channel over its variance (6,). Nothing, (0, 6), of too
    few readings to tell.
    """
    count = len(table)
    found = np.zeros((0, 6)), 0
    best = np.inf
    for first in range(_LEAST_FREEDOM, count - 1):
        columns = np.column_stack([table.gravity, np.ones(count), np.arange(count) >= first])
        freedom = count - columns.shape[1] - 1
        if freedom < _LEAST_FREEDOM or np.linalg.matrix_rank(columns) < columns.shape[1]:
            continue
        left = _left(columns, table.wrench)
        size = float(np.sum(left**2 / variance))
        if size < best:
            best, found = size, (left, freedom)
    return found


def _drift(time_s: Array, alike: float, memory_s: float) -> tuple[Array, float]:
    """Return courses (n, k) of a drift with weights of one, and what they leave white of it all.

    The leading eigenvectors of alike exp(-|t - t'| / memory_s).
    """
    apart = np.abs(time_s[:, None] - time_s[None, :]) / memory_s
    value, vectors = np.linalg.eigh(alike * np.exp(-apart))
    most = np.argsort(value)[::-1][: _MOST_COURSES if alike else 0]
    courses = vectors[:, most] * np.sqrt(np.maximum(value[most], 0.0))
    return courses, float(np.sqrt(1.0 - np.sum(value[most]) / len(time_s)))


def _seconds(table: OrientationTable) -> Array:
    assert table.time is not None
    return table.time


def _step_s(table: OrientationTable) -> float:
    return float(np.median(np.diff(_seconds(table))))


def _memory(residual: Array, time_s: Array, which: np.ndarray) -> tuple[float, float]:
    """Return how residuals (n, 6) hang together: alike exp(-dt / memory_s), alike and memory_s.

    By their autocorrelation, the mean over channels, up to where it falls to 1 / e of its first.
    """
    scaled = residual / np.maximum(residual.std(axis=0), 1e-300)
    step_s = float(np.median(np.diff(time_s)[np.diff(which) == 0]))

    def correlation(lag: int) -> float:
        return float(np.mean((scaled[lag:] * scaled[:-lag])[which[lag:] == which[:-lag]]))

    first = correlation(1)
    if first < _SIGMAS / np.sqrt(scaled.size):
        return 0.0, 1.0
    lag = 1
    while lag < len(scaled) // 4 and correlation(lag) > first * np.exp(-1.0):
        lag += 1
    return min(first * float(np.exp(1.0 / lag)), 0.99), lag * step_s


def _nominal(table: OrientationTable, tool: CalibrationFile | None) -> tuple[Load, Array, Array]:
    """Return the load, how far nominal may be off, and nominal readings (n, 6)."""
    if tool is None:
        if np.ptp(table.gravity, axis=0).max() < _SAME_GRAVITY_RAD * STANDARD_GRAVITY_M_S2:
            raise GalenError(
                f"{table.path}: all readings have gravity along one direction, where a load can't"
                " be separated from the sensor's zero; turn the sensor, or give the load (--tool)"
            )
        moments, _ = plain_least_squares(table.gravity, table.wrench)
        if not moments[0] > 0.0:
            raise GalenError(
                f"{table.path}: the load would weigh {moments[0]:.3g} kg; does a push read"
                " positive in the direction of the push?"
            )
        load = Load(float(moments[0]), moments[1:] / moments[0])
        if table.rotation is not None:
            # Fitted under a wrong direction of gravity it would be a wrong one.
            with suppress(IdentificationError):
                load = identify_single_load(
                    *(table.gravity, table.wrench, [BaseInclination.name], table.rotation),
                    arm=table.arm,
                ).load.load
        weight = gravity_wrench(table.gravity, load)
        offset = (table.wrench - weight).mean(axis=0)
        return load, _load_columns(table.gravity, _WIDE), weight + offset
    loads = [Load(of.mass_kg, np.asarray(of.com_m)) for of in (tool.load, tool.adapter)]
    weight = np.sum([gravity_wrench(table.gravity, one) for one in loads], axis=0)
    offset = (table.wrench - weight).mean(axis=0)
    only_constants = np.concatenate([np.zeros(4), _WIDE[4:]])
    return loads[0], _load_columns(table.gravity, only_constants), weight + offset


def _blocks(table: OrientationTable, *, apart: bool = False) -> tuple[np.ndarray, tuple[str, ...]]:
    if table.block is not None:
        labels = tuple(dict.fromkeys(table.block.tolist()))
        return np.array([labels.index(label) for label in table.block.tolist()]), labels
    unit = table.gravity / np.linalg.norm(table.gravity, axis=1, keepdims=True)
    block = np.full(len(unit), -1)
    first: list[int] = []
    for row, direction in enumerate(unit):
        near = [k for k, at in enumerate(first) if unit[at] @ direction > np.cos(_SAME_GRAVITY_RAD)]
        if not near:
            first.append(row)
        block[row] = near[0] if near else len(first) - 1
    visit = np.cumsum(np.diff(block, prepend=block[0]) != 0)
    visits = int(visit[-1]) + 1
    if apart and _FEWEST_BLOCKS <= visits <= _MOST_VISITS:
        return visit, tuple(f"visit {k + 1}" for k in range(visits))
    if _FEWEST_BLOCKS <= len(first) <= 0.5 * len(unit):
        names = [", ".join(f"{v:+.1f}" for v in unit[at] + 0.0) for at in first]
        return block, tuple(f"gravity along ({name})" for name in names)
    return np.arange(len(unit)), tuple(f"reading {k + 1}" for k in range(len(unit)))


def _floor_at_rest(run: _Stops) -> Floor:
    """Noise of means over windows in rest segments.

    Of autoregressive noise about a curve: with C its autocovariances, the mean of m samples has
    variance sum_ij C_|i-j| / m^2, and neighbouring means correlate alike.
    """
    table, segments = run.table, run.segments()
    assert table.time is not None
    if not segments:
        raise GalenError(f"{table.path}: no rest segment of {run.rest.min_duration_s:g} s in it")
    step_s = float(np.median(np.diff(table.time)))
    size = max(1, round(run.window_s / step_s))
    readings = [(table.time[segment], table.wrench[segment]) for segment in segments]
    noise = channel_noise(readings, max(_LONGEST_CURVE_S, 3.0 * run.window_s))
    if not noise:
        raise GalenError(f"{table.path}: every rest segment is too short to show its noise")
    variances = np.array([_of_means(channel, size) for channel in noise])
    together = float(np.clip(np.mean(variances[:, 1] / variances[:, 0]), 0.0, 0.99))
    std, source = np.sqrt(variances[:, 0]), "scatter within rest segments"
    if together < 0.02:
        return Floor(std, 0.0, 1.0, source)
    return Floor(std, 1.0, float(-size * step_s / np.log(together)), source)


def _of_means(noise: ChannelNoise, size: int) -> tuple[float, float]:
    """Variance of a mean of `size` samples, and covariance with the next such mean."""
    lags = noise.covariance(2 * size)
    apart = np.abs(np.arange(size)[:, None] - np.arange(2 * size)[None, :])
    sums = lags[apart].sum(axis=0) / size**2
    return float(sums[:size].sum()), float(sums[size:].sum())


def _floor_of_readings(table: OrientationTable, noise: Array | None) -> Floor | None:
    if noise is not None:
        return Floor(
            noise.std(axis=0, ddof=1), 0.0, 1.0, "one reading of the still recording (--noise)"
        )
    if table.rotation is None:
        return None
    turns = table.rotation.reshape(len(table), 9)
    apart = np.linalg.norm(turns[:, None] - turns[None, :], axis=2)
    twins = np.argwhere(np.triu(apart < _SAME_GRAVITY_RAD, 1))
    if len(twins) < _FEWEST_BLOCKS:
        return None
    difference = table.wrench[twins[:, 0]] - table.wrench[twins[:, 1]]
    std = np.sqrt(np.mean(difference**2, axis=0) / 2.0)
    return Floor(std, 0.0, 1.0, f"{len(twins)} pairs of readings in the same pose")
