"""What the nodes share that run a goal on the arm: one goal at a time, its inputs and its end."""

from __future__ import annotations

import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Generic, TypeVar

from galen_model.arm.galen import JOINT_NAMES, SENSOR_FRAME
from galen_model.errors import GalenError, one_line
from geometry_msgs.msg import WrenchStamped
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from galen_ros.conversions import JointStateReader, stamp_to_ns, wrench_to_array
from galen_ros.goal.arm_link import DISCOVERY_S, ArmPublisher, PublisherWatch
from galen_ros.goal.commands import End, MoveTo, Stop
from galen_ros.goal.deferred_action import DeferredActionServer
from galen_ros.goal.parameters import MotionParameters
from galen_ros.goal.procedure import GoalProcedure
from galen_ros.node.diagnostics import ERROR, OK, WARN, DiagnosticsPublisher, Status
from galen_ros.parameters.declare import declare_parameters
from galen_ros.qos import STREAM

_TICK_S = 0.1
# The publishers of the topics are looked up this often.
_TICKS_PER_GRAPH_CHECK = 10
_LONGEST_NAME = 80


class RejectedGoalError(Exception):
    """A goal that can't be begun."""

    def __init__(self, code: IntEnum, message: str) -> None:
        super().__init__(message)
        self.code = code


ProcedureT = TypeVar("ProcedureT", bound=GoalProcedure[Any, Any])


class RunningGoal(Generic[ProcedureT]):
    """One running goal and what belongs to it alone."""

    def __init__(self, handle: ServerGoalHandle, procedure: ProcedureT) -> None:
        self.handle = handle
        self.procedure = procedure
        self.reader = JointStateReader(JOINT_NAMES)
        self.subscriptions: list[Subscription] = []
        self.publishers: PublisherWatch | None = None
        self.preflight_s: float | None = 0.0
        self.ticks = 0


@dataclass(frozen=True)
class Words:
    """How a node speaks of its goals."""

    subject: str
    """The field of the action's goal that names what it is about."""
    doing: str
    nothing_yet: str
    unit: str
    restarted: str
    shutting_down: str


SettingsT = TypeVar("SettingsT", bound=MotionParameters)
GoalT = TypeVar("GoalT", bound=RunningGoal[Any])
EndT = TypeVar("EndT", bound=End)


class GoalNode(Node, ABC, Generic[SettingsT, GoalT, EndT]):
    """Declares, converts and calls; what happens when is in the goal's procedure."""

    codes: ClassVar[type[IntEnum]]
    """The action's error codes, as the procedure's."""
    words: ClassVar[Words]

    def __init__(
        self,
        name: str,
        parameters: type[SettingsT],
        action_type: Any,
        action_name: str,
        **kwargs: Any,
    ) -> None:
        super().__init__(name, **kwargs)
        self._settings = declare_parameters(self, parameters)
        self._goal: GoalT | None = None
        self._over: list[GoalT] = []
        self._rejected = ""
        self._last = self.words.nothing_yet
        self._last_failed = False

        self._arm = ArmPublisher(self)
        self._server = DeferredActionServer(
            self,
            action_type,
            action_name,
            on_goal=self._on_goal,
            on_start=self._on_start,
            on_cancel=self._on_cancel,
        )
        # Each server of an action publishes this.
        status = f"{self.resolve_service_name(action_name)}/_action/status"
        self._servers = PublisherWatch(self, [status])
        self._other_server = ""
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._on_tick, clock=self._steady)
        self._diagnostics = DiagnosticsPublisher(self, "galen", self._report_status)

    def destroy_node(self) -> None:
        """Stop the arm if it is at work, then go."""
        goal, self._goal = self._goal, None
        if goal is not None:
            self.get_logger().warning(self.words.shutting_down)
            self._arm.stop_and_wait()
            canceled = self._make_end(self.codes["CANCELED"], "the node was shut down", goal)
            self._put_away(goal, canceled)
            goal.handle.abort()
        self._server.destroy()
        super().destroy_node()

    # ---- what a subclass says

    @abstractmethod
    def _make_goal(self, handle: ServerGoalHandle) -> GoalT:
        """Return the goal to run; raises RejectedGoalError."""

    @abstractmethod
    def _introduce(self, goal: GoalT) -> str:
        """Say in the log what begins."""

    @abstractmethod
    def _make_end(self, code: IntEnum, message: str, goal: GoalT | None) -> EndT:
        """Return an end that the procedure doesn't know of; `goal` is None where there was none."""

    @abstractmethod
    def _make_result(
        self, handle: ServerGoalHandle, end: EndT, goal: GoalT | None
    ) -> tuple[Any, str]:
        """Return the action's result, and a sentence for /diagnostics."""

    @abstractmethod
    def _folders(self) -> dict[str, object]:
        """Name the folders that it works in."""

    def _rejection(self, request: Any) -> str:
        """Say why this goal can't even begin; empty where it can."""
        return ""

    def _subscribe(self, goal: GoalT) -> list[Subscription]:
        topic = goal.procedure.wrench_topic
        return [
            self.create_subscription(JointState, "joint_states", self._on_joint_state, STREAM),
            self.create_subscription(WrenchStamped, topic, self._on_wrench, STREAM),
        ]

    def _also_watched(self) -> list[str]:
        """Name topics that it doesn't hear, and whose publishers matter all the same."""
        return []

    def _needed_clients(self, goal: GoalT) -> list[Client]:
        """Return the clients of the services that the goal can't do without."""
        return []

    def _silent_text(self, topics: list[str]) -> str:
        return f"nobody publishes {' and '.join(topics)}: is the driver running?"

    def _look_after(self, goal: GoalT) -> None:
        """Do what is to be done ten times a second."""

    def _put_away(self, goal: GoalT, end: EndT) -> EndT:
        """Close what the goal has open; returns the end that it came to."""
        return end

    def _status_values(self, goal: GoalT) -> dict[str, object]:
        """Return more values for /diagnostics."""
        return {}

    def _status_remark(self, goal: GoalT) -> str:
        """Return what /diagnostics says after the progress."""
        return ""

    # ---- the action

    def _on_goal(self, request: Any) -> GoalResponse:
        """Reject a second goal; an action's rejection carries no text, so /diagnostics does."""
        self._look_for_servers()
        why = self._other_server or self._busy_text() or self._rejection(request)
        if not why:
            return GoalResponse.ACCEPT
        self._rejected = (
            f"{self._named(request)} rejected: {why}" if self._subject(request) else why
        )
        self.get_logger().warning(self._rejected)
        self._diagnostics.publish_now()
        return GoalResponse.REJECT

    def _busy_text(self) -> str:
        if self._goal is None:
            return ""
        words = self.words
        done, total = self._goal.procedure.progress
        now = self._subject(self._goal.handle.request)
        return (
            f"{words.doing} {now!r} now,"
            f" {done} of {total} {words.unit} done; cancel that first, or wait"
        )

    def _look_for_servers(self) -> None:
        """Two servers of one action both take each goal: an error, from whichever starts second."""
        several = self._servers.several()
        if several:
            several = f"this action has more than one server: {several}; end one of them"
        if several and not self._other_server:
            self.get_logger().error(several)
        self._other_server = several

    def _on_start(self, handle: ServerGoalHandle) -> None:
        """Begin; a goal that makes no sense ends at once, for a result can say why."""
        try:
            goal = self._make_goal(handle)
        except RejectedGoalError as error:
            self._conclude(handle, self._make_end(error.code, str(error), None), None)
            return
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            self._conclude(handle, self._internal(error, None), None)
            return
        self._goal = goal
        self._rejected = ""
        goal.subscriptions = self._subscribe(goal)
        heard = [subscription.topic_name for subscription in goal.subscriptions]
        goal.publishers = PublisherWatch(self, [*heard, *self._also_watched()])
        name = self._subject(handle.request)
        self.get_logger().info(f"{self.words.doing} {name!r}: {self._introduce(goal)}")
        self._diagnostics.publish_now()

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        goal = self._goal
        if goal is None or goal.handle.goal_id != handle.goal_id:
            return CancelResponse.REJECT
        self.get_logger().info("canceled: stopping the arm")
        self._feed(goal.procedure.cancel)
        return CancelResponse.ACCEPT

    def _end(self, goal: GoalT, end: EndT) -> None:
        self._goal = None
        # Not here: this may run inside one of the subscriptions' own callbacks.
        self._over.append(goal)
        self._conclude(goal.handle, self._put_away(goal, end), goal)

    def _conclude(self, handle: ServerGoalHandle, end: EndT, goal: GoalT | None) -> None:
        """Give the goal its result and say it on /diagnostics and in the log."""
        result, self._last = self._make_result(handle, end, goal)
        self._server.finish(handle, result, success=end.error_code == self.codes["NONE"])
        self._last_failed = end.error_code not in (self.codes["NONE"], self.codes["CANCELED"])
        if self._last_failed:
            self.get_logger().error(self._last)
        else:
            self.get_logger().info(self._last)
        self._diagnostics.publish_now()

    def _internal(self, error: Exception, goal: GoalT | None) -> EndT:
        return self._make_end(self.codes["INTERNAL"], f"{type(error).__name__}: {error}", goal)

    def _subject(self, request: Any) -> str:
        return str(getattr(request, self.words.subject))

    def _named(self, request: Any) -> str:
        """The subject in quotes, for a log; a goal that is rejected may name it by a megabyte."""
        return one_line(repr(self._subject(request)), _LONGEST_NAME)

    # ---- inputs

    def _on_joint_state(self, message: JointState) -> None:
        goal = self._goal
        if goal is None:
            return
        try:
            position, velocity = goal.reader.read(message)
        except GalenError as error:
            self._feed(goal.procedure.fail, self.codes["BAD_INPUT"], f"joint_states: {error}")
            return
        self._feed(goal.procedure.on_joints, stamp_to_ns(message.header.stamp), position, velocity)

    def _on_wrench(self, message: WrenchStamped) -> None:
        goal = self._goal
        if goal is None:
            return
        if message.header.frame_id != SENSOR_FRAME:
            self._feed(
                goal.procedure.fail,
                self.codes["BAD_INPUT"],
                f"{goal.procedure.wrench_topic} has frame_id {message.header.frame_id!r}, not"
                f" {SENSOR_FRAME!r}",
            )
            return
        self._feed(
            goal.procedure.on_wrench, stamp_to_ns(message.header.stamp), wrench_to_array(message)
        )

    def _on_other_command(self, text: str) -> None:
        """End: two that command one arm are a danger, and no pose is where it was sent."""
        if self._goal is not None:
            self._look_for_servers()
            self._feed(
                self._goal.procedure.fail, self.codes["BAD_INPUT"], self._other_server or text
            )

    def _on_tick(self) -> None:
        for over in self._over:
            for subscription in over.subscriptions:
                self.destroy_subscription(subscription)
        self._over.clear()
        goal = self._goal
        if goal is None:
            return
        if goal.ticks % _TICKS_PER_GRAPH_CHECK == 0 or goal.preflight_s is not None:
            self._feed(self._check_publishers, goal)
        goal.ticks += 1
        if self._goal is goal and goal.preflight_s is not None:
            self._feed(self._check_driver, goal)
        if self._goal is goal:
            self._feed(self._look_after, goal)
        if self._goal is goal:
            self._feed(goal.procedure.on_wall, time.monotonic())

    # ---- the driver

    def _check_driver(self, goal: GoalT) -> None:
        """Start the procedure once everything it needs is there, or say what is missing."""
        missing = self._find_missing(goal)
        if goal.procedure.ending:
            return
        if missing is None:
            goal.preflight_s = None
            # Not before: this node's own subscription would count as somebody who listens.
            goal.subscriptions.append(self._arm.hear_others(self._on_other_command))
            goal.procedure.start()
            return
        assert goal.preflight_s is not None
        goal.preflight_s += _TICK_S
        if goal.preflight_s > max(self._settings.silent_timeout_s, DISCOVERY_S):
            goal.procedure.fail(*missing)

    def _find_missing(self, goal: GoalT) -> tuple[IntEnum, str] | None:
        assert goal.publishers is not None
        silent = goal.publishers.silent()
        if silent:
            return self.codes["DRIVER_SILENT"], self._silent_text(silent)
        absent = [
            self.resolve_service_name(client.srv_name)
            for client in self._needed_clients(goal)
            if not client.service_is_ready()
        ]
        if absent:
            return (
                self.codes["SERVICE_FAILED"],
                f"nobody offers the service {' and '.join(absent)}",
            )
        if not self._arm.has_listener:
            return (
                self.codes["DRIVER_SILENT"],
                f"nobody listens on {self._arm.topic_name}: is the driver running?",
            )
        return None

    def _check_publishers(self, goal: GoalT) -> None:
        """End when a topic has two publishers, or another than before."""
        assert goal.publishers is not None
        if several := goal.publishers.several():
            goal.procedure.fail(self.codes["BAD_INPUT"], several)
        elif changed := goal.publishers.changed():
            goal.procedure.fail(self.codes["DRIVER_SILENT"], f"{changed}: {self.words.restarted}")

    def _call(
        self, goal: GoalT, client: Client, request: Any, answered: Callable[[Any], None]
    ) -> None:
        """Call a service; its answer comes back while the goal runs, or not at all."""

        def on_answer(future: Any) -> None:
            if self._goal is goal:
                answered(future.result())

        client.call_async(request).add_done_callback(on_answer)

    # ---- commands

    def _feed(self, event: Callable[..., object], *args: object) -> None:
        """Hand an event to the procedure and do what it then asks for; a bug ends only the goal."""
        goal = self._goal
        try:
            event(*args)
            while goal is not None and (commands := goal.procedure.take_commands()):
                for command in commands:
                    self._obey(goal, command)
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            if goal is None or self._goal is not goal:
                return
            self._arm.stop()
            self._end(goal, self._internal(error, goal))

    def _obey(self, goal: GoalT, command: Any) -> None:
        """Do what each procedure asks for; a subclass does the rest."""
        match command:
            case MoveTo():
                self._arm.move(command)
            case Stop():
                self._arm.stop()
            case End():
                self._end(goal, command)  # type: ignore[arg-type]

    # ---- diagnostics

    def _report_status(self) -> Status:
        values = self._folders() | {"last": self._last}
        if self._rejected:
            values["rejected"] = self._rejected
        goal = self._goal
        self._look_for_servers()
        if self._other_server:
            level, state = (ERROR, "several_servers")
            return Status(level, self._other_server, {"state": state} | values)
        if goal is None:
            level, state = (WARN, "failed") if self._last_failed else (OK, "ready")
            return Status(level, f"ready; {self._last}", {"state": state} | values)
        words = self.words
        done, total = goal.procedure.progress
        name, state = self._subject(goal.handle.request), goal.procedure.state.name
        values |= {words.subject: name, "state": state, "done": done, "total": total}
        values |= self._status_values(goal)
        return Status(
            OK,
            f"{words.doing} {name}: {state}, {done} of {total} {words.unit}"
            f"{self._status_remark(goal)}",
            values,
        )
