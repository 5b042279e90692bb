# SPDX-License-Identifier: Apache-2.0
"""A RosSuite in a Harness's domain: nodes are added and taken away around it."""

import asyncio
import time
from contextlib import contextmanager

from galen_panel.ros.suite import RosSuite
from galen_ros.node.testing import Harness, parameters


class World:
    """`suite` beside the Harness's nodes."""

    def __init__(self, harness, suite):
        self.harness = harness
        self.suite = suite

    @property
    def state(self):
        return self.suite.state

    def add(self, kind, **values):
        return self.harness.add(
            lambda context: kind(context=context, parameter_overrides=parameters(**values))
        )

    def ask(self, coroutine):
        """Run a coroutine of the suite to its end, in an event loop of its own."""
        return asyncio.run(coroutine)

    def timed(self, coroutine):
        """Its answer, and how long it took, s."""
        began_s = time.monotonic()
        return self.ask(coroutine), time.monotonic() - began_s

    def wait_for(self, predicate, what, timeout_s=15.0):
        """Wait until `predicate(state)` holds; returns what it returns."""
        return self.harness.wait_for(lambda: predicate(self.state), timeout_s, what)

    def wait_for_service(self, *names):
        self.wait_for(lambda state: set(names) <= state.available, " and ".join(names))


@contextmanager
def panel_world(monkeypatch, *arguments, **options):
    """The suite is started before any node, as a person may do it."""
    with Harness() as harness:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(harness.domain_id))
        with RosSuite(["panel", *arguments], **options) as suite:
            yield World(harness, suite)
