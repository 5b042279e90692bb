# SPDX-License-Identifier: Apache-2.0
"""Cost, latency and loss of one node's process, against bare relays in the same run.

A sender process publishes joint_states and a wrench; the subject is a process of its own; this
process receives what the subject puts out. What rclpy itself costs is in the relays; the node's own
work is the difference. Latency is from the sender's publish call to this process's callback, so it
holds two hops through DDS. CPU is the subject's user and system time for one wrench, with the joint
message that comes with it. Loss is exact: a stamp's last digits are the wrench's number (the time
is good to 10 us). Subjects take turns, round by round, so that what else the machine does meets all
of them; ratios are of one round.
"""

from __future__ import annotations

import argparse
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from galen_common.cdr import NS_PER_S, STAMP_AT
from galen_ros.messages import STREAM
from galen_ros.node.spin import DomainLock, make_executor
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rich.table import Table

from galen_msgs.msg import DeflectionStamped
from galen_validation.nominal import NAME, write_bench_models, write_bench_tool
from galen_validation.speed.relays import NUMBERS

TITLE = "nodes beside bare relays"
WRENCH_TOPIC = "wrench_raw"
WARM_UP_S = 1.5
DISCOVERY_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Subject:
    """A process to measure: arguments after `python -m`, and the topic whose stamps are taken.

    others: further topics that it publishes, which are received as well and not looked at. moving:
    whether the arm moves, so that no two joint vectors are alike.
    """

    name: str
    arguments: tuple[str, ...]
    output: tuple[str, Any]
    others: tuple[tuple[str, Any], ...] = ()
    moving: bool = False


@dataclass(frozen=True)
class Measurement:
    """One subject at one rate, one round. lost: wrenches that never came out of it."""

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


def relays() -> list[Subject]:
    """Return the bare relays: of a wrench, with joints taken, and of a deflection."""
    module = "galen_validation.speed.relays"
    output = ("relayed", WrenchStamped)
    return [
        Subject("relay", (module, "relay", WRENCH_TOPIC), output),
        Subject("relay_joints", (module, "relay_joints", WRENCH_TOPIC), output),
        Subject(
            "relay_deflection",
            (module, "relay_deflection", WRENCH_TOPIC),
            ("relayed_deflection", DeflectionStamped),
            (("relayed_pose", PoseStamped),),
        ),
    ]


def gravcomp_nodes(tools_dir: Path) -> list[Subject]:
    """Return the compensator with its stages; writes a calibration file.

    Args:
        tools_dir: Existing folder, which gets the file.

    Returns:
        The node as it is by default, without its calibration monitor, and with motion from joints.

    """
    write_bench_tool(tools_dir)
    node = (
        *("galen_gravcomp.ros.node", "--ros-args", "--log-level", "error"),
        *("-p", f"tools_dir:={tools_dir}", "-p", f"tool:={NAME}"),
    )
    output = ("wrench_compensated", WrenchStamped)
    return [
        Subject("gravcomp", node, output, moving=True),
        Subject(
            "gravcomp, weight alone",
            (*node, "-p", "calibration_monitor:=false"),
            output,
            moving=True,
        ),
        Subject("gravcomp, motion", (*node, "-p", "motion:=joints"), output, moving=True),
    ]


def deflection_nodes(folder: Path) -> list[Subject]:
    """Return the deflection's node with each model, which takes `wrench_raw` as compensated.

    `stands` is the same with one joint vector, of which less has to be calculated.

    Args:
        folder: Existing folder, which gets the model files.

    Returns:
        Of each model, the node with the arm in motion and standing.

    """
    out = []
    for model in write_bench_models(folder):
        arguments = (
            *("galen_deflection.ros.node", "--ros-args", "--log-level", "error"),
            *("-r", f"wrench_compensated:={WRENCH_TOPIC}", "-p", f"model_file:={model}"),
        )
        given = ("deflection", DeflectionStamped)
        others = (("tip_pose_corrected", PoseStamped),)
        name = f"deflection, {model.stem}"
        out.append(Subject(name, arguments, given, others, moving=True))
        out.append(Subject(f"{name}, stands", arguments, given, others))
    return out


def measure(options: argparse.Namespace, progress: Callable[[str], None]) -> list[Measurement]:
    """Measure the nodes of the loop, beside the relays.

    Args:
        options: The command's: `subjects` (None for all), `rates` in Hz, `seconds` of each run,
            `rounds`.
        progress: Called with what is measured next.

    Returns:
        One for each rate, round and subject.

    Raises:
        RuntimeError: A subject puts out nothing.

    """
    with tempfile.TemporaryDirectory(prefix="galen_bench_") as directory:
        folder = Path(directory)
        relay, relay_joints, relay_deflection = relays()
        subjects = [
            *(relay, relay_joints, *gravcomp_nodes(folder)),
            *(relay_deflection, *deflection_nodes(folder)),
        ]
        if options.subjects:
            wanted = ("relay", *options.subjects)
            subjects = [one for one in subjects if one.name in wanted]
        return compare(subjects, options.rates, options.seconds, options.rounds, progress)


def compare(
    subjects: Sequence[Subject],
    rates_hz: Sequence[float],
    seconds: float,
    rounds: int,
    progress: Callable[[str], None],
) -> list[Measurement]:
    """Measure all subjects at every rate, turn by turn.

    Args:
        subjects: Processes to measure; ratios need the one named `relay`.
        rates_hz: Wrenches per second.
        seconds: Length of a measurement after the warm-up.
        rounds: Turns of each subject at a rate.
        progress: Called with what is measured next.

    Returns:
        One for each rate, round and subject.

    Raises:
        RuntimeError: A subject puts out nothing.

    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    found = []
    for rate_hz in rates_hz:
        for number in range(rounds):
            for subject in subjects:
                progress(f"{subject.name} at {rate_hz:g} Hz")
                found.append(_measure_once(subject, rate_hz, seconds, number))
    return found


class _Receiver(Node):
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
        """Cost what sending it to a listener costs."""

    def spin_for(self, executor: Any, duration_s: float) -> None:
        """Receive for so long."""
        until_s = time.monotonic() + duration_s
        while (left_s := until_s - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=min(left_s, 0.05))

    def start(self, executor: Any, subject: Subject) -> None:
        """Receive until the subject has warmed up, and begin to note anew."""
        deadline_s = time.monotonic() + DISCOVERY_TIMEOUT_S
        while not self.stamps_ns:
            if time.monotonic() > deadline_s:
                raise RuntimeError(
                    f"no output of {subject.name} within {DISCOVERY_TIMEOUT_S:g} s: does it start?"
                )
            self.spin_for(executor, 0.1)
        self.spin_for(executor, WARM_UP_S)
        self.stamps_ns.clear()
        self.times_ns.clear()


def cpu_s(pid: int) -> float:
    """Return user and system time of a process so far (Linux).

    Args:
        pid: Its process id.

    Returns:
        Seconds, in steps of the system's clock tick.

    Raises:
        OSError: There is no such process.

    """
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _measure_once(subject: Subject, rate_hz: float, seconds: float, number: int) -> Measurement:
    """Run sender and subject in a domain of their own for a while and take the numbers."""
    lock = DomainLock()
    environment = os.environ | {"ROS_DOMAIN_ID": str(lock.domain_id), "OMP_NUM_THREADS": "1"}
    sending: tuple[str, ...] = ("galen_validation.speed.relays", "sender")
    sending += (WRENCH_TOPIC, str(rate_hz))
    sending += ("moving",) * subject.moving
    processes: list[subprocess.Popen[bytes]] = []
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=lock.domain_id)
    executor = make_executor(context)
    receiver = _Receiver(subject, context=context)
    executor.add_node(receiver)
    try:
        for arguments in (subject.arguments, sending):
            command = [sys.executable, "-m", *arguments]
            processes.append(subprocess.Popen(command, env=environment))
        receiver.start(executor, subject)
        before_s, start_s = cpu_s(processes[0].pid), time.monotonic()
        receiver.spin_for(executor, seconds)
        used_s = cpu_s(processes[0].pid) - before_s
        elapsed_s = time.monotonic() - start_s
    finally:
        _end(processes)
        receiver.destroy_node()
        executor.shutdown()
        rclpy.shutdown(context=context)
        lock.release()
    stamps_ns = np.array(receiver.stamps_ns)
    if len(stamps_ns) == 0:
        raise RuntimeError(f"{subject.name} stopped putting out anything at {rate_hz:g} Hz")
    latencies_ms = (np.array(receiver.times_ns) - stamps_ns) * 1e-6
    p50, p99, p999 = np.percentile(latencies_ms, (50, 99, 99.9))
    return Measurement(
        subject=subject.name,
        rate_hz=rate_hz,
        round=number,
        received=len(latencies_ms),
        lost=lost_between(stamps_ns),
        cpu_us_per_wrench=1e6 * used_s / len(latencies_ms),
        cpu_percent=100.0 * used_s / elapsed_s,
        latency_p50_ms=float(p50),
        latency_p99_ms=float(p99),
        latency_p999_ms=float(p999),
        latency_max_ms=float(latencies_ms.max()),
    )


def _end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """End processes; those that have ended are left alone."""
    for process in processes:
        process.terminate()
    for process in processes:
        process.wait(timeout=10.0)


def lost_between(stamps_ns: np.ndarray) -> int:
    """Count the numbers that lack between the first and the last of stamps.

    Args:
        stamps_ns: Stamps as they came out, (n,), n > 0; the last four digits are the wrench's
            number.

    Returns:
        Number of lost wrenches.

    """
    numbers = stamps_ns % NUMBERS
    begun_again = np.concatenate([[0], np.cumsum(np.diff(numbers) < -NUMBERS // 2)])
    steps = np.diff(np.sort(numbers + begun_again * NUMBERS))
    return int(np.sum(steps - 1))


def ratios(found: Sequence[Measurement], subject: str, rate_hz: float, what: str) -> list[float]:
    """Divide a subject's number by the relay's of the same round, for each round.

    Args:
        found: Measurements of all subjects and rates.
        subject: Name of the subject.
        rate_hz: Rate that is compared.
        what: Name of a field of Measurement.

    Returns:
        Ratios of the rounds that have both.

    """
    by_round = {
        (one.subject, one.round): getattr(one, what) for one in found if one.rate_hz == rate_hz
    }
    return [
        value / by_round["relay", number]
        for (name, number), value in by_round.items()
        if name == subject and ("relay", number) in by_round
    ]


def table(found: Sequence[Measurement]) -> Table:
    """Make a row of each subject and rate: least/median/largest of the rounds.

    Args:
        found: What `measure` returned.

    Returns:
        The table.

    """
    out = Table(
        "subject", "Hz", "lost", "CPU us a wrench", "x relay", "p50 ms", "p99 ms", "x relay",
        "p99.9 ms", "largest ms", box=None, header_style="bold",
    )  # fmt: skip
    for column in out.columns[1:]:
        column.justify = "right"
    for rate_hz in dict.fromkeys(one.rate_hz for one in found):
        for subject in dict.fromkeys(one.subject for one in found):
            own = [one for one in found if (one.subject, one.rate_hz) == (subject, rate_hz)]
            lost, came = sum(one.lost for one in own), sum(one.received for one in own)

            def three(what: str, digits: int, own: list[Measurement] = own) -> str:
                return spread([getattr(one, what) for one in own], digits)

            out.add_row(
                subject, f"{rate_hz:g}", f"{lost} of {lost + came}",
                three("cpu_us_per_wrench", 0),
                spread(ratios(found, subject, rate_hz, "cpu_us_per_wrench"), 2),
                three("latency_p50_ms", 2), three("latency_p99_ms", 2),
                spread(ratios(found, subject, rate_hz, "latency_p99_ms"), 2),
                three("latency_p999_ms", 1), three("latency_max_ms", 1),
            )  # fmt: skip
        out.add_section()
    return out


def spread(values: Sequence[float], digits: int) -> str:
    """Return least, median and largest as text; one value alone.

    Args:
        values: Numbers of the rounds.
        digits: Digits after the point.

    Returns:
        Numbers with `/` between; empty of none.

    """
    if not values:
        return ""
    shown = [f"{v:.{digits}f}" for v in (min(values), statistics.median(values), max(values))]
    return shown[0] if len(values) == 1 else "/".join(shown)
