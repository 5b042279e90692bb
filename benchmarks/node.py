"""Cost, latency and loss of one node's process, against bare relays in the same run.

A sender process publishes joint_states and a wrench; the subject is a process of its own; this
process receives what the subject puts out. Subjects beside the nodes themselves:

- `relay`: publishes every wrench as it is;
- `relay_joints`: the same, and takes joint_states too, without looking at them;
- `relay_deflection`: takes both, and publishes a deflection and a pose for each wrench.

What rclpy itself costs is in the relays; the node's own work is the difference. Latency is from the
sender's publish call to this process's callback, so it holds two hops through DDS. CPU is the
subject's user and system time for one wrench, with the joint message that comes with it. Loss is
exact: the last four digits of a stamp, ns, are the wrench's number (the time is good to 10 us).
Subjects take turns, round by round, so that what else the machine does meets all of them; ratios
are of one round.
"""

import argparse
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from galen_ros.cdr.layout import NS_PER_S, STAMP_AT
from galen_ros.conversions import fill_stamp
from galen_ros.node.domain import DomainLock
from galen_ros.node.spin import make_executor, run
from galen_ros.qos import STREAM
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from galen_msgs.msg import DeflectionStamped

WARM_UP_S = 1.5
DISCOVERY_TIMEOUT_S = 60.0
# An encoder's last digit, so that no two joint vectors that follow each other are alike.
_JOINT_STEP = 1e-6
_NUMBERS = 10_000
"""Of wrenches, until they begin again."""


CpuSoFar = Callable[[], dict[str, float]]
"""CPU time so far of what runs beside a subject, s, by its name."""


@dataclass(frozen=True)
class Subject:
    """A process to measure: arguments after `python -m`, and the topic whose stamps are taken.

    others: further topics that it publishes, which are received as well and not looked at. moving:
    whether the arm moves, so that no two joint vectors are alike. beside: starts what else shall
    run, in the environment that it is given, before the subject, and ends it. warm_up_s: from the
    first output until the numbers are taken.
    """

    name: str
    arguments: tuple[str, ...]
    output: tuple[str, Any]
    others: tuple[tuple[str, Any], ...] = ()
    moving: bool = False
    beside: Callable[[Mapping[str, str]], AbstractContextManager[CpuSoFar]] | None = None
    warm_up_s: float = WARM_UP_S


@dataclass(frozen=True)
class Measurement:
    """One subject at one rate, one round. lost: wrenches that never came out of it.

    beside_percent: CPU of what ran beside it, by its name.
    """

    subject: str
    rate_hz: float
    round: int
    received: int
    lost: int
    cpu_us_per_wrench: float
    cpu_percent: float
    latency_p50_ms: float
    latency_p99_ms: float
    latency_p999_ms: float
    latency_max_ms: float
    beside_percent: dict[str, float] = field(default_factory=dict)


def relays(wrench_topic: str) -> tuple[Subject, Subject]:
    """The bare relays of a wrench."""
    module = "benchmarks.node"
    output = ("relayed", WrenchStamped)
    return (
        Subject("relay", (module, "relay", wrench_topic), output),
        Subject("relay_joints", (module, "relay_joints", wrench_topic), output),
    )


def deflection_relay(wrench_topic: str) -> Subject:
    """The bare relay that takes and gives what a deflection's node does."""
    return Subject(
        "relay_deflection",
        ("benchmarks.node", "relay_deflection", wrench_topic),
        ("relayed_deflection", DeflectionStamped),
        (("relayed_pose", PoseStamped),),
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


class DeflectionRelay(Node):
    """Publishes a deflection and a pose for each wrench, and takes joint_states."""

    def __init__(self, wrench_topic: str) -> None:
        super().__init__("relay")
        self._deflection, self._pose = DeflectionStamped(), PoseStamped()
        self._deflections = self.create_publisher(DeflectionStamped, "relayed_deflection", STREAM)
        self._poses = self.create_publisher(PoseStamped, "relayed_pose", STREAM)
        self.create_subscription(WrenchStamped, wrench_topic, self._on_wrench, STREAM)
        self.create_subscription(JointState, "joint_states", self._on_joint_state, STREAM)

    def _on_joint_state(self, message: JointState) -> None:
        """Only the cost of receiving it is wanted."""

    def _on_wrench(self, message: WrenchStamped) -> None:
        self._deflection.header = self._pose.header = message.header
        self._deflections.publish(self._deflection)
        self._poses.publish(self._pose)


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
        now_ns = time.time_ns() // _NUMBERS * _NUMBERS + count % _NUMBERS
        fill_stamp(joints.header.stamp, now_ns)
        fill_stamp(wrench.header.stamp, now_ns)
        joints_publisher.publish(joints)
        wrench_publisher.publish(wrench)


class Receiver(Node):
    """Notes the latency of every output."""

    def __init__(self, subject: Subject, **options: Any) -> None:
        super().__init__("receiver", **options)
        self.stamps_ns: list[int] = []
        self.times_ns: list[int] = []
        topic, kind = subject.output
        self.create_subscription(kind, topic, self._on_output, STREAM, raw=True)
        for topic, kind in subject.others:
            self.create_subscription(kind, topic, self._on_other, STREAM, raw=True)

    def _on_output(self, data: bytes) -> None:
        sec, nanosec = struct.unpack_from("<iI", data, STAMP_AT)
        self.stamps_ns.append(sec * NS_PER_S + nanosec)
        self.times_ns.append(time.time_ns())

    def _on_other(self, data: bytes) -> None:
        """Only that it is sent to somebody is wanted."""


def cpu_s(pid: int) -> float:
    """User and system time of a process so far, s (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(
    subject: Subject, wrench_topic: str, rate_hz: float, seconds: float, number: int = 0
) -> Measurement:
    """Run sender and subject for a while and take the numbers."""
    lock = DomainLock()
    environment = os.environ | {"ROS_DOMAIN_ID": str(lock.domain_id), "OMP_NUM_THREADS": "1"}
    try:
        beside = nullcontext(dict) if subject.beside is None else subject.beside(environment)
        with beside as cpu_beside:
            taken = _take(
                subject, wrench_topic, rate_hz, seconds, lock.domain_id, environment, cpu_beside
            )
    finally:
        lock.release()
    stamps_ns, times_ns = taken.stamps_ns, taken.times_ns
    if len(stamps_ns) == 0:
        raise RuntimeError(f"{subject.name} stopped putting out anything at {rate_hz:g} Hz")
    latencies_ms = (times_ns - stamps_ns) * 1e-6
    p50, p99, p999 = np.percentile(latencies_ms, (50, 99, 99.9))
    return Measurement(
        subject=subject.name,
        rate_hz=rate_hz,
        round=number,
        received=len(latencies_ms),
        lost=lost_between(stamps_ns),
        cpu_us_per_wrench=1e6 * taken.cpu_s / len(latencies_ms),
        cpu_percent=100.0 * taken.cpu_s / taken.elapsed_s,
        latency_p50_ms=float(p50),
        latency_p99_ms=float(p99),
        latency_p999_ms=float(p999),
        latency_max_ms=float(latencies_ms.max()),
        beside_percent={
            name: 100.0 * used_s / taken.elapsed_s for name, used_s in taken.beside_s.items()
        },
    )


@dataclass(frozen=True)
class _Taken:
    """Outputs' stamps and times of arrival (n,); CPU time meanwhile, of the subject and beside."""

    stamps_ns: np.ndarray
    times_ns: np.ndarray
    cpu_s: float
    elapsed_s: float
    beside_s: dict[str, float]


def _take(
    subject: Subject,
    wrench_topic: str,
    rate_hz: float,
    seconds: float,
    domain_id: int,
    environment: Mapping[str, str],
    cpu_beside: CpuSoFar,
) -> _Taken:
    """Run sender and subject, and receive for a while."""
    sending = ["benchmarks.node", "sender", wrench_topic, "--rate", str(rate_hz)]
    sending += ["--moving"] * subject.moving
    processes = []
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain_id)
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
        while not receiver.stamps_ns:
            if time.monotonic() > deadline_s:
                raise RuntimeError(f"nothing came from {subject.name} for {DISCOVERY_TIMEOUT_S} s")
            spin_for(0.1)
        spin_for(subject.warm_up_s)
        receiver.stamps_ns.clear()
        receiver.times_ns.clear()
        beside_s = cpu_beside()
        before_s, start_s = cpu_s(processes[0].pid), time.monotonic()
        spin_for(seconds)
        used_s = cpu_s(processes[0].pid) - before_s
        elapsed_s = time.monotonic() - start_s
        return _Taken(
            np.array(receiver.stamps_ns),
            np.array(receiver.times_ns),
            used_s,
            elapsed_s,
            {name: so_far_s - beside_s[name] for name, so_far_s in cpu_beside().items()},
        )
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(timeout=10.0)
        receiver.destroy_node()
        executor.shutdown()
        rclpy.shutdown(context=context)


def lost_between(stamps_ns: np.ndarray) -> int:
    """How many numbers lack between the first and the last of stamps (n,), n > 0."""
    steps = np.diff(np.sort(stamps_ns % _NUMBERS + _turns(stamps_ns) * _NUMBERS))
    return int(np.sum(steps - 1))


def _turns(stamps_ns: np.ndarray) -> np.ndarray:
    """How often the numbers had begun again, for stamps (n,) in the order in which they came."""
    back = np.diff(stamps_ns % _NUMBERS) < -_NUMBERS // 2
    return np.concatenate([[0], np.cumsum(back)])


def compare(
    subjects: Sequence[Subject],
    wrench_topic: str,
    rates_hz: Sequence[float],
    seconds: float,
    rounds: int,
    progress: Callable[[str], None] = lambda what: None,
) -> list[Measurement]:
    """Measure all subjects at every rate, turn by turn; progress(what) is called before each."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    found = []
    for rate_hz in rates_hz:
        for number in range(rounds):
            for subject in subjects:
                progress(f"{subject.name} at {rate_hz:g} Hz")
                found.append(measure(subject, wrench_topic, rate_hz, seconds, number))
    return found


def main() -> None:
    """Be the sender or a relay."""
    parser = argparse.ArgumentParser(description="a process that a benchmark of a node needs")
    parser.add_argument("role", choices=("sender", "relay", "relay_joints", "relay_deflection"))
    parser.add_argument("wrench_topic")
    parser.add_argument("--rate", type=float, default=500.0, help="Hz")
    parser.add_argument("--moving", action="store_true", help="no two joint vectors alike")
    options = parser.parse_args()
    topic = options.wrench_topic
    if options.role == "sender":
        send(topic, options.rate, options.moving)
    elif options.role == "relay_deflection":
        run(lambda: DeflectionRelay(topic), args=[])
    else:
        run(lambda: Relay(topic, options.role == "relay_joints"), args=[])


if __name__ == "__main__":
    main()
