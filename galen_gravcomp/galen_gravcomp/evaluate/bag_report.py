"""A bag's evaluation for a person, and for a program."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from galen_bags.arrays.stamp_check import StampReport
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_ros.stream.results import Notice
from rich.console import Console
from rich.table import Table

from galen_gravcomp.evaluate.bag_evaluation import BagEvaluation
from galen_gravcomp.evaluate.channel_check import describe_run
from galen_gravcomp.evaluate.residual_decomposition import Misfit
from galen_gravcomp.evaluate.verdict import Verdict

_UNITS = ("mN", "mN", "mN", "mN.m", "mN.m", "mN.m")
_WORST = 5
_EVENTS = 5
_RUNS = ("frozen", "stuck", "saturated")
_VERDICT_STYLE = {Verdict.FITS: "bold green", Verdict.UNKNOWN: "bold yellow"}


def print_evaluation(result: BagEvaluation, console: Console) -> None:
    """Tables for a person."""
    tool = result.tool
    console.print(
        f"[bold]{result.path}[/bold]: {result.duration_s:.1f} s, tool {tool.tool}"
        f" ({1e3 * tool.load.mass_kg:.1f} g, calibrated {tool.calibrated_at})",
        soft_wrap=True,
    )
    if result.motion:
        console.print(f"Inertial forces are taken off, with the inertia: {result.motion}")
    style = _VERDICT_STYLE.get(result.verdict, "bold red")
    console.print(f"[{style}]{result.sentence}[/{style}]", soft_wrap=True)
    console.print(_rmse_table(result))
    if result.misfit is not None:
        console.print(_parts_table(result.misfit))
        for line in _misfit_lines(result.misfit):
            console.print(line, soft_wrap=True)
    if len(result.phases):
        console.print(_worst_table(result))
    console.print(_stamps_table(result))
    for line in findings(result):
        console.print(f"[yellow]{line}[/yellow]", soft_wrap=True, highlight=False)


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
    misfit, phases = result.misfit, result.phases
    return {
        "bag": str(result.path),
        "tool": result.tool.tool,
        "motion": result.motion or None,
        "verdict": result.verdict.value,
        "sentence": result.sentence,
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
            "still": _by_axis(result.rmse_still),
            "still_phases": _by_axis(result.rmse_phases),
            "moving": _by_axis(result.rmse_moving),
            "noise": _by_axis(phases.noise),
            "limit": _by_axis(result.limits.axes),
        },
        "still_s": result.still_s,
        "still_phases": len(phases),
        "misfit": None if misfit is None else _misfit_dict(misfit),
        "load_change": None
        if result.change is None
        else {
            "time_s": (result.change.time_ns - result.start_ns) * 1e-9,
            "mass_kg": None if result.change.mass_kg is None else list(result.change.mass_kg),
            "offset_step": _by_axis(result.change.offset_step),
        },
        "worst_poses": [_phase_dict(result, int(k)) for k in result.worst_phases[:_WORST]],
        "stamps": {
            "joint_states": _stamps_dict(result.joint_stamps),
            "wrench_raw": _stamps_dict(result.wrench_stamps),
        },
        "channels": {
            "beyond_range": _by_axis(result.channels.beyond_range),
            "not_finite": _by_axis(result.channels.not_finite),
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
    table = Table(title=f"Does the file still fit?{where}", title_justify="left")
    table.add_column("bag", overflow="fold")
    for name in ("length, s", "out, %", "still N", "still mN.m", "moving N", "drift N/h"):
        table.add_column(name, justify="right")
    table.add_column("verdict")
    table.add_column("findings", justify="right")
    for name, row in zip(names, rows, strict=True):
        if "error" in row:
            table.add_row(name, *("-",) * 6, "[bold red]broken[/bold red]", "-")
            continue
        verdict = Verdict(row["verdict"])
        style = _VERDICT_STYLE.get(verdict, "bold red")
        received = row["wrenches"]["received"]
        out = 100.0 * row["wrenches"]["compensated"] / received if received else 0.0
        table.add_row(
            name,
            f"{row['duration_s']:.1f}",
            f"{out:.1f}",
            _largest(row["rmse"]["still_phases"], WRENCH_AXES[:3], 1.0, 4),
            _largest(row["rmse"]["still_phases"], WRENCH_AXES[3:], 1e3, 2),
            _largest(row["rmse"]["moving"], WRENCH_AXES[:3], 1.0, 3),
            _drift(row["misfit"]),
            f"[{style}]{verdict.value}[/{style}]",
            str(len(row["findings"])),
        )
    console.print(table)
    for name, row in zip(names, rows, strict=True):
        if "error" in row:
            console.print(f"[red]{row['error']}[/red]", soft_wrap=True, highlight=False)
        elif row["verdict"] != Verdict.FITS.value:
            console.print(f"{name}: {row['sentence']}", soft_wrap=True, highlight=False)


def _short_names(bags: list[str]) -> tuple[list[str], str]:
    """The bags' paths below the folder that they share, and that folder ("": they share none)."""
    folders = {os.path.dirname(bag) for bag in bags}  # noqa: PTH120 - as they were given
    try:
        folder = os.path.commonpath(folders)
    except ValueError:  # none at all, or some absolute and some not
        return bags, ""
    return [os.path.relpath(bag, folder) for bag in bags] if folder else bags, folder


def _drift(misfit: dict[str, Any] | None) -> str:
    """The largest rate, N/h, if it is more than noise: a short recording's is a large number."""
    if misfit is None or "drift" not in misfit["significant"]:
        return "-"
    return _largest(misfit["rate_per_hour"], WRENCH_AXES[:3], 1.0, 3)


def _rmse_table(result: BagEvaluation) -> Table:
    table = Table(
        title=f"Left over of {result.compensated} compensated wrenches, root mean square;"
        f" {len(result.phases)} still phases of {result.still_s:.1f} s in all",
        title_justify="left",
    )
    table.add_column("")
    for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True):
        table.add_column(f"{axis} ({unit})", justify="right")
    for name, values in (
        ("still phases' means", result.rmse_phases),
        ("limit of a fit", result.limits.axes),
        ("arm still, one reading", result.rmse_still),
        ("arm moving, one reading", result.rmse_moving),
        ("noise of one reading", result.phases.noise),
    ):
        table.add_row(name, *_cells(values))
    return table


def _parts_table(misfit: Misfit) -> Table:
    table = Table(
        title="What the still phases' left over is made of, root mean square", title_justify="left"
    )
    table.add_column("")
    for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True):
        table.add_column(f"{axis} ({unit})", justify="right")
    for name, values in (
        ("another load", misfit.load),
        ("an offset", misfit.offset),
        ("drift", misfit.drift),
        ("the rest", misfit.rest),
    ):
        if values is not None:
            table.add_row(name, *_cells(values))
    if misfit.rate_per_hour is not None and misfit.rate_std is not None:
        rates = misfit.rate_per_hour * 1e3
        stds = misfit.rate_std * 1e3
        table.add_section()
        table.add_row("drift, per hour", *(f"{value:.4g}" for value in rates))
        table.add_row("+-", *(f"{value:.2g}" for value in stds))
    return table


def _misfit_lines(misfit: Misfit) -> Iterator[str]:
    if misfit.load is not None:
        moment = ", ".join(f"{1e3 * value:+.2f}" for value in misfit.moment_kgm)
        yield (
            f"load less the file's: {1e3 * misfit.mass_kg:+.2f} +- {1e3 * misfit.mass_std_kg:.2f} g"
            f", first moment ({moment}) g.m"
        )
    elif misfit.why_no_load:
        yield f"another load: can't be told; {misfit.why_no_load}"
    if misfit.why_no_drift:
        yield f"drift: can't be told; {misfit.why_no_drift}"


def _worst_table(result: BagEvaluation) -> Table:
    table = Table(title="Worst still phases", title_justify="left")
    for name in ("at (s)", "for (s)", "roll (rad)", "tilt (rad)"):
        table.add_column(name, justify="right")
    for axis, unit in zip(WRENCH_AXES, _UNITS, strict=True):
        table.add_column(f"{axis} ({unit})", justify="right")
    table.add_column("")
    for k in result.worst_phases[:_WORST]:
        phase = _phase_dict(result, int(k))
        table.add_row(
            f"{phase['time_s']:.1f}",
            f"{phase['duration_s']:.1f}",
            f"{phase['roll_rad']:.3f}",
            f"{phase['tilt_rad']:.3f}",
            *_cells(result.phases.mean[k]),
            "" if phase["agrees"] else "stands out",
        )
    return table


def _stamps_table(result: BagEvaluation) -> Table:
    table = Table(
        title="Time stamps; delay: log time less stamp, least/mean/largest", title_justify="left"
    )
    table.add_column("topic")
    for name in (
        "messages", "rate (Hz)", "gaps", "missing", "jumps", "duplicates", "out of order",
        "delay (ms)",
    ):  # fmt: skip
        table.add_column(name, justify="right")
    for topic, stamps in zip(
        result.topics, (result.joint_stamps, result.wrench_stamps), strict=True
    ):
        low, mean, high = (1e3 * value for value in stamps.delay_s)
        table.add_row(
            topic,
            str(stamps.count),
            f"{stamps.rate_hz:.1f}",
            *map(
                str,
                (stamps.gaps, stamps.missing, stamps.jumps, stamps.duplicates, stamps.out_of_order),
            ),
            f"{low:.2f}/{mean:.2f}/{high:.2f}",
        )
    return table


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


def _misfit_dict(misfit: Misfit) -> dict[str, Any]:
    return {
        "load": _by_axis(misfit.load),
        "offset": _by_axis(misfit.offset),
        "drift": _by_axis(misfit.drift),
        "rest": _by_axis(misfit.rest),
        "offset_value": _by_axis(misfit.offset_value),
        "offset_std": _by_axis(misfit.offset_std),
        "rate_per_hour": _by_axis(misfit.rate_per_hour),
        "rate_std": _by_axis(misfit.rate_std),
        "mass_kg": _number(misfit.mass_kg),
        "mass_std_kg": _number(misfit.mass_std_kg),
        "moment_kgm": [_number(value) for value in misfit.moment_kgm],
        "moment_std_kgm": [_number(value) for value in misfit.moment_std_kgm],
        "phases_that_stand_out": int(np.count_nonzero(~misfit.used)),
        "why_no_load": misfit.why_no_load,
        "why_no_drift": misfit.why_no_drift,
        "significant": sorted(misfit.significant),
    }


def _phase_dict(result: BagEvaluation, k: int) -> dict[str, Any]:
    phases = result.phases
    return {
        "time_s": (int(phases.start_ns[k]) - result.start_ns) * 1e-9,
        "duration_s": int(phases.end_ns[k] - phases.start_ns[k]) * 1e-9,
        "roll_rad": float(phases.angles[k, 0]),
        "tilt_rad": float(phases.angles[k, 1]),
        "left_over": _by_axis(phases.mean[k]),
        "agrees": bool(result.misfit is None or result.misfit.used[k]),
    }


def _stamps_dict(stamps: StampReport) -> dict[str, Any]:
    low, mean, high = stamps.delay_s
    return {
        "messages": stamps.count,
        "rate_hz": _number(stamps.rate_hz),
        "period_s": _number(stamps.period_s),
        "longest_step_s": stamps.longest_step_s,
        "gaps": stamps.gaps,
        "missing": stamps.missing,
        "jumps": stamps.jumps,
        "duplicates": stamps.duplicates,
        "out_of_order": stamps.out_of_order,
        "unstamped": stamps.unstamped,
        "delay_s": {"min": _number(low), "mean": _number(mean), "max": _number(high)},
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


def _by_axis(values: Array | None) -> dict[str, Any] | None:
    """By axis; None when there is nothing to say."""
    if values is None or not np.all(np.isfinite(values)):
        return None
    return dict(zip(WRENCH_AXES, np.asarray(values).tolist(), strict=True))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _cells(values: Array) -> list[str]:
    return [f"{1e3 * value:.2f}" if np.isfinite(value) else "-" for value in values]


def _largest(values: dict[str, float] | None, axes: Any, factor: float, digits: int) -> str:
    if values is None:
        return "-"
    return f"{factor * max((values[axis] for axis in axes), key=abs):.{digits}f}"
