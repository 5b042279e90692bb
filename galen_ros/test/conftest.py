# SPDX-License-Identifier: Apache-2.0
"""Worlds of this package's tests: on the executor that nodes have, and on rclpy's own."""

import pytest
from galen_ros.node.spin import make_executor
from galen_ros.node.testing import Harness
from rclpy.executors import SingleThreadedExecutor


@pytest.fixture
def harness():
    """A world on the executor that nodes have."""
    with Harness() as world:
        yield world


@pytest.fixture(
    params=[make_executor, lambda context: SingleThreadedExecutor(context=context)],
    ids=["default", "single_threaded"],
)
def any_harness(request):
    """The same on either executor: for what hangs on it."""
    with Harness(request.param) as world:
        yield world
