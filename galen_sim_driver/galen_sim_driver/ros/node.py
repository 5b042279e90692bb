# SPDX-License-Identifier: Apache-2.0
"""The simulated driver as a ROS node: stands in for arm, force/torque sensor and tracker."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

import numpy as np
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_model.arm.galen import TRACKER_FRAME, galen_urdf
from galen_model.errors import ToolNameError
from galen_model.files.calibration_file import check_tool_name
from galen_ros.messages import LATCHED, STREAM, fill_stamp, stamp_to_ns, wrench_to_array
from galen_ros.node.diagnostics import ERROR, OK, WARN, Level, Status
from galen_ros.node.managed_node import ManagedNode
from galen_ros.node.parameters import declare_parameters
from galen_ros.node.spin import run
from galen_ros.rclpy_workarounds import DeferredService, Respond
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from galen_msgs.srv import PushTool, SetTool
from galen_sim_driver.effects.effect import ConfigError
from galen_sim_driver.parameters import (
    DRIVER_NODE,
    DriverParameters,
    SimulatedArmParameters,
    effect_parameters,
    effects_of,
)
from galen_sim_driver.plant.cell import Plant, Sample
from galen_sim_driver.plant.config import HandPush, PlantError
from galen_sim_driver.plant.motion import Trajectory, TrajectoryPoint
from galen_sim_driver.plant.sensors import MarkerPose, Zeroing

_CLOCK_RATE_HZ = 100.0
# Slower than this part of what was asked is worth a warning.
_SLOW = 0.9
_TELL_SLOW_EVERY_S = 60.0
# A busy machine must slow the simulation down: a node that falls behind it loses samples.
_NICENESS = 10
_INACTIVE = "the driver is inactive: activate it first"
_TICK_S = 0.002
"""Wall time between two batches of steps."""
_MOST_STEPS = 40
"""Of the plant at once, when it has to catch up."""


def trajectory_from_message(message: JointTrajectory) -> Trajectory:
    """Return the trajectory that a message asks for, unchecked.

    Args:
        message: in m, rad and s; its stamp 0 means now.

    Returns:
        The trajectory.

    """
    return Trajectory(
        list(message.joint_names),
        [
            TrajectoryPoint(
                point.time_from_start.sec + point.time_from_start.nanosec * 1e-9,
                list(point.positions),
                list(point.velocities),
                list(point.accelerations),
            )
            for point in message.points
        ],
        stamp_to_ns(message.header.stamp),
    )


def push_from_request(request: PushTool.Request) -> HandPush:
    """Return the push that a request asks for, unchecked.

    Args:
        request: force and torque in N and N.m along base_link, times in s.

    Returns:
        A push that begins at once.

    """
    fx, fy, fz = (float(value) for value in request.force_n)
    tx, ty, tz = (float(value) for value in request.torque_nm)
    return HandPush(
        start_s=0.0,
        # In this order, for rise and fall to be within the sum whatever is rounded.
        duration_s=(request.rise_s + request.fall_s) + request.hold_s,
        force_n=(fx, fy, fz),
        torque_nm=(tx, ty, tz),
        frame="base",
        ramp_s=request.rise_s,
        fall_s=request.fall_s,
    )


def fill_pose(message: PoseStamped, stamp_ns: int, pose: MarkerPose) -> None:
    """Write stamp and pose into a message.

    Args:
        message: to be filled; its frame stays.
        stamp_ns: ns.
        pose: of a marker in `tracker`, m.

    """
    fill_stamp(message.header.stamp, stamp_ns)
    position, orientation = message.pose.position, message.pose.orientation
    (position.x, position.y, position.z), turn = pose
    orientation.x, orientation.y, orientation.z, orientation.w = turn


class Pacer:
    """Spread simulated periods over wall time, `speed_factor` simulated seconds to a second.

    In real time every step that a stall left out is made up, at most 40 at once, since
    the stamps follow the system's clock. At another speed a stall slows simulated time down
    instead: steps in a burst would overrun the subscribers of a machine that is short of time.
    """

    def __init__(self, period_s: float, speed_factor: float) -> None:
        self._steps_per_s = speed_factor / period_s
        self._makes_up = speed_factor == 1.0
        self._origin_s = 0.0
        self._taken = 0

    def start(self, now_s: float) -> None:
        """Count from now.

        Args:
            now_s: steady clock, s.

        """
        self._origin_s = now_s
        self._taken = 0

    def due(self, now_s: float) -> int:
        """Return how many steps to take now; the caller takes them.

        Args:
            now_s: steady clock, s.

        Returns:
            0 to 40.

        """
        missing = int((now_s - self._origin_s) * self._steps_per_s) - self._taken
        steps = max(0, min(missing, _MOST_STEPS))
        self._taken += steps
        if steps < missing and not self._makes_up:
            self.start(now_s)
        return steps


class SpeedMeter:
    """Measure the speed of simulated time over at least `window_s` of wall time."""

    def __init__(self, window_s: float) -> None:
        self._window_s = window_s
        self._last: tuple[float, int] | None = None
        self.speed: float | None = None
        """Simulated over wall time, None at first."""

    def update(self, now_s: float, sim_ns: int) -> None:
        """Take both times; `speed` changes when the window is over.

        Args:
            now_s: steady clock, s.
            sim_ns: simulated time, ns.

        """
        if self._last is None:
            self._last = (now_s, sim_ns)
        elif now_s - self._last[0] >= self._window_s:
            self.speed = (sim_ns - self._last[1]) * 1e-9 / (now_s - self._last[0])
            self._last = (now_s, sim_ns)


class SimDriverNode(ManagedNode):
    """Step the plant by wall time, publish its samples, pass commands on to it.

    While it is inactive, the arm and the world go on: the plant is stepped, nothing is published,
    and no command moves the arm.
    """

    hardware_id = "galen_simulated"

    def __init__(self, **node_options: Any) -> None:
        """Take rclpy.node.Node's keyword arguments, such as context and parameter_overrides."""
        super().__init__(DRIVER_NODE, **node_options)
        self._held = self.hold(DriverParameters, self._on_parameters)
        # What effects have parameters hangs on the arm, which therefore stays as it is.
        self._arm = declare_parameters(self, SimulatedArmParameters).arm()
        self._held_effects = self.hold(effect_parameters(self._arm))
        self.start()

    def _configure(self) -> None:
        self._settings = self._held.now
        effects = effects_of(self._held_effects.now)
        real_time = self._settings.speed_factor == 1.0
        config = replace(self._settings.plant_config(self._arm), effects=effects)
        if real_time:
            config = replace(config, start_ns=time.time_ns())
        self._config = config
        self._plant = Plant(config, np.random.default_rng(self._settings.seed))
        self._plant.attach_tool(self._settings.initial_tool)
        self._rejected_count = 0
        self._rejection = ""
        self._ignored_wrench = ""
        self._pending_zeroing: tuple[Zeroing, Any, Respond] | None = None
        """A zeroing under way, and the response that its caller waits for."""

        self._joint_state_bytes = joint_state_bytes(config.arm.joint_names, "")
        self._wrench_bytes = wrench_bytes(self._arm.sensor_frame)
        self._pose = PoseStamped()
        self._pose.header.frame_id = TRACKER_FRAME
        self._clock_message = ClockMessage()
        self._clock_every = round(config.rate_hz / _CLOCK_RATE_HZ)
        self._until_clock = 1

        self._joint_states = self.create_publisher(JointState, "joint_states", STREAM)
        self._wrench_raw = self.create_publisher(WrenchStamped, "wrench_raw", STREAM)
        self._tool_pose = self.create_publisher(PoseStamped, "tracker/tool_pose", STREAM)
        self._base_pose = self.create_publisher(PoseStamped, "tracker/base_pose", STREAM)
        self._description = self.create_publisher(String, "robot_description", LATCHED)
        self._sim_clock = None if real_time else self.create_publisher(ClockMessage, "/clock", 10)
        self._publish_description()

        self._at_undo(self._give_up_zeroing)
        DeferredService(self, Trigger, "zero_ft_sensor", self._on_zero_ft_sensor)
        self.create_service(SetTool, "attach_tool", self._on_attach_tool)
        self.create_service(PushTool, "push_tool", self._on_push_tool)
        self.create_service(SetBool, "~/set_admittance", self._on_set_admittance)
        self.create_service(Trigger, "~/run_hand", self._on_run_hand)

        self._speed_meter = SpeedMeter(window_s=0.9)
        self._pacer = Pacer(config.period_ns * 1e-9, self._settings.speed_factor)
        self._pacer.start(time.monotonic())
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._on_tick, clock=self._steady)

    def _activate(self) -> None:
        self.create_subscription(JointTrajectory, "joint_trajectory", self._on_trajectory, 10)
        self.create_subscription(
            WrenchStamped, "wrench_compensated", self._on_wrench_compensated, STREAM
        )
        self._at_undo(self._stand_still)

    def _stand_still(self) -> None:
        self._plant.set_admittance(False)
        self._plant.stop()

    # --- samples out ------------------------------------------------------------------------

    def _on_tick(self) -> None:
        raw_admittance = self._plant.admittance_on and self._settings.admittance_source == "raw"
        for _ in range(self._pacer.due(time.monotonic())):
            sample = self._plant.step()
            if not self.active:
                continue
            self._publish(sample)
            if raw_admittance:
                self._plant.admittance.feed(sample.stamp_ns, sample.wrench)
        if self._pending_zeroing is not None and self._pending_zeroing[0].done:
            self._answer_zeroing()

    def _publish(self, sample: Sample) -> None:
        stamp_ns = sample.stamp_ns
        if self._sim_clock is not None:
            self._until_clock -= 1
            if self._until_clock == 0:
                self._until_clock = self._clock_every
                fill_stamp(self._clock_message.clock, stamp_ns)
                self._sim_clock.publish(self._clock_message)
        self._joint_states.publish(
            self._joint_state_bytes.fill(stamp_ns, sample.positions, sample.velocities)
        )
        wrench_ns = stamp_ns + self._plant.wrench_delay_ns
        self._wrench_raw.publish(self._wrench_bytes.fill(wrench_ns, sample.wrench))
        if sample.tracker is not None:
            publishers = (self._tool_pose, self._base_pose)
            for publisher, marker in zip(publishers, sample.tracker, strict=True):
                if marker is not None:
                    fill_pose(self._pose, stamp_ns + self._plant.tracker_delay_ns, marker)
                    publisher.publish(self._pose)

    def _publish_description(self) -> None:
        text = self._arm.urdf
        if self._arm.delta is not None:  # the Galen's has the tip of the tool that is on
            tool = self._config.tools.get(self._plant.tool)
            text = galen_urdf(self._arm, np.zeros(3) if tool is None else tool.tip_m)
        self._description.publish(String(data=text))

    # --- commands in ------------------------------------------------------------------------

    def _on_trajectory(self, message: JointTrajectory) -> None:
        try:
            self._plant.command(trajectory_from_message(message))
        except PlantError as error:
            self._rejected_count += 1
            self._rejection = str(error)
            self.get_logger().error(f"joint_trajectory rejected: {error}")
            self._diagnostics.publish_now()
            return
        if self._rejection:
            self._rejection = ""
            self._diagnostics.publish_now()

    def _on_wrench_compensated(self, message: WrenchStamped) -> None:
        if self._settings.admittance_source != "compensated":
            return
        frame = self._arm.sensor_frame
        if message.header.frame_id != frame:
            self._ignored_wrench = (
                f"wrench_compensated is in frame '{message.header.frame_id}', not '{frame}'"
            )
            return
        self._ignored_wrench = ""
        if self._plant.admittance_on:
            self._plant.admittance.feed(
                stamp_to_ns(message.header.stamp), wrench_to_array(message).tolist()
            )

    def _on_parameters(self, parameters: DriverParameters) -> None:
        self._settings = parameters
        self._plant.admittance.forget()
        self._diagnostics.publish_now()

    # --- services ---------------------------------------------------------------------------

    def _on_zero_ft_sensor(self, _: Any, response: Any, respond: Respond) -> None:
        try:
            if not self.active:
                raise PlantError(_INACTIVE)
            zeroing = self._plant.start_zeroing(self._settings.bias_window_s)
        except PlantError as error:
            response.message = f"not zeroed: {error}"
            respond(response)
            return
        self._pending_zeroing = (zeroing, response, respond)

    def _give_up_zeroing(self) -> None:
        """Answer the caller of a zeroing when the services are removed."""
        if self._pending_zeroing is not None:
            self._pending_zeroing[0].error = PlantError("the driver was shut down")
            self._answer_zeroing()

    def _answer_zeroing(self) -> None:
        assert self._pending_zeroing is not None
        zeroing, response, respond = self._pending_zeroing
        self._pending_zeroing = None
        response.success = zeroing.error is None
        at = ", ".join(f"{name} {value:.6g} rad" for name, value in self._zero_angles().items())
        response.message = (
            f"zeroed at {at}" if zeroing.error is None else f"not zeroed: {zeroing.error}"
        )
        respond(response)
        self._diagnostics.publish_now()

    def _zero_angles(self) -> dict[str, float]:
        names = self._config.arm.turning_names
        return dict(zip(names, self._plant.zero_angles, strict=True))

    def _on_attach_tool(self, request: Any, response: Any) -> Any:
        response.error_code = SetTool.Response.NONE
        try:
            if request.tool:
                check_tool_name(request.tool)
            self._plant.attach_tool(request.tool)
        except ToolNameError as error:
            response.error_code = SetTool.Response.INVALID_NAME
            response.error_msg = str(error)
        except PlantError as error:
            response.error_code = SetTool.Response.NOT_FOUND
            response.error_msg = str(error)
        else:
            self._publish_description()
            self._diagnostics.publish_now()
        response.success = response.error_code == SetTool.Response.NONE
        response.tool = self._plant.tool
        tool = self._config.tools.get(self._plant.tool)
        if tool is not None:
            response.mass_kg = float(tool.load.mass_kg)
            response.com_m = [float(value) for value in tool.load.com_m]
            response.tip_m = [float(value) for value in tool.tip_m]
        return response

    def _on_push_tool(self, request: Any, response: Any) -> Any:
        try:
            self._plant.push(push_from_request(request))
        except PlantError as error:
            response.error_code, response.error_msg = PushTool.Response.BUSY, str(error)
        except ConfigError as error:
            response.error_code, response.error_msg = PushTool.Response.BAD_INPUT, str(error)
        response.success = response.error_code == PushTool.Response.NONE
        return response

    def _on_set_admittance(self, request: Any, response: Any) -> Any:
        if request.data and not self.active:
            response.message = f"admittance stays off: {_INACTIVE}"
            return response
        self._plant.set_admittance(request.data)
        self._diagnostics.publish_now()
        response.success = True
        state = "on" if request.data else "off"
        response.message = f"admittance {state}, source {self._settings.admittance_source}"
        return response

    def _on_run_hand(self, _: Any, response: Any) -> Any:
        if not self._config.hand:
            response.message = "parameter 'hand_pushes' is empty"
            return response
        self._plant.start_hand()
        response.success = True
        end_s = max(push.start_s + push.duration_s for push in self._config.hand)
        response.message = f"{len(self._config.hand)} pushes in {end_s:.6g} s"
        return response

    # --- state ------------------------------------------------------------------------------

    def _state(self, speed: float | None) -> tuple[Level, str, str]:
        """Level, the state's short name, and a sentence for a person."""
        asked = self._settings.speed_factor
        if not self.active:
            return WARN, "inactive", self.inactive_text
        if self._rejection:
            return ERROR, "trajectory_rejected", f"trajectory rejected: {self._rejection}"
        if self._ignored_wrench and self._plant.admittance_on:
            return ERROR, "wrench_ignored", self._ignored_wrench
        if self.count_publishers("joint_states") > 1:
            text = "another node publishes joint_states too: two drivers at once?"
            return WARN, "several_drivers", text
        if speed is not None and speed < _SLOW * asked:
            text = (
                f"runs at {speed:.3g} times real time, speed_factor is {asked:g}: this machine"
                " keeps up with no more; close other programs, or lower speed_factor"
            )
            self.get_logger().warning(text, throttle_duration_sec=_TELL_SLOW_EVERY_S)
            return WARN, "slow", text
        return OK, "running", "running"

    def _report(self) -> Status:
        asked = self._settings.speed_factor
        self._speed_meter.update(time.monotonic(), self._plant.now_ns)
        speed = self._speed_meter.speed
        level, state, message = self._state(speed)
        return Status(
            level,
            message,
            {
                "state": state,
                "samples_per_wall_s": self._config.rate_hz * (speed or 0.0),
                "speed_factor": asked,
                "speed_reached": speed or 0.0,
                "tool": self._plant.tool or "none",
                "moving": self._plant.moving,
                "admittance": self._plant.admittance_on,
                "admittance_source": self._settings.admittance_source,
                "hand": self._plant.hand_active,
                "effects": ", ".join(effect.identity for effect in self._config.effects) or "none",
                **{f"zeroed_at_{name}_rad": q for name, q in self._zero_angles().items()},
                "trajectories_rejected": self._rejected_count,
            },
        )


def main() -> None:
    """Run the node until SIGINT or SIGTERM, at a lower priority than the other nodes."""
    os.nice(_NICENESS)
    run(SimDriverNode)


if __name__ == "__main__":
    main()
