# SPDX-License-Identifier: Apache-2.0
"""A node as a process: signals, exit codes, what it prints."""

import os
import signal
import subprocess
import sys

import pytest
from galen_model.errors import GalenError
from galen_ros.node.spin import DomainLock, run
from rclpy.node import Node

_PROGRAM = """
from galen_ros.node.spin import run
from rclpy.node import Node
from std_msgs.msg import String

class Talker(Node):
    def __init__(self):
        super().__init__("talker")
        self.talk = self.create_publisher(String, "talk", 10)
        self.create_timer(0.001, self.on_timer)
        self.count = 0
    def on_timer(self):
        self.talk.publish(String(data="x"))
        self.count += 1
        if self.count == 20:
            print("running", flush=True)
    def destroy_node(self):
        self.talk.publish(String(data="good-bye"))
        print("ended", flush=True)
        super().destroy_node()

run(Talker)
"""


@pytest.fixture
def domain(monkeypatch):
    """A process with a node, and this process's own world."""
    lock = DomainLock()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(lock.domain_id))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    yield
    lock.release()


@pytest.mark.usefixtures("domain")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_node_cleanly(number):
    with subprocess.Popen(
        [sys.executable, "-c", _PROGRAM],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # nohup ignores it
    ) as process:
        assert process.stdout.readline() == "running\n"
        process.send_signal(number)
        assert process.communicate(timeout=10.0) == ("ended\n", "")
    assert process.returncode == 0


@pytest.mark.usefixtures("domain")
def test_bad_input_is_one_line_and_exit_code_1(capfd):
    def broken():
        raise GalenError("parameter 'rate_hz' is 0")

    with pytest.raises(SystemExit, match="1"):
        run(broken, [])
    assert capfd.readouterr() == ("", "error: parameter 'rate_hz' is 0\n")
    with pytest.raises(ZeroDivisionError):  # a bug keeps its traceback
        run(lambda: 1 / 0, [])


@pytest.mark.usefixtures("domain")
def test_a_domain_without_ports_is_one_line(monkeypatch, capfd):
    monkeypatch.setenv("ROS_DOMAIN_ID", "500")
    with pytest.raises(SystemExit) as ended:
        run(lambda: Node("never"), [])
    assert ended.value.code == 1
    assert capfd.readouterr().err.startswith("error: ROS_DOMAIN_ID is 500: at most 232")


def test_a_parameter_that_the_node_does_not_have_is_told(capfd):
    def misspelt():
        node = Node("node", cli_args=["--ros-args", "-p", "use_sim_tim:=true"])
        node.create_timer(0.01, lambda: os.kill(os.getpid(), signal.SIGINT))
        return node

    run(misspelt, [])
    told = "'use_sim_tim' is unknown to /node and ignored: did you mean 'use_sim_time'?"
    assert told in capfd.readouterr().err
