"""How well a load model fits a table's readings that it has not seen."""

from dataclasses import dataclass, field, replace

import numpy as np
from galen_bags.orientation_table import OrientationTable
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.identification import SingleLoad, identify_single_load
from galen_model.tool_file import ToolFile

from galen_gravcomp.cross_validation import MODELS, Score, contiguous_blocks, cross_validate
from galen_gravcomp.still_phases import StillSettings, still_phases

_FEWEST_READINGS = 4
_MOST_LEFT_OUT_ONE_BY_ONE = 200  # each takes a fit of all others


@dataclass(frozen=True)
class Evaluation:
    """What was found; scores by split, then by model."""

    table: OrientationTable
    source_rows: int
    phases: int | None
    fit: SingleLoad
    scores: dict[str, dict[str, Score]]
    scatter: Array | None
    tool: ToolFile | None = None
    tool_residuals: Array | None = None
    notes: list[str] = field(default_factory=list)


def average_still(
    table: OrientationTable, window_s: float, settings: StillSettings
) -> tuple[OrientationTable, Array]:
    """Averages of `window_s` within each still phase of a recording, and their scatter (6,).

    Each phase becomes a block of its own. Raises GalenError when the table has no increasing time
    or no still phase.
    """
    if table.time is None:
        raise GalenError(f"{table.path}: finding still phases needs a column t (s)")
    steps = np.diff(table.time)
    if np.any(steps <= 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        raise GalenError(
            f"{table.path}: time does not increase at reading {row + 1} "
            f"({table.time[row - 1]:.6f} s, then {table.time[row]:.6f} s)"
        )
    means: list[tuple[Array, Array, float, str]] = []
    variances = []
    for number, phase in enumerate(still_phases(table.time, table.gravity, settings)):
        time = table.time[phase]
        window = np.floor((time - time[0]) / window_s).astype(int)
        whole = [w for w in np.unique(window) if time[window == w][-1] - time[0] >= w * window_s]
        in_phase = []
        for index in whole:
            rows = np.arange(phase.start, phase.stop)[window == index]
            wrench = table.wrench[rows].mean(axis=0)
            in_phase.append(wrench)
            means.append(
                (table.gravity[rows].mean(axis=0), wrench, float(table.time[rows].mean()),
                 f"still phase {number + 1}")
            )  # fmt: skip
        if len(in_phase) > 1:
            variances.append(np.var(in_phase, axis=0, ddof=1))
    if not means:
        raise GalenError(f"{table.path}: no still phase of {settings.min_duration_s} s in it")
    gravity, wrench, time_of, label = zip(*means, strict=True)
    averaged = OrientationTable(
        table.path, np.array(gravity), np.array(wrench), np.array(time_of), np.array(label),
        table.orientation,
    )  # fmt: skip
    scatter = np.sqrt(np.mean(variances, axis=0)) if variances else np.full(6, np.nan)
    return averaged, scatter


def evaluate_table(
    table: OrientationTable,
    blocks: int | None = None,
    average_window_s: float | None = None,
    settings: StillSettings | None = None,
    tool: ToolFile | None = None,
) -> Evaluation:
    """Fit and score every model on a table; raises GalenError naming what stands in the way."""
    source_rows, phases, scatter = len(table), None, None
    notes = []
    if average_window_s is not None:
        table, scatter = average_still(table, average_window_s, settings or StillSettings())
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
    scores = {
        split: {name: cross_validate(table, groups, model) for name, model in MODELS.items()}
        for split, groups in splits.items()
    }
    fit = identify_single_load(table.gravity, table.wrench)
    if phases is not None and phases > 2:
        # averages within a phase share its error, so the residuals' own covariance is too small
        load = replace(fit.load, covariance=_jackknife(table))
        fit = replace(fit, load=load)
    if not fit.used.all():
        rows = ", ".join(str(row + 1) for row in np.flatnonzero(~fit.used))
        notes.append(f"the fit on all readings left out reading {rows}: off the common load")
    residuals = None if tool is None else table.wrench - tool.predict_under(table.gravity)
    return Evaluation(table, source_rows, phases, fit, scores, scatter, tool, residuals, notes)


def _jackknife(table: OrientationTable) -> Array:
    """Covariance (4, 4) of mass and centre, by leaving out each of G blocks.

    (G - 1) / G sum (x_g - mean) (x_g - mean)^T: Efron and Tibshirani, *An Introduction to the
    Bootstrap* (1993), eq. (11.5). Raises IdentificationError when a block can't be spared.
    """
    assert table.block is not None
    labels = np.unique(table.block)
    values = []
    for label in labels:
        kept = table.block != label
        load = identify_single_load(table.gravity[kept], table.wrench[kept]).load
        values.append(np.concatenate([[load.mass_kg], load.com_m]))
    spread = np.array(values) - np.mean(values, axis=0)
    return np.asarray((len(labels) - 1) / len(labels) * spread.T @ spread)
