# SPDX-License-Identifier: Apache-2.0
"""From readings to blocks of rows and effects: a table with orientations, or one joint's runs.

A table with time is cut into its rest segments, blocks of averages over short windows. One without
time is a row a reading; readings under the same gravity, where there are such, are a block, and
with a reference each visit to it: what shows under one direction alone no other predicts. The
load is fitted (mass, centre, constant part: what a calibration has) unless a file has it.

Of a joint's two angles and torque, the lag is the motor's angle less the link's. Nominal is a rigid
gear: a constant, the encoders' zeros. What effects add to it is in `effects/transmission.py`;
plays, velocity and direction are those of `galen_model.transmission`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from galen_bags.arrays.tables import OrientationTable, average_still, without_repeats
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.evidence.held_out import BlockRows, Columns, Effects
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.identification import plain_least_squares
from galen_model.load.model import Load, gravity_regressor
from galen_model.play import PlayOperators
from galen_model.rest.segments import DirectionRest, rest_by_direction
from galen_model.transmission import TERMS, JointRun, Parts, Scales, design, noise_of
from scipy.stats import f as f_distribution

from galen_diagnosis.effects.registry import RECORDS
from galen_diagnosis.effects.table_data import JointTerms, TablePlant
from galen_diagnosis.observation.noise import ChannelNoise, channel_noise

_FEWEST_BLOCKS = 4
_LEAST_FREEDOM = 2
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
_NO_FLOOR = 1.0 / 300.0
_LEVELS = np.geomspace(1.0, 600.0, 14)
"""What a floor that is not known may be, over a 300th of the residual."""
_MOST_NOISE = 0.1
"""Of how forces change: what is more is not taken for noise."""


@dataclass(frozen=True)
class Floor:
    """Noise of a row (6,), and how it correlates (`BlockRows`); where it is from."""

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


def prepare_table(
    table: OrientationTable,
    noise: Array | None = None,
    tool: CalibrationFile | None = None,
    window_s: float = 1.0,
    references: Sequence[OrientationTable] = (),
) -> tuple[BlockRows, Effects, tuple[str, ...]]:
    """Return rows and effects of a table, and notes on how they were made.

    Args:
        table: n readings with orientations; one with time and without blocks is cut into its rest
            segments.
        noise: Readings of the same sensor, still and untouched, (m, 6), N and N.m, for the floor
            of a table that isn't cut; None where there are none. Not used with references.
        tool: File that has the load; None to fit it. Not used with references.
        window_s: How long an average in a rest segment is.
        references: Earlier tables of the same sensor and load: nominal is the load that fits them,
            the floor what it leaves of them.

    Returns:
        Rows in the sensor's frame, six channels; the ways in which effects show; sentences.

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
        notes.append("the order of readings is taken for time")
    block, labels = _blocks(averaged, apart=bool(references))
    if len(labels) < _FEWEST_BLOCKS:
        raise GalenError(
            f"{table.path}: {len(labels)} blocks of readings; holding some out takes"
            f" {_FEWEST_BLOCKS}"
        )
    if references:
        earlier = [_averaged(one, window_s) for one in references]
        plant, nominal, floor, expected = _nominal_since(averaged, earlier)
    else:
        plant, nominal = _nominal(averaged, tool)
        expected = plant.reading()
    residual = averaged.wrench - expected
    known = floor is not None
    if floor is None:
        spread = np.repeat([residual[:, :3].std(), residual[:, 3:].std()], 3)
        floor = Floor(_NO_FLOOR * spread, 0.0, 1.0, "not known")
        most = _MOST_NOISE * np.std(averaged.wrench[:, :3] - averaged.wrench[:, :3].mean(axis=0))
        levels = tuple(_LEVELS[_LEVELS * floor.std[0] < most].tolist())
    notes.append(f"floor: {floor.source}")
    rows = BlockRows(
        channels=WRENCH_AXES,
        units=("N", "N", "N", "N.m", "N.m", "N.m"),
        residual=residual,
        floor=floor.std,
        at_s=plant.at_s,
        block=block,
        labels=labels,
        alike=floor.alike,
        memory_s=floor.memory_s,
        floor_known=known,
        memories_s=(float("inf"), 1e-6),
    )
    if references:
        rows = replace(rows, levels=_levels(len(averaged), sum(map(len, earlier))))
    if not known:
        rows = replace(rows, levels=levels, memories_s=(float("inf"),))
    known_load = tool is not None or bool(references)
    plant = replace(plant, known_load=known_load, by_order=table.time is None)
    ways = {name: record.in_table(plant) for name, record in RECORDS.items()}
    for name, record in RECORDS.items():
        if record.needs == "motion":
            ways[name] = "rest segments have no motion"
    return rows, _shown(nominal, ways), tuple(notes)


def _shown(nominal: Columns, ways: Mapping[str, Sequence[Columns] | str]) -> Effects:
    """Return the effects that show, and sentences on those that can't; ways: or why they can't."""
    of: dict[str, Sequence[Columns]] = {}
    cannot: dict[str, list[str]] = {}
    for name, found in ways.items():
        if isinstance(found, str):
            cannot.setdefault(found, []).append(name)
        elif found:
            of[name] = found
    reasons = (f"{', '.join(names)}: {reason}" for reason, names in cannot.items())
    return Effects(nominal, of, tuple(reasons))


def _load_columns(gravity: Array, prior: Array) -> Columns:
    """Return columns that are always fitted: moments and constants, by their prior (10,)."""
    values = np.zeros((len(gravity), 6, 10))
    values[:, :, :4] = gravity_regressor(gravity)
    values[:, :, 4:] = np.eye(6)
    return Columns(values * prior, {})


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


def _levels(later: int, earlier: int) -> tuple[float, ...]:
    """Return how many times the floor of so many earlier readings later ones may scatter by chance.

    Of one variance, ratios of two estimates of it are F-distributed.
    """
    freedom = [max(count - 4, 1) for count in (later, earlier)]
    most = float(np.sqrt(f_distribution.ppf(0.975, *freedom)))
    return tuple(np.geomspace(1.0 / most, most, 5).tolist())


def _nominal_since(
    table: OrientationTable, earlier: Sequence[OrientationTable]
) -> tuple[TablePlant, Columns, Floor, Array]:
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
    alike, memory_s = _memory(residual, np.concatenate([_seconds(one) for one in earlier]), which)
    moments, _ = plain_least_squares(gravity, wrench)
    if not moments[0] > 0.0:
        raise GalenError(f"{earlier[0].path}: the load would weigh {moments[0]:.3g} kg")
    load = Load(float(moments[0]), moments[1:] / moments[0])
    expected = table.gravity @ fitted[:3]
    offset = (table.wrench - expected).mean(axis=0)
    source = f"what gravity leaves of {len(design)} readings of the reference"
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
    plant = TablePlant(table, table.time - table.time[0], load, offset)
    return plant, Columns(values, {}), floor, expected + offset


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


def _nominal(table: OrientationTable, tool: CalibrationFile | None) -> tuple[TablePlant, Columns]:
    assert table.time is not None
    at_s = table.time - table.time[0]
    if tool is None:
        moments, offset = plain_least_squares(table.gravity, table.wrench)
        if not moments[0] > 0.0:
            raise GalenError(
                f"{table.path}: the load would weigh {moments[0]:.3g} kg; does a push read"
                " positive in the direction of the push?"
            )
        load = Load(float(moments[0]), moments[1:] / moments[0])
        columns = _load_columns(table.gravity, _WIDE)
    else:
        loads = [Load(of.mass_kg, np.asarray(of.com_m)) for of in (tool.load, tool.adapter)]
        total = loads[0].moments + loads[1].moments
        load = Load(float(total[0]), total[1:] / total[0])
        weight = TablePlant(table, at_s, load, np.zeros(6)).reading()
        offset = (table.wrench - weight).mean(axis=0)
        only_constants = np.concatenate([np.zeros(4), _WIDE[4:]])
        columns = _load_columns(table.gravity, only_constants)
    return TablePlant(table, at_s, load, offset), columns


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


# A joint's runs

_MOST_ROWS = 700
_GAPS = np.geomspace(0.08, 2.2, 14)
"""Thresholds of plays of the motion over half of the lag's range."""
_APART_S = 1e4
_VELOCITY_WINDOW_S = 0.1


def prepare_joint(
    runs: Sequence[JointRun], parts: Parts
) -> tuple[BlockRows, Effects, tuple[str, ...]]:
    """Return rows and effects of a joint's runs, and notes on how they were made.

    Args:
        runs: Angles at both ends, rad, torque, N.m, and time, s.
        parts: Parts of the runs; a part is a block.

    Returns:
        Rows of one channel, the lag, rad; the ways in which effects show; sentences.

    """
    every = [np.ones(len(run), dtype=bool) for run in runs]
    scales = Scales.of(runs, every, _VELOCITY_WINDOW_S)
    gaps = scales.lag_half_range * _GAPS
    terms = np.concatenate([design(run, scales) for run in runs])
    lost = np.concatenate([_lost(run, gaps) for run in runs])
    lag = np.concatenate([run.lag for run in runs])
    torque_rate = np.concatenate([np.gradient(run.torque, run.time_s) for run in runs])
    at_s = np.concatenate([run.time_s + k * _APART_S for k, run in enumerate(runs)])
    label = np.concatenate(parts.label)
    window, size = _windows(runs, label)
    count = np.bincount(window)

    def mean(values: Array) -> Array:
        sums = np.zeros((len(count), *values.shape[1:]))
        np.add.at(sums, window, values)
        return sums / count.reshape(-1, *[1] * (values.ndim - 1))

    noise = noise_of(list(runs))
    floor = float(np.hypot(noise.quantisation, noise.jitter / np.sqrt(size)))
    wide = 100.0 * scales.lag_half_range
    residual = mean(lag)[:, None]
    step_s = size * runs[0].step_s
    span_s = sum(float(run.time_s[-1] - run.time_s[0]) for run in runs) / len(parts.names)
    rows = BlockRows(
        channels=("lag",),
        units=("rad",),
        residual=residual - residual.mean(),
        floor=np.array([max(floor, 1e-9 * scales.lag_half_range)]),
        at_s=mean(at_s),
        block=np.round(mean(label.astype(float))).astype(int),
        labels=parts.names,
        memories_s=(2.0 * step_s, max(span_s / 10.0, 4.0 * step_s), span_s),
    )
    constant = Columns(wide * np.ones((len(residual), 1, 1)), {})
    notes = (
        f"{len(residual)} means over {size} readings of {len(runs)} runs",
        "floor: encoders' steps and the lag's jitter",
    )
    column = dict(zip(TERMS, mean(terms).T, strict=True))
    data = JointTerms(residual[:, 0], column, mean(torque_rate), mean(lost), gaps, scales)
    ways = {name: record.in_joint_runs(data) for name, record in RECORDS.items()}
    return rows, _shown(constant, ways), notes


def _windows(runs: Sequence[JointRun], label: np.ndarray) -> tuple[np.ndarray, int]:
    """Of each reading its window, which stays within a run and a part; readings in one."""
    total = sum(len(run) for run in runs)
    size = max(1, -(-total // _MOST_ROWS))
    run_of = np.concatenate([np.full(len(run), k) for k, run in enumerate(runs)])
    place = np.concatenate([np.arange(len(run)) for run in runs])
    edges = [0, *(np.flatnonzero((np.diff(run_of) != 0) | (np.diff(label) != 0)) + 1), total]
    window = np.zeros(total, dtype=int)
    first = 0
    for start, end in pairwise(edges):
        window[start:end] = first + (place[start:end] - place[start]) // size
        first = window[end - 1] + 1
    return window, size


def _lost(run: JointRun, thresholds: Array) -> Array:
    """Return what each play of the motion leaves behind (n, p), rad; from amid the gap."""
    motion = np.repeat((run.motor - run.motor[0])[:, None], len(thresholds), axis=1)
    return np.asarray(motion - PlayOperators(thresholds).run(motion).output)
