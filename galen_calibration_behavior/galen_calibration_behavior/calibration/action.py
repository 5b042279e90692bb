"""The action `calibrate_tool`: the procedure on the arm's topics and services."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, GalenError, NotExcitedError, ToolNameError
from galen_model.files.calibration_file import calibration_path
from galen_model.load.mounting.identification import check_planned_mounting
from galen_ros.goal.node import ArmAction, GoalNode, RejectedGoalError, RunningGoal, named
from galen_ros.goal.procedure import End
from rclpy.action.server import ServerGoalHandle
from rclpy.client import Client
from std_srvs.srv import Trigger

from galen_calibration_behavior.calibration.estimate import (
    Calibration,
    EstimateError,
    MountingRequest,
    calibration_fields,
    check_writable,
    choose_tip,
    estimate,
)
from galen_calibration_behavior.calibration.procedure import (
    CalibrationProcedure,
    CalibrationRequest,
)
from galen_calibration_behavior.commands import (
    AttachTool,
    CalibrationCode,
    Measurements,
    PoseFeedback,
    PosesEnd,
    ZeroSensor,
)
from galen_calibration_behavior.parameters import MAX_ITERS
from galen_msgs.action import CalibrateTool
from galen_msgs.srv import SetTool


class _Goal(RunningGoal):
    """One running calibration; `warnings`: known from before it began."""

    def __init__(
        self,
        action: ArmAction,
        handle: ServerGoalHandle,
        procedure: CalibrationProcedure,
        path: Path,
        tip_m: Array,
        warnings: list[str],
    ) -> None:
        super().__init__(action, handle, procedure)
        self.path = path
        self.tip_m = tip_m
        self.warnings = warnings
        self.calibration: Calibration | None = None


class CalibrateAction(ArmAction):
    """Declares, converts and calls; what happens when is in CalibrationProcedure."""

    action_type = CalibrateTool
    name = "calibrate_tool"
    codes = CalibrationCode
    doing = "calibrating"
    unit = "poses"
    restarted = "the driver was restarted, and the sensor's zero is lost"

    def __init__(self, node: GoalNode) -> None:
        super().__init__(node)
        self._zero_client = node.create_client(Trigger, "zero_ft_sensor")
        self._attach_client = node.create_client(SetTool, "attach_tool")
        node.create_service(Trigger, "~/confirm", self._on_confirm)

    def make_goal(self, handle: ServerGoalHandle) -> _Goal:
        """Return the goal to run; raises RejectedGoalError."""
        request, settings = handle.request, self.node.settings
        for name, count in (("iters_t", request.iters_t), ("iters_r", request.iters_r)):
            if count > MAX_ITERS:
                raise RejectedGoalError(
                    CalibrationCode.BAD_INPUT, f"{name} is {count}: at most {MAX_ITERS}, or 0"
                )
            if count and settings.poses != "grid":
                raise RejectedGoalError(
                    CalibrationCode.BAD_INPUT,
                    f"{name} is {count}, but the node's poses are {settings.poses} ones",
                )
        try:
            path = calibration_path(Path(settings.tools_dir).expanduser(), request.tool)
            tip_m, warnings = choose_tip(np.array(request.tip_m, float), path)
            if warnings and settings.obstacles:
                raise GalenError(f"{warnings[0]}, so that it is not known what the tool would hit")
            plan = settings.plan(
                tip_m, one_sweep=request.one_sweep, tilts=request.iters_t, rolls=request.iters_r
            )
            if settings.estimate:
                check_planned_mounting(
                    plan.poses,
                    settings.estimate,
                    one_sweep=request.one_sweep,
                    zero_angles=settings.home_angles,
                    arm=settings.arm,
                )
            check_writable(path)
        except ToolNameError as error:
            raise RejectedGoalError(CalibrationCode.INVALID_NAME, str(error)) from error
        except CalibrationFileError as error:
            raise RejectedGoalError(CalibrationCode.WRITE_FAILED, str(error)) from error
        except NotExcitedError as error:
            raise RejectedGoalError(CalibrationCode.NOT_EXCITED, str(error)) from error
        except GalenError as error:
            raise RejectedGoalError(CalibrationCode.BAD_INPUT, str(error)) from error
        procedure = CalibrationProcedure(
            settings.of_sweep(),
            CalibrationRequest(
                request.tool,
                request.one_sweep,
                request.attach_by_service,
                plan.poses,
                plan.router,
            ),
        )
        return _Goal(self, handle, procedure, path, tip_m, warnings)

    def introduce(self, goal: _Goal) -> str:
        """Describe in the log what begins."""
        return f"{goal.procedure.progress[1]} poses, file {goal.path}"

    def make_end(self, code: IntEnum, message: str, goal: _Goal | None) -> End:
        """Return an end that the procedure doesn't know of."""
        return PosesEnd(CalibrationCode(code), message)

    def make_result(
        self, handle: ServerGoalHandle, end: PosesEnd, goal: _Goal | None
    ) -> tuple[CalibrateTool.Result, str]:
        """Return the action's result, and a sentence for /diagnostics."""
        tool, shown = handle.request.tool, named(handle.request.tool)
        calibration = None if goal is None else goal.calibration
        last = f"{shown} not calibrated: {end.error_code.name}: {end.error_msg}"
        if calibration is not None:
            last = f"{shown} calibrated: {calibration.path}"
        return _to_result(tool, end, calibration), last

    def _on_confirm(self, _request: Trigger.Request, response: Trigger.Response) -> Any:
        goal = self.node.goal
        if goal is None or goal.action is not self:
            response.success, response.message = False, "no calibration is running"
            return response
        response.success = goal.procedure.waiting_for_person
        if response.success:
            self.node.feed(goal.procedure.confirm)
        else:
            response.message = f"it waits for no confirmation: state {goal.procedure.state.name}"
        return response

    # ---- commands

    def needed_clients(self, goal: _Goal) -> list[Client]:
        """Return the clients of the services that the goal can't do without."""
        by_service = goal.handle.request.attach_by_service
        return [self._zero_client, self._attach_client] if by_service else [self._zero_client]

    def obey(self, goal: _Goal, command: Any) -> None:
        """Give feedback, call the driver's services, estimate."""
        node, on_service = self.node, goal.procedure.on_service
        match command:
            case PoseFeedback():
                self._publish_feedback(goal, command)
            case ZeroSensor():
                node.call(
                    goal,
                    self._zero_client,
                    Trigger.Request(),
                    lambda answer: node.feed(on_service, answer.success, answer.message),
                )
            case AttachTool():
                node.call(
                    goal,
                    self._attach_client,
                    SetTool.Request(tool=command.tool),
                    lambda answer: node.feed(on_service, answer.success, answer.error_msg),
                )
            case Measurements():
                self._estimate(goal, command)

    def _estimate(self, goal: _Goal, measurements: Measurements) -> None:
        groups = self.node.settings.estimate
        try:
            calibration = estimate(
                goal.path,
                goal.handle.request.tool,
                goal.tip_m,
                measurements,
                goal.warnings,
                mounting=MountingRequest(groups) if groups else None,
            )
            calibration.write()
        except EstimateError as error:
            goal.procedure.fail(error.code, str(error))
        else:
            goal.calibration = calibration
            goal.procedure.on_estimated()

    def _publish_feedback(self, goal: _Goal, feedback: PoseFeedback) -> None:
        message = CalibrateTool.Feedback(
            state=int(feedback.state),
            pose=feedback.pose,
            poses=feedback.poses,
            done=feedback.done,
            total=feedback.total,
            angles=feedback.angles,
            accepted=feedback.accepted,
            wrench=list(feedback.wrench),
            message=feedback.message,
        )
        goal.handle.publish_feedback(message)
        self.node.get_logger().debug(feedback.message)

    # ---- diagnostics

    def status_values(self, goal: _Goal) -> dict[str, object]:
        """Return whether it waits for a person."""
        return {"waits_for_person": goal.procedure.waiting_for_person}

    def status_remark(self, goal: _Goal) -> str:
        """Return what it waits for."""
        return "; waits for ~/confirm" if goal.procedure.waiting_for_person else ""


def _to_result(tool: str, end: PosesEnd, calibration: Calibration | None) -> CalibrateTool.Result:
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
