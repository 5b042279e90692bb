# SPDX-License-Identifier: Apache-2.0
"""`calibrate`: sends one goal to calibration_node and shows how it goes, on a terminal."""

from __future__ import annotations

import argparse
import json
import math
import select
import sys
import termios
from typing import Any

from galen_common.command import EXIT_OK, finite, make_parser, own_arguments, whole
from galen_ros.goal.client import (
    GoalClient,
    add_client_options,
    cancel_goals,
    read_options,
    report_error,
    result_to_dict,
    run_client,
)
from std_srvs.srv import Trigger

from galen_calibration_behavior.calibration.estimate import format_result
from galen_calibration_behavior.common.commands import (
    CALIBRATION_PHASES,
    WARNING,
    CalibrationCode,
    CalibrationState,
)
from galen_msgs.action import CalibrateTool


class CalibrateClient(GoalClient):
    """A calibration; tells states and bad poses, and hands a person's Enter on to the node."""

    action_type = CalibrateTool
    action_name = "calibrate_tool"
    node_name = "calibrate"
    server = "calibration_node"
    server_node = "calibration"
    lost = "nothing was written"
    unit = "pose"

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__(options)
        self._confirm = self.node.create_client(Trigger, f"{self.server_node}/confirm")
        self._state: int | None = None
        self._asked: int | None = None
        self._question = False
        self._shown_warnings: set[str] = set()

    def run(self) -> Any:
        """Run it; without `--json` the result has only the warnings not shown yet."""
        result = super().run()
        if not self.options.json:
            shown = self._shown_warnings
            result.warnings = [text for text in result.warnings if WARNING + text not in shown]
        return result

    def make_goal(self) -> CalibrateTool.Goal:
        """Return what the options ask for."""
        options = self.options
        return CalibrateTool.Goal(
            tool=options.tool,
            one_sweep=options.one_sweep,
            attach_by_service=not (options.confirm or options.by_hand),
            by_hand=options.by_hand,
            tip_m=[math.nan] * 3 if options.tip is None else options.tip,
            iters_t=options.iters_t,
            iters_r=options.iters_r,
        )

    def on_feedback(self, feedback: Any) -> None:
        """Show it, and ask a person where the node waits for one.

        Args:
            feedback: a CalibrateTool.Feedback.

        """
        self._show(feedback)
        asks = feedback.state in (CalibrationState.REMOVE_TOOL, CalibrationState.ATTACH_TOOL)
        by_person = self.options.confirm or self.options.by_hand
        if by_person and asks and self._asked != feedback.state:
            if sys.stdin.isatty():
                # An Enter from before the question must not answer it: the arm would move.
                termios.tcflush(sys.stdin, termios.TCIFLUSH)
            self.bar.line(f"{feedback.message} - press Enter when done")
            self._question = True
        self._asked = feedback.state if asks else None

    def while_waiting(self) -> None:
        """Hand an Enter on the terminal on to the node, without holding up the executor."""
        if not self._question or not select.select([sys.stdin], [], [], 0.0)[0]:
            return
        self._question = False
        if not sys.stdin.readline():
            self.bar.line(
                f"standard input has ended; confirm with the service {self._confirm.srv_name}"
            )
            return
        answering = self._confirm.call_async(Trigger.Request())

        def on_answer(future: Any) -> None:
            answer = future.result()
            if not answer.success:
                self.bar.line(f"not confirmed: {answer.message}")

        answering.add_done_callback(on_answer)

    def _show(self, feedback: Any) -> None:
        """Return the bar, or without a terminal a line for each state; and each bad pose."""
        state = CalibrationState(feedback.state)
        self.bar.show(CALIBRATION_PHASES[state], feedback.done, feedback.total)
        sweeps = (CalibrationState.SWEEP_BARE, CalibrationState.SWEEP_TOOL)
        guides = self.options.by_hand and state in sweeps and not len(feedback.angles)
        if feedback.message.startswith(WARNING):
            self._shown_warnings.add(feedback.message)
            self.bar.line(feedback.message)
        elif guides or (not self.bar.active and state != self._state):
            self.bar.line(f"[{feedback.done}/{feedback.total}] {feedback.message}")
        if len(feedback.angles) and not feedback.accepted:
            self.bar.line(f"  {feedback.message}")
        self._state = state


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line.

    Args:
        arguments: without the program's name and without those of ROS.

    Returns:
        The options; either `tool` or `cancel` is set.

    Raises:
        SystemExit: code 2, with a message: the command line is wrong.

    """
    parser = make_parser(
        "calibrate",
        "Calibrate a tool on the arm: sweep over still poses, write the tool's file.",
        notes="From recorded sweeps, without an arm: calibrate_from_bag.",
        ok="calibrated, file written",
        failed="failed; one line gives the reason, nothing is written",
        interrupted="canceled (Ctrl-C); the arm is stopped, nothing is written",
    )
    parser.add_argument(
        "tool", nargs="?", help="name of the tool and of its file: letters, digits, _ and -"
    )
    parser.add_argument(
        "--cancel", action="store_true", help="cancel the calibration that runs, and stop the arm"
    )
    parser.add_argument(
        "--tip",
        nargs=3,
        type=finite,
        metavar=("X", "Y", "Z"),
        help="the tool's tip in the sensor's frame, m; else the old file's is kept, or (0, 0, 0)",
    )
    parser.add_argument(
        "--one-sweep",
        action="store_true",
        help="only sweep with the tool on: half the time, but tool and adapter are then not fully"
        " distinguished (a warning names what is not known)",
    )
    parser.add_argument(
        "--confirm",
        action="store_true",
        help="an operator removes the tool and puts it on, and presses Enter here"
        " (default: the driver's service attach_tool does it)",
    )
    parser.add_argument(
        "--by-hand",
        action="store_true",
        help="an operator also moves the arm, by freedrive or pendant: each rest segment in a new"
        " orientation is taken; what is identified so far and which orientation is missing is"
        " shown, and the sweep ends at the wanted precision (parameters by_hand_std_n, _nm)",
    )
    parser.add_argument(
        "--iters-t", type=whole(0, 100), default=0, help="number of tilts; 0: the node's"
    )
    parser.add_argument(
        "--iters-r", type=whole(0, 100), default=0, help="number of rolls; 0: the node's"
    )
    add_client_options(parser)
    options = read_options(parser, arguments, tool="tool")
    if (options.tool is None) != options.cancel:
        parser.error("give a TOOL, or --cancel")
    return options


def main() -> None:
    """Run the client; see `calibrate --help`."""
    options = parse(own_arguments(sys.argv)[1:])
    if options.cancel:
        cancel_goals("calibrate", CalibrateClient, options.timeout_s)
    run_client("calibrate", CalibrateClient, options, _print_result)


def _print_result(result: Any, as_json: bool) -> int:
    if as_json:
        print(json.dumps(result_to_dict(result)))
    elif result.error_code == CalibrationCode.NONE:
        print(format_result(result))
    exit_code = report_error("calibrate", CalibrationCode(result.error_code), result.error_msg)
    if exit_code != EXIT_OK and not as_json:
        for text in result.poses_rejected:
            print(f"  rejected {text}", file=sys.stderr)
    return exit_code


if __name__ == "__main__":
    main()
