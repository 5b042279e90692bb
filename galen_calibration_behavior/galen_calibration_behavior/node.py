"""The action server `calibrate_tool`: runs the procedure on the arm's topics and services."""

from __future__ import annotations

from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, GalenError, NotExcitedError, ToolNameError
from galen_model.files.calibration_file import calibration_path
from galen_model.load.mounting.identification import check_planned_mounting
from galen_ros.goal.arm_link import DriversTools
from galen_ros.goal.commands import (
    AttachTool,
    ErrorCode,
    Estimate,
    Feedback,
    Finished,
    ZeroSensor,
)
from galen_ros.goal.node import GoalNode, RejectedGoalError, RunningGoal, Words
from galen_ros.node.diagnostics import Status
from galen_ros.node.spin import run
from rclpy.action.server import ServerGoalHandle
from rclpy.client import Client
from std_srvs.srv import Trigger

from galen_calibration_behavior.calibration.estimate import (
    Calibration,
    EstimateError,
    MountingRequest,
    TipError,
    calibrate,
    check_writable,
    choose_tip,
)
from galen_calibration_behavior.calibration.parameters import CalibrationParameters
from galen_calibration_behavior.calibration.procedure import CalibrationProcedure, Request
from galen_calibration_behavior.calibration.result_text import calibration_fields
from galen_calibration_behavior.calibration.sweep_parameters import MAX_ITERS
from galen_msgs.action import CalibrateTool
from galen_msgs.srv import SetTool


class _Goal(RunningGoal[CalibrationProcedure]):
    """One running calibration."""

    def __init__(
        self,
        handle: ServerGoalHandle,
        procedure: CalibrationProcedure,
        path: Path,
        tip_m: Array,
        warnings: list[str],
    ) -> None:
        super().__init__(handle, procedure)
        self.path = path
        self.tip_m = tip_m
        self.warnings = warnings
        self.calibration: Calibration | None = None
        self.asking: DriversTools | None = None


class CalibrationNode(GoalNode[CalibrationParameters, _Goal, Finished]):
    """Declares, converts and calls; what happens when is in CalibrationProcedure."""

    codes = ErrorCode
    words = Words(
        subject="tool",
        doing="calibrating",
        nothing_yet="no calibration yet",
        unit="poses",
        restarted="the driver was restarted, and the sensor's zero is lost",
        shutting_down="shutting down: stopping the arm, nothing is written",
    )

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            "calibration", CalibrationParameters, CalibrateTool, "calibrate_tool", **kwargs
        )
        self._tools_dir = Path(self._settings.tools_dir).expanduser()
        self._duration = _duration(self._settings)
        self._bias_client = self.create_client(Trigger, "zero_ft_sensor")
        self._attach_client = self.create_client(SetTool, "attach_tool")
        self.create_service(Trigger, "~/confirm", self._on_confirm)

    # ---- the action

    def _make_goal(self, handle: ServerGoalHandle) -> _Goal:
        request = handle.request
        for name, count in (("iters_t", request.iters_t), ("iters_r", request.iters_r)):
            if count > MAX_ITERS:
                raise RejectedGoalError(
                    ErrorCode.BAD_INPUT, f"{name} is {count}: at most {MAX_ITERS}, or 0"
                )
            if count and self._settings.poses != "grid":
                raise RejectedGoalError(
                    ErrorCode.BAD_INPUT,
                    f"{name} is {count}, but the node's poses are {self._settings.poses} ones",
                )
        try:
            path = calibration_path(self._tools_dir, request.tool)
            tip_m, warnings = choose_tip(np.array(request.tip_m, float), path)
            if warnings and self._settings.obstacles:
                raise TipError(f"{warnings[0]}, so that nobody knows what the tool would hit")
            plan = self._settings.plan(
                tip_m, one_sweep=request.one_sweep, tilts=request.iters_t, rolls=request.iters_r
            )
            if self._settings.estimate:
                check_planned_mounting(
                    plan.poses[:, 0],
                    plan.poses[:, 1],
                    self._settings.estimate,
                    one_sweep=request.one_sweep,
                    zero_roll_rad=self._settings.Rhome,
                    zero_tilt_rad=self._settings.Thome,
                )
            check_writable(path)
        except ToolNameError as error:
            raise RejectedGoalError(ErrorCode.INVALID_NAME, str(error)) from error
        except CalibrationFileError as error:
            raise RejectedGoalError(ErrorCode.WRITE_FAILED, str(error)) from error
        except NotExcitedError as error:
            raise RejectedGoalError(ErrorCode.NOT_EXCITED, str(error)) from error
        except GalenError as error:
            raise RejectedGoalError(ErrorCode.BAD_INPUT, str(error)) from error
        procedure = CalibrationProcedure(
            self._settings.settings(),
            Request(
                request.tool,
                request.one_sweep,
                request.attach_by_service,
                plan.poses,
                plan.router,
                self._settings.wanted,
            ),
        )
        return _Goal(handle, procedure, path, tip_m, warnings)

    def _introduce(self, goal: _Goal) -> str:
        return f"{goal.procedure.progress[1]} poses, file {goal.path}"

    def _make_end(self, code: IntEnum, message: str, goal: _Goal | None) -> Finished:
        return Finished(ErrorCode(code), message)

    def _make_result(
        self, handle: ServerGoalHandle, end: Finished, goal: _Goal | None
    ) -> tuple[CalibrateTool.Result, str]:
        tool, shown = handle.request.tool, self._named(handle.request)
        calibration = None if goal is None else goal.calibration
        last = f"{shown} not calibrated: {end.error_code.name}: {end.error_msg}"
        if calibration is not None:
            last = f"{shown} calibrated: {calibration.path}"
        return _to_result(tool, end, calibration), last

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

    # ---- commands

    def _needed_clients(self, goal: _Goal) -> list[Client]:
        by_service = goal.handle.request.attach_by_service
        return [self._bias_client, self._attach_client] if by_service else [self._bias_client]

    def _find_missing(self, goal: _Goal) -> tuple[IntEnum, str] | None:
        """Beside what each goal needs: a driver that changes tools has to know this one."""
        missing = super()._find_missing(goal)
        request = goal.handle.request
        if missing is not None or not request.attach_by_service:
            return missing
        if goal.asking is None:
            goal.asking = DriversTools(self, self._attach_client)
            goal.preflight_s = 0.0  # what it needs is there; this waits by its own clock
        if not goal.asking.is_over():
            return ErrorCode.SERVICE_FAILED, f"{goal.asking.driver} does not answer"
        known = goal.asking.tools
        if known is not None and request.tool not in known:
            goal.procedure.fail(
                ErrorCode.SERVICE_FAILED,
                f"attach_tool can't put {request.tool!r} on: {goal.asking.driver} knows"
                f" {', '.join(known) or 'no tool'} (its parameter 'tools'); correct the name, or"
                " calibrate by hand",
            )
        return None

    def _obey(self, goal: _Goal, command: Any) -> None:
        on_service = goal.procedure.on_service
        match command:
            case Feedback():
                self._publish_feedback(goal, command)
            case ZeroSensor():
                self._call(
                    goal,
                    self._bias_client,
                    Trigger.Request(),
                    lambda answer: self._feed(on_service, answer.success, answer.message),
                )
            case AttachTool():
                self._call(
                    goal,
                    self._attach_client,
                    SetTool.Request(tool=command.tool),
                    lambda answer: self._feed(on_service, answer.success, answer.error_msg),
                )
            case Estimate():
                self._estimate(goal, command)
            case _:
                super()._obey(goal, command)

    def _estimate(self, goal: _Goal, command: Estimate) -> None:
        try:
            goal.calibration = calibrate(
                goal.path,
                goal.handle.request.tool,
                goal.tip_m,
                command.measurements,
                goal.warnings,
                mounting=MountingRequest(self._settings.estimate)
                if self._settings.estimate
                else None,
            )
        except EstimateError as error:
            goal.procedure.fail(error.code, str(error))
        else:
            goal.procedure.on_estimated()

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

    # ---- diagnostics

    def _folders(self) -> dict[str, object]:
        return {"tools_dir": self._tools_dir}

    def _report_status(self) -> Status:
        status = super()._report_status()
        return replace(status, values=self._duration | dict(status.values))

    def _status_values(self, goal: _Goal) -> dict[str, object]:
        return {"waits_for_person": goal.procedure.waiting_for_person}

    def _status_remark(self, goal: _Goal) -> str:
        return "; waits for ~/confirm" if goal.procedure.waiting_for_person else ""


def _duration(settings: CalibrationParameters) -> dict[str, object]:
    """How long a sweep takes, for /diagnostics; a goal says why its poses can't be."""
    try:
        return {"sweep_s": settings.sweep_s()}
    except GalenError:
        return {}


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
