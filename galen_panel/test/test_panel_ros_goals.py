# SPDX-License-Identifier: Apache-2.0
"""Behaviours over ROS: goals of the panel and of anybody, on a server that does as it is told."""

import math
import threading

import pytest
from galen_calibration_behavior.common.commands import CalibrationCode as ErrorCode
from galen_calibration_behavior.common.commands import CalibrationState as Phase
from galen_panel.ros import goals as ros_goals
from galen_panel.state.snapshot import BehaviourKind, Goal
from galen_ros.node.diagnostics import OK, DiagnosticsPublisher, Status
from galen_ros.rclpy_workarounds import DeferredActionServer
from panel_ros_world import World
from rclpy.action import ActionClient, CancelResponse, GoalResponse
from rclpy.node import Node
from std_srvs.srv import Trigger

from galen_msgs.action import CalibrateTool


def calibrate(tool, **options):
    return Goal(BehaviourKind.CALIBRATE, tool, **options)


class Server(Node):
    """`calibrate_tool` as calibration_node has it, without an arm."""

    def __init__(self, context, **_):
        super().__init__("calibration", context=context)
        self.goal = None
        self.answers = threading.Event()
        self.answers.set()
        self.canceled = []
        self.confirmed = 0
        self.rejected = ""
        self.person = False
        self.values = {}
        self.server = DeferredActionServer(
            self, CalibrateTool, "calibrate_tool", self.on_goal, self.on_start, self.on_cancel
        )
        self.create_service(Trigger, "~/confirm", self.on_confirm)
        self.diagnostics = DiagnosticsPublisher(self, "galen", self.report, 0.2)

    def destroy_node(self):
        if self.goal is not None:
            self.goal.abort()
        self.server.destroy()
        super().destroy_node()

    def on_goal(self, request):
        self.answers.wait(20.0)
        if self.goal is None:
            return GoalResponse.ACCEPT
        self.rejected = f"'{request.tool}' rejected: calibrating {self.goal.request.tool!r} now"
        self.diagnostics.publish_now()
        return GoalResponse.REJECT

    def on_start(self, handle):
        self.goal, self.rejected = handle, ""

    def on_cancel(self, handle):
        self.canceled.append(bytes(handle.goal_id.uuid))
        return CancelResponse.ACCEPT

    def on_confirm(self, _request, response):
        self.confirmed += 1
        response.success, response.message = self.person, "" if self.person else "nobody was asked"
        return response

    def say(self, state, **fields):
        nothing = {"wrench": [math.nan] * 6, "total": 4}
        fields = nothing | {"message": state.name.lower()} | fields
        self.goal.publish_feedback(CalibrateTool.Feedback(state=int(state), **fields))

    def pose(self, done, roll, *, accepted=True, message="recorded"):
        self.say(
            Phase.SWEEP_TOOL, pose=done, done=done, angles=[roll, 0.1], accepted=accepted,
            wrench=[1.0] * 6 if accepted else [math.nan] * 6, message=message,
        )  # fmt: skip

    def end(self, code=ErrorCode.NONE, message="", **fields):
        handle, self.goal = self.goal, None
        result = CalibrateTool.Result(
            error_code=int(code), error_msg=message, tool=handle.request.tool, **fields
        )
        self.server.finish(handle, result, code is ErrorCode.NONE)

    def report(self):
        values = {"rejected": self.rejected} if self.rejected else {}
        if self.goal is None:
            return Status(OK, "ready", values)
        values |= {"tool": self.goal.request.tool, "done": 1, "total": 4}
        values |= {"state": "ATTACH_TOOL", "waits_for_person": self.person}
        return Status(OK, "calibrating", values)


class Goals(World):
    """The suite, the server and what is seen of a calibration."""

    def __init__(self, world):
        super().__init__(world.harness, world.suite)
        self.start_server()

    def start_server(self):
        self.server = self.add(Server)
        self.wait_for_service("calibrate_tool")

    def do(self, job):
        """Run in the executor's thread, as the server's own callbacks do."""
        return self.harness.call_in_executor(job)

    @property
    def behaviour(self):
        return self.state.behaviours.get(BehaviourKind.CALIBRATE)

    def seen(self, what, predicate):
        return self.harness.wait_for(
            lambda: self.behaviour and predicate(self.behaviour), 10.0, what
        )

    def send_as_another(self, tool="pointer"):
        """A goal of somebody else's, such as the command `calibrate`."""
        node = self.harness.add(lambda context: Node("somebody", context=context))
        client = ActionClient(node, CalibrateTool, "calibrate_tool")
        self.harness.wait_for(client.server_is_ready, 10.0, "the action server")
        goal = CalibrateTool.Goal(tool=tool, tip_m=[math.nan] * 3)
        return self.harness.answer_of(
            lambda: client.send_goal_async(goal), 10.0, "an answer to the goal"
        )


@pytest.fixture
def goals(world):
    return Goals(world)


def test_a_goal_is_followed_from_pose_to_pose_to_its_result(goals):
    answer = goals.ask(goals.suite.start(calibrate("pointer", tip_m=(0.1, 0.0, 0.05))))
    assert answer.ok and "pointer" in answer.text
    request = goals.server.goal.request
    assert request.attach_by_service and list(request.tip_m) == [0.1, 0.0, 0.05]
    behaviour = goals.behaviour
    assert behaviour.running and behaviour.ours and behaviour.tool == "pointer"

    goals.do(lambda: goals.server.say(Phase.ZERO))
    goals.seen("zeroing", lambda b: b.phase == "zeroing" and b.total == 4)
    goals.do(lambda: goals.server.pose(1, 0.1))
    goals.do(lambda: goals.server.pose(1, 0.2, accepted=False, message="tool/1: moved"))
    goals.do(lambda: goals.server.pose(2, 0.3))
    behaviour = goals.seen("two poses", lambda b: b.done == 2 and b)
    assert behaviour.phase == "sweep with tool" and behaviour.rejected == ("tool/1: moved",)

    goals.do(
        lambda: goals.server.end(
            mass_kg=0.0601, mass_std_kg=3e-5, poses_used=4, file="pointer.json",
            warnings=["odd"],
        )
    )  # fmt: skip
    outcome = goals.seen("the end", lambda b: b.outcome)
    assert not outcome.error and "pointer is calibrated: 60.10 ± 0.03 g; 4 poses" in outcome.text
    assert (outcome.file, outcome.tool) == ("pointer.json", "pointer")
    assert outcome.warnings == ("odd",)
    assert outcome.values["mass_kg"] == 0.0601 and outcome.values["poses_used"] == 4


def test_a_cancel_stops_the_panel_s_own_goal(goals):
    goals.ask(goals.suite.start(calibrate("pointer")))
    answer = goals.ask(goals.suite.cancel(BehaviourKind.CALIBRATE))
    assert answer.ok and goals.behaviour.canceling
    assert goals.server.canceled == [bytes(goals.server.goal.goal_id.uuid)]
    goals.do(lambda: goals.server.end(ErrorCode.CANCELED, "canceled by the client"))
    outcome = goals.seen("the end", lambda b: b.outcome)
    assert outcome.error == "CANCELED" and "canceled by the client" in outcome.text
    answer = goals.ask(goals.suite.cancel(BehaviourKind.CALIBRATE))
    assert not answer.ok and "nothing is running" in answer.text
    first = goals.behaviour.number
    goals.ask(goals.suite.start(calibrate("retractor")))
    assert goals.behaviour.running and goals.behaviour.number > first


def test_a_goal_is_rejected_with_the_node_s_reason(goals):
    goals.ask(goals.suite.start(calibrate("pointer")))
    answer = goals.ask(goals.suite.start(calibrate("retractor")))
    assert not answer.ok and answer.text == "'retractor' rejected: calibrating 'pointer' now"
    # It is the first one that goes on, and not hurt.
    assert goals.behaviour.running and goals.behaviour.tool == "pointer"
    assert goals.behaviour.ours


def test_a_goal_that_makes_no_sense_is_not_sent(goals):
    answer = goals.ask(goals.suite.start(calibrate("../pointer")))
    assert not answer.ok and "../pointer" in answer.text
    assert goals.server.goal is None and goals.behaviour is None


def test_a_goal_that_ends_at_once_has_ended(goals):
    """Its acceptance and its result cross on the way, in either order."""
    start = goals.server.on_start

    def on_start(handle):
        start(handle)
        goals.server.end(ErrorCode.BAD_INPUT, "no such pose")

    goals.server.server._on_start = on_start
    numbers = set()
    for _ in range(10):
        assert goals.ask(goals.suite.start(calibrate("pointer"))).ok
        outcome = goals.seen("the end", lambda b: b.outcome if b.number not in numbers else None)
        assert outcome.error == "BAD_INPUT"
        numbers.add(goals.behaviour.number)


def test_a_goal_of_somebody_else_is_shown_asks_a_person_and_can_be_canceled(goals):
    goals.server.person = True
    theirs = goals.send_as_another()
    goals.seen("their goal", lambda b: b.tool == "pointer" and b.total == 4)
    behaviour = goals.behaviour
    assert not behaviour.ours and behaviour.running
    assert (behaviour.phase, behaviour.done) == ("tool on", 1)  # from /diagnostics
    goals.seen("the question", lambda b: b.asked == "ATTACH_TOOL")
    goals.server.person = False
    goals.seen("its answer", lambda b: b.asked is None)
    goals.do(lambda: goals.server.pose(2, 0.1))
    goals.seen("its pose", lambda b: b.done == 2 and b.phase == "sweep with tool")
    assert goals.ask(goals.suite.cancel(BehaviourKind.CALIBRATE)).ok
    assert goals.server.canceled == [bytes(theirs.goal_id.uuid)]
    goals.do(lambda: goals.server.end(ErrorCode.CANCELED, "canceled by the client"))
    goals.seen("its end", lambda b: b.outcome and b.outcome.error == "CANCELED")


def test_a_person_is_asked_and_answers(goals):
    goals.ask(goals.suite.start(calibrate("pointer", by_hand=True)))
    assert not goals.server.goal.request.attach_by_service
    answer = goals.ask(goals.suite.confirm())
    assert not answer.ok and answer.text == "nobody was asked"
    goals.server.person = True
    goals.do(lambda: goals.server.say(Phase.REMOVE_TOOL))
    goals.seen("the question", lambda b: b.asked == "REMOVE_TOOL")
    assert goals.ask(goals.suite.confirm()).ok and goals.server.confirmed == 2
    goals.do(lambda: goals.server.say(Phase.ZERO))
    goals.seen("the next step", lambda b: b.asked is None)


def test_a_server_that_goes_away_takes_its_goal_with_it(goals):
    goals.ask(goals.suite.start(calibrate("pointer")))
    goals.harness.remove(goals.server)
    outcome = goals.seen("the loss", lambda b: b.outcome)
    assert outcome.error == "LOST" and "calibration_node went away" in outcome.text
    assert "nothing was written" in outcome.text
    goals.wait_for(lambda state: "calibrate_tool" not in state.available, "that it is gone")
    answer = goals.ask(goals.suite.start(calibrate("pointer")))
    assert not answer.ok and "ros2 run galen_calibration_behavior" in answer.text
    goals.start_server()
    assert goals.ask(goals.suite.start(calibrate("pointer"))).ok
    assert goals.behaviour.running


def test_a_server_that_was_restarted_unseen_doesn_t_know_the_goal(goals, monkeypatch):
    monkeypatch.setattr(ros_goals, "_LOST_S", 60.0)
    goals.ask(goals.suite.start(calibrate("pointer")))
    goals.harness.remove(goals.server)
    goals.start_server()
    outcome = goals.seen("the loss", lambda b: b.outcome)
    assert outcome.error == "LOST"


class OutOfSight:
    """In place of a client whose server discovery has lost."""

    def service_is_ready(self):
        return False


def test_a_goal_that_was_out_of_sight_is_followed_again(goals):
    """A machine that stood still, or a network: discovery gives up what is still there."""
    goals.ask(goals.suite.start(calibrate("pointer")))
    goals.do(lambda: goals.server.pose(1, 0.1))
    goals.seen("a pose", lambda b: b.done == 1)
    number = goals.behaviour.number
    follower = goals.suite._followers[BehaviourKind.CALIBRATE]
    in_sight = follower._clients
    follower._clients = (OutOfSight(),)
    goals.seen("the loss", lambda b: b.outcome and b.outcome.error == "LOST")
    follower._clients = in_sight
    goals.do(lambda: goals.server.pose(2, 0.2))
    goals.seen("the goal again", lambda b: b.running and b.ours and b.done == 2)
    assert goals.behaviour.number == number
    goals.do(goals.server.end)
    goals.seen("its end", lambda b: b.outcome and not b.outcome.error)


def test_a_goal_whose_answer_is_late_is_taken_back(goals, monkeypatch):
    monkeypatch.setattr(ros_goals, "_SEND_LIMIT_S", 0.3)
    goals.server.answers.clear()
    threading.Timer(1.0, goals.server.answers.set).start()
    answer = goals.ask(goals.suite.start(calibrate("pointer")))
    assert not answer.ok
    assert "has not answered" in answer.text and "had begun, and is canceled" in answer.text
