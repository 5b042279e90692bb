# SPDX-License-Identifier: Apache-2.0
"""What a user's program does with the arm: watch it, move it, call its services."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from galen_common.cdr import JointWire
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.poses.plan import quintic_duration_s
from galen_ros.messages import STREAM, fill_stamp, stamp_to_ns, wrench_to_array
from galen_ros.node.spin import make_executor
from geometry_msgs.msg import WrenchStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from galen_msgs.srv import SetTool

MAX_VELOCITY = np.array([0.15, 0.15, 0.15, 1.4, 1.4])
MAX_ACCELERATION = np.array([0.9, 0.9, 0.9, 5.5, 5.5])
"""m/s, rad/s and per s: a little below the simulated arm's own limits."""
_CHECK_EVERY_S = 0.2


JointListener = Callable[[int, Array, Array | None], None]
WrenchListener = Callable[[int, Array], None]


class ArmClient(Node):
    """Subscribes to the streams, and hands each sample to the present listener.

    Listeners: on_joints(stamp_ns, position (5,), velocity (5,)), on_raw(stamp_ns, wrench (6,)),
    on_compensated(stamp_ns, wrench (6,)).
    """

    def __init__(self, check: Callable[[], None]) -> None:
        """Make the node, its subscriptions and clients; ROS must be initialised.

        Args:
            check: called a few times a second while waiting; it raises when going on makes no
                sense.

        """
        super().__init__("galen_demo")
        self._check = check
        self._executor = make_executor()
        self._executor.add_node(self)
        self._reader = JointWire(GALEN.joint_names)
        self.stamp_ns = 0
        self.position: Array | None = None
        self.on_joints: JointListener | None = None
        self.on_raw: WrenchListener | None = None
        self.on_compensated: WrenchListener | None = None
        self._trajectory = self.create_publisher(JointTrajectory, "joint_trajectory", 10)
        self.create_subscription(JointState, "joint_states", self._on_joint_state, STREAM, raw=True)
        self._set_tool = self.create_client(SetTool, "gravcomp/set_tool")
        self._zero_ft_sensor = self.create_client(Trigger, "zero_ft_sensor")
        self._set_admittance = self.create_client(SetBool, "sim_driver/set_admittance")
        self._driver_parameters = AsyncParameterClient(self, "sim_driver")

    @contextmanager
    def wrenches(self) -> Iterator[None]:
        """Receive both wrenches while this lasts.

        Unneeded, they would cost a third of a core at five times real time.
        """
        subscriptions = [
            self.create_subscription(WrenchStamped, topic, callback, STREAM)
            for topic, callback in (
                ("wrench_raw", self._on_wrench_raw),
                ("wrench_compensated", self._on_wrench_compensated),
            )
        ]
        try:
            yield
        finally:
            for subscription in subscriptions:
                self.destroy_subscription(subscription)

    def close(self) -> None:
        """Leave ROS."""
        self._executor.remove_node(self)
        self.destroy_node()
        self._executor.shutdown()

    def wait_for(self, predicate: Callable[[], Any], timeout_s: float, what: str) -> None:
        """Spin until a predicate holds.

        Args:
            predicate: called after every event, and twenty times a second.
            timeout_s: how long to wait, s of wall time.
            what: names what is waited for in the error's text.

        Raises:
            GalenError: it did not hold in time; what `check` raises comes out as well.

        """
        now = time.monotonic()
        deadline, next_check = now + timeout_s, now
        while not predicate():
            self._executor.spin_once(timeout_sec=0.05)
            now = time.monotonic()
            if now > next_check:  # it asks the system, which costs more than a sample
                self._check()
                next_check = now + _CHECK_EVERY_S
            if now > deadline:
                raise GalenError(f"waited {timeout_s:g} s in vain for {what}")

    def wait_until_up(self, timeout_s: float = 30.0) -> None:
        """Wait for the streams and services of driver and gravcomp.

        Args:
            timeout_s: for each of them, s of wall time.

        Raises:
            GalenError: naming the first that did not come in time.

        """
        self.wait_for(lambda: self.position is not None, timeout_s, "joint_states")
        for client in (self._set_tool, self._zero_ft_sensor, self._set_admittance):
            self.wait_for(client.service_is_ready, timeout_s, f"the service {client.srv_name}")
        self.wait_for(self._driver_parameters.services_are_ready, timeout_s, "sim_driver")
        self.wait_for(
            lambda: self._trajectory.get_subscription_count() > 0, timeout_s, "joint_trajectory"
        )

    def move_to(self, target: Array) -> float:
        """Send a smooth move from here, from rest to rest.

        Args:
            target: joints (5,), m and rad.

        Returns:
            The move's duration, s.

        Raises:
            GalenError: no joint state has come yet.

        """
        if self.position is None:
            raise GalenError("where the arm is, is not known: no joint_states yet")
        duration_s = quintic_duration_s(target - self.position, MAX_VELOCITY, MAX_ACCELERATION)
        self.follow([target], [duration_s])
        return duration_s

    def follow(self, targets: Sequence[Array], times_s: Sequence[float], start_ns: int = 0) -> None:
        """Send a trajectory through joints, at rest in each.

        Args:
            targets: joints (5,) each, m and rad.
            times_s: when the arm is there, one a target, s since the start.
            start_ns: stamp of the start, ns; 0: at once.

        """
        message = JointTrajectory(joint_names=list(GALEN.joint_names))
        fill_stamp(message.header.stamp, start_ns)
        for target, time_s in zip(targets, times_s, strict=True):
            message.points.append(
                JointTrajectoryPoint(
                    positions=[float(value) for value in target],
                    velocities=[0.0] * 5,
                    accelerations=[0.0] * 5,
                    time_from_start=Duration(seconds=time_s).to_msg(),
                )
            )
        self._trajectory.publish(message)

    def set_tool(self, tool: str) -> SetTool.Response:
        """Make gravcomp load a calibration file.

        Args:
            tool: the file's name, without folder and ending.

        Returns:
            The service's Response, of a success.

        Raises:
            GalenError: with gravcomp's reason, or for lack of an answer.

        """
        response = self._call(self._set_tool, SetTool.Request(tool=tool))
        if not response.success:
            raise GalenError(f"gravcomp: {response.error_msg}")
        return response

    def zero_ft_sensor(self) -> None:
        """Zero the sensor here.

        Raises:
            GalenError: with the driver's reason, or for lack of an answer.

        """
        response = self._call(self._zero_ft_sensor, Trigger.Request())
        if not response.success:
            raise GalenError(f"zero_ft_sensor: {response.message}")

    def set_admittance(self, on: bool, source: str) -> None:
        """Switch the driver's admittance mode.

        Args:
            on: whether the arm follows the wrench.
            source: of the wrench, "compensated" or "raw".

        Raises:
            GalenError: with the driver's reason, or for lack of an answer.

        """
        parameter = Parameter("admittance_source", value=source)
        future = self._driver_parameters.set_parameters([parameter])
        self.wait_for(future.done, 10.0, "sim_driver to take a parameter")
        result = future.result().results[0]
        if not result.successful:
            raise GalenError(f"sim_driver: admittance_source: {result.reason}")
        response = self._call(self._set_admittance, SetBool.Request(data=on))
        if not response.success:
            raise GalenError(f"sim_driver: {response.message}")

    def _call(self, client: Any, request: Any) -> Any:
        future = client.call_async(request)
        self.wait_for(future.done, 20.0, f"an answer of {client.srv_name}")
        return future.result()

    def _on_joint_state(self, data: bytes) -> None:
        self.stamp_ns, position, velocity = self._reader.read_motion(data)
        self.position = np.array(position)
        if self.on_joints is not None:
            speed = None if velocity is None else np.array(velocity)
            self.on_joints(self.stamp_ns, self.position, speed)

    def _on_wrench_raw(self, message: WrenchStamped) -> None:
        if self.on_raw is not None:
            self.on_raw(stamp_to_ns(message.header.stamp), wrench_to_array(message))

    def _on_wrench_compensated(self, message: WrenchStamped) -> None:
        if self.on_compensated is not None:
            self.on_compensated(stamp_to_ns(message.header.stamp), wrench_to_array(message))
