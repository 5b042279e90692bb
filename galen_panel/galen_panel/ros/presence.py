"""What of the suite is there now: its services and actions, once a second."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from galen_panel.messages.programs import DRIVER, GRAVCOMP, OFFERED_BY, Program
from galen_panel.state.board import Board

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

    def add(self, name: str, *clients: ReadyClient) -> None:
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


class ReadyClient(Protocol):
    """An rclpy client."""

    def service_is_ready(self) -> bool:
        """Whether there is a server."""
