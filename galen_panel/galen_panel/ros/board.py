"""The newest snapshot of the suite, which services are there, and what nodes report."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from galen_model.errors import one_line
from rclpy.client import Client
from rclpy.node import Node

from galen_panel.messages.hints import DRIVER, GRAVCOMP, OFFERED_BY, Program
from galen_panel.snapshot import Behaviour, BehaviourKind, NodeLevel, NodeReport, SuiteState


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
        """Change fields of the state; nothing new where they are as they were."""
        self.change(lambda _: changes)

    def put_behaviour(self, behaviour: Behaviour) -> None:
        """Show a behaviour in place of the one of its kind."""

        def changes(state: SuiteState) -> dict[str, dict[BehaviourKind, Behaviour]]:
            return {"behaviours": {**state.behaviours, behaviour.kind: behaviour}}

        self.change(changes)

    def change(self, changes: Callable[[SuiteState], dict[str, Any]]) -> None:
        """Change what `changes(state)` says; in it the state stays as it is."""
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
        """`name` is there while all of the clients have their server."""
        self._ready[name] = lambda: all(client.service_is_ready() for client in clients)

    def tick(self, now_s: float) -> None:
        """Look, where it is time to."""
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
    """Put each node's newest report of /diagnostics on the board, and hand it to `on_report`."""

    def on_message(message: DiagnosticArray) -> None:
        now_s = time.monotonic()
        reports = [_report(status, now_s) for status in message.status[:_MOST_NODES]]
        nodes = {**board.state.nodes, **{report.name: report for report in reports}}
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
