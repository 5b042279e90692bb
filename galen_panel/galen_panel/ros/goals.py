# SPDX-License-Identifier: Apache-2.0
"""Follow the goals of one action: the panel's own and those of other clients.

rclpy's ActionClient follows only goals that it sent itself. An action is three services and two
topics (REP design "Actions"), so here they are used as such: a goal id that comes by on the topics
of status or feedback is taken over, its result asked for and its cancelling, as if it were ours.
"""

from __future__ import annotations

import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from action_msgs.msg import GoalStatus
from galen_model.errors import one_line
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_action_status_default
from unique_identifier_msgs.msg import UUID

from galen_panel.ros.board import Board, Presence
from galen_panel.ros.goal_kinds import GoalKind, rejected_pose
from galen_panel.ros.thread import CallError, Calls, Reply, RosThread
from galen_panel.state.snapshot import (
    LOST,
    Asked,
    Behaviour,
    BehaviourKind,
    BehaviourOutcome,
    CallAnswer,
    Goal,
    NodeReport,
)

_SEND_LIMIT_S, _CANCEL_LIMIT_S = 5.0, 5.0
_LOST_S = 1.5
"""So long a server may be out of sight before its goal is given up.

Only discovery counts, which takes some 20 s where a process was killed: a node that says nothing
may be well, on a machine that is too busy.
"""
_ASK_AGAIN_S = 2.0
_REJECTAL_PATIENCE_S = 2.5
_LOOK_PERIOD_S = 0.5
_ACTIVE = (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING, GoalStatus.STATUS_CANCELING)


@dataclass(eq=False)
class _Followed:
    """The goal under way; `goal` is None where another client sent it.

    over: by its status, the result is still to come. lost: its server is out of sight.
    """

    goal_id: bytes
    goal: Goal | None
    behaviour: Behaviour
    new: bool
    began_s: float
    stop_asking: Callable[[], None] = lambda: None
    asked_s: float | None = None
    over: bool = False
    gone_s: float | None = None
    lost: bool = False


@dataclass(frozen=True)
class _Rejection:
    """A rejected goal; the reason comes on /diagnostics in a moment."""

    reply: Reply[CallAnswer]
    sent_s: float
    deadline_s: float


class GoalFollower:
    """One action: `start` and `cancel` are for the event loop, all else for the ROS thread."""

    def __init__(
        self,
        node: Node,
        kind: GoalKind,
        board: Board,
        thread: RosThread,
        calls: Calls,
        presence: Presence,
        numbers: Iterator[int],
        on_end: Callable[[], None],
    ) -> None:
        """Make the action's clients and subscriptions.

        Args:
            node: that has them.
            kind: the action.
            board: where the behaviour is shown.
            thread: of the node.
            calls: where what waits for an answer is kept.
            presence: looks whether the action's server is there.
            numbers: of all behaviours.
            on_end: called when a goal has ended or is lost.

        """
        self._kind = kind
        self._board = board
        self._thread = thread
        self._calls = calls
        self._numbers = numbers
        self._on_end = on_end
        self._followed: _Followed | None = None
        # Sent, and not heard of yet.
        self._ours: dict[bytes, Goal] = {}
        # Their last word on the topics may come after their result.
        self._ended: deque[bytes] = deque(maxlen=100)
        self._rejections: list[_Rejection] = []
        self._next_look_s = 0.0
        self._impl = impl = kind.action_type.Impl
        action = f"{kind.kind.value}/_action"
        self._send = node.create_client(impl.SendGoalService, f"{action}/send_goal")
        self._get_result = node.create_client(impl.GetResultService, f"{action}/get_result")
        self._cancel = node.create_client(impl.CancelGoalService, f"{action}/cancel_goal")
        self._clients = (self._send, self._get_result, self._cancel)
        presence.add(kind.kind.value, *self._clients)
        node.create_subscription(
            impl.FeedbackMessage, f"{action}/feedback", self._on_feedback, QoSProfile(depth=100)
        )
        node.create_subscription(
            impl.GoalStatusMessage,
            f"{action}/status",
            self._on_status,
            qos_profile_action_status_default,
        )

    # ---- what the page asks for

    async def start(self, goal: Goal) -> CallAnswer:
        """Send a goal.

        Args:
            goal: of the follower's kind.

        Returns:
            Whether the goal was accepted, and a sentence.

        Raises:
            CallError: the server is absent, or the goal can't be sent so.
            ToolNameError: a name can't be a file's.

        """
        request = self._kind.request(goal)
        return await self._thread.ask(lambda reply: self._send_goal(goal, request, reply))

    async def cancel(self) -> CallAnswer:
        """Cancel the goal under way.

        Returns:
            Whether it is being canceled, and a sentence.

        Raises:
            CallError: the server is absent, or does not answer.

        """
        return await self._thread.ask(self._cancel_followed)

    def _send_goal(self, goal: Goal, request: Any, reply: Reply[CallAnswer]) -> None:
        kind, sent_s = self._kind, time.monotonic()
        if not self._send.service_is_ready():
            raise CallError(kind.program.absent(self._board.state))
        goal_id = uuid.uuid4().bytes
        self._ours[goal_id] = goal

        def done(answer: Any) -> None:
            if isinstance(answer, CallError):
                self._take_back(goal_id, str(answer), reply)
            elif answer.accepted:
                self._begin(goal_id)
                reply.give(CallAnswer(True, kind.begun(goal)))
            else:
                self._ours.pop(goal_id, None)
                now_s = time.monotonic()
                rejection = _Rejection(reply, sent_s, now_s + _REJECTAL_PATIENCE_S)
                self._rejections.append(rejection)
                self._tell_rejections(now_s)

        message = self._impl.SendGoalService.Request(goal_id=UUID(uuid=list(goal_id)), goal=request)
        self._calls.send(self._send, message, kind.program, _SEND_LIMIT_S, done)

    def _take_back(self, goal_id: bytes, why: str, reply: Reply[CallAnswer]) -> None:
        """Cancel a goal without an answer: it may have begun, and only the answer be lost."""

        def done(answer: Any) -> None:
            if isinstance(answer, CallError):
                text = "whether it has begun is not known"
            elif answer.goals_canceling:
                text = "it had begun, and is canceled"
            else:
                text = "it has not begun"
            reply.give(CallAnswer(False, f"{why}; {text}"))

        self._send_cancel(goal_id, done)

    def _cancel_followed(self, reply: Reply[CallAnswer]) -> None:
        followed = self._followed
        if followed is None or followed.lost:
            reply.give(CallAnswer(False, "nothing is running: there is nothing to cancel"))
            return

        def done(answer: Any) -> None:
            if isinstance(answer, CallError):
                reply.fail(answer)
            elif answer.goals_canceling:
                if self._followed is followed:
                    self._show(followed, canceling=True)
                reply.give(CallAnswer(True, "canceling: the arm stops"))
            else:
                reply.give(CallAnswer(False, "it had just ended: there is nothing to cancel"))

        self._send_cancel(followed.goal_id, done)

    def _send_cancel(self, goal_id: bytes, done: Callable[[Any], None]) -> None:
        request = self._impl.CancelGoalService.Request()
        request.goal_info.goal_id.uuid = list(goal_id)
        self._calls.send(self._cancel, request, self._kind.program, _CANCEL_LIMIT_S, done)

    def _tell_rejections(self, now_s: float) -> None:
        """Answer rejected goals: the reason is not in the action but on /diagnostics."""
        report = self._report
        for rejection in list(self._rejections):
            said = report is not None and report.heard_s >= rejection.sent_s
            if report is not None and said and "rejected" in report.values:
                text = report.values["rejected"]
            elif now_s > rejection.deadline_s:
                text = f"{self._kind.program.executable} rejected it; see its log"
            else:
                continue
            self._rejections.remove(rejection)
            rejection.reply.give(CallAnswer(False, text))

    # ---- the goal under way

    def _begin(self, goal_id: bytes) -> None:
        """Follow a goal from now on; of another one before it no more is to be heard."""
        # Also where its acceptance is the last that comes of it.
        if goal_id in self._ended:
            return
        followed = self._followed
        if followed is not None and followed.goal_id == goal_id:
            if followed.lost:
                followed.lost = False
                self._show(followed, outcome=None)
            return
        if followed is not None:
            self._forget(followed)
        goal = self._ours.pop(goal_id, None)
        active_tool = self._board.state.active_tool
        tool = ""
        if goal is not None:
            tool = goal.tool or ("" if active_tool is None else active_tool.tool)
        self._followed = followed = _Followed(
            goal_id,
            goal,
            Behaviour(next(self._numbers), self._kind.kind, tool, ours=goal is not None),
            self._is_new(tool),
            began_s=time.monotonic(),
        )
        self._show(followed)
        self._ask_result(followed)

    def _is_new(self, tool: str) -> bool:
        tools = self._board.state.tools
        known = self._kind.kind is BehaviourKind.CALIBRATE and bool(tool) and tools is not None
        return known and tool not in (one.name for one in tools or ())

    def _show(self, followed: _Followed, **changes: Any) -> None:
        followed.behaviour = replace(followed.behaviour, **changes)
        self._board.put_behaviour(followed.behaviour)

    def _forget(self, followed: _Followed) -> None:
        followed.stop_asking()
        self._ended.append(followed.goal_id)
        self._followed = None

    def _end(self, followed: _Followed, outcome: BehaviourOutcome) -> None:
        self._forget(followed)
        self._show(followed, outcome=outcome, asked=None)
        self._on_end()

    def _lose(self, followed: _Followed) -> None:
        """Show it as lost, but listen on: its server may only have been out of sight."""
        if followed.lost:
            return
        followed.lost = True
        outcome = BehaviourOutcome(LOST, self._kind.gone, followed.behaviour.tool, new=followed.new)
        self._show(followed, outcome=outcome, asked=None)
        self._on_end()

    def _ask_result(self, followed: _Followed) -> None:
        followed.stop_asking()
        if not self._get_result.service_is_ready():
            return  # asked when it is; or the goal is lost
        followed.asked_s = time.monotonic()
        request = self._impl.GetResultService.Request(goal_id=UUID(uuid=list(followed.goal_id)))
        followed.stop_asking = self._calls.send(
            self._get_result,
            request,
            self._kind.program,
            None,
            lambda answer: self._on_result(followed, answer),
        )

    def _on_result(self, followed: _Followed, answer: Any) -> None:
        if followed is not self._followed or isinstance(answer, CallError):
            return
        if answer.status == GoalStatus.STATUS_UNKNOWN:  # a server that was started since
            self._lose(followed)
            return
        tool = followed.behaviour.tool or getattr(answer.result, "tool", "")
        self._end(followed, self._kind.outcome(answer.result, tool, followed.new))

    def tick(self, now_s: float) -> None:
        """Look whether the server is still there, and ask again for a result that is overdue.

        Args:
            now_s: time.monotonic(), s.

        """
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + _LOOK_PERIOD_S
        self._tell_rejections(now_s)
        followed = self._followed
        if followed is None:
            return
        if not all(client.service_is_ready() for client in self._clients):
            followed.gone_s = followed.gone_s or now_s
            if now_s - followed.gone_s > _LOST_S:
                self._lose(followed)
            return
        back, followed.gone_s = followed.gone_s is not None, None
        overdue = not followed.lost and (followed.over or self._idle_since(followed.began_s))
        asked_s = followed.asked_s
        if asked_s is None or back or (overdue and now_s - asked_s > _ASK_AGAIN_S):
            self._ask_result(followed)

    # ---- topics

    def _on_status(self, message: Any) -> None:
        for one in message.status_list:
            goal_id = bytes(one.goal_info.goal_id.uuid)
            if one.status in _ACTIVE:
                self._begin(goal_id)
            followed = self._followed
            if followed is not None and goal_id == followed.goal_id:
                followed.over = one.status not in _ACTIVE
                if one.status == GoalStatus.STATUS_CANCELING:
                    self._show(followed, canceling=True)

    def _on_feedback(self, message: Any) -> None:
        goal_id = bytes(message.goal_id.uuid)
        if goal_id in self._ended:
            return
        self._begin(goal_id)
        followed = self._followed
        assert followed is not None
        feedback, behaviour = message.feedback, followed.behaviour
        state_name = self._kind.state_name(feedback.state)
        phase = self._kind.phase_text(state_name)
        asked = behaviour.asked if phase == behaviour.phase else None
        if followed.goal is not None and (followed.goal.by_hand or followed.goal.hand_guided):
            asked = self._kind.asked(state_name)
        rejected = rejected_pose(feedback)
        self._show(
            followed,
            phase=phase,
            message=one_line(feedback.message),
            done=feedback.done,
            total=feedback.total,
            rejected=(*behaviour.rejected[-99:], rejected) if rejected else behaviour.rejected,
            asked=asked,
        )

    # ---- the server's node on /diagnostics

    @property
    def _report(self) -> NodeReport | None:
        return self._board.state.report_of(self._kind.program.node)

    def _idle_since(self, since_s: float) -> bool:
        """Whether the node has reported since that it has no goal."""
        report = self._report
        return report is not None and report.heard_s > since_s + 1.0 and not _active(report)

    def on_report(self, report: NodeReport) -> None:
        """Take a node's report.

        Args:
            report: any node's; it is on the board already.

        """
        if report.name != self._board.state.full_name(self._kind.program.node):
            return
        self._tell_rejections(report.heard_s)
        if self._followed is not None and not self._followed.lost:
            self._take_report(self._followed, report)

    def _take_report(self, followed: _Followed, report: NodeReport) -> None:
        """Learn of another client's goal what its feedback lacks, or held before."""
        if not _active(report) or followed.behaviour.ours:
            return
        values, behaviour = report.values, followed.behaviour
        changes: dict[str, Any] = {}
        if not behaviour.tool and values.get("tool"):
            changes["tool"] = values["tool"]
            followed.new = self._is_new(values["tool"])
        state = values.get("state", "")
        if not behaviour.total:
            changes["phase"] = self._kind.phase_text(state)
            changes["done"], changes["total"] = _count(values["done"]), _count(values["total"])
        asked: Asked | None = None
        if values.get("waits_for_person") == "true":
            asked = self._kind.asked(state)
        self._show(followed, asked=asked, **changes)


def _active(report: NodeReport) -> bool:
    return "done" in report.values and "total" in report.values


def _count(text: str) -> int:
    return int(text) if text.isdecimal() and len(text) < 10 else 0
