# SPDX-License-Identifier: Apache-2.0
"""A bag's evaluation for a person, and for a program."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from galen_bags.arrays.timeline import StampReport
from galen_common.stream.samples import Notice
from galen_model.arm.galen import WRENCH_AXES
from galen_model.load.verdict import Cause
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from galen_gravcomp.evaluate.bag import BagEvaluation
from galen_gravcomp.evaluate.channel_check import RUNS, describe_run
from galen_gravcomp.evaluate.report import (
    Report,
    axes_table,
    axis_cells,
    by_axis,
    number_or_none,
    table,
)

RESULT_VERSION = 1
"""To be raised where `to_json` changes: kept results of before are then not taken for today's."""
_WORST = 5
_EVENTS = 5
_STYLES = {Cause.FITS.word: "bold green", Cause.UNKNOWN.word: "bold yellow"}
_RMSE = {
    "still_phases": "rest segments' means",
    "limit": "limit of a fit",
    "still": "arm at rest, one reading",
    "moving": "arm moving, one reading",
    "noise": "noise of one reading",
}
_PARTS = {"load": "another load", "offset": "an offset", "drift": "drift", "rest": "unexplained"}
_STAMP_COUNTS = ("gaps", "missing", "jumps", "duplicates", "out_of_order")


def report(result: BagEvaluation) -> Report:
    """Make the report of one bag; its picture is written by the job.

    Args:
        result: the bag's evaluation.

    Returns:
        The report, without a plot.

    """
    content = to_json(result)
    tool = result.tool
    shown: list[str | Table] = [
        f"[bold]{escape(str(result.path))}[/bold]: {result.duration_s:.1f} s, tool"
        f" {escape(tool.tool)} ({1e3 * tool.load.mass_kg:.1f} g,"
        f" calibrated {escape(tool.calibrated_at)})"
    ]
    if result.motion:
        shown.append(f"Inertial forces are subtracted, with the inertia: {escape(result.motion)}")
    style = _STYLES.get(content["verdict"], "bold red")
    residual = axes_table(
        f"Residual of {result.compensated} compensated wrenches, root mean square;"
        f" {len(result.phases)} rest segments of {result.still_s:.1f} s in all"
    )
    for key, name in _RMSE.items():
        residual.add_row(name, *axis_cells(content["rmse"][key]))
    shown += [f"[{style}]{escape(result.verdict.text)}[/{style}]", residual]
    if content["residual_decomposition"] is not None:
        shown += _parts(content["residual_decomposition"])
    if content["worst_poses"]:
        shown.append(_worst(content["worst_poses"]))
    shown.append(_stamps(content["stamps"]))
    shown += [f"[yellow]{escape(line)}[/yellow]" for line in content["findings"]]
    return Report(content, shown)


def to_json(result: BagEvaluation) -> dict[str, Any]:
    """Return the evaluation as plain numbers, texts and lists.

    Args:
        result: the bag's evaluation.

    Returns:
        Content for JSON; SI units, None where unknown.

    """
    change = result.change
    return {
        "bag": str(result.path),
        "tool": result.tool.tool,
        "motion": result.motion or None,
        "verdict": result.verdict.cause.word,
        "sentence": result.verdict.text,
        "duration_s": result.duration_s,
        "topics": {"joint_states": result.topics[0], "wrench_raw": result.topics[1]},
        "wrenches": {
            "received": result.received,
            "compensated": result.compensated,
            "waiting_at_end": result.waiting,
            "rejected": result.rejected,
        },
        "notices": result.notices,
        "rmse": {
            "still": by_axis(result.rmse_still),
            "still_phases": by_axis(result.rmse_phases),
            "moving": by_axis(result.rmse_moving),
            "noise": by_axis(result.phases.noise),
            "limit": by_axis(result.limits.axes),
        },
        "still_s": result.still_s,
        "still_phases": len(result.phases),
        "residual_decomposition": None if result.parts is None else result.parts.to_json(),
        "load_change": None
        if change is None
        else {
            "time_s": (change.time_ns - result.start_ns) * 1e-9,
            "mass_kg": None if change.mass_kg is None else list(change.mass_kg),
            "offset_step": by_axis(change.offset_step),
        },
        "worst_poses": [_phase(result, int(k)) for k in result.worst_phases[:_WORST]],
        "stamps": {
            topic: {
                "messages": stamps.count,
                "rate_hz": number_or_none(stamps.rate_hz),
                **{name: getattr(stamps, name) for name in (*_STAMP_COUNTS, "unstamped")},
                "delay_s": [number_or_none(value) for value in stamps.delay_s],
            }
            for topic, stamps in (
                ("joint_states", result.joint_stamps),
                ("wrench_raw", result.wrench_stamps),
            )
        },
        "findings": list(_findings(result)),
    }


COLUMNS = {
    **dict.fromkeys(("verdict", "sentence", "tool"), "string"),
    **dict.fromkeys(("duration_s", "still_s"), "float64"),
    **dict.fromkeys(
        ("still_phases", "wrenches_received", "wrenches_compensated", "findings"), "int64"
    ),
    **dict.fromkeys(("joint_states_rate_hz", "wrench_raw_rate_hz"), "float64"),
    **{
        f"rmse_{part}_{axis}_{'N' if axis in WRENCH_AXES[:3] else 'Nm'}": "float64"
        for part in ("still_phases", "still", "moving", "noise")
        for axis in WRENCH_AXES
    },
    **{
        f"drift_{axis}_{'N' if axis in WRENCH_AXES[:3] else 'Nm'}_per_h": "float64"
        for axis in WRENCH_AXES
    },
    "drift_is_significant": "bool_",
    "load_error_kg": "float64",
    "load_error_std_kg": "float64",
}
"""The table of an archive: a row a bag, SI units, null where unknown; types as pyarrow's."""


def to_row(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of `COLUMNS`.

    Args:
        content: as `to_json` returns it.

    Returns:
        Values by column, None where unknown.

    """
    parts = content["residual_decomposition"] or {}
    groups = {f"rmse_{name}": values for name, values in content["rmse"].items()}
    groups["drift"] = parts.get("rate_per_hour")
    row = {name: content[name] for name in ("verdict", "sentence", "tool", "duration_s", "still_s")}
    row |= {
        "still_phases": content["still_phases"],
        "wrenches_received": content["wrenches"]["received"],
        "wrenches_compensated": content["wrenches"]["compensated"],
        "findings": len(content["findings"]),
        "drift_is_significant": "drift" in parts["significant"] if parts else None,
        "load_error_kg": parts.get("mass_kg"),
        "load_error_std_kg": parts.get("mass_std_kg"),
    }
    row |= {f"{topic}_rate_hz": stamps["rate_hz"] for topic, stamps in content["stamps"].items()}
    for group, values in groups.items():
        ending = "_per_h" if group == "drift" else ""
        for number, axis in enumerate(WRENCH_AXES):
            unit = "N" if number < 3 else "Nm"
            row[f"{group}_{axis}_{unit}{ending}"] = values and values[axis]
    return row


def print_overview(rows: list[dict[str, Any]], console: Console) -> None:
    """Print one line a bag, and a sentence on each that does not fit.

    Args:
        rows: from `to_json`, or {"bag": ..., "error": ...}.
        console: console to print to.

    """
    names, folder = _short_names([row["bag"] for row in rows])
    names = [escape(name) for name in names]
    where = f" (bags in {escape(folder)})" if folder else ""
    heads = ("length, s", "out, %", "rest N", "rest mN.m", "moving N", "drift N/h")
    made = table(f"Does the file still fit?{where}", ("bag", *heads, "verdict", "findings"))
    for name, row in zip(names, rows, strict=True):
        if "error" in row:
            made.add_row(name, *("-",) * 6, "[bold red]broken[/bold red]", "-")
            continue
        style = _STYLES.get(row["verdict"], "bold red")
        received = row["wrenches"]["received"]
        out = 100.0 * row["wrenches"]["compensated"] / received if received else 0.0
        parts = row["residual_decomposition"]
        # A short recording's rate is a large number that noise makes.
        drifts = parts is not None and "drift" in parts["significant"]
        made.add_row(
            name,
            f"{row['duration_s']:.1f}",
            f"{out:.1f}",
            _largest(row["rmse"]["still_phases"], WRENCH_AXES[:3], 1.0, 4),
            _largest(row["rmse"]["still_phases"], WRENCH_AXES[3:], 1e3, 2),
            _largest(row["rmse"]["moving"], WRENCH_AXES[:3], 1.0, 3),
            _largest(parts["rate_per_hour"], WRENCH_AXES[:3], 1.0, 3) if drifts else "-",
            f"[{style}]{row['verdict']}[/{style}]",
            str(len(row["findings"])),
        )
    console.print(made)
    for name, row in zip(names, rows, strict=True):
        if "error" in row:
            console.print(f"[red]{escape(row['error'])}[/red]", soft_wrap=True, highlight=False)
        elif row["verdict"] != Cause.FITS.word:
            console.print(f"{name}: {escape(row['sentence'])}", soft_wrap=True, highlight=False)


def _short_names(bags: list[str]) -> tuple[list[str], str]:
    folders = {os.path.dirname(bag) for bag in bags}  # noqa: PTH120 - as they were given
    try:
        folder = os.path.commonpath(folders)
    except ValueError:  # none at all, or some absolute and some not
        return bags, ""
    short = [os.path.relpath(bag, folder) for bag in bags] if folder else bags
    return short, re.sub(r"^(\w+):/(?!/)", r"\1://", folder)


def _largest(values: dict[str, float] | None, axes: Any, factor: float, digits: int) -> str:
    if values is None:
        return "-"
    return f"{factor * max((values[axis] for axis in axes), key=abs):.{digits}f}"


def _parts(parts: Mapping[str, Any]) -> list[str | Table]:
    made = axes_table("Parts of the rest segments' residual, root mean square")
    for key, name in _PARTS.items():
        if parts[key] is not None:
            made.add_row(name, *axis_cells(parts[key]))
    if parts["rate_per_hour"] is not None:
        made.add_section()
        rates = (("drift, per hour", "rate_per_hour", ".4g"), ("+-", "rate_std", ".2g"))
        for name, key, digits in rates:
            made.add_row(name, *(f"{1e3 * value:{digits}}" for value in parts[key].values()))
    shown: list[str | Table] = [made]
    if parts["mass_kg"] is not None:
        moment = ", ".join(f"{1e3 * value:+.2f}" for value in parts["moment_kgm"])
        shown.append(
            f"load less the file's: {1e3 * parts['mass_kg']:+.2f} +-"
            f" {1e3 * parts['mass_std_kg']:.2f} g, first moment ({moment}) g.m"
        )
    if parts["why_no_load"]:
        shown.append(f"another load: not identifiable; {parts['why_no_load']}")
    if parts["why_no_drift"]:
        shown.append(f"drift: not identifiable; {parts['why_no_drift']}")
    return shown


def _phase(result: BagEvaluation, k: int) -> dict[str, Any]:
    phases = result.phases
    angles = zip(result.tool.arm.turning_names, phases.angles[k].tolist(), strict=True)
    return {
        "time_s": (int(phases.start_ns[k]) - result.start_ns) * 1e-9,
        "duration_s": int(phases.end_ns[k] - phases.start_ns[k]) * 1e-9,
        "angles_rad": dict(angles),
        "residual": by_axis(phases.mean[k]),
        "agrees": bool(result.parts is None or result.parts.used[k]),
    }


def _worst(phases: list[dict[str, Any]]) -> Table:
    names = list(phases[0]["angles_rad"])
    heads = [f"{name} (rad)" for name in names] if len(names) <= 2 else ["revolute joints (rad)"]
    made = axes_table("Worst rest segments", "at (s)", ("for (s)", *heads))
    made.add_column("")
    for phase in phases:
        angles = phase["angles_rad"].values()
        made.add_row(
            f"{phase['time_s']:.1f}",
            f"{phase['duration_s']:.1f}",
            *(
                [f"{angle:.3f}" for angle in angles]
                if len(names) <= 2
                else [" ".join(f"{angle:.2f}" for angle in angles)]
            ),
            *axis_cells(phase["residual"]),
            "" if phase["agrees"] else "outlier",
        )
    return made


def _stamps(content: Mapping[str, Any]) -> Table:
    names = tuple(name.replace("_", " ") for name in _STAMP_COUNTS)
    made = table(
        "Time stamps; delay: log time less stamp, least/mean/largest",
        ("topic", "messages", "rate (Hz)", *names, "delay (ms)"),
    )
    for topic, stamps in content.items():
        rate, delay = stamps["rate_hz"], stamps["delay_s"]
        made.add_row(
            escape(topic),
            str(stamps["messages"]),
            "-" if rate is None else f"{rate:.1f}",
            *(str(stamps[name]) for name in _STAMP_COUNTS),
            "/".join("-" if value is None else f"{1e3 * value:.2f}" for value in delay),
        )
    return made


def _findings(result: BagEvaluation) -> Iterator[str]:
    for problem in result.problems:
        yield f"bag: {problem}"
    for reason, count in result.rejected.items():
        example = result.rejected_example.get(reason, "")
        yield f"not compensated, {reason}: {count} wrenches; {example}"
    for name, count in result.notices.items():
        if name != Notice.BEYOND_RANGE.value:  # below, axis by axis
            yield f"{name.replace('_', ' ')}: {count}"
    for topic, stamps in zip(
        result.topics, (result.joint_stamps, result.wrench_stamps), strict=True
    ):
        yield from _stamp_findings(topic, stamps)
    channels = result.channels
    if channels.held > 1:
        rate = result.wrench_stamps.rate_hz / channels.held
        yield (
            f"{result.topics[1]}: each reading comes about {channels.held} times: new ones come at"
            f" {rate:.0f} Hz"
        )
    for counts, what in (
        (channels.not_finite, "not finite"),
        (channels.beyond_range, "at or beyond the sensor's range"),
    ):
        for axis in np.flatnonzero(counts):
            yield f"{WRENCH_AXES[axis]}: {counts[axis]} readings {what}"
    for verb in RUNS:
        runs = getattr(channels, verb)
        for run in runs[:_EVENTS]:
            yield describe_run(run, result.start_ns, verb)
        if len(runs) > _EVENTS:
            yield f"and {len(runs) - _EVENTS} more times {verb}"


def _stamp_findings(topic: str, stamps: StampReport) -> Iterator[str]:
    if stamps.unstamped:
        yield f"{topic}: {stamps.unstamped} messages without a stamp"
    for kind, time_s, size_s in stamps.events[:_EVENTS]:
        yield f"{topic}: {kind.replace('_', ' ')} at {time_s:.3f} s, a step of {size_s:+.4f} s"
    more = stamps.gaps + stamps.jumps + stamps.duplicates + stamps.out_of_order - _EVENTS
    if more > 0:
        yield f"{topic}: and {more} more like these"
