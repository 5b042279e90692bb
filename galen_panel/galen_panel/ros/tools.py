"""gravcomp's services on the tools' files, what it has active, its switch and its tare."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from galen_gravcomp.tools.client import to_dict
from galen_model.files.calibration_file import check_tool_name
from galen_ros.qos import LATCHED
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from galen_msgs.msg import ActiveTool
from galen_msgs.srv import CompareTools, ListTools, RemoveTool, RevertTool, SetTool
from galen_panel.messages.hints import GRAVCOMP
from galen_panel.ros.board import Board, Presence
from galen_panel.ros.thread import CallError, Calls
from galen_panel.snapshot import Active, Answer, Comparison, Difference, State, Tool

_LIST_PERIOD_S = 10.0
_FILE_LIMIT_S, _SWITCH_LIMIT_S = 5.0, 3.0
# It averages, and waits for samples (parameters tare_window_s and tare_timeout_s).
_TARE_LIMIT_S = 20.0


class Tools:
    """The tools on the board, and what can be asked of gravcomp."""

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
        self._active: Active | None = None
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
            _FILE_LIMIT_S,
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

        def changes(state: State) -> dict[str, Any]:
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

    # In the event loop; all raise CallError, or ToolNameError for names that can't be

    async def list_tools(self) -> Answer:
        """As in `Suite`, as all below."""
        response = await self._ask("list_tools", ListTools.Request(), _FILE_LIMIT_S)
        self._show_list(response)
        if not response.success:
            return Answer(False, response.error_msg)
        count = len(response.tools)
        return Answer(True, f"{count} tool{'' if count == 1 else 's'} in {response.tools_dir}")

    async def activate(self, tool: str) -> Answer:
        """An empty name is no tool."""
        request = SetTool.Request(tool=check_tool_name(tool) if tool else "")
        response = await self._ask("set_tool", request, _FILE_LIMIT_S)
        if not response.success:
            return Answer(False, response.error_msg)
        return Answer(True, f"{response.tool} is active" if tool else "no tool is active")

    async def remove_tool(self, tool: str) -> Answer:
        """The file is kept beside."""
        request = RemoveTool.Request(tool=check_tool_name(tool))
        response = await self._ask("remove_tool", request, _FILE_LIMIT_S)
        if not response.success:
            return Answer(False, response.error_msg)
        await self._list_quietly()
        return Answer(True, f"{tool} is removed; its file is kept as {response.kept_as}")

    async def revert_tool(self, tool: str) -> Answer:
        """The present calibration becomes the one before."""
        request = RevertTool.Request(tool=check_tool_name(tool))
        response = await self._ask("revert_tool", request, _FILE_LIMIT_S)
        if not response.success:
            return Answer(False, response.error_msg)
        await self._list_quietly()
        active_tool = self._board.state.active_tool
        again = active_tool is not None and active_tool.tool == tool
        load = f"; activate {tool} to load it" if again else ""
        return Answer(True, f"{tool} has its calibration before the last one again{load}")

    async def compare(self, tool: str, with_tool: str = "") -> Comparison | Answer:
        """Against the calibration before it where `with_tool` is empty."""
        request = CompareTools.Request(
            a=check_tool_name(with_tool or tool),
            a_previous=not with_tool,
            b=check_tool_name(tool),
        )
        response = await self._ask("compare_tools", request, _FILE_LIMIT_S)
        return _comparison(response) if response.success else Answer(False, response.error_msg)

    async def set_enabled(self, enabled: bool) -> Answer:
        """Switch the compensation."""
        response = await self._ask("enable", SetBool.Request(data=enabled), _SWITCH_LIMIT_S)
        return Answer(response.success, response.message)

    async def tare(self) -> Answer:
        """The answer comes when it is done."""
        response = await self._ask("tare", Trigger.Request(), _TARE_LIMIT_S)
        return Answer(response.success, response.message)

    async def _list_quietly(self) -> None:
        """So that who has changed a file sees it in the list with the answer."""
        try:
            self._show_list(await self._ask("list_tools", ListTools.Request(), _FILE_LIMIT_S))
        except CallError as error:
            self._board.put(tools_problem=str(error))

    async def _ask(self, name: str, request: Any, timeout_s: float) -> Any:
        return await self._calls.ask(self._clients[name], request, GRAVCOMP, timeout_s)


def _marked(tools: Iterable[Tool], active_tool: Active | None) -> tuple[Tool, ...]:
    name = "" if active_tool is None else active_tool.tool
    return tuple(replace(tool, active_tool=bool(name) and tool.name == name) for tool in tools)


def _of_file(active_tool: Active) -> tuple[str, str, str]:
    return active_tool.tool, active_tool.calibrated_at, active_tool.file_state


def _floats(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(map(float, values))


def _tool(row: Any) -> Tool:
    return Tool(
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


def _active(message: ActiveTool) -> Active:
    content = to_dict(message)
    tare, bias_drift = content["tare"], content["bias_drift"]
    return Active(
        tool=content["tool"],
        enabled=content["enabled"],
        mass_kg=content["mass_kg"],
        com_m=_floats(content["com_m"]),
        tip_m=_floats(content["tip_m"]),
        calibrated_at=content["calibrated_at"],
        file_state=content["file_state"],
        tare=None if tare is None else _floats(tare),
        bias_drift=None if bias_drift is None else _floats(bias_drift),
    )


def _comparison(response: Any) -> Comparison:
    return Comparison(
        response.text,
        response.same_load,
        tuple(
            Difference(row.quantity, row.unit, row.a, row.b, row.std_dev, row.text)
            for row in response.differences
        ),
        response.worst_force_n,
        response.worst_torque_nm,
    )
