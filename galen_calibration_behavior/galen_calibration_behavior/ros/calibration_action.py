# SPDX-License-Identifier: Apache-2.0
"""The action `calibrate_tool`: the procedure on the arm's topics and services."""

from __future__ import annotations

import math
import time
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from galen_common.goal.procedure import End
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, GalenError, NotExcitedError, ToolNameError
from galen_model.files.calibration_file import calibration_path
from galen_model.poses.plan import SweepPlan
from galen_ros.goal.node import ArmAction, GoalNode, RejectedGoalError, RunningGoal, named
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters
from rclpy.action.server import ServerGoalHandle
from rclpy.client import Client
from rclpy.node import NodeNameNonExistentError
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from galen_calibration_behavior.calibration.by_hand import ByHandProcedure
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
from galen_calibration_behavior.common.commands import (
    WARNING,
    AttachTool,
    CalibrationCode,
    Measurements,
    PoseFeedback,
    PosesEnd,
    ZeroSensor,
)
from galen_calibration_behavior.common.parameters import MAX_ITERS
from galen_msgs.action import CalibrateTool
from galen_msgs.srv import SetTool

_ANSWER_S = 2.0
"""So long a driver is asked which tools it knows."""


class _Calibrating(RunningGoal):
    """One running calibration."""

    def __init__(
        self,
        action: ArmAction,
        handle: ServerGoalHandle,
        procedure: CalibrationProcedure,
        path: Path,
        tip_m: Array,
    ) -> None:
        super().__init__(action, handle, procedure)
        self.path = path
        self.tip_m = tip_m
        self.calibration: Calibration | None = None
        self.drivers_tools: _DriversTools | None = None


class _DriversTools:
    """Asks the node that offers `attach_tool` for its parameter `tools`, the names it knows.

    A driver without that parameter, or one that does not answer, is not known to lack any tool.
    """

    def __init__(self, node: GoalNode, attach: Client) -> None:
        self.driver = ""
        self.tools: list[str] | None = None
        self._node = node
        self._service = node.resolve_service_name(attach.srv_name)
        self._until_s = time.monotonic() + _ANSWER_S
        self._client: Client | None = None
        self._answer: Future | None = None

    def is_over(self) -> bool:
        """Go on asking; return whether there is an answer, or none to wait for any longer."""
        if self._answer is not None and self._answer.done():
            for value in self._answer.result().values:
                if value.type == ParameterType.PARAMETER_STRING_ARRAY:
                    self.tools = list(value.string_array_value)
        elif time.monotonic() < self._until_s:
            self._ask()
            return False
        if self._client is not None:
            self._node.destroy_client(self._client)
        return True

    def _ask(self) -> None:
        if self._client is None:
            self.driver = self._service_owner()
            if self.driver:
                name = f"{self.driver}/get_parameters"
                self._client = self._node.create_client(GetParameters, name)
        elif self._answer is None and self._client.service_is_ready():
            self._answer = self._client.call_async(GetParameters.Request(names=["tools"]))

    def _service_owner(self) -> str:
        for name, namespace in self._node.get_node_names_and_namespaces():
            with suppress(NodeNameNonExistentError):  # gone since it was listed
                services = self._node.get_service_names_and_types_by_node(name, namespace)
                if any(offered == self._service for offered, _ in services):
                    return f"{namespace.rstrip('/')}/{name}"
        return ""


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
        node.create_subscription(
            Temperature, "temperature", self._on_temperature, qos_profile_sensor_data
        )

    def make_goal(self, handle: ServerGoalHandle) -> _Calibrating:
        """Make the goal to run, with its poses where it is known where the arm stands.

        Args:
            handle: the goal's, with its request.

        Returns:
            The goal, whose procedure has not begun.

        Raises:
            RejectedGoalError: the request is wrong, the poses can't be had, or the file can't be
                written.

        """
        request, settings = handle.request, self.node.settings
        for name, count in (("iters_t", request.iters_t), ("iters_r", request.iters_r)):
            if count > MAX_ITERS:
                raise RejectedGoalError(
                    CalibrationCode.BAD_INPUT, f"{name} is {count}: at most {MAX_ITERS}, or 0"
                )
            if count and (settings.pose_kind != "grid" or request.by_hand):
                kind = "an operator's" if request.by_hand else f"{settings.pose_kind} ones"
                raise RejectedGoalError(
                    CalibrationCode.BAD_INPUT,
                    f"{name} is {count}, but there is no grid: the poses are {kind}",
                )
        try:
            path = calibration_path(Path(settings.tools_dir).expanduser(), request.tool)
            tip_m, warnings = choose_tip(np.array(request.tip_m, float), path, settings.arm)
            if warnings and settings.obstacles:
                raise GalenError(f"{warnings[0]}, so that it is not known what the tool would hit")
            plan = SweepPlan(np.zeros((0, len(settings.arm.turning)))) if request.by_hand else None
            if plan is None and settings.has_home:  # else once it is known where the arm stands
                plan = settings.plan(
                    tip_m, one_sweep=request.one_sweep, tilts=request.iters_t, rolls=request.iters_r
                )
            elif plan is None and warnings:
                warnings.append("without its tip it is not known what the tool would hit")
            check_writable(path)
        except ToolNameError as error:
            raise RejectedGoalError(CalibrationCode.INVALID_NAME, str(error)) from error
        except CalibrationFileError as error:
            raise RejectedGoalError(CalibrationCode.WRITE_FAILED, str(error)) from error
        except NotExcitedError as error:
            raise RejectedGoalError(CalibrationCode.NOT_EXCITED, str(error)) from error
        except GalenError as error:
            raise RejectedGoalError(CalibrationCode.BAD_INPUT, str(error)) from error
        by_hand = request.by_hand
        procedure = (ByHandProcedure if by_hand else CalibrationProcedure)(
            settings if by_hand else settings.of_sweep(),
            CalibrationRequest(
                request.tool,
                request.one_sweep,
                request.attach_by_service,
                None if plan is None else plan.poses,
                None if plan is None else plan.router,
                zero=self._can_zero(request),
                tip_m=tip_m,
                warnings=(*warnings, *(() if plan is None else plan.warnings)),
            ),
        )
        return _Calibrating(self, handle, procedure, path, tip_m)

    def introduce(self, goal: _Calibrating) -> str:
        """Describe in the log what begins.

        Args:
            goal: the goal that begins.

        Returns:
            Number of poses, and the tool's file.

        """
        return f"{goal.procedure.progress[1]} poses, file {goal.path}"

    def make_end(self, code: IntEnum, message: str, goal: _Calibrating | None) -> End:
        """Return an end that the procedure doesn't know of.

        Args:
            code: one of CalibrationCode.
            message: the reason.
            goal: the goal that ends; None: it was rejected.

        Returns:
            The end, without poses and warnings.

        """
        return PosesEnd(CalibrationCode(code), message)

    def make_result(
        self, handle: ServerGoalHandle, end: PosesEnd, goal: _Calibrating | None
    ) -> tuple[CalibrateTool.Result, str]:
        """Return the action's result, and a sentence for /diagnostics.

        Args:
            handle: the goal's, with its request.
            end: the procedure's, or of `make_end`.
            goal: the goal that ended; None: it was rejected.

        Returns:
            The result, with the file's loads where one was written; and the sentence.

        """
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

    def _on_temperature(self, message: Temperature) -> None:
        goal = self.node.goal
        if goal is not None and goal.action is self and math.isfinite(message.temperature):
            goal.procedure.temperature_c = message.temperature

    # ---- commands

    def _can_zero(self, request: CalibrateTool.Goal) -> bool:
        if self.node.settings.zeroing == "none":
            return False
        return not request.by_hand or self._zero_client.service_is_ready()

    def needed_clients(self, goal: _Calibrating) -> list[Client]:
        """Return the clients of the services that the goal can't do without.

        Args:
            goal: the goal that begins.

        Returns:
            Clients of `zero_ft_sensor` and `attach_tool`, as far as the goal calls them.

        """
        request = goal.handle.request
        settled = request.by_hand or self.node.settings.zeroing == "none"
        zero = [] if settled else [self._zero_client]
        return [*zero, self._attach_client] if request.attach_by_service else zero

    def find_missing(self, goal: _Calibrating) -> tuple[IntEnum, str] | None:
        """Ask a driver that changes tools whether it knows this one, before the arm moves.

        Args:
            goal: the goal that begins; it fails where the driver lacks the tool.

        Returns:
            While the driver has not answered: the code and reason should it never; None: go on.

        """
        request = goal.handle.request
        if not request.attach_by_service:
            return None
        if goal.drivers_tools is None:
            goal.drivers_tools = _DriversTools(self.node, self._attach_client)
            goal.preflight_s = 0.0  # topics and services are there; this has a time-out of its own
        asked = goal.drivers_tools
        if not asked.is_over():
            return CalibrationCode.SERVICE_FAILED, f"{asked.driver} does not answer"
        if asked.tools is not None and request.tool not in asked.tools:
            goal.procedure.fail(
                CalibrationCode.SERVICE_FAILED,
                f"attach_tool can't put {request.tool!r} on: {asked.driver} knows"
                f" {', '.join(asked.tools) or 'no tool'} (its parameter 'tools'); correct the"
                " name, or calibrate by hand",
            )
        return None

    def obey(self, goal: _Calibrating, command: Any) -> None:
        """Give feedback, call the driver's services, estimate.

        Args:
            goal: the goal that runs.
            command: what its procedure asks for.

        """
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

    def _estimate(self, goal: _Calibrating, measurements: Measurements) -> None:
        """Identify beside the executor, which goes on; write where the goal still wants it."""
        groups = self.node.settings.estimate

        def go_on(_compared: str) -> None:
            if self.node.goal is not goal or goal.procedure.ending:
                raise EstimateError(CalibrationCode.CANCELED, "not needed any more")

        def identify() -> Calibration | EstimateError:
            try:
                return estimate(
                    goal.path,
                    goal.handle.request.tool,
                    goal.tip_m,
                    measurements,
                    [],
                    mounting=MountingRequest(groups) if groups else None,
                    check_setup=self.node.settings.check_setup,
                    progress=go_on,
                )
            except EstimateError as error:
                return error

        def finish(found: Calibration | EstimateError) -> None:
            if goal.procedure.ending:
                return
            try:
                if isinstance(found, EstimateError):
                    raise found
                found.write()
            except EstimateError as error:
                goal.procedure.fail(error.code, str(error))
            else:
                goal.calibration = found
                goal.procedure.on_estimated()

        self.node.work(goal, identify, finish)

    def _publish_feedback(self, goal: _Calibrating, feedback: PoseFeedback) -> None:
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
        if feedback.message.startswith(WARNING):
            self.node.get_logger().warning(feedback.message)
        else:
            self.node.get_logger().debug(feedback.message)

    # ---- diagnostics

    def status_values(self, goal: _Calibrating) -> dict[str, object]:
        """Return whether the goal waits for a person.

        Args:
            goal: the goal that runs.

        Returns:
            Values for /diagnostics.

        """
        return {"waits_for_person": goal.procedure.waiting_for_person}

    def status_remark(self, goal: _Calibrating) -> str:
        """Return what the goal waits for.

        Args:
            goal: the goal that runs.

        Returns:
            Text after the progress in /diagnostics; empty where it doesn't wait for a person.

        """
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
