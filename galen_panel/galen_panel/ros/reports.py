"""Hears what nodes say about themselves on /diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from galen_model.errors import one_line
from rclpy.node import Node

from galen_panel.state.board import Board
from galen_panel.state.snapshot import Level, NodeReport

# Anybody may publish there; those heard last are kept.
_MOST_NODES, _MOST_VALUES, _LONGEST_KEY = 100, 200, 100


class Reports:
    """Puts the newest word of each node on the board, and hands it to `on_report`."""

    def __init__(self, node: Node, board: Board, on_report: Callable[[NodeReport], None]) -> None:
        self._board = board
        self._on_report = on_report
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_message, 100)

    def _on_message(self, message: DiagnosticArray) -> None:
        now_s = time.monotonic()
        reports = [_report(status, now_s) for status in message.status[:_MOST_NODES]]
        nodes = {**self._board.state.nodes, **{report.name: report for report in reports}}
        newest_first = sorted(nodes.values(), key=lambda report: -report.heard_s)
        kept = {report.name for report in newest_first[:_MOST_NODES]}
        self._board.put(nodes={name: nodes[name] for name in nodes if name in kept})
        for report in reports:
            self._on_report(report)


def _report(status: Any, heard_s: float) -> NodeReport:
    level = int.from_bytes(status.level)
    return NodeReport(
        one_line(status.name, _LONGEST_KEY),
        Level(level) if level in (known.value for known in Level) else Level.STALE,
        one_line(status.message),
        {
            one_line(item.key, _LONGEST_KEY): one_line(item.value)
            for item in status.values[:_MOST_VALUES]
        },
        heard_s,
    )
