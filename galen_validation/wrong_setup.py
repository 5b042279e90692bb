# SPDX-License-Identifier: Apache-2.0
"""Measure how soon gravcomp_node detects a driver's mistake.

    python -m galen_validation.wrong_setup

The simulated driver, at home with the retractor on, and gravcomp_node run as processes of their
own; this one relays the driver's samples with a mistake in them. Told are the time from the first
relayed wrench to the verdict on /diagnostics, and how many wrenches went out before it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from galen_bringup.processes import Processes, ros_arguments, ros_world
from galen_ros.messages import STREAM, fill_wrench, wrench_to_array
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from galen_msgs.srv import SetTool

TOOLS = Path(__file__).resolve().parent.parent / "bags" / "tools"
VERDICTS = ("wrong_setup", "implausible_units")
PATIENCE_S = 30.0


def _scaled(*factors: float) -> Callable[[Any, Any], None]:
    def change(wrench: Any, _joints: Any) -> None:
        if wrench is not None:
            fill_wrench(wrench, wrench_to_array(wrench) * np.array(factors))

    return change


def _degrees(_wrench: Any, joints: Any) -> None:
    if joints is not None:
        joints.position = [30.0 if name == "roll" else 0.0 for name in joints.name]


MISTAKES = {
    "reversed reading": _scaled(*[-1.0] * 6),
    "sensor upside down": _scaled(1.0, -1.0, -1.0, 1.0, -1.0, -1.0),
    "forces in kgf": _scaled(*[1 / 9.80665] * 3, 1.0, 1.0, 1.0),
    "torques in N.mm": _scaled(1.0, 1.0, 1.0, 1e3, 1e3, 1e3),
    "angles in degrees": _degrees,
}


class Relay(Node):
    """Hands the driver's samples on with a mistake, and hears what comes of it."""

    def __init__(self, change: Callable[[Any, Any], None]) -> None:
        super().__init__("relay")
        self._change, self.on = change, False
        self.first_s, self.verdict_s, self.text, self.published = 0.0, 0.0, "", 0
        self._wrench = self.create_publisher(WrenchStamped, "wrench_raw", STREAM)
        self._joints = self.create_publisher(JointState, "joint_states", STREAM)
        self.create_subscription(WrenchStamped, "true/wrench", self._on_wrench, STREAM)
        self.create_subscription(JointState, "true/joints", self._on_joints, STREAM)
        self.create_subscription(WrenchStamped, "wrench_compensated", self._on_output, STREAM)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self.zero = self.create_client(Trigger, "zero_ft_sensor")
        self.attach = self.create_client(SetTool, "attach_tool")

    def _on_wrench(self, message: WrenchStamped) -> None:
        if self.on:
            self.first_s = self.first_s or time.monotonic()
            self._change(message, None)
            self._wrench.publish(message)

    def _on_joints(self, message: JointState) -> None:
        if self.on:
            self._change(None, message)
            self._joints.publish(message)

    def _on_output(self, _message: WrenchStamped) -> None:
        self.published += not self.verdict_s

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            state = next((item.value for item in status.values if item.key == "state"), "")
            if "gravcomp" in status.name and state in VERDICTS and not self.verdict_s:
                self.verdict_s, self.text = time.monotonic(), status.message

    def ready(self) -> bool:
        """Whether gravcomp listens."""
        return bool(self._wrench.get_subscription_count() and self._joints.get_subscription_count())


def measure(change: Callable[[Any, Any], None], log_dir: Path) -> Relay:
    """Run driver, relay and gravcomp_node until the verdict.

    Args:
        change: Puts the mistake into a wrench (first argument) or joint message (second) in place;
            the other one is None.
        log_dir: Folder for the processes' logs.

    Returns:
        The relay, its node destroyed: times of the first wrench and of the verdict, its sentence,
        and how many wrenches went out before.

    Raises:
        ProcessError: A process ended.
        TimeoutError: No process, answer or verdict within PATIENCE_S.

    """
    with ros_world(), Processes(log_dir) as processes:
        remaps = {"wrench_raw": "true/wrench", "joint_states": "true/joints"}
        processes.start("galen_sim_driver", "sim_driver_node", ros_arguments(remaps=remaps))
        relay = Relay(change)
        executor = SingleThreadedExecutor()
        executor.add_node(relay)

        def wait(done: Callable[[], bool], what: str) -> None:
            end_s = time.monotonic() + PATIENCE_S
            while not done():
                executor.spin_once(timeout_sec=0.05)
                processes.check()
                if time.monotonic() > end_s:
                    raise TimeoutError(f"{what}: not within {PATIENCE_S:g} s")

        wait(lambda: relay.zero.service_is_ready() and relay.attach.service_is_ready(), "driver")
        for client, request in (
            (relay.zero, Trigger.Request()),
            (relay.attach, SetTool.Request(tool="retractor")),
        ):
            answer = client.call_async(request)
            wait(answer.done, client.srv_name)
        processes.start(
            "galen_gravcomp",
            "gravcomp_node",
            ros_arguments({"tools_dir": TOOLS, "tool": "retractor"}),
        )
        wait(relay.ready, "gravcomp_node")
        relay.on = True
        wait(lambda: bool(relay.verdict_s), "a verdict")
        relay.destroy_node()
        return relay


def main() -> int:
    """Print the table; returns the exit code."""
    print(f"{'mistake':22}{'verdict after [s]':>18}{'published before':>18}   told")
    with tempfile.TemporaryDirectory() as folder:
        for name, change in MISTAKES.items():
            found = measure(change, Path(folder))
            after_s = found.verdict_s - found.first_s
            print(f"{name:22}{after_s:18.2f}{found.published:18}   {found.text[:110]}", flush=True)
    return 0 if not rclpy.ok() else 1


if __name__ == "__main__":
    sys.exit(main())
