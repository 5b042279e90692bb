# SPDX-License-Identifier: Apache-2.0
"""Processes for the tests of commands."""

import subprocess
import sys

import pytest
from galen_ros.node.spin import DomainLock


@pytest.fixture
def started(monkeypatch):
    """Start `python arguments` in a ROS domain of its own; what still runs in the end is killed."""
    lock = DomainLock()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(lock.domain_id))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    processes = []

    def start(*arguments):
        command = [sys.executable, *arguments]
        pipe = subprocess.PIPE
        processes.append(subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True))
        return processes[-1]

    yield start
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()
    lock.release()
