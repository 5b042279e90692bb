"""A cable's pull out of a recorded sweep with the cable on: poses, what is left, the file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from galen_bags.arrays.arm_recording import ArmRecording
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.cable.drag import MAX_POSES, SUPPORT_M
from galen_model.load.cable.fit import CableSweep, spread_out
from galen_model.load.cable.learning import HeldOut, LearnedCable, learn_cable
from galen_model.load.cable.rivals import check_same_tool, doubts, rivals
from galen_model.rest.pose import PoseRecord

from galen_calibration_behavior.from_bag.calibrate_from_bag import measured_at
from galen_calibration_behavior.from_bag.home_stays import BiasPose
from galen_calibration_behavior.from_bag.recorded_sweeps import SweepSorter
from galen_calibration_behavior.from_bag.visits import RecordingError, find_visits
from galen_calibration_behavior.parameters import CalibrationParameters

# Poses of one sweep at one place stand nearer to each other than this.
_PLACE_M = 0.01


@dataclass(frozen=True)
class CableResult:
    """The tool's file with the cable in it, what was learned, of which poses, and what is odd.

    others: how well what is no cable explains the same poses held out, by name.
    """

    tool: CalibrationFile
    learned: LearnedCable
    sweep: CableSweep
    others: dict[str, HeldOut]
    warnings: tuple[str, ...]


def estimate_cable(
    tool: CalibrationFile,
    recording: ArmRecording,
    settings: CalibrationParameters,
    *,
    whole_phases: bool = False,
    phase_progress: Callable[[list[slice]], Iterable[slice]] = iter,
    fit_progress: Callable[[list[tuple[str, int]]], Iterable[tuple[str, int]]] = iter,
) -> CableResult:
    """Learn what a sweep with the cable on reads beyond the tool's file; writes nothing.

    The cable that the file may already hold is not looked at. Raises RecordingError, and
    galen_model.load.cable.learning's errors where there is no cable, or too few poses.
    """
    if not np.isfinite(recording.joints).any(axis=0).all():
        raise RecordingError(
            f"{recording.path}: the platform's position is not in it, and a cable's pull hangs on"
            " all five joints"
        )
    visits = find_visits(recording, settings, whole_phases=whole_phases, progress=phase_progress)
    sorter = SweepSorter(settings, BiasPose(*tool.zero_pose_rad))
    poses, warnings = sorter.still_poses(visits)
    warnings += [f"pose {p.number} at {p.time_s:.1f} s: {p.fault}" for p in poses if p.fault]
    used = [pose for pose in poses if isinstance(pose.visit.outcome, PoseRecord) and not pose.fault]
    records = [pose.visit.outcome for pose in used if isinstance(pose.visit.outcome, PoseRecord)]
    joints = np.array([record.joints for record in records])
    wrench = np.array([record.wrench for record in records])
    sweep = CableSweep(
        joints=joints,
        wrench=wrench - tool.predict(joints[:, 3], joints[:, 4]),
        std_of_mean=np.array([record.std_of_mean for record in records]),
        noise=np.median([record.wrench_std for record in records], axis=0),
        time_s=np.array([pose.time_s for pose in used]),
    )
    if len(sweep) > MAX_POSES:
        warnings.append(f"of {len(sweep)} poses the {MAX_POSES} that lie farthest apart are used")
        sweep = sweep.part(spread_out(sweep.joints, MAX_POSES))
    warnings += check_same_tool(tool, sweep)
    when = measured_at(used[-1].visit).isoformat(timespec="seconds")
    learned = learn_cable(sweep, when, progress=fit_progress)
    if np.ptp(sweep.joints[:, :3], axis=0).max() < _PLACE_M:
        warnings.append(
            "all poses have one place of the platform: the pull is taken off whole up to"
            f" {0.6 * SUPPORT_M:.2g} m from it, and less and less beyond"
        )
    others = rivals(tool, sweep, learned)
    warnings += doubts(sweep, learned, others)
    return CableResult(replace(tool, cable=learned.drag), learned, sweep, others, tuple(warnings))
