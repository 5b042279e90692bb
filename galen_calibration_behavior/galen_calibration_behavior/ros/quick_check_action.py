# SPDX-License-Identifier: Apache-2.0
"""The action `check_tool`: the quick check on the arm's topics."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from galen_common.goal.procedure import End
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files.calibration_store import CalibrationStore
from galen_ros.goal.node import ArmAction, GoalNode, RejectedGoalError, RunningGoal, named
from galen_ros.messages import LATCHED
from rclpy.action.server import ServerGoalHandle

from galen_calibration_behavior.common.check_decision import FEWEST_POSES, centre_change
from galen_calibration_behavior.common.commands import CheckCode, PoseFeedback, PosesEnd
from galen_calibration_behavior.common.parameters import MOST_CHECK_POSES
from galen_calibration_behavior.quick_check.procedure import CheckProcedure
from galen_msgs.action import CheckTool
from galen_msgs.msg import ActiveTool


class CheckAction(ArmAction):
    """Declares, converts and calls; what happens when is in CheckProcedure."""

    action_type = CheckTool
    name = "check_tool"
    codes = CheckCode
    doing = "checking"
    unit = "poses"
    restarted = "the driver was restarted"

    def __init__(self, node: GoalNode) -> None:
        super().__init__(node)
        self._store = CalibrationStore(Path(node.settings.tools_dir).expanduser(), node.arm)
        self._active: ActiveTool | None = None
        node.create_subscription(ActiveTool, "gravcomp/active_tool", self._on_active_tool, LATCHED)

    def _on_active_tool(self, message: ActiveTool) -> None:
        self._active = message

    # ---- the action

    def subject_of(self, request: Any) -> str:
        """Return the tool's name; without one that of the active tool.

        Args:
            request: a CheckTool.Goal.

        Returns:
            The name; empty where gravcomp has no tool, or none runs.

        """
        if request.tool or self._active is None:
            return str(request.tool)
        return str(self._active.tool)

    def rejection(self, request: Any) -> str:
        """Return why there is no tool to check.

        Args:
            request: a CheckTool.Goal.

        Returns:
            The reason with its remedy; empty where there is a tool.

        """
        if not self.node.count_publishers("gravcomp/active_tool"):
            self._active = None  # a node that is gone subtracts nothing
        if self.subject_of(request):
            return ""
        why = "no gravcomp_node is running" if self._active is None else "gravcomp has none"
        return f"the goal names no tool, and {why}: name the tool that is on, as in 'check pointer'"

    def make_goal(self, handle: ServerGoalHandle) -> RunningGoal:
        """Make the goal to run.

        Args:
            handle: the goal's, with its request.

        Returns:
            The goal, whose procedure has not begun.

        Raises:
            RejectedGoalError: the number of poses is wrong, or the tool's file can't be read.

        """
        name, poses = self.subject_of(handle.request), handle.request.poses
        settings = self.node.settings
        if poses and not FEWEST_POSES <= poses <= MOST_CHECK_POSES:
            raise RejectedGoalError(
                CheckCode.BAD_INPUT,
                f"poses is {poses}: from {FEWEST_POSES} to {MOST_CHECK_POSES}, or 0",
            )
        try:
            tool = self._store.read(name).tool
            others = {
                entry.name: entry.stored.tool
                for entry in self._store.entries()
                if entry.stored is not None and entry.name != name
            }
        except ToolNameError as error:
            raise RejectedGoalError(CheckCode.INVALID_NAME, str(error)) from error
        except CalibrationFileError as error:
            raise RejectedGoalError(CheckCode.TOOL_FILE, str(error)) from error
        except GalenError as error:
            raise RejectedGoalError(CheckCode.BAD_INPUT, str(error)) from error
        known_offset = self._known_offset(name)
        warnings = []
        if known_offset is not None:
            warnings.append(
                "what gravcomp's tare, or its estimate of the bias drift, subtracts counts"
            )
        procedure = CheckProcedure(
            settings, tool, poses or settings.check_poses, others, known_offset
        )
        return RunningGoal(self, handle, procedure, warnings)

    def _known_offset(self, tool: str) -> Array | None:
        """Return what gravcomp subtracts beside the file (6,), N and N.m; None for nothing."""
        now = self._active
        if now is None or now.tool != tool or not (now.tared or now.bias_drift_estimated):
            return None
        taken_off = np.zeros(6)
        for on, wrench in ((now.tared, now.tare), (now.bias_drift_estimated, now.bias_drift)):
            if on:
                force, torque = wrench.force, wrench.torque
                taken_off += [force.x, force.y, force.z, torque.x, torque.y, torque.z]
        return taken_off

    def introduce(self, goal: RunningGoal) -> str:
        """Describe in the log what begins.

        Args:
            goal: the goal that begins.

        Returns:
            Number of poses.

        """
        return f"{goal.procedure.progress[1]} poses"

    def make_end(self, code: IntEnum, message: str, goal: RunningGoal | None) -> End:
        """Return an end that the procedure doesn't know of.

        Args:
            code: one of CheckCode.
            message: the reason.
            goal: the goal that ends; None: it was rejected.

        Returns:
            The end, without poses and warnings.

        """
        return PosesEnd(CheckCode(code), message)

    def make_result(
        self, handle: ServerGoalHandle, end: PosesEnd, goal: RunningGoal | None
    ) -> tuple[CheckTool.Result, str]:
        """Return the action's result, and a sentence for /diagnostics.

        Args:
            handle: the goal's, with its request.
            end: the procedure's, or of `make_end`.
            goal: the goal that ended; None: it was rejected.

        Returns:
            The result, with what the check found where it came to an end; and the sentence.

        """
        name = self.subject_of(handle.request)
        shown = named(name)
        result = CheckTool.Result(
            error_code=int(end.error_code),
            error_msg=end.error_msg,
            tool=name,
            poses_rejected=list(end.rejected),
            warnings=[*(goal.warnings if goal else []), *end.warnings],
        )
        if end.check is None or goal is None:
            return result, f"{shown} not checked: {end.error_code.name}: {end.error_msg}"
        check, found = end.check, end.check.found
        result.answer, result.cause, result.text = int(check.answer), int(check.cause), check.text
        result.mass_change_kg = float(found.moments[0])
        result.mass_change_std_kg = float(np.sqrt(found.moments_covariance[0, 0]))
        nowhere = np.full(3, np.nan)
        moved = centre_change(found, goal.procedure.tool)
        result.com_change_m, result.com_change_std_m = moved or (nowhere, nowhere)
        result.offset, result.offset_std = found.offset, found.offset_std
        result.unexplained = np.sqrt(np.mean(found.rest**2, axis=0))
        result.effect = found.effect
        result.found_mass_kg, result.found_offset = check.found_mass_kg, check.found_offset
        result.poses_used = check.poses
        return result, f"{shown} checked: {check.answer.name}: {check.text}"

    # ---- commands

    def obey(self, goal: RunningGoal, command: Any) -> None:
        """Give feedback.

        Args:
            goal: the goal that runs.
            command: what its procedure asks for; all but feedback is ignored.

        """
        if not isinstance(command, PoseFeedback):
            return
        goal.handle.publish_feedback(
            CheckTool.Feedback(
                state=int(command.state),
                done=command.done,
                total=command.total,
                angles=command.angles,
                accepted=command.accepted,
                message=command.message,
            )
        )
        self.node.get_logger().debug(command.message)
