"""A signal is how the panel ends, with exit code 0, whenever it comes."""

from __future__ import annotations

import signal
from types import FrameType


def end_by_signals() -> None:
    """Take SIGINT and SIGTERM from here on; while uvicorn runs it takes them, and repeats them."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)


def _end(_number: int, _frame: FrameType | None) -> None:
    raise SystemExit(0)
