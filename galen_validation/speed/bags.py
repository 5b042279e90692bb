# SPDX-License-Identifier: Apache-2.0
"""Time and memory of `evaluate` on bags, beside only reading them with the library rosbags.

    make bench ARGS="--only bags --hours 0.25 0.5 1"

For each length a bag of joint_states and wrench_raw (MCAP, zstd) is generated, and worked through
by processes of their own, one after the other, each measured by itself:

- `rosbags read`: the plain read, `rosbags.rosbag2.Reader.messages`;
- `rosbags read and deserialise`: the same, and `deserialize_cdr` of each message: the baseline;
- `read into arrays`: `galen_bags`, of which the evaluation is built;
- `evaluate`: all of it, compensation, checks and report.

Memory is the process's largest resident set, imports included.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_bags.arrays.arm_recording import ArmReader
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_gravcomp.evaluate.bag import evaluate_bag
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.files.calibration_file import read_calibration, write_calibration
from rich.table import Table
from tqdm import tqdm

from galen_validation.nominal import bench_tool

TITLE = "evaluate beside reading alone"
_RATE_HZ = 500.0
_START_NS = 1_767_225_600_000_000_000
_BLOCK_S = 60.0
_HOLD_S, _MOVE_S = 4.0, 2.0


@dataclass(frozen=True)
class Read:
    """One subject on one bag."""

    subject: str
    hours: float
    messages: int
    seconds: float
    us_a_message: float
    peak_mb: float


def generate(path: Path, hours: float, *, quiet: bool) -> int:
    """Write a recording: a pose is held for 4 s, then 2 s of motion.

    Args:
        path: Bag to write.
        hours: Its length; both topics have 500 Hz.
        quiet: Whether to show no progress bar.

    Returns:
        Number of messages of both topics.

    """
    rng = np.random.default_rng(1)
    tool = bench_tool()
    period_ns = round(1e9 / _RATE_HZ)
    total = round(hours * 3600.0 * _RATE_HZ)
    states, forces = joint_state_bytes(GALEN.joint_names), wrench_bytes("ft_sensor")
    goals = rng.uniform([-1.3, -0.9], [1.3, 0.9], size=(round(hours * 3600 / 6) + 2, 2))
    with (
        BagWriter(path) as bag,
        tqdm(total=total, unit="sample", unit_scale=True, disable=quiet) as bar,
    ):
        joints = bag.add_topic("joint_states", "sensor_msgs/msg/JointState")
        wrenches = bag.add_topic("wrench_raw", "geometry_msgs/msg/WrenchStamped")
        block = round(_BLOCK_S * _RATE_HZ)
        for first in range(0, total, block):
            number = np.arange(first, min(first + block, total))
            angles = _angles(number / _RATE_HZ, goals)
            noise = SENSOR.noise_std * rng.normal(size=(len(number), 6))
            wrench = tool.predict(angles) + noise
            wrench = np.round(wrench / SENSOR.quantum) * SENSOR.quantum
            angles = np.round(angles / 5e-5) * 5e-5
            rows = zip((_START_NS + number * period_ns).tolist(), angles.tolist(), wrench.tolist(),
                       strict=True)  # fmt: skip
            for stamp_ns, pair, reading in rows:
                position = [0.0, 0.0, 0.408, *pair]
                message = states.fill(stamp_ns, position, [0.0] * 5)
                bag.write(joints, stamp_ns + 200_000, message)
                bag.write(wrenches, stamp_ns + 250_000, forces.fill(stamp_ns, reading))
            bar.update(len(number))
    return 2 * total


def _angles(time_s: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Roll and tilt (n, 2), rad: held, then a smooth step to the next goal."""
    cycle = _HOLD_S + _MOVE_S
    number = (time_s // cycle).astype(int)
    s = np.clip((time_s - number * cycle - _HOLD_S) / _MOVE_S, 0.0, 1.0)
    smooth = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return np.asarray(goals[number] + smooth[:, None] * (goals[number + 1] - goals[number]))


def rosbags_read(bag: Path, _tool: Path) -> int:
    """Read every message by rosbags.

    Args:
        bag: Bag to read.
        _tool: Not used; subjects are called alike.

    Returns:
        Number of messages.

    """
    from rosbags.rosbag2 import Reader

    with Reader(bag) as reader:
        return sum(1 for _ in reader.messages())


def rosbags_deserialise(bag: Path, _tool: Path) -> int:
    """Read and deserialise every message by rosbags.

    Args:
        bag: Bag to read.
        _tool: Not used; subjects are called alike.

    Returns:
        Number of messages.

    """
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    count = 0
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            types.deserialize_cdr(data, connection.msgtype)
            count += 1
    return count


def read_arrays(bag: Path, _tool: Path) -> int:
    """Read every message into arrays.

    Args:
        bag: Bag to read.
        _tool: Not used; subjects are called alike.

    Returns:
        Number of messages.

    """
    with open_bag(bag) as opened:
        return sum(len(block.is_wrench) for block in ArmReader(opened, arm=GALEN).blocks())


def evaluate(bag: Path, tool: Path) -> int:
    """Evaluate the bag.

    Args:
        bag: Bag to read.
        tool: Calibration file.

    Returns:
        Number of messages of both topics.

    Raises:
        AssertionError: Not every wrench was compensated.

    """
    result = evaluate_bag(bag, read_calibration(tool, GALEN))
    assert result.compensated == result.wrench_stamps.count, result.rejected
    return result.joint_stamps.count + result.wrench_stamps.count


SUBJECTS: dict[str, Callable[[Path, Path], int]] = {
    "rosbags read": rosbags_read,
    "rosbags read and deserialise": rosbags_deserialise,
    "read into arrays": read_arrays,
    "evaluate": evaluate,
}
_BASELINE = "rosbags read and deserialise"


def _measure_once(subject: str, bag: Path, tool: Path, hours: float, messages: int) -> Read:
    """Run a subject in a process of its own."""
    command = [sys.executable, "-m", "galen_validation.speed.bags", subject]
    done = subprocess.run(
        [*command, str(bag), str(tool)], check=True, capture_output=True, text=True
    )
    found = json.loads(done.stdout)
    if found["messages"] != messages:
        raise RuntimeError(f"{subject} saw {found['messages']} of {messages} messages")
    seconds = found["seconds"]
    return Read(subject, hours, messages, seconds, 1e6 * seconds / messages, found["peak_mb"])


def run_subject(subject: str, bag: Path, tool: Path) -> None:
    """Run a subject in this process and print messages, seconds and peak memory as JSON.

    Args:
        subject: Name of one of SUBJECTS.
        bag: Bag to read.
        tool: Calibration file.

    """
    begin = time.perf_counter()
    messages = SUBJECTS[subject](bag, tool)
    seconds = time.perf_counter() - begin
    print(json.dumps({"messages": messages, "seconds": seconds, "peak_mb": _peak_mb()}))


def _peak_mb() -> float:
    """Largest resident set since the process began; getrusage's would hold the parent's as well."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (peak,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(peak) * 1024 / 1e6


def table(measurements: list[Read]) -> Table:
    """Make a row of each subject at each length, with its time over the baseline's.

    Args:
        measurements: What `measure` returned.

    Returns:
        The table.

    """
    out = Table("subject", box=None, header_style="bold")
    for name in ("hours", "messages", "s", "us a message", "of the baseline", "peak MB"):
        out.add_column(name, justify="right")
    for one in measurements:
        baseline = next(
            (m.seconds for m in measurements if m.subject == _BASELINE and m.hours == one.hours),
            float("nan"),
        )
        out.add_row(
            one.subject, f"{one.hours:g}", str(one.messages), f"{one.seconds:.1f}",
            f"{one.us_a_message:.2f}", f"{one.seconds / baseline:.3f}", f"{one.peak_mb:.0f}",
        )  # fmt: skip
    return out


def measure(options: argparse.Namespace, progress: Callable[[str], None]) -> list[Read]:
    """Measure every subject on a bag of each length.

    Args:
        options: The command's; `hours`: lengths of bags.
        progress: Called with what is done next.

    Returns:
        One for each length and subject.

    Raises:
        RuntimeError: A subject saw another number of messages than the bag has.
        subprocess.CalledProcessError: A subject failed.

    """
    out: list[Read] = []
    for length in options.hours:
        with tempfile.TemporaryDirectory(prefix="galen_bench_") as directory:
            bag, tool = Path(directory, "bag"), Path(directory, "bench.json")
            write_calibration(tool, bench_tool())
            progress(f"writing a bag of {length:g} h")
            messages = generate(bag, length, quiet=not sys.stderr.isatty())
            for name in SUBJECTS:
                progress(f"{name}, {length:g} h")
                out.append(_measure_once(name, bag, tool, length, messages))
    return out


def main() -> None:
    """Run one subject: `measure` starts a process for each."""
    subject, bag, tool = sys.argv[1:]
    run_subject(subject, Path(bag), Path(tool))


if __name__ == "__main__":
    main()
