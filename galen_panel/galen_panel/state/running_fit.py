"""What poses of an unfinished sweep disagree by, pose by pose. No ROS, no NiceGUI.

The calibration fits when all poses are done. Until then the plain least squares of one load and six
offsets, on the poses so far, tells whether something goes wrong: a touched pose stands out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.load.identification import plain_least_squares
from galen_model.load.model import gravity_regressor

from galen_panel.state.snapshot import Pose

_ENOUGH = 4
"""Poses: six readings each, ten unknowns."""


def residuals(poses: Sequence[Pose]) -> Mapping[int, tuple[float, float]]:
    """By pose's number, the length of force and torque that the fit leaves over, N and N.m.

    poses: of one sweep. Only accepted ones with a finite reading count; empty while they are too
    few.
    """
    used = [p for p in poses if p.accepted and p.wrench is not None and np.isfinite(p.wrench).all()]
    if len(used) < _ENOUGH:
        return {}
    gravity = gravity_in_sensor([p.roll_rad for p in used], [p.tilt_rad for p in used])
    readings = np.array([p.wrench for p in used])
    moments, offset = plain_least_squares(gravity, readings)
    left = readings - gravity_regressor(gravity) @ moments - offset
    lengths = np.linalg.norm(left.reshape(-1, 2, 3), axis=2)
    return {
        pose.number: (float(force), float(torque))
        for pose, (force, torque) in zip(used, lengths, strict=True)
    }
