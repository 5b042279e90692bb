# SPDX-License-Identifier: Apache-2.0
"""The suite's executables as processes of their own, each with a log and ended by its id.

On a full ROS 2 `ros2 launch` does this; a demonstration has to run without it, too, and in a ROS
domain of its own.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from galen_model.errors import GalenError
from galen_model.load.model import TOOLS
from galen_ros.node.spin import DomainLock
from rclpy.signals import SignalHandlerOptions

from galen_bringup.arm_client import ArmClient

_PATIENCE_S = 5.0
AVERAGE_S = 0.25
"""Length of an averaged reading outside the calibration, s of simulated time."""

QUICK = {
    "settle_s": 0.05,
    "velocity_window_s": 0.06,
    "max_angle_velocity_rad_s": 1.4,
    "max_angle_acceleration_rad_s2": 5.5,
    "max_delta_velocity_m_s": 0.15,
    "max_delta_acceleration_m_s2": 0.9,
    "use_sim_time": True,
}
"""Quicker than the node's defaults, which are for a real arm; the simulated one does not ring."""


class ProcessError(GalenError):
    """An executable is missing, or a process ended by itself; then with its log's last lines."""

    __str__ = Exception.__str__


def executable_path(package: str, executable: str) -> Path:
    """Return where colcon installed an executable.

    Args:
        package: its package.
        executable: its name.

    Returns:
        The file.

    Raises:
        ProcessError: naming what is missing.

    """
    try:
        path = Path(get_package_prefix(package)) / "lib" / package / executable
    except PackageNotFoundError as error:
        raise ProcessError(f"package {package} is not installed: build and source first") from error
    if not path.is_file():
        raise ProcessError(f"{path} is not there: build again")
    return path


def ros_arguments(
    parameters: Mapping[str, object] | None = None, remaps: Mapping[str, str] | None = None
) -> list[str]:
    """Return command-line arguments that set a node's parameters and remaps.

    Args:
        parameters: value by the parameter's name; None: none.
        remaps: new name by the old one; None: none.

    Returns:
        `--ros-args` and what follows it; empty where there is nothing to set.

    """
    arguments = []
    for name, value in (parameters or {}).items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += ["-p", f"{name}:={text}"]
    for old, new in (remaps or {}).items():
        arguments += ["-r", f"{old}:={new}"]
    return ["--ros-args", *arguments] if arguments else []


class Processes:
    """Processes that end with this object, whatever happens; each writes its own log."""

    def __init__(self, log_dir: Path) -> None:
        """Start with no process.

        Args:
            log_dir: logs go to `log_dir`/<executable>.log; `__enter__` makes it.

        """
        self._log_dir = log_dir
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Processes:
        """Make the folder of the logs."""
        self._log_dir.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End all of them."""
        self.stop()

    def start(self, package: str, executable: str, arguments: Sequence[str] = ()) -> int:
        """Start an executable.

        Args:
            package: its package.
            executable: its name, by which it is kept: one process of each.
            arguments: of its command line.

        Returns:
            The process id.

        Raises:
            ProcessError: the executable is missing.

        """
        path = executable_path(package, executable)
        # A signal between a process' start and its entry in the list would leave it behind.
        with (self._log_dir / f"{executable}.log").open("wb") as log, _signals_later():
            self._running[executable] = process = subprocess.Popen(
                [str(path), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                # A group of their own: a Ctrl-C ends them through stop(), in order. Not a session
                # of their own, in which Linux would not weigh the driver's niceness against theirs.
                process_group=0,
            )
        return process.pid

    def check(self) -> None:
        """Check that no process has ended by itself.

        Raises:
            ProcessError: one has; with the last lines of its log.

        """
        for name, process in self._running.items():
            if process.poll() is not None:
                log = self._log_dir / f"{name}.log"
                last = "\n".join(log.read_text(errors="replace").splitlines()[-5:])
                raise ProcessError(f"{name} ended with code {process.returncode} ({log}):\n{last}")

    def stop(self) -> None:
        """Interrupt all, wait, and kill what is left."""
        for process in self._running.values():
            _signal(process, signal.SIGINT)
        deadline = time.monotonic() + _PATIENCE_S
        try:
            for process in self._running.values():
                with suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=max(0.1, deadline - time.monotonic()))
        finally:  # an impatient second Ctrl-C, too, must leave nothing behind
            for process in self._running.values():
                _signal(process, signal.SIGKILL)
                process.wait()
            self._running.clear()


@contextmanager
def _signals_later() -> Iterator[None]:
    """Hold back what would end this process until the block is done."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach the main thread alone
        return
    came: list[int] = []
    held = {
        number: signal.signal(number, lambda which, _frame: came.append(which))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
        for which in came:
            signal.raise_signal(which)


def _signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    if process.poll() is None:
        os.kill(process.pid, number)


@contextmanager
def ros_world() -> Iterator[None]:
    """Hold a ROS domain on this machine for this process and its children."""
    lock = DomainLock()
    os.environ["ROS_DOMAIN_ID"] = str(lock.domain_id)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    finally:
        rclpy.try_shutdown()
        lock.release()


def start_suite(processes: Processes, tools_dir: Path, speed: float, seed: int) -> None:
    """Start driver, compensation and calibration; returns when they are up.

    Args:
        processes: that they become part of.
        tools_dir: folder of the calibration files.
        speed: simulated over wall time.
        seed: of the simulated noise.

    Raises:
        GalenError: an executable is missing, a process ended, or one was not up in time.

    """
    processes.start(
        "galen_sim_driver",
        "sim_driver_node",
        ros_arguments({"speed_factor": speed, "seed": seed}),
    )
    processes.start(
        "galen_gravcomp",
        "gravcomp_node",
        ros_arguments({"tools_dir": tools_dir, "use_sim_time": True}),
    )
    processes.start(
        "galen_calibration_behavior",
        "calibration_node",
        ros_arguments({"tools_dir": tools_dir, **QUICK}),
    )
    with connected_arm(processes):
        pass  # entering waits until the nodes are up


def calibrate(processes: Processes, tool: str, arguments: Sequence[str] = ()) -> dict[str, Any]:
    """Run the client that a user runs; its progress goes to standard error.

    Args:
        processes: with the suite's nodes.
        tool: name of a simulated tool, whose tip is given to the client.
        arguments: further ones of the client.

    Returns:
        The client's JSON: the action's result by the field's name, SI units.

    Raises:
        ProcessError: the client failed, or a process ended.

    """
    tip = [repr(float(value)) for value in TOOLS[tool].tip_m]
    client = executable_path("galen_calibration_behavior", "calibrate")
    answer = subprocess.run(
        [str(client), tool, "--json", "--timeout-s", "30", "--tip", *tip, *arguments],
        stdout=subprocess.PIPE,
        check=False,
    )
    processes.check()
    if answer.returncode != 0:
        raise ProcessError(f"the calibration of the {tool} failed (exit code {answer.returncode})")
    return dict(json.loads(answer.stdout))


@contextmanager
def connected_arm(processes: Processes) -> Iterator[ArmClient]:
    """Give a client of the arm only while it is used: unread queues would hold old samples.

    Args:
        processes: checked while the client waits.

    Yields:
        The client, once driver and gravcomp are up.

    Raises:
        GalenError: they were not up in time, or a process ended.

    """
    arm = ArmClient(processes.check)
    try:
        arm.wait_until_up()
        yield arm
    finally:
        arm.close()
