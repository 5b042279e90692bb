"""What the commands that make a tool's file out of a recording share: options, and how they end."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from galen_bags.arrays.arm_recording import ArmTopics
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files.calibration_file import age_text, check_tool_name, read_calibration
from galen_ros.parameters.param import add_options

from galen_calibration_behavior.calibration.estimate import EstimateError
from galen_calibration_behavior.parameters import CalibrationParameters

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_CANCELED = 0, 1, 2, 130

POSE_PARAMETERS = (
    "settle_s", "average_s", "velocity_tolerance_m_s", "velocity_tolerance_rad_s",
    "velocity_window_s", "position_tolerance_rad", "joint_motion_m", "joint_motion_rad",
    "max_scatter_ratio", "max_trend_sigmas", "min_samples", "max_stamp_step_s",
    "min_pose_fraction", "zero_tolerance_n", "zero_tolerance_nm",
)  # fmt: skip
"""The node's parameters that a recording's poses are judged by."""
# A stamp before this is not a date: a simulation's clock, or one that nobody has set.
_EARLIEST_DATE = datetime(2000, 1, 1, tzinfo=UTC)


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add `--tools-dir`, `--replace-newer`, `--dry-run` and `--json`."""
    add_options(parser, CalibrationParameters, ("tools_dir",))
    parser.add_argument(
        "--replace-newer",
        action="store_true",
        help="write also where the file's calibration is newer than the recording",
    )
    parser.add_argument("--dry-run", action="store_true", help="print what is found, write nothing")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def sample_time(stamp_ns: int, log_ns: int) -> datetime:
    """When a sample was taken: its stamp or, where that is no date, when it was received."""
    stamp = datetime.fromtimestamp(stamp_ns / 1e9, UTC)
    received = datetime.fromtimestamp(log_ns / 1e9, UTC)
    return stamp if stamp >= _EARLIEST_DATE else max(stamp, received)


def check_not_newer(options: argparse.Namespace, path: Path, recorded: datetime) -> None:
    """Raise GalenError where the file's calibration is newer than the recording's end.

    Nothing is raised where nothing is to be written, or `--replace-newer` allows it.
    """
    if options.dry_run or options.replace_newer:
        return
    try:
        held = read_calibration(path).calibrated_at
    except CalibrationFileError:
        return
    ended = recorded.isoformat(timespec="seconds")  # as precise as the file's
    if datetime.fromisoformat(ended) < datetime.fromisoformat(held):
        raise GalenError(
            f"{path}: not replaced: calibrated {held} ({age_text(held)}), after the recording's"
            f" end, {ended} ({age_text(ended)}); --replace-newer replaces it all the same"
        )


def add_topic_options(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Names of topics and joints in the recording; `arm_topics` reads them."""
    topics = ArmTopics()
    parser.add_argument("--joint-states", default=topics.joint_states, metavar="TOPIC")
    parser.add_argument("--wrench-raw", default=topics.wrench_raw, metavar="TOPIC")
    parser.add_argument(
        "--joint-names",
        nargs=5,
        default=topics.joint_names,
        metavar="NAME",
        help=f"default: {' '.join(topics.joint_names)}",
    )


def arm_topics(options: argparse.Namespace) -> ArmTopics:
    """The names that the options of `add_topic_options` give."""
    return ArmTopics(options.joint_states, options.wrench_raw, tuple(options.joint_names))


def add_pose_options(parser: argparse.ArgumentParser) -> None:
    """How still poses are averaged and judged."""
    parser.add_argument(
        "--whole-phases",
        action="store_true",
        help="average all of a still phase after settling, not only average_s of it",
    )
    add_options(
        parser.add_argument_group("how poses are judged, as calibration_node's parameters"),
        CalibrationParameters,
        POSE_PARAMETERS,
    )


def parse_with_tool(
    parser: argparse.ArgumentParser, arguments: list[str] | None
) -> argparse.Namespace:
    """Parse; a `tool` that can't name a file is a wrong argument."""
    options = parser.parse_args(arguments)
    try:
        check_tool_name(options.tool)
    except ToolNameError as error:
        parser.error(str(error))
    return options


@contextmanager
def reported(command: str) -> Iterator[None]:
    """Print an error as one line and exit with the code that the command's help states."""
    try:
        yield
    except EstimateError as error:
        _end(f"{command}: {error.code.name}: {error}", EXIT_FAILED)
    except GalenError as error:
        _end(f"{command}: {error}", EXIT_FAILED)
    except KeyboardInterrupt:
        _end(f"{command}: interrupted; nothing is written", EXIT_CANCELED)


def _end(message: str, code: int) -> None:
    print(message, file=sys.stderr)
    raise SystemExit(code) from None
