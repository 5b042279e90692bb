"""Which few poses a quick check goes to: near where the arm is, and worth most.

The poses are those of a small grid around the present one that make the compensation's error,
mean over the arm's range, best known (`galen_model.poses.design`, goal "compensation"): just what
the check has to judge. They are visited in the order that is shortest and on which a drift does
not look like a load (`pose_order`). Around boxes the arm goes within that grid, too.
"""

from __future__ import annotations

import numpy as np
from galen_model.arm.clearance import ObstacleError
from galen_model.arrays import Array
from galen_model.poses.design import ANGLE_LIMITS
from galen_model.poses.order import SweepTimes
from galen_model.poses.plan import (
    Surroundings,
    SweepPlan,
    SweepRange,
    plan_chosen,
)

_STEPS = (5, 5)


def plan_check(
    here: Array,
    reach_rad: float,
    count: int,
    times: SweepTimes,
    surroundings: Surroundings,
    tip_m: Array,
) -> SweepPlan:
    """Poses (count, 2) within `reach_rad` of the joints `here` (5,) and the limits, and the ways.

    tip_m (3,): the tool's tip in ft_sensor. Where the arm stands near a limit the grid is moved
    away from it, not made smaller. Raises PoseDesignError or NotExcitedError for a reach that tells
    too little, ObstacleError where boxes leave too little, the arm stands too near to one, or the
    tip is not known.
    """
    if surroundings.boxes and not np.any(tip_m):
        raise ObstacleError(
            "the tool's file has its tip at (0, 0, 0): nobody gave one, and so nobody knows what"
            " the tool would hit; calibrate with --tip, or write tip_m"
        )
    low, high = (np.array(limit) for limit in ANGLE_LIMITS)
    reach = np.minimum(reach_rad, (high - low) / 2.0)
    centre = np.clip(here[3:], low + reach, high - reach)
    (low_roll, low_tilt), (high_roll, high_tilt) = centre - reach, centre + reach
    where = SweepRange(
        home=here,
        lower=(low_roll, low_tilt),
        upper=(high_roll, high_tilt),
        steps=_STEPS,
        name="the present pose",
    )
    return plan_chosen(count, where, surroundings, tip_m, times)
