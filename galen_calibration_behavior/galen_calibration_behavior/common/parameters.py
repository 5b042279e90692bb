# SPDX-License-Identifier: Apache-2.0
"""The calibration node's settings, each a parameter: sweep and home under the report's names."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from galen_common.goal.parameters import PoseParameters
from galen_common.parameters import ParameterError, param
from galen_model.arm.clearance import boxes_from_numbers
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.load.identification import check_planned_poses
from galen_model.load.mounting import entities
from galen_model.poses.plan import (
    Surroundings,
    SweepPlan,
    SweepRange,
    SweepTimes,
    order_poses,
    plan_as_is,
    plan_chosen,
    sweep_grid,
)

from galen_calibration_behavior.common.check_decision import FEWEST_POSES, CheckLimits

MAX_ITERS = 100  # so that the feedback's counts of poses, uint16, hold two sweeps
MAX_CHOSEN = 60  # more take long to choose and to order, and are no better than a grid
MAX_LISTED = 1000
MOST_CHECK_POSES = 12
POSES = ("auto", "grid", "chosen", "listed")
ZEROINGS = ("auto", "zeroed", "none")


@dataclass(frozen=True)
class CalibrationParameters(PoseParameters):
    """Settings of calibration_node, for both of its actions and for recorded sweeps."""

    tools_dir: str = param("~/.ros/galen/tools", "directory of the tools' files; `~` is expanded")

    obstacles: tuple[float, ...] = param(
        (),
        "boxes that the arm keeps away from, six numbers each: smallest x, y, z, largest x, y, z,"
        " in the base frame, m",
    )
    obstacle_clearance_m: float = param(0.03, "how far it keeps away from them", 0.0, 1.0)

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
        "auto",
        "which poses a sweep visits: `grid`, all tilts at all rolls, `chosen`, those in the"
        " grid's range, or around another arm's present pose, that tell most, see *Fewer poses*,"
        " or `listed`, those of `listed_poses_rad`; `auto`: the Galen's grid, another arm's chosen"
        " ones",
    )
    pose_box_rad: float = param(
        1.2,
        "half width of the box around another arm's present angles, where its sensor is zeroed,"
        " in which its chosen poses lie, rad",
        0.05,
        3.2,
    )
    listed_poses_rad: tuple[float, ...] = param(
        (),
        "angles of each listed pose's turning joints, one pose after the other, in this order;"
        " `diagnose --next` writes such a list",
    )
    chosen_poses: int = param(18, "number of chosen poses", 6, MAX_CHOSEN)
    chosen_average_s: float = param(
        1.5,
        "`average_s` of the chosen poses: fewer of them, each for longer",
        0.01,
        60.0,
    )

    pose_retries: int = param(1, "how often a rejected pose is tried again", 0, 10)
    max_rejected_in_a_row: int = param(8, "so many rejected poses in a row end it", 1, 10_000)
    min_pose_fraction: float = param(0.5, "fewest good poses, as a part of the sweep", 0.05, 1.0)
    zero_tolerance_n: float = param(0.1, "largest force read just after zeroing, N", 1e-4, 100.0)
    zero_tolerance_nm: float = param(
        0.005, "largest torque read just after zeroing, N·m", 1e-6, 10.0
    )
    estimate: tuple[str, ...] = param(
        (),
        "what to estimate together with the loads, see *Sensor and mounting*; a goal is rejected"
        " where the poses don't identify it",
    )
    zeroing: str = param(
        "auto",
        "whether the sensor is zeroed with the adapter alone: `none`: it can't be; one sweep then"
        " finds tool and adapter as one load, and the file holds the sensor's offset. `auto`: by"
        " `zero_ft_sensor`, by hand where that service is there; of a recording the readings tell",
    )
    check_setup: bool = param(
        True,
        "whether nothing is written where a wrong set-up (mount, axes, units, order of joints)"
        " explains the readings, or no load does",
    )
    confirm_timeout_s: float = param(
        600.0, "time for an operator to put the tool on or to remove it", 1.0, 86_400.0
    )

    by_hand_std_n: float = param(
        0.02,
        "a sweep by hand ends when the compensation is known to this on average (1 sigma), N",
        1e-4,
        10.0,
    )
    by_hand_std_nm: float = param(0.001, "likewise, N·m", 1e-6, 1.0)

    check_poses: int = param(6, "number of a check's poses", FEWEST_POSES, MOST_CHECK_POSES)
    check_reach_rad: float = param(
        0.5, "a check's poses lie within this of the present angles, rad", 0.1, 1.5
    )
    check_limit_force_n: float = param(
        0.05, "a file is good that leaves no more than this anywhere, N", 1e-4, 100.0
    )
    check_limit_torque_nm: float = param(0.002, "likewise, N·m", 1e-6, 10.0)
    check_false_alarm: float = param(
        0.05, "how often chance alone may look like a change, before the limits", 1e-6, 0.5
    )

    present: Array | None = field(default=None, repr=False, compare=False)
    """Where an arm without a home of its own stands, (n,), m and rad; None: at zero."""

    def validate(self) -> None:
        """Reject a home or a sweep outside the joint limits, and what can't be estimated.

        Raises GalenError naming the joint, IdentificationError naming the group, ObstacleError
        naming the box, ParameterError naming the parameter.
        """
        homes = ("Xhome", "Yhome", "Zhome", "Rhome", "Thome") if self.has_home else ()
        limits = zip(homes, self.home, self.arm.lower, self.arm.upper, strict=False)
        for name, value, low, high in limits:
            if not low <= value <= high:
                raise GalenError(f"{name} = {value:g} is outside its limits, {low:g} ... {high:g}")
        entities(self.estimate, self.arm)
        if self.poses not in POSES:
            raise ParameterError(
                f"parameter 'poses' is {self.poses!r}, but must be {' or '.join(map(repr, POSES))}"
            )
        if self.zeroing not in ZEROINGS:
            raise ParameterError(
                f"parameter 'zeroing' is {self.zeroing!r}, but must be"
                f" {' or '.join(map(repr, ZEROINGS))}"
            )
        if self.has_home:
            self.grid_poses(self.itersT, self.itersR)
        elif self.poses == "grid":
            raise ParameterError(
                f"parameter 'poses' is 'grid', which is one of the Galen's tilts and rolls; the arm"
                f" is '{self.arm.name}': set it to 'chosen' or 'listed'"
            )
        if self.poses == "listed":
            self.listed_poses()
        boxes_from_numbers(self.obstacles)

    @property
    def surroundings(self) -> Surroundings:
        """The obstacles."""
        return Surroundings(
            boxes_from_numbers(self.obstacles),
            self.obstacle_clearance_m,
            self.require_collision_shapes,
        )

    @property
    def has_home(self) -> bool:
        """Whether parameters say where home is: the Galen's do, others begin where they stand."""
        return self.arm.joint_names == GALEN.joint_names

    def standing_at(self, joints: Array) -> CalibrationParameters:
        """Return the same of an arm that stands at these joints.

        An arm that stands at a limit may read a little beyond it, where none may be sent.

        Args:
            joints: (n,) in the arm's order, m and rad.

        Returns:
            Parameters whose `present` is inside the limits, unless it is beyond them by more than
            the tolerance of an arrival.

        """
        inside = np.clip(joints, self.arm.lower, self.arm.upper)
        near = np.abs(joints - inside) <= self.arrival.position_tolerance
        return replace(self, present=np.where(near, inside, joints))

    @property
    def home(self) -> Array:
        """Home (n,) in the arm's order, m and rad; where the arm stands if it has none."""
        if not self.has_home:
            return self.arm.home if self.present is None else self.present
        return np.array([self.Xhome, self.Yhome, self.Zhome, self.Rhome, self.Thome])

    @property
    def home_angles(self) -> Array:
        """Angles (k,) at home, rad, where the sensor is zeroed."""
        return self.arm.angles(self.home)

    @property
    def angle_limits(self) -> tuple[Array, Array]:
        """Lowest and highest angles (k,), rad."""
        return self.arm.angles(self.arm.lower), self.arm.angles(self.arm.upper)

    @property
    def zero_tolerance(self) -> Array:
        """Largest reading (6,) just after zeroing, N and N.m."""
        return np.array([self.zero_tolerance_n] * 3 + [self.zero_tolerance_nm] * 3)

    @property
    def by_hand_std(self) -> Array:
        """Wanted standard deviation (6,) of the compensation, N and N.m."""
        return np.array([self.by_hand_std_n] * 3 + [self.by_hand_std_nm] * 3)

    @property
    def check_limits(self) -> CheckLimits:
        """What a check judges a file by."""
        return CheckLimits(
            self.check_limit_force_n, self.check_limit_torque_nm, self.check_false_alarm
        )

    @property
    def pose_kind(self) -> str:
        """Which poses a sweep visits: grid, chosen or listed."""
        if self.poses != "auto":
            return self.poses
        return "grid" if self.has_home else "chosen"

    @property
    def zeroed(self) -> bool | None:
        """Whether the sensor was zeroed, as the parameter says; None: it doesn't."""
        return None if self.zeroing == "auto" else self.zeroing == "zeroed"

    @property
    def chosen(self) -> bool:
        """Whether the poses are chosen ones."""
        return self.pose_kind == "chosen"

    @property
    def pose_count(self) -> int:
        """How many poses a sweep visits."""
        if self.poses == "listed":
            return len(self.listed_poses())
        return self.chosen_poses if self.chosen else self.itersT * self.itersR

    def grid_poses(self, tilts: int, rolls: int) -> Array:
        """Return the grid's poses.

        Args:
            tilts: number of tilts, at least 1.
            rolls: number of rolls, at least 1.

        Returns:
            (roll, tilt) (n, 2), rad, one roll after the other.

        Raises:
            GalenError: a count is below 1, or a pose outside the limits.

        """
        lower, upper = self.angle_limits
        return sweep_grid(
            (self.tstart, self.tend, tilts), (self.rstart, self.rend, rolls), lower, upper
        )

    def listed_poses(self) -> Array:
        """Return the listed poses (n, k), rad; raises GalenError."""
        numbers, names = self.listed_poses_rad, self.arm.turning_names
        if not numbers or len(numbers) % len(names) or len(numbers) > len(names) * MAX_LISTED:
            raise ParameterError(
                f"parameter 'listed_poses_rad' has {len(numbers)} numbers, but must have"
                f" {len(names)} a pose, {' and '.join(names)}, for 1 to {MAX_LISTED} poses"
            )
        poses = np.reshape(np.array(numbers), (-1, len(names)))
        lower, upper = self.angle_limits
        outside = np.any((poses < lower) | (poses > upper), axis=1)
        if outside.any():
            index = int(np.argmax(outside))
            raise GalenError(
                f"pose {index} of listed_poses_rad ({self.arm.described(poses[index])}) is outside"
                " the joints' limits"
            )
        return poses

    def plan(
        self, tip_m: Array, *, one_sweep: bool = False, tilts: int = 0, rolls: int = 0
    ) -> SweepPlan:
        """Plan a sweep's poses, and the ways around obstacles.

        Args:
            tip_m: the tool's tip (3,), m in ft_sensor.
            one_sweep: with the tool on only, after a zeroing at home.
            tilts: the grid's count of tilts; 0: the parameter's.
            rolls: the grid's count of rolls; 0: the parameter's.

        Returns:
            Angles (n, k), rad, in visiting order, and free ways between them.

        Raises:
            GalenError: something is in the way, or the poses don't identify what is asked for; it
                names it.

        """
        if self.chosen:
            plan = plan_chosen(
                self.chosen_poses,
                self.range,
                self.surroundings,
                tip_m,
                self.times(),
                one_sweep=one_sweep,
            )
        else:
            named = {}
            if self.poses == "listed":
                poses = self.listed_poses()
                named = {"source": "listed_poses_rad", "remedy": "clear the space, or leave it out"}
            else:
                poses = self.grid_poses(tilts or self.itersT, rolls or self.itersR)
            check_planned_poses(
                poses, one_sweep=one_sweep, zero_angles=self.home_angles, arm=self.arm
            )
            plan = plan_as_is(poses, self.range, self.surroundings, tip_m, **named)
            if self.poses != "listed":
                plan = replace(plan, poses=order_poses(poses, self.times(), self.arm))
        if self.estimate:
            check_planned_poses(
                plan.poses,
                self.estimate,
                one_sweep=one_sweep,
                zero_angles=self.home_angles,
                arm=self.arm,
            )
        return plan

    @property
    def range(self) -> SweepRange:
        """Where the sweep may go: no further than its grid does, or than `pose_box_rad`."""
        if not self.has_home:
            remedy = f"enlarge pose_box_rad ({self.pose_box_rad:g} rad), or start from another pose"
            return SweepRange.around(self.home, self.pose_box_rad, self.arm, remedy=remedy)
        return SweepRange(
            home=self.home,
            lower=(min(self.rstart, self.rend), min(self.tstart, self.tend)),
            upper=(max(self.rstart, self.rend), max(self.tstart, self.tend)),
            arm=self.arm,
        )

    def of_sweep(self) -> CalibrationParameters:
        """Return the same with the average's length that belongs to the poses."""
        return replace(self, average_s=self.chosen_average_s) if self.chosen else self

    def sweep_s(self) -> float:
        """Return how long one sweep takes, s of stamps; ways around obstacles are not counted.

        Raises a GalenError that names what the poses don't tell.
        """
        if not self.has_home and self.present is None:
            raise GalenError("how long a sweep takes is known once the arm's pose is")
        free = replace(self, obstacles=())
        return self.times().sweep_s(free.plan(np.zeros(3)).poses)

    def times(self) -> SweepTimes:
        """Return how long a sweep's moves and stays take."""
        return SweepTimes(
            self.home_angles,
            self.arm.angles(self.max_velocity),
            self.arm.angles(self.max_acceleration),
            self.velocity_window_s + self.settle_s + self.of_sweep().average_s,
        )
