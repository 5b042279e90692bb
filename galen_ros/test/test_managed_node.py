# SPDX-License-Identifier: Apache-2.0
"""Managed nodes: transitions over the real services, what is undone, and what a failure becomes."""

import time
from dataclasses import dataclass

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from galen_common.parameters import param
from galen_model.errors import GalenError
from galen_ros.node.diagnostics import OK, Level, Status
from galen_ros.node.managed_node import ManagedNode
from galen_ros.node.testing import Lifecycle, parameters
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import GetAvailableTransitions
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger


@dataclass(frozen=True)
class Settings:
    topic: str = param("words", "topic")
    gain: float = param(1.0, "gain", maximum=2.0, read_only=False)
    fails_in: str = param("", "transition that fails")
    bug: bool = param(False, "whether it fails by a bug")

    def fail(self, name):
        if self.fails_in == name and self.bug:
            raise ZeroDivisionError("a bug")
        if self.fails_in == name:
            raise GalenError(f"{name} can't be done with {self.topic}")


class Worker(ManagedNode):
    hardware_id = "worker"

    def __init__(self, **options):
        super().__init__("worker", **options)
        self.undone, self.gains, self.heard = [], [], []
        self._held = self.hold(Settings, lambda new: self.gains.append(new.gain))
        self.start()

    def _configure(self):
        self._settings = self._held.now
        self.words = self.create_publisher(String, self._settings.topic, 10)
        self.create_service(Trigger, "~/ask", self._on_ask)
        self._at_undo(lambda: self._undone("cleanup"))
        self._settings.fail("configure")

    def _activate(self):
        self.create_subscription(String, "said", lambda _: self.heard.append("said"), 10)
        self.create_timer(0.001, lambda: self.heard.append("timer"))
        self._at_undo(lambda: self._undone("deactivate"))
        self._settings.fail("activate")

    def _on_ask(self, _request, response):
        self.heard.append("asked")
        return response

    def _undone(self, name):
        self.undone.append(name)
        self._settings.fail(name)

    def _report(self):
        return Status(OK, "works", {"topic": self._settings.topic})


class World:
    """A worker, and a probe that drives it and hears it."""

    def __init__(self, harness, **values):
        self.harness = harness
        self.node = harness.add(
            lambda context: Worker(context=context, parameter_overrides=parameters(**values))
        )
        self.probe = harness.add(lambda context: Node("probe", context=context))
        self.status, self.events = {}, []
        self.probe.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, 10)
        topic = "worker/transition_event"
        self.probe.create_subscription(TransitionEvent, topic, self._on_event, 10)
        self.life = Lifecycle(harness, self.probe, "worker")
        self.go, self.set = self.life.go, self.life.set

    def _on_status(self, message):
        (status,) = message.status
        values = {item.key: item.value for item in status.values}
        self.status = {"level": Level(status.level[0]), "message": status.message} | values

    def _on_event(self, event):
        self.events.append(event.goal_state.label)

    @property
    def state(self):
        return self.life.state

    def own(self):
        """Names of what configuring and activating make."""
        node = self.node
        names = {one.topic_name for one in (*node.publishers, *node.subscriptions)}
        names |= {one.srv_name for one in node.services}
        return names & {"/words", "/other", "/said", "~/ask"}


def test_it_starts_active_by_itself_and_walks_through_its_states(any_harness):
    world, harness = World(any_harness), any_harness
    assert world.state == "active" and world.own() == {"/words", "/said", "~/ask"}
    assert world.go("deactivate") and world.state == "inactive"
    assert world.own() == {"/words", "~/ask"} and world.node.undone == ["deactivate"]
    assert world.go("cleanup") and world.state == "unconfigured" and world.own() == set()
    assert world.node.undone == ["deactivate", "cleanup"]
    harness.wait_for(lambda: world.status.get("lifecycle") == "unconfigured", 20.0, "its state")
    assert world.status["level"] is Level.WARN and "call configure" in world.status["message"]
    # What was fixed can be set now, and is what it is configured with.
    assert not world.set(topic="other")
    assert world.go("configure", "activate")
    assert world.own() == {"/other", "/said", "~/ask"}
    harness.wait_for(lambda: world.status.get("topic") == "other", 20.0, "the new topic")
    assert world.status["lifecycle"] == "active" and world.status["level"] is Level.OK
    # From active, all is undone.
    assert world.go("shutdown") and world.state == "finalized" and world.own() == set()
    harness.wait_for(lambda: world.status["lifecycle"] == "finalized", 20.0, "the end")
    assert "deactivating" in world.events and world.events[-1] == "finalized"


def test_told_not_to_it_waits_unconfigured_and_says_so(harness):
    world = World(harness, autostart=False)
    harness.wait_for(lambda: world.status, 20.0, "diagnostics")
    assert world.status["lifecycle"] == world.state == "unconfigured" and world.own() == set()
    transitions = world.probe.create_client(
        GetAvailableTransitions, "worker/get_available_transitions"
    )
    answer = harness.call(transitions, GetAvailableTransitions.Request())
    labels = {item.transition.label for item in answer.available_transitions}
    assert {"configure", "shutdown"} <= labels
    assert world.go("configure", "activate") and world.state == "active"


def test_what_still_waits_in_the_executor_reaches_nobody(any_harness):
    world, harness = World(any_harness), any_harness
    publisher = world.probe.create_publisher(String, "said", 10)
    ask = world.probe.create_client(Trigger, "worker/ask")
    harness.wait_for(publisher.get_subscription_count, 20.0, "the subscription")
    harness.wait_for(ask.service_is_ready, 20.0, "the service")

    def end():
        publisher.publish(String())
        ask.call_async(Trigger.Request())
        time.sleep(0.05)  # they arrive, and the timer is due, while the executor is busy
        world.node.trigger_deactivate()
        world.node.trigger_cleanup()
        world.node.heard.clear()

    harness.call_in_executor(end)
    assert world.go("configure") and world.go("shutdown")  # time for what waited
    assert world.node.heard == []


def test_a_destroyed_node_leaves_the_graph(any_harness):
    world, harness = World(any_harness), any_harness
    harness.remove(world.node)  # which is still referred to here, as any is until it is collected

    def gone():
        topic = "/worker/transition_event"
        return not world.probe.get_publishers_info_by_topic(topic) and "worker" not in [
            name for name, _ in world.probe.get_node_names_and_namespaces()
        ]

    harness.wait_for(gone, 20.0, "the node to go")


def test_what_is_fixed_stays_while_it_is_configured(harness):
    world = World(harness)
    rejected = world.set(topic="other")
    assert "'topic' can't be set while the node is active" in rejected and "cleanup" in rejected
    assert not world.set(gain=1.5) and world.node.gains == [1.5]
    assert world.set(gain=3.0)
    assert world.go("deactivate") and "cleanup" in world.set(topic="other")
    assert world.go("cleanup") and not world.set(gain=0.5)
    assert world.node.gains == [1.5]  # nobody works with it now
    assert world.set(gain=3.0) and world.set(autostart=False)


@pytest.mark.parametrize("by", ["id", "label"])
def test_a_transition_that_the_state_does_not_have_is_rejected(harness, by):
    """As rclpy has it, one such request by its number ends the process."""
    world = World(harness)
    for label, number in (("activate", 3), ("configure", 1), ("nonsense", 200)):
        wanted = Transition(label=label) if by == "label" else Transition(id=number)
        assert not world.life.ask(wanted)
    assert world.state == "active"


@pytest.mark.parametrize("name", ["configure", "activate", "deactivate", "cleanup"])
def test_a_failed_transition_leaves_it_unconfigured_and_ready_to_be_fixed(harness, name):
    world = World(harness, autostart=False, fails_in=name)
    path = ["configure", "activate", "deactivate", "cleanup"]
    assert world.go(*path[: path.index(name)]) and not world.go(name)
    assert world.state == "unconfigured" and world.own() == set()
    assert "errorprocessing" in world.events
    harness.wait_for(lambda: world.status.get("level") is Level.ERROR, 20.0, "the error")
    assert f"{name} failed: {name} can't be done with words;" in world.status["message"]
    assert not world.set(fails_in="")
    assert world.go("configure", "activate") and world.state == "active"
    harness.wait_for(lambda: world.status["level"] is Level.OK, 20.0, "a good state")


def test_a_bug_in_a_transition_is_an_error_state_too_and_its_traceback_is_logged(harness, capfd):
    world = World(harness, autostart=False, fails_in="configure", bug=True)
    assert not world.go("configure") and world.state == "unconfigured"
    said = capfd.readouterr().err
    assert "/worker: configure failed: ZeroDivisionError: a bug" in said
    assert "in _configure" in said


def test_a_failed_start_by_itself_is_raised(harness):
    for name in ("configure", "activate"):
        with pytest.raises(GalenError, match=f"{name} can't be done"):
            World(harness, fails_in=name)
    with pytest.raises(ZeroDivisionError):
        World(harness, fails_in="activate", bug=True)
    assert World(harness).state == "active"  # nothing of those is left in the way


def test_parameters_of_rclpy_survive_a_cleanup(harness):
    """use_sim_time makes a subscription while the node is configured: it is not the node's."""
    world = World(harness)
    new = Parameter("use_sim_time", value=True)
    harness.call_in_executor(lambda: world.node.set_parameters([new]))
    assert world.go("deactivate", "cleanup")
    assert "/clock" in {one.topic_name for one in world.node.subscriptions}
