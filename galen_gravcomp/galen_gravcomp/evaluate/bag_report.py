"""A bag's evaluation for a person, and for a program."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from galen_bags.arrays.stamp_check import StampReport
from galen_model.arm.galen import WRENCH_AXES
from galen_model.evidence.verdict import Cause
from galen_ros.stream.samples import Notice
from rich.console import Console
from rich.table import Table

from galen_gravcomp.evaluate.bag_evaluation import BagEvaluation
from galen_gravcomp.evaluate.channel_check import describe_run
from galen_gravcomp.evaluate.report import (
    UNITS,
    Report,
    axes_table,
    axis_cells,
    by_axis,
    number_or_none,
    table,
)
from galen_gravcomp.evaluate.residual_decomposition import ResidualParts

_WORST = 5
_EVENTS = 5
_RUNS = ("frozen", "stuck", "saturated")
_STYLES = {Cause.FITS.word: "bold green", Cause.UNKNOWN.word: "bold yellow"}


def report(result: BagEvaluation) -> Report:
    """Make the report of one bag; its picture is written by the job."""
    tool = result.tool
    style = _STYLES.get(result.verdict.cause.word, "bold red")
    shown: list[str | Table] = [
        f"[bold]{result.path}[/bold]: {result.duration_s:.1f} s, tool {tool.tool}"
        f" ({1e3 * tool.load.mass_kg:.1f} g, calibrated {tool.calibrated_at})"
    ]
    if result.motion:
        shown.append(f"Inertial forces are subtracted, with the inertia: {result.motion}")
    shown += [f"[{style}]{result.verdict.text}[/{style}]", _rmse_table(result)]
    if result.parts is not None:
        shown += [_parts_table(result.parts), *_parts_lines(result.parts)]
    if len(result.phases):
        shown.append(_worst_table(result))
    shown.append(_stamps_table(result))
    shown += [f"[yellow]{line}[/yellow]" for line in findings(result)]
    return Report(to_dict(result), shown)


def findings(result: BagEvaluation) -> list[str]:
    """What is wrong with the recording itself, a sentence each; empty if nothing is."""
    lines = [f"bag: {problem}" for problem in result.problems]
    for reason, count in result.rejected.items():
        example = result.rejected_example.get(reason, "")
        lines.append(f"not compensated, {reason}: {count} wrenches; {example}")
    lines += [
        f"{name.replace('_', ' ')}: {count}"
        for name, count in result.notices.items()
        if name != Notice.BEYOND_RANGE.value  # said below, axis by axis
    ]
    for topic, stamps in zip(
        result.topics, (result.joint_stamps, result.wrench_stamps), strict=True
    ):
        lines += _stamp_lines(topic, stamps)
    channels = result.channels
    if channels.held > 1:
        rate = result.wrench_stamps.rate_hz / channels.held
        lines.append(
            f"{result.topics[1]}: each reading comes about {channels.held} times: new ones come at"
            f" {rate:.0f} Hz"
        )
    for axis in range(6):
        if channels.not_finite[axis]:
            lines.append(f"{WRENCH_AXES[axis]}: {channels.not_finite[axis]} readings not finite")
        if channels.beyond_range[axis]:
            lines.append(
                f"{WRENCH_AXES[axis]}: {channels.beyond_range[axis]} readings at or beyond the"
                " sensor's range"
            )
    for verb in _RUNS:
        runs = getattr(channels, verb)
        lines += [describe_run(run, result.start_ns, verb) for run in runs[:_EVENTS]]
        if len(runs) > _EVENTS:
            lines.append(f"and {len(runs) - _EVENTS} more times {verb}")
    return lines


def to_dict(result: BagEvaluation) -> dict[str, Any]:
    """The evaluation as plain numbers, texts and lists; SI units, None where unknown."""
    parts, phases = result.parts, result.phases
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
            "noise": by_axis(phases.noise),
            "limit": by_axis(result.limits.axes),
        },
        "still_s": result.still_s,
        "still_phases": len(phases),
        "residual_decomposition": None if parts is None else _parts_dict(parts),
        "load_change": None
        if result.change is None
        else {
            "time_s": (result.change.time_ns - result.start_ns) * 1e-9,
            "mass_kg": None if result.change.mass_kg is None else list(result.change.mass_kg),
            "offset_step": by_axis(result.change.offset_step),
        },
        "worst_poses": [_phase_dict(result, int(k)) for k in result.worst_phases[:_WORST]],
        "stamps": {
            "joint_states": _stamps_dict(result.joint_stamps),
            "wrench_raw": _stamps_dict(result.wrench_stamps),
        },
        "channels": {
            "beyond_range": by_axis(result.channels.beyond_range),
            "not_finite": by_axis(result.channels.not_finite),
            "held": result.channels.held,
            **{kind: _runs(result, kind) for kind in _RUNS},
        },
        "findings": findings(result),
    }


def print_overview(rows: list[dict[str, Any]], console: Console) -> None:
    """One line a bag, and a sentence on each that does not fit.

    `rows`: from `to_dict`, or {"bag": ..., "error": ...}.
    """
    names, folder = _short_names([row["bag"] for row in rows])
    where = f" (bags in {folder})" if folder else ""
    made = Table(title=f"Does the file still fit?{where}", title_justify="left")
    made.add_column("bag", overflow="fold")
    for name in ("length, s", "out, %", "rest N", "rest mN.m", "moving N", "drift N/h"):
        made.add_column(name, justify="right")
    made.add_column("verdict")
    made.add_column("findings", justify="right")
    for name, row in zip(names, rows, strict=True):
        if "error" in row:
            made.add_row(name, *("-",) * 6, "[bold red]broken[/bold red]", "-")
            continue
        style = _STYLES.get(row["verdict"], "bold red")
        received = row["wrenches"]["received"]
        out = 100.0 * row["wrenches"]["compensated"] / received if received else 0.0
        made.add_row(
            name,
            f"{row['duration_s']:.1f}",
            f"{out:.1f}",
            _largest(row["rmse"]["still_phases"], WRENCH_AXES[:3], 1.0, 4),
            _largest(row["rmse"]["still_phases"], WRENCH_AXES[3:], 1e3, 2),
            _largest(row["rmse"]["moving"], WRENCH_AXES[:3], 1.0, 3),
            _drift(row["residual_decomposition"]),
            f"[{style}]{row['verdict']}[/{style}]",
            str(len(row["findings"])),
        )
    console.print(made)
    for name, row in zip(names, rows, strict=True):
        if "error" in row:
            console.print(f"[red]{row['error']}[/red]", soft_wrap=True, highlight=False)
        elif row["verdict"] != Cause.FITS.word:
            console.print(f"{name}: {row['sentence']}", soft_wrap=True, highlight=False)


def _short_names(bags: list[str]) -> tuple[list[str], str]:
    """The bags' paths below the folder that they share, and that folder ("": they share none)."""
    folders = {os.path.dirname(bag) for bag in bags}  # noqa: PTH120 - as they were given
    try:
        folder = os.path.commonpath(folders)
    except ValueError:  # none at all, or some absolute and some not
        return bags, ""
    return [os.path.relpath(bag, folder) for bag in bags] if folder else bags, folder


def _drift(parts: dict[str, Any] | None) -> str:
    """The largest rate, N/h, if it is more than noise: a short recording's is a large number."""
    if parts is None or "drift" not in parts["significant"]:
        return "-"
    return _largest(parts["rate_per_hour"], WRENCH_AXES[:3], 1.0, 3)


def _rmse_table(result: BagEvaluation) -> Table:
    made = axes_table(
        f"Residual of {result.compensated} compensated wrenches, root mean square;"
        f" {len(result.phases)} rest segments of {result.still_s:.1f} s in all"
    )
    for name, values in (
        ("rest segments' means", result.rmse_phases),
        ("limit of a fit", result.limits.axes),
        ("arm at rest, one reading", result.rmse_still),
        ("arm moving, one reading", result.rmse_moving),
        ("noise of one reading", result.phases.noise),
    ):
        made.add_row(name, *axis_cells(values))
    return made


def _parts_table(parts: ResidualParts) -> Table:
    made = axes_table("Parts of the rest segments' residual, root mean square")
    for name, values in (
        ("another load", parts.load),
        ("an offset", parts.offset),
        ("drift", parts.drift),
        ("unexplained", parts.rest),
    ):
        if values is not None:
            made.add_row(name, *axis_cells(values))
    if parts.rate_per_hour is not None and parts.rate_std is not None:
        made.add_section()
        made.add_row("drift, per hour", *(f"{1e3 * value:.4g}" for value in parts.rate_per_hour))
        made.add_row("+-", *(f"{1e3 * value:.2g}" for value in parts.rate_std))
    return made


def _parts_lines(parts: ResidualParts) -> Iterator[str]:
    if parts.load is not None:
        moment = ", ".join(f"{1e3 * value:+.2f}" for value in parts.moment_kgm)
        yield (
            f"load less the file's: {1e3 * parts.mass_kg:+.2f} +- {1e3 * parts.mass_std_kg:.2f} g"
            f", first moment ({moment}) g.m"
        )
    elif parts.why_no_load:
        yield f"another load: not identifiable; {parts.why_no_load}"
    if parts.why_no_drift:
        yield f"drift: not identifiable; {parts.why_no_drift}"


def _worst_table(result: BagEvaluation) -> Table:
    made = table(
        "Worst rest segments",
        ("at (s)", "for (s)", "roll (rad)", "tilt (rad)")
        + tuple(f"{axis} ({unit})" for axis, unit in zip(WRENCH_AXES, UNITS, strict=True))
        + ("",),
    )
    for k in result.worst_phases[:_WORST]:
        phase = _phase_dict(result, int(k))
        made.add_row(
            f"{phase['time_s']:.1f}",
            f"{phase['duration_s']:.1f}",
            f"{phase['roll_rad']:.3f}",
            f"{phase['tilt_rad']:.3f}",
            *axis_cells(result.phases.mean[k]),
            "" if phase["agrees"] else "outlier",
        )
    return made


def _stamps_table(result: BagEvaluation) -> Table:
    made = table(
        "Time stamps; delay: log time less stamp, least/mean/largest",
        (
            "topic", "messages", "rate (Hz)", "gaps", "missing", "jumps", "duplicates",
            "out of order", "delay (ms)",
        ),
    )  # fmt: skip
    for topic, stamps in zip(
        result.topics, (result.joint_stamps, result.wrench_stamps), strict=True
    ):
        low, mean, high = (1e3 * value for value in stamps.delay_s)
        made.add_row(
            topic,
            str(stamps.count),
            f"{stamps.rate_hz:.1f}",
            *map(
                str,
                (stamps.gaps, stamps.missing, stamps.jumps, stamps.duplicates, stamps.out_of_order),
            ),
            f"{low:.2f}/{mean:.2f}/{high:.2f}",
        )
    return made


def _stamp_lines(topic: str, stamps: StampReport) -> list[str]:
    lines = []
    if stamps.unstamped:
        lines.append(f"{topic}: {stamps.unstamped} messages without a stamp")
    for event in stamps.events[:_EVENTS]:
        lines.append(
            f"{topic}: {event.kind.replace('_', ' ')} at {event.time_s:.3f} s, a step of"
            f" {event.size_s:+.4f} s"
        )
    more = stamps.gaps + stamps.jumps + stamps.duplicates + stamps.out_of_order - _EVENTS
    if more > 0:
        lines.append(f"{topic}: and {more} more like these")
    return lines


def _parts_dict(parts: ResidualParts) -> dict[str, Any]:
    return {
        "load": by_axis(parts.load),
        "offset": by_axis(parts.offset),
        "drift": by_axis(parts.drift),
        "rest": by_axis(parts.rest),
        "offset_value": by_axis(parts.offset_value),
        "offset_std": by_axis(parts.offset_std),
        "rate_per_hour": by_axis(parts.rate_per_hour),
        "rate_std": by_axis(parts.rate_std),
        "mass_kg": number_or_none(parts.mass_kg),
        "mass_std_kg": number_or_none(parts.mass_std_kg),
        "moment_kgm": [number_or_none(value) for value in parts.moment_kgm],
        "moment_std_kgm": [number_or_none(value) for value in parts.moment_std_kgm],
        "outliers": int(np.count_nonzero(~parts.used)),
        "why_no_load": parts.why_no_load,
        "why_no_drift": parts.why_no_drift,
        "significant": sorted(parts.significant),
    }


def _phase_dict(result: BagEvaluation, k: int) -> dict[str, Any]:
    phases = result.phases
    return {
        "time_s": (int(phases.start_ns[k]) - result.start_ns) * 1e-9,
        "duration_s": int(phases.end_ns[k] - phases.start_ns[k]) * 1e-9,
        "roll_rad": float(phases.angles[k, 0]),
        "tilt_rad": float(phases.angles[k, 1]),
        "residual": by_axis(phases.mean[k]),
        "agrees": bool(result.parts is None or result.parts.used[k]),
    }


def _stamps_dict(stamps: StampReport) -> dict[str, Any]:
    low, mean, high = stamps.delay_s
    return {
        "messages": stamps.count,
        "rate_hz": number_or_none(stamps.rate_hz),
        "period_s": number_or_none(stamps.period_s),
        "longest_step_s": stamps.longest_step_s,
        "gaps": stamps.gaps,
        "missing": stamps.missing,
        "jumps": stamps.jumps,
        "duplicates": stamps.duplicates,
        "out_of_order": stamps.out_of_order,
        "unstamped": stamps.unstamped,
        "delay_s": {
            "min": number_or_none(low),
            "mean": number_or_none(mean),
            "max": number_or_none(high),
        },
        "events": [
            {"kind": event.kind, "time_s": event.time_s, "step_s": event.size_s}
            for event in stamps.events
        ],
    }


def _runs(result: BagEvaluation, kind: str) -> list[dict[str, Any]]:
    return [
        {
            "axis": "all" if run.axis is None else WRENCH_AXES[run.axis],
            "time_s": (run.start_ns - result.start_ns) * 1e-9,
            "duration_s": run.duration_s,
            "readings": run.count,
            "value": run.value,
        }
        for run in getattr(result.channels, kind)
    ]


def _largest(values: dict[str, float] | None, axes: Any, factor: float, digits: int) -> str:
    if values is None:
        return "-"
    return f"{factor * max((values[axis] for axis in axes), key=abs):.{digits}f}"
