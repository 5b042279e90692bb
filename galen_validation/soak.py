# SPDX-License-Identifier: Apache-2.0
"""Run the nodes for long and look at what wears out: losses, memory, stamps, latency.

    make soak                           # an hour of simulated time, then 10 minutes at 1000 Hz
    make soak ARGS="--only real --minutes 60"

- `simulated`: the simulated arm moves about at `--speed` times real time; gravcomp compensates.
- `real`: a sender gives 1000 wrenches and joint vectors a second with the system's stamps;
  gravcomp compensates, deflection predicts from what comes out.

This process hears every wrench_raw, wrench_compensated and deflection and compares their stamps one
by one. Memory is each process's resident set. What counts is its slope after the first tenth.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from galen_bringup.processes import Processes, ros_arguments, ros_world
from galen_common.cdr import NS_PER_S, STAMP_AT
from galen_model.arm.galen import GALEN
from galen_model.files.atomic_file import write_whole
from galen_ros.messages import STREAM
from galen_ros.node.diagnostics import Level
from galen_ros.node.spin import make_executor
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rich.console import Console
from rich.table import Table
from tqdm import tqdm
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from galen_msgs.msg import DeflectionStamped
from galen_validation.nominal import NAME, write_bench_models, write_bench_tool
from galen_validation.speed.nodes import cpu_s

_ALLOWED_NS = 500_000_000


@dataclass
class Account:
    """What became of the stamps of one input so far."""

    went_in: int = 0
    came_out: int = 0
    lost: int = 0
    doubled: int = 0
    unknown: int = 0
    """Came out without having gone in."""
    disordered: int = 0


class StampLedger:
    """Compares the stamps of an output with those of its input, a stretch at a time.

    Both are heard from their publishers, in any order among each other. What went in more than
    half a second before the newest of both is looked at and forgotten, so that memory is bounded.
    """

    def __init__(self, allowed_ns: int = _ALLOWED_NS) -> None:
        """`allowed_ns`: so much later by stamps may an output be heard."""
        self.account = Account()
        self._allowed_ns = allowed_ns
        self._inputs: list[int] = []
        self._outputs: list[int] = []
        self._newest_out = 0
        self._begun = False

    def go_in(self, stamp_ns: int) -> None:
        """Enter a stamp that was heard on the input.

        Args:
            stamp_ns: Stamp of the message.

        """
        self._inputs.append(stamp_ns)

    def come_out(self, stamp_ns: int) -> None:
        """Enter a stamp that was heard on the output.

        Args:
            stamp_ns: Stamp of the message.

        """
        if stamp_ns < self._newest_out:
            self.account.disordered += 1
        self._newest_out = max(self._newest_out, stamp_ns)
        self._outputs.append(stamp_ns)

    def settle(self, *, last: bool = False) -> None:
        """Compare all stamps that are old enough, and forget them.

        The first stretch begins with the first stamp that was heard on both sides.

        Args:
            last: Whether to compare up to the newest stamp of both sides, and not `allowed_ns`
                less; where the output ended, up to 60 times that before the newest input.

        """
        if not self._inputs or not self._newest_out:
            return
        newest_in = max(self._inputs)
        until_ns = min(newest_in, self._newest_out)
        if last:
            until_ns = max(until_ns, newest_in - 60 * self._allowed_ns)
        else:
            until_ns -= self._allowed_ns
        inputs = [stamp for stamp in self._inputs if stamp <= until_ns]
        outputs = [stamp for stamp in self._outputs if stamp <= until_ns]
        self._inputs = [stamp for stamp in self._inputs if stamp > until_ns]
        self._outputs = [stamp for stamp in self._outputs if stamp > until_ns]
        known, seen = set(inputs), set(outputs)
        if not self._begun and known and seen:
            common = known & seen
            if not common:
                return
            begin_ns = min(common)
            known = {stamp for stamp in known if stamp >= begin_ns}
            outputs = [stamp for stamp in outputs if stamp >= begin_ns]
            seen = set(outputs)
            self._begun = True
        self.account.went_in += len(known)
        self.account.came_out += len(outputs)
        self.account.lost += len(known - seen)
        self.account.unknown += len(seen - known)
        self.account.doubled += len(outputs) - len(seen)


_WARM_UP_SHARE = 0.1


def slope_per_hour(time_s: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Return the slope after the warm-up and its standard error; of least squares.

    The error takes neighbouring windows as independent; memory that steps isn't, so that it is too
    small for a process that grew once.

    Args:
        time_s: Ends of the windows, s.
        values: One for each window.

    Returns:
        Slope and standard error in the values' unit per hour; nan of fewer than three values.

    """
    first = int(len(time_s) * _WARM_UP_SHARE)
    hours, y = np.array(time_s[first:]) / 3600.0, np.array(values[first:])
    if len(y) < 3:
        return float("nan"), float("nan")
    design = np.column_stack([hours - hours.mean(), np.ones_like(hours)])
    solution, *_ = np.linalg.lstsq(design, y, rcond=None)
    rest = y - design @ solution
    spread = np.sqrt(rest @ rest / (len(y) - 2) / np.sum(design[:, 0] ** 2))
    return float(solution[0]), float(spread)


def print_report(one: Soaked, console: Console) -> None:
    """Print streams, memory and delays.

    Args:
        one: What was seen of one kind.
        console: Where to print.

    """
    real = one.kind == "real"
    title = f"{one.seconds / 60:.1f} min of wall time"
    if not real:
        title += f", {one.simulated_s / 3600:.2f} h of simulated time"
    console.rule(f"[bold]{one.kind}: {title}", align="left")
    streams = Table("stream", "in", "out", "lost", "doubled", "unknown", "out of order", box=None)
    for name, a in one.accounts.items():
        numbers = (a.went_in, a.came_out, a.lost, a.doubled, a.unknown, a.disordered)
        streams.add_row(name, *(str(number) for number in numbers))
    console.print(streams)
    memory = Table("process", "CPU %", "MB first", "MB last", "MB/h after warm-up", box=None)
    for name, values in one.memory_mb.items():
        slope, error = slope_per_hour(one.time_s, values)
        memory.add_row(
            name, f"{one.cpu_percent[name]:.0f}", f"{values[0]:.1f}", f"{values[-1]:.1f}",
            f"{slope:+.2f} +- {error:.2f}",
        )  # fmt: skip
    console.print(memory)
    if real:
        slope, error = slope_per_hour(one.time_s, one.delay_p50_ms)
        console.print(
            f"stamp to compensation, windows of 5 s: median {np.median(one.delay_p50_ms):.2f} ms, "
            f"99 % {np.median(one.delay_p99_ms):.1f} ms, largest {max(one.delay_max_ms):.1f} ms; "
            f"the median drifts by {slope:+.2f} +- {error:.2f} ms/h"
        )
    console.print(
        f"stamps over wall time: {one.pace[-1]:.6f}"
        + (f", off by {1e6 * (one.pace[-1] - 1):+.0f} ppm" if real else "")
    )
    for state, (count, text) in one.states.items():
        console.print(f"/diagnostics, {state}, {count} times, the last: {text}")


KINDS = ("simulated", "real")
_WINDOW_S = 5.0
_MOVE_EVERY_S = 4.0
_START_TIMEOUT_S = 60.0
_SETTLE_S = 2.0


@dataclass
class Soaked:
    """What was seen. Windows are of 5 s of wall time; memory in MB, latencies in ms.

    delay: from a wrench's stamp to its compensation here (real time only); pace: simulated over
    wall time, from the start to each window's end. states: what /diagnostics said beside OK, by
    node and state: how often, and the last sentence.
    """

    kind: str
    seconds: float
    simulated_s: float
    accounts: dict[str, Account]
    cpu_percent: dict[str, float]
    time_s: list[float] = field(default_factory=list)
    memory_mb: dict[str, list[float]] = field(default_factory=dict)
    delay_p50_ms: list[float] = field(default_factory=list)
    delay_p99_ms: list[float] = field(default_factory=list)
    delay_max_ms: list[float] = field(default_factory=list)
    pace: list[float] = field(default_factory=list)
    states: dict[str, tuple[int, str]] = field(default_factory=dict)

    @property
    def whole(self) -> bool:
        """Whether nothing was lost, doubled, made up or out of order."""
        return all(
            account.went_in > 0
            and not (account.lost or account.doubled or account.unknown or account.disordered)
            for account in self.accounts.values()
        )


class Listener(Node):
    """Hears the streams as bytes, and looks at their stamps only."""

    def __init__(self, with_deflection: bool) -> None:
        super().__init__("soak_listener")
        self.ledgers = {"wrench_compensated": StampLedger()}
        if with_deflection:
            self.ledgers["deflection"] = StampLedger()
        self.stamp_ns = 0
        self.delays_ns: list[int] = []
        self.states: dict[str, tuple[int, str]] = {}
        self.compensated = 0
        self.deflections = 0
        self._move = self.create_publisher(JointTrajectory, "joint_trajectory", 10)
        self._rng = np.random.default_rng(1)
        self.create_subscription(WrenchStamped, "wrench_raw", self._on_raw, STREAM, raw=True)
        self.create_subscription(
            WrenchStamped, "wrench_compensated", self._on_compensated, STREAM, raw=True
        )
        if with_deflection:
            self.create_subscription(
                DeflectionStamped, "deflection", self._on_deflection, STREAM, raw=True
            )
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_state, 50)

    def _on_raw(self, data: bytes) -> None:
        self.stamp_ns = _stamp_ns(data)
        self.ledgers["wrench_compensated"].go_in(self.stamp_ns)

    def _on_compensated(self, data: bytes) -> None:
        stamp_ns = _stamp_ns(data)
        self.compensated += 1
        self.delays_ns.append(time.time_ns() - stamp_ns)
        self.ledgers["wrench_compensated"].come_out(stamp_ns)
        if "deflection" in self.ledgers:
            self.ledgers["deflection"].go_in(stamp_ns)

    def _on_deflection(self, data: bytes) -> None:
        self.deflections += 1
        self.ledgers["deflection"].come_out(_stamp_ns(data))

    def _on_state(self, message: DiagnosticArray) -> None:
        for status in message.status:
            level = status.level[0] if isinstance(status.level, bytes) else status.level
            if level != Level.OK.value and "galen" in status.hardware_id:
                state = next((one.value for one in status.values if one.key == "state"), "")
                key = f"{status.name} {state}".rstrip()
                count, _ = self.states.get(key, (0, ""))
                self.states[key] = count + 1, status.message

    def move(self) -> None:
        """Send the arm somewhere."""
        joints = GALEN.home + self._rng.uniform(-1, 1, 5) * [0.05, 0.05, 0.04, 1.2, 0.8]
        point = JointTrajectoryPoint(positions=joints.tolist())
        point.time_from_start.sec = int(_MOVE_EVERY_S) - 1
        self._move.publish(JointTrajectory(joint_names=list(GALEN.joint_names), points=[point]))


def _stamp_ns(data: bytes) -> int:
    sec, nanosec = struct.unpack_from("<iI", data, STAMP_AT)
    return int(sec * NS_PER_S + nanosec)


def memory_mb(pid: int) -> float:
    """Return the resident set of a process (Linux).

    Args:
        pid: Its process id.

    Returns:
        MB, of 1e6 bytes.

    Raises:
        RuntimeError: The process has ended and wasn't waited for.
        OSError: There is no such process.

    """
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise RuntimeError(f"process {pid} has ended")


def soak(kind: str, seconds: float, speed: float, rate_hz: float, folder: Path) -> Soaked:
    """Run one kind of load.

    Args:
        kind: One of KINDS.
        seconds: Wall time to watch, s.
        speed: Simulated over wall time, of `simulated`.
        rate_hz: Wrenches per second, of `real`.
        folder: Existing folder for calibration, models and logs.

    Returns:
        What was seen.

    Raises:
        ProcessError: A process ended.
        RuntimeError: Nothing came out for a minute.

    """
    simulated = kind == "simulated"
    write_bench_tool(folder)
    springs = write_bench_models(folder)[0]
    with ExitStack() as stack:
        stack.enter_context(ros_world())
        processes = stack.enter_context(Processes(folder / "log"))
        pids = {}
        if simulated:
            driver = ros_arguments({"speed_factor": speed, "initial_tool": NAME})
            pids["driver"] = processes.start("galen_sim_driver", "sim_driver_node", driver)
        given = {"tools_dir": folder, "tool": NAME, "use_sim_time": simulated}
        pids["gravcomp"] = processes.start("galen_gravcomp", "gravcomp_node", ros_arguments(given))
        if not simulated:
            pids["deflection"] = processes.start(
                "galen_deflection", "deflection_node", ros_arguments({"model_file": springs})
            )
            pids["sender"] = stack.enter_context(_sender(rate_hz))
        executor = make_executor()
        listener = Listener(with_deflection=not simulated)
        executor.add_node(listener)
        stack.callback(executor.shutdown)
        stack.callback(listener.destroy_node)
        stack.callback(lambda: executor.remove_node(listener))
        return _watch(kind, seconds, listener, executor, processes, pids)


@contextmanager
def _sender(rate_hz: float) -> Iterator[int]:
    """Run the benchmark's sender; gives its process id."""
    arguments = ["galen_validation.speed.relays", "sender", "wrench_raw", str(rate_hz), "moving"]
    process = subprocess.Popen([sys.executable, "-m", *arguments])
    try:
        yield process.pid
    finally:
        process.terminate()
        process.wait(timeout=10.0)


def _watch(
    kind: str,
    seconds: float,
    listener: Listener,
    executor: Any,
    processes: Processes,
    pids: dict[str, int],
) -> Soaked:
    def spin(duration_s: float) -> None:
        until_s = time.monotonic() + duration_s
        while (left_s := until_s - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=min(left_s, 0.05))

    began_s = time.monotonic()
    while not listener.compensated or (
        "deflection" in listener.ledgers and not listener.deflections
    ):
        spin(0.1)
        processes.check()
        if time.monotonic() - began_s > _START_TIMEOUT_S:
            raise RuntimeError(f"nothing came out for {_START_TIMEOUT_S:g} s")
    spin(_SETTLE_S)
    listener.states.clear()
    listener.delays_ns.clear()
    out = Soaked(kind, seconds, 0.0, {}, {}, memory_mb={name: [] for name in pids})
    used_s = {name: cpu_s(pid) for name, pid in pids.items()}
    start_s, start_ns, move_s = time.monotonic(), listener.stamp_ns, 0.0
    with tqdm(total=round(seconds), unit="s", disable=not sys.stderr.isatty()) as bar:
        while (now_s := time.monotonic() - start_s) < seconds:
            if kind == "simulated" and now_s >= move_s:
                listener.move()
                move_s = now_s + _MOVE_EVERY_S / 2.0
            spin(min(_WINDOW_S if kind == "real" else 2.0, seconds - now_s))
            processes.check()
            for ledger in listener.ledgers.values():
                ledger.settle()
            passed_s = time.monotonic() - start_s
            if not out.time_s or passed_s - out.time_s[-1] >= 0.9 * _WINDOW_S:
                out.time_s.append(passed_s)
                for name, pid in pids.items():
                    out.memory_mb[name].append(memory_mb(pid))
                # Where nothing came out, a wrench is late by the window at least.
                delays_ms = np.array(listener.delays_ns or [round(_WINDOW_S * NS_PER_S)]) * 1e-6
                listener.delays_ns.clear()
                if kind == "real":
                    p50, p99 = np.percentile(delays_ms, (50, 99))
                    out.delay_p50_ms.append(float(p50))
                    out.delay_p99_ms.append(float(p99))
                    out.delay_max_ms.append(float(delays_ms.max()))
                out.pace.append((listener.stamp_ns - start_ns) * 1e-9 / passed_s)
            bar.update(round(passed_s) - bar.n)
    elapsed_s = time.monotonic() - start_s
    out.seconds = elapsed_s
    out.simulated_s = (listener.stamp_ns - start_ns) * 1e-9
    out.cpu_percent = {
        name: 100.0 * (cpu_s(pid) - used_s[name]) / elapsed_s for name, pid in pids.items()
    }
    for name, ledger in listener.ledgers.items():
        ledger.settle(last=True)
        out.accounts[name] = ledger.account
    out.states = dict(listener.states)
    return out


def build_parser() -> argparse.ArgumentParser:
    """Build the command's options."""
    parser = argparse.ArgumentParser(
        prog="make soak",
        description=(__doc__ or "").partition("\n")[0],
        epilog="Ends with 1 where a wrench was lost, doubled, made up or out of order.",
    )
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS), help="which")
    parser.add_argument("--hours", type=float, default=1.0, help="of simulated time (1)")
    parser.add_argument("--speed", type=float, default=4.0, help="simulated over wall time (4)")
    parser.add_argument("--minutes", type=float, default=10.0, help="of real time (10)")
    parser.add_argument("--rate", type=float, default=1000.0, help="in real time, Hz (1000)")
    parser.add_argument(
        "--output", type=Path, default=Path("output/soak"), metavar="DIR", help="results go here"
    )
    parser.add_argument("--json", action="store_true", help="print JSON in place of tables")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Be the command.

    Args:
        arguments: Command line; None for the process's own.

    Returns:
        Exit code; 1 where a stamp was lost, doubled, unknown or out of order.

    """
    options = build_parser().parse_args(arguments)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    found = []
    for kind in (kind for kind in KINDS if kind in options.only):
        simulated = kind == "simulated"
        seconds = 3600.0 * options.hours / options.speed if simulated else 60.0 * options.minutes
        with tempfile.TemporaryDirectory(prefix="galen_soak_") as folder:
            found.append(soak(kind, seconds, options.speed, options.rate, Path(folder)))
        text = json.dumps([asdict(one) for one in found], indent=1)
        write_whole(options.output / "soak.json", text + "\n")
    if options.json:
        print(text)
    else:
        console = Console(width=None if sys.stdout.isatty() else 120)
        for one in found:
            print_report(one, console)
    return 0 if all(one.whole for one in found) else 1


if __name__ == "__main__":
    sys.exit(main())
