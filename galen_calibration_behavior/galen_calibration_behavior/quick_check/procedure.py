# SPDX-License-Identifier: Apache-2.0
"""The quick check's course, without ROS: samples and events in, commands out.

    MEASURE (each pose: go, arrive, settle, average, judge) > decide > RETURN to where the arm was

A cancel, an error and time are as in `galen_common.goal.procedure`; the arm then stays where it
stops.

The poses are those of a small grid around the present one, or of an arm of more than two revolute
joints of a small box (`galen_model.poses.plan`), that make the compensation's error, mean over the
arm's range, best known (`galen_model.poses.design`): just what the check has to judge. They are
visited in the order that is shortest and on which a drift does not look like a load
(`order_poses`). Around boxes the arm goes within that grid, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

import numpy as np
from galen_common.goal.arrival import PoseRejection
from galen_common.goal.procedure import PoseProcedure
from galen_model.arm.arm import Arm
from galen_model.arm.clearance import ObstacleError
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.poses.plan import Surroundings, SweepPlan, SweepRange, SweepTimes, plan_chosen
from galen_model.rest.segments import PoseRecord

from galen_calibration_behavior.common.check_decision import FEWEST_POSES, QuickCheck, quick_check
from galen_calibration_behavior.common.commands import (
    CheckCode,
    CheckState,
    PoseFeedback,
    PosesEnd,
)
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.common.sweep import PoseOutcome, Sweep

_GRID_STEPS = 5
# Of the best information: enough to see a change, for a smaller motion than a calibration's.
_GOOD_SHARE = 1.0 / 3.0


class CheckProcedure(PoseProcedure):
    """One check. Call `start`, feed samples and events, and do what `take_commands` gives."""

    codes = CheckCode
    _settings: CalibrationParameters
    _state: CheckState

    def __init__(
        self,
        settings: CalibrationParameters,
        tool: CalibrationFile,
        poses: int,
        others: Mapping[str, CalibrationFile],
        known_offset: Array | None,
    ) -> None:
        """Check a tool at so many poses.

        others: the files of other tools by name; known_offset (6,): what a tare already subtracts,
        N and N.m, None where that isn't known.
        """
        super().__init__(settings, CheckState.MEASURE)
        self.tool = tool
        self._poses = poses
        self._others = others
        self._known_offset = known_offset
        self._before = settings.arm.home
        self._sweep: Sweep | None = None
        self._check: QuickCheck | None = None
        self._plan_warnings: tuple[str, ...] = ()

    @property
    def progress(self) -> tuple[int, int]:
        """Poses finished, and poses in all."""
        return self._sweep.finished_poses if self._sweep else 0, self._poses

    def _begin(self) -> None:
        assert self._joints is not None
        if not np.all(np.isfinite(self._joints)):
            self.fail(CheckCode.BAD_INPUT, "joint_states holds values that are not finite")
            return
        settings = self._settings.beside(self.beside)
        present = settings.standing_at(self._joints).present
        assert present is not None
        self._before = present
        stay_s = settings.arrival.velocity_window_s + settings.arrival.settle_s + settings.average_s
        times = SweepTimes(
            settings.arm.angles(self._before),
            settings.arm.angles(settings.max_velocity),
            settings.arm.angles(settings.max_acceleration),
            stay_s,
        )
        try:
            plan = plan_check(
                self._before,
                settings.check_reach_rad,
                self._poses,
                times,
                settings.surroundings,
                self.tool.tip_m,
                settings.arm,
            )
        except GalenError as error:
            self.fail(CheckCode.BAD_INPUT, str(error))
            return
        self._router, self._plan_warnings = plan.router, plan.warnings
        self._sweep = Sweep("check", plan.poses, settings.stillness, settings.pose_retries)
        self._report(f"{len(plan.poses)} poses: keep off the tool")
        self._visit_next()

    def _visit_next(self) -> None:
        assert self._sweep is not None
        index = self._sweep.current
        if index is None:
            self._judge(self._sweep)
            return
        target = self._settings.arm.with_angles(self._sweep.poses[index], self._before)
        self._visit(target, self._on_pose)

    def _on_pose(self, outcome: PoseRecord | PoseRejection) -> None:
        assert self._sweep is not None
        for verdict in self._sweep.take(outcome):
            self._report_pose(verdict)
        self._visit_next()

    def _judge(self, sweep: Sweep) -> None:
        if len(sweep.records) < FEWEST_POSES:
            self.fail(
                CheckCode.BAD_INPUT if sweep.not_finite else CheckCode.POSES_NOT_STILL,
                f"only {len(sweep.records)} of {len(sweep.poses)} poses can be used, and"
                f" {FEWEST_POSES} are needed; {sweep.rejections[-1]}",
            )
            return
        self._check = quick_check(
            sweep.records,
            self.tool,
            self._settings.check_limits,
            others=self._others,
            known_offset=self._known_offset,
        )
        self._state = CheckState.RETURN
        self._report("going back to where it was")
        self._go_to(self._before, self._succeed)

    def _make_end(self, code: IntEnum, message: str) -> PosesEnd:
        return PosesEnd(
            CheckCode(code),
            message,
            check=self._check if code == CheckCode.NONE else None,
            rejected=tuple(self._sweep.rejections) if self._sweep else (),
            warnings=(*self._warnings(), *self._plan_warnings),
        )

    # ---- reports

    def _report(self, message: str) -> None:
        done, total = self.progress
        self._commands.append(PoseFeedback(self._state, message, done=done, total=total))

    def _report_pose(self, verdict: PoseOutcome) -> None:
        done, total = self.progress
        where = f"pose {verdict.index + 1}"
        self._commands.append(
            PoseFeedback(
                self._state,
                f"{where}: {verdict.message}" if verdict.message else f"{where} recorded",
                done=done,
                total=total,
                angles=verdict.angles,
                accepted=verdict.accepted,
            )
        )


def plan_check(
    here: Array,
    reach_rad: float,
    count: int,
    times: SweepTimes,
    surroundings: Surroundings,
    tip_m: Array,
    arm: Arm,
) -> SweepPlan:
    """Choose a check's poses near the present one.

    Where the arm stands near a limit the grid is moved away from it, not made smaller.

    Args:
        here: joints (n,) where the arm stands, m and rad.
        reach_rad: poses lie within this of the present angles, rad, and within the limits.
        count: number of poses.
        times: of moves and stays, for the order of the poses.
        surroundings: boxes to keep away from.
        tip_m: the tool's tip (3,), m in ft_sensor.
        arm: whose poses they are.

    Returns:
        Angles (count, k), rad, in visiting order, and free ways between them.

    Raises:
        PoseDesignError: the reach is too small.
        NotExcitedError: likewise.
        ObstacleError: boxes leave too little, the arm stands too near to one, or the tip is not
            known.

    """
    if surroundings.boxes and not np.any(tip_m):
        raise ObstacleError(
            "the tool's file has its tip at (0, 0, 0): it was not given, and what the tool"
            " would hit is not known; calibrate with --tip, or write tip_m"
        )
    steps = (_GRID_STEPS,) * len(arm.turning)
    remedy = f"enlarge check_reach_rad ({reach_rad:g} rad), or start from another pose"
    where = SweepRange.around(
        here, reach_rad, arm, steps=steps, remedy=remedy, good_share=_GOOD_SHARE
    )
    return plan_chosen(count, where, surroundings, tip_m, times)
