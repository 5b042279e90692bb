"""The gravity compensation node: wrench_raw and joint_states in, wrench_compensated out."""

import time
from typing import Any, cast

from galen_model.errors import ToolFileError, ToolNameError
from galen_model.tool_file import ToolFile, read_tool, tool_path
from galen_ros.cdr import UnreadableError
from galen_ros.deferred_service import DeferredService, Respond
from galen_ros.diagnostics import DiagnosticsPublisher, Level, Status
from galen_ros.joint_names import JointStateError
from galen_ros.parameters import declare_parameters
from galen_ros.qos import STREAM
from galen_ros.spin import run
from geometry_msgs.msg import WrenchStamped
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from galen_gravcomp.compensator import Compensator, TareRefusedError
from galen_gravcomp.monitor import Monitor
from galen_gravcomp.parameters import GravcompParameters
from galen_gravcomp.results import Compensated, Result
from galen_gravcomp.stream_monitor import Severity, State
from galen_gravcomp.tare import TareOutcome
from galen_gravcomp.wire import JointWire, RawWrench, WrenchWire
from galen_msgs.srv import SetTool

WATCH_PERIOD_S = 0.2
# Not more often than this are changes of state published and logged.
MIN_ANNOUNCE_S = 0.05


class GravcompNode(Node):
    """Subtracts the tool's weight from the wrench, sample by sample."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("gravcomp", **node_options)
        self._config = declare_parameters(self, GravcompParameters)
        p = self._config
        self._compensator = Compensator(p.settings(), on_restart=self._on_restart)
        self._monitor = Monitor(self._compensator, p.silence_s)
        self._joint_wire = JointWire(p.joint_names)
        self._wrench_wire = WrenchWire()
        self._announced: State | None = None
        self._announced_s = float("-inf")
        self._publisher_counts = {"wrench_raw": 0, "joint_states": 0}
        self._qos_trouble = ""
        self._tare_progress = (0, 0.0)

        self._publisher = self.create_publisher(WrenchStamped, "wrench_compensated", STREAM)
        self._diagnostics = DiagnosticsPublisher(self, "galen_gravcomp", self._report)
        self._compensator.set_enabled(p.enabled)
        if p.tool:
            self._load_at_start(p.tool)

        self._joint_subscription = self._subscribe(JointState, "joint_states", self._on_joint_state)
        self._wrench_subscription = self._subscribe(WrenchStamped, "wrench_raw", self._on_wrench)
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.create_service(SetTool, "~/set_tool", self._on_set_tool)
        self._tare_service = DeferredService(self, Trigger, "~/tare", self._on_tare)
        # Wall time: it watches for silence, also when a simulation's clock stands still.
        self._watch_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(WATCH_PERIOD_S, self._on_watch, clock=self._watch_clock)

    def _subscribe(self, message_type: Any, topic: str, callback: Any) -> Any:
        qos = STREAM
        if self._config.best_effort_input:
            qos = QoSProfile(depth=STREAM.depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        events = SubscriptionEventCallbacks(
            matched=lambda info: self._on_matched(topic, info),
            incompatible_qos=lambda _info: self._on_incompatible_qos(topic),
        )
        # Serialised messages: see galen_gravcomp.wire.
        return self.create_subscription(
            message_type, topic, callback, qos, event_callbacks=events, raw=True
        )

    # Samples

    def _on_joint_state(self, data: bytes) -> None:
        self._monitor.on_joints(time.monotonic())
        try:
            stamp_ns, (roll, tilt) = self._joint_wire.read(data)
        except (JointStateError, UnreadableError) as error:
            self._compensator.push_bad_joints(f"joint_states can't be used: {error}")
            return
        results = self._compensator.push_joints(stamp_ns, roll, tilt)
        if results:
            self._emit(results)

    def _on_wrench(self, data: bytes) -> None:
        arrival_s = time.monotonic()
        self._monitor.on_wrench(arrival_s)
        try:
            raw = self._wrench_wire.read(data)
        except UnreadableError as error:
            self._emit(self._compensator.push_bad_wrench(f"wrench_raw can't be used: {error}"))
            return
        results = self._compensator.push_wrench(
            raw.stamp_ns, raw.wrench, raw.frame_id, tag=(arrival_s, raw)
        )
        if results:
            self._emit(results)

    def _emit(self, results: list[Result]) -> None:
        """Publish what was compensated and take note of what was refused."""
        changed = False
        for result in results:
            if isinstance(result, Compensated):
                arrival_s, raw = cast(tuple[float, RawWrench], result.tag)
                # The input's own bytes with other numbers: stamp and frame_id can't but be kept.
                self._publisher.publish(raw.with_wrench(result.wrench))
                changed |= self._monitor.on_output(arrival_s, time.monotonic())
            else:
                changed |= self._monitor.on_refused(result, time.monotonic())
        if changed:
            self._announce()

    # Restarts of the driver

    def _on_matched(self, topic: str, info: Any) -> None:
        """A publisher of an input came or went: whoever publishes now may be another driver.

        A first publisher is no restart: its first samples may even have come before this event.
        """
        before = self._publisher_counts[topic]
        came = info.total_count_change
        gone = before + came - info.current_count
        self._publisher_counts[topic] = info.current_count
        if gone > 0 or (came > 0 and before > 0):
            why = f"driver restarted: a publisher of {topic} {'is gone' if gone > 0 else 'is new'}"
            self._emit(self._compensator.restart(why))
        self._announce()

    def _on_restart(self, why: str) -> None:
        self._monitor.on_restart(why, time.monotonic())
        self.get_logger().warning(f"{why}; samples and tare are cleared")

    def _on_incompatible_qos(self, topic: str) -> None:
        self._qos_trouble = (
            f"a publisher of {topic} is best effort, so nothing comes from it:"
            " set the parameter best_effort_input"
        )
        self._announce()

    # Tools

    def _read_tool(self, name: str) -> ToolFile:
        """Read a tool's file; raises ToolNameError or ToolFileError that names it."""
        path = tool_path(self._config.tools_dir, name)
        tool = read_tool(path)
        if tool.tool != name:
            raise ToolFileError(f"{path}: holds the tool '{tool.tool}', not '{name}'")
        return tool

    def _load_at_start(self, name: str) -> None:
        try:
            self._compensator.set_tool(self._read_tool(name))
        except (ToolNameError, ToolFileError) as error:
            # The node lives on, so that the state is on /diagnostics and the file can be mended.
            self._compensator.set_tool(None, str(error))
            self._monitor.set_tool_error(str(error))

    def _on_set_tool(self, request: SetTool.Request, response: SetTool.Response) -> Any:
        response.success = False
        try:
            tool = self._read_tool(request.tool) if request.tool else None
        except ToolNameError as error:
            response.error_code, response.error_msg = response.INVALID_NAME, str(error)
        except ToolFileError as error:
            missing = isinstance(error.__cause__, FileNotFoundError)
            response.error_code = response.NOT_FOUND if missing else response.INVALID_FILE
            response.error_msg = str(error)
        else:
            response.success = True
            self._monitor.set_tool_error("")
            self._emit(self._compensator.set_tool(tool))
            self.get_logger().info(f"tool in force: {request.tool or 'none'}")
        self._fill_tool_in_force(response)
        if not response.success:
            self.get_logger().error(f"set_tool refused: {response.error_msg}")
        self._announce(always=True)
        return response

    def _fill_tool_in_force(self, response: SetTool.Response) -> None:
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
        response.success = True
        response.message = "compensation is on" if request.data else "compensation is off"
        if request.data and self._compensator.tool is None:
            response.message += ", but no tool is loaded"
        self._announce(always=True)
        return response

    def _on_tare(
        self, _request: Trigger.Request, response: Trigger.Response, respond: Respond
    ) -> None:
        def on_done(outcome: TareOutcome) -> None:
            response.success, response.message = outcome.success, outcome.message
            respond(response)
            log = self.get_logger().info if outcome.success else self.get_logger().warning
            log(outcome.message)

        try:
            self._compensator.start_tare(on_done)
        except TareRefusedError as error:
            on_done(TareOutcome(False, str(error)))
            return
        self._tare_progress = (self._compensator.compensated, time.monotonic())
        self._announce(always=True)

    # State

    def _on_watch(self) -> None:
        now_s = time.monotonic()
        self._monitor.tick(now_s)
        if self._compensator.taring:
            count, since_s = self._tare_progress
            if self._compensator.compensated != count:
                self._tare_progress = (self._compensator.compensated, now_s)
            elif now_s - since_s > self._config.tare_timeout_s:
                state = self._state(now_s)
                self._compensator.cancel_tare(
                    f"no compensated wrench for {now_s - since_s:.1f} s ({state.message})"
                )
        self._announce()

    def _state(self, now_s: float) -> State:
        state = self._monitor.state(now_s)
        if state.severity is Severity.STALE and self._qos_trouble:
            return State(Severity.ERROR, "incompatible_qos", self._qos_trouble)
        if state.severity is Severity.OK:
            for topic, count in self._publisher_counts.items():
                if count > 1:
                    message = f"{state.message}; {topic} has {count} publishers"
                    return State(Severity.WARN, state.name, message)
        return state

    def _announce(self, always: bool = False) -> None:
        """Publish the state if it changed, or `always`; log a change."""
        now_s = time.monotonic()
        if not always and now_s - self._announced_s < MIN_ANNOUNCE_S:
            return
        state = self._state(now_s)
        last = self._announced
        changed = last is None or (last.severity, last.name) != (state.severity, state.name)
        if not changed and not always:
            return
        self._announced, self._announced_s = state, now_s
        self._diagnostics.publish_now()
        if changed:
            self._log(state)

    def _log(self, state: State) -> None:
        # rclpy's logger wants one severity for each line of code.
        if state.severity is Severity.OK:
            self.get_logger().info(state.message)
        elif state.severity is Severity.ERROR:
            self.get_logger().error(state.message)
        else:
            self.get_logger().warning(state.message)

    def _report(self) -> Status:
        now_s = time.monotonic()
        state = self._state(now_s)
        values: dict[str, object] = {"state": state.name}
        values |= self._monitor.values(now_s)
        values["tools_dir"] = self._config.tools_dir
        values["joint_names"] = " ".join(self._config.joint_names)
        values["wrench_raw_publishers"] = self._publisher_counts["wrench_raw"]
        values["joint_states_publishers"] = self._publisher_counts["joint_states"]
        return Status(Level[state.severity.value], state.message, values)


def main() -> None:
    """Run the node until it is told to stop."""
    run(GravcompNode)


if __name__ == "__main__":
    main()
