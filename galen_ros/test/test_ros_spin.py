"""A node as a process: signals, exit codes, what it prints."""

import os
import signal
import subprocess
import sys

import pytest
from galen_ros.node.domain import DomainLock

_PROGRAM = """
import os, signal, sys
from galen_model.errors import GalenError
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

def broken():
    raise GalenError("parameter 'rate_hz' is 0")

def misspelt():
    node = Node("node", cli_args=["--ros-args", "-p", "use_sim_tim:=true"])
    node.create_timer(0.01, lambda: os.kill(os.getpid(), signal.SIGINT))
    return node

run({"talker": Talker, "misspelt": misspelt, "broken": broken, "bug": lambda: 1 / 0}[sys.argv[1]])
"""


@pytest.fixture
def start():
    lock = DomainLock()
    started = []

    def launch(what):
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, what],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={
                **os.environ,
                "ROS_DOMAIN_ID": str(lock.domain_id),
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            },
        )
        started.append(process)
        return process

    yield launch
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()
    lock.release()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_cleanly(start, number):
    process = start("talker")
    assert process.stdout.readline() == "running\n"
    process.send_signal(number)
    out, err = process.communicate(timeout=10.0)
    assert process.returncode == 0
    assert out == "ended\n"
    assert err == ""


def test_bad_input_is_one_line_and_exit_code_1(start):
    out, err = start("broken").communicate(timeout=20.0)
    assert (out, err) == ("", "error: parameter 'rate_hz' is 0\n")


def test_a_bug_keeps_its_traceback(start):
    process = start("bug")
    _, err = process.communicate(timeout=20.0)
    assert process.returncode != 0
    assert "ZeroDivisionError" in err


def test_a_parameter_that_the_node_does_not_have_is_told(start):
    process = start("misspelt")
    _, err = process.communicate(timeout=20.0)
    assert process.returncode == 0
    assert "'use_sim_tim' is unknown to /node and ignored: did you mean 'use_sim_time'?" in err
