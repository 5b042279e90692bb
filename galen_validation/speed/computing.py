# SPDX-License-Identifier: Apache-2.0
"""What computing costs, without any ROS: each against a baseline in the same run.

- compensation of one sample: the node's kernel against the weight by Pinocchio's forward kinematics
  and against the formula of other packages (R^T m g and the centre's torque, R from the caller);
- compensation of an array: against the same formula on arrays, and against writing as many bytes
  as the kernel has to read and write, once (numpy's copy): what memory allows;
- six joints: compensation of one sample and of arrays, against gravity in the sensor by Pinocchio
  alone, one sample after the other;
- regression: a calibration's two sweeps of 56 and of 10 000 poses, against one plain least squares
  of the same equations;
- hysteresis: a sample of a deflection model with two smooth plays at each spring, against the
  springs alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pinocchio
from galen_deflection.models.spring_model import SpringStream
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.arrays import Array
from galen_model.calibrated.prediction import Prediction
from galen_model.load.identification import identify_two_sweeps
from galen_model.load.model import gravity_regressor
from galen_model.load.readings import StillPoses
from rich.table import Table

from galen_validation.nominal import bench_models, bench_tool
from galen_validation.pinocchio_arm import PinocchioArm

TITLE = "computing"

_SAMPLES = 1_000_000
_PERIOD_NS = 2_000_000
_LEAST_S = 0.05
_UNITS = (("ns", 1e9), ("us", 1e6), ("ms", 1e3), ("s", 1.0))
_SIX_AXIS = Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf"
_GRAVITY = np.array([0.0, 0.0, -9.81])


Spread = tuple[float, float, float]
"""Least, median and largest of the rounds."""


@dataclass(frozen=True)
class Compared:
    """A subject beside its baseline, s a piece."""

    group: str
    subject: str
    baseline: str
    piece: str
    time_s: Spread
    baseline_s: Spread


def peer_wrench(rotation: Array, mass_kg: float, com_m: Array, reading: Array) -> Array:
    """Subtract the weight from a reading as other packages do: f = R^T m g, t = c x f.

    Args:
        rotation: Of the sensor in the base, (3, 3); from a transform tree in their case.
        mass_kg: Mass of the tool.
        com_m: Centre of mass in the sensor's frame, (3,), m.
        reading: Wrench in the sensor's frame, (6,), N and N.m.

    Returns:
        Reading without the weight, (6,).

    """
    force = rotation.T @ (mass_kg * _GRAVITY)
    return np.asarray(reading - np.concatenate([force, np.cross(com_m, force)]))


def one_sample(rounds: int) -> list[Compared]:
    """Compare the compensation of one sample at a time.

    Args:
        rounds: Turns of each subject.

    Returns:
        The kernel beside Pinocchio's kinematics, and beside the formula alone.

    """
    tool = bench_tool()
    kernel, arm = Prediction(tool, arm=GALEN), PinocchioArm()
    reading, joints = np.ones(6), np.array([0.0, 0.0, 0.408, 0.3, -0.2])
    mass, com = tool.load.mass_kg, tool.load.com_m
    turned, _ = arm.pose(joints)

    def ours() -> Array:
        return kernel.wrench(reading - kernel.reading((0.3, -0.2)))

    def by_pinocchio() -> Array:
        rotation, _ = arm.pose(joints)
        return peer_wrench(rotation, mass, com, reading)

    def by_peer() -> Array:
        return peer_wrench(turned, mass, com, reading)

    times = time_calls({"ours": ours, "pinocchio": by_pinocchio, "peer": by_peer}, rounds)
    return [
        Compared("compensation, one sample", "kernel", name, "sample", times["ours"], times[key])
        for key, name in (
            ("pinocchio", "Pinocchio's kinematics and the peers' formula"),
            ("peer", "the peers' formula, rotation given"),
        )
    ]


def arrays(rounds: int, samples: int = _SAMPLES) -> list[Compared]:
    """Compare the compensation of many samples at once.

    Args:
        rounds: Turns of each subject.
        samples: Number of samples.

    Returns:
        The kernel beside the formula on arrays, and beside a copy of as many bytes.

    """
    tool = bench_tool()
    kernel = Prediction(tool, arm=GALEN)
    random = np.random.default_rng(1)
    angles = random.uniform(-1.5, 1.5, (samples, 2))
    readings = random.normal(size=(samples, 6))
    from_here, to_here = np.ones(samples * 7), np.empty(samples * 7)
    mass, com = tool.load.mass_kg, tool.load.com_m

    def ours() -> Array:
        return kernel.compensate(readings, angles)

    def by_peer() -> Array:
        force = mass * GALEN.gravity_in_sensor(angles)
        return np.asarray(readings - np.concatenate([force, np.cross(com, force)], axis=1))

    def copied() -> None:
        # 8 doubles in, 6 out a sample; a copy of 7 reads 7 and writes 7.
        np.copyto(to_here, from_here)

    each = time_calls({"ours": ours, "peer": by_peer, "copy": copied}, rounds, pieces=samples)
    return [
        Compared("compensation, arrays", "kernel", name, "sample", each["ours"], each[key])
        for key, name in (("peer", "the peers' formula on arrays"), ("copy", "memory"))
    ]


def six_joints(rounds: int, samples: int = _SAMPLES // 10) -> list[Compared]:
    """Compare the compensation of an arm with six revolute joints.

    Args:
        rounds: Turns of each subject.
        samples: Number of samples in the arrays.

    Returns:
        One sample and arrays, each beside gravity in the sensor by Pinocchio, one sample at a time.

    """
    text = _SIX_AXIS.read_text(encoding="utf-8")
    arm, model = read_arm(text), pinocchio.buildModelFromXML(text)
    data, sensor = model.createData(), model.getFrameId(arm.sensor_frame)
    angles, readings = np.random.default_rng(3).uniform(-1.0, 1.0, (2, samples, 6))
    one, joints, reading = tuple(angles[0].tolist()), angles[0], readings[0]
    kernel = Prediction(replace(bench_tool(), arm=arm), arm)

    def ours() -> Array:
        return kernel.wrench(reading - kernel.reading(one))

    def by_pinocchio() -> Array:
        pinocchio.forwardKinematics(model, data, joints)
        placement = pinocchio.updateFramePlacement(model, data, sensor)
        return np.asarray(placement.rotation.T @ arm.gravity_m_s2)

    live = time_calls({"ours": ours, "base": by_pinocchio}, rounds)
    calls = {"ours": partial(kernel.compensate, readings, angles)}
    whole = time_calls(calls, rounds, pieces=samples)
    return [
        Compared(f"six joints, {what}", "kernel", "gravity in the sensor by Pinocchio, one sample",
                 "sample", times["ours"], live["base"])
        for what, times in (("one sample", live), ("arrays", whole))
    ]  # fmt: skip


def regression(rounds: int) -> list[Compared]:
    """Compare a whole calibration's computing, checks included.

    Args:
        rounds: Turns of each subject.

    Returns:
        Calibrations of 56 and of 10 000 poses beside one plain least squares each.

    """
    out = []
    for poses in (56, 10_000):
        bare, tool = _sweeps(poses)
        rows = _plain_rows(bare, tool)
        target = np.concatenate([bare.wrench, tool.wrench]).ravel()
        calls: dict[str, Callable[[], object]] = {
            "ours": partial(identify_two_sweeps, bare, tool),
            "plain": partial(np.linalg.lstsq, rows, target, rcond=None),
        }
        times = time_calls(calls, rounds)
        out.append(
            Compared(
                "calibration's regression",
                f"two sweeps of {poses} poses",
                "one plain least squares",
                "calibration",
                times["ours"],
                times["plain"],
            )
        )
    return out


def hysteresis(rounds: int) -> list[Compared]:
    """Compare a sample of the deflection's models as they stream.

    Args:
        rounds: Turns of each subject.

    Returns:
        Springs with plays beside springs.

    """
    random = np.random.default_rng(2)
    joints = np.array([0.0, 0.0, 0.408, 0.3, -0.2]) + 1e-4 * random.normal(size=(256, 5))
    wrench = 3.0 * np.sin(0.05 * np.arange(256))[:, None] * np.array([1, 0.3, 0.5, 0, 0, 0.01])
    calls: dict[str, Callable[[], object]] = {
        model.name: partial(_step, model.stream(), list(zip(joints, wrench, strict=True)), count(1))
        for model in bench_models()
    }
    times = time_calls(calls, rounds, pieces=256)
    springs, plays = times
    return [
        Compared("deflection, one sample", plays, springs, "sample", times[plays], times[springs])
    ]


def _step(stream: SpringStream, samples: list[tuple[Array, Array]], turns: Iterator[int]) -> None:
    """Stream all samples through a model, at 500 Hz by their stamps, turn after turn."""
    now_ns = next(turns) * len(samples) * _PERIOD_NS
    for joints, wrench in samples:
        now_ns += _PERIOD_NS
        stream.step(now_ns, joints, wrench)


def _sweeps(poses: int) -> tuple[StillPoses, StillPoses]:
    random = np.random.default_rng(poses)
    tool = bench_tool()
    out = []
    for load in (0.0, 1.0):
        angles = random.uniform((-1.4, -0.9), (1.4, 0.8), (poses, 2))
        whole = tool.predict(angles) * (1.0 + load)
        noise = SENSOR.noise_std / 10.0 * random.normal(size=(poses, 6))
        out.append(StillPoses(angles, whole + noise, arm=GALEN))
    return out[0], out[1]


def _plain_rows(bare: StillPoses, tool: StillPoses) -> Array:
    """Both sweeps' mass and first moment, and an offset each: (12 n, 14)."""
    return np.concatenate([_with_offset(bare, 0), _with_offset(tool, 1)])


def _with_offset(sweep: StillPoses, number: int) -> Array:
    regressor = gravity_regressor(sweep.gravity)
    n, axes, columns = regressor.shape
    rows = np.zeros((n, axes, 2 * columns + axes))
    rows[:, :, :columns] = regressor
    if number:
        rows[:, :, columns : 2 * columns] = regressor
    rows[:, :, 2 * columns :] = np.eye(axes)
    return rows.reshape(n * axes, -1)


def time_calls(
    subjects: Mapping[str, Callable[[], object]], rounds: int, pieces: int = 1
) -> dict[str, Spread]:
    """Time each subject.

    Subjects take turns, so that what else the machine does meets all of them. A round calls a
    subject so often that it takes at least 0.05 s.

    Args:
        subjects: Calls by name.
        rounds: Turns of each subject.
        pieces: How many pieces a call works on.

    Returns:
        By name, least, median and largest time of a piece over the rounds, s.

    """
    often = {name: _often(call) for name, call in subjects.items()}
    seconds: dict[str, list[float]] = {name: [] for name in subjects}
    for _ in range(rounds):
        for name, call in subjects.items():
            started = time.perf_counter()
            for _ in range(often[name]):
                call()
            seconds[name].append((time.perf_counter() - started) / often[name] / pieces)
    return {name: (min(each), float(np.median(each)), max(each)) for name, each in seconds.items()}


def _often(call: Callable[[], object]) -> int:
    """Count how many calls take that long; the first one, which fills caches, doesn't count."""
    call()
    number = 1
    while True:
        started = time.perf_counter()
        for _ in range(number):
            call()
        taken = time.perf_counter() - started
        if taken >= _LEAST_S:
            return number
        number = max(number + 1, int(1.2 * number * _LEAST_S / max(taken, 1e-9)))


PARTS: tuple[Callable[[int], list[Compared]], ...] = (
    one_sample, arrays, six_joints, regression, hysteresis,
)  # fmt: skip


def measure(options: argparse.Namespace, progress: Callable[[str], None]) -> list[Compared]:
    """Time all of PARTS.

    Args:
        options: The command's; each part has three times its `rounds`.
        progress: Called with the part's name before it.

    Returns:
        All comparisons, in the order of PARTS.

    """
    out = []
    for part in PARTS:
        progress(part.__name__.replace("_", " "))
        out += part(3 * options.rounds)
    return out


def table(found: Sequence[Compared]) -> Table:
    """Make a row of each comparison: least/median/largest, and the ratio of the medians.

    Args:
        found: What `measure` returned.

    Returns:
        The table.

    """
    out = Table("what", "subject", "time", "baseline", "its time", "ratio", box=None,
                header_style="bold")  # fmt: skip
    for one in found:
        ours, base = (_words(each, one.piece) for each in (one.time_s, one.baseline_s))
        ratio = one.time_s[1] / one.baseline_s[1]
        out.add_row(one.group, one.subject, ours, one.baseline, base, f"{ratio:.2f}")
    return out


def _words(spread_s: Spread, piece: str) -> str:
    unit, scale = next(
        ((unit, scale) for unit, scale in _UNITS if spread_s[1] * scale < 1000.0), _UNITS[-1]
    )
    return "/".join(f"{value * scale:.3g}" for value in spread_s) + f" {unit} a {piece}"
