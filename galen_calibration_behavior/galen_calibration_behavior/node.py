"""The action server `calibrate_tool`: runs the procedure on the arm's topics and services."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arm import JOINT_NAMES, SENSOR_FRAME
from galen_model.arrays import Array
from galen_model.errors import GalenError, NotExcitedError, ToolFileError, ToolNameError
from galen_model.identification import check_planned_poses
from galen_model.tool_file import tool_path
from galen_ros.conversions import JointStateReader, stamp_to_ns, wrench_to_array
from galen_ros.diagnostics import OK, WARN, DiagnosticsPublisher, Status
from galen_ros.parameters import declare_parameters
from galen_ros.qos import STREAM
from galen_ros.spin import run
from geometry_msgs.msg import WrenchStamped
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from galen_calibration_behavior.arm_link import DISCOVERY_S, ArmPublisher, PublisherWatch
from galen_calibration_behavior.commands import (
    AttachTool,
    Command,
    ErrorCode,
    Estimate,
    Feedback,
    Finished,
    MoveTo,
    Stop,
    ZeroSensor,
)
from galen_calibration_behavior.deferred_action import DeferredActionServer
from galen_calibration_behavior.estimate import (
    Calibration,
    EstimateError,
    calibrate,
    check_writable,
    choose_tip,
)
from galen_calibration_behavior.parameters import MAX_ITERS, CalibrationParameters
from galen_calibration_behavior.procedure import CalibrationProcedure, Request
from galen_calibration_behavior.result_text import calibration_fields
from galen_msgs.action import CalibrateTool
from galen_msgs.srv import SetTool

_TICK_S = 0.1
# The publishers of the topics are looked up this often.
_TICKS_PER_GRAPH_CHECK = 10


class _RefusedGoalError(Exception):
    """A goal that can't be begun."""

    def __init__(self, code: ErrorCode, message: str) -> None:
        super().__init__(message)
        self.code = code


class _Goal:
    """One running goal and what belongs to it alone."""

    def __init__(
        self,
        handle: ServerGoalHandle,
        procedure: CalibrationProcedure,
        path: Path,
        tip_m: Array,
        warnings: list[str],
    ) -> None:
        self.handle = handle
        self.procedure = procedure
        self.path = path
        self.tip_m = tip_m
        self.warnings = warnings
        self.reader = JointStateReader(JOINT_NAMES)
        self.subscriptions: list[Subscription] = []
        self.publishers: PublisherWatch | None = None
        self.calibration: Calibration | None = None
        self.preflight_s: float | None = 0.0
        self.ticks = 0


class CalibrationNode(Node):
    """Declares, converts and calls; what happens when is in CalibrationProcedure."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calibration", **kwargs)
        self._settings = declare_parameters(self, CalibrationParameters)
        self._tools_dir = Path(self._settings.tools_dir).expanduser()
        self._goal: _Goal | None = None
        self._over: list[_Goal] = []
        self._refused = ""
        self._last = "no calibration yet"
        self._last_failed = False

        self._arm = ArmPublisher(self)
        self._bias_client = self.create_client(Trigger, "bias_sensor")
        self._attach_client = self.create_client(SetTool, "attach_tool")
        self.create_service(Trigger, "~/confirm", self._on_confirm)
        self._server = DeferredActionServer(
            self,
            CalibrateTool,
            "calibrate_tool",
            on_goal=self._on_goal,
            on_start=self._on_start,
            on_cancel=self._on_cancel,
        )
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._on_tick, clock=self._steady)
        self._diagnostics = DiagnosticsPublisher(self, "galen", self._report_status)

    def destroy_node(self) -> None:
        """Stop the arm if it is at work, then go."""
        if self._goal is not None:
            self.get_logger().warning("shutting down: stopping the arm, nothing is written")
            self._arm.stop_and_wait()
            self._goal.handle.abort()
            self._goal = None
        self._server.destroy()
        super().destroy_node()

    # ---- the action

    def _on_goal(self, request: CalibrateTool.Goal) -> GoalResponse:
        """Refuse a second goal; an action's refusal carries no text, so /diagnostics does."""
        if self._goal is None:
            return GoalResponse.ACCEPT
        done, total = self._goal.procedure.progress
        self._refused = (
            f"{request.tool!r} refused: calibrating {self._goal.handle.request.tool!r} now,"
            f" {done} of {total} poses done; cancel that first, or wait"
        )
        self.get_logger().warning(self._refused)
        self._diagnostics.publish_now()
        return GoalResponse.REJECT

    def _on_start(self, handle: ServerGoalHandle) -> None:
        """Begin; a goal that makes no sense ends at once, for a result can say why."""
        request = handle.request
        try:
            goal = self._make_goal(handle)
        except _RefusedGoalError as error:
            self._conclude(handle, Finished(error.code, str(error)), None)
            return
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            self._conclude(handle, _internal(error), None)
            return
        self._goal = goal
        self._refused = ""
        goal.subscriptions = [
            self.create_subscription(JointState, "joint_states", self._on_joint_state, STREAM),
            self.create_subscription(WrenchStamped, "wrench_raw", self._on_wrench, STREAM),
        ]
        goal.publishers = PublisherWatch(self, [s.topic_name for s in goal.subscriptions])
        self.get_logger().info(
            f"calibrating {request.tool!r}: {goal.procedure.progress[1]} poses, file {goal.path}"
        )
        self._diagnostics.publish_now()

    def _make_goal(self, handle: ServerGoalHandle) -> _Goal:
        request = handle.request
        for name, count in (("iters_t", request.iters_t), ("iters_r", request.iters_r)):
            if count > MAX_ITERS:
                raise _RefusedGoalError(
                    ErrorCode.BAD_INPUT, f"{name} is {count}: at most {MAX_ITERS}, or 0"
                )
        tilts = request.iters_t or self._settings.itersT
        rolls = request.iters_r or self._settings.itersR
        try:
            path = tool_path(self._tools_dir, request.tool)
            poses = self._settings.poses(tilts, rolls)
            check_planned_poses(
                poses[:, 0],
                poses[:, 1],
                one_sweep=request.one_sweep,
                bias_roll_rad=self._settings.Rhome,
                bias_tilt_rad=self._settings.Thome,
            )
            tip_m, warnings = choose_tip(np.array(request.tip_m, float), path)
            check_writable(path)
        except ToolNameError as error:
            raise _RefusedGoalError(ErrorCode.INVALID_NAME, str(error)) from error
        except ToolFileError as error:
            raise _RefusedGoalError(ErrorCode.WRITE_FAILED, str(error)) from error
        except NotExcitedError as error:
            raise _RefusedGoalError(ErrorCode.NOT_EXCITED, str(error)) from error
        except GalenError as error:
            raise _RefusedGoalError(ErrorCode.BAD_INPUT, str(error)) from error
        procedure = CalibrationProcedure(
            self._settings.settings(),
            Request(request.tool, request.one_sweep, request.attach_by_service, poses),
        )
        return _Goal(handle, procedure, path, tip_m, warnings)

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        goal = self._goal
        if goal is None or goal.handle.goal_id != handle.goal_id:
            return CancelResponse.REJECT
        self.get_logger().info("canceled: stopping the arm")
        self._feed(goal.procedure.cancel)
        return CancelResponse.ACCEPT

    def _conclude(
        self, handle: ServerGoalHandle, end: Finished, calibration: Calibration | None
    ) -> None:
        """Give the goal its result and say it on /diagnostics and in the log."""
        self._server.finish(
            handle,
            _to_result(handle.request.tool, end, calibration),
            success=end.error_code == ErrorCode.NONE,
        )
        tool = handle.request.tool
        self._last_failed = end.error_code not in (ErrorCode.NONE, ErrorCode.CANCELED)
        if calibration is not None:
            self._last = f"{tool!r} calibrated: {calibration.path}"
            self.get_logger().info(self._last)
        else:
            self._last = f"{tool!r} not calibrated: {end.error_code.name}: {end.error_msg}"
            if end.error_code == ErrorCode.CANCELED:
                self.get_logger().info(self._last)
            else:
                self.get_logger().error(self._last)
        self._diagnostics.publish_now()

    # ---- inputs

    def _on_joint_state(self, message: JointState) -> None:
        goal = self._goal
        if goal is None:
            return
        try:
            position, velocity = goal.reader.read(message)
        except GalenError as error:
            self._feed(goal.procedure.fail, ErrorCode.BAD_INPUT, f"joint_states: {error}")
            return
        self._feed(goal.procedure.on_joints, stamp_to_ns(message.header.stamp), position, velocity)

    def _on_wrench(self, message: WrenchStamped) -> None:
        goal = self._goal
        if goal is None:
            return
        if message.header.frame_id != SENSOR_FRAME:
            self._feed(
                goal.procedure.fail,
                ErrorCode.BAD_INPUT,
                f"wrench_raw has frame_id {message.header.frame_id!r}, not {SENSOR_FRAME!r}",
            )
            return
        self._feed(
            goal.procedure.on_wrench, stamp_to_ns(message.header.stamp), wrench_to_array(message)
        )

    def _on_confirm(self, _request: Trigger.Request, response: Trigger.Response) -> Any:
        goal = self._goal
        response.success = goal is not None and goal.procedure.waiting_for_person
        if goal is None:
            response.message = "no calibration is running"
        elif not response.success:
            response.message = f"nobody was asked for anything: state {goal.procedure.state.name}"
        else:
            self._feed(goal.procedure.confirm)
        return response

    def _on_tick(self) -> None:
        for over in self._over:
            for subscription in over.subscriptions:
                self.destroy_subscription(subscription)
        self._over.clear()
        goal = self._goal
        if goal is None:
            return
        if goal.ticks % _TICKS_PER_GRAPH_CHECK == 0 or goal.preflight_s is not None:
            self._feed(self._check_publishers, goal)
        goal.ticks += 1
        if self._goal is goal and goal.preflight_s is not None:
            self._feed(self._check_driver, goal)
        if self._goal is goal:
            self._feed(goal.procedure.on_wall, time.monotonic())

    # ---- the driver

    def _check_driver(self, goal: _Goal) -> None:
        """Start the procedure once everything it needs is there, or say what is missing."""
        missing = self._find_missing(goal)
        if missing is None:
            goal.preflight_s = None
            goal.procedure.start()
            return
        assert goal.preflight_s is not None
        goal.preflight_s += _TICK_S
        if goal.preflight_s > max(self._settings.silent_timeout_s, DISCOVERY_S):
            goal.procedure.fail(*missing)

    def _find_missing(self, goal: _Goal) -> tuple[ErrorCode, str] | None:
        assert goal.publishers is not None
        silent = goal.publishers.silent()
        if silent:
            return (
                ErrorCode.DRIVER_SILENT,
                f"nobody publishes {' and '.join(silent)}: is the driver running?",
            )
        clients: list[Client] = [self._bias_client]
        if goal.handle.request.attach_by_service:
            clients.append(self._attach_client)
        absent = [
            self.resolve_service_name(client.srv_name)
            for client in clients
            if not client.service_is_ready()
        ]
        if absent:
            return ErrorCode.SERVICE_FAILED, f"nobody offers the service {' and '.join(absent)}"
        if not self._arm.has_listener:
            return (
                ErrorCode.DRIVER_SILENT,
                f"nobody listens on {self._arm.topic_name}: is the driver running?",
            )
        return None

    def _check_publishers(self, goal: _Goal) -> None:
        """End when a topic has two publishers, or another than before: its zero would be lost."""
        assert goal.publishers is not None
        if several := goal.publishers.several():
            goal.procedure.fail(ErrorCode.BAD_INPUT, several)
        elif changed := goal.publishers.changed():
            goal.procedure.fail(
                ErrorCode.DRIVER_SILENT,
                f"{changed}: the driver was restarted, and the sensor's zero is lost",
            )

    def _call(self, client: Client, request: Any) -> None:
        goal = self._goal
        future = client.call_async(request)

        def on_answer(answered: Any) -> None:
            if self._goal is not goal or goal is None:
                return
            response = answered.result()
            text = (
                response.message if isinstance(response, Trigger.Response) else response.error_msg
            )
            self._feed(goal.procedure.on_service, response.success, text)

        future.add_done_callback(on_answer)

    # ---- commands

    def _feed(self, event: Callable[..., object], *args: object) -> None:
        """Hand an event to the procedure and do what it then asks for; a bug ends only the goal."""
        goal = self._goal
        try:
            event(*args)
            while goal is not None and (commands := goal.procedure.take_commands()):
                for command in commands:
                    self._obey(goal, command)
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            if goal is None or self._goal is not goal:
                return
            self._arm.stop()
            self._end(goal, _internal(error))

    def _obey(self, goal: _Goal, command: Command) -> None:
        match command:
            case Feedback():
                self._publish_feedback(goal, command)
            case MoveTo():
                self._arm.move(command)
            case Stop():
                self._arm.stop()
            case ZeroSensor():
                self._call(self._bias_client, Trigger.Request())
            case AttachTool():
                self._call(self._attach_client, SetTool.Request(tool=command.tool))
            case Estimate():
                self._estimate(goal, command)
            case Finished():
                self._end(goal, command)

    def _estimate(self, goal: _Goal, command: Estimate) -> None:
        try:
            goal.calibration = calibrate(
                goal.path,
                goal.handle.request.tool,
                goal.tip_m,
                command.measurements,
                goal.warnings,
            )
        except EstimateError as error:
            goal.procedure.fail(error.code, str(error))
        else:
            goal.procedure.on_estimated()

    def _end(self, goal: _Goal, end: Finished) -> None:
        self._goal = None
        # Not here: this may run inside one of the subscriptions' own callbacks.
        self._over.append(goal)
        self._conclude(goal.handle, end, goal.calibration)

    def _publish_feedback(self, goal: _Goal, feedback: Feedback) -> None:
        message = CalibrateTool.Feedback(
            state=int(feedback.state),
            pose=feedback.pose,
            poses=feedback.poses,
            done=feedback.done,
            total=feedback.total,
            roll=feedback.roll,
            tilt=feedback.tilt,
            accepted=feedback.accepted,
            wrench=list(feedback.wrench),
            message=feedback.message,
        )
        goal.handle.publish_feedback(message)
        self.get_logger().debug(feedback.message)

    def _report_status(self) -> Status:
        values: dict[str, object] = {"tools_dir": self._tools_dir, "last": self._last}
        if self._refused:
            values["refused"] = self._refused
        goal = self._goal
        if goal is None:
            level = WARN if self._last_failed else OK
            return Status(level, f"ready; {self._last}", values)
        done, total = goal.procedure.progress
        tool, state = goal.handle.request.tool, goal.procedure.state
        values |= {"tool": tool, "state": state.name, "done": done, "total": total}
        waiting = "; waits for ~/confirm" if goal.procedure.waiting_for_person else ""
        return Status(
            OK, f"calibrating {tool}: {state.name}, {done} of {total} poses{waiting}", values
        )


def _internal(error: Exception) -> Finished:
    return Finished(ErrorCode.INTERNAL, f"{type(error).__name__}: {error}")


def _to_result(tool: str, end: Finished, calibration: Calibration | None) -> CalibrateTool.Result:
    result = CalibrateTool.Result(
        error_code=int(end.error_code),
        error_msg=end.error_msg,
        tool=tool,
        poses_rejected=list(end.rejected),
        warnings=list(end.warnings),
    )
    if calibration is None:
        return result
    result.file = str(calibration.path)
    for name, value in calibration_fields(calibration).items():
        setattr(result, name, value)
    return result


def main() -> None:
    """Run the node until SIGINT or SIGTERM."""
    run(CalibrationNode)


if __name__ == "__main__":
    main()
