# SPDX-License-Identifier: Apache-2.0
"""What commands share that send one goal to an action server and show how it goes on a terminal."""

from __future__ import annotations

import argparse
import signal
import sys
import time
import uuid
from array import array
from collections.abc import Callable
from enum import IntEnum
from types import FrameType
from typing import Any, ClassVar, NoReturn

import numpy as np
import rclpy
from action_msgs.srv import CancelGoal
from diagnostic_msgs.msg import DiagnosticArray
from galen_common.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    ProgressLine,
    add_json,
    positive,
)
from galen_common.executable import stop_signals, terminal_closed
from galen_model.errors import GalenError, ToolNameError
from galen_model.files.calibration_file import check_tool_name
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from unique_identifier_msgs.msg import UUID

from galen_ros.node.spin import init_ros
from galen_ros.rclpy_workarounds import guard_parameter_services

_SERVER_LOST_S = 1.5
_CANCEL_PATIENCE_S = 10.0


class ClientError(Exception):
    """Ends the client with a message and an exit code."""

    def __init__(self, message: str, exit_code: int = EXIT_FAILED) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class GoalClient:
    """One goal, from finding the server to its result; subclasses say which."""

    action_type: ClassVar[Any]
    action_name: ClassVar[str]
    node_name: ClassVar[str]
    server: ClassVar[str]
    """The executable that it needs."""
    server_node: ClassVar[str]
    """The name of its node."""
    lost: ClassVar[str]
    """What becomes of the goal if that goes away."""
    unit: ClassVar[str]
    """Of the bar."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Make the node and the action's client; ROS must be initialised.

        Args:
            options: those of `read_options`.

        """
        self.options = options
        self.bar = ProgressLine(self.unit)
        self.node = Node(self.node_name)
        guard_parameter_services(self.node)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._action = ActionClient(self.node, self.action_type, self.action_name)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._rejected = ""
        self._interrupts = 0

    def make_goal(self) -> Any:
        """Return the goal to send.

        Returns:
            The action's Goal.

        """
        raise NotImplementedError

    def on_feedback(self, feedback: Any) -> None:
        """Take one feedback.

        Args:
            feedback: the action's Feedback.

        """
        raise NotImplementedError

    def while_waiting(self) -> None:
        """Do what is to be done while the goal runs, some twenty times a second."""

    def on_signal(self, number: int, _frame: FrameType | None) -> None:
        """Note a Ctrl-C, or a terminal that closed; the second one does not wait for the arm.

        Args:
            number: of the signal.
            _frame: not used.

        """
        if number == signal.SIGHUP:
            terminal_closed()
        self._interrupts += 1

    def run(self) -> Any:
        """Send the goal and wait for its end.

        Returns:
            The action's Result.

        Raises:
            ClientError: there is none: no server, no answer, a rejection, an interruption, a lost
                server.

        """
        self._wait(
            self._action.server_is_ready,
            self.options.timeout_s,
            f"no action server {self.node.resolve_service_name(self.action_name)!r} after"
            f" {self.options.timeout_s:g} s: start {self.server} (and the driver) first, with the"
            " same ROS_DOMAIN_ID",
        )
        self._rejected = ""  # an earlier goal's, heard while the server was looked for
        goal_id = UUID(uuid=list(uuid.uuid4().bytes))
        sending = self._action.send_goal_async(
            self.make_goal(),
            feedback_callback=lambda message: self.on_feedback(message.feedback),
            goal_uuid=goal_id,
        )
        try:
            self._wait(
                sending.done,
                self.options.timeout_s,
                f"{self.server} did not answer the goal",
                "canceled while waiting for an answer to the goal",
            )
        except ClientError as error:
            raise ClientError(f"{error}; {self._take_back(goal_id)}", error.exit_code) from None
        handle = sending.result()
        if not handle.accepted:
            self._fail_rejected()
        result = handle.get_result_async()
        canceling_since: float | None = None
        lost_since: float | None = None
        while not result.done():
            self._executor.spin_once(timeout_sec=0.05)
            now = time.monotonic()
            if self._interrupts and canceling_since is None:
                canceling_since = now
                self.bar.line("canceling: waiting for the arm to stop (Ctrl-C: don't wait)")
                handle.cancel_goal_async()
            if canceling_since is not None and (
                self._interrupts > 1 or now - canceling_since > _CANCEL_PATIENCE_S
            ):
                raise ClientError("canceled, but the arm was not seen to stop", EXIT_INTERRUPTED)
            if self._action.server_is_ready():
                lost_since = None
            else:
                lost_since = lost_since or now
                if now - lost_since > _SERVER_LOST_S:
                    raise ClientError(f"{self.server} went away; {self.lost}")
            self.while_waiting()
        return result.result().result

    def close(self) -> None:
        """Leave ROS."""
        self._action.destroy()
        self._executor.remove_node(self.node)
        self.node.destroy_node()
        self._executor.shutdown()

    def _take_back(self, goal_id: UUID) -> str:
        """Cancel a goal without an answer, and say what came of it.

        The server may have begun it, and only the answer is late, or lost on a busy machine.
        """
        self.bar.line("canceling: the goal may have begun (Ctrl-C: don't wait)")
        interrupts, deadline = self._interrupts, time.monotonic() + _CANCEL_PATIENCE_S
        unanswered = self.action_type.Impl.SendGoalService.Response()
        canceling = ClientGoalHandle(self._action, goal_id, unanswered).cancel_goal_async()
        while not canceling.done():
            if time.monotonic() > deadline or self._interrupts > interrupts:
                return f"whether it has begun is not known: see {self.server}'s /diagnostics"
            self._executor.spin_once(timeout_sec=0.05)
        if canceling.result().goals_canceling:
            return "it had begun, and is canceled"
        return f"{self.server} reports no running goal"

    def _wait(
        self,
        predicate: Callable[[], bool],
        timeout_s: float,
        message: str,
        canceled: str = "canceled before anything began",
    ) -> None:
        deadline = time.monotonic() + timeout_s
        while not predicate():
            if self._interrupts:
                raise ClientError(canceled, EXIT_INTERRUPTED)
            if time.monotonic() > deadline:
                raise ClientError(message)
            self._executor.spin_once(timeout_sec=0.05)

    def _fail_rejected(self) -> NoReturn:
        """Raise the reason, from /diagnostics: an action's rejection has no text."""
        deadline = time.monotonic() + 2.5
        while not self._rejected and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.05)
        raise ClientError(self._rejected or f"{self.server} rejected the goal; see its log")

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.rsplit("/", 1)[-1] == self.server_node:
                for item in status.values:
                    if item.key == "rejected":
                        self._rejected = item.value


def add_client_options(parser: argparse.ArgumentParser) -> None:
    """Add `--json` and `--timeout-s`, which each of these commands takes, for `read_options`.

    Args:
        parser: the command's.

    """
    add_json(parser)
    parser.add_argument(
        "--timeout-s", type=positive, default=10.0, help="wait so long for the node (default 10)"
    )


def read_options(
    parser: argparse.ArgumentParser, arguments: list[str], **names: str
) -> argparse.Namespace:
    """Read the command line; exits with code 2 and a message where it is wrong.

    Args:
        parser: with all of the command's options.
        arguments: the command's own, without ROS's.
        **names: the options that become names of files, and what `check_tool_name` calls each.

    Returns:
        The options.

    """
    options = parser.parse_args(arguments)
    try:
        for name, whose in names.items():
            if (value := getattr(options, name)) != parser.get_default(name):
                check_tool_name(value, whose)
    except ToolNameError as error:
        parser.error(str(error))
    return options


def result_to_dict(result: Any) -> dict[str, Any]:
    """Return an action's result as plain numbers, texts and lists, SI units.

    Args:
        result: the action's Result, of fields that are no messages themselves.

    Returns:
        Values by the field's name.

    """
    return {name: plain(getattr(result, name)) for name in result.get_fields_and_field_types()}


def plain(value: Any) -> Any:
    """Return a field's value as JSON takes it.

    Args:
        value: of a message's field.

    Returns:
        A list for an array, else the value itself.

    """
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, array) else value


def report_error(name: str, code: IntEnum, message: str) -> int:
    """Print why a command's goal failed.

    Args:
        name: the command's name, which begins the line.
        code: of the result.
        message: the result's sentence.

    Returns:
        The exit code; EXIT_OK, and nothing printed, where the code is NONE.

    """
    if code.name == "NONE":
        return EXIT_OK
    print(f"{name}: {code.name}: {message}", file=sys.stderr)
    return EXIT_INTERRUPTED if code.name == "CANCELED" else EXIT_FAILED


def cancel_goals(name: str, client: type[GoalClient], timeout_s: float) -> NoReturn:
    """Cancel whatever goal of a client's action runs; leave with an exit code.

    Args:
        name: the command's name, which begins an error's line.
        client: names action and server; no instance is made.
        timeout_s: how long to wait for the server, and for its answer, s of wall time.

    Raises:
        SystemExit: always; with EXIT_OK also where no goal runs.

    """
    _init_ros(name)
    node = Node(f"{client.node_name}_cancel")
    try:
        service = node.create_client(CancelGoal, f"{client.action_name}/_action/cancel_goal")
        if not service.wait_for_service(timeout_s):
            print(f"{name}: no {client.server} after {timeout_s:g} s", file=sys.stderr)
            raise SystemExit(EXIT_FAILED)
        answer = service.call_async(CancelGoal.Request())  # of no id and no time: all
        rclpy.spin_until_future_complete(node, answer, timeout_sec=timeout_s)
        result = answer.result() if answer.done() else None
        if result is None:
            print(f"{name}: {client.server} did not answer", file=sys.stderr)
            raise SystemExit(EXIT_FAILED)
        count = len(result.goals_canceling)
        print(
            f"{count} goal{'s' * (count != 1)} canceled; the arm is stopped"
            if count
            else f"{client.server} runs no goal"
        )
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    raise SystemExit(EXIT_OK)


def _init_ros(name: str) -> None:
    try:
        init_ros(sys.argv)
    except GalenError as error:
        print(f"{name}: {error}", file=sys.stderr)
        raise SystemExit(EXIT_USAGE) from None


def run_client(
    name: str,
    make: Callable[[argparse.Namespace], GoalClient],
    options: argparse.Namespace,
    print_result: Callable[[Any, bool], int],
) -> NoReturn:
    """Make the client, run it to its end and leave with an exit code.

    Args:
        name: the command's name, which begins an error's line.
        make: makes the client from the options.
        options: those of `read_options`.
        print_result: prints the result of a goal that came to its end, as JSON where its second
            argument is True; returns the exit code.

    Raises:
        SystemExit: always.

    """
    _init_ros(name)
    client = make(options)
    for number in stop_signals():
        signal.signal(number, client.on_signal)
    try:
        result = client.run()
        client.bar.close()
        exit_code = print_result(result, options.json)
    except ClientError as failure:
        client.bar.close()
        print(f"{name}: {failure}", file=sys.stderr)
        exit_code = failure.exit_code
    finally:
        client.close()
        rclpy.try_shutdown()
    raise SystemExit(exit_code)
