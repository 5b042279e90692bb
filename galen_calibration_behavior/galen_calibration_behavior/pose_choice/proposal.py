"""The poses that are worth most for a load, proposed beside the grid's. Moves nothing."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arm.clearance import ObstacleError
from galen_model.arrays import Array
from galen_model.poses.design import PoseDesign
from galen_model.poses.plan import left_out, make_router, plan_grid
from galen_ros.command import check_folder, writing
from tqdm import tqdm

from galen_calibration_behavior.parameters import CalibrationParameters
from galen_calibration_behavior.pose_choice.report import (
    Promise,
    efficiency_curve,
    equal_count,
    format_curve,
    format_poses,
    format_promises,
    promise,
    to_dict,
)

_RATE_HZ = 500.0  # the contract's, of wrench_raw
_CURVE = (6, 8, 10, 12, 14, 16, 18, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56)


def propose_poses(options: argparse.Namespace) -> dict[str, Any]:
    """Choose as the options say, print it unless as JSON; raises GalenError."""
    check_folder(options.plots)
    found = choose(options)
    if options.plots:
        with writing(options.plots):
            _plot(found, options.plots)
    if not options.json:
        print(format_choice(found))
    return to_plain(found)


def choose(options: argparse.Namespace) -> dict[str, Any]:
    """All that the command tells, arrays as numpy has them; raises GalenError."""
    parameters = replace(
        options.parameters,
        poses="chosen",
    )
    parameters.validate()
    tip = np.array(options.tip or [0.0, 0.0, 0.0])
    plan = parameters.plan(tip, one_sweep=options.one_sweep)
    grid = parameters.grid_poses(parameters.itersT, parameters.itersR)
    where, around = parameters.range, parameters.surroundings
    router = make_router(where, around, tip)
    candidates = where.candidates()
    faults = [""] * len(candidates) if router is None else router.lattice_faults
    free = np.array([not fault for fault in faults])
    bias = (parameters.Rhome, parameters.Thome) if options.one_sweep else None
    design = PoseDesign(candidates[free], goal=parameters.chosen_for, one_sweep_zero=bias)
    # The grid may go where boxes are: it is held against the best without any.
    unhindered = PoseDesign(candidates, goal=parameters.chosen_for, one_sweep_zero=bias)
    grid_parameters = replace(parameters, poses="grid")
    try:
        plan_grid(grid, where, around, tip)
        grid_fault = ""
    except ObstacleError as error:
        grid_fault = str(error)

    def promised(poses: Array, of: CalibrationParameters, average_s: float) -> Promise:
        return promise(poses, of.times(), average_s, _RATE_HZ)

    value, of_grid = design.value(plan.poses), design.value(grid)
    found: dict[str, Any] = {
        "parameters": parameters,
        "poses": plan.poses,
        "grid": grid,
        "grid_fault": grid_fault,
        "free": candidates[free],
        "blocked": candidates[~free],
        "left_out": left_out(faults),
        "promises": {
            "grid": promised(grid, grid_parameters, parameters.average_s),
            "chosen": promised(plan.poses, parameters, parameters.chosen_average_s),
        },
        "efficiency": design.lower_bound(len(plan.poses)) / value,
        "grid_efficiency": unhindered.lower_bound(len(grid)) / of_grid,
        "equal_count": equal_count(design, grid),
        "equal_average_s": parameters.average_s * value / of_grid,
        "curve": [],
    }
    if options.plots:
        counts = [n for n in _CURVE if n <= len(design.candidates)]
        found["curve"] = efficiency_curve(design, grid, counts, _progress)
    return found


def _progress(counts: Sequence[int]) -> Iterable[int]:
    return tqdm(counts, desc="curve", unit="number", file=sys.stderr, disable=None, leave=False)


def format_choice(found: dict[str, Any]) -> str:
    """The result for a person."""
    count, grid = len(found["poses"]), len(found["grid"])
    average_s = found["parameters"].average_s
    equal = found["equal_count"]
    many = f"{equal} chosen poses equal" if equal else f"no fewer than {grid} chosen poses equal"
    lines = [
        format_poses(found["poses"], found["parameters"].times()),
        "",
        format_promises(found["promises"]),
        "",
        f"The {count} chosen poses are within {100 * (1 - found['efficiency']):.1f} % of the best"
        f" possible (the grid's {grid}, were nothing in its way:"
        f" {100 * (1 - found['grid_efficiency']):.1f} %).",
        f"{many} the grid's {grid}, all averaged equally long;",
        f"{count} do with averages of {found['equal_average_s']:.2f} s instead of {average_s:g} s.",
    ]
    if found["left_out"]:
        taken = ", ".join(f"{n} by {name}" for name, n in found["left_out"].items())
        lines.append(
            f"Of {len(found['free']) + len(found['blocked'])} candidates, {len(found['blocked'])}"
            f" can't be visited: {taken}."
        )
    if found["grid_fault"]:
        lines.append(f"The grid can't be swept: {found['grid_fault']}.")
    if found["curve"]:
        lines += ["", format_curve(found["curve"])]
    return "\n".join(lines)


def to_plain(found: dict[str, Any]) -> dict[str, Any]:
    """Return the result as plain numbers and texts, SI units."""
    plain = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in found.items()
        if name != "parameters"
    }
    plain["promises"] = {name: to_dict(row) for name, row in found["promises"].items()}
    plain["curve"] = [to_dict(row) for row in found["curve"]]
    return plain


def _plot(found: dict[str, Any], directory: Path) -> None:
    # Only here: a picture's library takes a second to load.
    from galen_calibration_behavior.pose_choice.plots import plot_curve, plot_poses

    for path in (
        plot_poses(
            found["poses"],
            found["grid"],
            found["free"],
            found["blocked"],
            directory / "chosen_poses.png",
        ),
        plot_curve(found["curve"], directory / "chosen_poses_curve.png"),
    ):
        print(f"{path} written", file=sys.stderr)
