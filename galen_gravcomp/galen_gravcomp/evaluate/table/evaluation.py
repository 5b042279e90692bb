"""How well a load model fits a table's readings that it has not seen."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from galen_bags.arrays.orientation_table import OrientationTable, average_still
from galen_model.arrays import Array
from galen_model.errors import GalenError, IdentificationError
from galen_model.evidence.block_gain import MOUNTED, Worth
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.drifting_identification import DriftingLoad
from galen_model.load.identification import SingleLoad, identify_single_load
from galen_model.load.mounting.identification import MountedLoad
from galen_model.rest.segments import DirectionRest

from galen_gravcomp.evaluate.table.cross_validation import (
    BLOCK_MODELS,
    MODELS,
    Model,
    Score,
    TableMounting,
    contiguous_blocks,
    cross_validate,
    identify_drifting,
    table_worth,
)

_FEWEST_READINGS = 4
_MOST_LEFT_OUT_ONE_BY_ONE = 200  # each takes a fit of all others


@dataclass(frozen=True)
class TableEvaluation:
    """What was found; scores by split, then by model."""

    table: OrientationTable
    source_rows: int
    phases: int | None
    fit: SingleLoad
    scores: dict[str, dict[str, Score]]
    scatter: Array | None
    tool: CalibrationFile | None = None
    tool_residuals: Array | None = None
    notes: list[str] = field(default_factory=list)
    mounted: MountedLoad | None = None
    worth: Worth | None = None
    drifting: DriftingLoad | None = None


def evaluate_table(
    table: OrientationTable,
    blocks: int | None = None,
    average_window_s: float | None = None,
    settings: DirectionRest | None = None,
    tool: CalibrationFile | None = None,
    mounting: TableMounting | None = None,
    bias_drift: bool = False,
) -> TableEvaluation:
    """Fit and score every model on a table; raises GalenError naming the obstacle.

    mounting: what to estimate beside the load, in a model of its own. bias_drift: also a model
    whose bias may drift, where blocks are held out.
    """
    source_rows, phases, scatter = len(table), None, None
    notes = []
    if average_window_s is not None:
        table, scatter = average_still(table, average_window_s, settings or DirectionRest())
        assert table.block is not None
        phases = len(np.unique(table.block))
    if len(table) < _FEWEST_READINGS:
        raise GalenError(
            f"{table.path}: {len(table)} readings; at least {_FEWEST_READINGS} are needed to hold"
            " some out"
        )
    splits: dict[str, np.ndarray] = {}
    if table.block is None:
        if len(table) <= _MOST_LEFT_OUT_ONE_BY_ONE:
            labels = [f"reading {i + 1}" for i in range(len(table))]
            splits["leave one reading out"] = np.array(labels)
        else:
            notes.append(
                f"leave one reading out: not done for {len(table)} readings, more than"
                f" {_MOST_LEFT_OUT_ONE_BY_ONE}; is it a recording (--average-s)?"
            )
        count = blocks or min(6, len(table) // 2)
        splits[f"{count} blocks of neighbours"] = np.array(
            [f"block {b + 1}" for b in contiguous_blocks(len(table), count)]
        )
    else:
        order = list(dict.fromkeys(table.block.tolist()))
        splits["leave one still phase out" if phases else "leave one block out"] = table.block
        count = blocks or min(3, len(order) // 2)
        if count >= 2:
            group = contiguous_blocks(len(order), count)
            of_label = {label: f"block {g + 1}" for label, g in zip(order, group, strict=True)}
            splits[f"{count} blocks of neighbours"] = np.array([of_label[b] for b in table.block])
    models = dict(MODELS)
    mounted = None
    if mounting is not None:
        mounted = mounting.identify(table)
        models[MOUNTED] = mounting.model
    scores = {
        split: {
            name: cross_validate(table, groups, model)
            for name, model in (
                models | (_block_models(table, groups) if bias_drift else {})
            ).items()
        }
        for split, groups in splits.items()
    }
    fit = identify_single_load(table.gravity, table.wrench)
    drifting = None
    try:
        drifting = identify_drifting(table.timed()) if bias_drift else None
    except IdentificationError as error:
        notes.append(f"with a bias that drifts: {error}")
    if phases is not None and phases > 2:
        # averages within a phase share its error, so the residuals' own covariance is too small
        load = replace(fit.load, covariance=_jackknife(table, _mass_and_centre))
        fit = replace(fit, load=load)
        if mounting is not None and mounted is not None:
            mounted = _jackknifed(mounted, mounting, table)
    worth = None
    if mounted is not None:  # the widest blocks that leave enough to tell the mounting
        found = (table_worth(scores[s], splits[s], mounted.single.sigma) for s in reversed(splits))
        worth = next((one for one in found if one is not None), None)
    if not fit.used.all():
        rows = ", ".join(str(row + 1) for row in np.flatnonzero(~fit.used))
        notes.append(f"the fit on all readings left out reading {rows}: off the common load")
    residuals = None if tool is None else table.wrench - table_prediction(tool, table)
    return TableEvaluation(
        table,
        source_rows,
        phases,
        fit,
        scores,
        scatter,
        tool,
        residuals,
        notes,
        mounted,
        worth,
        drifting,
    )


def _block_models(table: OrientationTable, groups: np.ndarray) -> dict[str, Model]:
    return BLOCK_MODELS if len(set(groups.tolist())) < len(table) else {}


def _mass_and_centre(table: OrientationTable) -> Array:
    load = identify_single_load(table.gravity, table.wrench).load
    return np.concatenate([[load.mass_kg], load.com_m])


def _jackknifed(
    mounted: MountedLoad, mounting: TableMounting, table: OrientationTable
) -> MountedLoad:
    """The same with covariances by leaving out each block."""

    def values(known: OrientationTable) -> Array:
        found = mounting.identify(known)
        load = found.single.load
        return np.concatenate([[load.mass_kg], load.com_m, found.mounting.vector])

    covariance = _jackknife(table, values)
    load = replace(mounted.single.load, covariance=covariance[:4, :4])
    return MountedLoad(
        replace(mounted.single, load=load),
        replace(mounted.mounting, covariance=covariance[4:, 4:]),
    )


def _jackknife(table: OrientationTable, estimate: Callable[[OrientationTable], Array]) -> Array:
    """Covariance (k, k) of what `estimate` (k,) finds, by leaving out each of G blocks.

    (G - 1) / G sum (x_g - mean) (x_g - mean)^T: Efron and Tibshirani, *An Introduction to the
    Bootstrap* (1993), eq. (11.5). Raises IdentificationError when a block can't be spared.
    """
    assert table.block is not None
    labels = np.unique(table.block)
    values = []
    for label in labels:
        values.append(estimate(table.take(table.block != label, None)))
    spread = np.array(values) - np.mean(values, axis=0)
    return np.asarray((len(labels) - 1) / len(labels) * spread.T @ spread)


def table_prediction(tool: CalibrationFile, table: OrientationTable) -> Array:
    """Reading (n, 6) that a tool's file expects at a table's orientations, its mounting included.

    Raises GalenError where the file's mounting needs what the table doesn't tell.
    """
    mounting = tool.mounting
    if mounting is None:
        return tool.predict_under(table.gravity)
    if np.any(mounting.joint_zero_rad):
        raise GalenError(f"{table.path}: {tool.tool} holds zeros of joints; a table has none")
    if not np.any(mounting.base_inclination_rad):
        return tool.predict_under(table.gravity)
    if table.rotation is None:
        raise GalenError(
            f"{table.path}: {tool.tool} holds an inclination of the base, which needs qx..qw,"
            " r11..r33 or roll, tilt"
        )
    return tool.predict_under(mounting.turned_gravity(table.gravity, table.rotation))
