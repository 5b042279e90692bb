"""Reads a diagnostic recording (contract, section 5): up to three bags and the tool's file.

Nothing else in its directory is opened, and nothing of its name is used but to say which it is.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_bags.arm_recording import ArmRecording, ArmTopics, read_arm
from galen_bags.bag import open_bag
from galen_bags.errors import BagError
from galen_deflection.marker_tracks import marker_track, read_poses
from galen_model.arrays import Array
from galen_model.tool_file import ToolFile, read_tool

from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.rows import BAGS

_JUMP_S = 1.0
_TRACKER_TOPICS = ("tracker/tool_pose", "tracker/base_pose")
_LEAST_SAMPLES = 50


@dataclass(frozen=True)
class Track:
    """Poses of a marker in `tracker`: at_s (n,), rotation (n, 3, 3), position (n, 3) m."""

    at_s: Array
    rotation: Array
    position: Array

    def __len__(self) -> int:
        return len(self.at_s)


@dataclass(frozen=True)
class BagData:
    """One bag; times in s since its first stamp, in increasing order.

    start_s: its first stamp since the recording's. joint_s (nj,), joints (nj, 5) m and rad;
    wrench_s (nw,), wrenches (nw, 6) N and N.m in ft_sensor; the two markers, None without.
    """

    name: str
    start_s: float
    joint_s: Array
    joints: Array
    wrench_s: Array
    wrenches: Array
    tool_marker: Track | None
    base_marker: Track | None


@dataclass(frozen=True)
class Recording:
    """What there is: bags by name, in the contract's order; `missing` names those that aren't."""

    name: str
    tool: ToolFile
    bags: dict[str, BagData]
    missing: tuple[str, ...]
    problems: tuple[str, ...]


def read_recording(
    path: str | os.PathLike[str],
    tool: str | os.PathLike[str] | None = None,
    topics: ArmTopics | None = None,
    progress: Callable[[str], None] | None = None,
) -> Recording:
    """Read a recording's directory; raises DiagnosisError, BagError or ToolFileError.

    tool: the tool's file, where it isn't the directory's own tool.json. Missing bags are named in
    `missing`; without any there is nothing to diagnose.
    """
    path = Path(path)
    if not path.is_dir():
        raise DiagnosisError(f"{path}: no directory with a recording")
    tool_file = read_tool(path / "tool.json" if tool is None else tool)
    arms: dict[str, ArmRecording] = {}
    problems: list[str] = []
    for name in BAGS:
        if (path / name).exists():
            if progress is not None:
                progress(name)
            arms[name] = read_arm(path / name, topics)
            problems += [f"{name}: {problem}" for problem in arms[name].problems]
    if not arms:
        raise DiagnosisError(f"{path}: holds none of the bags {', '.join(BAGS)}")
    for name, arm in arms.items():
        _check(path / name, arm, tool_file)
    session_ns = min(_first_ns(arm) for arm in arms.values())
    bags = {name: _bag(path / name, name, arm, session_ns, problems) for name, arm in arms.items()}
    if tool_file.mounting is not None or tool_file.cable is not None:
        problems.append(
            "the tool's file has an estimate of the sensor's mounting or of a cable; the nominal "
            "model of a diagnosis leaves them out, and so finds them again"
        )
    missing = tuple(name for name in BAGS if name not in arms)
    return Recording(path.name or str(path), tool_file, bags, missing, tuple(problems))


def _first_ns(arm: ArmRecording) -> int:
    return int(min(arm.joint_stamp_ns.min(), arm.wrench_stamp_ns.min()))


def _check(path: Path, arm: ArmRecording, tool: ToolFile) -> None:
    if len(arm.joint_stamp_ns) < _LEAST_SAMPLES or len(arm.wrench_stamp_ns) < _LEAST_SAMPLES:
        raise DiagnosisError(
            f"{path}: {len(arm.joint_stamp_ns)} joint states and {len(arm.wrench_stamp_ns)} "
            f"wrenches; at least {_LEAST_SAMPLES} of each are needed"
        )
    if not np.isfinite(arm.joints).all():
        raise DiagnosisError(f"{path}: joint states don't name all five joints")
    other = [frame for frame in arm.frame_ids if frame and frame != tool.sensor_frame]
    if other:
        raise DiagnosisError(
            f"{path}: wrenches in frame {other[0]!r}, but the tool's file is for "
            f"{tool.sensor_frame!r}"
        )


def _bag(path: Path, name: str, arm: ArmRecording, session_ns: int, problems: list[str]) -> BagData:
    first_ns = _first_ns(arm)
    joint_s, joints = _in_time(arm.joint_stamp_ns, arm.joints, first_ns)
    wrench_s, wrenches = _in_time(arm.wrench_stamp_ns, arm.wrenches, first_ns)
    tool_marker = base_marker = None
    try:
        with open_bag(path) as bag:
            raw = read_poses(bag, _TRACKER_TOPICS)
        tracks = []
        for track, may_stand in zip(raw, (False, True), strict=True):
            good = marker_track(track, _JUMP_S, first_ns, may_stand=may_stand)
            problems += [f"{name}: {problem}" for problem in good.problems]
            order = np.argsort(good.line.time_ns, kind="stable")
            at_s = (good.line.time_ns[order] - first_ns) * 1e-9
            tracks.append(Track(at_s, good.poses.rotation[order], good.poses.translation[order]))
        if min(len(track) for track in tracks) >= _LEAST_SAMPLES:
            tool_marker, base_marker = tracks
    except BagError as error:
        if name == "push":
            problems.append(f"push: no tracker: {error}")
    return BagData(
        name,
        (first_ns - session_ns) * 1e-9,
        joint_s,
        joints,
        wrench_s,
        wrenches,
        tool_marker,
        base_marker,
    )


def _in_time(stamp_ns: np.ndarray, values: Array, first_ns: int) -> tuple[Array, Array]:
    """Values in the order of their stamps, one a stamp."""
    stamps, rows = np.unique(stamp_ns, return_index=True)
    return (stamps - first_ns) * 1e-9, values[rows]
