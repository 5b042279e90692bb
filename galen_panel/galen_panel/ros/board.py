# SPDX-License-Identifier: Apache-2.0
"""The newest snapshot of the suite: services that are there, nodes' reports, gravcomp's tools."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from galen_model.errors import one_line
from galen_ros.messages import LATCHED
from rclpy.client import Client
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from galen_msgs.msg import ActiveTool
from galen_msgs.srv import CompareTools, ListTools, RemoveTool, RevertTool, SetTool
from galen_panel.messages.programs import DRIVER, GRAVCOMP, OFFERED_BY, Program
from galen_panel.ros.thread import CallError, Calls
from galen_panel.state.snapshot import (
    Behaviour,
    BehaviourKind,
    ListedTool,
    LoadedTool,
    NodeLevel,
    NodeReport,
    QuantityDifference,
    SuiteState,
    ToolComparison,
)


class Board:
    """The state, and the only way to change it."""

    def __init__(self) -> None:
        self._state = SuiteState()
        self._lock = threading.Lock()

    @property
    def state(self) -> SuiteState:
        """The newest snapshot."""
        return self._state

    def put(self, **changes: Any) -> None:
        """Change fields of the state; nothing new where they are as they were.

        Args:
            **changes: values by the field's name.

        """
        self.change(lambda _: changes)

    def put_behaviour(self, behaviour: Behaviour) -> None:
        """Show a behaviour in place of the one of its kind.

        Args:
            behaviour: the newest snapshot of it.

        """

        def changes(state: SuiteState) -> dict[str, dict[BehaviourKind, Behaviour]]:
            return {"behaviours": {**state.behaviours, behaviour.kind: behaviour}}

        self.change(changes)

    def change(self, changes: Callable[[SuiteState], dict[str, Any]]) -> None:
        """Change fields of the state by what they are now.

        Args:
            changes: returns values by the field's name; while it runs the state stays as it is.

        """
        with self._lock:
            old = self._state
            new = changes(old)
            if any(getattr(old, name) != value for name, value in new.items()):
                self._state = replace(old, **new, revision=old.revision + 1)


PERIOD_S = 1.0
SILENT_S = 4.0
"""A node that says nothing on /diagnostics for so long is gone, or too busy."""
# DDS hears of a killed process only by a time-out, some 20 s later. Too late for these: what they
# do must not be believed in meanwhile. Others may be silent while they run a goal, and live.
_GONE_WHEN_SILENT = (DRIVER, GRAVCOMP)


class Presence:
    """Looks which names of `OFFERED_BY` are there; each was said how by `add`."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._ready: dict[str, Callable[[], bool]] = {}
        self._next_s = 0.0

    def add(self, name: str, *clients: Client) -> None:
        """Look for a name from now on.

        Args:
            name: a key of `OFFERED_BY`.
            *clients: the name is there while all of them have their server.

        """
        self._ready[name] = lambda: all(client.service_is_ready() for client in clients)

    def tick(self, now_s: float) -> None:
        """Look, where it is time to.

        Args:
            now_s: time.monotonic(), s.

        """
        if now_s < self._next_s:
            return
        self._next_s = now_s + PERIOD_S
        self._board.put(
            available=frozenset(
                name
                for name, ready in self._ready.items()
                if not self._silent(OFFERED_BY[name], now_s) and ready()
            )
        )

    def _silent(self, program: Program, now_s: float) -> bool:
        """Whether a node that has been heard is not heard any more, and is gone for that."""
        report = self._board.state.report_of(program.node)
        heard = report is None or now_s - report.heard_s <= SILENT_S
        return program in _GONE_WHEN_SILENT and not heard


# Any node may publish there; those heard last are kept.
_MOST_NODES, _MOST_VALUES, _LONGEST_KEY = 100, 200, 100


def hear_reports(node: Node, board: Board, on_report: Callable[[NodeReport], None]) -> None:
    """Put each node's newest report of /diagnostics on the board.

    Args:
        node: that subscribes.
        board: where the reports go.
        on_report: called with each report, once it is on the board.

    """

    def on_message(message: DiagnosticArray) -> None:
        now_s = time.monotonic()
        reports = [_report(status, now_s) for status in message.status[:_MOST_NODES]]
        before = board.state.nodes
        nodes = {**before, **{one.name: one.after(before.get(one.name)) for one in reports}}
        newest_first = sorted(nodes.values(), key=lambda report: -report.heard_s)
        kept = {report.name for report in newest_first[:_MOST_NODES]}
        board.put(nodes={name: nodes[name] for name in nodes if name in kept})
        for report in reports:
            on_report(report)

    node.create_subscription(DiagnosticArray, "/diagnostics", on_message, 100)


def _report(status: Any, heard_s: float) -> NodeReport:
    level = int.from_bytes(status.level)
    return NodeReport(
        one_line(status.name, _LONGEST_KEY),
        NodeLevel(level) if level in (known.value for known in NodeLevel) else NodeLevel.STALE,
        one_line(status.message),
        {
            one_line(item.key, _LONGEST_KEY): one_line(item.value)
            for item in status.values[:_MOST_VALUES]
        },
        heard_s,
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
        """See whether gravcomp came or went, and ask for the list where it is time to.

        Args:
            now_s: time.monotonic(), s.

        """
        there = "gravcomp/set_tool" in self._board.state.available
        if there != self._there:
            self._there = there
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
        """Call one of gravcomp's services.

        Args:
            name: the service's, without the node's.
            request: the service's Request.
            timeout_s: how long to wait for the answer, s; None: FILE_LIMIT_S.

        Returns:
            The service's Response.

        Raises:
            CallError: the service is absent, or does not answer.

        """
        limit_s = FILE_LIMIT_S if timeout_s is None else timeout_s
        return await self._calls.ask(self._clients[name], request, GRAVCOMP, limit_s)

    async def list_tools(self) -> Any:
        """Show the list anew.

        Returns:
            The service's Response.

        Raises:
            CallError: the service is absent, or does not answer.

        """
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
    """Read the response of `compare_tools`.

    Args:
        response: of a success.

    Returns:
        The comparison.

    """
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
