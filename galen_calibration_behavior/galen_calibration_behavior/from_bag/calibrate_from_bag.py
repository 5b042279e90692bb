"""`calibrate_from_bag`: a tool's file out of recorded sweeps. Needs no ROS and no arm."""

from __future__ import annotations

import argparse
import functools
import json
import math
import sys
from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from galen_bags.arrays.arm_recording import read_arm
from galen_model.errors import IdentificationError
from galen_model.files.calibration_file import LoadEstimate, calibration_path, read_calibration
from galen_model.load.bias.choice import BiasMode
from galen_model.load.mounting.identification import KnownLoad
from galen_model.load.mounting.mounting import GROUPS, entities
from galen_ros.command import positive
from galen_ros.parameters.param import from_options
from tqdm import tqdm

from galen_calibration_behavior.calibration.estimate import (
    Calibration,
    MountingRequest,
    calibrate,
    check_writable,
    choose_tip,
    estimate,
)
from galen_calibration_behavior.calibration.mounting_text import format_mounting, mounting_fields
from galen_calibration_behavior.calibration.result_text import (
    calibration_fields,
    format_result,
)
from galen_calibration_behavior.commands import CalibrationCode
from galen_calibration_behavior.from_bag.home_stays import BiasPose
from galen_calibration_behavior.from_bag.options import (
    EXIT_CANCELED,
    EXIT_FAILED,
    EXIT_OK,
    EXIT_USAGE,
    POSE_PARAMETERS,
    add_output_options,
    add_pose_options,
    add_topic_options,
    arm_topics,
    check_not_newer,
    parse_with_tool,
    reported,
    sample_time,
)
from galen_calibration_behavior.from_bag.pose_table import format_poses, pose_rows
from galen_calibration_behavior.from_bag.recorded_sweeps import RecordedSweeps, SweepSorter
from galen_calibration_behavior.from_bag.visits import RecordingError, Visit, Visits, find_visits
from galen_calibration_behavior.parameters import CalibrationParameters

_EPILOG = f"""exit codes:
  {EXIT_OK}    calibrated; the file is written, but for --dry-run
  {EXIT_FAILED}    failed; the reason is printed, nothing is written
  {EXIT_USAGE}    wrong arguments
  {EXIT_CANCELED}  interrupted (Ctrl-C); nothing is written"""


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and a message where it is wrong."""
    home = CalibrationParameters()
    parser = argparse.ArgumentParser(
        prog="calibrate_from_bag",
        usage="%(prog)s TOOL BAG [options]\n"
        "       %(prog)s TOOL --bare BAG --with-tool BAG [options]",
        description="Calibrate a tool from recorded sweeps: find the still poses, average and"
        " judge them as calibration_node does, write the tool's file.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("tool", help="name of the tool and of its file: letters, digits, _ and -")
    parser.add_argument(
        "bag",
        nargs="?",
        help="a recording of both sweeps, first bare, then with the tool on: a rosbag2 directory,"
        " .mcap, .db3 or ROS 1 .bag",
    )
    parser.add_argument("--bare", metavar="BAG", help="a recording of the sweep without the tool")
    parser.add_argument("--with-tool", metavar="BAG", help="and one of the sweep with the tool on")
    parser.add_argument(
        "--one-sweep",
        action="store_true",
        help="BAG holds the tool's sweep alone: tool and adapter are then not fully told apart"
        " (a warning says what is not known)",
    )
    parser.add_argument(
        "--adapter-from",
        metavar="FILE",
        help="with --one-sweep: a tool's file whose adapter is the one in the recording; then they"
        " are told apart",
    )
    parser.add_argument(
        "--tool-on-at-s",
        type=float,
        metavar="SECONDS",
        help="when the tool came on, from the recording's first joint state (default: found out)",
    )
    parser.add_argument(
        "--tip",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="the tool's tip in ft_sensor, m; else the old file's is kept, or (0, 0, 0)",
    )
    add_output_options(parser)
    add_mounting_options(parser.add_argument_group("sensor and mounting"))
    parser.add_argument(
        "--bias",
        type=BiasMode,
        choices=list(BiasMode),
        default=BiasMode.CONSTANT,
        help="the sensor's bias over a sweep: constant; drifting; or whichever of them held-out"
        " blocks of poses prefer (default: %(default)s)",
    )
    parser.add_argument("--poses", action="store_true", help="print every pose with its residual")
    where = parser.add_argument_group("where things are in the recording")
    add_topic_options(where)
    for joint, value in (("roll", home.Rhome), ("tilt", home.Thome)):
        where.add_argument(
            f"--bias-{joint}-rad",
            type=float,
            default=value,
            metavar="RAD",
            help=f"{joint} where the sensor was zeroed (default {value:g})",
        )
    add_pose_options(parser)
    options = parse_with_tool(parser, arguments)
    _check_combination(parser, options)
    return options


def add_mounting_options(group: argparse._ArgumentGroup) -> None:
    """What to estimate beside the loads, and what is known of the tool."""
    group.add_argument(
        "--estimate",
        metavar="GROUPS",
        type=lambda text: tuple(text.split(",")),
        help="estimate these together with the load, comma-separated; rejected where the poses"
        f" can't tell them apart: {', '.join(GROUPS)}",
    )
    group.add_argument(
        "--known-mass-kg",
        type=positive,
        metavar="KG",
        help="the tool's mass, as a scale tells it; the common force gain needs it",
    )
    group.add_argument(
        "--known-mass-std-kg", type=positive, metavar="KG", help="and its standard deviation"
    )
    group.add_argument(
        "--known-com-m",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="the tool's centre in ft_sensor, as a drawing tells it; the common torque gain needs"
        " it",
    )
    group.add_argument(
        "--known-com-std-m", type=positive, metavar="M", help="and its standard deviation"
    )


def mounting_request(options: argparse.Namespace) -> MountingRequest | None:
    """What the options ask of the mounting; raises IdentificationError for what can't be known."""
    if options.estimate is None:
        return None
    if options.known_mass_kg is None:
        return MountingRequest(options.estimate)
    com = None if options.known_com_m is None else np.array(options.known_com_m)
    known = KnownLoad(
        options.known_mass_kg, options.known_mass_std_kg, com, options.known_com_std_m
    )
    return MountingRequest(options.estimate, known)


def _check_combination(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    pair = (options.bare, options.with_tool)
    if any(pair) and (options.bag or not all(pair)):
        parser.error("either one BAG, or --bare BAG and --with-tool BAG")
    if not any(pair) and not options.bag:
        parser.error("a BAG is needed, or --bare BAG and --with-tool BAG")
    if options.one_sweep and any(pair):
        parser.error("--one-sweep is for one BAG")
    if options.adapter_from and not options.one_sweep:
        parser.error("--adapter-from is for --one-sweep: two sweeps tell the adapter themselves")
    if options.tool_on_at_s is not None and (options.one_sweep or any(pair)):
        parser.error("--tool-on-at-s is for one BAG that holds both sweeps")
    if (options.known_mass_kg is None) != (options.known_mass_std_kg is None):
        parser.error("--known-mass-kg and --known-mass-std-kg belong together")
    if (options.known_com_m is None) != (options.known_com_std_m is None):
        parser.error("--known-com-m and --known-com-std-m belong together")
    if options.known_com_m is not None and options.known_mass_kg is None:
        parser.error("--known-com-m needs --known-mass-kg")
    if options.bias is not BiasMode.CONSTANT and options.estimate is not None:
        parser.error("--estimate is for a constant bias")
    if options.known_mass_kg is not None and options.estimate is None:
        parser.error("--known-mass-kg is for --estimate")
    try:
        entities(options.estimate or ())
    except IdentificationError as error:
        parser.error(f"--estimate: {error}")
    given = {
        "--known-com-m": options.known_com_m or [],
        "--tip": options.tip or [],
        "--tool-on-at-s": [] if options.tool_on_at_s is None else [options.tool_on_at_s],
        "--bias-roll-rad": [options.bias_roll_rad],
        "--bias-tilt-rad": [options.bias_tilt_rad],
    }
    for name, values in given.items():
        if not all(map(math.isfinite, values)):
            parser.error(f"{name} needs finite numbers")


def find_sweeps(options: argparse.Namespace) -> RecordedSweeps:
    """Read the recordings and sort their still poses into sweeps; raises GalenError."""
    settings = from_options(options, CalibrationParameters, POSE_PARAMETERS)

    def visits(bag: str) -> Visits:
        return find_visits(
            read_arm(bag, arm_topics(options)),
            settings,
            whole_phases=options.whole_phases,
            progress=functools.partial(_progress, Path(bag).name),
        )

    sorter = SweepSorter(settings, BiasPose(options.bias_roll_rad, options.bias_tilt_rad))
    if options.bag is None:
        return sorter.two_recordings(visits(options.bare), visits(options.with_tool))
    if options.one_sweep:
        return sorter.one_sweep(visits(options.bag), _known_adapter(options.adapter_from))
    return sorter.two_sweeps(visits(options.bag), options.tool_on_at_s)


def _progress(name: str, phases: list[slice]) -> Iterable[slice]:
    # Nothing where standard error is no terminal, and never left behind an error message.
    return tqdm(phases, desc=name, unit="phase", file=sys.stderr, disable=None, leave=False)


def _known_adapter(path: str | None) -> LoadEstimate | None:
    if path is None:
        return None
    tool = read_calibration(path)
    if tool.unresolved:
        raise RecordingError(
            f"{path}: its adapter is itself not told apart from its tool: it came from one sweep"
        )
    return tool.adapter


def measured_at(last: Visit) -> datetime:
    """When the last sample was taken."""
    return sample_time(last.window_ns[1], last.log_ns)


def run(options: argparse.Namespace) -> tuple[RecordedSweeps, Calibration]:
    """Calibrate as the options say; writes the file, but for `dry_run`. Raises GalenError."""
    path = calibration_path(options.tools_dir, options.tool)
    if not options.dry_run:
        check_writable(path)
    tip, warnings = choose_tip(np.array(options.tip or [math.nan] * 3), path)
    sweeps = find_sweeps(options)
    recorded = measured_at(sweeps.last)
    check_not_newer(options, path, recorded)
    make = estimate if options.dry_run else calibrate
    return sweeps, make(
        path,
        options.tool,
        tip,
        replace(sweeps.measurements, bias_mode=options.bias),
        warnings,
        calibrated_at=recorded,
        mounting=mounting_request(options),
    )


def result_fields(
    options: argparse.Namespace, sweeps: RecordedSweeps, calibration: Calibration
) -> dict[str, Any]:
    """The fields of a live calibration's result, and what only a recording has; for JSON."""
    border = sweeps.border
    fields = {
        "error_code": int(CalibrationCode.NONE),
        "error_msg": "",
        "tool": options.tool,
        "file": "" if options.dry_run else str(calibration.path),
    } | calibration_fields(calibration)
    bias_drift = calibration.found.bias_drift
    return fields | {
        "bias": None if bias_drift is None else str(bias_drift.choice),
        "bias_mass_growth": None if bias_drift is None else bias_drift.mass_growth,
        "calibrated_at": calibration.content.calibrated_at,
        "tool_on_s": sweeps.tool_on_s,
        "next_border_worse_sigmas": None if border is None else border.next_worse,
        "one_load_worse_ratio": None if border is None else border.ratio,
        "mounting": mounting_fields(calibration),
        "poses": pose_rows(sweeps, calibration),
    }


def format_sweeps(sweeps: RecordedSweeps) -> str:
    """How many poses there are, and where the tool came on, in words."""
    counts = [
        f"{len({p.number for p in sweeps.poses if p.sweep == name})} poses {words}"
        for name, words in (("bare", "without the tool"), ("tool", "with it"))
        if any(p.sweep == name for p in sweeps.poses)
    ]
    text = ", ".join(counts)
    if sweeps.tool_on_s is not None:
        text += f"; it came on between {sweeps.tool_on_s[0]:.1f} s and {sweeps.tool_on_s[1]:.1f} s"
    if sweeps.border is not None:
        text += (
            f"\n(the next best place is {sweeps.border.next_worse:.0f} standard deviations worse,"
            f" one load for all poses {sweeps.border.ratio:.0f} times)"
        )
    return text


def main(arguments: list[str] | None = None) -> None:
    """Run the command; see `calibrate_from_bag --help`."""
    options = parse(arguments)
    with reported("calibrate_from_bag"):
        sweeps, calibration = run(options)
        fields = result_fields(options, sweeps, calibration)
        if options.json:
            print(json.dumps(fields))
        else:
            if options.poses:
                print(format_poses(fields["poses"]) + "\n")
            print(f"{format_sweeps(sweeps)}\n{format_mounting(calibration)}")
            if fields["bias"] is not None:
                print(f"bias of the sensor, as held-out poses choose it: {fields['bias']}\n")
            print(format_result(SimpleNamespace(**fields)))


if __name__ == "__main__":
    main()
