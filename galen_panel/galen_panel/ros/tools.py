"""gravcomp's list of calibration files and what it has active, on the board."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from galen_ros.messages import LATCHED
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from galen_msgs.msg import ActiveTool
from galen_msgs.srv import CompareTools, ListTools, RemoveTool, RevertTool, SetTool
from galen_panel.messages.hints import GRAVCOMP
from galen_panel.ros.board import Board, Presence
from galen_panel.ros.thread import CallError, Calls
from galen_panel.snapshot import (
    ListedTool,
    LoadedTool,
    QuantityDifference,
    SuiteState,
    ToolComparison,
)

_LIST_PERIOD_S = 10.0
FILE_LIMIT_S = 5.0
_FILE_STATES = {
    ActiveTool.FILE_NONE: "none",
    ActiveTool.FILE_AS_LOADED: "as loaded",
    ActiveTool.FILE_CHANGED: "changed",
    ActiveTool.FILE_GONE: "gone",
}


class Tools:
    """Keeps the tools on the board, and calls gravcomp's services."""

    def __init__(self, node: Node, board: Board, calls: Calls, presence: Presence) -> None:
        self._board = board
        self._calls = calls
        self._clients = {
            name: node.create_client(kind, f"gravcomp/{name}")
            for name, kind in (
                ("set_tool", SetTool),
                ("list_tools", ListTools),
                ("compare_tools", CompareTools),
                ("remove_tool", RemoveTool),
                ("revert_tool", RevertTool),
                ("enable", SetBool),
                ("tare", Trigger),
            )
        }
        for name, client in self._clients.items():
            presence.add(f"gravcomp/{name}", client)
        self._active: LoadedTool | None = None
        self._there = False
        self._listing = False
        self._list_again = False
        self._next_list_s = 0.0
        node.create_subscription(ActiveTool, "gravcomp/active_tool", self._on_active_tool, LATCHED)

    # In the ROS thread

    def tick(self, now_s: float) -> None:
        """See whether gravcomp came or went, and ask for the list where it is time to."""
        there = "gravcomp/set_tool" in self._board.state.available
        if there != self._there:
            self._there = there
            if not there:
                self._active = None
            self._next_list_s = now_s
            self._show_active()
        if now_s >= self._next_list_s and "gravcomp/list_tools" in self._board.state.available:
            self._next_list_s = now_s + _LIST_PERIOD_S
            self.refresh()

    def refresh(self) -> None:
        """Ask for the list, after the one that is under way."""
        if self._listing:
            self._list_again = True
            return
        self._listing = True
        self._calls.send(
            self._clients["list_tools"],
            ListTools.Request(),
            GRAVCOMP,
            FILE_LIMIT_S,
            self._on_listed,
        )

    def _on_listed(self, answer: Any) -> None:
        self._listing = False
        if isinstance(answer, CallError):
            self._board.put(tools_problem=str(answer))
        else:
            self._show_list(answer)
        if self._list_again:
            self._list_again = False
            self.refresh()

    def _on_active_tool(self, message: ActiveTool) -> None:
        before, self._active = self._active, _active(message)
        self._show_active()
        # A bias drift's estimate changes all the time, the files don't.
        if before is None or _of_file(before) != _of_file(self._active):
            self._next_list_s = 0.0

    def _show_active(self) -> None:
        active_tool = self._active if self._there else None

        def changes(state: SuiteState) -> dict[str, Any]:
            tools = None if state.tools is None else _marked(state.tools, active_tool)
            return {"active_tool": active_tool, "tools": tools}

        self._board.change(changes)

    # In any thread

    def _show_list(self, response: Any) -> None:
        if not response.success:
            self._board.put(tools_dir=response.tools_dir, tools_problem=response.error_msg)
            return
        left_out = f"{response.left_out} more files are there" if response.left_out else ""
        tools = tuple(map(_tool, response.tools))
        self._board.change(
            lambda state: {
                "tools": _marked(tools, state.active_tool),
                "tools_dir": response.tools_dir,
                "tools_problem": left_out,
            }
        )

    # In the event loop

    async def ask(self, name: str, request: Any, timeout_s: float | None = None) -> Any:
        """Call one of gravcomp's services and return its response; raises CallError."""
        limit_s = FILE_LIMIT_S if timeout_s is None else timeout_s
        return await self._calls.ask(self._clients[name], request, GRAVCOMP, limit_s)

    async def list_tools(self) -> Any:
        """Show the list anew and return the service's response; raises CallError."""
        response = await self.ask("list_tools", ListTools.Request())
        self._show_list(response)
        return response

    async def list_quietly(self) -> None:
        """Show the list with the answer to a change of a file; a failure is shown, too."""
        try:
            await self.list_tools()
        except CallError as error:
            self._board.put(tools_problem=str(error))


def _marked(tools: Iterable[ListedTool], active_tool: LoadedTool | None) -> tuple[ListedTool, ...]:
    name = "" if active_tool is None else active_tool.tool
    return tuple(replace(tool, active_tool=bool(name) and tool.name == name) for tool in tools)


def _of_file(active_tool: LoadedTool) -> tuple[str, str, str]:
    return active_tool.tool, active_tool.calibrated_at, active_tool.file_state


def _floats(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(map(float, values))


def _tool(row: Any) -> ListedTool:
    return ListedTool(
        name=row.tool,
        mass_kg=row.mass_kg,
        mass_std_kg=row.mass_std_kg,
        com_m=_floats(row.com_m),
        rmse_force_n=_floats(row.rmse_force_n),
        rmse_torque_nm=_floats(row.rmse_torque_nm),
        poses_used=row.poses_used,
        calibrated_at=row.calibrated_at,
        parts=tuple(row.parts),
        has_previous=row.has_previous,
        problem=row.problem,
    )


def _active(message: ActiveTool) -> LoadedTool:
    force, torque = message.tare.force, message.tare.torque
    tare = (force.x, force.y, force.z, torque.x, torque.y, torque.z)
    return LoadedTool(
        tool=message.tool,
        enabled=message.enabled,
        mass_kg=message.mass_kg,
        com_m=_floats(message.com_m),
        tip_m=_floats(message.tip_m),
        calibrated_at=message.calibrated_at,
        file_state=_FILE_STATES.get(message.file_state, "unknown"),
        tare=_floats(tare) if message.tared else None,
    )


def comparison(response: Any) -> ToolComparison:
    """Read the response of `compare_tools`."""
    return ToolComparison(
        response.text,
        response.same_load,
        tuple(
            QuantityDifference(row.quantity, row.unit, row.a, row.b, row.std_dev, row.text)
            for row in response.differences
        ),
        response.worst_force_n,
        response.worst_torque_nm,
    )
