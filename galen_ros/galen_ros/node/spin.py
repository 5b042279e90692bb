# SPDX-License-Identifier: Apache-2.0
"""Run one node as a process: executor, signals, exit code, domain."""

from __future__ import annotations

import fcntl
import gc
import inspect
import os
import re
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import IO, TypeVar

import rclpy
from galen_common.executable import interrupted, stop_signals, terminal_closed
from galen_model.errors import GalenError
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, try_shutdown

from galen_ros.node.parameters import warn_of_unknown_parameters

N = TypeVar("N", bound=Node)

_HELP = """usage: {name} [--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO ...]

{what}

`ros2 param list` and `ros2 param describe` list its parameters while it runs."""
_LAST_DOMAIN = 232
_IN_RCL = re.compile(r",? at /\S+")


def make_executor(context: Context | None = None) -> Executor:
    """Return an EventsExecutor where this rclpy has one, else a SingleThreadedExecutor.

    Use it as `while ...: executor.spin_once(timeout_sec=0.1)`; its `spin()` calls nothing in
    rclpy 7.1.6.

    Args:
        context: of the nodes; None: rclpy's default one.

    Returns:
        The executor, without nodes.

    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def init_ros(args: list[str] | None = None, context: Context | None = None) -> None:
    """Do `rclpy.init` without its signal handlers.

    Args:
        args: the command line with its ROS arguments; None: that of the process.
        context: to initialise; None: rclpy's default one.

    Raises:
        GalenError: ROS_DOMAIN_ID is too large, a ROS argument is unknown, or rcl fails.

    """
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    if domain.isdecimal() and int(domain) > _LAST_DOMAIN:
        raise GalenError(
            f"ROS_DOMAIN_ID is {domain}: at most {_LAST_DOMAIN}, since its UDP ports follow from it"
        )
    try:
        rclpy.init(args=args, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except UnknownROSArgsError as error:
        raise GalenError(f"unknown after --ros-args: {error}") from error
    except RCLError as error:
        # rcl adds the lines of its own source.
        raise GalenError(_IN_RCL.sub("", str(error))) from error


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> None:
    """Make the node and run it until SIGINT, SIGTERM or SIGHUP; a console script's whole `main`.

    With `--help` it prints what the node is, and how parameters are given, and makes none.

    Ends with exit code 0 on a signal. A GalenError while the node is made (a bad parameter, a bad
    file) prints one line and ends with exit code 1. Anything else is a bug, and keeps its
    traceback.

    Args:
        make_node: the node's class, or a function that makes it; `--help` prints its docstring.
        args: the command line; None: that of the process.

    Raises:
        SystemExit: with code 1 after a GalenError.

    """
    words = sys.argv[1:] if args is None else args
    if {"-h", "--help"} & set(
        words[: words.index("--ros-args")] if "--ros-args" in words else words
    ):
        print(_HELP.format(name=Path(sys.argv[0]).name, what=inspect.getdoc(make_node)))
        return
    try:
        run_until(make_node, lambda _node: False, args)
    except GalenError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def run_until(
    make_node: Callable[[], N],
    done: Callable[[N], bool],
    args: list[str] | None = None,
    make: Callable[[], Executor] = make_executor,
) -> int | None:
    """Make the node and run it until it is done, or a signal comes.

    For commands that go on after their node.

    Args:
        make_node: makes the node, once ROS is initialised.
        done: returns whether the node is done; called after every event, and ten times a second.
        args: the command line with its ROS arguments; None: that of the process.
        make: makes the executor.

    Returns:
        The signal's number; None: the node was done.

    Raises:
        GalenError: ROS can't be initialised, or rclpy rejects a parameter; what the node raises
            comes out as well.

    """
    caught: list[int] = []

    def on_signal(number: int, _frame: FrameType | None) -> None:
        caught.append(number)
        if number == signal.SIGINT:
            interrupted()
        if number == signal.SIGHUP:
            terminal_closed()

    # Own handlers, not rclpy's: rclpy's shut the context down under a running callback, whose next
    # publish then raises. With these, the callback ends first and the node can say good-bye.
    previous = {number: signal.signal(number, on_signal) for number in stop_signals()}
    try:
        init_ros(args)
        try:
            _make_and_spin(make_node, lambda node: bool(caught) or done(node), make)
        finally:
            try_shutdown()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    return caught[0] if caught else None


def _make_and_spin(
    make_node: Callable[[], N], done: Callable[[N], bool], make: Callable[[], Executor]
) -> None:
    try:
        node = make_node()
    except ParameterException as error:  # of rclpy's own, such as use_sim_time
        raise GalenError(str(error)) from error
    warn_of_unknown_parameters(node)
    executor = make()
    executor.add_node(node)
    # A full collection looks at all that the imports made, 30 ms and more between two messages.
    # What is there by now stays: the collector need not look at it again.
    gc.collect()
    gc.freeze()
    try:
        while ok() and not done(node):
            executor.spin_once(timeout_sec=0.1)
    finally:
        executor.remove_node(node)
        node.destroy_node()
        executor.shutdown()


# Domains

# Fast DDS takes UDP port 7400 + 250 domain and up. Linux hands out ports from 32768 to everybody,
# which is domain 101; people use the low domains.
_DOMAIN_IDS = range(61, 101)


class DomainLock:
    """Holds a ROS domain id that no other process of this suite holds: a test, a demonstration."""

    def __init__(self, timeout_s: float = 60.0) -> None:
        deadline = time.monotonic() + timeout_s
        count = len(_DOMAIN_IDS)
        first = os.getpid() % count
        while True:
            for step in range(count):
                domain_id = _DOMAIN_IDS[(first + step) % count]
                handle = _try_lock(domain_id)
                if handle is not None:
                    self.domain_id = domain_id
                    self._handle = handle
                    return
            if time.monotonic() > deadline:
                raise TimeoutError(f"no free ROS domain id among {_DOMAIN_IDS} for {timeout_s} s")
            time.sleep(0.1)

    def release(self) -> None:
        """Give the domain id back."""
        self._handle.close()


def _try_lock(domain_id: int) -> IO[str] | None:
    """Lock a domain's file; the system releases it when the process ends, however it ends."""
    path = Path(tempfile.gettempdir()) / f"galen_ros_domain_{domain_id}.lock"
    try:
        handle = path.open("a")
    except PermissionError:  # another user's
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        handle.close()
        return None
    return handle
