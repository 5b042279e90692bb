"""Tools' files for a person, as tables, and for a program, as plain numbers and texts (SI)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from galen_model.arm.galen import JOINT_NAMES, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.calibration_file import LoadEstimate, age_text
from galen_model.files.calibration_store import Entry, StoredCalibration
from galen_model.files.comparison import CalibrationComparison, three_digits
from galen_model.load.frames import SensorInFrame
from rich.console import Console
from rich.markup import escape
from rich.table import Table

# A list


def list_to_dict(tools_dir: str, entries: Sequence[Entry], removed: Sequence[str]) -> dict:
    """A directory's tools; what is broken has its reason and nothing else."""
    return {
        "tools_dir": tools_dir,
        "tools": [
            {"tool": entry.name, "problem": entry.problem}
            if entry.stored is None
            else {
                "tool": entry.name,
                "problem": None,
                "mass_kg": float(entry.stored.tool.load.mass_kg),
                "mass_std_kg": entry.stored.tool.load.mass_std_kg,
                "com_m": _list(entry.stored.tool.load.com_m),
                "calibrated_at": entry.stored.tool.calibrated_at,
                "parts": list(entry.stored.tool.parts),
                "unresolved": list(entry.stored.tool.unresolved),
            }
            for entry in entries
        ],
        "removed": list(removed),
    }


def print_list(
    tools_dir: str, entries: Sequence[Entry], removed: Sequence[str], console: Console
) -> None:
    """A row for each tool, then what is broken and what was removed."""
    good = [(entry.name, entry.stored.tool) for entry in entries if entry.stored is not None]
    count = f"{len(good)} tool{'' if len(good) == 1 else 's'}"
    table = Table(title=f"{escape(tools_dir)}: {count}", title_justify="left")
    table.add_column("tool", no_wrap=True)
    for name in ("mass, g", "centre in ft_sensor, mm"):
        table.add_column(name, justify="right", no_wrap=True)
    for name in ("calibrated", "poses", "parts"):
        table.add_column(name)
    for name, tool in good:
        table.add_row(
            name,
            _mass(tool.load),
            _millimetres(tool.load.com_m),
            age_text(tool.calibrated_at),
            str(tool.poses_used),
            ", ".join((*tool.parts, *(("one sweep",) if tool.unresolved else ()))),
        )
    console.print(table)
    for entry in entries:
        if entry.problem:
            text = f"can't be used: {escape(entry.problem)}"
            console.print(f"[red]{text}[/red]", soft_wrap=True, highlight=False)
    if removed:
        console.print(f"removed, and can be restored: {', '.join(removed)}", soft_wrap=True)


# One tool


def tool_to_dict(stored: StoredCalibration, place: SensorInFrame, joints: Array) -> dict[str, Any]:
    """One tool; mass, centres, tip and covariances in the frame of `place`."""
    tool = stored.tool
    return {
        "tool": tool.tool,
        "path": str(stored.path),
        "sha256": stored.sha256,
        "frame": place.frame,
        "joints": [None if math.isnan(value) else float(value) for value in joints],
        "load": _load_dict(place.load(tool.load)),
        "adapter": _load_dict(place.load(tool.adapter)),
        "tip_m": _list(place.point(tool.tip_m)),
        "residual_offset": _list(tool.residual_offset),
        "rmse": _list(tool.rmse),
        "poses_used": tool.poses_used,
        "poses_rejected": list(tool.poses_rejected),
        "calibrated_at": tool.calibrated_at,
        "unresolved": list(tool.unresolved),
        "parts": {part: getattr(tool, part).to_json() for part in tool.parts},
    }


def print_tool(
    stored: StoredCalibration, place: SensorInFrame, joints: Array, console: Console
) -> None:
    """One tool, its optional parts, and what its calibration could not tell."""
    tool = stored.tool
    console.print(f"[bold]{tool.tool}[/bold]: {escape(str(stored.path))}", soft_wrap=True)
    known = [
        f"{name} {value:g}"
        for name, value in zip(JOINT_NAMES, joints, strict=True)
        if math.isfinite(value)
    ]
    at = f" at {', '.join(known)}" if known else ""
    table = Table("", "mass, g", f"centre in {place.frame}{at}, mm", "standard deviation, mm")
    for name, load in (("tool", tool.load), ("adapter", tool.adapter)):
        moved = place.load(load)
        table.add_row(name, _mass(load), _millimetres(moved.com_m), _millimetres(moved.com_std_m))
    table.add_row("tip", "", _millimetres(place.point(tool.tip_m)), "")
    console.print(table)
    rejected = f", {len(tool.poses_rejected)} rejected" if tool.poses_rejected else ""
    console.print(
        f"calibrated {tool.calibrated_at}, {age_text(tool.calibrated_at)}, in {tool.poses_used}"
        f" poses{rejected}",
        soft_wrap=True,
        highlight=False,
    )
    wrenches = Table("in ft_sensor, mN and mN.m", *WRENCH_AXES)
    for name, values in (("offset left", tool.residual_offset), ("RMSE", tool.rmse)):
        wrenches.add_row(name, *(f"{1e3 * value:.2f}" for value in values))
    console.print(wrenches)
    for part in tool.parts:
        console.print(_part_table(part, getattr(tool, part).to_json()))
    for text in tool.unresolved:
        console.print(f"[yellow]not identified by the calibration: {escape(text)}[/yellow]")


def _part_table(part: str, content: Mapping[str, Any]) -> Table:
    """An optional part as its file has it, whatever it holds; a covariance only by name."""
    table = Table(part, "")
    for key, value in content.items():
        table.add_row(key, "given" if "covariance" in key else _plain(value))
    return table


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_plain(item)}" for key, item in value.items())
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        if len(value) > 12:
            return f"{len(value)} values"
        return " ".join(_plain(item) for item in value)
    return escape(str(value))


# Two tools


def comparison_to_dict(comparison: CalibrationComparison) -> dict[str, Any]:
    """A comparison; `std_dev` and `sigmas` are None where the files tell none."""
    return {
        "a": comparison.a,
        "b": comparison.b,
        "same_load": comparison.same_load,
        "text": comparison.text,
        "differences": [
            {
                "quantity": row.quantity,
                "unit": row.unit,
                "a": float(row.a),
                "b": float(row.b),
                "difference": float(row.value),
                "std_dev": _or_none(row.std_dev),
                "sigmas": _or_none(row.sigmas),
                "text": row.text,
            }
            for row in comparison.differences
        ],
        "worst": {
            name: {"size": worst.size, "roll_rad": at[0], "tilt_rad": at[1]}
            for name, worst, at in (
                ("force_n", comparison.worst_force, _list(comparison.worst_force.at_rad)),
                ("torque_nm", comparison.worst_torque, _list(comparison.worst_torque.at_rad)),
            )
        },
        "parts": [{"part": part, "only_in": owner} for part, owner in comparison.parts],
    }


def print_comparison(comparison: CalibrationComparison, console: Console) -> None:
    """The sentence, and a row for each quantity."""
    style = "green" if comparison.same_load else "yellow"
    console.print(f"[{style}]{escape(comparison.text)}[/{style}]", soft_wrap=True, highlight=False)
    table = Table("", "unit")
    for name in (comparison.a, comparison.b, "difference", "standard deviation"):
        table.add_column(escape(name), justify="right")
    table.add_column("in words")
    for row in comparison.differences:
        scale, unit = row.shown
        std_dev = "" if math.isnan(row.std_dev) else three_digits(scale * row.std_dev)
        table.add_row(
            row.quantity.replace("_", " "),
            unit,
            f"{scale * row.a:.2f}",
            f"{scale * row.b:.2f}",
            three_digits(scale * row.value),
            std_dev,
            row.text,
        )
    console.print(table)
    for name, worst, unit in (
        ("force", comparison.worst_force, "mN"),
        ("torque", comparison.worst_torque, "mN.m"),
    ):
        roll, tilt = worst.at_rad
        console.print(
            f"largest difference of the compensated {name}: {three_digits(1e3 * worst.size)}"
            f" {unit}, at roll {roll:.2f}, tilt {tilt:.2f} rad",
            highlight=False,
            soft_wrap=True,
        )


# What is active


def print_active(state: Mapping[str, Any], console: Console) -> None:
    """What a node has active, as `active_tool_client.read` gives it."""
    if not state["tool"]:
        console.print("[yellow]no tool is active: nothing is compensated[/yellow]")
        return
    switch = "" if state["enabled"] else ", but [yellow]compensation is switched off[/yellow]"
    console.print(f"[bold]{state['tool']}[/bold] is active{switch}")
    load = LoadEstimate(state["mass_kg"], np.array(state["com_m"]), np.array(state["covariance"]))
    adapter = state["adapter"]
    table = Table("", "mass, g", f"centre in {state['frame']}, mm")
    table.add_row("tool", _mass(load), _millimetres(load.com_m))
    table.add_row(
        "adapter", f"{1e3 * adapter['mass_kg']:.2f}", _millimetres(np.array(adapter["com_m"]))
    )
    table.add_row("tip", "", _millimetres(np.array(state["tip_m"])))
    console.print(table)
    wrenches = Table("subtracted, mN and mN.m", *WRENCH_AXES)
    for name in ("tare", "bias_drift"):
        if state[name] is not None:
            wrenches.add_row(name, *(f"{1e3 * value:.2f}" for value in state[name]))
    if wrenches.row_count:
        console.print(wrenches)
    for text in (
        f"calibrated {state['calibrated_at']}, {age_text(state['calibrated_at'])}",
        f"parts: {', '.join(state['parts']) or 'none'}",
        f"file: {state['path']}, sha256 {state['sha256'][:12]}",
    ):
        console.print(escape(text), highlight=False, soft_wrap=True)
    if state["file_state"] != "as loaded":
        text = "the file has changed since it was loaded: what is active is the older content"
        if state["file_state"] == "gone":
            text = "the file is gone since it was loaded"
        console.print(f"[yellow]{text}[/yellow]", soft_wrap=True)


def _mass(load: LoadEstimate) -> str:
    return f"{1e3 * load.mass_kg:.2f} ± {three_digits(1e3 * load.mass_std_kg)}"


def _millimetres(values: Array) -> str:
    return " ".join(f"{1e3 * value:8.2f}" for value in values)


def _load_dict(load: LoadEstimate) -> dict[str, Any]:
    return {
        "mass_kg": float(load.mass_kg),
        "com_m": _list(load.com_m),
        "covariance": [_list(row) for row in load.covariance],
    }


def _list(values: Array) -> list[float]:
    return [float(value) for value in values]


def _or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
