"""Cost and latency of one node's process, against bare relays in the same run.

A sender process publishes joint_states and a wrench; the subject is a process of its own; this
process receives what the subject puts out. Subjects beside the node itself:

- `relay`: publishes every wrench as it is;
- `relay_joints`: the same, and takes joint_states too, without looking at them.

What rclpy itself costs is in the relays; the node's own work is the difference. Latency is from the
sender's publish call to this process's callback, so it holds two hops through DDS. CPU is the
subject's user and system time for one wrench, with the joint message that comes with it. Subjects
take turns, round by round, so that what else the machine does meets all of them.
"""

import argparse
import json
import os
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from galen_ros.cdr import NS_PER_S, STAMP_AT
from galen_ros.conversions import fill_stamp
from galen_ros.domain import DomainLock
from galen_ros.qos import STREAM
from galen_ros.spin import make_executor, run
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

WARM_UP_S = 1.5
DISCOVERY_TIMEOUT_S = 60.0
# An encoder's last digit, so that no two joint vectors that follow each other are alike.
_JOINT_STEP = 1e-6


@dataclass(frozen=True)
class Subject:
    """A process to measure: arguments after `python -m`, and the topic whose stamps are taken.

    others: further topics that it publishes, which are received as well and not looked at.
    """

    name: str
    arguments: tuple[str, ...]
    output: tuple[str, Any]
    others: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class Measurement:
    """One subject at one rate, one round."""

    subject: str
    rate_hz: float
    sent: int
    received: int
    cpu_us_per_wrench: float
    cpu_percent: float
    latency_median_ms: float
    latency_p99_ms: float
    latency_max_ms: float


def relays(wrench_topic: str) -> tuple[Subject, Subject]:
    """The bare relays of a wrench."""
    module = "galen_gravcomp.node_benchmark"
    output = ("relayed", WrenchStamped)
    return (
        Subject("relay", (module, "relay", wrench_topic), output),
        Subject("relay_joints", (module, "relay_joints", wrench_topic), output),
    )


class Relay(Node):
    """Publishes each wrench as it comes."""

    def __init__(self, wrench_topic: str, take_joints: bool) -> None:
        super().__init__("relay")
        self._out = self.create_publisher(WrenchStamped, "relayed", STREAM)
        self.create_subscription(WrenchStamped, wrench_topic, self._out.publish, STREAM)
        if take_joints:
            self.create_subscription(JointState, "joint_states", self._on_joint_state, STREAM)

    def _on_joint_state(self, message: JointState) -> None:
        """Only the cost of receiving it is wanted."""


def send(wrench_topic: str, rate_hz: float, moving: bool) -> None:
    """Publish joints and wrenches at a rate until the process is ended."""
    # Without rclpy's handlers SIGTERM ends this endless loop at once.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("sender")
    joints_publisher = node.create_publisher(JointState, "joint_states", STREAM)
    wrench_publisher = node.create_publisher(WrenchStamped, wrench_topic, STREAM)
    joints, wrench = JointState(), WrenchStamped()
    joints.name = ["delta_x", "delta_y", "delta_z", "roll", "tilt"]
    home = np.array([0.0, 0.0, 0.408, 0.2, -0.1])
    joints.position = home.tolist()
    joints.velocity = [0.0] * 5
    wrench.header.frame_id = "ft_sensor"
    period_s = 1.0 / rate_hz
    next_s = time.monotonic()
    count = 0
    while True:
        next_s += period_s
        time.sleep(max(0.0, next_s - time.monotonic()))
        count += 1
        if moving:
            joints.position = (home + _JOINT_STEP * (count % 10007)).tolist()
        wrench.wrench.force.x = 3.0 * np.sin(0.01 * count)
        now_ns = time.time_ns()
        fill_stamp(joints.header.stamp, now_ns)
        fill_stamp(wrench.header.stamp, now_ns)
        joints_publisher.publish(joints)
        wrench_publisher.publish(wrench)


class Receiver(Node):
    """Notes the latency of every output."""

    def __init__(self, subject: Subject, **options: Any) -> None:
        super().__init__("receiver", **options)
        self.latencies_ns: list[int] = []
        topic, kind = subject.output
        self.create_subscription(kind, topic, self._on_output, STREAM, raw=True)
        for topic, kind in subject.others:
            self.create_subscription(kind, topic, self._on_other, STREAM, raw=True)

    def _on_output(self, data: bytes) -> None:
        sec, nanosec = struct.unpack_from("<iI", data, STAMP_AT)
        self.latencies_ns.append(time.time_ns() - (sec * NS_PER_S + nanosec))

    def _on_other(self, data: bytes) -> None:
        """Only that it is sent to somebody is wanted."""


def cpu_s(pid: int) -> float:
    """User and system time of a process so far, s (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(
    subject: Subject, wrench_topic: str, rate_hz: float, seconds: float, moving: bool = False
) -> Measurement:
    """Run sender and subject for a while and take the numbers."""
    lock = DomainLock()
    environment = os.environ | {"ROS_DOMAIN_ID": str(lock.domain_id), "OMP_NUM_THREADS": "1"}
    sending = ["galen_gravcomp.node_benchmark", "sender", wrench_topic, "--rate", str(rate_hz)]
    sending += ["--moving"] * moving
    processes = []
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=lock.domain_id)
    executor = make_executor(context)
    receiver = Receiver(subject, context=context)
    executor.add_node(receiver)

    def spin_for(duration_s: float) -> None:
        until_s = time.monotonic() + duration_s
        while (left_s := until_s - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=min(left_s, 0.05))

    try:
        for module_arguments in (subject.arguments, sending):
            processes.append(
                subprocess.Popen([sys.executable, "-m", *module_arguments], env=environment)
            )
        deadline_s = time.monotonic() + DISCOVERY_TIMEOUT_S
        while not receiver.latencies_ns:
            if time.monotonic() > deadline_s:
                raise RuntimeError(f"nothing came from {subject.name} for {DISCOVERY_TIMEOUT_S} s")
            spin_for(0.1)
        spin_for(WARM_UP_S)
        receiver.latencies_ns.clear()
        cpu_before_s, start_s = cpu_s(processes[0].pid), time.monotonic()
        spin_for(seconds)
        cpu_used_s = cpu_s(processes[0].pid) - cpu_before_s
        elapsed_s = time.monotonic() - start_s
        latencies_ms = np.array(receiver.latencies_ns) * 1e-6
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(timeout=10.0)
        receiver.destroy_node()
        executor.shutdown()
        rclpy.shutdown(context=context)
        lock.release()
    if len(latencies_ms) == 0:
        raise RuntimeError(f"{subject.name} stopped putting out anything at {rate_hz:g} Hz")
    median, p99 = np.percentile(latencies_ms, (50, 99))
    return Measurement(
        subject=subject.name,
        rate_hz=rate_hz,
        sent=round(rate_hz * elapsed_s),
        received=len(latencies_ms),
        cpu_us_per_wrench=1e6 * cpu_used_s / len(latencies_ms),
        cpu_percent=100.0 * cpu_used_s / elapsed_s,
        latency_median_ms=float(median),
        latency_p99_ms=float(p99),
        latency_max_ms=float(latencies_ms.max()),
    )


def add_benchmark_options(parser: argparse.ArgumentParser) -> None:
    """Rates, time, rounds, JSON."""
    parser.add_argument("--rates", type=float, nargs="+", default=[500.0], help="Hz")
    parser.add_argument("--seconds", type=float, default=10.0, help="measured time of each run")
    parser.add_argument("--rounds", type=int, default=1, help="how often each subject has its turn")
    parser.add_argument("--json", action="store_true", help="print every measurement as JSON")


def compare(
    subjects: Sequence[tuple[Subject, bool]], wrench_topic: str, options: argparse.Namespace
) -> None:
    """Measure subjects (and whether the arm moves) at every rate; print a table, or JSON."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    every: list[Measurement] = []
    for rate_hz in options.rates:
        rows: dict[str, list[Measurement]] = {subject.name: [] for subject, _ in subjects}
        for _ in range(options.rounds):
            for subject, moving in subjects:
                found = measure(subject, wrench_topic, rate_hz, options.seconds, moving)
                rows[subject.name].append(found)
                every.append(found)
        if not options.json:
            for number, measured in enumerate(rows.values()):
                _print_row(measured, first=number == 0 and rate_hz == options.rates[0])
    if options.json:
        print(json.dumps([asdict(measurement) for measurement in every], indent=2))


def _print_row(rounds: list[Measurement], first: bool) -> None:
    """Print one line of the table: minimum, median and maximum of the rounds."""
    if first:
        print(
            "subject                  rate Hz       received  CPU us/wrench     CPU %"
            "             median ms         p99 ms            max ms"
        )

    def three(name: str, digits: int) -> str:
        values = [getattr(measured, name) for measured in rounds]
        spread = (min(values), statistics.median(values), max(values))
        return "/".join(f"{value:.{digits}f}" for value in spread)

    received = sum(measured.received for measured in rounds)
    sent = sum(measured.sent for measured in rounds)
    print(
        f"{rounds[0].subject:24s} {rounds[0].rate_hz:7g} {received:7d}/{sent:<7d}"
        f" {three('cpu_us_per_wrench', 0):16s} {three('cpu_percent', 1):17s}"
        f" {three('latency_median_ms', 2):17s} {three('latency_p99_ms', 2):17s}"
        f" {three('latency_max_ms', 2)}",
        flush=True,
    )


def main() -> None:
    """Be the sender or a relay."""
    parser = argparse.ArgumentParser(description="a process that a benchmark of a node needs")
    parser.add_argument("role", choices=("sender", "relay", "relay_joints"))
    parser.add_argument("wrench_topic")
    parser.add_argument("--rate", type=float, default=500.0, help="Hz")
    parser.add_argument("--moving", action="store_true", help="no two joint vectors alike")
    options = parser.parse_args()
    if options.role == "sender":
        send(options.wrench_topic, options.rate, options.moving)
    else:
        take_joints = options.role == "relay_joints"
        run(lambda: Relay(options.wrench_topic, take_joints), args=[])


if __name__ == "__main__":
    main()
