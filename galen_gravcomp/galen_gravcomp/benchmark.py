"""Cost and latency of the compensator's process, against bare relays in the same run.

    python -m galen_gravcomp.benchmark --rates 500 1000 --seconds 10 --json

A sender process publishes joint_states and wrench_raw; the subject is a process of its own; this
process receives what the subject puts out. Subjects:

- `relay`: publishes every wrench as it is;
- `relay_joints`: the same, and takes joint_states too, without looking at them;
- `gravcomp`: the compensator.

What rclpy itself costs is in the relays; the compensator's own work is the difference. Latency is
from the sender's publish call to this process's callback, so it holds two hops through DDS. CPU is
the subject's user and system time for one wrench, with the joint message that comes with it.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from galen_model.tool_file import LoadEstimate, ToolFile, tool_path, write_tool
from galen_ros.conversions import fill_stamp, stamp_to_ns
from galen_ros.domain import DomainLock
from galen_ros.qos import STREAM
from galen_ros.spin import make_executor, run
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

SUBJECTS = ("relay", "relay_joints", "gravcomp")
WARM_UP_S = 1.5
DISCOVERY_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class Measurement:
    """One subject at one rate."""

    subject: str
    rate_hz: float
    sent: int
    received: int
    cpu_us_per_wrench: float
    cpu_percent: float
    latency_median_ms: float
    latency_p99_ms: float
    latency_max_ms: float


class Relay(Node):
    """Publishes each wrench as it comes."""

    def __init__(self, take_joints: bool) -> None:
        super().__init__("relay")
        self._out = self.create_publisher(WrenchStamped, "wrench_compensated", STREAM)
        self.create_subscription(WrenchStamped, "wrench_raw", self._out.publish, STREAM)
        if take_joints:
            self.create_subscription(JointState, "joint_states", self._on_joint_state, STREAM)

    def _on_joint_state(self, message: JointState) -> None:
        """Only the cost of receiving it is wanted."""


def send(rate_hz: float) -> None:
    """Publish joints and wrenches at a rate until the process is ended."""
    # Without rclpy's handlers SIGTERM ends this endless loop at once.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("sender")
    joints_publisher = node.create_publisher(JointState, "joint_states", STREAM)
    wrench_publisher = node.create_publisher(WrenchStamped, "wrench_raw", STREAM)
    joints, wrench = JointState(), WrenchStamped()
    joints.name = ["delta_x", "delta_y", "delta_z", "roll", "tilt"]
    joints.position = [0.0, 0.0, 0.408, 0.2, -0.1]
    joints.velocity = [0.0] * 5
    wrench.header.frame_id = "ft_sensor"
    period_s = 1.0 / rate_hz
    next_s = time.monotonic()
    while True:
        next_s += period_s
        time.sleep(max(0.0, next_s - time.monotonic()))
        now_ns = time.time_ns()
        fill_stamp(joints.header.stamp, now_ns)
        fill_stamp(wrench.header.stamp, now_ns)
        joints_publisher.publish(joints)
        wrench_publisher.publish(wrench)


class Receiver(Node):
    """Notes the latency of every output."""

    def __init__(self, **options: Any) -> None:
        super().__init__("receiver", **options)
        self.latencies_ns: list[int] = []
        self.create_subscription(WrenchStamped, "wrench_compensated", self._on_wrench, STREAM)

    def _on_wrench(self, message: WrenchStamped) -> None:
        self.latencies_ns.append(time.time_ns() - stamp_to_ns(message.header.stamp))


def cpu_s(pid: int) -> float:
    """User and system time of a process so far, s (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(subject: str, rate_hz: float, seconds: float, tools_dir: Path) -> Measurement:
    """Run sender and subject for a while and take the numbers."""
    lock = DomainLock()
    environment = os.environ | {"ROS_DOMAIN_ID": str(lock.domain_id)}
    if subject == "gravcomp":
        arguments = ["galen_gravcomp.node", "--ros-args", "--log-level", "error"]
        arguments += ["-p", f"tools_dir:={tools_dir}", "-p", "tool:=bench"]
    else:
        arguments = ["galen_gravcomp.benchmark", "--role", subject]
    sending = ["galen_gravcomp.benchmark", "--role", "sender", "--rates", str(rate_hz)]
    processes = []
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=lock.domain_id)
    executor = make_executor(context)
    receiver = Receiver(context=context)
    executor.add_node(receiver)

    def spin_for(duration_s: float) -> None:
        until_s = time.monotonic() + duration_s
        while (left_s := until_s - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=min(left_s, 0.05))

    try:
        for module_arguments in (arguments, sending):
            processes.append(
                subprocess.Popen([sys.executable, "-m", *module_arguments], env=environment)
            )
        deadline_s = time.monotonic() + DISCOVERY_TIMEOUT_S
        while not receiver.latencies_ns:
            if time.monotonic() > deadline_s:
                raise RuntimeError(f"nothing came from {subject} for {DISCOVERY_TIMEOUT_S:g} s")
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
        raise RuntimeError(f"{subject} stopped putting out anything at {rate_hz:g} Hz")
    median, p99 = np.percentile(latencies_ms, (50, 99))
    return Measurement(
        subject=subject,
        rate_hz=rate_hz,
        sent=round(rate_hz * elapsed_s),
        received=len(latencies_ms),
        cpu_us_per_wrench=1e6 * cpu_used_s / len(latencies_ms),
        cpu_percent=100.0 * cpu_used_s / elapsed_s,
        latency_median_ms=float(median),
        latency_p99_ms=float(p99),
        latency_max_ms=float(latencies_ms.max()),
    )


def write_bench_tool(tools_dir: Path) -> None:
    """A tool file for the compensator to use."""
    load = LoadEstimate(0.06, np.array([0.055, 0.002, 0.045]), np.eye(4) * 1e-8)
    tool = ToolFile(
        tool="bench",
        load=load,
        bias=load,
        tip_m=np.zeros(3),
        rmse=np.zeros(6),
        poses_used=0,
        calibrated_at="2026-01-01T00:00:00+00:00",
    )
    write_tool(tool_path(tools_dir, "bench"), tool)


def main() -> None:
    """Measure every subject at every rate and print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rates", type=float, nargs="+", default=[500.0], help="Hz")
    parser.add_argument("--seconds", type=float, default=10.0, help="measured time of each run")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--role", choices=("sender", "relay", "relay_joints"), help=argparse.SUPPRESS
    )
    options = parser.parse_args()
    if options.role == "sender":
        send(options.rates[0])
    elif options.role:
        run(lambda: Relay(take_joints=options.role == "relay_joints"), args=[])
    else:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        results = []
        with tempfile.TemporaryDirectory() as directory:
            write_bench_tool(Path(directory))
            for rate_hz in options.rates:
                for subject in SUBJECTS:
                    result = measure(subject, rate_hz, options.seconds, Path(directory))
                    results.append(result)
                    if not options.json:
                        print_row(result, first=len(results) == 1)
        if options.json:
            print(json.dumps([asdict(result) for result in results], indent=2))


def print_row(result: Measurement, first: bool) -> None:
    """Print one line of the table."""
    if first:
        print("subject       rate Hz  received  CPU us/wrench  CPU %  median ms  p99 ms  max ms")
    print(
        f"{result.subject:12s} {result.rate_hz:8g} {result.received:5d}/{result.sent:<5d}"
        f"{result.cpu_us_per_wrench:10.0f} {result.cpu_percent:8.1f} "
        f"{result.latency_median_ms:9.2f} {result.latency_p99_ms:8.2f}"
        f" {result.latency_max_ms:7.2f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
