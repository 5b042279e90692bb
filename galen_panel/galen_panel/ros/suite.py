# SPDX-License-Identifier: Apache-2.0
"""The suite over ROS: the services, actions and topics that any client may use."""

from __future__ import annotations

import functools
import itertools
import json
import threading
from collections.abc import Callable, Coroutine
from contextlib import AbstractContextManager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from galen_common.arm import ArmParameters
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError, one_line
from galen_model.files.calibration_file import check_tool_name
from galen_ros.node.parameters import Held
from galen_ros.node.robot_description import ArmSource
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from galen_msgs.srv import CompareTools, RemoveTool, RevertTool, SetTool
from galen_panel.messages.programs import CALIBRATION
from galen_panel.ros.board import Board, Presence, Tools, comparison, hear_reports
from galen_panel.ros.goal_kinds import KINDS
from galen_panel.ros.goals import GoalFollower
from galen_panel.ros.streams import Streams
from galen_panel.ros.thread import Calls, RosThread
from galen_panel.state.history import History
from galen_panel.state.shapes import draw
from galen_panel.state.snapshot import (
    TOOLS_DIR,
    BehaviourKind,
    CallAnswer,
    Goal,
    NodeReport,
    SuiteState,
    ToolComparison,
)

P = ParamSpec("P")
T = TypeVar("T")

NODE_NAME = "panel"
_SWITCH_LIMIT_S = 3.0
# It averages, and waits for samples (parameters tare_window_s and tare_timeout_s).
_TARE_LIMIT_S = 20.0


def _answered(
    call: Callable[Concatenate[RosSuite, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[RosSuite, P], Coroutine[Any, Any, T | CallAnswer]]:
    """Give an error as an answer: no call of the page raises."""

    @functools.wraps(call)
    async def safe(suite: RosSuite, *args: P.args, **kwargs: P.kwargs) -> T | CallAnswer:
        try:
            return await call(suite, *args, **kwargs)
        except GalenError as error:
            return CallAnswer(False, str(error))

    return safe


class RosSuite(AbstractContextManager["RosSuite"]):
    """The suite as the page sees it, by a ROS node of its own."""

    def __init__(self, argv: list[str], tools_dir: Path = TOOLS_DIR) -> None:
        """Start the panel's node in a thread of its own.

        Args:
            argv: the command line with its ROS arguments.
            tools_dir: folder of calibration files, until gravcomp reports its own.

        Raises:
            GalenError: ROS can't be initialised, or a parameter or the arm can't be used.

        """
        self._board = Board()
        self._board.put(tools_dir=str(tools_dir.expanduser().absolute()))
        self.history = History(GALEN)
        """The streams' newest samples; it grows only while a page shows them."""
        self._thread = RosThread()
        self.streams = Streams(self.history, self._thread.context)
        self._calls = Calls(self._thread, lambda program: program.absent(self.state))
        self._thread.start(NODE_NAME, argv, self._set_up, self.streams.close)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave ROS; open calls end with an answer. May be called more than once."""
        self._thread.close()

    def _set_up(self, node: Node) -> Callable[[float], None]:
        board, calls = self._board, self._calls
        self._arm_parameters = Held(node, ArmParameters)
        board.put(
            namespace=node.get_namespace().strip("/"), given=_given(node, self._arm_parameters.now)
        )
        self._source = ArmSource(
            node, self._arm_parameters, self._on_description, "start the panel again to show it"
        )
        if self._source.waiting:
            board.put(arm_problem=f"No arm is shown: {self._source.waiting}")
        else:
            self._show_arm()
        presence = Presence(board)
        self._tools = tools = Tools(node, board, calls, presence)
        self._confirm = node.create_client(Trigger, "calibration/confirm")
        presence.add("calibration/confirm", self._confirm)
        presence.add("attach_tool", node.create_client(SetTool, "attach_tool"))
        numbers = itertools.count(1)
        self._followers = followers = {
            kind.kind: GoalFollower(
                node, kind, board, self._thread, calls, presence, numbers, tools.refresh
            )
            for kind in KINDS
        }

        def on_report(report: NodeReport) -> None:
            for follower in followers.values():
                follower.on_report(report)

        hear_reports(node, board, on_report)

        def on_beat(now_s: float) -> None:
            self.streams.tick(now_s)
            calls.tick(now_s)
            presence.tick(now_s)
            tools.tick(now_s)
            for follower in followers.values():
                follower.tick(now_s)

        return on_beat

    def _show_arm(self) -> None:
        """Show the arm of the parameters, or of the description that came; raises GalenError."""
        arm = self._source.take()
        self.streams.follow(arm)
        self._board.put(drawing=draw(arm, shapes=False), arm_problem="")
        # This thread has goals to follow meanwhile. It isn't a daemon: what the interpreter's end
        # would stop inside a library may take the process with it.
        threading.Thread(target=lambda: self._board.put(drawing=draw(arm)), name="shapes").start()

    def _on_description(self) -> None:
        try:
            if self.state.drawing is None:
                self._show_arm()
            else:
                self._board.put(arm_problem=self._difference(self.state.drawing.arm))
        except GalenError as error:
            self._board.put(arm_problem=one_line(f"Description not used: {error}"))

    def _difference(self, arm: Arm) -> str:
        """Say what the topic has otherwise than the arm that is shown; raises GalenError."""
        parameters = self._arm_parameters.now
        if parameters.use_robot_description:
            return one_line(self._source.trouble)
        other = replace(parameters, urdf_file="").arm(self._source.text)
        found = arm.difference(other)
        return found and one_line(
            f"The arm {arm.name} is shown, but robot_description has {other.name}: {found}. To"
            " show that one, start the panel again with use_robot_description:=true."
        )

    @property
    def state(self) -> SuiteState:
        """The newest snapshot."""
        return self._board.state

    def watch(self) -> AbstractContextManager[None]:
        """Listen to the streams within it; the last one to leave stops that."""
        return self.streams.watch()

    @_answered
    async def list_tools(self) -> CallAnswer:
        """Ask anew for the tools; they are then in `state`.

        Returns:
            Whether it was done, and a sentence.

        """
        response = await self._tools.list_tools()
        if not response.success:
            return CallAnswer(False, response.error_msg)
        count = len(response.tools)
        return CallAnswer(True, f"{count} tool{'' if count == 1 else 's'} in {response.tools_dir}")

    @_answered
    async def activate(self, tool: str) -> CallAnswer:
        """Have gravcomp load a calibration file.

        Args:
            tool: its name; empty: no tool.

        Returns:
            Whether it was done, and a sentence.

        """
        request = SetTool.Request(tool=check_tool_name(tool) if tool else "")
        response = await self._tools.ask("set_tool", request)
        if not response.success:
            return CallAnswer(False, response.error_msg)
        return CallAnswer(True, f"{response.tool} is active" if tool else "no tool is active")

    @_answered
    async def remove_tool(self, tool: str) -> CallAnswer:
        """Remove a calibration file from the list; it is kept beside.

        Args:
            tool: its name.

        Returns:
            Whether it was done, and a sentence.

        """
        request = RemoveTool.Request(tool=check_tool_name(tool))
        response = await self._tools.ask("remove_tool", request)
        if not response.success:
            return CallAnswer(False, response.error_msg)
        await self._tools.list_quietly()
        return CallAnswer(True, f"{tool} is removed; its file is kept as {response.kept_as}")

    @_answered
    async def revert_tool(self, tool: str) -> CallAnswer:
        """Bring back the calibration before the present one.

        Args:
            tool: its name.

        Returns:
            Whether it was done, and a sentence.

        """
        request = RevertTool.Request(tool=check_tool_name(tool))
        response = await self._tools.ask("revert_tool", request)
        if not response.success:
            return CallAnswer(False, response.error_msg)
        await self._tools.list_quietly()
        active_tool = self.state.active_tool
        again = active_tool is not None and active_tool.tool == tool
        load = f"; activate {tool} to load it" if again else ""
        return CallAnswer(True, f"{tool} has its calibration before the last one again{load}")

    @_answered
    async def compare(self, tool: str) -> ToolComparison | CallAnswer:
        """Compare a tool's calibration (b) with its own before (a).

        Args:
            tool: its name.

        Returns:
            The comparison; an answer with the reason where there is none.

        """
        name = check_tool_name(tool)
        request = CompareTools.Request(a=name, a_previous=True, b=name)
        response = await self._tools.ask("compare_tools", request)
        return comparison(response) if response.success else CallAnswer(False, response.error_msg)

    @_answered
    async def set_enabled(self, enabled: bool) -> CallAnswer:
        """Switch the compensation.

        Args:
            enabled: whether compensated wrenches are to be published.

        Returns:
            Whether it was done, and gravcomp's sentence.

        """
        request = SetBool.Request(data=enabled)
        response = await self._tools.ask("enable", request, _SWITCH_LIMIT_S)
        return CallAnswer(response.success, response.message)

    @_answered
    async def tare(self) -> CallAnswer:
        """Subtract the present residual; answers when it is done.

        Returns:
            Whether it was done, and gravcomp's sentence.

        """
        response = await self._tools.ask("tare", Trigger.Request(), _TARE_LIMIT_S)
        return CallAnswer(response.success, response.message)

    @_answered
    async def start(self, goal: Goal) -> CallAnswer:
        """Send a goal; answers when it is accepted or rejected.

        Args:
            goal: of any kind.

        Returns:
            Whether it was accepted, and a sentence.

        """
        if goal.kind is BehaviourKind.CALIBRATE and "gravcomp/list_tools" in self.state.available:
            # Whether the tool had a file before is read from the list.
            await self._tools.list_quietly()
        return await self._followers[goal.kind].start(goal)

    @_answered
    async def confirm(self) -> CallAnswer:
        """Confirm to a calibration that the person has done what it asked.

        Returns:
            Whether it was waiting for that, and a sentence.

        """
        response = await self._calls.ask(
            self._confirm, Trigger.Request(), CALIBRATION, _SWITCH_LIMIT_S
        )
        return CallAnswer(
            response.success, response.message or "confirmed: the calibration goes on"
        )

    @_answered
    async def cancel(self, kind: BehaviourKind) -> CallAnswer:
        """Cancel a behaviour's goal, of any client; answers when that is accepted.

        Args:
            kind: of the behaviour.

        Returns:
            Whether it is being canceled, and a sentence.

        """
        return await self._followers[kind].cancel()


_INPUTS = ("wrench_raw", "joint_states", "robot_description")


def _given(node: Node, arm: ArmParameters) -> tuple[tuple[str, str], ...]:
    """Return in what the panel's inputs and its arm differ from the defaults."""
    namespace = node.get_namespace().rstrip("/")
    topics = {name: node.resolve_topic_name(name) for name in _INPUTS}
    found = [
        ("-r", f"{name}:={topic}")
        for name, topic in topics.items()
        if topic != f"{namespace}/{name}"
    ]
    for name, default in ((field.name, field.default) for field in fields(arm)):
        value = getattr(arm, name)
        if value == default:
            continue
        if name == "urdf_file":
            value = str(Path(value).expanduser().absolute())
        found.append(("-p", f"{name}:={value if isinstance(value, str) else json.dumps(value)}"))
    return tuple(found)
