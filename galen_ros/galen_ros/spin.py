"""Run one node as a process: executor, signals, exit code."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

import rclpy
from galen_model.errors import GalenError
from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, try_shutdown


def make_executor(context: Context | None = None) -> Executor:
    """Return an EventsExecutor where this rclpy has one, else a SingleThreadedExecutor.

    Use it as `while ...: executor.spin_once(timeout_sec=0.1)`; its `spin()` calls nothing in
    rclpy 7.1.6.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> None:
    """Make the node and run it until SIGINT or SIGTERM; to be a console script's whole `main`.

    Ends with exit code 0 on a signal. A GalenError while the node is made (a bad parameter, a bad
    file) prints one line and ends with exit code 1. Anything else is a bug, and keeps its
    traceback.
    """
    stop = threading.Event()

    def on_signal(_signum: int, _frame: FrameType | None) -> None:
        stop.set()

    # Own handlers, not rclpy's: rclpy's shut the context down under a running callback, whose next
    # publish then raises. With these, the callback ends first and the node can say good-bye.
    previous = {
        number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        try:
            _make_and_spin(make_node, stop)
        finally:
            try_shutdown()
    except GalenError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _make_and_spin(make_node: Callable[[], Node], stop: threading.Event) -> None:
    node = make_node()
    executor = make_executor()
    executor.add_node(node)
    try:
        while ok() and not stop.is_set():
            executor.spin_once(timeout_sec=0.1)
    finally:
        executor.remove_node(node)
        node.destroy_node()
        executor.shutdown()
