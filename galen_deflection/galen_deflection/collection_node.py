"""The action server `collect_pushes`: runs the collection on the arm's topics and records it."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from galen_bags.errors import BagError
from galen_calibration_behavior.arm_link import DISCOVERY_S, ArmPublisher, PublisherWatch
from galen_calibration_behavior.commands import MoveTo, Stop
from galen_calibration_behavior.deferred_action import DeferredActionServer
from galen_model.arm import JOINT_NAMES, SENSOR_FRAME
from galen_model.arrays import Array
from galen_model.errors import GalenError, ToolFileError, ToolNameError
from galen_model.rotation import quaternion_to_matrix
from galen_model.tool_file import ToolFile, read_tool, tool_path
from galen_ros.conversions import JointStateReader, stamp_to_ns, wrench_to_array
from galen_ros.diagnostics import OK, WARN, DiagnosticsPublisher, Status
from galen_ros.parameters import declare_parameters
from galen_ros.qos import STREAM
from galen_ros.spin import run
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from galen_deflection.collection_commands import (
    Command,
    ErrorCode,
    Feedback,
    Finished,
    Push,
    Record,
)
from galen_deflection.collection_folder import CollectionFolder, CollectionFolderError
from galen_deflection.collection_parameters import CollectionParameters
from galen_deflection.collection_plan import (
    CollectionPlan,
    OutOfReachError,
    PlanError,
    make_plan,
)
from galen_deflection.collection_procedure import CollectionProcedure
from galen_deflection.collection_recorder import BagRecording
from galen_deflection.collection_summary import summary
from galen_msgs.action import CollectPushes
from galen_msgs.srv import PushTool

_TICK_S = 0.1
# The publishers of the topics are looked up this often.
_TICKS_PER_GRAPH_CHECK = 10
_RECORDED = ("joint_states", "wrench_raw", "tracker/tool_pose", "tracker/base_pose")
_NORM_TOLERANCE = 1e-3


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
        procedure: CollectionProcedure,
        plan: CollectionPlan,
        tool: ToolFile,
        folder: CollectionFolder,
    ) -> None:
        self.handle = handle
        self.procedure = procedure
        self.plan = plan
        self.tool = tool
        self.folder = folder
        self.recording: BagRecording | None = None
        self.folder_made = False
        self.messages = 0
        self.problems: list[str] = []
        self.reader = JointStateReader(JOINT_NAMES)
        self.subscriptions: list[Subscription] = []
        self.publishers: PublisherWatch | None = None
        self.frames: dict[str, str] = {}
        self.preflight_s: float | None = 0.0
        self.ticks = 0


class CollectionNode(Node):
    """Declares, converts, calls and records; what happens when is in CollectionProcedure."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("collection", **kwargs)
        self._settings = declare_parameters(self, CollectionParameters)
        self._goal: _Goal | None = None
        self._over: list[_Goal] = []
        self._refused = ""
        self._last = "no collection yet"
        self._last_failed = False

        self._arm = ArmPublisher(self)
        self._push_client = self.create_client(PushTool, "push_tool")
        self._server = DeferredActionServer(
            self,
            CollectPushes,
            "collect_pushes",
            on_goal=self._on_goal,
            on_start=self._on_start,
            on_cancel=self._on_cancel,
        )
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._on_tick, clock=self._steady)
        self._diagnostics = DiagnosticsPublisher(self, "galen", self._report_status)

    def destroy_node(self) -> None:
        """Stop the arm if it is at work, close what is recorded, then go."""
        goal, self._goal = self._goal, None
        if goal is not None:
            self.get_logger().warning("shutting down: stopping the arm")
            self._arm.stop_and_wait()
            end = Finished(ErrorCode.CANCELED, "the node was shut down", goal.procedure.collected)
            self._put_away(goal, end)
            goal.handle.abort()
        self._server.destroy()
        super().destroy_node()

    # ---- the action

    def _on_goal(self, request: CollectPushes.Goal) -> GoalResponse:
        """Refuse a second goal; an action's refusal carries no text, so /diagnostics does."""
        if self._goal is None:
            return GoalResponse.ACCEPT
        done, total = self._goal.procedure.progress
        self._refused = (
            f"{request.name!r} refused: collecting {self._goal.handle.request.name!r} now,"
            f" {done} of {total} pushes done; cancel that first, or wait"
        )
        self.get_logger().warning(self._refused)
        self._diagnostics.publish_now()
        return GoalResponse.REJECT

    def _on_start(self, handle: ServerGoalHandle) -> None:
        """Begin; a goal that makes no sense ends at once, for a result can say why."""
        try:
            goal = self._make_goal(handle)
        except _RefusedGoalError as error:
            self._conclude(handle, Finished(error.code, str(error)), 0, 0, "")
            return
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            self._conclude(handle, _internal(error), 0, 0, "")
            return
        self._goal = goal
        self._refused = ""
        subscribe = self.create_subscription
        goal.subscriptions = [
            subscribe(JointState, "joint_states", self._on_joint_state, STREAM),
            subscribe(WrenchStamped, "wrench_compensated", self._on_wrench, STREAM),
            subscribe(PoseStamped, "tracker/tool_pose", self._on_tool_pose, STREAM),
            subscribe(PoseStamped, "tracker/base_pose", self._on_base_pose, STREAM),
        ]
        heard = [subscription.topic_name for subscription in goal.subscriptions]
        goal.publishers = PublisherWatch(self, [*heard, self.resolve_topic_name("wrench_raw")])
        self.get_logger().info(
            f"collecting {handle.request.name!r}: {goal.plan.total} pushes, {goal.folder.final}"
        )
        self._diagnostics.publish_now()

    def _make_goal(self, handle: ServerGoalHandle) -> _Goal:
        request, settings = handle.request, self._settings
        try:
            folder = CollectionFolder(settings.folder("recordings_dir"), request.name)
            path = tool_path(settings.folder("tools_dir"), request.tool)
            tool = read_tool(path)
            if tool.tool != request.tool:
                raise ToolFileError(f"{path}: holds the tool '{tool.tool}', not '{request.tool}'")
            plan = make_plan(
                request.positions or settings.positions,
                request.forces_n or settings.forces_n,
                request.torques_nm or settings.torques_nm,
                request.sets or settings.sets,
                tool.tip_m,
                settings.limits,
            )
        except ToolNameError as error:
            raise _RefusedGoalError(ErrorCode.INVALID_NAME, str(error)) from error
        except CollectionFolderError as error:
            raise _RefusedGoalError(ErrorCode.WRITE_FAILED, str(error)) from error
        except ToolFileError as error:
            raise _RefusedGoalError(ErrorCode.TOOL_FILE, str(error)) from error
        except OutOfReachError as error:
            raise _RefusedGoalError(ErrorCode.OUT_OF_REACH, str(error)) from error
        except PlanError as error:
            raise _RefusedGoalError(ErrorCode.BAD_INPUT, str(error)) from error
        procedure = CollectionProcedure(
            settings.settings(), plan, np.asarray(tool.tip_m, float), request.push_by_service
        )
        return _Goal(handle, procedure, plan, tool, folder)

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        goal = self._goal
        if goal is None or goal.handle.goal_id != handle.goal_id:
            return CancelResponse.REJECT
        self.get_logger().info("canceled: stopping the arm")
        self._feed(goal.procedure.cancel)
        return CancelResponse.ACCEPT

    def _conclude(
        self, handle: ServerGoalHandle, end: Finished, asked: int, messages: int, directory: str
    ) -> None:
        """Give the goal its result and say it on /diagnostics and in the log."""
        collected = end.collected
        result = CollectPushes.Result(
            error_code=int(end.error_code),
            error_msg=end.error_msg,
            directory=directory,
            pushes=collected.pushes,
            pushes_asked=asked,
            left_out=list(collected.left_out),
            calibration_shift=[float(value) for value in collected.shift],
            calibration_holds=collected.holds,
            messages=messages,
            warnings=list(collected.warnings),
        )
        good = end.error_code == ErrorCode.NONE
        self._server.finish(handle, result, success=good)
        name = handle.request.name
        self._last_failed = end.error_code not in (ErrorCode.NONE, ErrorCode.CANCELED)
        if good:
            self._last = f"{name!r} collected: {collected.pushes} of {asked} pushes, {directory}"
        else:
            self._last = f"{name!r} not collected: {end.error_code.name}: {end.error_msg}"
        if self._last_failed:
            self.get_logger().error(self._last)
        else:
            self.get_logger().info(self._last)
        for warning in collected.warnings:
            self.get_logger().warning(warning)
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
                f"wrench_compensated has frame_id {message.header.frame_id!r}, not"
                f" {SENSOR_FRAME!r}",
            )
            return
        self._feed(
            goal.procedure.on_wrench, stamp_to_ns(message.header.stamp), wrench_to_array(message)
        )

    def _on_tool_pose(self, message: PoseStamped) -> None:
        if self._goal is not None:
            self._on_pose("tool_pose", message, self._goal.procedure.on_tool_marker)

    def _on_base_pose(self, message: PoseStamped) -> None:
        if self._goal is not None:
            self._on_pose("base_pose", message, self._goal.procedure.on_base_marker)

    def _on_pose(self, name: str, message: PoseStamped, event: Callable[..., None]) -> None:
        goal = self._goal
        assert goal is not None
        goal.frames[name] = message.header.frame_id
        if len(set(goal.frames.values())) > 1:
            frames = " and ".join(f"tracker/{key} {goal.frames[key]!r}" for key in goal.frames)
            self._feed(
                goal.procedure.fail, ErrorCode.BAD_INPUT, f"both must be in one frame: {frames}"
            )
            return
        position, turn = message.pose.position, message.pose.orientation
        quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
        # A tracker that has lost its marker may send anything instead of a rotation.
        if abs(float(np.linalg.norm(quaternion)) - 1.0) < _NORM_TOLERANCE:
            rotation: Array = quaternion_to_matrix(quaternion)
            translation = np.array([position.x, position.y, position.z])
            self._feed(event, stamp_to_ns(message.header.stamp), rotation, translation)

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
        if self._goal is goal and goal.recording is not None:
            if goal.recording.error:
                self._feed(goal.procedure.fail, ErrorCode.WRITE_FAILED, goal.recording.error)
            elif goal.recording.ready:
                self._feed(goal.procedure.on_recording)
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
                f"nobody publishes {', '.join(silent)}: are the driver, the compensation"
                " (wrench_compensated) and the tracker running?",
            )
        if goal.handle.request.push_by_service and not self._push_client.service_is_ready():
            name = self.resolve_service_name(self._push_client.srv_name)
            return ErrorCode.SERVICE_FAILED, f"nobody offers the service {name}"
        if not self._arm.has_listener:
            return (
                ErrorCode.DRIVER_SILENT,
                f"nobody listens on {self._arm.topic_name}: is the driver running?",
            )
        return None

    def _check_publishers(self, goal: _Goal) -> None:
        """End when a topic has two publishers, or another than before."""
        assert goal.publishers is not None
        if several := goal.publishers.several():
            goal.procedure.fail(ErrorCode.BAD_INPUT, several)
        elif changed := goal.publishers.changed():
            goal.procedure.fail(ErrorCode.DRIVER_SILENT, f"{changed}: it was restarted")

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
            self._end(goal, replace(_internal(error), collected=goal.procedure.collected))

    def _obey(self, goal: _Goal, command: Command) -> None:
        match command:
            case Feedback():
                self._publish_feedback(goal, command)
            case MoveTo():
                self._arm.move(command)
            case Stop():
                self._arm.stop()
            case Push():
                self._push(goal, command)
            case Record():
                self._record(goal, command.bag)
            case Finished():
                self._end(goal, command)

    def _push(self, goal: _Goal, push: Push) -> None:
        future = self._push_client.call_async(
            PushTool.Request(
                force_n=push.wrench[:3],
                torque_nm=push.wrench[3:],
                rise_s=push.rise_s,
                hold_s=push.hold_s,
                fall_s=push.fall_s,
            )
        )

        def on_answer(answered: Any) -> None:
            if self._goal is goal:
                answer = answered.result()
                busy = answer.error_code == PushTool.Response.BUSY
                self._feed(goal.procedure.on_service, answer.success, answer.error_msg, busy)

        future.add_done_callback(on_answer)

    def _record(self, goal: _Goal, bag: str) -> None:
        try:
            if not goal.folder_made:
                goal.folder.make(goal.tool)
                goal.folder_made = True
            path = goal.folder.path / bag
            if goal.recording is None:
                topics = [self.resolve_topic_name(name) for name in _RECORDED]
                goal.recording = BagRecording(self, path, topics)
            else:
                goal.problems += goal.recording.change(path)
        except GalenError as error:
            goal.procedure.fail(ErrorCode.WRITE_FAILED, str(error))

    def _close_recording(self, goal: _Goal) -> None:
        recording, goal.recording = goal.recording, None
        if recording is not None:
            try:
                goal.problems += recording.close()
            finally:
                goal.messages = recording.messages

    # ---- the end

    def _end(self, goal: _Goal, end: Finished) -> None:
        self._goal = None
        # Not here: this may run inside one of the subscriptions' own callbacks.
        self._over.append(goal)
        end, directory = self._put_away(goal, end)
        self._conclude(goal.handle, end, goal.plan.total, goal.messages, directory)

    def _put_away(self, goal: _Goal, end: Finished) -> tuple[Finished, str]:
        """Close the bag and the folder; returns the end that it came to, and where it all is."""
        if not goal.folder_made:
            return end, ""
        try:
            self._close_recording(goal)
        except BagError as error:
            end = _worse(end, str(error))
        collected = end.collected
        end = replace(
            end, collected=replace(collected, warnings=(*collected.warnings, *goal.problems))
        )
        if not goal.messages:
            goal.folder.discard()
            return end, ""
        request = goal.handle.request
        content = summary(
            request.name,
            request.tool,
            goal.plan,
            request.push_by_service,
            end.error_code,
            end.error_msg,
            end.collected,
            goal.messages,
        )
        try:
            goal.folder.close(content, finished=end.error_code == ErrorCode.NONE)
        except CollectionFolderError as error:
            end = _worse(end, str(error))
        return end, str(goal.folder.path)

    def _publish_feedback(self, goal: _Goal, feedback: Feedback) -> None:
        plan = goal.plan
        goal.handle.publish_feedback(
            CollectPushes.Feedback(
                state=int(feedback.state),
                set=feedback.set_number,
                sets=plan.sets,
                position=feedback.position,
                positions=len(plan.positions),
                done=feedback.done,
                total=plan.total,
                wanted=feedback.wanted.tolist(),
                load=feedback.load.tolist(),
                along=feedback.along,
                aside=feedback.aside,
                message=feedback.message,
            )
        )
        self.get_logger().debug(feedback.message)

    def _report_status(self) -> Status:
        values: dict[str, object] = {
            "recordings_dir": self._settings.folder("recordings_dir"),
            "tools_dir": self._settings.folder("tools_dir"),
            "last": self._last,
        }
        if self._refused:
            values["refused"] = self._refused
        goal = self._goal
        if goal is None:
            level = WARN if self._last_failed else OK
            return Status(level, f"ready; {self._last}", values)
        done, total = goal.procedure.progress
        name, state = goal.handle.request.name, goal.procedure.state.name
        recorded = goal.recording.messages if goal.recording else goal.messages
        values |= {"name": name, "state": state, "done": done, "total": total}
        values |= {"directory": goal.folder.path, "messages": recorded}
        return Status(OK, f"collecting {name}: {state}, {done} of {total} pushes", values)


def _internal(error: Exception) -> Finished:
    return Finished(ErrorCode.INTERNAL, f"{type(error).__name__}: {error}")


def _worse(end: Finished, what: str) -> Finished:
    """The end, when its recording can't be put away, too; the first error goes first."""
    if end.error_code == ErrorCode.NONE:
        return replace(end, error_code=ErrorCode.WRITE_FAILED, error_msg=what)
    return replace(end, error_msg=f"{end.error_msg}; {what}")


def main() -> None:
    """Run the node until SIGINT or SIGTERM."""
    run(CollectionNode)


if __name__ == "__main__":
    main()
