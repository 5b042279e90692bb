# SPDX-License-Identifier: Apache-2.0
"""The start and end that all executables share: SIGINT ends them without a traceback.

A package names its executables in `executables.py`, which imports nothing else: the signal is
handled before the imports, which take seconds.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import os
import signal
import stat
import time
from types import FrameType
from typing import Literal

EXIT_INTERRUPTED = 130
EXIT_PIPE_CLOSED = 141
# One Ctrl-C may come twice: from the terminal, and handed on by `ros2 launch`.
_SAME_S = 1.0


class _Interrupts:
    """The handler of SIGINT while no handler of the executable's own is in place."""

    def __init__(self) -> None:
        self.phase: Literal["importing", "working", "ending"] = "importing"
        self._came_s: float | None = None

    def take(self) -> None:
        """Become the handler, also after others."""
        signal.signal(signal.SIGINT, self)

    def note(self) -> bool:
        """Note that SIGINT came. True if it is a new one, not the last one repeated."""
        now_s = time.monotonic()
        if self._came_s is not None and now_s - self._came_s < _SAME_S:
            return False
        self._came_s = now_s
        return True

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        first = self._came_s is None
        if self.phase == "importing":
            os._exit(EXIT_INTERRUPTED)  # an exception would come out of some import
        if not self.note():
            return
        if self.phase == "working":
            raise KeyboardInterrupt
        if not first:  # the end itself hangs
            os._exit(EXIT_INTERRUPTED)


_interrupts = _Interrupts()


def stop_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that end an executable: not SIGHUP where `nohup` has it ignored."""
    ends = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    return tuple(one for one in ends if signal.getsignal(one) is not signal.SIG_IGN)


def terminal_closed() -> None:
    """Send what is still printed nowhere: writing to a terminal that is gone fails."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        with contextlib.suppress(OSError):  # it may be closed
            if stat.S_ISCHR(os.fstat(stream).st_mode):
                os.dup2(nowhere, stream)


def interrupted() -> None:
    """Note a SIGINT that a handler of one's own has taken: its repetition is ignored, too."""
    _interrupts.note()


class Executable:
    """A module's `main`, imported when it is called; the entry point of an executable."""

    def __init__(self, module: str) -> None:
        self.module = module

    def __call__(self) -> object:
        """Run the executable.

        Returns:
            What its `main` returns, its exit code; EXIT_INTERRUPTED after Ctrl-C, EXIT_PIPE_CLOSED
            where who reads standard output went away, such as `head`.

        """
        _interrupts.take()
        # Before numpy is imported: for matrices as small as the suite's, waking threads costs more
        # than they bring, and on a busy machine ten times as much.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # Called last: what is left is the interpreter's end, which would drop a handler in Python.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
        main = importlib.import_module(self.module).main
        try:
            _interrupts.phase = "working"
            try:
                code: object = main()
                return code
            finally:
                print(end="", flush=True)
        except KeyboardInterrupt:
            return EXIT_INTERRUPTED
        except BrokenPipeError:
            # What is still to be written would fail again at the interpreter's end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            return EXIT_PIPE_CLOSED
        finally:
            _interrupts.phase = "ending"
            _interrupts.take()
