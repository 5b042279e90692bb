# SPDX-License-Identifier: Apache-2.0
"""`panel`: the operator's panel in the browser, a client of the suite's nodes like any other.

A signal is how it ends, with exit code 0, whenever it comes; further ones change nothing.
"""

from __future__ import annotations

import signal
import sys
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

    Args:
        server: uvicorn's, whose method this is.
        number: of the signal.
        _frame: not used.

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


def main() -> None:
    """Run the panel; see `panel --help`."""
    # Before the slow imports: an early signal, too, is an orderly end.
    end_by_signals()
    from galen_common.command import own_arguments
    from galen_model.errors import GalenError

    from galen_panel.options import read_options

    options = read_options(own_arguments(sys.argv)[1:])
    # Slower still, and nothing of it is needed for --help.
    from galen_panel.ros.suite import RosSuite
    from galen_panel.server import serve

    try:
        with RosSuite(sys.argv, options.tools_dir) as suite:
            serve(suite, options, suite.close)
    except GalenError as error:
        print(f"panel: {error}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
