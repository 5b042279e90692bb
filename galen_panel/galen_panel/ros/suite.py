"""The suite over ROS: the services, actions and topics that any client may use."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Coroutine
from contextlib import AbstractContextManager
from typing import Any, Concatenate, ParamSpec, TypeVar

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.files.calibration_file import check_tool_name
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from galen_msgs.srv import CompareTools, RemoveTool, RevertTool, SetTool
from galen_panel.history import History
from galen_panel.messages.programs import CALIBRATION
from galen_panel.ros.board import Board, Presence, Tools, comparison, hear_reports
from galen_panel.ros.goal_kinds import KINDS
from galen_panel.ros.goals import GoalFollower
from galen_panel.ros.streams import Streams
from galen_panel.ros.thread import Calls, RosThread
from galen_panel.snapshot import (
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

    def __init__(self, argv: list[str], arm: Arm = GALEN) -> None:
        """`argv`: the command line, with what is ROS's; raises GalenError."""
        self._board = Board()
        self.arm = arm
        self.history = History(arm)
        """The streams' newest samples; it grows only while a page shows them."""
        self._thread = RosThread()
        self.streams = Streams(self.history, self._thread.context, arm)
        self._calls = Calls(self._thread)
        self._thread.start(NODE_NAME, argv, self._set_up, self.streams.close)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave ROS; open calls end with an answer. May be called more than once."""
        self._thread.close()

    def _set_up(self, node: Node) -> Callable[[float], None]:
        board, calls = self._board, self._calls
        board.put(namespace=node.get_namespace().strip("/"))
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

    @property
    def state(self) -> SuiteState:
        """The newest snapshot."""
        return self._board.state

    def watch(self) -> AbstractContextManager[None]:
        """Listen to the streams within it; the last one to leave stops that."""
        return self.streams.watch()

    @_answered
    async def list_tools(self) -> CallAnswer:
        """Ask anew for the tools; they are then in `state`."""
        response = await self._tools.list_tools()
        if not response.success:
            return CallAnswer(False, response.error_msg)
        count = len(response.tools)
        return CallAnswer(True, f"{count} tool{'' if count == 1 else 's'} in {response.tools_dir}")

    @_answered
    async def activate(self, tool: str) -> CallAnswer:
        """Have gravcomp load a calibration file; "" for no tool."""
        request = SetTool.Request(tool=check_tool_name(tool) if tool else "")
        response = await self._tools.ask("set_tool", request)
        if not response.success:
            return CallAnswer(False, response.error_msg)
        return CallAnswer(True, f"{response.tool} is active" if tool else "no tool is active")

    @_answered
    async def remove_tool(self, tool: str) -> CallAnswer:
        """Remove a calibration file from the list; it is kept beside."""
        request = RemoveTool.Request(tool=check_tool_name(tool))
        response = await self._tools.ask("remove_tool", request)
        if not response.success:
            return CallAnswer(False, response.error_msg)
        await self._tools.list_quietly()
        return CallAnswer(True, f"{tool} is removed; its file is kept as {response.kept_as}")

    @_answered
    async def revert_tool(self, tool: str) -> CallAnswer:
        """Bring back the calibration before the present one."""
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
        """Compare a tool's calibration (b) with its own before (a)."""
        name = check_tool_name(tool)
        request = CompareTools.Request(a=name, a_previous=True, b=name)
        response = await self._tools.ask("compare_tools", request)
        return comparison(response) if response.success else CallAnswer(False, response.error_msg)

    @_answered
    async def set_enabled(self, enabled: bool) -> CallAnswer:
        """Switch the compensation."""
        request = SetBool.Request(data=enabled)
        response = await self._tools.ask("enable", request, _SWITCH_LIMIT_S)
        return CallAnswer(response.success, response.message)

    @_answered
    async def tare(self) -> CallAnswer:
        """Subtract the present residual; answers when it is done."""
        response = await self._tools.ask("tare", Trigger.Request(), _TARE_LIMIT_S)
        return CallAnswer(response.success, response.message)

    @_answered
    async def start(self, goal: Goal) -> CallAnswer:
        """Send a goal; answers when it is accepted or rejected."""
        if goal.kind is BehaviourKind.CALIBRATE and "gravcomp/list_tools" in self.state.available:
            # Whether the tool had a file before is read from the list.
            await self._tools.list_quietly()
        return await self._followers[goal.kind].start(goal)

    @_answered
    async def confirm(self) -> CallAnswer:
        """Tell a calibration that the person has done what it asked."""
        response = await self._calls.ask(
            self._confirm, Trigger.Request(), CALIBRATION, _SWITCH_LIMIT_S
        )
        return CallAnswer(
            response.success, response.message or "confirmed: the calibration goes on"
        )

    @_answered
    async def cancel(self, kind: BehaviourKind) -> CallAnswer:
        """Cancel a behaviour's goal, of any client; answers when that is accepted."""
        return await self._followers[kind].cancel()
