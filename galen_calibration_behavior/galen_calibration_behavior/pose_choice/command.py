"""`choose_poses`: the poses that tell most about a load, beside the grid's. Moves nothing."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arm.clearance import ObstacleError
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.poses.design import GOALS, PoseDesign
from galen_model.poses.plan import left_out, make_router, plan_grid
from galen_ros.command import check_folder
from galen_ros.parameters.param import add_options, from_options
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

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_CANCELED = 0, 1, 2, 130
_EPILOG = f"""exit codes:
  {EXIT_OK}    chosen
  {EXIT_FAILED}    no poses can be chosen; the reason is printed
  {EXIT_USAGE}    wrong arguments
  {EXIT_CANCELED}  interrupted (Ctrl-C)"""
_PARAMETERS = (
    "tstart", "tend", "itersT", "rstart", "rend", "itersR", "Xhome", "Yhome", "Zhome", "Rhome",
    "Thome", "chosen_poses", "chosen_average_s", "average_s", "settle_s", "velocity_window_s",
    "max_angle_velocity_rad_s", "max_angle_acceleration_rad_s2", "obstacle_clearance_m",
)  # fmt: skip
_CURVE = (6, 8, 10, 12, 14, 16, 18, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and a message where it is wrong."""
    parser = argparse.ArgumentParser(
        prog="choose_poses",
        description="Choose the poses of a calibration's sweep that tell most about the load, of"
        " those that the arm can visit, and say how good they are beside the grid's.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--for",
        dest="goal",
        choices=GOALS,
        default=GOALS[0],
        help="what shall become precise (default %(default)s)",
    )
    parser.add_argument("--one-sweep", action="store_true", help="only a sweep with the tool on")
    parser.add_argument(
        "--obstacle",
        nargs=6,
        type=float,
        action="append",
        default=[],
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="a box to keep away from: its smallest and largest corner in base_link, m; again for"
        " another one",
    )
    parser.add_argument(
        "--tip", nargs=3, type=float, metavar=("X", "Y", "Z"),
        help="the tool's tip in ft_sensor, m; needed with --obstacle",
    )  # fmt: skip
    parser.add_argument(
        "--rate-hz", type=float, default=500.0, help="the wrench's rate (default %(default)g)"
    )
    parser.add_argument("--curve", action="store_true", help="how good any number of poses is")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write pictures there")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    add_options(
        parser.add_argument_group("as calibration_node's parameters"),
        CalibrationParameters,
        _PARAMETERS,
    )
    options = parser.parse_args(arguments)
    if options.obstacle and options.tip is None:
        parser.error("--obstacle needs --tip: what the tool would hit depends on its length")
    if not all(map(math.isfinite, [*(options.tip or []), options.rate_hz])) or options.rate_hz <= 0:
        parser.error("--tip and --rate-hz need finite numbers, and a rate is positive")
    return options


def choose(options: argparse.Namespace) -> dict[str, Any]:
    """All that the command tells, arrays as numpy has them; raises GalenError."""
    parameters = replace(
        from_options(options, CalibrationParameters, _PARAMETERS),
        poses="chosen",
        chosen_for=options.goal,
        obstacles=tuple(value for box in options.obstacle for value in box),
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
    design = PoseDesign(candidates[free], goal=options.goal, one_sweep_zero=bias)
    # The grid may go where boxes are: it is held against the best without any.
    unhindered = PoseDesign(candidates, goal=options.goal, one_sweep_zero=bias)
    grid_parameters = replace(parameters, poses="grid")
    try:
        plan_grid(grid, where, around, tip)
        grid_fault = ""
    except ObstacleError as error:
        grid_fault = str(error)

    def promised(poses: Array, of: CalibrationParameters, average_s: float) -> Promise:
        return promise(poses, of.times(), average_s, options.rate_hz)

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
    if options.curve or options.plots:
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


def to_json(found: dict[str, Any]) -> str:
    """The result as one JSON object, SI units."""
    plain = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in found.items()
        if name != "parameters"
    }
    plain["promises"] = {name: to_dict(row) for name, row in found["promises"].items()}
    plain["curve"] = [to_dict(row) for row in found["curve"]]
    return json.dumps(plain)


def main(arguments: list[str] | None = None) -> None:
    """Run the command; see `choose_poses --help`."""
    options = parse(arguments)
    try:
        check_folder(options.plots)
        found = choose(options)
        if options.plots:
            _plot(found, options.plots)
        print(to_json(found) if options.json else format_choice(found))
    except (GalenError, OSError) as error:
        print(f"choose_poses: {error}", file=sys.stderr)
        raise SystemExit(EXIT_FAILED) from None
    except KeyboardInterrupt:
        print("choose_poses: interrupted", file=sys.stderr)
        raise SystemExit(EXIT_CANCELED) from None


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


if __name__ == "__main__":
    main()
