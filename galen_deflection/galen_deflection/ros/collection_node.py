# SPDX-License-Identifier: Apache-2.0
"""`collection_node`: runs the action `collect_pushes` on the arm's topics and records it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from typing import Any

import numpy as np
from galen_bags.formats.errors import BagError
from galen_common.goal.procedure import End
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files.calibration_file import CalibrationFile, calibration_path, read_calibration
from galen_model.json_fields import numbers
from galen_model.rotation import quaternion_to_matrix
from galen_ros.goal.node import ArmAction, GoalNode, RejectedGoalError, RunningGoal, named
from galen_ros.messages import STREAM, stamp_to_ns
from galen_ros.node.spin import run
from geometry_msgs.msg import PoseStamped
from rclpy.action.server import ServerGoalHandle
from rclpy.client import Client
from rclpy.subscription import Subscription

from galen_deflection.collection.plan import (
    CollectionParameters,
    CollectionPlan,
    ErrorCode,
    Feedback,
    Finished,
    OutOfReachError,
    PlanError,
    Push,
    Record,
    make_plan,
)
from galen_deflection.collection.procedure import CollectionProcedure
from galen_deflection.measurement.samples import DeflectionError
from galen_deflection.ros.recorder import (
    BagRecording,
    CollectionFolder,
)
from galen_msgs.action import CollectPushes
from galen_msgs.srv import PushTool

_RECORDED = ("joint_states", "wrench_raw", "tracker/tool_pose", "tracker/base_pose")
_NORM_TOLERANCE = 1e-3

SCHEMA_VERSION = 1


class _Goal(RunningGoal):
    """One running collection; `directory`: where it was put, once that is done."""

    def __init__(
        self,
        action: ArmAction,
        handle: ServerGoalHandle,
        procedure: CollectionProcedure,
        tool: CalibrationFile,
        folder: CollectionFolder,
    ) -> None:
        super().__init__(action, handle, procedure)
        self.tool = tool
        self.folder = folder
        self.recording: BagRecording | None = None
        self.folder_made = False
        self.directory = ""
        self.messages = 0
        self.problems: list[str] = []
        self.frames: dict[str, str] = {}


class CollectAction(ArmAction):
    """Declares, converts, calls and records; what happens when is in CollectionProcedure."""

    action_type = CollectPushes
    name = "collect_pushes"
    codes = ErrorCode
    subject = "name"
    doing = "collecting"
    unit = "pushes"
    restarted = "it was restarted"

    def __init__(self, node: GoalNode) -> None:
        super().__init__(node)
        self._push_client = node.create_client(PushTool, "push_tool")

    # ---- the action

    def make_goal(self, handle: ServerGoalHandle) -> _Goal:
        """Return the goal to run.

        Args:
            handle: the accepted goal.

        Returns:
            The goal, with its plan checked and nothing written yet.

        Raises:
            RejectedGoalError: the name, the tool's file or the plan can't be used, or the folder
                exists.

        """
        request, settings = handle.request, self.node.settings
        try:
            folder = CollectionFolder(settings.folder("recordings_dir"), request.name)
            path = calibration_path(settings.folder("tools_dir"), request.tool)
            tool = read_calibration(path, self.node.arm)
            if tool.tool != request.tool:
                raise CalibrationFileError(
                    f"{path}: holds the tool '{tool.tool}', not '{request.tool}'"
                )
            asked = {
                name: tuple(getattr(request, name)) or getattr(settings, name)
                for name in ("positions", "forces_n", "torques_nm")
            }
            wanted = replace(settings, **asked, sets=request.sets or settings.sets)
            plan = make_plan(wanted, np.asarray(tool.tip_m, float))
        except ToolNameError as error:
            raise RejectedGoalError(ErrorCode.INVALID_NAME, str(error)) from error
        except DeflectionError as error:
            raise RejectedGoalError(ErrorCode.WRITE_FAILED, str(error)) from error
        except CalibrationFileError as error:
            raise RejectedGoalError(ErrorCode.TOOL_FILE, str(error)) from error
        except OutOfReachError as error:
            raise RejectedGoalError(ErrorCode.OUT_OF_REACH, str(error)) from error
        except PlanError as error:
            raise RejectedGoalError(ErrorCode.BAD_INPUT, str(error)) from error
        procedure = CollectionProcedure(
            settings, plan, np.asarray(tool.tip_m, float), request.push_by_service
        )
        return _Goal(self, handle, procedure, tool, folder)

    def introduce(self, goal: _Goal) -> str:
        """Describe in the log what begins.

        Args:
            goal: the running goal.

        Returns:
            Number of pushes and folder.

        """
        return f"{goal.procedure.plan.total} pushes, {goal.folder.final}"

    def make_end(self, code: IntEnum, message: str, goal: _Goal | None) -> End:
        """Return an end that the procedure doesn't know of.

        Args:
            code: one of `ErrorCode`.
            message: the error in words.
            goal: the running goal; None: it never began.

        Returns:
            The end, with what has come of the goal so far.

        """
        if goal is None:
            return Finished(ErrorCode(code), message)
        return goal.procedure.finish(code, message)

    def make_result(
        self, handle: ServerGoalHandle, end: Finished, goal: _Goal | None
    ) -> tuple[CollectPushes.Result, str]:
        """Return the action's result; warnings go to the log.

        Args:
            handle: the goal.
            end: the end that it came to.
            goal: the running goal; None: it never began.

        Returns:
            The result, and a sentence for /diagnostics.

        """
        for warning in end.warnings:
            self.node.get_logger().warning(warning)
        result = CollectPushes.Result(
            error_code=int(end.error_code),
            error_msg=end.error_msg,
            directory=goal.directory if goal else "",
            pushes=end.pushes,
            pushes_asked=goal.procedure.plan.total if goal else 0,
            left_out=list(end.left_out),
            calibration_shift=[float(value) for value in end.shift],
            calibration_holds=end.holds,
            messages=goal.messages if goal else 0,
            warnings=list(end.warnings),
        )
        name = named(handle.request.name)
        last = f"{name} not collected: {end.error_code.name}: {end.error_msg}"
        if end.error_code == ErrorCode.NONE:
            last = (
                f"{name} collected: {end.pushes} of {result.pushes_asked} pushes,"
                f" {result.directory}"
            )
        return result, last

    # ---- inputs

    def subscribe(self, goal: _Goal) -> list[Subscription]:
        """Subscribe to the tracker, too.

        Args:
            goal: the running goal.

        Returns:
            Subscriptions of joints, compensated wrench and both markers.

        """
        subscribe = self.node.create_subscription
        return [
            *super().subscribe(goal),
            subscribe(PoseStamped, "tracker/tool_pose", self._on_tool_pose, STREAM),
            subscribe(PoseStamped, "tracker/base_pose", self._on_base_pose, STREAM),
        ]

    def also_watched(self) -> list[str]:
        """Name the raw wrench, which is only recorded."""
        return [self.node.resolve_topic_name("wrench_raw")]

    def needed_clients(self, goal: _Goal) -> list[Client]:
        """Return that of `push_tool`, where it pushes.

        Args:
            goal: the running goal.

        Returns:
            Clients that must find their service before the goal begins.

        """
        return [self._push_client] if goal.handle.request.push_by_service else []

    def silent_text(self, topics: list[str]) -> str:
        """Return what is wrong where topics have no publisher.

        Args:
            topics: names of these topics.

        Returns:
            A sentence with the remedy.

        """
        return (
            f"no publisher on {', '.join(topics)}: are the driver, the compensation"
            " (wrench_compensated) and the tracker running?"
        )

    def _on_tool_pose(self, message: PoseStamped) -> None:
        if self.node.goal is not None:
            self._on_pose("tool_pose", message, self.node.goal.procedure.on_tool_marker)

    def _on_base_pose(self, message: PoseStamped) -> None:
        if self.node.goal is not None:
            self._on_pose("base_pose", message, self.node.goal.procedure.on_base_marker)

    def _on_pose(self, name: str, message: PoseStamped, event: Callable[..., None]) -> None:
        goal = self.node.goal
        assert isinstance(goal, _Goal)
        goal.frames[name] = message.header.frame_id
        if len(set(goal.frames.values())) > 1:
            frames = " and ".join(f"tracker/{key} {goal.frames[key]!r}" for key in goal.frames)
            self.node.feed(
                goal.procedure.fail, ErrorCode.BAD_INPUT, f"both must be in one frame: {frames}"
            )
            return
        position, turn = message.pose.position, message.pose.orientation
        quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
        # A tracker that has lost its marker may send anything instead of a rotation.
        if abs(float(np.linalg.norm(quaternion)) - 1.0) < _NORM_TOLERANCE:
            rotation: Array = quaternion_to_matrix(quaternion)
            translation = np.array([position.x, position.y, position.z])
            self.node.feed(event, stamp_to_ns(message.header.stamp), rotation, translation)

    def look_after(self, goal: _Goal) -> None:
        """Look whether the recording goes on.

        Args:
            goal: the running goal.

        """
        if goal.recording is None:
            return
        if goal.recording.error:
            goal.procedure.fail(ErrorCode.WRITE_FAILED, goal.recording.error)
        elif goal.recording.ready:
            goal.procedure.on_recording()

    # ---- commands

    def obey(self, goal: _Goal, command: Any) -> None:
        """Give feedback, push, record.

        Args:
            goal: the running goal.
            command: a `Feedback`, `Push` or `Record`.

        """
        match command:
            case Feedback():
                self._publish_feedback(goal, command)
            case Push():
                self._push(goal, command)
            case Record():
                self._record(goal, command.bag)

    def _push(self, goal: _Goal, push: Push) -> None:
        def on_answer(answer: Any) -> None:
            busy = answer.error_code == PushTool.Response.BUSY
            self.node.feed(goal.procedure.on_service, answer.success, answer.error_msg, busy)

        request = PushTool.Request(
            force_n=push.wrench[:3],
            torque_nm=push.wrench[3:],
            rise_s=push.rise_s,
            hold_s=push.hold_s,
            fall_s=push.fall_s,
        )
        self.node.call(goal, self._push_client, request, on_answer)

    def _record(self, goal: _Goal, bag: str) -> None:
        try:
            if not goal.folder_made:
                goal.folder.make(goal.tool)
                goal.folder_made = True
            path = goal.folder.path / bag
            if goal.recording is None:
                topics = [self.node.resolve_topic_name(name) for name in _RECORDED]
                goal.recording = BagRecording(self.node, path, topics)
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

    def put_away(self, goal: _Goal, end: Finished) -> Finished:
        """Close the bag and the folder.

        Args:
            goal: the running goal.
            end: the procedure's end.

        Returns:
            The end that it came to, with the recording's problems among its warnings.

        """
        if not goal.folder_made:
            return end
        try:
            self._close_recording(goal)
        except BagError as error:
            end = _worse(end, str(error))
        end = replace(end, warnings=(*end.warnings, *goal.problems))
        if not goal.messages:
            goal.folder.discard()
            return end
        request = goal.handle.request
        content = summary(request, goal.procedure.plan, end, goal.messages)
        try:
            goal.folder.close(content, finished=end.error_code == ErrorCode.NONE)
        except DeflectionError as error:
            end = _worse(end, str(error))
        goal.directory = str(goal.folder.path)
        return end

    def _publish_feedback(self, goal: _Goal, feedback: Feedback) -> None:
        plan = goal.procedure.plan
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
        self.node.get_logger().debug(feedback.message)

    # ---- diagnostics

    def status_values(self, goal: _Goal) -> dict[str, object]:
        """Return what is recorded, and where.

        Args:
            goal: the running goal.

        Returns:
            Values by key for /diagnostics.

        """
        recorded = goal.recording.messages if goal.recording else goal.messages
        return {
            "tool": goal.tool.tool,
            "directory": goal.folder.path,
            "messages": recorded,
        }


def summary(
    request: CollectPushes.Goal, plan: CollectionPlan, end: Finished, messages: int
) -> dict[str, Any]:
    """Make the content of `collection.json`; SI units, lengths m, angles rad, loads N and N.m.

    Args:
        request: what the goal asked for.
        plan: the plan with the positions that the arm went to.
        end: what came of it.
        messages: number of messages recorded, in all bags.

    Returns:
        Content for JSON.

    """
    shift = end.shift
    return {
        "schema_version": SCHEMA_VERSION,
        "name": request.name,
        "tool": request.tool,
        "finished": end.error_code == ErrorCode.NONE,
        "error": {"code": end.error_code.name, "message": end.error_msg},
        "asked": {
            "sets": plan.sets,
            "positions": [numbers(row) for row in plan.positions],
            "pushes": [numbers(push.wrench) for push in plan.pushes],
            "push_by_service": request.push_by_service,
        },
        "pushes": end.pushes,
        "pushes_asked": plan.total,
        "left_out": list(end.left_out),
        "calibration": {
            "shift": numbers(shift) if np.all(np.isfinite(shift)) else None,
            "holds": end.holds,
        },
        "messages": messages,
        "warnings": list(end.warnings),
    }


def _worse(end: Finished, what: str) -> Finished:
    """Return the end with another error; the first error goes first."""
    if end.error_code == ErrorCode.NONE:
        return replace(end, error_code=ErrorCode.WRITE_FAILED, error_msg=what)
    return replace(end, error_msg=f"{end.error_msg}; {what}")


class CollectionNode(GoalNode):
    """The action server `collect_pushes`."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("collection", CollectionParameters, (CollectAction,), **kwargs)

    def _set_up(self) -> None:
        for name in ("recordings_dir", "tools_dir"):
            self.status_values[name] = self.settings.folder(name)


def main() -> None:
    """Run the node until SIGINT or SIGTERM."""
    run(CollectionNode)


if __name__ == "__main__":
    main()
