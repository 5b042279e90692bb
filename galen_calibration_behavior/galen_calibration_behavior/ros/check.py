# SPDX-License-Identifier: Apache-2.0
"""`check`: has calibration_node find out whether a tool's file still fits, and says what to do."""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import Any

from galen_common.command import EXIT_OK, make_parser, own_arguments, whole
from galen_model.arm.galen import WRENCH_AXES
from galen_model.load.verdict import Cause, CheckAnswer
from galen_ros.goal.client import (
    GoalClient,
    add_client_options,
    read_options,
    report_error,
    result_to_dict,
    run_client,
)

from galen_calibration_behavior.common.commands import CheckCode
from galen_msgs.action import CheckTool

EXIT_RETARE, EXIT_RECALIBRATE, EXIT_UNSURE = 3, 4, 5
_EXITS = {
    CheckAnswer.GOOD: EXIT_OK,
    CheckAnswer.RETARE: EXIT_RETARE,
    CheckAnswer.RECALIBRATE: EXIT_RECALIBRATE,
    CheckAnswer.UNSURE: EXIT_UNSURE,
}
_SIGMAS = 2.0  # a change of mass alone is significant beyond so many standard deviations
_HEADS = {
    CheckAnswer.GOOD: "good",
    CheckAnswer.RETARE: "re-tare",
    CheckAnswer.RECALIBRATE: "recalibrate",
    CheckAnswer.UNSURE: "not decided",
}


class CheckClient(GoalClient):
    """A check; tells of poses that can't be used."""

    action_type = CheckTool
    action_name = "check_tool"
    node_name = "check_client"
    server = "calibration_node"
    server_node = "calibration"
    lost = "nothing is known of the tool"
    unit = "pose"

    def make_goal(self) -> CheckTool.Goal:
        """Return what the options ask for."""
        return CheckTool.Goal(tool=self.options.tool, poses=self.options.poses)

    def on_feedback(self, feedback: Any) -> None:
        """Show it: the bar, or without a terminal a line for each; and each bad pose.

        Args:
            feedback: a CheckTool.Feedback.

        """
        self.bar.show("checking", feedback.done, feedback.total)
        rejected = len(feedback.angles) > 0 and not feedback.accepted
        if rejected or not self.bar.active:
            self.bar.line(f"[{feedback.done}/{feedback.total}] {feedback.message}")


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line.

    Args:
        arguments: without the program's name and without those of ROS.

    Returns:
        The options; `tool` is empty where the active one is meant, `poses` 0 where the node
        decides.

    Raises:
        SystemExit: code 2, with a message: the command line is wrong.

    """
    parser = make_parser(
        "check",
        "Check at a few poses whether a tool's calibration file still fits.",
        notes="The tool is on, without contact. The calibration file stays as it is.",
        ok="good: the file still fits",
        failed="not checked; one line gives the reason",
        codes={
            EXIT_RETARE: "re-tare: an offset, which a tare subtracts",
            EXIT_RECALIBRATE: "recalibrate: another load, or something that a tare does not fix",
            EXIT_UNSURE: "not decided: too noisy, or one pose does not agree with the others",
        },
        interrupted="canceled (Ctrl-C); the arm is stopped where it is",
    )
    parser.add_argument(
        "tool", nargs="?", default="", help="name of the tool; default: that active in gravcomp"
    )
    parser.add_argument(
        "--poses", type=whole(0, 100), default=0, help="number of poses; 0: the node's"
    )
    add_client_options(parser)
    return read_options(parser, arguments, tool="tool")


def main() -> None:
    """Run the client; see `check --help`."""
    options = parse(own_arguments(sys.argv)[1:])
    run_client("check", CheckClient, options, _print_result)


def result_fields(result: Any) -> dict[str, Any]:
    """Return a check's result for JSON: answer and cause as words, no NaN.

    Args:
        result: a CheckTool.Result.

    Returns:
        Its fields by name, SI; answer and cause are None where it failed.

    """
    content = result_to_dict(result)
    if result.error_code == CheckCode.NONE:
        content |= {"answer": CheckAnswer(result.answer).name, "cause": Cause(result.cause).name}
    else:
        content |= {"answer": None, "cause": None}
    for name in ("com_change_m", "com_change_std_m"):
        if not all(map(math.isfinite, content[name])):
            content[name] = None
    return content


def format_result(result: Any) -> str:
    """Format a check's result for a person; one standard deviation after +-.

    Args:
        result: a CheckTool.Result without an error.

    Returns:
        Several lines, in N, mN.m and g.

    """
    lines = [
        f"{_HEADS[CheckAnswer(result.answer)]}: {result.tool}: {result.text}",
        "",
        "                " + "".join(f"{axis:>10}" for axis in WRENCH_AXES) + "   [N, mN.m]",
        _row("offset", result.offset),
        _row("+-", result.offset_std),
        _row("unexplained", result.unexplained),
        _row("off by at most", result.effect),
        f"mass {1e3 * result.mass_change_kg:+.2f} +- {1e3 * result.mass_change_std_kg:.2f} g;"
        f" {result.poses_used} poses; {_beside_noise(result)}",
    ]
    lines += [f"rejected {text}" for text in result.poses_rejected]
    lines += [f"warning: {text}" for text in result.warnings]
    return "\n".join(lines)


def _beside_noise(result: Any) -> str:
    """Say whether the change of mass is noise; whether it matters, the answer says."""
    noise_kg = max(result.found_mass_kg, _SIGMAS * result.mass_change_std_kg)
    found = f"{1e3 * noise_kg:.2f} g"
    if abs(result.mass_change_kg) < noise_kg:
        return f"a change of less than {found} can be noise"
    return f"a change of {found} or more is no noise; the limits say whether it matters"


def _row(name: str, values: Any) -> str:
    scaled = [value if k < 3 else 1e3 * value for k, value in enumerate(values)]
    return f"{name:16}" + "".join(f"{round(value, 4) + 0.0:10.4f}" for value in scaled)


def _print_result(result: Any, as_json: bool) -> int:
    code = CheckCode(result.error_code)
    if as_json:
        print(json.dumps(result_fields(result)))
    elif code == CheckCode.NONE:
        print(format_result(result))
    exit_code = report_error("check", code, result.error_msg)
    if code == CheckCode.NONE:
        return _EXITS[CheckAnswer(result.answer)]
    if not as_json:
        for text in result.poses_rejected:
            print(f"  rejected {text}", file=sys.stderr)
    return exit_code


if __name__ == "__main__":
    main()
