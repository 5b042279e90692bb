# SPDX-License-Identifier: Apache-2.0
"""`collect`: sends one goal to collection_node and tells a person what to push."""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import Any

import numpy as np
from galen_common.command import EXIT_OK, finite, make_parser, own_arguments, whole
from galen_ros.goal.client import (
    GoalClient,
    add_client_options,
    read_options,
    report_error,
    result_to_dict,
    run_client,
)

from galen_deflection.collection.plan import MOST_SETS, ErrorCode, State
from galen_msgs.action import CollectPushes

_PUSHING = (State.PUSH, State.HOLD, State.RELEASE, State.REST)


class CollectClient(GoalClient):
    """A collection; where there is a terminal, the bar says what to push and what is there."""

    action_type = CollectPushes
    action_name = "collect_pushes"
    node_name = "collect"
    server = "collection_node"
    server_node = "collection"
    lost = "what it recorded is under a name that ends in .unfinished"
    unit = "push"

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__(options)
        self._shown: tuple[Any, ...] = ()

    def make_goal(self) -> CollectPushes.Goal:
        """Return what the options ask for."""
        options = self.options
        return CollectPushes.Goal(
            name=options.name,
            tool=options.tool,
            push_by_service=options.by_service,
            sets=options.sets,
            positions=options.positions,
            forces_n=options.forces_n,
            torques_nm=options.torques_nm,
        )

    def on_feedback(self, feedback: Any) -> None:
        """Show it: the bar at each, a line where something new is to be done or was wrong.

        Args:
            feedback: a CollectPushes.Feedback.

        """
        self.bar.show(feedback.message, feedback.done, feedback.total)
        # What is pushed now comes some ten times a second, and only the bar can keep up with it.
        looks = feedback.state in _PUSHING and math.isfinite(feedback.along)
        shown = (feedback.state, *feedback.wanted) if looks else (feedback.message,)
        if shown == self._shown or (looks and self.bar.active):
            return
        self._shown = shown
        where = f" set {feedback.set}, position {feedback.position}:" if feedback.set else ""
        self.bar.line(f"[{feedback.done}/{feedback.total}]{where} {feedback.message}")


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and a message where it is wrong.

    Args:
        arguments: the command line without the program's name and ROS' own arguments.

    Returns:
        The options.

    """
    parser = make_parser(
        "collect",
        "Record pushes at the tool's tip, for deflection models to be fitted to.",
        notes="Axes are those of base_link. What isn't given here is as in the node's parameters.",
        ok="collected; what was left out is printed",
        failed="failed; the reason is printed, and where what was recorded is",
        interrupted="canceled (Ctrl-C); the arm is stopped, the recording stays as unfinished",
    )
    parser.add_argument("name", help="of the recording: letters, digits, _ and -")
    parser.add_argument("--tool", required=True, help="the tool that is on, with a tool's file")
    parser.add_argument(
        "--by-service",
        action="store_true",
        help="the driver's service push_tool pushes, not a person as asked here",
    )
    parser.add_argument(
        "--sets", type=whole(1, MOST_SETS), default=0, help="visits of each position"
    )
    parser.add_argument(
        "--positions",
        nargs="+",
        type=finite,
        default=[],
        metavar="JOINT",
        help="joints of one position after the other, m and rad; the node knows how many",
    )
    parser.add_argument(
        "--forces-n", nargs="+", type=finite, default=[], metavar="N", help="levels of force, N"
    )
    parser.add_argument(
        "--torques-nm",
        nargs="+",
        type=finite,
        default=[],
        metavar="NM",
        help="levels of torque about the tip, N·m",
    )
    add_client_options(parser)
    return read_options(parser, arguments, name="recording's", tool="tool")


def main() -> None:
    """Run the client; see `collect --help`."""
    options = parse(own_arguments(sys.argv)[1:])
    run_client("collect", CollectClient, options, _print_result)


def result_fields(result: Any) -> dict[str, Any]:
    """Return a result for JSON, which has no NaN.

    Args:
        result: a CollectPushes.Result.

    Returns:
        Its fields; `calibration_shift` (m, rad) None without a second calibration set.

    """
    content = result_to_dict(result)
    if not np.all(np.isfinite(result.calibration_shift)):
        content["calibration_shift"] = None
    return content


def format_result(result: Any) -> str:
    """Return a result for a person.

    Args:
        result: a CollectPushes.Result.

    Returns:
        Lines of text.

    """
    lines = [f"{result.pushes} of {result.pushes_asked} pushes, {result.messages} messages"]
    shift = np.asarray(result.calibration_shift)
    if np.all(np.isfinite(shift)):
        lines.append(
            f"between the calibration sets the tip moved by {1e3 * np.linalg.norm(shift[:3]):.3f}"
            f" mm and {1e3 * np.linalg.norm(shift[3:]):.3f} mrad from where the joints say"
        )
    lines += [f"left out: {text}" for text in result.left_out]
    lines += [f"warning: {text}" for text in result.warnings]
    if result.directory:
        lines.append(f"recorded: {result.directory}")
    return "\n".join(lines)


def _print_result(result: Any, as_json: bool) -> int:
    code = ErrorCode(result.error_code)
    if as_json:
        print(json.dumps(result_fields(result)))
    elif code == ErrorCode.NONE:
        print(format_result(result))
    exit_code = report_error("collect", code, result.error_msg)
    if exit_code != EXIT_OK and not as_json and result.directory:
        print(format_result(result), file=sys.stderr)
    return exit_code


if __name__ == "__main__":
    main()
