"""Read the arm's joints and compensated wrenches from a bag, each on its line of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from galen_bags.arrays.arm_recording import ArmReader, Samples, join_samples
from galen_bags.arrays.timeline import Timeline, interpolated, lay_out, stamp_sentences
from galen_bags.formats.bag import Bag
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.prediction import Prediction
from galen_ros.stream.samples import joint_jump

from galen_deflection.errors import DeflectionError

# The live node's `max_joint_age_s`: joints are not interpolated over more.
_MAX_JOINT_GAP_S = 0.05
# Poses at which a cable's pull is computed at once.
_CABLE_ROWS = 2048


@dataclass(frozen=True)
class ArmTrack:
    """joints (n, j) m and rad, wrenches (m, 6) compensated, N and N.m, with their lines of time.

    start_ns: the first stamp; problems: sentences, with times in s after it.
    """

    joint_line: Timeline
    joints: Array
    wrench_line: Timeline
    wrenches: Array
    start_ns: int
    joint_topic: str
    wrench_topic: str
    problems: tuple[str, ...]


def read_arm_track(
    bag: Bag,
    tool: CalibrationFile,
    *,
    jump_s: float,
    arm: Arm = GALEN,
    on_progress: Callable[[int, int | None], None] | None = None,
) -> ArmTrack:
    """Compensate a bag's wrenches as the live node does, at the joints of their stamps.

    Readings beyond the sensor's range are left out. Raises BagError, and DeflectionError where
    a joint lacks or no wrench can be compensated.
    """
    reader = ArmReader(bag)
    total, done = reader.message_count, 0
    blocks = []
    for block in reader.blocks():
        blocks.append(block)
        done += len(block.is_wrench)
        if on_progress is not None:
            on_progress(done, total)
    if not blocks:
        raise DeflectionError(f"{bag.path}: it holds no message of the arm")
    joints = join_samples([block.joints for block in blocks], 2 * len(arm.joints))
    readings = join_samples([block.wrenches for block in blocks], 6)
    joint_line = lay_out(
        joints.stamp_ns, np.concatenate([block.joint_log_ns for block in blocks]), jump_s
    )
    wrench_line = lay_out(
        readings.stamp_ns, np.concatenate([block.wrench_log_ns for block in blocks]), jump_s
    )
    positions = joints.values[joint_line.row, : len(arm.joints)]
    lacking = [
        name
        for name, k in zip(arm.joint_names, positions.T, strict=True)
        if not np.isfinite(k).any()
    ]
    if lacking:
        raise DeflectionError(f"{bag.path}: {reader.joint_states} lacks {', '.join(lacking)}")
    wrench, rejected = _compensated(tool, arm, joint_line, positions, wrench_line, readings)

    firsts = [int(line.time_ns[0]) for line in (joint_line, wrench_line) if len(line)]
    start_ns = min(firsts, default=0)
    problems = stamp_sentences(reader.joint_states, joint_line, start_ns)
    problems += stamp_sentences(reader.wrench_raw, wrench_line, start_ns)
    for topic, samples in ((reader.joint_states, joints), (reader.wrench_raw, readings)):
        if samples.bad:
            what = _count(len(samples.bad), "message", "messages")
            problems.append(f"{topic}: {what} can't be used: {next(iter(samples.bad.values()))}")
    problems += [f"{reader.wrench_raw}: {sentence}" for sentence in rejected]
    good = np.asarray(np.isfinite(wrench).all(axis=1))
    if not good.any():
        raise DeflectionError(
            f"{bag.path}: no wrench could be compensated" + "".join(f"; {p}" for p in problems)
        )
    return ArmTrack(
        joint_line,
        positions,
        wrench_line.kept(good),
        wrench[good],
        start_ns,
        reader.joint_states,
        reader.wrench_raw,
        tuple(problems),
    )


def _compensated(
    tool: CalibrationFile,
    arm: Arm,
    joint_line: Timeline,
    joints: Array,
    wrench_line: Timeline,
    readings: Samples,
) -> tuple[Array, list[str]]:
    """Wrenches (n, 6) on their line, NaN where there is none, and the reasons as sentences."""
    raw = readings.values[wrench_line.row]
    cable = tool.cable
    angles = arm.angles(joints)
    needed = angles if cable is None else joints
    jumped = np.zeros(len(joints), dtype=bool)
    steps = np.abs(np.nan_to_num(np.diff(angles, axis=0)))
    jumped[1:] = joint_jump(np.diff(joint_line.time_ns), steps.max(axis=1))
    needed = np.where(jumped[:, None], np.nan, needed)
    at, known, shift = interpolated(joint_line, needed, wrench_line.time_ns, _MAX_JOINT_GAP_S)
    known &= shift == wrench_line.shift_ns
    finite = np.isfinite(raw).all(axis=1)
    expected = np.array([name == tool.sensor_frame for name in readings.frame_ids], dtype=bool)
    framed = expected[readings.frame[wrench_line.row]]
    beyond = np.any(np.abs(raw) > SENSOR.range, axis=1)
    readable = np.ones(len(readings), dtype=bool)
    readable[list(readings.bad)] = False
    readable = readable[wrench_line.row]

    sentences = []
    for rows, why in (
        (readable & ~framed, f"frame_id is not {tool.sensor_frame!r}, the tool's sensor_frame"),
        (readable & framed & ~finite, "a value is not finite"),
        (
            readable & framed & finite & ~known,
            f"no joint angles within {_MAX_JOINT_GAP_S:g} s on both sides of the stamp",
        ),
    ):
        if rows.any():
            what = _count(int(rows.sum()), "wrench", "wrenches")
            sentences.append(f"{what} not compensated: {why}")
    used = readable & framed & finite & known
    if (used & beyond).any():
        what = _count(int((used & beyond).sum()), "wrench", "wrenches")
        first = ", ".join(f"{value:.4g}" for value in raw[used & beyond][0])
        sentences.append(f"{what} left out, beyond the sensor's range: {first}")
    used &= ~beyond

    wrench = np.full(raw.shape, np.nan)
    reading, at = raw[used], at[used]
    if cable is not None and len(at):
        reading = reading - np.concatenate(
            [
                cable.posterior.readings(at[first : first + _CABLE_ROWS])
                for first in range(0, len(at), _CABLE_ROWS)
            ]
        )
        at = arm.angles(at)
    wrench[used] = Prediction(tool, arm).compensate(reading, at)
    return wrench, sentences


def _count(number: int, one: str, several: str) -> str:
    return f"{number} {one if number == 1 else several}"
