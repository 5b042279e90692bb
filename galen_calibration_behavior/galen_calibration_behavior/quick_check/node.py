"""The action server `check_tool`: runs the quick check on the arm's topics."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files.calibration_store import CalibrationStore
from galen_ros.goal.node import GoalNode, RejectedGoalError, RunningGoal, Words
from galen_ros.node.spin import run
from galen_ros.qos import LATCHED
from rclpy.action.server import ServerGoalHandle

from galen_calibration_behavior.quick_check.commands import ErrorCode, Feedback, Finished
from galen_calibration_behavior.quick_check.decision import FEWEST_POSES
from galen_calibration_behavior.quick_check.parameters import MOST_POSES, CheckParameters
from galen_calibration_behavior.quick_check.procedure import CheckProcedure, CheckRequest
from galen_calibration_behavior.quick_check.text import centre_change
from galen_msgs.action import CheckTool
from galen_msgs.msg import ActiveTool


class _Goal(RunningGoal[CheckProcedure]):
    """One running check; `warnings`: known from before it began."""

    def __init__(
        self, handle: ServerGoalHandle, procedure: CheckProcedure, warnings: list[str]
    ) -> None:
        super().__init__(handle, procedure)
        self.warnings = warnings


class CheckNode(GoalNode[CheckParameters, _Goal, Finished]):
    """Declares, converts and calls; what happens when is in CheckProcedure."""

    codes = ErrorCode
    words = Words(
        subject="tool",
        doing="checking",
        nothing_yet="no check yet",
        unit="poses",
        restarted="the driver was restarted",
        shutting_down="shutting down: stopping the arm",
    )

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("check", CheckParameters, CheckTool, "check_tool", **kwargs)
        self._store = CalibrationStore(Path(self._settings.tools_dir).expanduser())
        self._active: ActiveTool | None = None
        self.create_subscription(ActiveTool, "gravcomp/active_tool", self._on_active_tool, LATCHED)

    def _on_active_tool(self, message: ActiveTool) -> None:
        self._active = message

    # ---- the action

    def _subject(self, request: Any) -> str:
        if request.tool or self._active is None:
            return str(request.tool)
        return str(self._active.tool)

    def _rejection(self, request: Any) -> str:
        if not self.count_publishers("gravcomp/active_tool"):
            self._active = None  # a node that is gone subtracts nothing
        if self._subject(request):
            return ""
        why = "no gravcomp_node is running" if self._active is None else "gravcomp has none"
        return f"the goal names no tool, and {why}: name the tool that is on, as in 'check pointer'"

    def _make_goal(self, handle: ServerGoalHandle) -> _Goal:
        name, poses = self._subject(handle.request), handle.request.poses
        if poses and not FEWEST_POSES <= poses <= MOST_POSES:
            raise RejectedGoalError(
                ErrorCode.BAD_INPUT,
                f"poses is {poses}: from {FEWEST_POSES} to {MOST_POSES}, or 0",
            )
        try:
            tool = self._store.read(name).tool
            others = {
                entry.name: entry.stored.tool
                for entry in self._store.entries()
                if entry.stored is not None and entry.name != name
            }
        except ToolNameError as error:
            raise RejectedGoalError(ErrorCode.INVALID_NAME, str(error)) from error
        except CalibrationFileError as error:
            raise RejectedGoalError(ErrorCode.TOOL_FILE, str(error)) from error
        except GalenError as error:
            raise RejectedGoalError(ErrorCode.BAD_INPUT, str(error)) from error
        known_offset = self._known_offset(name)
        warnings = []
        if known_offset is not None:
            warnings.append(
                "what gravcomp's tare, or its estimate of the bias drift, takes off counts"
            )
        request = CheckRequest(tool, poses or self._settings.poses, others, known_offset)
        procedure = CheckProcedure(self._settings.settings(), request)
        return _Goal(handle, procedure, warnings)

    def _known_offset(self, tool: str) -> Array | None:
        """What the compensation takes off beside the file (6,), N and N.m; None for nothing."""
        now = self._active
        if now is None or now.tool != tool or not (now.tared or now.bias_drift_estimated):
            return None
        taken_off = np.zeros(6)
        for on, wrench in ((now.tared, now.tare), (now.bias_drift_estimated, now.bias_drift)):
            if on:
                force, torque = wrench.force, wrench.torque
                taken_off += [force.x, force.y, force.z, torque.x, torque.y, torque.z]
        return taken_off

    def _introduce(self, goal: _Goal) -> str:
        return f"{goal.procedure.progress[1]} poses"

    def _make_end(self, code: IntEnum, message: str, goal: _Goal | None) -> Finished:
        return Finished(ErrorCode(code), message)

    def _make_result(
        self, handle: ServerGoalHandle, end: Finished, goal: _Goal | None
    ) -> tuple[CheckTool.Result, str]:
        name, shown = self._subject(handle.request), self._named(handle.request)
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

    def _obey(self, goal: _Goal, command: Any) -> None:
        match command:
            case Feedback():
                goal.handle.publish_feedback(
                    CheckTool.Feedback(
                        state=int(command.state),
                        done=command.done,
                        total=command.total,
                        roll=command.roll,
                        tilt=command.tilt,
                        accepted=command.accepted,
                        message=command.message,
                    )
                )
                self.get_logger().debug(command.message)
            case _:
                super()._obey(goal, command)

    # ---- diagnostics

    def _folders(self) -> dict[str, object]:
        return {"tools_dir": self._store.directory}


def main() -> None:
    """Run the node until SIGINT or SIGTERM."""
    run(CheckNode)


if __name__ == "__main__":
    main()
