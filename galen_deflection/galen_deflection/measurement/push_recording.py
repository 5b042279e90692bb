# SPDX-License-Identifier: Apache-2.0
"""Read a recording of pushes: load and marker, at the tool marker's stamps.

The wrench is compensated as by the live node. Joints and wrench are interpolated at the stamps of
the tool's marker; the base's marker is a mean. Where stamps jump, samples lack, a
marker is lost, the base moved or the arm went elsewhere, a new segment begins; every finding is a
sentence in `problems`.

For the base's marker: one mean over the recording instead of the pose at each stamp, because its
rotation noise acts through the lever to the tool: 0.1 mrad over 0.7 m is 0.07 mm, more than all the
rest.
What error is left in the mean, the registration takes up: it multiplies every pose from the left,
as the unknown pose of base_link in the marker does.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from galen_bags.arrays.marker_tracks import MarkerTrack, RawTrack, marker_track, read_poses
from galen_bags.arrays.timeline import Timeline, interpolated
from galen_bags.formats.bag import open_bag
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.distributions import chi2_isf
from galen_model.files.calibration_file import CalibrationFile
from galen_model.registration import Transform, mean_pose

from galen_deflection.measurement.arm_track import (
    ArmTrack,
    Stay,
    find_stays,
    no_contact_phase,
    noise_of_mean,
    read_arm_track,
)
from galen_deflection.measurement.samples import DeflectionError

TOOL_POSE, BASE_POSE = "tracker/tool_pose", "tracker/base_pose"
"""Topics by name, or by the end of their name (`ArmTopics`)."""

_MAX_GAP_S = 0.1
"""Nothing is interpolated over more, and more without a sample begins a segment."""

_JUMP_S = 0.03
"""Stamps whose delay to their log times changes by more, and stays so, jumped."""

_NS = 1e9
# Of the base's marker: fewer samples are no mean.
_LEAST_SAMPLES = 20
_FALSE_MOVES_A_RECORDING = 1e-6
# A smaller move than this part of one sample's noise does no harm; a mean may drift as much.
_LEAST_SHARE_OF_NOISE = 0.25
_LEAST_NOISE = 1e-6
_CLIP_SIGMAS = 4.0
_MOST_MOVES = 20
_BLOCK = 15


class BaseStand(NamedTuple):
    """The base's marker while it stood: from start_ns to before end_ns.

    pose: mean in `tracker`; std (6,): of one sample, m and rad.
    """

    start_ns: int
    end_ns: int
    pose: Transform
    std: Array


@dataclass(frozen=True)
class PushRecording:
    """Samples (n,) at the stamps of the tool's marker, of the arm standing at its positions.

    stamp_ns, segment, position, visit, stand (n,): `stand` counts in `stands`, visits from 0 for
    each position; joints (n, j) m and rad; wrench (n, 6) compensated, ft_sensor, N and N.m; marker
    (n): the tool's marker in the base's marker. untouched (n,): before the first push of a visit,
    without contact. positions (p, j): joints.
    """

    path: Path
    tool: CalibrationFile
    arm: Arm
    stamp_ns: np.ndarray
    segment: np.ndarray
    position: np.ndarray
    visit: np.ndarray
    stand: np.ndarray
    joints: Array
    wrench: Array
    marker: Transform
    untouched: np.ndarray
    positions: Array
    stands: tuple[BaseStand, ...]
    start_ns: int
    problems: tuple[str, ...]

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.stamp_ns)


def read_pushes(
    path: str | os.PathLike[str],
    tool: CalibrationFile,
    on_progress: Callable[[int, int | None], None] | None = None,
    *,
    arm: Arm,
) -> PushRecording:
    """Read a recording of pushes.

    Args:
        path: bag to read.
        tool: calibration of the tool that was on.
        on_progress: called with the arm's messages read so far and their number, None where that is
            not known.
        arm: the arm that was recorded.

    Returns:
        Samples at the stamps of the tool's marker.

    Raises:
        BagError: the bag can't be read or lacks a topic.
        DeflectionError: no sample is left; the message gives the reasons.

    """
    with open_bag(path) as bag:
        track = read_arm_track(bag, tool, jump_s=_JUMP_S, arm=arm, on_progress=on_progress)
        tool_raw, base_raw = read_poses(bag, (TOOL_POSE, BASE_POSE))
        problems = [*bag.problems, *track.problems]
    return _assembled(Path(path), tool, arm, track, (tool_raw, base_raw), problems)


def _assembled(
    path: Path,
    tool: CalibrationFile,
    robot: Arm,
    arm: ArmTrack,
    markers: tuple[RawTrack, RawTrack],
    problems: list[str],
) -> PushRecording:
    tool_raw, base_raw = markers
    start_ns = arm.start_ns
    track = marker_track(tool_raw, _JUMP_S, start_ns, may_stand=False)
    base = marker_track(base_raw, _JUMP_S, start_ns, may_stand=True)
    problems = [*problems, *track.problems, *base.problems]
    if set(tool_raw.frame_ids) != set(base_raw.frame_ids):
        raise DeflectionError(
            f"{path}: {track.topic} is in {', '.join(tool_raw.frame_ids)}, {base.topic} in"
            f" {', '.join(base_raw.frame_ids)}: they must be in one frame"
        )
    problems += _other_clocks(arm, track)
    if len(base) < _LEAST_SAMPLES:
        raise DeflectionError(_nothing(path, f"{base.topic} has {len(base)} poses", problems))
    stands, moved = base_stands(base, start_ns)
    problems += moved
    stays, positions = find_stays(arm.joint_line, arm.joints, robot)
    if not stays:
        raise DeflectionError(_nothing(path, "the arm never stands still", problems))

    at_ns = track.line.time_ns
    joints, joints_known, joint_shift = interpolated(arm.joint_line, arm.joints, at_ns, _MAX_GAP_S)
    wrench, wrench_known, wrench_shift = interpolated(
        arm.wrench_line, arm.wrenches, at_ns, _MAX_GAP_S
    )
    jump_ns = _JUMP_S * _NS
    agree = np.abs(track.line.shift_ns - joint_shift) <= jump_ns
    agree &= np.abs(track.line.shift_ns - wrench_shift) <= jump_ns
    stay = _inside(at_ns, [(s.start_ns, s.end_ns) for s in stays])
    # At the rims of a stay, the first and last samples of the topics don't come together.
    inner = _inside(at_ns, [_shrunk(s) for s in stays]) >= 0
    for lost, why in (
        (~agree & inner, "stamps differ from the other topics' after a jump"),
        (agree & ~joints_known & inner, f"no {arm.joint_topic} around"),
        (agree & joints_known & ~wrench_known & inner, "no compensated wrench around"),
    ):
        if lost.any():
            first_s = (at_ns[lost][0] - start_ns) / _NS
            problems.append(
                f"{track.topic}: {int(lost.sum())} samples left out from {first_s:.2f} s on: {why}"
            )
    keep = (stay >= 0) & agree & joints_known & wrench_known
    if not keep.any():
        raise DeflectionError(_nothing(path, "no sample is left", problems))

    phases = _phases_of_visits(arm, stays, problems)
    at_ns, stay = at_ns[keep], stay[keep]
    position = np.array([s.position for s in stays])[stay]
    stand = _stand_of(at_ns, stands)
    segment = _segments(track.line.kept(keep), stay, stand)
    untouched = _inside(at_ns, phases) >= 0
    base_in_tracker = Transform(
        np.array([s.pose.rotation for s in stands])[stand],
        np.array([s.pose.translation for s in stands])[stand],
    )
    return PushRecording(
        path=path,
        tool=tool,
        arm=robot,
        stamp_ns=track.line.stamp_ns[keep],
        segment=segment,
        position=position,
        visit=np.array([s.visit for s in stays])[stay],
        stand=stand,
        joints=robot.nearest(joints[keep], positions[position]),
        wrench=wrench[keep],
        marker=base_in_tracker.inverse() @ track.poses[keep],
        untouched=untouched,
        positions=positions,
        stands=tuple(stands),
        start_ns=start_ns,
        problems=tuple(problems),
    )


def _other_clocks(arm: ArmTrack, track: MarkerTrack) -> list[str]:
    found = []
    for topic, line in ((arm.wrench_topic, arm.wrench_line), (track.topic, track.line)):
        behind_s = (line.delay_ns - arm.joint_line.delay_ns) / _NS
        if abs(behind_s) > _JUMP_S:
            found.append(
                f"{topic}: stamps are {abs(behind_s):.3f} s"
                f" {'behind' if behind_s > 0 else 'ahead of'} those of {arm.joint_topic}, by when"
                " they were received; are they from another clock?"
            )
    return found


def _nothing(path: Path, what: str, problems: list[str]) -> str:
    return f"{path}: {what}" + "".join(f"; {problem}" for problem in problems)


def _inside(at_ns: np.ndarray, spans: list[tuple[int, int]]) -> np.ndarray:
    """Which of the spans, in order and apart from each other, each time (n,) is in; -1 for none."""
    if not spans:
        return np.full(len(at_ns), -1)
    starts, ends = np.array(spans, dtype=np.int64).T
    which = np.searchsorted(starts, at_ns, side="right") - 1
    return np.where((which >= 0) & (at_ns <= ends[np.maximum(which, 0)]), which, -1)


def _shrunk(stay: Stay) -> tuple[int, int]:
    margin_ns = round(_MAX_GAP_S * _NS)
    return stay.start_ns + margin_ns, stay.end_ns - margin_ns


def _stand_of(at_ns: np.ndarray, stands: list[BaseStand]) -> np.ndarray:
    return np.searchsorted([s.start_ns for s in stands], at_ns, side="right") - 1


def _segments(line: Timeline, stay: np.ndarray, stand: np.ndarray) -> np.ndarray:
    """Numbers (n,) of runs without a gap, a jump, a move of the base or of the arm."""
    new = np.diff(line.time_ns) > _MAX_GAP_S * _NS
    for number in (line.shift_ns, stay, stand):
        new |= np.diff(number) != 0
    return np.concatenate([[0], np.cumsum(new)])


def _phases_of_visits(
    arm: ArmTrack, stays: list[Stay], problems: list[str]
) -> list[tuple[int, int]]:
    """Without contact before the first push; a visit with contact at its start is a problem."""
    visits: list[list[Stay]] = []
    for stay in stays:
        if visits and visits[-1][-1].position == stay.position:
            visits[-1].append(stay)
        else:
            visits.append([stay])
    phases = []
    line = arm.wrench_line
    noise = noise_of_mean(line.time_ns, arm.wrenches)
    for visit in visits:
        inside = (line.time_ns >= visit[0].start_ns) & (line.time_ns <= visit[-1].end_ns)
        phase, _, why_none = no_contact_phase(line.time_ns[inside], arm.wrenches[inside], noise)
        if phase is None:
            at_s = (visit[0].start_ns - arm.start_ns) / _NS
            problems.append(
                f"position {visit[0].position}, visited at {at_s:.1f} s: not untouched at first:"
                f" {why_none}"
            )
        else:
            phases.append(phase)
    return phases


# The base's marker


def base_stands(track: MarkerTrack, start_ns: int) -> tuple[list[BaseStand], list[str]]:
    """Return where the marker stood, one after the other, and sentences about its moves.

    Moves are found by splitting at the largest step of the means on both sides, in units of the
    noise, for as long as it is larger than chance makes it anywhere in the recording (binary
    segmentation: Vostrikova, *Soviet Math. Doklady* 24, 1981). Poses far off are clipped, so that
    one of them makes no move; the noise's own correlation in time counts against a move.

    Args:
        track: the base marker's poses in `tracker`.
        start_ns: the recording's start, from which the sentences count time.

    Returns:
        Stands, which together cover all time; a sentence for each move.

    """
    mean, _, _ = mean_pose(track.poses)
    off = track.poses.displacement_from(mean)
    # The floor is for a marker that was looked at once, and published for ever.
    noise = np.maximum(_noise(off), _LEAST_NOISE)
    cuts = _moves(off / noise)
    edges = [0, *cuts, len(track)]
    time_ns = track.line.time_ns
    stands = []
    for number, (first, stop) in enumerate(pairwise(edges)):
        pose, std, _ = mean_pose(track.poses[first:stop])
        begin = int(time_ns[first]) if number else -(1 << 62)
        end = int(time_ns[stop]) if stop < len(track) else 1 << 62
        stands.append(BaseStand(begin, end, pose, std))
    moves = []
    for before, after in pairwise(stands):
        step = after.pose.displacement_from(before.pose)
        moves.append(
            f"{track.topic}: the base's marker moved at {(after.start_ns - start_ns) * 1e-9:.2f} s,"
            f" by {1e3 * np.linalg.norm(step[:3]):.3f} mm and"
            f" {1e3 * np.linalg.norm(step[3:]):.3f} mrad; cut there"
        )
    if len(cuts) >= _MOST_MOVES:
        moves.append(f"{track.topic}: the base's marker does not stand still")
    return stands, moves


def _noise(off: Array) -> Array:
    """Return the standard deviation (6,) of one sample, by differences: a move doesn't count."""
    return np.asarray(1.4826 * np.median(np.abs(np.diff(off, axis=0)), axis=0) / np.sqrt(2.0))


def _correlation(scaled: Array) -> float:
    """How much more a mean scatters than of white noise, as a factor of its variance, at least 1.

    By means of blocks, from the differences of neighbours.
    """
    count = len(scaled) // _BLOCK
    if count < 4:
        return 1.0
    blocks = scaled[: count * _BLOCK].reshape(count, _BLOCK, -1).mean(axis=1)
    scatter = 1.4826 * np.median(np.abs(np.diff(blocks, axis=0)), axis=0) / np.sqrt(2.0)
    return float(max(1.0, _BLOCK * np.mean(scatter**2)))


def _moves(scaled: Array) -> list[int]:
    """Rows at which a new stand begins; scaled (n, 6) in units of the noise."""
    limit = chi2_isf(_FALSE_MOVES_A_RECORDING / max(len(scaled), 1), scaled.shape[1])
    limit *= _correlation(scaled)
    found: list[int] = []
    todo = [(0, len(scaled))]
    while todo and len(found) < _MOST_MOVES:
        first, stop = todo.pop()
        count = stop - first
        if count < 2 * _LEAST_SAMPLES:
            continue
        part = scaled[first:stop]
        middle = np.median(part, axis=0)
        spread = np.maximum(1.4826 * np.median(np.abs(part - middle), axis=0), 1.0)
        part = np.clip(part - middle, -_CLIP_SIGMAS * spread, _CLIP_SIGMAS * spread)
        left = np.arange(_LEAST_SAMPLES, count - _LEAST_SAMPLES + 1)
        sums = np.cumsum(part, axis=0)
        step = (
            sums[left - 1] / left[:, None] - (sums[-1] - sums[left - 1]) / (count - left)[:, None]
        )
        score = np.sum(step**2, axis=1) * left * (count - left) / count
        best = int(np.argmax(score))
        if score[best] > limit and np.max(np.abs(step[best])) > _LEAST_SHARE_OF_NOISE:
            at = first + int(left[best])
            found.append(at)
            todo += [(first, at), (at, stop)]
    return sorted(found)
