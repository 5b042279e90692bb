# SPDX-License-Identifier: Apache-2.0
"""Find stamps of joints and wrench that are apart by a constant.

A reading is compared with the orientation at its stamp. Where the stamps are apart by d, the load
fits with the joints taken d earlier or later: the residual of one load and a constant bias over a
recording in motion has its least there. d is sought on a grid, then between its neighbours.
"""

from __future__ import annotations

import numpy as np
import scipy  # its parts are loaded when they are used

from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.setup_check.check import SetupFinding, check_fit
from galen_model.setup_check.mistakes import Corrected
from galen_model.setup_check.readings import StillReadings, at_angles, fit_load

LONGEST_SHIFT_S = 3.0
LEAST_SHIFT_S = 0.03
"""Less is a delay, an effect for the diagnosis."""

_STEP_S = 0.05
_MOST_READINGS = 600


def check_stamps(
    joint_time_s: Array, joints: Array, wrench_time_s: Array, wrench: Array, arm: Arm
) -> SetupFinding | None:
    """Find out whether stamps that are apart explain why no load fits.

    Args:
        joint_time_s: (n,) stamps of the joints, s, increasing.
        joints: (n, k) of the arm, m and rad.
        wrench_time_s: (m,) stamps of the wrenches, s, from the same zero.
        wrench: (m, 6) raw readings, N and N.m.
        arm: whose joints they are.

    Returns:
        None where the load fits as it is, or no shift up to 3 s explains the readings.

    """
    first, last = joint_time_s[0] + LONGEST_SHIFT_S, joint_time_s[-1] - LONGEST_SHIFT_S
    inside = np.flatnonzero((wrench_time_s > first) & (wrench_time_s < last))
    if len(inside) < 2 * _MOST_READINGS // 10:
        return None
    rows = inside[:: max(1, len(inside) // _MOST_READINGS)]
    angles = np.unwrap(arm.angles(joints), axis=0)

    def shifted(delay_s: float) -> StillReadings:
        at_s = wrench_time_s[rows] - delay_s
        columns = [np.interp(at_s, joint_time_s, column) for column in angles.T]
        return at_angles(wrench[rows], np.column_stack(columns), arm)

    def badness(delay_s: float) -> float:
        return float(np.sum(np.log(np.maximum(fit_load(shifted(delay_s)).relative, 1e-9))))

    grid = np.arange(-LONGEST_SHIFT_S, LONGEST_SHIFT_S + _STEP_S / 2.0, _STEP_S)
    best = float(grid[np.argmin([badness(delay_s) for delay_s in grid])])
    bounds = (best - _STEP_S, best + _STEP_S)
    delay_s = float(scipy.optimize.minimize_scalar(badness, bounds=bounds, method="bounded").x)
    if abs(delay_s) < LEAST_SHIFT_S:
        return None
    late, early = ("wrench", "joints") if delay_s > 0.0 else ("joints", "wrench")
    mistake = Corrected(
        shifted(delay_s),
        f"the stamps of the {late} are {abs(delay_s):.3f} s later than those of the {early}",
        "stamp both when they are sampled, by one clock (chrony, PTP)",
        "move the arm and stop it: do joints and wrench come to rest at the same stamp?",
        1,
    )
    return check_fit(shifted(0.0), mistake)
