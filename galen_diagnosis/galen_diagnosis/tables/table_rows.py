"""From a table of readings with orientations to blocks of rows: what noise is, what is held out.

A table with time is cut into its rest segments, blocks of averages over short windows. One without
time is a row a reading; readings under the same gravity, where there are such, are a block. The
load is fitted (mass, centre, constant part: what a calibration has) unless a file has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_bags.arrays.tables import OrientationTable, average_still
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.evidence.held_out import BlockRows, Columns, Effects
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.identification import plain_least_squares
from galen_model.load.model import Load, gravity_regressor
from galen_model.rest.segments import DirectionRest, rest_by_direction

from galen_diagnosis.observation.noise import ChannelNoise, channel_noise
from galen_diagnosis.tables.table_effects import TablePlant, table_effects

_FEWEST_BLOCKS = 4
_SAME_GRAVITY_RAD = 0.03
_WIDE = np.array([10.0, 1.0, 1.0, 1.0, *[100.0] * 3, *[10.0] * 3])
"""Mass (kg), first moments (kg.m), constants: nothing is known of them."""
_LONGEST_CURVE_S = 3.0
_NO_FLOOR = 1.0 / 30.0


@dataclass(frozen=True)
class Floor:
    """Noise of a row (6,), and how it correlates (`BlockRows`); where it is from."""

    std: Array
    alike: float
    memory_s: float
    source: str


def prepare_table(
    table: OrientationTable,
    noise: Array | None = None,
    tool: CalibrationFile | None = None,
    window_s: float = 1.0,
) -> tuple[BlockRows, Effects, tuple[str, ...]]:
    """Return rows and effects of a table, and notes on how they were made.

    noise (n, 6): readings of the same sensor, still and untouched. Raises GalenError where the
    table can't be used.
    """
    if table.time is not None and table.block is None:
        floor: Floor | None = _floor_at_rest(table, window_s)
        averaged, _ = average_still(table, window_s, DirectionRest())
        notes = [f"{len(averaged)} averages of {window_s:g} s in rest segments"]
    else:
        averaged, notes = table.timed(), [f"{len(table)} readings"]
        if table.time is None:
            notes.append("the order of readings is taken for time")
        floor = _floor_of_readings(averaged, noise)
    block, labels = _blocks(averaged)
    if len(labels) < _FEWEST_BLOCKS:
        raise GalenError(
            f"{table.path}: {len(labels)} blocks of readings; holding some out takes"
            f" {_FEWEST_BLOCKS}"
        )
    plant, nominal = _nominal(averaged, tool)
    residual = averaged.wrench - plant.reading()
    known = floor is not None
    if floor is None:
        spread = np.repeat([residual[:, :3].std(), residual[:, 3:].std()], 3)
        floor = Floor(_NO_FLOOR * spread, 0.0, 1.0, "not known")
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
    known_load, by_order = tool is not None, table.time is None
    effects = table_effects(plant, nominal, known_load=known_load, by_order=by_order)
    return rows, effects, tuple(notes)


def _load_columns(gravity: Array, prior: Array) -> Columns:
    """Return columns that are always fitted: moments and constants, by their prior (10,)."""
    values = np.zeros((len(gravity), 6, 10))
    values[:, :, :4] = gravity_regressor(gravity)
    values[:, :, 4:] = np.eye(6)
    return Columns(values * prior, {})


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
        weight = TablePlant(table.gravity, table.rotation, at_s, load, np.zeros(6)).reading()
        offset = (table.wrench - weight).mean(axis=0)
        only_constants = np.concatenate([np.zeros(4), _WIDE[4:]])
        columns = _load_columns(table.gravity, only_constants)
    return TablePlant(table.gravity, table.rotation, at_s, load, offset), columns


def _blocks(table: OrientationTable) -> tuple[np.ndarray, tuple[str, ...]]:
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
    if _FEWEST_BLOCKS <= len(first) <= 0.5 * len(unit):
        names = [", ".join(f"{v:+.1f}" for v in unit[at] + 0.0) for at in first]
        return block, tuple(f"gravity along ({name})" for name in names)
    return np.arange(len(unit)), tuple(f"reading {k + 1}" for k in range(len(unit)))


def _floor_at_rest(table: OrientationTable, window_s: float) -> Floor:
    """Noise of means over windows in rest segments.

    Of autoregressive noise about a curve: with C its autocovariances, the mean of m samples has
    variance sum_ij C_|i-j| / m^2, and neighbouring means correlate alike.
    """
    assert table.time is not None
    segments = rest_by_direction(table.time, table.gravity, DirectionRest())
    if not segments:
        shortest_s = DirectionRest().min_duration_s
        raise GalenError(f"{table.path}: no rest segment of {shortest_s:g} s in it")
    step_s = float(np.median(np.diff(table.time)))
    size = max(1, round(window_s / step_s))
    readings = [(table.time[segment], table.wrench[segment]) for segment in segments]
    noise = channel_noise(readings, max(_LONGEST_CURVE_S, 3.0 * window_s))
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
