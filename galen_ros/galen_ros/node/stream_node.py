# SPDX-License-Identifier: Apache-2.0
"""What the nodes share that take a wrench and joint_states, and make something of each wrench."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, cast

from galen_common.arm import ArmParameters, other_arm
from galen_common.cdr import JointStateError, JointWire, RawWrench, UnreadableError, WrenchWire
from galen_common.stream.monitor import (
    UNIT_TEXTS,
    UNITS_HOLD_S,
    Severity,
    StreamMonitor,
    StreamState,
)
from galen_common.stream.pairing import WrenchPairing
from galen_common.stream.samples import Notice, Rejected, Rejection
from galen_model.arm.arm import Arm
from geometry_msgs.msg import WrenchStamped
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from galen_ros.messages import STREAM, publisher_nodes
from galen_ros.node.diagnostics import Level, Status
from galen_ros.node.managed_node import ManagedNode
from galen_ros.node.robot_description import ArmSource

PushWrench = Callable[[int, Sequence[float], str, object], list[Any]]

WATCH_PERIOD_S = 0.2
# Not more often than this are changes of state published and logged.
MIN_ANNOUNCE_S = 0.05


def input_qos(best_effort: bool) -> QoSProfile:
    """Return how a stream of samples is subscribed to.

    Args:
        best_effort: whether to take samples of a best-effort publisher, too.

    Returns:
        The quality of service, of STREAM's depth.

    """
    if best_effort:
        return QoSProfile(depth=STREAM.depth, reliability=ReliabilityPolicy.BEST_EFFORT)
    return STREAM


class StreamNode(ManagedNode):
    """Feed a `WrenchPairing` from its topics, publish results and state."""

    cleared_on_restart: ClassVar[str]
    """As the log says it."""

    def __init__(self, name: str, **node_options: Any) -> None:
        super().__init__(name, **node_options)
        self._source = ArmSource(
            self,
            self.hold(ArmParameters),
            self._on_description,
            "call deactivate, cleanup and configure to take it",
        )
        self._starts_late = False
        self._announced: StreamState | None = None
        self._announced_s = float("-inf")
        self._qos_trouble = ""
        self._newest_joint_state: tuple[float, bytes] | None = None
        """Wall time of its arrival, s, and the message, serialised."""

    def start(self) -> None:
        """Configure and activate as soon as the arm is known, unless told not to."""
        self._starts_late = self._autostarts and bool(self._source.waiting)
        if self._starts_late:
            self.get_logger().info(self._source.waiting)
        else:
            super().start()

    def _on_description(self) -> None:
        if self._starts_late and self.trigger_configure() is TransitionCallbackReturn.SUCCESS:
            self._starts_late = False
            self.trigger_activate()
        self._diagnostics.publish_now()

    def _take_arm(self) -> Arm:
        """To be called first in `_configure`; raises GalenError."""
        self._at_undo(self._source.leave)
        self.arm = self._source.take()
        return self.arm

    def _remark(self) -> str:
        return self._source.trouble if self.configured else self._source.waiting

    def _begin(
        self,
        pairing: WrenchPairing,
        push_wrench: PushWrench,
        monitor: StreamMonitor,
        joint_names: Sequence[str],
        best_effort: bool,
    ) -> None:
        """To be called in `_configure`: watch these; the inputs are subscribed to when active.

        `push_wrench`: as `WrenchPairing.push_wrench`, with what is made of the wrenches;
        `joint_names` in the order in which `_push_joints` takes them.
        """
        self._pairing = pairing
        self._units_seen: Counter[Notice] = Counter()
        self._implausible: tuple[float, str] | None = None
        self._push_wrench = push_wrench
        self._monitor = monitor
        if self.get_parameter("use_sim_time").value:
            monitor.stamps_are_simulated()
        self._read_joints(joint_names)
        self._wrench_wire = WrenchWire()
        self._inputs_qos = input_qos(best_effort)
        # Wall time: it watches for silence, also when a simulation's clock stands still.
        self._watch_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(WATCH_PERIOD_S, self._on_watch, clock=self._watch_clock)

    def _activate(self) -> None:
        self._monitor.begin()
        self._qos_trouble = ""
        self._at_undo(self._forget_samples)
        qos = self._inputs_qos
        self._joint_subscription = self._subscribe(
            JointState, "joint_states", self._on_joint_state, qos
        )
        self._wrench_subscription = self._subscribe(
            WrenchStamped, self._pairing.wrench_topic, self._on_wrench, qos
        )

    def _forget_samples(self) -> None:
        """As when the driver was restarted: nothing is held over to the next time."""
        if self.configured:  # else it ends, and there is no next time
            self._emit(self._pairing.restart("the node was deactivated"))
        self._newest_joint_state = None

    def _read_joints(self, joint_names: Sequence[str]) -> None:
        self._joint_wire = JointWire(joint_names)

    # What a subclass does

    @abstractmethod
    def _push_joints(self, stamp_ns: int, positions: tuple[float, ...]) -> list[Any]:
        """Push them into the pairing; return what was made of the wrenches."""

    @abstractmethod
    def _publish(self, result: Any, raw: RawWrench) -> None:
        """Publish what was made of a wrench."""

    @abstractmethod
    def _values(self, now_s: float) -> dict[str, object]:
        """Values for /diagnostics."""

    def _watch(self, now_s: float) -> None:
        """Do what is to be done a few times a second of wall time."""

    # Samples

    def _subscribe(self, message_type: Any, topic: str, callback: Any, qos: QoSProfile) -> Any:
        events = SubscriptionEventCallbacks(
            matched=lambda info: self._on_matched(topic, info),
            incompatible_qos=lambda _info: self._on_incompatible_qos(topic),
        )
        # Serialised messages: see galen_common.cdr.
        return self.create_subscription(
            message_type, topic, callback, qos, event_callbacks=events, raw=True
        )

    def _on_joint_state(self, data: bytes) -> None:
        now_s = time.monotonic()
        self._monitor.on_joints(now_s)
        self._newest_joint_state = (now_s, data)
        try:
            stamp_ns, positions = self._joint_wire.read(data)
        except (JointStateError, UnreadableError) as error:
            text = f"joint_states can't be used: {error}"
            if isinstance(error, JointStateError):
                text += other_arm(self.arm)
            self._pairing.push_bad_joints(text)
            return
        results = self._push_joints(stamp_ns, positions)
        self._look_at_units(now_s)
        if results:
            self._emit(results)

    def _on_wrench(self, data: bytes) -> None:
        arrival_s = time.monotonic()
        self._monitor.on_wrench(arrival_s)
        try:
            raw = self._wrench_wire.read(data)
        except UnreadableError as error:
            detail = f"{self._pairing.wrench_topic} can't be used: {error}"
            self._emit(self._pairing.push_bad_wrench(detail))
            return
        results = self._push_wrench(raw.stamp_ns, raw.wrench, raw.frame_id, (arrival_s, raw))
        self._look_at_units(arrival_s)
        if results:
            self._emit(results)

    def _look_at_units(self, now_s: float) -> None:
        """Note which values looked like those of another unit just now."""
        notices = self._pairing.notices
        for notice, text in UNIT_TEXTS.items():
            if notices[notice] > self._units_seen[notice]:
                self._units_seen[notice] = notices[notice]
                self._implausible = (now_s, text)

    def _withheld(self) -> tuple[Rejection, str] | None:
        """Return why what was made of a wrench must not be published; None: it may."""
        if self._implausible is None or not self._pairing.parameters.check_units:
            return None
        since_s, text = self._implausible
        if time.monotonic() - since_s < UNITS_HOLD_S:
            return Rejection.UNITS, f"{text} (check_units:=false where they are right)"
        self._implausible = None
        return None

    def _emit(self, results: Sequence[Any]) -> None:
        changed = False
        for result in results:
            if isinstance(result, Rejected):
                changed |= self._monitor.on_rejected(result, time.monotonic())
            elif (why := self._withheld()) is not None:
                withheld = self._pairing.reject(result.stamp_ns, *why, result.number)
                changed |= self._monitor.on_rejected(withheld, time.monotonic())
            else:
                arrival_s, raw = cast(tuple[float, RawWrench], result.tag)
                self._publish(result, raw)
                changed |= self._monitor.on_output(arrival_s, time.monotonic(), raw.stamp_ns)
        if changed:
            self._announce()

    # Restarts of the driver

    def _on_matched(self, topic: str, info: Any) -> None:
        """Take note that a publisher of an input came or went: another driver, maybe."""
        now_s = time.monotonic()
        why = self._monitor.publishers_changed(
            topic, info.current_count, info.total_count_change, now_s
        )
        if why:
            self._emit(self._pairing.restart(why))
        self._monitor.publishers[topic].name(publisher_nodes(self, topic))
        self._count_outputs()
        self._emit(self._monitor.review(now_s))
        self._announce()

    def _count_outputs(self) -> None:
        """Count the publishers, this node's too, where it must be alone: no event tells of them."""
        topic, outputs = self._monitor.output, self._monitor.outputs
        if not topic:
            return
        before = outputs.listed
        outputs.listed = self.count_publishers(self.resolve_topic_name(topic))
        if outputs.listed != before or outputs.several:
            outputs.name(publisher_nodes(self, topic))

    def _on_restart(self, why: str) -> None:
        self._monitor.on_restart(why, time.monotonic())
        # Two drivers with two clocks restart it with every message.
        text = f"{why}; {self.cleared_on_restart} are cleared"
        self.get_logger().warning(text, throttle_duration_sec=1.0)

    def _on_incompatible_qos(self, topic: str) -> None:
        self._qos_trouble = (
            f"a publisher of {topic} is best effort, so nothing comes from it:"
            " set the parameter best_effort_input"
        )
        self._announce()

    # State

    def _on_watch(self) -> None:
        now_s = time.monotonic()
        if self.active:
            self._monitor.tick(now_s)
            for topic, publishers in self._monitor.publishers.items():
                if publishers.several:  # names come later than the publishers themselves
                    publishers.name(publisher_nodes(self, topic))
            self._count_outputs()
            self._emit(self._monitor.review(now_s))
        self._watch(now_s)
        self._announce()

    def _state(self, now_s: float) -> StreamState:
        if not self.active:
            return StreamState(Severity.WARN, "inactive", self.inactive_text)
        state = self._monitor.state(now_s)
        if state.severity is Severity.STALE and self._qos_trouble:
            return StreamState(Severity.ERROR, "incompatible_qos", self._qos_trouble)
        return state

    def _announce(self, always: bool = False) -> None:
        """Publish the state if it changed, or `always`; log a change."""
        now_s = time.monotonic()
        if not self.configured or (not always and now_s - self._announced_s < MIN_ANNOUNCE_S):
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

    def _log(self, state: StreamState) -> None:
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
        values |= self._values(now_s)
        return Status(Level[state.severity.value], state.message, values)
