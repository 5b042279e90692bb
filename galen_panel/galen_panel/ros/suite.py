"""The suite over ROS: the services, actions and topics that anybody may use."""

from __future__ import annotations

import itertools
from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager
from typing import TypeVar

from galen_model.errors import GalenError
from rclpy.node import Node
from std_srvs.srv import Trigger

from galen_msgs.srv import SetTool
from galen_panel.history import History
from galen_panel.messages.hints import CALIBRATION
from galen_panel.ros.board import Board, Presence, Reports
from galen_panel.ros.goal_kinds import KINDS, kind_of
from galen_panel.ros.goals import GoalFollower
from galen_panel.ros.streams import Streams
from galen_panel.ros.thread import Calls, RosThread
from galen_panel.ros.tools import Tools
from galen_panel.snapshot import Answer, CalibrateGoal, Comparison, Goal, Kind, NodeReport, State

T = TypeVar("T")

NODE_NAME = "panel"
_CONFIRM_LIMIT_S = 3.0


class RosSuite(AbstractContextManager["RosSuite"]):
    """A `galen_panel.snapshot.Suite` in a ROS node of its own."""

    def __init__(self, argv: list[str]) -> None:
        """`argv`: the command line, with what is ROS's; raises StartError."""
        self._board = Board()
        self._history = History()
        self._thread = RosThread()
        self.streams = Streams(self._history, self._thread.context)
        self._calls = Calls(self._thread)
        self._thread.start(NODE_NAME, argv, self._set_up, self.streams.close)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave ROS; who still waits for an answer is told so. May be called more than once."""
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

        Reports(node, board, on_report)

        def on_beat(now_s: float) -> None:
            self.streams.tick(now_s)
            calls.tick(now_s)
            presence.tick(now_s)
            tools.tick(now_s)
            for follower in followers.values():
                follower.tick(now_s)

        return on_beat

    @property
    def state(self) -> State:
        """The newest snapshot."""
        return self._board.state

    @property
    def history(self) -> History:
        """The streams' newest samples."""
        return self._history

    def watch(self) -> AbstractContextManager[None]:
        """See Suite."""
        return self.streams.watch()

    async def list_tools(self) -> Answer:
        """See Suite."""
        return await _answer(self._tools.list_tools())

    async def activate(self, tool: str) -> Answer:
        """See Suite."""
        return await _answer(self._tools.activate(tool))

    async def remove_tool(self, tool: str) -> Answer:
        """See Suite."""
        return await _answer(self._tools.remove_tool(tool))

    async def revert_tool(self, tool: str) -> Answer:
        """See Suite."""
        return await _answer(self._tools.revert_tool(tool))

    async def compare(self, tool: str, with_tool: str = "") -> Comparison | Answer:
        """See Suite."""
        return await _answer(self._tools.compare(tool, with_tool))

    async def set_enabled(self, enabled: bool) -> Answer:
        """See Suite."""
        return await _answer(self._tools.set_enabled(enabled))

    async def tare(self) -> Answer:
        """See Suite."""
        return await _answer(self._tools.tare())

    async def start(self, goal: Goal) -> Answer:
        """See Suite."""
        if isinstance(goal, CalibrateGoal) and "gravcomp/list_tools" in self.state.available:
            # Whether the tool had a file before is told from the list.
            await self.list_tools()
        return await _answer(self._followers[kind_of(goal)].start(goal))

    async def confirm(self) -> Answer:
        """See Suite."""
        return await _answer(self._ask_confirm())

    async def cancel(self, kind: Kind) -> Answer:
        """See Suite."""
        return await _answer(self._followers[kind].cancel())

    async def _ask_confirm(self) -> Answer:
        response = await self._calls.ask(
            self._confirm, Trigger.Request(), CALIBRATION, _CONFIRM_LIMIT_S
        )
        return Answer(response.success, response.message or "confirmed: the calibration goes on")


async def _answer(work: Awaitable[T]) -> T | Answer:
    try:
        return await work
    except GalenError as error:
        return Answer(False, str(error))
