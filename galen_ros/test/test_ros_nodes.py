# SPDX-License-Identifier: Apache-2.0
"""Diagnostics, latched topics, deferred services and the harness, on both executors."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from galen_ros.node.diagnostics import OK, WARN, DiagnosticsPublisher, Status
from galen_ros.node.testing import Harness
from galen_ros.rclpy_workarounds import DeferredService
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger


def talk(harness, report, **options):
    """Publish diagnostics of a node; return its publisher and what a probe receives."""
    node = harness.add(
        lambda context: Node("talker", namespace="/left", context=context, **options)
    )
    probe = harness.add(lambda context: Node("probe", context=context))
    received = []
    probe.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)
    return DiagnosticsPublisher(node, "arm", report, period_s=0.05), received


def values_of(status):
    return {item.key: item.value for item in status.values}


def test_diagnostics_come_by_period_and_on_change(any_harness):
    harness = any_harness
    state = {"status": Status(OK, "fine", {"rate_hz": 500.0, "on": True, "tool": "pointer"})}
    publisher, received = talk(harness, lambda: state["status"])
    harness.wait_for(lambda: len(received) >= 3, 10.0, "three diagnostics")
    status = received[-1].status[0]
    assert (status.level, status.name) == (DiagnosticStatus.OK, "left/talker")
    assert (status.message, status.hardware_id) == ("fine", "arm")
    assert values_of(status) == {"rate_hz": "500", "on": "true", "tool": "pointer"}

    state["status"] = Status(WARN, "no tool")
    harness.call_in_executor(publisher.publish_now)
    last = harness.wait_for(
        lambda: next((m for m in received if m.status[0].message == "no tool"), None),
        10.0,
        "the new state",
    )
    assert last.status[0].level == DiagnosticStatus.WARN


def test_time_that_stands_still_is_told_with_a_value(harness):
    clock = [Parameter("use_sim_time", value=True)]
    report = Status(OK, "fine", {"on": True})
    _, received = talk(harness, lambda: report, parameter_overrides=clock)
    harness.wait_for(lambda: received, 10.0, "diagnostics")
    status = received[-1].status[0]
    assert status.level == DiagnosticStatus.WARN and "no /clock came" in status.message
    assert values_of(status) == {"clock": "stands still", "on": "true"}


def test_a_deferred_answer_waits_for_its_event_and_blocks_nothing(any_harness):
    harness = any_harness
    waiting = []

    def on_request(_request, response, respond):
        waiting.append((response, respond))

    node = harness.add(lambda context: Node("server", context=context))
    DeferredService(node, Trigger, "later", on_request)

    def on_now(_request, response):
        response.success = True
        return response

    node.create_service(Trigger, "now", on_now)
    probe = harness.add(lambda context: Node("probe", context=context))
    later = probe.create_client(Trigger, "later")
    now = probe.create_client(Trigger, "now")
    harness.wait_for(later.service_is_ready, 10.0, "the service")
    first, second = later.call_async(Trigger.Request()), later.call_async(Trigger.Request())
    harness.wait_for(lambda: len(waiting) == 2, 10.0, "both requests")
    assert harness.call(now, Trigger.Request()).success
    assert not first.done() and not second.done()

    # Answered in the other order, each caller still gets its own.
    def answer(index, text):
        response, respond = waiting[index]
        response.message = text
        harness.call_in_executor(lambda: respond(response))

    answer(1, "second")
    harness.wait_for(second.done, 10.0, "the second answer")
    assert second.result().message == "second" and not first.done()
    answer(0, "first")
    harness.wait_for(first.done, 10.0, "the first answer")
    assert first.result().message == "first"


def test_a_deferred_service_may_answer_at_once(harness):
    def on_request(_request, response, respond):
        response.message = "rejected"
        respond(response)
        with pytest.raises(RuntimeError, match="twice"):
            respond(response)

    node = harness.add(lambda context: Node("server", context=context))
    DeferredService(node, Trigger, "later", on_request)
    client = harness.add(lambda context: Node("probe", context=context)).create_client(
        Trigger, "later"
    )
    assert harness.call(client, Trigger.Request()).message == "rejected"


def test_the_harness_names_what_was_missing_and_passes_errors_on():
    with Harness() as world:
        with pytest.raises(AssertionError, match="a miracle"):
            world.wait_for(lambda: False, 0.05, "a miracle")
        with pytest.raises(ZeroDivisionError):
            world.add(lambda context: 1 / 0)

    with Harness() as world:
        node = world.add(lambda context: Node("broken", context=context))
        node.create_timer(0.01, lambda: {}["missing"])
        with pytest.raises(KeyError):
            world.wait_for(lambda: False, 10.0, "nothing")
