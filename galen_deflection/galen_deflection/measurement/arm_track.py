"""The arm's joints and compensated wrenches out of a bag, each on its topic's line of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from galen_bags.arrays.arm_recording import ArmBlock, ArmReader, ArmTopics
from galen_bags.arrays.timeline import Timeline, lay_out, stamp_sentences
from galen_bags.formats.bag import Bag
from galen_gravcomp.arm_block import push_arm_block
from galen_gravcomp.compensator import Compensator, CompensatorSettings
from galen_model.arm.galen import JOINT_NAMES, SENSOR
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile

from galen_deflection.errors import PushRecordingError

_JOINTS = len(JOINT_NAMES)


@dataclass(frozen=True)
class ArmTrack:
    """joints (n, 5) m and rad, wrenches (m, 6) compensated, N and N.m, with their lines of time.

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
    topics: ArmTopics,
    settings: CompensatorSettings,
    *,
    jump_s: float,
    on_progress: Callable[[int, int | None], None] | None = None,
) -> ArmTrack:
    """Send a bag's samples through the live node's compensator, in the order received.

    Readings beyond the sensor's range are none, and left out. Raises BagError, and
    PushRecordingError where a joint lacks or no wrench comes out.
    """
    reader = ArmReader(bag, topics)
    compensator = Compensator(settings)
    compensator.set_tool(tool)
    total, done = reader.message_count, 0
    blocks: list[ArmBlock] = []
    numbers: list[np.ndarray] = []
    compensated: list[Array] = []
    rejections: dict[Enum, str] = {}
    unreadable: list[str] = []
    for block in reader.blocks():
        result = push_arm_block(compensator, block)
        numbers.append(result.index)
        compensated.append(result.wrench)
        for rejected in result.rejected:
            rejections.setdefault(rejected.reason, rejected.detail)
        unreadable += block.joints.bad.values()
        blocks.append(block)
        done += len(block.is_wrench)
        if on_progress is not None:
            on_progress(done, total)
    if not blocks:
        raise PushRecordingError(f"{bag.path}: it holds no message of the arm")

    joint_stamps = np.concatenate([block.joints.stamp_ns for block in blocks])
    joint_log = np.concatenate([block.joint_log_ns for block in blocks])
    joint_line = lay_out(joint_stamps, joint_log, jump_s)
    positions = np.concatenate([block.joints.values[:, :_JOINTS] for block in blocks])
    positions = positions[joint_line.row]
    lacking = [
        name for name, k in zip(JOINT_NAMES, positions.T, strict=True) if not np.isfinite(k).any()
    ]
    if lacking:
        raise PushRecordingError(f"{bag.path}: {reader.joint_states} lacks {', '.join(lacking)}")

    wrench_stamps = np.concatenate([block.wrenches.stamp_ns for block in blocks])
    wrench_log = np.concatenate([block.wrench_log_ns for block in blocks])
    wrench_line = lay_out(wrench_stamps, wrench_log, jump_s)
    wrench = np.full((len(wrench_stamps), 6), np.nan)
    wrench[np.concatenate(numbers)] = np.concatenate(compensated)
    readings = np.concatenate([block.wrenches.values for block in blocks])
    with np.errstate(invalid="ignore"):
        beyond = np.any(np.abs(readings) > SENSOR.range, axis=1) & np.isfinite(wrench).all(axis=1)
    wrench[beyond] = np.nan
    wrench = wrench[wrench_line.row]

    firsts = [int(line.time_ns[0]) for line in (joint_line, wrench_line) if len(line)]
    start_ns = min(firsts, default=0)
    problems = stamp_sentences(reader.joint_states, joint_line, start_ns)
    problems += stamp_sentences(reader.wrench_raw, wrench_line, start_ns)
    if unreadable:
        what = "message" if len(unreadable) == 1 else "messages"
        problems.append(
            f"{reader.joint_states}: {len(unreadable)} {what} can't be used: {unreadable[0]}"
        )
    for reason, detail in rejections.items():
        number = compensator.rejections[reason]
        what = "wrench" if number == 1 else "wrenches"
        problems.append(f"{reader.wrench_raw}: {number} {what} not compensated: {detail}")
    if beyond.any():
        what = "wrench" if beyond.sum() == 1 else "wrenches"
        problems.append(
            f"{reader.wrench_raw}: {int(beyond.sum())} {what} left out, beyond the sensor's range:"
            f" {', '.join(f'{value:.4g}' for value in readings[beyond][0])}"
        )
    if not compensator.compensated:
        raise PushRecordingError(
            f"{bag.path}: no wrench could be compensated" + "".join(f"; {p}" for p in problems)
        )
    good = np.isfinite(wrench).all(axis=1)
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
