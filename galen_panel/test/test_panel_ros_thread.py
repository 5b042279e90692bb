# SPDX-License-Identifier: Apache-2.0
"""The ROS thread by itself: jobs, errors in them, and the board that it writes on."""

import asyncio
import math
import threading

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from galen_model.errors import GalenError
from galen_panel.ros import thread as ros_thread
from galen_panel.ros.board import Board
from galen_panel.ros.thread import CallError, RosThread
from galen_panel.state.snapshot import Behaviour, BehaviourKind, NodeLevel
from galen_ros.node.spin import DomainLock
from rclpy.node import Node


@pytest.fixture
def thread(monkeypatch):
    lock = DomainLock()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(lock.domain_id))
    thread = RosThread()
    yield thread
    thread.close()
    lock.release()


def ask(thread, job):
    """Ask from an event loop, as the page does."""

    async def asked():
        return await asyncio.wait_for(thread.ask(job), 5.0)

    return asyncio.run(asked())


def test_jobs_run_in_the_thread_and_their_errors_come_back(thread):
    beats = []
    thread.start("panel", ["panel"], lambda _: beats.append, lambda: None)
    with pytest.raises(KeyError):
        ask(thread, lambda reply: {}["nothing"])

    def twice(reply):
        reply.give("first")
        reply.give("second")
        reply.fail(ValueError())

    assert ask(thread, twice) == "first"
    assert beats


def test_a_bug_in_a_beat_is_printed_and_does_not_end_the_thread(thread, capfd):
    def beat(_now_s):
        raise ZeroDivisionError("in a beat")

    thread.start("panel", ["panel"], lambda _: beat, lambda: None)
    assert ask(thread, lambda reply: reply.give(3)) == 3
    assert "in a beat" in capfd.readouterr().err


def test_what_can_t_be_set_up_is_raised_where_it_is_started(thread):
    def set_up(_node):
        raise CallError("no")

    with pytest.raises(CallError, match="no"):
        thread.start("panel", ["panel"], set_up, lambda: None)
    with pytest.raises(CallError, match="stopped"):
        ask(thread, lambda reply: reply.give(3))


def test_a_start_that_takes_too_long_is_one_sentence(thread, monkeypatch):
    monkeypatch.setattr(ros_thread, "_START_PATIENCE_S", 0.1)
    go_on = threading.Event()

    def set_up(_node):
        go_on.wait()
        return lambda _: None

    with pytest.raises(GalenError, match=r"ROS has not started within 0\.1 s"):
        thread.start("panel", ["panel"], set_up, lambda: None)
    go_on.set()


def test_a_board_has_a_new_revision_only_where_something_is_new():
    board = Board()
    board.put(available=frozenset({"check_tool"}))
    first = board.state
    board.put(available=frozenset({"check_tool"}))
    assert board.state is first and first.revision == 1
    board.put_behaviour(Behaviour(1, BehaviourKind.CHECK, "pointer"))
    board.put_behaviour(Behaviour(2, BehaviourKind.CALIBRATE, "pointer"))
    assert board.state.revision == 3 and set(board.state.behaviours) == {
        BehaviourKind.CHECK,
        BehaviourKind.CALIBRATE,
    }
    assert first.behaviours == {}


def test_diagnostics_of_anybody_are_kept_small(world):
    node = world.harness.add(lambda context: Node("somebody", context=context))
    publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    world.harness.wait_for(lambda: publisher.get_subscription_count(), 10.0, "the panel")

    def say(*statuses):
        message = DiagnosticArray(status=list(statuses))
        world.harness.call_in_executor(lambda: publisher.publish(message))

    values = [KeyValue(key=f"key {k}", value="x" * 10_000) for k in range(1000)]
    name, message = "noisy\n\x1b[2J", "m" * 100_000
    say(DiagnosticStatus(name=name, level=b"\x07", message=message, values=values))
    world.wait_for(lambda state: state.nodes, "a report")
    (report,) = world.state.nodes.values()
    assert report.level is NodeLevel.STALE and report.name.isprintable()
    assert len(report.message) < 5000 and len(report.values) == 200
    assert all(len(text) < 5000 for text in report.values.values())
    for first in (0, 100, 200):
        names = [f"node {k}" for k in range(first, first + 99)]
        say(*(DiagnosticStatus(name=name, level=b"\0") for name in names))
    say(DiagnosticStatus(name="gravcomp", level=b"\0", message="fine"))
    world.wait_for(lambda state: "gravcomp" in state.nodes, "the last one")
    assert len(world.state.nodes) == 100 and "node 0" not in world.state.nodes
    assert math.isfinite(world.state.nodes["gravcomp"].heard_s)
