# SPDX-License-Identifier: Apache-2.0
"""The deflection's node: wrench_compensated and joint_states in, how far the tip deflects out."""

import time
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from galen_common.arm import names_of_joints
from galen_common.cdr import RawWrench, deflection_bytes, pose_bytes
from galen_common.stream.samples import Rejected
from galen_model.errors import GalenError
from galen_ros.messages import STREAM
from galen_ros.node.spin import run
from galen_ros.node.stream_node import StreamNode
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from galen_deflection.deflector import Deflected, DeflectionParameters, Deflector, GravcompState
from galen_deflection.models.file import DeflectionModel, read_model
from galen_deflection.monitor import DeflectorMonitor
from galen_msgs.msg import DeflectionStamped

AS_NEVER_LOADED = (
    "the loads so far are forgotten: from here on it is as if the arm had never been loaded,"
    " and the covariance holds what may have been left of earlier loads"
)


class DeflectionNode(StreamNode):
    """Predicts the deflection of each wrench's moment, and where the tip then is."""

    hardware_id = "galen_deflection"
    cleared_on_restart = "samples and the loads so far"

    def __init__(self, **node_options: Any) -> None:
        super().__init__("deflection", **node_options)
        self._read: tuple[str, DeflectionModel | None] | None = None
        # Before the parameters' own check, which accepts any text.
        self.add_on_set_parameters_callback(self._check_model_file)
        self._held = self.hold(DeflectionParameters, self._on_change)
        self.start()

    def _configure(self) -> None:
        p = self._config = self._held.now
        self._arm = self._take_arm()
        self._joint_names = names_of_joints(p.joint_names, self._arm)
        self._deflector = Deflector(p, self._on_restart, self._on_forgotten, arm=self._arm)
        self._prediction = DeflectorMonitor(self._deflector)
        self._model_file = ""
        self._gravcomp: GravcompState | None = None
        self._gravcomp_name = self._resolved(p.gravcomp_node)

        self._deflection_bytes = deflection_bytes(self._arm.base_frame)
        self._pose_bytes = pose_bytes(self._arm.base_frame)
        self._deflections = self.create_publisher(DeflectionStamped, "deflection", STREAM)
        self._tip_poses = self.create_publisher(PoseStamped, "tip_pose_corrected", STREAM)
        self._load_at_start(p.model_file)
        self._begin(
            self._deflector.pairing,
            self._deflector.push_wrench,
            self._prediction,
            self._joint_names,
            p.best_effort_input,
        )
        self.create_service(Trigger, "~/reset", self._on_reset)
        if self._gravcomp_name:
            self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    # Samples

    def _push_joints(
        self, stamp_ns: int, positions: tuple[float, ...]
    ) -> list[Deflected | Rejected]:
        return self._deflector.push_joints(stamp_ns, positions)

    def _publish(self, result: Deflected, raw: RawWrench) -> None:
        # Written from templates, which costs a sixth of filling messages.
        predicted = result.predicted
        self._deflections.publish(
            self._deflection_bytes.fill(
                result.stamp_ns,
                predicted.mean.tolist(),
                predicted.covariance.ravel().tolist(),
                [predicted.extrapolated],
            )
        )
        self._tip_poses.publish(self._pose_bytes.fill(result.stamp_ns, *result.tip))

    # The model

    def _check_model_file(self, parameters: list[Parameter]) -> SetParametersResult:
        """Read a new model's file before it is accepted, so that a bad one changes nothing."""
        for parameter in parameters:
            if parameter.name != "model_file" or not isinstance(parameter.value, str):
                continue
            if not self.configured:  # it is read then
                continue
            try:
                self._read = (parameter.value, self._model_of(parameter.value))
            except GalenError as error:
                why = f"model_file is rejected, the old one stays: {error}"
                self._prediction.on_notice(why, time.monotonic())
                self.get_logger().error(why)
                self._announce(always=True)
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_change(self, new: DeflectionParameters) -> None:
        if self._read is None or self._read[0] != new.model_file:
            return
        (_, model), self._read = self._read, None
        self._use(new.model_file, model)
        text = f"active model: {new.model_file or 'none'}"
        if model is not None:
            text += f" ({model.name}); it has seen no load yet"
        self.get_logger().info(text)
        self._announce(always=True)

    def _load_at_start(self, file: str) -> None:
        try:
            self._use(file, self._model_of(file))
        except GalenError as error:
            if not self.starts_itself:
                raise  # the transition fails with the reason
            # The node lives on, so that the state is on /diagnostics and the file can be fixed.
            self._deflector.set_model(None, str(error))
            self._prediction.set_model_error(str(error))

    def _model_of(self, file: str) -> DeflectionModel | None:
        """Read a file's model, None for no file; raises DeflectionError that names it."""
        return read_model(Path(file).expanduser(), self._arm) if file else None

    def _use(self, file: str, model: DeflectionModel | None) -> None:
        self._model_file = file
        self._prediction.set_model_error("")
        results = self._deflector.set_model(model)
        if results:
            self._emit(results)

    # Loads

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Any:
        response.success = self._deflector.model is not None
        if not response.success:
            response.message = "no model is loaded: there is nothing to forget"
            return response
        self._deflector.forget("~/reset was called")
        response.message = AS_NEVER_LOADED
        self._announce(always=True)
        return response

    def _on_forgotten(self, why: str) -> None:
        self._prediction.on_forgotten(why, time.monotonic())
        self.get_logger().info(f"the loads so far are forgotten: {why}")

    # The compensation

    def _resolved(self, name: str) -> str:
        """Return the name of a node as it is on /diagnostics."""
        if not name or name.startswith("/"):
            return name.lstrip("/")
        return f"{self.get_namespace().rstrip('/')}/{name}".lstrip("/")

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.hardware_id == "galen_gravcomp" and status.name == self._gravcomp_name:
                self._follow(GravcompState.of({item.key: item.value for item in status.values}))

    def _follow(self, now: GravcompState) -> None:
        """Forget loads that were read otherwise; reject a tool that the model is not for."""
        before, self._gravcomp = self._gravcomp, now
        why = "" if before is None else now.change_since(before)
        if why:
            self._deflector.forget(why)
        elif before is not None:
            return
        results = self._deflector.set_tool(now.tool, now.tip_m if now.tool else None)
        if results:
            self._emit(results)
        self._announce()

    # State

    def _values(self, now_s: float) -> dict[str, object]:
        values: dict[str, object] = {
            "model_file": self._model_file,
        }
        values |= self._prediction.values(now_s)
        state = self._gravcomp
        values["gravcomp_node"] = self._gravcomp_name
        values["gravcomp_tool"] = "not known" if state is None else state.tool
        values["joint_names"] = " ".join(self._joint_names)
        return values


def main() -> None:
    """Run the node until it is told to stop."""
    run(DeflectionNode)


if __name__ == "__main__":
    main()
