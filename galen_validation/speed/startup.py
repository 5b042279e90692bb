# SPDX-License-Identifier: Apache-2.0
"""How long each node takes from its process' start till others see it, beside a bare relay.

Seen is: the node's name is in the graph and it has told its state on /diagnostics (a relay: its
name). CPU is user and system time of the process until then.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from galen_ros.node.spin import DomainLock, make_executor
from rclpy.node import Node
from rich.table import Table

from galen_validation.nominal import NAME, write_bench_tool
from galen_validation.speed.nodes import cpu_s, spread

TITLE = "start of a node's process"
_LONGEST_S = 60.0
_POLL_S = 0.02


@dataclass(frozen=True)
class Started:
    """One start of a node: s from its process' start till it was seen, and its CPU time, s."""

    subject: str
    seconds: float
    cpu_s: float


def subjects(folder: Path) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return the processes to start; the relay first.

    Args:
        folder: Folder of tools, with the retractor's calibration.

    Returns:
        By subject, the node's name in the graph, and arguments after `python -m`.

    """
    tools = ("-p", f"tools_dir:={folder}")
    ros = ("--ros-args", "--log-level", "error")
    return {
        "relay": ("relay", ("galen_validation.speed.relays", "relay", "wrench_raw")),
        "gravcomp_node": (
            "gravcomp",
            ("galen_gravcomp.ros.node", *ros, *tools, "-p", f"tool:={NAME}"),
        ),
        "deflection_node": ("deflection", ("galen_deflection.ros.node", *ros)),
        "sim_driver_node": ("sim_driver", ("galen_sim_driver.ros.node", *ros)),
        "calibration_node": ("calibration", ("galen_calibration_behavior.ros.node", *ros, *tools)),
        "collection_node": ("collection", ("galen_deflection.ros.collection_node", *ros, *tools)),
    }


class _Watcher(Node):
    """Sees names in the graph, and which nodes reported their state."""

    def __init__(self, context: rclpy.Context) -> None:
        super().__init__("startup_watcher", context=context)
        self.told: set[str] = set()
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_state, 50)

    def _on_state(self, message: DiagnosticArray) -> None:
        self.told.update(status.name for status in message.status)

    def sees(self, name: str) -> bool:
        """Whether a node of that name is there and, unless it is a relay, has told its state."""
        if name not in self.get_node_names():
            return False
        return name == "relay" or any(name in told for told in self.told)


def start(subject: str, name: str, arguments: Sequence[str]) -> Started:
    """Start a node once, alone in its domain.

    Args:
        subject: Name in the table.
        name: The node's name in the graph.
        arguments: Arguments after `python -m`.

    Returns:
        Time and processor time until others see the node.

    Raises:
        RuntimeError: The process ended, or wasn't seen within a minute.

    """
    lock = DomainLock()
    environment = os.environ | {"ROS_DOMAIN_ID": str(lock.domain_id), "OMP_NUM_THREADS": "1"}
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=lock.domain_id)
    watcher = _Watcher(context)
    executor = make_executor(context)
    executor.add_node(watcher)
    process = None
    try:
        began_s = time.monotonic()
        process = subprocess.Popen([sys.executable, "-m", *arguments], env=environment)
        while not watcher.sees(name):
            executor.spin_once(timeout_sec=_POLL_S)
            if process.poll() is not None:
                raise RuntimeError(f"{subject} ended with exit code {process.returncode}")
            if time.monotonic() - began_s > _LONGEST_S:
                raise RuntimeError(f"{subject} wasn't seen within {_LONGEST_S:g} s")
        return Started(subject, time.monotonic() - began_s, cpu_s(process.pid))
    finally:
        if process is not None:
            process.terminate()
            process.wait(timeout=10.0)
        executor.remove_node(watcher)
        watcher.destroy_node()
        executor.shutdown()
        rclpy.shutdown(context=context)
        lock.release()


def measure(options: argparse.Namespace, progress: Callable[[str], None]) -> list[Started]:
    """Start every node several times, in turns.

    Args:
        options: The command's; `rounds`: how often.
        progress: Called with what is started next.

    Returns:
        One for each round and node.

    Raises:
        RuntimeError: A node ended, or wasn't seen.

    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    found: list[Started] = []
    with tempfile.TemporaryDirectory() as folder:
        write_bench_tool(Path(folder))
        for _ in range(options.rounds):
            for subject, (name, arguments) in subjects(Path(folder)).items():
                progress(f"start of {subject}")
                found.append(start(subject, name, arguments))
    return found


def table(found: Sequence[Started]) -> Table:
    """Make a row of each node: least/median/largest of the rounds.

    Args:
        found: What `measure` returned.

    Returns:
        The table.

    """
    base = statistics.median(one.seconds for one in found if one.subject == "relay")
    out = Table("node", "s till seen", "x relay", "CPU s", box=None, header_style="bold")
    for subject in dict.fromkeys(one.subject for one in found):
        own = [one for one in found if one.subject == subject]
        ratio = statistics.median(one.seconds for one in own) / base
        seconds, cpu = (spread([getattr(one, k) for one in own], 2) for k in ("seconds", "cpu_s"))
        out.add_row(subject, seconds, f"{ratio:.2f}", cpu)
    return out
