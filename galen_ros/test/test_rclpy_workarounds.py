# SPDX-License-Identifier: Apache-2.0
"""Workarounds for rclpy: the version that they are for, jobs beside the executor."""

import threading
from importlib import metadata

import pytest
from galen_ros.rclpy_workarounds import RCLPY_VERSION, BackgroundJobs
from rclpy.node import Node


def test_the_executor_goes_on_and_gets_the_results_in_order(any_harness) -> None:
    harness = any_harness
    node = harness.add(lambda context: Node("worker", context=context))
    background = harness.call_in_executor(lambda: BackgroundJobs(node))
    go, results = threading.Event(), []

    def hand_over() -> None:
        executor = threading.current_thread()
        for number in range(3):
            background.submit(
                lambda number=number: (go.wait(5.0), number, threading.current_thread()),
                lambda result: results.append((*result, threading.current_thread(), executor)),
            )

    harness.call_in_executor(hand_over)
    assert harness.call_in_executor(lambda: len(results)) == 0  # it runs, the jobs wait
    go.set()
    harness.wait_for(lambda: len(results) == 3, 5.0, "the jobs")
    for expected, (went, number, at_work, told, executor) in enumerate(results):
        assert went and number == expected
        assert told is executor and at_work is not executor
    # Idle in between, it takes the next one.
    harness.call_in_executor(lambda: background.submit(lambda: 7, results.append))
    harness.wait_for(lambda: results[-1] == 7, 5.0, "a later job")
    harness.call_in_executor(lambda: background.submit(lambda: 1 / 0, results.append))
    with pytest.raises(ZeroDivisionError):
        harness.wait_for(lambda: len(results) > 4, 5.0, "an error")
    background.close()
    node.destroy_node()
    background._on_look()  # as the executor may call it, whose timer is destroyed


def test_rclpy_is_the_version_that_the_workarounds_are_for():
    try:
        found = metadata.version("ros-rclpy")
    except metadata.PackageNotFoundError:
        pytest.skip("rclpy is of an installed ROS 2, whose version the machine decides")
    assert found == RCLPY_VERSION, "see the docstring of galen_ros/rclpy_workarounds.py"
