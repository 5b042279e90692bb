# SPDX-License-Identifier: Apache-2.0
"""Nodes that run goals on the arm: one at a time over all their actions, its inputs and its end."""

from __future__ import annotations

import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
from galen_common.arm import ArmParameters, other_arm
from galen_common.cdr import JointStateError, JointWire, WrenchWire, joint_positions
from galen_common.goal.parameters import MotionParameters
from galen_common.goal.procedure import DISCOVERY_S, End, GoalProcedure, MoveTo, Stop
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.errors import GalenError, one_line
from geometry_msgs.msg import WrenchStamped
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from galen_ros.goal.arm_link import ArmPublisher, PublisherWatch
from galen_ros.messages import STREAM
from galen_ros.node.diagnostics import ERROR, OK, WARN, DiagnosticsPublisher, Status
from galen_ros.node.parameters import Held, declare_parameters
from galen_ros.node.robot_description import ArmSource
from galen_ros.rclpy_workarounds import BackgroundJobs, DeferredActionServer

_TICK_S = 0.1
_NEWEST_S = 0.1
# The publishers of the topics are looked up this often.
_TICKS_PER_GRAPH_CHECK = 10
_LONGEST_NAME = 80

T = TypeVar("T")


class RejectedGoalError(Exception):
    """A goal that can't be begun."""

    def __init__(self, code: IntEnum, message: str) -> None:
        super().__init__(message)
        self.code = code


class RunningGoal:
    """One running goal and what belongs to it alone; `warnings`: known from before it began."""

    def __init__(
        self,
        action: ArmAction,
        handle: ServerGoalHandle,
        procedure: GoalProcedure,
        warnings: Sequence[str] = (),
    ) -> None:
        self.action = action
        self.handle = handle
        self.procedure: Any = procedure
        self.warnings = list(warnings)
        self.joints = JointWire(action.node.arm.joint_names)
        self.wrenches = WrenchWire()
        self.subscriptions: list[Subscription] = []
        self.publishers: PublisherWatch | None = None
        self.exclusive: PublisherWatch | None = None
        """Of the topics that may have one publisher alone; joints of a gripper come beside."""
        self.joints_heard_s = time.monotonic()
        self.newest: tuple[Array, Array | None] | None = None
        """Joints and velocities (n,) as they came at `joints_heard_s`."""
        self.moved = False
        self.preflight_s: float | None = 0.0
        self.ticks = 0


class ArmAction(ABC):
    """One action; what happens when is in the goal's procedure, what all share in the node."""

    action_type: ClassVar[Any]
    name: ClassVar[str]
    codes: ClassVar[type[IntEnum]]
    """The action's error codes, as the procedure's."""
    subject: ClassVar[str] = "tool"
    """The field of the action's goal that names what it is about."""
    doing: ClassVar[str]
    unit: ClassVar[str]
    restarted: ClassVar[str]
    """What it means that a publisher is another one."""

    def __init__(self, node: GoalNode) -> None:
        self.node = node

    @abstractmethod
    def make_goal(self, handle: ServerGoalHandle) -> RunningGoal:
        """Return the goal to run.

        Args:
            handle: of the accepted goal, with its request.

        Returns:
            The goal with its procedure, not started.

        Raises:
            RejectedGoalError: the goal can't be begun.

        """

    @abstractmethod
    def introduce(self, goal: Any) -> str:
        """Describe in the log what begins.

        Args:
            goal: as `make_goal` made it.

        Returns:
            The end of the log's line.

        """

    @abstractmethod
    def make_end(self, code: IntEnum, message: str, goal: Any) -> End:
        """Return an end that the procedure doesn't know of.

        Args:
            code: one of `codes`.
            message: the error's sentence.
            goal: what has come of it goes into the end; None without one.

        Returns:
            The end, of the action's own kind.

        """

    @abstractmethod
    def make_result(self, handle: ServerGoalHandle, end: Any, goal: Any) -> tuple[Any, str]:
        """Return the action's result.

        Args:
            handle: of the goal, with its request.
            end: of the action's own kind.
            goal: as `make_goal` made it; None where it made none.

        Returns:
            The action's Result; a sentence for /diagnostics.

        """

    @abstractmethod
    def obey(self, goal: Any, command: Any) -> None:
        """Do what the procedure asks for, beside motion and its end.

        Args:
            goal: as `make_goal` made it.
            command: of the procedure, none of MoveTo, Stop and End.

        """

    def subject_of(self, request: Any) -> str:
        """Return what a goal is about.

        Args:
            request: the action's Goal.

        Returns:
            The field `subject`, not checked.

        """
        return str(getattr(request, self.subject))

    def rejection(self, request: Any) -> str:
        """Return why a goal can't even begin.

        Args:
            request: the action's Goal.

        Returns:
            A sentence; empty where it can.

        """
        return ""

    def subscribe(self, goal: Any) -> list[Subscription]:
        """Subscribe to what the goal hears.

        Args:
            goal: as `make_goal` made it.

        Returns:
            The subscriptions, which the node destroys after the goal.

        """
        node, topic = self.node, goal.procedure.wrench_topic
        return [
            node.create_subscription(
                JointState, "joint_states", node.on_joint_state, STREAM, raw=True
            ),
            node.create_subscription(WrenchStamped, topic, node.on_wrench, STREAM, raw=True),
        ]

    def also_watched(self) -> list[str]:
        """Name topics that it doesn't hear, and whose publishers matter all the same."""
        return []

    def needed_clients(self, goal: Any) -> list[Client]:
        """Return the clients of the services that the goal can't do without.

        Args:
            goal: as `make_goal` made it.

        Returns:
            The clients.

        """
        return []

    def find_missing(self, goal: Any) -> tuple[IntEnum, str] | None:
        """Return what the goal waits for beside topics, services and the arm.

        Args:
            goal: as `make_goal` made it.

        Returns:
            Code and sentence of the error that ends the goal if it stays missing; None: nothing.

        """
        return None

    def silent_text(self, topics: list[str]) -> str:
        """Return what is wrong where topics have no publisher.

        Args:
            topics: their names.

        Returns:
            The error's sentence.

        """
        return f"no publisher on {' and '.join(topics)}: is the driver running?"

    def look_after(self, goal: Any) -> None:  # noqa: B027 - most have nothing to do
        """Do what is to be done ten times a second.

        Args:
            goal: as `make_goal` made it.

        """

    def put_away(self, goal: Any, end: Any) -> Any:
        """Close what the goal has open.

        Args:
            goal: as `make_goal` made it.
            end: as the procedure made it.

        Returns:
            The end that it came to.

        """
        return end

    def status_values(self, goal: Any) -> dict[str, object]:
        """Return more values for /diagnostics.

        Args:
            goal: that runs.

        Returns:
            Values by name.

        """
        return {}

    def status_remark(self, goal: Any) -> str:
        """Return what /diagnostics adds to the progress.

        Args:
            goal: that runs.

        Returns:
            Text, which follows without a space; empty: nothing.

        """
        return ""


class GoalNode(Node):
    """Declares, converts and calls; what happens when is in the goal's procedure."""

    def __init__(
        self,
        name: str,
        parameters: type[MotionParameters],
        actions: Sequence[type[ArmAction]],
        **kwargs: Any,
    ) -> None:
        super().__init__(name, **kwargs)
        self.status_values: dict[str, object] = {}
        """What /diagnostics has beside the state; such as the folders that it works in."""
        self._goal: RunningGoal | None = None
        self._over: list[RunningGoal] = []
        self._rejected = self._closing = ""
        self._last = "no goal yet"
        self._last_failed = False
        self._unusable = ""
        """Why there is no arm to work with; empty where there is, or none came yet."""

        self._servers: dict[ArmAction, DeferredActionServer] = {}
        self._other_server = ""
        self._diagnostics = DiagnosticsPublisher(self, "galen", self._report_status)
        self._source = ArmSource(
            self,
            Held(self, ArmParameters),
            partial(self._on_description, parameters, actions),
            "start the node again to take it",
        )
        if self._source.waiting:
            self.get_logger().info(self._source.waiting)
        else:
            self._begin(self._source.take(), parameters, actions)

    def _on_description(
        self, parameters: type[MotionParameters], actions: Sequence[type[ArmAction]]
    ) -> None:
        if not self._servers:
            try:
                arm = self._source.take()
            except GalenError as error:
                self._unusable = str(error)
                self.get_logger().error(self._unusable)
            else:
                self._begin(arm, parameters, actions)
        self._diagnostics.publish_now()

    def _begin(
        self, arm: Arm, parameters: type[MotionParameters], actions: Sequence[type[ArmAction]]
    ) -> None:
        """Offer the actions, now that the arm is known."""
        self.arm = arm
        self.settings: Any = declare_parameters(self, parameters, arm=arm)
        self._set_up()
        self._background = BackgroundJobs(self)
        self._arm = ArmPublisher(self, self.arm, self._on_motion_failed)
        status = []
        for kind in actions:
            action = kind(self)
            self._servers[action] = DeferredActionServer(
                self,
                action.action_type,
                action.name,
                on_goal=partial(self._on_goal, action),
                on_start=partial(self._on_start, action),
                on_cancel=self._on_cancel,
            )
            # Each server of an action publishes this.
            status.append(f"{self.resolve_service_name(action.name)}/_action/status")
        self._status_topics = PublisherWatch(self, status)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._on_tick, clock=self._steady)

    def _set_up(self) -> None:
        """Do what a node needs beside its actions, once arm and settings are known."""

    @property
    def goal(self) -> RunningGoal | None:
        """The goal that runs."""
        return self._goal

    def destroy_node(self) -> None:
        """Stop the arm if a goal runs, then go."""
        goal, self._goal = self._goal, None
        if goal is not None:
            if goal.procedure.holds_arm:
                self.get_logger().warning("shutting down: stopping the arm")
                self._closing = "the node is shutting down"
                self._arm.stop_and_wait(self._rest(goal))
            action = goal.action
            canceled = action.make_end(action.codes["CANCELED"], "the node was shut down", goal)
            action.put_away(goal, canceled)
            goal.handle.abort()
        for server in self._servers.values():
            server.destroy()
        if self._servers:
            self._background.close()
        super().destroy_node()

    # ---- the action

    def _on_goal(self, action: ArmAction, request: Any) -> GoalResponse:
        """Reject a second goal; an action's rejection carries no text, so /diagnostics does."""
        self._look_for_servers()
        why = self._closing or self._other_server or self._busy_text() or action.rejection(request)
        if not why:
            return GoalResponse.ACCEPT
        subject = action.subject_of(request)
        self._rejected = f"{named(subject)} rejected: {why}" if subject else why
        self.get_logger().warning(self._rejected)
        self._diagnostics.publish_now()
        return GoalResponse.REJECT

    def _busy_text(self) -> str:
        if self._goal is None:
            return ""
        action = self._goal.action
        done, total = self._goal.procedure.progress
        now = action.subject_of(self._goal.handle.request)
        return (
            f"{action.doing} {now!r} now,"
            f" {done} of {total} {action.unit} done; cancel that first, or wait"
        )

    def _look_for_servers(self) -> None:
        """Two servers of one action both take each goal: an error, from whichever starts second."""
        several = self._status_topics.several()
        if several:
            several = f"this action has more than one server: {several}; end one of them"
        if several and not self._other_server:
            self.get_logger().error(several)
        self._other_server = several

    def _on_start(self, action: ArmAction, handle: ServerGoalHandle) -> None:
        """Begin; a goal that makes no sense ends at once, for a result can say why."""
        try:
            goal = action.make_goal(handle)
        except RejectedGoalError as error:
            end = action.make_end(error.code, str(error), None)
            self._conclude(action, handle, end, None)
            return
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            self._conclude(action, handle, _internal(action, error, None), None)
            return
        self._goal = goal
        self._rejected = ""
        goal.subscriptions = action.subscribe(goal)
        heard = [subscription.topic_name for subscription in goal.subscriptions]
        watched = [*heard, *action.also_watched()]
        goal.publishers = PublisherWatch(self, watched)
        joints = self.resolve_topic_name("joint_states")
        goal.exclusive = PublisherWatch(self, [topic for topic in watched if topic != joints])
        name = action.subject_of(handle.request)
        self.get_logger().info(f"{action.doing} {name!r}: {action.introduce(goal)}")
        self._diagnostics.publish_now()

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        goal = self._goal
        if goal is None or goal.handle.goal_id != handle.goal_id:
            return CancelResponse.REJECT
        stops = ": stopping the arm" if goal.procedure.holds_arm else ""
        self.get_logger().info(f"canceled{stops}")
        self.feed(goal.procedure.cancel)
        return CancelResponse.ACCEPT

    def _end(self, goal: RunningGoal, end: End) -> None:
        self._goal = None
        # Not here: this may run inside one of the subscriptions' own callbacks.
        self._over.append(goal)
        self._conclude(goal.action, goal.handle, goal.action.put_away(goal, end), goal)

    def _conclude(
        self, action: ArmAction, handle: ServerGoalHandle, end: End, goal: RunningGoal | None
    ) -> None:
        codes = action.codes
        result, self._last = action.make_result(handle, end, goal)
        self._servers[action].finish(handle, result, success=end.error_code == codes["NONE"])
        self._last_failed = end.error_code not in (codes["NONE"], codes["CANCELED"])
        if self._last_failed:
            self.get_logger().error(self._last)
        else:
            self.get_logger().info(self._last)
        self._diagnostics.publish_now()

    # ---- inputs

    def on_joint_state(self, data: bytes) -> None:
        """Hand a joint state to the goal.

        Args:
            data: the serialised message.

        """
        goal = self._goal
        if goal is None:
            return
        try:
            if not goal.moved:
                goal.procedure.beside |= joint_positions(data)
            stamp_ns, position, velocity = goal.joints.read_motion(data)
        except JointStateError as error:
            # Another node's joints, such as a gripper's, may come beside the arm's.
            if time.monotonic() - goal.joints_heard_s > self.settings.silent_timeout_s:
                self._fail(goal, "BAD_INPUT", f"joint_states: {error}{other_arm(self.arm)}")
            return
        except GalenError as error:
            self._fail(goal, "BAD_INPUT", f"joint_states: {error}")
            return
        goal.joints_heard_s = time.monotonic()
        joints, speed = np.array(position), None if velocity is None else np.array(velocity)
        goal.newest = joints, speed
        self.feed(goal.procedure.on_joints, stamp_ns, joints, speed)

    def on_wrench(self, data: bytes) -> None:
        """Hand a wrench to the goal.

        Args:
            data: the serialised message.

        """
        goal = self._goal
        if goal is None:
            return
        topic = goal.procedure.wrench_topic
        try:
            raw = goal.wrenches.read(data)
        except GalenError as error:
            self._fail(goal, "BAD_INPUT", f"{topic}: {error}")
            return
        if raw.frame_id != self.arm.sensor_frame:
            text = f"{topic} has frame_id {raw.frame_id!r}, not {self.arm.sensor_frame!r}"
            self._fail(goal, "BAD_INPUT", text)
            return
        self.feed(goal.procedure.on_wrench, raw.stamp_ns, np.array(raw.wrench))

    def _on_motion_failed(self, text: str) -> None:
        if self._goal is not None:
            self._fail(self._goal, "MOTION_TIMEOUT", text)

    def _on_other_command(self, text: str) -> None:
        """End: two that command one arm are a danger, and no pose is where it was sent."""
        if self._goal is not None and self._goal.procedure.needs_arm:
            self._look_for_servers()
            self._fail(self._goal, "BAD_INPUT", self._other_server or text)

    def _on_tick(self) -> None:
        for over in self._over:
            for subscription in over.subscriptions:
                self.destroy_subscription(subscription)
        self._over.clear()
        goal = self._goal
        if goal is None:
            return
        look = goal.ticks % _TICKS_PER_GRAPH_CHECK == 0 or goal.preflight_s is not None
        if look and goal.procedure.needs_arm:
            self.feed(self._check_publishers, goal)
        goal.ticks += 1
        if self._goal is goal and goal.preflight_s is not None:
            self.feed(self._check_driver, goal)
        if self._goal is goal:
            self.feed(goal.action.look_after, goal)
        if self._goal is goal:
            self.feed(goal.procedure.on_wall, time.monotonic())

    # ---- the driver

    def _check_driver(self, goal: RunningGoal) -> None:
        """Start the procedure once everything it needs is there, or say what is missing."""
        missing = self._find_missing(goal) or goal.action.find_missing(goal)
        if goal.procedure.ending:
            return
        if missing is None:
            goal.preflight_s = None
            # Not before: this node's own subscription would count as a listener.
            if goal.procedure.moves:
                goal.subscriptions.append(self._arm.hear_others(self._on_other_command))
            goal.procedure.start()
            return
        assert goal.preflight_s is not None
        goal.preflight_s += _TICK_S
        if goal.preflight_s > max(self.settings.silent_timeout_s, DISCOVERY_S):
            goal.procedure.fail(*missing)

    def _find_missing(self, goal: RunningGoal) -> tuple[IntEnum, str] | None:
        assert goal.publishers is not None
        action, codes = goal.action, goal.action.codes
        silent = goal.publishers.silent()
        if silent:
            return codes["DRIVER_SILENT"], action.silent_text(silent)
        absent = [
            self.resolve_service_name(client.srv_name)
            for client in action.needed_clients(goal)
            if not client.service_is_ready()
        ]
        if absent:
            return codes["SERVICE_FAILED"], f"no server of the service {' and '.join(absent)}"
        if goal.procedure.moves and not self._arm.has_listener:
            return (
                codes["DRIVER_SILENT"],
                f"no subscriber on {self._arm.topic_name}: is the driver running?",
            )
        return None

    def _check_publishers(self, goal: RunningGoal) -> None:
        """End when a topic has two publishers, or another than before."""
        assert goal.exclusive is not None
        if several := goal.exclusive.several():
            goal.procedure.fail(goal.action.codes["BAD_INPUT"], several)
        elif changed := goal.exclusive.changed():
            action = goal.action
            goal.procedure.fail(action.codes["DRIVER_SILENT"], f"{changed}: {action.restarted}")

    def call(
        self, goal: RunningGoal, client: Client, request: Any, answered: Callable[[Any], None]
    ) -> None:
        """Call a service; its answer comes back while the goal runs, or not at all.

        Args:
            goal: that the call is for.
            client: of the service.
            request: the service's Request.
            answered: called with the Response, in the executor's thread.

        """

        def on_answer(future: Any) -> None:
            if self._goal is goal:
                answered(future.result())

        client.call_async(request).add_done_callback(on_answer)

    def work(self, goal: RunningGoal, job: Callable[[], T], done: Callable[[T], None]) -> None:
        """Run a job in a thread beside the executor.

        Nothing is done with the result of a goal that is over; an exception ends the goal.

        Args:
            goal: that the job is for.
            job: runs in the thread.
            done: called with the job's result in the executor's thread.

        """

        def attempt() -> Callable[[], None]:
            try:
                return partial(done, job())
            except Exception as error:
                return partial(_raise, error)

        def take(end: Callable[[], None]) -> None:
            if self._goal is goal:
                self.feed(end)

        self._background.submit(attempt, take, lambda: None)

    # ---- commands

    def _fail(self, goal: RunningGoal, code: str, message: str) -> None:
        self.feed(goal.procedure.fail, goal.action.codes[code], message)

    def feed(self, event: Callable[..., object], *args: object) -> None:
        """Hand an event to the procedure and do what it then asks for; a bug ends only the goal.

        Args:
            event: a method of the procedure or the action.
            *args: its arguments.

        """
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
            if goal.procedure.holds_arm:
                self._arm.stop(self._rest(goal))
            self._end(goal, _internal(goal.action, error, goal))

    def _obey(self, goal: RunningGoal, command: Any) -> None:
        match command:
            case MoveTo():
                goal.moved = True
                self._arm.move(command)
            case Stop():
                self._arm.stop(self._rest(goal))
            case End():
                self._end(goal, command)
            case _:
                goal.action.obey(goal, command)

    def _rest(self, goal: RunningGoal) -> MoveTo | None:
        """Where the arm comes to rest if it brakes now; None where unknown, or it wasn't sent."""
        if goal.newest is None or not goal.moved:
            return None
        joints, velocity = goal.newest
        # An arm must not be sent back to where it was when its driver fell silent.
        silent_s = time.monotonic() - goal.joints_heard_s
        if silent_s > _NEWEST_S or not np.all(np.isfinite(joints)):
            return None
        return MoveTo(*self.settings.braking(joints, velocity))

    # ---- diagnostics

    def _report_status(self) -> Status:
        if not self._servers:
            text = self._unusable or self._source.waiting
            return Status(ERROR if self._unusable else WARN, text, {"state": "waiting"})
        values = self.status_values | {"last": self._last}
        if self._rejected:
            values["rejected"] = self._rejected
        goal = self._goal
        self._look_for_servers()
        if self._other_server:
            level, state = (ERROR, "several_servers")
            return Status(level, self._other_server, {"state": state} | values)
        if goal is None:
            level, state = (WARN, "failed") if self._last_failed else (OK, "ready")
            trouble = self._source.trouble
            text = f"{trouble}; {self._last}" if trouble else f"ready; {self._last}"
            return Status(WARN if trouble else level, text, {"state": state} | values)
        action = goal.action
        done, total = goal.procedure.progress
        name, state = action.subject_of(goal.handle.request), goal.procedure.state.name
        values |= {action.subject: name, "state": state, "done": done, "total": total}
        values |= action.status_values(goal)
        return Status(
            OK,
            f"{action.doing} {name}: {state}, {done} of {total} {action.unit}"
            f"{action.status_remark(goal)}",
            values,
        )


def _raise(error: Exception) -> None:
    raise error


def _internal(action: ArmAction, error: Exception, goal: RunningGoal | None) -> End:
    return action.make_end(action.codes["INTERNAL"], f"{type(error).__name__}: {error}", goal)


def named(subject: str) -> str:
    """Return a goal's subject in quotes, for a log.

    Args:
        subject: as the client sent it; it may be a megabyte long.

    Returns:
        One line, shortened.

    """
    return one_line(repr(subject), _LONGEST_NAME)
