"""Parameters that say which poses a sweep visits, when it is enough, and what stands around."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from galen_model.arm.galen import LIMITS
from galen_model.arrays import Array
from galen_model.load.identification import check_planned_poses
from galen_model.poses.design import GOALS
from galen_model.poses.grid import GridError, SweepGrid
from galen_model.poses.order import SweepTimes
from galen_model.poses.plan import (
    SweepPlan,
    SweepRange,
    plan_chosen,
    plan_grid,
    plan_listed,
)
from galen_ros.goal.pose_procedure import PoseSettings
from galen_ros.parameters.param import ParameterError, param

from galen_calibration_behavior.calibration.obstacle_parameters import ObstacleParameters
from galen_calibration_behavior.calibration.precision import WantedPrecision

MAX_ITERS = 100  # so that the feedback's counts of poses, uint16, hold two sweeps
MAX_CHOSEN = 60  # more take long to choose and to order, and are no better than a grid
MAX_LISTED = 1000
POSES = ("grid", "chosen", "listed")


@dataclass(frozen=True)
class SweepParameters(ObstacleParameters):
    """Which poses, around which obstacles, and how precise."""

    tstart: float = param(-1.0, "first tilt of the sweep, rad")
    tend: float = param(0.9, "last tilt of the sweep, rad")
    itersT: int = param(7, "number of tilts", minimum=1, maximum=MAX_ITERS)
    rstart: float = param(-1.5, "first roll of the sweep, rad")
    rend: float = param(1.5, "last roll of the sweep, rad")
    itersR: int = param(8, "number of rolls", minimum=1, maximum=MAX_ITERS)
    Xhome: float = param(0.0, "delta_x at home and during the sweeps, m")
    Yhome: float = param(0.0, "delta_y at home and during the sweeps, m")
    Zhome: float = param(0.408, "delta_z at home and during the sweeps, m")
    Rhome: float = param(0.0, "roll at home, where the sensor is zeroed, rad")
    Thome: float = param(0.0, "tilt at home, where the sensor is zeroed, rad")

    poses: str = param(
        "grid",
        "which poses a sweep visits: `grid`, all tilts at all rolls, `chosen`, those in the"
        " grid's range that tell most, see *Fewer poses*, or `listed`, those of"
        " `listed_poses_rad`",
    )
    listed_poses_rad: tuple[float, ...] = param(
        (),
        "roll and tilt of each listed pose, one pose after the other, visited in this order;"
        " `diagnose --next` writes such a list",
    )
    chosen_poses: int = param(18, "number of chosen poses", 6, MAX_CHOSEN)
    chosen_average_s: float = param(
        1.5,
        "`average_s` of the chosen poses: fewer of them, each for longer",
        0.01,
        60.0,
    )
    chosen_for: str = param(
        "compensation",
        "what the chosen poses shall make precise: the `compensation`, or the `load`'s own mass and"
        " centre",
    )
    wanted_force_std_n: float = param(
        0.0,
        "a sweep ends as soon as the standard deviation of the compensation's own force error,"
        " N, is this small; 0: never",
        0.0,
        10.0,
    )
    wanted_torque_std_nm: float = param(
        0.0, "likewise in torque, N·m; where both are given, both must be reached", 0.0, 1.0
    )
    fewest_poses: int = param(12, "but not before so many good poses", 6, 10_000)

    def check_sweep(self) -> None:
        """Reject a sweep outside the joint limits, poses of no kind, and boxes that are none."""
        self.grid_poses(self.itersT, self.itersR)
        if self.poses not in POSES:
            raise ParameterError(
                f"parameter 'poses' is {self.poses!r}, but must be {' or '.join(map(repr, POSES))}"
            )
        if self.poses == "listed":
            self.listed_poses()
        if self.chosen_for not in GOALS:
            raise ParameterError(
                f"parameter 'chosen_for' is {self.chosen_for!r}, but must be"
                f" {' or '.join(map(repr, GOALS))}"
            )
        self.check_obstacles()

    @property
    def home(self) -> tuple[float, float, float, float, float]:
        """Home in the joint vector's order, m and rad."""
        return (self.Xhome, self.Yhome, self.Zhome, self.Rhome, self.Thome)

    @property
    def chosen(self) -> bool:
        """Whether the poses are chosen ones."""
        return self.poses == "chosen"

    def grid_poses(self, tilts: int, rolls: int) -> Array:
        """Return the grid's poses (n, 2), roll and tilt in rad; raises GridError."""
        grid = SweepGrid(self.tstart, self.tend, tilts, self.rstart, self.rend, rolls)
        (low_roll, low_tilt), (high_roll, high_tilt) = LIMITS.lower[3:], LIMITS.upper[3:]
        return grid.poses((low_roll, low_tilt), (high_roll, high_tilt))

    def listed_poses(self) -> Array:
        """The listed poses (n, 2), roll and tilt in rad; raises ParameterError or GridError."""
        numbers = self.listed_poses_rad
        if not numbers or len(numbers) % 2 or len(numbers) > 2 * MAX_LISTED:
            raise ParameterError(
                f"parameter 'listed_poses_rad' has {len(numbers)} numbers, but must have two a"
                f" pose, roll and tilt, for 1 to {MAX_LISTED} poses"
            )
        poses = np.reshape(np.array(numbers), (-1, 2))
        outside = np.any((poses < LIMITS.lower[3:]) | (poses > LIMITS.upper[3:]), axis=1)
        if outside.any():
            index = int(np.argmax(outside))
            roll, tilt = poses[index]
            raise GridError(
                f"pose {index} of listed_poses_rad (roll {roll:g}, tilt {tilt:g} rad) is outside"
                " the joints' limits"
            )
        return poses

    def plan(
        self, tip_m: Array, *, one_sweep: bool = False, tilts: int = 0, rolls: int = 0
    ) -> SweepPlan:
        """Return the poses, for a tool with its tip at tip_m (3,), and the ways around obstacles.

        tilts, rolls: the grid's counts, 0 for the parameters'. Raises a GalenError that names what
        is in the way, or what the poses don't tell.
        """
        if self.chosen:
            return plan_chosen(
                self.chosen_poses,
                self.range,
                self.surroundings,
                tip_m,
                self.times(),
                goal=self.chosen_for,
                one_sweep=one_sweep,
            )
        listed = self.poses == "listed"
        poses = (
            self.listed_poses()
            if listed
            else self.grid_poses(tilts or self.itersT, rolls or self.itersR)
        )
        check_planned_poses(
            poses[:, 0],
            poses[:, 1],
            one_sweep=one_sweep,
            zero_roll_rad=self.Rhome,
            zero_tilt_rad=self.Thome,
        )
        plan = plan_listed if listed else plan_grid
        return plan(poses, self.range, self.surroundings, tip_m)

    @property
    def range(self) -> SweepRange:
        """Where the sweep may go: no further than its grid does."""
        return SweepRange(
            home=np.array(self.home),
            lower=(min(self.rstart, self.rend), min(self.tstart, self.tend)),
            upper=(max(self.rstart, self.rend), max(self.tstart, self.tend)),
        )

    @property
    def wanted(self) -> WantedPrecision:
        """When a sweep may end before its last pose."""
        return WantedPrecision(
            self.wanted_force_std_n, self.wanted_torque_std_nm, self.fewest_poses
        )

    def sweep_pose_settings(self) -> PoseSettings:
        """As `pose_settings`, with the average's length that belongs to the poses."""
        settings = self.pose_settings()
        if not self.chosen:
            return settings
        return replace(settings, average_s=self.chosen_average_s)

    def sweep_s(self) -> float:
        """Return how long one sweep takes, s of stamps; ways around obstacles are not counted.

        Raises a GalenError that names what the poses don't tell.
        """
        free = replace(self, obstacles=())
        return self.times().sweep_s(free.plan(np.zeros(3)).poses)

    def times(self) -> SweepTimes:
        """Return how long a sweep's moves and stays take."""
        average_s = self.chosen_average_s if self.chosen else self.average_s
        return SweepTimes(
            np.array(self.home[3:]),
            self.max_velocity[3:],
            self.max_acceleration[3:],
            self.velocity_window_s + self.settle_s + average_s,
        )
