# SPDX-License-Identifier: Apache-2.0
"""Read the arm's joints and wrenches from a bag; where it stood, and when without contact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from galen_bags.arrays.arm_recording import ArmReader, Samples, join_samples
from galen_bags.arrays.timeline import Timeline, interpolated, lay_out, stamp_sentences
from galen_bags.formats.bag import Bag
from galen_common.stream.samples import joint_jump
from galen_model.arm.arm import Arm
from galen_model.arm.galen import SENSOR
from galen_model.arrays import Array
from galen_model.calibrated.prediction import Prediction
from galen_model.files.calibration_file import CalibrationFile
from galen_model.rest.segments import rest_by_joints

from galen_deflection.measurement.samples import DeflectionError

_SAME_M, _SAME_RAD = 2e-3, 1e-2

WINDOW_S = 0.1
"""Without contact, the wrench's mean over this window stays within SIGMAS of its noise."""

SIGMAS = 6.0

_MIN_DURATION_S = 0.5  # of the phase before the first push
_MARGIN_S = 0.1  # cut off before the wrench leaves the limits
_MAX_OFFSET = np.array([0.5] * 3 + [0.05] * 3)  # that the tool's file may be wrong by, N and N.m
_NS = 1e9
_MAD_TO_STD = 1.4826
_LOWER_QUARTILE = 0.3186  # of a normal deviate's absolute value


def same_position(arm: Arm) -> Array:
    """Return how near joints are that count as the same position.

    Args:
        arm: the arm whose joints they are.

    Returns:
        (j,), m and rad.

    """
    return np.array([_SAME_M if unit == "m" else _SAME_RAD for unit in arm.units])


class Stay(NamedTuple):
    """The arm stood at a position from start_ns to end_ns; `visit` counts the times it came."""

    start_ns: int
    end_ns: int
    position: int
    visit: int


def find_stays(line: Timeline, joints: Array, arm: Arm) -> tuple[list[Stay], Array]:
    """Return where the arm stood, in order, and the joints of each position.

    A stay at the place of the one before is the same visit.

    Args:
        line: the joint samples' times.
        joints: (n, j) of the line's samples, m and rad, unwrapped.
        arm: the arm whose joints they are.

    Returns:
        Stays; joints (p, j) by the positions' numbers, m and rad, of the first stay there, the
        endless ones within half a turn of home.

    """
    same = same_position(arm)
    positions: list[Array] = []
    visits: list[int] = []
    stays: list[Stay] = []
    for rows in rest_by_joints(line.time_ns, joints, arm=arm):
        here = arm.nearest(np.nanmedian(joints[rows], axis=0), arm.home)
        near = [
            k
            for k, p in enumerate(positions)
            if np.all(np.abs(arm.nearest(p, here) - here) <= same)
        ]
        if near:
            position = near[0]
        else:
            position = len(positions)
            positions.append(here)
            visits.append(-1)
        if not stays or stays[-1].position != position:
            visits[position] += 1
        first, last = line.time_ns[rows.start], line.time_ns[rows.stop - 1]
        stays.append(Stay(int(first), int(last), position, visits[position]))
    return stays, np.array(positions).reshape(-1, joints.shape[1])


def wrench_noise(wrenches: Array) -> Array:
    """Return the standard deviation of one sample's white noise, at least a quantum.

    From second differences, which smooth pushes hardly change.

    Args:
        wrenches: (n, 6), N and N.m.

    Returns:
        (6,), N and N.m.

    """
    steps = np.diff(wrenches, n=2, axis=0)
    if not len(steps):
        return np.asarray(SENSOR.quantum)
    # The median alone would be one of few values: readings come in quanta.
    limit = 4.0 * _MAD_TO_STD * np.median(np.abs(steps), axis=0)
    small = np.where(np.abs(steps) <= np.maximum(limit, SENSOR.quantum), steps, np.nan)
    return np.maximum(np.sqrt(np.nanmean(small**2, axis=0) / 6.0), SENSOR.quantum)


def noise_of_mean(time_ns: np.ndarray, wrenches: Array) -> Array:
    """Return the standard deviation of the mean over WINDOW_S, white noise or filtered.

    At least that of white noise. More comes from second differences of windows' means: of their
    absolute values the lower quartile, because many windows are inside of pushes; where half of
    them are, this is too large by a factor of two.

    Args:
        time_ns: (n,) the wrenches' times.
        wrenches: (n, 6), N and N.m.

    Returns:
        (6,), N and N.m.

    """
    width = _window_samples(time_ns)
    white = wrench_noise(wrenches) / np.sqrt(width)
    count = len(wrenches) // width
    if count < 12:
        return np.asarray(white)
    means = wrenches[: count * width].reshape(count, width, 6).mean(axis=1)
    steps = np.abs(np.diff(means, n=2, axis=0))
    return np.maximum(white, np.quantile(steps, 0.25, axis=0) / _LOWER_QUARTILE / np.sqrt(6.0))


def no_contact_phase(
    time_ns: np.ndarray, wrenches: Array, noise: Array
) -> tuple[tuple[int, int] | None, Array, str]:
    """Find the first phase without contact in one visit's wrenches.

    Args:
        time_ns: (n,) the wrenches' times, increasing.
        wrenches: (n, 6) compensated, N and N.m.
        noise: (6,) standard deviation of a mean over the window, as `noise_of_mean` returns it.

    Returns:
        From when to when (time_ns), or None; the mean wrench (6,) meanwhile, NaN without a phase;
        why there is none, in words, else empty.

    """
    nothing = np.full(6, np.nan)
    if len(time_ns) < 3:
        return None, nothing, "there are no wrenches"
    mean = _moving_mean(wrenches, _window_samples(time_ns))
    limit = SIGMAS * noise
    start_rows = int(np.searchsorted(time_ns, time_ns[0] + round(_MIN_DURATION_S * _NS)))
    stop = start_rows
    for _ in range(3):
        offset = wrenches[:stop].mean(axis=0)
        away = np.any(np.abs(mean - offset) > limit, axis=1)
        stop = int(np.argmax(away)) if away.any() else len(time_ns)
        if stop < start_rows:
            return None, nothing, "the wrench changes from the start"
    if np.any(np.abs(offset) > _MAX_OFFSET):
        force, torque = np.linalg.norm(offset[:3]), 1e3 * np.linalg.norm(offset[3:])
        return None, nothing, f"it begins under load ({force:.2f} N, {torque:.0f} mN·m)"
    margin_ns = round(_MARGIN_S * _NS)
    end_ns = int(time_ns[stop - 1]) - (margin_ns if stop < len(time_ns) else 0)
    if end_ns - time_ns[0] < _MIN_DURATION_S * _NS:
        return None, nothing, f"it is without contact for less than {_MIN_DURATION_S:g} s"
    return (int(time_ns[0]), end_ns), offset, ""


def _window_samples(time_ns: np.ndarray) -> int:
    """How many samples the window holds, at least one."""
    period_s = float(np.median(np.diff(time_ns))) / _NS if len(time_ns) > 1 else WINDOW_S
    return max(1, round(WINDOW_S / period_s))


def _moving_mean(values: Array, width: int) -> Array:
    """Means (n, k) over `width` neighbours, fewer at the ends."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    row = np.arange(len(values))
    low = np.maximum(row - (width - 1) // 2, 0)
    high = np.minimum(row + width // 2 + 1, len(values))
    return np.asarray((sums[high] - sums[low]) / (high - low)[:, None])


# The live node's `max_joint_age_s`: joints are not interpolated over more.
_MAX_JOINT_GAP_S = 0.05
# Poses at which a cable's pull is computed at once.
_CABLE_ROWS = 2048


@dataclass(frozen=True)
class ArmTrack:
    """joints (n, j) m and rad, wrenches (m, 6) compensated, N and N.m, with their lines of time.

    Endless joints are unwrapped. start_ns: the first stamp; problems: sentences, with times in s
    after it.
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
    arm: Arm,
    on_progress: Callable[[int, int | None], None] | None = None,
) -> ArmTrack:
    """Compensate a bag's wrenches as the live node does, at the joints of their stamps.

    Readings beyond the sensor's range are left out.

    Args:
        bag: bag with the arm's joints and raw wrenches.
        tool: calibration of the tool that was on.
        jump_s: stamps whose delay to their log times changes by more, s, jumped.
        arm: the arm that was recorded.
        on_progress: called with the messages read so far and their number, None where that is not
            known.

    Returns:
        Joints and compensated wrenches, at least one.

    Raises:
        BagError: the bag can't be read or lacks a topic.
        DeflectionError: a joint lacks, or no wrench can be compensated.

    """
    reader = ArmReader(bag, arm=arm)
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
    positions = arm.unwrapped(joints.values[joint_line.row, : len(arm.joints)])
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
