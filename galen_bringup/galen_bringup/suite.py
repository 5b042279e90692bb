"""The suite on the simulated arm, as processes of their own, in a ROS domain of its own."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from galen_model.load.nominal_tools import TOOLS
from galen_ros.node.domain import DomainLock
from rclpy.signals import SignalHandlerOptions

from galen_bringup.arm_client import ArmClient
from galen_bringup.processes import ProcessError, Processes, executable_path, ros_arguments

AVERAGE_S = 0.25
"""Length of an averaged reading outside the calibration, s of simulated time."""

_CALIBRATION = {
    "settle_s": 0.05,
    "velocity_window_s": 0.06,
    "max_angle_velocity_rad_s": 1.4,
    "max_angle_acceleration_rad_s2": 5.5,
    "max_delta_velocity_m_s": 0.15,
    "max_delta_acceleration_m_s2": 0.9,
    "use_sim_time": True,
}
"""Quicker than the node's defaults, which are for a real arm; the simulated one does not ring."""


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
    """Start driver, compensation and calibration; returns when they are up."""
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
        ros_arguments({"tools_dir": tools_dir, **_CALIBRATION}),
    )
    with connected_arm(processes):
        pass  # entering waits until the nodes are up


def calibrate(processes: Processes, tool: str, arguments: Sequence[str] = ()) -> dict[str, Any]:
    """Run the client that a user runs; its progress goes to standard error.

    Raises ProcessError when it fails.
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
    """The arm's client lives only while it is listened to: unread queues would hold old samples."""
    arm = ArmClient(processes.check)
    try:
        arm.wait_until_up()
        yield arm
    finally:
        arm.close()
