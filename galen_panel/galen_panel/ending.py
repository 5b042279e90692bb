"""A signal is how the panel ends, with exit code 0, whenever it comes.

Further ones change nothing.
"""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_came: list[int] = []


def end_by_signals() -> None:
    """Take SIGINT and SIGTERM from here on, until uvicorn takes them."""
    for number in _SIGNALS:
        signal.signal(number, _end)


def end_server(server: Any, number: int, _frame: FrameType | None) -> None:
    """Have uvicorn's server end in order: in place of its own `handle_exit`.

    That one cancels what still runs at a second SIGINT, with a traceback, and raises the signals
    anew inside the event loop.
    """
    _came.append(number)
    server.should_exit = True


def ignore_signals() -> None:
    """Take none from here on: the interpreter's own end would let them kill the process."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _end(number: int, _frame: FrameType | None) -> None:
    if _came:
        return
    _came.append(number)
    ignore_signals()
    raise SystemExit(0)
