"""Which few poses a quick check goes to: near where the arm is, and worth most.

The poses are those of a small grid around the present one that make the compensation's error,
mean over the arm's range, best known (`galen_model.pose_design`, goal "compensation"): just what
the check has to judge. They are visited in the order that is shortest and on which a drift does
not look like a load (`pose_order`).
"""

from __future__ import annotations

import numpy as np
from galen_model.arrays import Array
from galen_model.pose_design import ANGLE_LIMITS, PoseDesign, angle_grid

from galen_calibration_behavior.pose_order import SweepTimes, order_poses

_STEPS = 5


def choose_check_poses(here: Array, reach_rad: float, count: int, times: SweepTimes) -> Array:
    """Poses (count, 2), roll and tilt in rad, within `reach_rad` of `here` (2,) and the limits.

    Where the arm stands near a limit the grid is moved away from it, not made smaller. Raises
    PoseDesignError for more poses than there are, or for a reach that tells too little.
    """
    low, high = (np.array(limit) for limit in ANGLE_LIMITS)
    reach = np.minimum(reach_rad, (high - low) / 2.0)
    centre = np.clip(here, low + reach, high - reach)
    grid = angle_grid(centre - reach, centre + reach, _STEPS, _STEPS)
    design = PoseDesign(grid)
    return order_poses(grid[design.choose(count)], times)
