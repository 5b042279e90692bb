# SPDX-License-Identifier: Apache-2.0
"""The gravity compensation node: wrench_raw and joint_states in, wrench_compensated out."""

import contextlib
import time
from typing import Any

import numpy as np
from galen_common.arm import names_of_joints
from galen_common.cdr import ImuWire, JointStateError, JointWire, RawWrench, UnreadableError
from galen_common.stream.samples import PairedWrench, Rejection, Result
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, ToolNameError
from galen_model.files.calibration_file import CalibrationFile
from galen_ros.messages import STREAM
from galen_ros.node.spin import run
from galen_ros.node.stream_node import StreamNode, input_qos
from galen_ros.rclpy_workarounds import DeferredService, Respond
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import Imu
from std_srvs.srv import SetBool, Trigger

from galen_gravcomp.compensator import Compensator, TareRejectedError
from galen_gravcomp.monitor import Monitor
from galen_gravcomp.parameters import GravcompParameters
from galen_gravcomp.ros.tool_services import ToolServices
from galen_msgs.srv import SetTool

# Wall time without a compensated wrench after which a running tare is given up.
_TARE_TIMEOUT_S = 2.0


class GravcompNode(StreamNode):
    """Subtracts the tool's weight from the wrench, sample by sample."""

    hardware_id = "galen_gravcomp"
    cleared_on_restart = "samples and tare"

    def __init__(self, **node_options: Any) -> None:
        super().__init__("gravcomp", **node_options)
        self._held = self.hold(GravcompParameters)
        self.start()

    def _configure(self) -> None:
        p = self._config = self._held.now
        arm = self._take_arm()
        self._joint_names = names_of_joints(p.joint_names, arm)
        self._compensator = Compensator(p, self._on_restart, arm=arm)
        self._compensation = Monitor(self._compensator)
        self._tare_progress = (0, 0.0)

        self._compensator.set_enabled(p.enabled)
        self._tools = ToolServices(
            self,
            self._compensator,
            p.tools_dir,
            self._live_joints,
            self._compensation.set_file_note,
        )
        self._at_undo(self._tools.close)
        if p.tool:
            self._load_at_start(p.tool)
        self._begin(
            self._compensator.pairing,
            self._compensator.push_wrench,
            self._compensation,
            self._joint_names,
            p.best_effort_input,
        )
        self._choose_joints()
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.create_service(SetTool, "~/set_tool", self._on_set_tool)
        self.create_service(SetBool, "~/set_bias_drift", self._on_set_bias_drift)
        self._tare_service = DeferredService(self, Trigger, "~/tare", self._on_tare)

    def _activate(self) -> None:
        # Not before: another node that is active is alone on the topic then.
        self._publisher = self.create_publisher(WrenchStamped, Monitor.output, STREAM)
        super()._activate()
        self._at_undo(lambda: self._compensator.cancel_tare("the node was deactivated"))
        if self._compensator.needs_imu:
            self._imu_wire = ImuWire()
            qos = input_qos(self._config.best_effort_input)
            self._imu = self.create_subscription(Imu, "imu", self._on_imu, qos, raw=True)

    def _push_joints(self, stamp_ns: int, positions: tuple[float, ...]) -> list[Result]:
        return self._compensator.push_joints(stamp_ns, positions)

    def _on_imu(self, data: bytes) -> None:
        try:
            reading = self._imu_wire.read(data)
        except UnreadableError as error:
            # As if it had not come: wrenches are rejected when it stays so.
            self._compensation.on_notice(f"imu can't be used: {error}", time.monotonic())
            return
        results = self._compensator.push_imu(*reading)
        if results:
            self._emit(results)

    def _choose_joints(self) -> None:
        """Read all joints from joint_states only while they are needed, else the angles."""
        arm, needs_all = self._compensator.arm, self._compensator.needs_positions
        places = range(len(arm.joints)) if needs_all else arm.turning
        self._read_joints([self._joint_names[k] for k in places])

    def _withheld(self) -> tuple[Rejection, str] | None:
        monitor, check = self._compensator.monitor, self._config.setup_check
        if monitor is not None and check != "off":
            if monitor.setup.contradiction:
                return Rejection.WRONG_SETUP, (
                    f"the set-up is wrong: {monitor.setup.contradiction}; setup_check:=off"
                    " publishes all the same"
                )
            if check == "wait" and monitor.setup.checks and not monitor.setup.fitting:
                return Rejection.NOT_VERIFIED, f"the set-up is {monitor.setup.text}"
        return super()._withheld()

    def _publish(self, result: PairedWrench, raw: RawWrench) -> None:
        # The input's own bytes with other numbers: stamp and frame_id can't but be kept.
        self._publisher.publish(raw.with_wrench(result.wrench))

    # Tools

    def _live_joints(self) -> Array:
        """Joints (n,), m and rad; NaN where they are not known, or were long ago."""
        p, newest = self._config, self._newest_joint_state
        joints = np.full(len(self._joint_names), np.nan)
        if newest is None or time.monotonic() - newest[0] > p.silence_s:
            return joints
        turning = self._compensator.arm.turning
        # A driver may send the revolute ones alone.
        for places in (range(len(joints)), turning):
            with contextlib.suppress(JointStateError, UnreadableError):
                wire = JointWire([self._joint_names[k] for k in places])
                joints[list(places)] = wire.read(newest[1])[1]
                break
        return joints

    def _load_at_start(self, name: str) -> None:
        try:
            stored = self._tools.read(name)
            self._compensator.set_tool(stored.tool)
            self._tools.active_tool.put(stored)
            self._warn_of_file(stored.tool)
        except (ToolNameError, CalibrationFileError) as error:
            if not self.starts_itself:
                raise  # the transition's caller gets it
            # The node lives on, so that the state is on /diagnostics and the file can be fixed.
            self._compensator.set_tool(None, str(error))
            self._compensation.set_tool_error(str(error))

    def _warn_of_file(self, file: CalibrationFile) -> None:
        # A line of code for each: rclpy's logger keeps one text's once.
        if file.arm_warning:
            self.get_logger().warning(file.arm_warning)
        if file.bias_note:
            self.get_logger().warning(file.bias_note)

    def _on_set_tool(self, request: SetTool.Request, response: SetTool.Response) -> Any:
        response.success = False
        try:
            stored = self._tools.read(request.tool) if request.tool else None
        except ToolNameError as error:
            response.error_code, response.error_msg = response.INVALID_NAME, str(error)
        except CalibrationFileError as error:
            missing = isinstance(error.__cause__, FileNotFoundError)
            response.error_code = response.NOT_FOUND if missing else response.INVALID_FILE
            response.error_msg = str(error)
        else:
            response.success = True
            self._compensation.set_tool_error("")
            self._emit(self._compensator.set_tool(None if stored is None else stored.tool))
            self._tools.active_tool.put(stored)
            self._choose_joints()
            self.get_logger().info(f"active tool: {request.tool or 'none'}")
            if stored is not None:
                self._warn_of_file(stored.tool)
        self._fill_active_tool(response)
        self._tools.active_tool.update()
        if not response.success:
            self.get_logger().error(f"set_tool rejected: {response.error_msg}")
        self._announce(always=True)
        return response

    def _fill_active_tool(self, response: SetTool.Response) -> None:
        tool = self._compensator.tool
        if tool is None:
            return
        response.tool = tool.tool
        response.mass_kg = float(tool.load.mass_kg)
        response.com_m = tool.load.com_m
        response.tip_m = tool.tip_m
        response.calibrated_at = tool.calibrated_at

    # Switch and tare

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        self._emit(self._compensator.set_enabled(request.data))
        self._tools.active_tool.update()
        response.success = True
        response.message = "compensation is on" if request.data else "compensation is off"
        if request.data and self._compensator.tool is None:
            response.message += ", but no tool is loaded"
        elif request.data and not self.active:
            response.message += ", but the node is inactive"
        self._announce(always=True)
        return response

    def _on_set_bias_drift(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        self._compensator.set_bias_drift(request.data)
        self._tools.active_tool.update()
        response.success = True
        response.message = (
            "bias drift is learned while the arm is at rest without contact"
            if request.data
            else "bias drift is off, what it subtracted goes along a ramp"
        )
        self.get_logger().info(response.message)
        self._announce(always=True)
        return response

    def _on_tare(
        self, _request: Trigger.Request, response: Trigger.Response, respond: Respond
    ) -> None:
        def on_done(message: str, offset: Array | None) -> None:
            response.success, response.message = offset is not None, message
            self._tools.active_tool.update()
            respond(response)
            # rclpy's logger wants one severity for each line of code, and raises otherwise.
            if response.success:
                self.get_logger().info(message)
            else:
                self.get_logger().warning(message)

        try:
            if not self.active:
                raise TareRejectedError("not tared: the node is inactive")
            self._compensator.start_tare(on_done)
        except TareRejectedError as error:
            on_done(str(error), None)
            return
        self._tare_progress = (self._compensator.compensated, time.monotonic())
        self._announce(always=True)

    # State

    def _watch(self, now_s: float) -> None:
        self._tools.active_tool.watch(now_s)
        if not self._compensator.taring:
            return
        count, since_s = self._tare_progress
        if self._compensator.compensated != count:
            self._tare_progress = (self._compensator.compensated, now_s)
        elif now_s - since_s > _TARE_TIMEOUT_S:
            state = self._state(now_s)
            self._compensator.cancel_tare(
                f"no compensated wrench for {now_s - since_s:.1f} s ({state.message})"
            )

    def _values(self, now_s: float) -> dict[str, object]:
        values = self._compensation.values(now_s)
        values["tools_dir"] = self._config.tools_dir
        values["joint_names"] = " ".join(self._joint_names)
        return values


def main() -> None:
    """Run the node until it is told to stop."""
    run(GravcompNode)


if __name__ == "__main__":
    main()
