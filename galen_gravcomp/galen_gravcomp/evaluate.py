"""`evaluate`: how well a load model fits readings that it has not seen."""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.orientation_table import OrientationTable, read_table
from galen_model.arm import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError, ToolFileError
from galen_model.identification import SingleLoad, identify_single_load
from galen_model.tool_file import ToolFile, read_tool, tool_path, write_tool
from rich.console import Console
from rich.table import Table

from galen_gravcomp.cross_validation import MODELS, Score, contiguous_blocks, cross_validate
from galen_gravcomp.still_phases import StillSettings, still_phases
from galen_gravcomp.table_tool import tool_from_table

EXIT_CODES = "exit codes: 0 done, 1 the table or tool can't be used (one line says why), 2 usage"
_FEWEST_READINGS = 4
_MOST_LEFT_OUT_ONE_BY_ONE = 200  # each takes a fit of all others
_SHOWN = np.array([1e3] * 6)  # N and N.m are printed as mN and mN.m
_UNITS = ("mN", "mN", "mN", "mN.m", "mN.m", "mN.m")


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
        split: {
            name: cross_validate(table.gravity, table.wrench, groups, model)
            for name, model in MODELS.items()
        }
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


def to_json(result: Evaluation) -> dict[str, Any]:
    """The evaluation for a program; SI units."""
    load = result.fit.load
    content: dict[str, Any] = {
        "table": result.table.path,
        "rows": result.source_rows,
        "readings": len(result.table),
        "still_phases": result.phases,
        "load": {
            "mass_kg": load.mass_kg,
            "com_m": load.com_m.tolist(),
            "covariance": load.covariance.tolist(),
            "weight_N": load.mass_kg * 9.80665,
        },
        "offset": result.fit.offset.tolist(),
        "left_out": (np.flatnonzero(~result.fit.used) + 1).tolist(),
        "scatter_within_phases": None if result.scatter is None else result.scatter.tolist(),
        "scores": {
            split: {
                name: {
                    "rmse": _by_axis(score.rmse),
                    "groups": score.groups,
                    "refused": list(score.refused),
                }
                for name, score in models.items()
            }
            for split, models in result.scores.items()
        },
    }
    if result.tool is not None and result.tool_residuals is not None:
        rmse = np.sqrt(np.mean(result.tool_residuals**2, axis=0))
        content["tool"] = {
            "name": result.tool.tool,
            "rmse": _by_axis(rmse),
        }
    return content


def _by_axis(rmse: Array) -> dict[str, float] | None:
    """By axis; None when there is nothing to score."""
    if not np.all(np.isfinite(rmse)):
        return None
    return dict(zip(WRENCH_AXES, rmse.tolist(), strict=True))


def print_report(result: Evaluation, console: Console) -> None:
    """Tables for a person."""
    load = result.fit.load
    source = f"{result.source_rows} rows"
    if result.phases is not None:
        source += f", {len(result.table)} averages in {result.phases} still phases"
    console.print(
        f"[bold]{result.table.path}[/bold]: {source}; orientation from {result.table.orientation}"
    )
    found = Table(title="Load, from all readings", title_justify="left")
    for name in ("", "value", "standard deviation"):
        found.add_column(name, justify="right" if name else "left")
    found.add_row("mass (g)", f"{load.mass_kg * 1e3:.2f}", f"{load.mass_std_kg * 1e3:.2f}")
    for axis, com, std in zip("xyz", load.com_m, load.com_std_m, strict=True):
        found.add_row(f"centre {axis} (mm)", f"{com * 1e3:.2f}", f"{std * 1e3:.2f}")
    console.print(found)
    scores = Table(
        title="Root mean square of what is left over on readings that the fit has not seen",
        title_justify="left",
    )
    scores.add_column("held out, model", no_wrap=True)
    for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True):
        scores.add_column(f"{axis} ({unit})", justify="right")
    for split, models in result.scores.items():
        scores.add_row(f"[bold]{split}[/bold]")
        for name, score in models.items():
            scores.add_row(f"  {name}", *_cells(score.rmse))
        scores.add_section()
    if result.tool is not None and result.tool_residuals is not None:
        rmse = np.sqrt(np.mean(result.tool_residuals**2, axis=0))
        scores.add_row(f"tool file {result.tool.tool}, no fit", *_cells(rmse))
    if result.scatter is not None:
        scores.add_row("scatter within still phases", *_cells(result.scatter))
    console.print(scores)
    for split, models in result.scores.items():
        for name, score in models.items():
            if score.refused:
                console.print(
                    f"[yellow]{split}, {name}: {len(score.refused)} of {score.groups} could not be "
                    f"scored; {score.refused[0]}[/yellow]"
                )
    for note in result.notes:
        console.print(f"[yellow]{note}[/yellow]")


def _cells(rmse: Array) -> list[str]:
    return [f"{value:.2f}" if np.isfinite(value) else "-" for value in rmse * _SHOWN]


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="evaluate",
        description="Fit a load to readings with orientations and score it on readings held out, "
        "beside the plain ten-parameter least squares.",
        epilog=EXIT_CODES,
    )
    parser.add_argument(
        "--table",
        required=True,
        metavar="FILE",
        help="text table: fx fy fz tx ty tz (N, N.m; a push reads positive in its direction) and "
        "one of gx gy gz | r11..r33 (R_base_sensor) | qx qy qz qw (sensor in base) | roll tilt; "
        "optional: t (s), block (label)",
    )
    parser.add_argument(
        "--columns",
        metavar="NAMES",
        help="comma-separated column names of a file without a first line of names; "
        "'-' for a column to skip",
    )
    parser.add_argument(
        "--wrench-frame",
        choices=("sensor", "base"),
        default="sensor",
        help="axes that the file's wrenches are written in (default: sensor)",
    )
    parser.add_argument(
        "--average-s",
        type=_positive,
        metavar="SECONDS",
        help="the table is a recording: find its still phases and average this long within them",
    )
    parser.add_argument(
        "--still-rate-rad-s",
        type=_positive,
        default=StillSettings.max_rate_rad_s,
        metavar="RATE",
        help="slower than this counts as still (default: %(default)s)",
    )
    parser.add_argument(
        "--still-min-s",
        type=_positive,
        default=StillSettings.min_duration_s,
        metavar="SECONDS",
        help="shortest still phase used, its rims cut off (default: %(default)s)",
    )
    parser.add_argument(
        "--blocks", type=int, metavar="N", help="blocks of neighbouring readings to hold out"
    )
    parser.add_argument("--tool", metavar="FILE", help="a tool's file to score beside the fits")
    parser.add_argument(
        "--write-tool",
        metavar="FILE",
        help="write the load from all readings as the tool's file <tools_dir>/<tool>.json; one "
        "load can't tell the adapter from the tool, and the file says so",
    )
    parser.add_argument("--plots", metavar="DIR", help="write the residuals' plot here")
    parser.add_argument("--json", action="store_true", help="print one JSON object (SI units)")
    return parser


def _positive(text: str) -> float:
    value = float(text)
    if not value > 0.0:
        raise argparse.ArgumentTypeError(f"{text} is not positive")
    return value


def run(arguments: argparse.Namespace, console: Console) -> None:
    """Do what the options ask; raises GalenError."""
    columns = arguments.columns.split(",") if arguments.columns else None
    written_tool = _written_tool(arguments.write_tool)
    table = read_table(arguments.table, columns, arguments.wrench_frame)
    tool = read_tool(arguments.tool) if arguments.tool else None
    settings = StillSettings(arguments.still_rate_rad_s, min_duration_s=arguments.still_min_s)
    result = evaluate_table(table, arguments.blocks, arguments.average_s, settings, tool)
    if written_tool is not None:
        write_tool(written_tool, tool_from_table(written_tool.stem, result.table, result.fit))
        if not arguments.json:
            console.print(f"tool file: {written_tool}")
    if arguments.plots:
        from galen_gravcomp.table_plots import plot_scores  # slow to import, so only when asked

        try:
            written = plot_scores(result, Path(arguments.plots))
        except OSError as error:
            raise GalenError(f"{arguments.plots}: can't be written: {error.strerror}") from error
        if not arguments.json:
            console.print(f"plot: {written}")
    if arguments.json:
        print(json.dumps(to_json(result), indent=2))
    else:
        print_report(result, console)


def _written_tool(file: str | None) -> Path | None:
    """The tool's file to write; its name must be one that a tool may have."""
    if file is None:
        return None
    path = Path(file)
    if path.suffix != ".json":
        raise ToolFileError(f"{path}: a tool's file is named <tool>.json")
    return tool_path(path.parent, path.stem)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = build_parser().parse_args(args)
    try:
        run(arguments, Console(width=None if sys.stdout.isatty() else 110))
    except GalenError as error:
        print(f"evaluate: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
