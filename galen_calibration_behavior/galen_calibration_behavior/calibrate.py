"""`calibrate`: sends one goal to calibration_node and shows how it goes, on a terminal."""

from __future__ import annotations

import argparse
import json
import math
import select
import shutil
import signal
import sys
import termios
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, NoReturn

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from galen_model.errors import ToolNameError
from galen_model.tool_file import check_tool_name
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger
from tqdm import tqdm

from galen_calibration_behavior.commands import ErrorCode, State
from galen_calibration_behavior.result_text import format_result, result_to_dict
from galen_msgs.action import CalibrateTool

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_CANCELED = 0, 1, 2, 130
_EPILOG = f"""From recorded sweeps, without an arm: calibrate_from_bag.

exit codes:
  {EXIT_OK}    calibrated, file written
  {EXIT_FAILED}    failed; the reason is printed, nothing is written
  {EXIT_USAGE}    wrong arguments
  {EXIT_CANCELED}  canceled (Ctrl-C); the arm is stopped, nothing is written"""
_SERVER_LOST_S = 1.5
_CANCEL_PATIENCE_S = 10.0
_STATE_TEXT = {
    State.HOME: "going home",
    State.REMOVE_TOOL: "tool off",
    State.ZERO: "zeroing",
    State.SWEEP_BARE: "sweep without tool",
    State.ATTACH_TOOL: "tool on",
    State.SWEEP_TOOL: "sweep with tool",
    State.ESTIMATE: "estimating",
}


class _ClientError(Exception):
    """Ends the client with a message and an exit code."""

    def __init__(self, message: str, exit_code: int = EXIT_FAILED) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Progress:
    """A bar where standard error is a terminal, else a line for each state and bad pose."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._fancy = sys.stderr.isatty()
        self._state: int | None = None

    def show(self, feedback: Any) -> None:
        """Show one feedback message."""
        state = State(feedback.state)
        if self._fancy:
            if self._bar is None:
                # Sizes given: tqdm shows nothing on a terminal that says it has 0 rows.
                columns = min(shutil.get_terminal_size().columns, 100)
                self._bar = tqdm(
                    total=feedback.total, unit="pose", file=sys.stderr, ncols=columns, nrows=24
                )
            self._bar.set_description(_STATE_TEXT[state], refresh=False)
            self._bar.n = feedback.done
            self._bar.refresh()
        elif state != self._state:
            self.say(f"[{feedback.done}/{feedback.total}] {feedback.message}")
        rejected = math.isfinite(feedback.roll) and not feedback.accepted
        if rejected:
            self.say(f"  {feedback.message}")
        self._state = state

    def say(self, text: str) -> None:
        """Print a line without tearing the bar."""
        tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class CalibrateClient:
    """One goal, from finding the server to its result."""

    def __init__(self, options: argparse.Namespace, progress: Progress) -> None:
        self._options = options
        self._progress = progress
        self._node = Node("calibrate")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._action = ActionClient(self._node, CalibrateTool, "calibrate_tool")
        self._confirm = self._node.create_client(Trigger, f"{options.node}/confirm")
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._refused = ""
        self._asked: int | None = None
        self._question = False
        self._interrupts = 0

    def on_signal(self, _number: int, _frame: FrameType | None) -> None:
        """Note a Ctrl-C; the second one does not wait for the arm."""
        self._interrupts += 1

    def run(self) -> Any:
        """Return the CalibrateTool.Result; raises _ClientError when there is none."""
        self._wait(
            self._action.server_is_ready,
            self._options.timeout_s,
            f"no action server {self._action_name()!r} after {self._options.timeout_s:g} s:"
            " start calibration_node (and the driver) first, with the same ROS_DOMAIN_ID",
        )
        sending = self._action.send_goal_async(self._goal(), feedback_callback=self._on_feedback)
        self._wait(sending.done, self._options.timeout_s, "the server did not answer the goal")
        handle = sending.result()
        if not handle.accepted:
            self._fail_refused()
        result = handle.get_result_async()
        canceling_since: float | None = None
        lost_since: float | None = None
        while not result.done():
            self._executor.spin_once(timeout_sec=0.05)
            now = time.monotonic()
            if self._interrupts and canceling_since is None:
                canceling_since = now
                self._progress.say("canceling: waiting for the arm to stop (Ctrl-C: don't wait)")
                handle.cancel_goal_async()
            if canceling_since is not None and (
                self._interrupts > 1 or now - canceling_since > _CANCEL_PATIENCE_S
            ):
                raise _ClientError("canceled, but the arm was not seen to stop", EXIT_CANCELED)
            if self._action.server_is_ready():
                lost_since = None
            else:
                lost_since = lost_since or now
                if now - lost_since > _SERVER_LOST_S:
                    raise _ClientError("the calibration node went away; nothing was written")
            self._ask_if_needed()
        return result.result().result

    def close(self) -> None:
        """Leave ROS."""
        self._action.destroy()
        self._executor.remove_node(self._node)
        self._node.destroy_node()
        self._executor.shutdown()

    def _action_name(self) -> str:
        return self._node.resolve_service_name("calibrate_tool")

    def _goal(self) -> CalibrateTool.Goal:
        options = self._options
        return CalibrateTool.Goal(
            tool=options.tool,
            one_sweep=options.one_sweep,
            attach_by_service=not options.by_hand,
            tip_m=[math.nan] * 3 if options.tip is None else options.tip,
            iters_t=options.iters_t,
            iters_r=options.iters_r,
        )

    def _wait(self, predicate: Callable[[], bool], timeout_s: float, message: str) -> None:
        deadline = time.monotonic() + timeout_s
        while not predicate():
            if self._interrupts:
                raise _ClientError("canceled before anything began", EXIT_CANCELED)
            if time.monotonic() > deadline:
                raise _ClientError(message)
            self._executor.spin_once(timeout_sec=0.05)

    def _fail_refused(self) -> NoReturn:
        """An action's refusal carries no text; the node says it on /diagnostics, once a second."""
        deadline = time.monotonic() + 2.5
        while not self._refused and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.05)
        raise _ClientError(self._refused or "the calibration node refused the goal; see its log")

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.rsplit("/", 1)[-1] == self._options.node.rsplit("/", 1)[-1]:
                for item in status.values:
                    if item.key == "refused":
                        self._refused = item.value

    def _on_feedback(self, message: Any) -> None:
        feedback = message.feedback
        self._progress.show(feedback)
        asks = feedback.state in (State.REMOVE_TOOL, State.ATTACH_TOOL)
        if self._options.by_hand and asks and self._asked != feedback.state:
            if sys.stdin.isatty():
                # An Enter from before the question must not answer it: the arm would move.
                termios.tcflush(sys.stdin, termios.TCIFLUSH)
            self._progress.say(f"{feedback.message} - press Enter when done")
            self._question = True
        self._asked = feedback.state if asks else None

    def _ask_if_needed(self) -> None:
        """Hand an Enter on the terminal on to the node, without holding up the executor."""
        if not self._question or not select.select([sys.stdin], [], [], 0.0)[0]:
            return
        self._question = False
        if not sys.stdin.readline():
            self._progress.say(
                f"standard input has ended; confirm with the service {self._confirm.srv_name}"
            )
            return
        answering = self._confirm.call_async(Trigger.Request())

        def on_answer(future: Any) -> None:
            answer = future.result()
            if not answer.success:
                self._progress.say(f"not confirmed: {answer.message}")

        answering.add_done_callback(on_answer)


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and a message where it is wrong."""
    parser = argparse.ArgumentParser(
        prog="calibrate",
        description="Calibrate a tool on the arm: sweep over still poses, write the tool's file.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("tool", help="name of the tool and of its file: letters, digits, _ and -")
    parser.add_argument(
        "--tip",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="the tool's tip in ft_sensor, m; else the old file's is kept, or (0, 0, 0)",
    )
    parser.add_argument(
        "--one-sweep",
        action="store_true",
        help="only sweep with the tool on: half the time, but tool and adapter are then not fully"
        " told apart (a warning says what is not known)",
    )
    parser.add_argument(
        "--by-hand",
        action="store_true",
        help="a person takes the tool off and puts it on, and presses Enter here"
        " (default: the driver's service attach_tool does it)",
    )
    parser.add_argument("--iters-t", type=_count, default=0, help="number of tilts; 0: the node's")
    parser.add_argument("--iters-r", type=_count, default=0, help="number of rolls; 0: the node's")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.add_argument(
        "--timeout-s", type=float, default=10.0, help="wait so long for the node (default 10)"
    )
    parser.add_argument(
        "--node", default="calibration", help="the node's name, for ~/confirm (default calibration)"
    )
    options = parser.parse_args(arguments)
    try:
        check_tool_name(options.tool)
    except ToolNameError as error:
        parser.error(str(error))
    if options.tip is not None and not all(map(math.isfinite, options.tip)):
        parser.error("--tip needs three finite numbers")
    if not options.timeout_s > 0:
        parser.error("--timeout-s needs a positive number")
    return options


def _count(text: str) -> int:
    value = int(text)
    if not 0 <= value <= 100:
        raise argparse.ArgumentTypeError(f"{value} is not in 0 ... 100")
    return value


def main() -> None:
    """Run the client; see `calibrate --help`."""
    options = parse(remove_ros_args(sys.argv)[1:])
    progress = Progress()
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    client = CalibrateClient(options, progress)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, client.on_signal)
    try:
        result = client.run()
        progress.close()
        exit_code = _print_result(result, options.json)
    except _ClientError as failure:
        progress.close()
        print(f"calibrate: {failure}", file=sys.stderr)
        exit_code = failure.exit_code
    finally:
        client.close()
        rclpy.try_shutdown()
    raise SystemExit(exit_code)


def _print_result(result: Any, as_json: bool) -> int:
    if as_json:
        print(json.dumps(result_to_dict(result)))
    elif result.error_code == ErrorCode.NONE:
        print(format_result(result))
    if result.error_code == ErrorCode.NONE:
        return EXIT_OK
    name = ErrorCode(result.error_code).name
    print(f"calibrate: {name}: {result.error_msg}", file=sys.stderr)
    if not as_json:
        for text in result.poses_rejected:
            print(f"  rejected {text}", file=sys.stderr)
    return EXIT_CANCELED if result.error_code == ErrorCode.CANCELED else EXIT_FAILED


if __name__ == "__main__":
    main()
