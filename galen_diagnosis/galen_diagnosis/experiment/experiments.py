"""The experiments that a diagnosis can propose, from the least trouble to the most.

Each takes poses or places chosen for the hypotheses at hand and gives the trials that it would
record; what some effects do in it differs from what they did in the recording (a tool that is off
has no mass error, a cable that is off doesn't pull), and that is what most of them are for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product
from typing import Literal

import numpy as np
from galen_model.arm.clearance import ArmClearance
from galen_model.arm.galen import HOME
from galen_model.arrays import Array
from galen_model.errors import NotExcitedError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.identification import check_planned_poses
from galen_model.poses.design import PoseDesign, PoseDesignError
from galen_model.poses.order import SweepTimes, order_poses
from galen_model.poses.plan import Surroundings, SweepRange, make_router
from galen_ros.goal.parameters import MotionParameters

from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.experiment.separation import Alternative, choose_units
from galen_diagnosis.experiment.trial import (
    Instruments,
    Trial,
    motion_trial,
    push_trial,
    still_trial,
)

Program = Literal["calibration", "collection", "none"]

OF_THE_TOOL = frozenset({"tool_mass_error", "tool_com_error", "loose_tool", "cable_drag"})
OF_THE_CABLE = frozenset({"cable_drag"})

_SPEEDS = (0.3, 1.0)
_MOTION_S = 20.0
LEVELS_N = (3.0, 8.0)
_PLACES = 3
# The platform moves, too: where it stands still, a turn about roll's axis is one of the tracker.
_PLATFORM_M = ((0.0, 0.0, 0.408), (0.07, -0.06, 0.45), (-0.07, 0.06, 0.36))
_ANGLES_RAD = ((0.0, 0.0), (0.9, -0.6), (-0.9, -0.6), (0.9, 0.6), (-0.9, 0.6))
_ASIDE_RAD = 0.15
_SETTLE_S = 0.4
"""As calibration_node's velocity_window_s and settle_s."""


def _sweep_range() -> SweepRange:
    return SweepRange(home=HOME, lower=(-1.5, -1.0), upper=(1.5, 0.9))


@dataclass(frozen=True)
class Budget:
    """What an experiment may use: poses, seconds of average at each, where, around which boxes."""

    poses: int = 14
    average_s: float = 1.0
    where: SweepRange = field(default_factory=_sweep_range)
    surroundings: Surroundings = field(default_factory=Surroundings)
    instruments: Instruments = field(default_factory=Instruments)

    def times(self) -> SweepTimes:
        """How long moves and stays take."""
        motion = MotionParameters()
        return SweepTimes(
            self.where.home[3:],
            motion.max_velocity[3:],
            motion.max_acceleration[3:],
            _SETTLE_S + self.average_s,
        )


@dataclass(frozen=True)
class Proposal:
    """An experiment that could be done: its kind, a sentence, what it would record.

    poses (n, 5): joints to stand at, m and rad, in this order; program: the node that runs it.
    """

    kind: str
    do: str
    poses: Array
    trials: tuple[Trial, ...]
    program: Program = "calibration"


class Experiments:
    """Makes the experiments for some alternatives with one tool."""

    def __init__(
        self, alternatives: Sequence[Alternative], tool: CalibrationFile, budget: Budget
    ) -> None:
        """Raise DiagnosisError where no pose is free, ObstacleError where home isn't."""
        self._alternatives = alternatives
        self._tool = tool
        self._budget = budget
        self._home = np.asarray(budget.where.home, dtype=float)
        tip = np.asarray(tool.tip_m, dtype=float)
        candidates = budget.where.candidates()
        router = make_router(budget.where, budget.surroundings, tip)
        if router is not None:
            candidates = candidates[[not fault for fault in router.lattice_faults]]
        if len(candidates) < 6:
            raise DiagnosisError(
                f"only {len(candidates)} poses can be visited; an experiment needs 6 or more"
            )
        self._candidates = candidates
        clearance = ArmClearance(budget.surroundings.boxes, budget.surroundings.clearance_m, tip)
        # The platform swings and the arm is pushed where it stands, so there must be space.
        self._may_swing = not budget.surroundings.boxes
        self._fault: Callable[[Array], str] = clearance.pose_fault

    def all(self) -> Iterator[Proposal]:
        """From the least trouble to the most; two of them only where they can make a difference."""
        names = {effect.identity for one in self._alternatives for effect in one.effects}
        poses = self._poses(tracker=False)
        yield self._still(poses)
        yield self._there_and_back(poses)
        yield self._from_both_sides(poses[: max(len(poses) // 2, 6)])
        seen = self._poses(tracker=True)
        yield self._with_tracker(seen)
        if self._tool.load.mass_kg > 0.0:
            yield self._without_tool(poses)
        if names & OF_THE_CABLE:
            yield self._without_cable(poses)
        if self._may_swing:
            yield self._two_speeds()
        yield self._pushes()

    # --- kinds ---------------------------------------------------------------------------------

    def _still(self, poses: Array) -> Proposal:
        do = (
            f"sweep these {len(poses)} still poses, {self._budget.average_s:g} s each, without"
            " touching the tool"
        )
        return Proposal("still poses", do, self._joints(poses), (self._trial(poses),))

    def _there_and_back(self, poses: Array) -> Proposal:
        both = np.concatenate([poses, poses[::-1]])
        do = (
            f"sweep these {len(poses)} still poses and then the same in reversed order, without"
            " zeroing the sensor between: what belongs to the pose comes back, what belongs to the"
            " time or the way doesn't"
        )
        return Proposal("reversed order", do, self._joints(both), (self._trial(both),))

    def _from_both_sides(self, poses: Array) -> Proposal:
        (low, high) = np.array(self._budget.where.lower), np.array(self._budget.where.upper)
        inside = np.clip(poses, low + _ASIDE_RAD, high - _ASIDE_RAD)
        legs = [
            (pose - _ASIDE_RAD, pose, pose + _ASIDE_RAD, pose)
            for pose in inside
            if not any(
                self._fault(np.array([*self._home[:3], *(pose + aside)]))
                for aside in (-_ASIDE_RAD, 0.0, _ASIDE_RAD)
            )
        ]
        course = np.reshape(np.array(legs), (-1, 2)) if legs else poses
        do = (
            f"visit {len(legs)} poses twice each, roll and tilt coming once from below and once"
            " from above: play and friction show as the difference"
        )
        return Proposal("from both sides", do, self._joints(course), (self._trial(course),))

    def _with_tracker(self, poses: Array) -> Proposal:
        do = (
            f"sweep these {len(poses)} still poses with the tracker on and record both markers:"
            " where the tip stands tells joints and frames from the sensor"
        )
        trial = self._trial(poses, tracker=True)
        return Proposal("tracker at rest", do, self._joints(poses), (trial,))

    def _without_tool(self, poses: Array) -> Proposal:
        do = (
            f"sweep these {len(poses)} still poses twice, with the adapter alone and with the"
            " tool on, as a calibration does: with two known masses a gain is not a mass"
        )
        bare = self._trial(poses, absent=OF_THE_TOOL, tool_on=False)
        return Proposal("second mass", do, self._joints(poses), (bare, self._trial(poses)))

    def _without_cable(self, poses: Array) -> Proposal:
        do = (
            f"sweep these {len(poses)} still poses as it is, and again with the cable off the tool"
            " or led another way: what changes is the cable"
        )
        free = self._trial(poses, absent=OF_THE_CABLE)
        return Proposal("cable re-routed", do, self._joints(poses), (self._trial(poses), free))

    def _two_speeds(self) -> Proposal:
        slow, fast = _SPEEDS
        do = (
            f"move all joints freely for {_MOTION_S:g} s at {slow:g} of the usual speed and for"
            f" {_MOTION_S:g} s at the full, without touching the tool: friction stays, a delay"
            " grows with the speed, inertia with its square"
        )
        trials = tuple(
            motion_trial(speed, _MOTION_S, self._tool, self._budget.instruments, self._home)
            for speed in (slow, fast)
        )
        return Proposal("two speeds", do, np.zeros((0, 5)), trials, "none")

    def _pushes(self) -> Proposal:
        places = np.array([[*at, *angles] for at, angles in product(_PLATFORM_M, _ANGLES_RAD)])
        places = places[[not self._fault(place) for place in places]]
        instruments = self._budget.instruments
        trial = push_trial(places, LEVELS_N[-1:], self._tool, instruments)
        chosen = places[choose_units(trial, self._alternatives, self._tool, _PLACES)]
        trial = push_trial(chosen, LEVELS_N, self._tool, instruments)
        levels = " and ".join(f"{level:g}" for level in LEVELS_N)
        where = "; ".join(
            f"({x:g}, {y:g}, {z:g}) m, roll {roll:g}, tilt {tilt:g} rad"
            for x, y, z, roll, tilt in chosen
        )
        do = f"with the tracker on, push with {levels} N to both sides along each axis at {where}"
        return Proposal("pushes", do, chosen, (trial,), "collection")

    # --- poses ---------------------------------------------------------------------------------

    def _trial(
        self,
        poses: Array,
        *,
        tracker: bool = False,
        absent: frozenset[str] = frozenset(),
        tool_on: bool = True,
    ) -> Trial:
        return still_trial(
            poses,
            self._budget.times().at_s(poses),
            self._budget.average_s,
            self._tool,
            self._budget.instruments,
            self._home,
            tracker=tracker,
            absent=absent,
            tool_on=tool_on,
        )

    def _joints(self, poses: Array) -> Array:
        """With the platform at home (n, 5)."""
        return np.column_stack([np.tile(self._home[:3], (len(poses), 1)), poses])

    def _poses(self, *, tracker: bool) -> Array:
        """The poses that tell most, in a good order; a calibration can be made of them."""
        candidates = self._candidates
        trial = self._trial(candidates, tracker=tracker)
        count = min(self._budget.poses, len(candidates))
        chosen = choose_units(trial, self._alternatives, self._tool, count)
        poses = candidates[chosen]
        if not _calibrates(poses, self._home):
            # Half of them for what tells the load: the behaviour rejects a sweep that doesn't.
            chosen = choose_units(trial, self._alternatives, self._tool, count // 2)
            with suppress(PoseDesignError):
                chosen = self._completed(chosen, count)
            poses = candidates[chosen]
        return order_poses(poses, self._budget.times())

    def _completed(self, chosen: list[int], count: int) -> list[int]:
        design = PoseDesign(self._candidates)
        for index in design.choose(count):
            if index not in chosen and len(chosen) < count:
                chosen = [*chosen, index]
        return chosen


def _calibrates(poses: Array, home: Array) -> bool:
    try:
        check_planned_poses(poses[:, 0], poses[:, 1], zero_roll_rad=home[3], zero_tilt_rad=home[4])
    except NotExcitedError:
        return False
    return True
