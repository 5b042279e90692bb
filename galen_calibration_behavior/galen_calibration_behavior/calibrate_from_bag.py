# SPDX-License-Identifier: Apache-2.0
"""`calibrate_from_bag`: a tool's calibration file out of recordings. Needs no ROS and no arm."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.arrays.arm_recording import arm_of_bag, topics_of
from galen_bags.formats.bag import open_bag
from galen_bags.formats.errors import BagError
from galen_bags.formats.files import is_bag
from galen_common.arm import add_arm, arm_parameters, chosen_arm, names_of_joints
from galen_common.command import (
    EXIT_FAILED,
    EXIT_OK,
    add_arm_topics,
    add_json,
    add_wrench_frame,
    make_parser,
    positive,
    run_command,
)
from galen_common.parameters import ParameterError, checked, param_fields
from galen_model.arm.arm import Arm
from galen_model.arm.clearance import ObstacleError
from galen_model.arrays import Array
from galen_model.errors import GalenError, IdentificationError, ToolNameError
from galen_model.estimation.curves import BiasShape, Shape
from galen_model.files.calibration_file import check_tool_name
from galen_model.load.mounting import GROUPS, entities
from galen_model.load.pose_order import drift_price
from galen_model.poses.design import compensation_std, reading_noise
from galen_model.poses.plan import order_poses, plan_as_is

from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.from_bag.loads import estimate_loads
from galen_calibration_behavior.from_bag.parts import add_part, remove_cable

_RATE_HZ = 500.0  # the contract's, of wrench_raw


def propose_poses(options: argparse.Namespace) -> dict[str, Any]:
    """Choose poses as the options say, and print them unless as JSON.

    Of another arm than the Galen around its zero pose, and without a grid to compare with.

    Args:
        options: of `parse`; `parameters`, `tip`, `one_sweep` and `json` are read.

    Returns:
        For JSON: chosen poses and the grid, (n, k) angles in rad, in visiting order; why the grid
        can't be swept, empty where it can; and what each makes of the compensation, SI.

    Raises:
        GalenError: no poses can be planned; the message names what is in the way.

    """
    parameters = replace(options.parameters, poses="chosen")
    parameters.validate()
    tip = np.array(options.tip or [0.0, 0.0, 0.0])
    poses = parameters.plan(tip, one_sweep=options.one_sweep).poses
    grid, grid_fault, promises = np.empty((0, poses.shape[1])), "", {}
    if parameters.has_home:
        grid = parameters.grid_poses(parameters.itersT, parameters.itersR)
        try:
            plan_as_is(grid, parameters.range, parameters.surroundings, tip)
        except ObstacleError as error:
            grid_fault = str(error)
        on_grid = replace(parameters, poses="grid")
        grid = order_poses(grid, on_grid.times(), arm=parameters.arm)
        promises["grid"] = _promise(grid, on_grid)
    promises["chosen"] = _promise(poses, parameters)
    if not options.json:
        print(f"{_format_poses(poses, parameters)}\n\n{_format_promises(promises)}")
        if grid_fault:
            print(f"The grid can't be swept: {grid_fault}.")
    return {
        "poses": poses.tolist(),
        "grid": grid.tolist(),
        "grid_fault": grid_fault,
        "promises": promises,
    }


def _promise(poses: Array, parameters: CalibrationParameters) -> dict[str, float]:
    """Return what poses (n, k), rad, in visiting order make of the compensation, by theory; SI.

    The standard deviations are the root mean square over workspace and three axes, the sensor's
    noise taken as white; line_price, walk_price: how many times larger a drift makes the load's
    standard deviation, a straight one, or a walk of 3 standard deviations of an average.
    """
    times, average_s = parameters.times(), parameters.of_sweep().average_s
    gravity, at_s = parameters.arm.gravity_in_sensor(poses), times.at_s(poses)
    arm, noise = parameters.arm, reading_noise() / np.sqrt(average_s * _RATE_HZ)
    std = compensation_std(poses, noise, arm)
    return {
        "poses": len(poses),
        "average_s": average_s,
        "sweep_s": times.sweep_s(poses),
        "force_std_n": float(np.sqrt(np.mean(std[:3] ** 2))),
        "torque_std_nm": float(np.sqrt(np.mean(std[3:] ** 2))),
        "line_price": drift_price(gravity, at_s, (BiasShape(Shape.LINEAR),) * 6),
        "walk_price": drift_price(gravity, at_s, (BiasShape(Shape.WALK, 3.0),) * 6),
    }


def _format_poses(poses: Array, parameters: CalibrationParameters) -> str:
    times = parameters.times()
    names = [f"{name} [rad]" for name in parameters.arm.turning_names]
    widths = [max(12, len(name) + 2) for name in names]
    heads = "".join(f"{name:>{width}}" for name, width in zip(names, widths, strict=True))
    lines = [f"{'pose':>4}{heads}{'from [s]':>10}"]
    starts = times.at_s(poses) - times.stay_s
    for index, (angles, start) in enumerate(zip(poses, starts, strict=True)):
        row = "".join(f"{at:{width}.4f}" for at, width in zip(angles, widths, strict=True))
        lines.append(f"{index:4}{row}{start:10.1f}")
    return "\n".join(lines)


def _format_promises(rows: dict[str, dict[str, float]]) -> str:
    lines = [
        f"{'':10}{'poses':>6}{'average':>9}{'sweep':>8}{'error of compensation':>26}"
        f"{'times, with drift':>19}",
        f"{'':10}{'':>6}{'[s]':>9}{'[s]':>8}{'force [mN]':>12}{'torque [mN.m]':>14}"
        f"{'line':>10}{'walk':>9}",
    ]
    lines += [
        f"{name:10}{row['poses']:6}{row['average_s']:9.2f}{row['sweep_s']:8.1f}"
        f"{row['force_std_n'] * 1e3:12.3f}{row['torque_std_nm'] * 1e3:14.4f}"
        f"{row['line_price']:10.3f}{row['walk_price']:9.2f}"
        for name, row in rows.items()
    ]
    return "\n".join(lines)


_NAME = "calibrate_from_bag"
_USAGE = """%(prog)s TOOL BAG [options]
       %(prog)s TOOL --bare BAG --with-tool BAG [options]
       %(prog)s TOOL BAG --estimate inertia|cable [options]
       %(prog)s TOOL --remove-cable [options]
       %(prog)s --propose-poses [options]"""
_NOTES = """BAG is a rosbag2 directory, .mcap or .db3:
  both sweeps of still poses, first bare, then with the tool on;
  --estimate inertia: at least 12 s in which the arm swings, smoothly and fast, no contact;
  --estimate cable: a sweep of still poses with the cable on, no contact."""
_PARTS = ("inertia", "cable")
"""Added to a calibrated tool's file, each from a recording of its own."""


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line.

    Args:
        arguments: without the program's name; None: those of the process.

    Returns:
        The options, and in `parameters` those of calibration_node, with the arm of the options,
        else of the recording.

    Raises:
        SystemExit: code 2 where the command line is wrong, 1 where the recording can't be read;
            with a message.

    """
    parser = make_parser(
        _NAME,
        "Calibrate a tool from recorded sweeps: average and judge still poses as calibration_node"
        " does, write the tool's file. Or add inertia or a cable's pull to a calibrated tool's"
        " file, or propose poses for a sweep.",
        notes=_NOTES,
        ok="done; the file is written, but for --dry-run",
        failed="failed; one line gives the reason, nothing is written",
        interrupted="interrupted (Ctrl-C); nothing is written",
        usage=_USAGE,
    )
    parser.add_argument("tool", nargs="?", help="name of the tool: letters, digits, _ and -")
    parser.add_argument("bag", nargs="?", help="the recording")
    _add_sweep_options(parser.add_argument_group("sweeps"))
    _add_estimate_options(parser.add_argument_group("what is estimated"))
    parser.add_argument(
        "--propose-poses", action="store_true", help="propose poses beside the grid's; no recording"
    )
    parser.add_argument(
        "--tools-dir",
        default=CalibrationParameters().tools_dir,
        metavar="DIR",
        help="directory of the tools' files (default: %(default)s)",
    )
    parser.add_argument(
        "--replace-newer",
        action="store_true",
        help="write also where the file's calibration is newer than the recording",
    )
    parser.add_argument("--dry-run", action="store_true", help="print what is found, write nothing")
    add_json(parser)
    add_arm(parser)
    recording = parser.add_argument_group("where things are in the recording")
    add_arm_topics(recording)
    add_wrench_frame(recording)
    options = parser.parse_intermixed_args(arguments)  # TOOL, options, BAG in any order
    try:
        arm = _arm(options)
        names_of_joints(topics_of(options).joint_names, arm)
        options.parameters = _parameters(options.param, arm)
        if not options.propose_poses:
            check_tool_name(options.tool or "")
    except BagError as error:
        parser.exit(EXIT_FAILED, f"{_NAME}: {error}; nothing is written\n")
    except (GalenError, ToolNameError) as error:
        parser.error(str(error))
    _check_combination(parser, options)
    return options


def _add_sweep_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--bare", metavar="BAG", help="a recording of the sweep without the tool")
    group.add_argument("--with-tool", metavar="BAG", help="and one of the sweep with the tool on")
    group.add_argument(
        "--one-sweep",
        action="store_true",
        help="BAG holds the tool's sweep alone: tool and adapter are then not fully distinguished"
        " (a warning names what is not known)",
    )
    group.add_argument(
        "--tool-on-at-s",
        type=float,
        metavar="SECONDS",
        help="when the tool came on, from the recording's first joint state (default: found)",
    )
    group.add_argument(
        "--tip",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="the tool's tip in the sensor's frame, m; else the old file's is kept, or (0, 0, 0)",
    )
    group.add_argument(
        "-p",
        "--param",
        action="append",
        default=[],
        metavar="NAME:=VALUE",
        help="a parameter of calibration_node: how poses are judged (average_s:=1.0), where the"
        " sensor was zeroed (Rhome, Thome), which poses are proposed",
    )


def _add_estimate_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--estimate",
        metavar="GROUPS",
        type=lambda text: tuple(text.split(",")),
        default=(),
        help="inertia or cable, added to a calibrated tool's file; or, comma-separated, together"
        f" with the load and rejected where the poses don't identify them: {', '.join(GROUPS)}",
    )
    group.add_argument(
        "--remove-cable", action="store_true", help="remove the cable from the tool's file"
    )
    group.add_argument(
        "--known-mass-kg",
        type=positive,
        metavar="KG",
        help="the tool's mass, as weighed; the common force gain needs it",
    )
    group.add_argument(
        "--known-mass-std-kg", type=positive, metavar="KG", help="and its standard deviation"
    )
    group.add_argument(
        "--known-com-m",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="the tool's centre in the sensor's frame, as drawn; the common torque gain needs it",
    )
    group.add_argument(
        "--known-com-std-m", type=positive, metavar="M", help="and its standard deviation"
    )


def _arm(options: argparse.Namespace) -> Arm:
    """Return the arm of the options, else of the recording's description, else the Galen.

    Raises GalenError, BagError where the recording's description has no such arm.
    """
    bag = options.bag or options.bare
    if bag is None or not is_bag(Path(bag)):  # the error is for what reads it
        return chosen_arm(options)
    try:
        with open_bag(bag) as opened:
            return arm_of_bag(opened, arm_parameters(options), topics_of(options))
    except BagError:
        raise
    except GalenError as error:
        if options.urdf or options.sensor_frame:
            raise
        remedy = "--sensor-frame names the frame that the wrenches are written in"
        raise BagError(f"{bag}: {error}; {remedy}") from error


def _parameters(given: list[str], arm: Arm) -> CalibrationParameters:
    """Return the node's parameters with those given as NAME:=VALUE; raises GalenError."""
    fields = param_fields(CalibrationParameters)
    values = {}
    for text in given:
        name, separator, value = text.partition(":=")
        if not separator or name not in fields:
            raise ParameterError(f"-p {text}: no parameter of calibration_node as NAME:=VALUE")
        hint, _, meaning = fields[name]
        try:
            read = value if hint is str else json.loads(value)
        except ValueError:
            read = value
        values[name] = checked(name, read, hint, meaning)
    parameters = CalibrationParameters(arm=arm, **values)
    parameters.validate()
    return parameters


def _check_combination(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    _check_recordings(parser, options)
    _check_estimate(parser, options)
    given = {
        "--known-com-m": options.known_com_m or [],
        "--tip": options.tip or [],
        "--tool-on-at-s": [] if options.tool_on_at_s is None else [options.tool_on_at_s],
    }
    for name, values in given.items():
        if not all(map(math.isfinite, values)):
            parser.error(f"{name} needs finite numbers")


def _check_recordings(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    pair = (options.bare, options.with_tool)
    if options.propose_poses or options.remove_cable:
        if options.bag or any(pair) or options.estimate:
            parser.error("--propose-poses and --remove-cable take no BAG, and no --estimate")
        if options.propose_poses and (options.tool or options.remove_cable):
            parser.error("--propose-poses takes no TOOL")
        if options.parameters.obstacles and options.tip is None:
            parser.error("obstacles need --tip: what the tool would hit depends on its length")
        return
    if any(pair) and (options.bag or not all(pair)):
        parser.error("either one BAG, or --bare BAG and --with-tool BAG")
    if not any(pair) and not options.bag:
        parser.error("a BAG is needed, or --bare BAG and --with-tool BAG")
    if options.one_sweep and any(pair):
        parser.error("--one-sweep is for one BAG")
    if options.tool_on_at_s is not None and (options.one_sweep or any(pair)):
        parser.error("--tool-on-at-s is for one BAG that holds both sweeps")


def _check_estimate(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    parts = set(options.estimate) & set(_PARTS)
    if parts and (len(options.estimate) > 1 or not options.bag or options.one_sweep):
        parser.error(f"--estimate {parts.pop()} is for itself, from one BAG")
    if (options.known_mass_kg is None) != (options.known_mass_std_kg is None):
        parser.error("--known-mass-kg and --known-mass-std-kg belong together")
    if (options.known_com_m is None) != (options.known_com_std_m is None):
        parser.error("--known-com-m and --known-com-std-m belong together")
    if options.known_com_m is not None and options.known_mass_kg is None:
        parser.error("--known-com-m needs --known-mass-kg")
    if options.known_mass_kg is not None and (parts or not options.estimate):
        parser.error("--known-mass-kg is for --estimate of gains")
    try:
        entities(() if parts else options.estimate, options.parameters.arm)
    except IdentificationError as error:
        parser.error(f"--estimate: {error}")


def _work(options: argparse.Namespace) -> int:
    options.tools_dir = Path(options.tools_dir).expanduser()
    if options.propose_poses:
        fields = propose_poses(options)
    elif options.remove_cable:
        fields = remove_cable(options)
    else:
        add = "".join(options.estimate) in _PARTS
        fields = add_part(options) if add else estimate_loads(options)
    if options.json:
        print(json.dumps(fields))
    return EXIT_OK


def main(arguments: list[str] | None = None) -> int:
    """Run the command; see `calibrate_from_bag --help`.

    Args:
        arguments: without the program's name; None: those of the process.

    Returns:
        The exit code.

    """
    options = parse(arguments)
    return run_command(_NAME, partial(_work, options), "; nothing is written")


if __name__ == "__main__":
    raise SystemExit(main())
