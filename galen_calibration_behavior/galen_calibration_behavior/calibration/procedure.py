# SPDX-License-Identifier: Apache-2.0
"""The calibration's state machine, without ROS: samples and events in, commands out.

    HOME -> REMOVE_TOOL -> ZERO -> SWEEP_BARE -> HOME -> ATTACH_TOOL -> SWEEP_TOOL -> HOME
    -> ESTIMATE

and for one sweep

    HOME -> REMOVE_TOOL -> ZERO -> ATTACH_TOOL -> SWEEP_TOOL -> HOME -> ESTIMATE

The sensor is zeroed at home with the adapter on and no tool in both. Home of an arm that has none
is where it stands as the goal begins, and its poses are planned then. A cancel, an error and time
are as in `galen_common.goal.procedure`; waiting for a person goes by the wall clock, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import ClassVar

import numpy as np
from galen_common.goal.arrival import PoseRejection
from galen_common.goal.procedure import OnRecord, PoseProcedure
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arm.routes import Router
from galen_model.arrays import Array
from galen_model.errors import GalenError, NotExcitedError
from galen_model.rest.segments import PoseRecord
from numpy.typing import ArrayLike

from galen_calibration_behavior.common.commands import (
    WARNING,
    AttachTool,
    CalibrationCode,
    CalibrationState,
    Measurements,
    PoseFeedback,
    PosesEnd,
    ZeroSensor,
)
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.common.sweep import PoseOutcome, Sweep, still_poses

# A topic's queue holds no more than this of stamps: 2000 samples at 500 Hz.
_DEEPEST_QUEUE_S = 4.0


@dataclass(frozen=True)
class CalibrationRequest:
    """What one goal asks for; `poses` (n, k) are angles in rad.

    poses None: they are planned from where the arm stands, for a tool with its tip at tip_m (3,).
    `router` knows the free ways, None: all are free. zero: whether the sensor can be
    zeroed; else what it reads where it stands goes into the constant offsets. warnings: to be told
    before the arm moves, and in the result.
    """

    tool: str
    one_sweep: bool
    attach_by_service: bool
    poses: Array | None
    router: Router | None = None
    zero: bool = True
    tip_m: ArrayLike = (0.0, 0.0, 0.0)
    warnings: tuple[str, ...] = ()


class CalibrationProcedure(PoseProcedure):
    """One calibration. Call `start`, feed samples and events, and do what `take_commands` gives."""

    codes = CalibrationCode
    two_sweeps: ClassVar[tuple[CalibrationState, ...]] = (
        CalibrationState.HOME,
        CalibrationState.REMOVE_TOOL,
        CalibrationState.ZERO,
        CalibrationState.SWEEP_BARE,
        CalibrationState.HOME,
        CalibrationState.ATTACH_TOOL,
        CalibrationState.SWEEP_TOOL,
        CalibrationState.HOME,
        CalibrationState.ESTIMATE,
    )
    one_sweep: ClassVar[tuple[CalibrationState, ...]] = (
        CalibrationState.HOME,
        CalibrationState.REMOVE_TOOL,
        CalibrationState.ZERO,
        CalibrationState.ATTACH_TOOL,
        CalibrationState.SWEEP_TOOL,
        CalibrationState.HOME,
        CalibrationState.ESTIMATE,
    )
    _settings: CalibrationParameters
    _state: CalibrationState

    def __init__(self, settings: CalibrationParameters, request: CalibrationRequest) -> None:
        states = self.one_sweep if request.one_sweep else self.two_sweeps
        if request.one_sweep and not request.zero:  # the tool may stay on
            off = (CalibrationState.REMOVE_TOOL, CalibrationState.ZERO)
            states = tuple(state for state in states if state not in off)
        super().__init__(settings, CalibrationState.HOME)
        self._request = request
        self._router = request.router
        self._plan = iter(states)
        self._sweep: Sweep | None = None
        self._bare: Sweep | None = None
        self._tool: Sweep | None = None
        self._done_before = 0
        self._poses = request.poses
        self._plan_warnings: tuple[str, ...] = ()
        count = settings.pose_count if request.poses is None else len(request.poses)
        self._planned = count * (1 if request.one_sweep else 2)
        self._waiting_for_person = False
        self._zero_attempts = 0
        self._zero_checks_left = 0
        self._zero_angles = settings.home_angles
        self._tool_off = False
        self.temperature_c = math.nan
        """Newest of the sensor; NaN: none has come."""

    @property
    def waiting_for_person(self) -> bool:
        """Whether `confirm` would be heard."""
        return self._waiting_for_person and not self.ending

    @property
    def progress(self) -> tuple[int, int]:
        """Poses finished in all sweeps, and poses in all sweeps."""
        done = self._done_before + (self._sweep.finished_poses if self._sweep else 0)
        return done, self._planned

    # ---- events

    def on_service(self, success: bool, message: str) -> None:
        """Take the answer to the last ZeroSensor or AttachTool.

        Args:
            success: the driver's.
            message: its reason, where it failed.

        """
        name, self._waiting_for = self._waiting_for, ""
        if not name or self.ending:
            return
        if not success:
            self.fail(CalibrationCode.SERVICE_FAILED, f"{name} failed: {message}")
        elif self._state == CalibrationState.ZERO:
            one_check_s = self._settings.arrival.settle_s + self._settings.average_s
            self._zero_checks_left = math.ceil(_DEEPEST_QUEUE_S / one_check_s)
            self._record_zero()
        else:
            self._tool_is_changed()

    def confirm(self) -> bool:
        """Take a person's word that the tool is off or on; False when none is waited for."""
        if not self.waiting_for_person:
            return False
        self._waiting_for_person = False
        self._tool_is_changed()
        return True

    def on_estimated(self) -> None:
        """Take that the file is written."""
        if not self.ending:
            self._succeed()

    def _check_patience(self) -> None:
        super()._check_patience()
        if self._under_way and self._poses is None:
            self._plan_from_here()
        if self._waiting_for_person and self._waited_s > self._settings.confirm_timeout_s:
            what = "removed" if self._state == CalibrationState.REMOVE_TOOL else "put on"
            self.fail(
                CalibrationCode.CONFIRM_TIMEOUT,
                f"no confirmation in {self._settings.confirm_timeout_s:g} s that the tool was"
                f" {what}",
            )

    def _make_end(self, code: IntEnum, message: str) -> PosesEnd:
        if code != CalibrationCode.NONE and self._tool_off:
            message += "; the tool is still off: put it on again"
        return PosesEnd(
            CalibrationCode(code), message, tuple(self._rejections()), tuple(self._warnings())
        )

    def _drop_watches(self) -> None:
        super()._drop_watches()
        self._waiting_for_person = False

    # ---- states

    def _begin(self) -> None:
        self._warn(self._request.warnings)
        if self._poses is not None:
            self._next()
            return
        # On the wall clock's next tick, so that this is told first: it may take seconds.
        self._report("choosing poses around the present one")

    def _plan_from_here(self) -> None:
        assert self._joints is not None
        request = self._request
        try:
            self._settings = self._settings.beside(self.beside).standing_at(self._joints)
            plan = self._settings.plan(np.asarray(request.tip_m), one_sweep=request.one_sweep)
        except NotExcitedError as error:
            self.fail(CalibrationCode.NOT_EXCITED, str(error))
        except GalenError as error:
            self.fail(CalibrationCode.BAD_INPUT, str(error))
        else:
            self._poses, self._router, self._plan_warnings = plan.poses, plan.router, plan.warnings
            self._zero_angles = self._settings.home_angles
            self._warn(plan.warnings)
            self._next()

    def _warn(self, warnings: Sequence[str]) -> None:
        """Tell what the operator must know before the arm moves."""
        for warning in warnings:
            self._report(f"{WARNING}{warning}")

    def _warnings(self) -> list[str]:
        return [*self._request.warnings, *self._plan_warnings, *super()._warnings()]

    def _next(self) -> None:
        self._state = next(self._plan)
        self._waited_s = 0.0
        enter = {
            CalibrationState.HOME: self._enter_home,
            CalibrationState.REMOVE_TOOL: lambda: self._change_tool("", "take the tool off"),
            CalibrationState.ZERO: self._enter_zero,
            CalibrationState.SWEEP_BARE: lambda: self._enter_sweep("bare"),
            CalibrationState.ATTACH_TOOL: lambda: self._change_tool(
                self._request.tool, f"put {self._request.tool} on"
            ),
            CalibrationState.SWEEP_TOOL: lambda: self._enter_sweep("tool"),
            CalibrationState.ESTIMATE: self._enter_estimate,
        }
        enter[self._state]()

    def _enter_home(self) -> None:
        self._report("going home")
        self._go_to(self._settings.home, self._next)

    def _change_tool(self, tool: str, what: str) -> None:
        if self._request.attach_by_service:
            self._report(f"asking the driver to {what}")
            self._waiting_for = "attach_tool"
            self._commands.append(AttachTool(tool))
        else:
            self._waiting_for_person = True
            self._report(f"please {what}, let go, then confirm")

    def _tool_is_changed(self) -> None:
        self._tool_off = self._state == CalibrationState.REMOVE_TOOL
        self._next()

    def _enter_zero(self) -> None:
        """Go home again, and stand still: the arm may have been pushed meanwhile."""
        self._zero_attempts += 1
        self._report("zeroing the sensor")
        self._stand_for_zeroing(self._on_ready_to_zero)

    def _stand_for_zeroing(self, then: OnRecord) -> None:
        self._visit(self._settings.home, then)

    def _record_zero(self) -> None:
        """Record what the sensor reads where it was just zeroed."""
        self._record(self._settings.home, 0.0, self._on_zero_checked)

    def _on_ready_to_zero(self, outcome: PoseRecord | PoseRejection) -> None:
        if isinstance(outcome, PoseRejection):
            self._zero_again(outcome)
            return
        self._zero_angles = self._settings.arm.angles(outcome.joints)
        if not self._request.zero:
            self._next()
            return
        self._waited_s = 0.0
        self._waiting_for = "zero_ft_sensor"
        self._commands.append(ZeroSensor())

    def _on_zero_checked(self, outcome: PoseRecord | PoseRejection) -> None:
        if isinstance(outcome, PoseRejection):
            self._zero_again(outcome)
            return
        off = np.abs(outcome.wrench) > self._settings.zero_tolerance
        if np.any(off) and self._zero_checks_left > 0:
            # Samples from before the zeroing may still have been in the queue.
            self._zero_checks_left -= 1
            self._record_zero()
            return
        if np.any(off):
            values = ", ".join(
                f"{WRENCH_AXES[k]} = {outcome.wrench[k]:.4g} {'N' if k < 3 else 'N.m'}"
                for k in np.flatnonzero(off)
            )
            self.fail(
                CalibrationCode.SERVICE_FAILED,
                f"zero_ft_sensor answered, but wrench_raw does not read zero: {values}",
            )
            return
        self._next()

    def _zero_again(self, rejection: PoseRejection) -> None:
        if self._zero_attempts > self._settings.pose_retries:
            self.fail(
                CalibrationCode.BAD_INPUT
                if rejection.not_finite
                else CalibrationCode.POSES_NOT_STILL,
                f"the sensor can't be zeroed at home: {rejection.reason}",
            )
        else:
            self._enter_zero()

    def _enter_sweep(self, name: str) -> None:
        assert self._poses is not None
        self._sweep = Sweep(
            name, self._poses, self._settings.stillness, self._settings.pose_retries
        )
        if name == "bare":
            self._bare = self._sweep
        else:
            self._tool = self._sweep
        with_tool = "without the tool" if name == "bare" else f"with {self._request.tool}"
        self._report(f"sweep {with_tool}")
        self._visit_next_pose()

    def _visit_next_pose(self) -> None:
        assert self._sweep is not None
        index = self._sweep.current
        if index is None:
            self._finish_sweep(self._sweep)
            return
        target = self._settings.arm.with_angles(self._sweep.poses[index], self._settings.home)
        self._visit(target, self._on_pose)

    def _on_pose(self, outcome: PoseRecord | PoseRejection) -> None:
        assert self._sweep is not None
        self._take_pose(self._sweep, outcome)
        if self._sweep.rejected_in_a_row >= self._settings.max_rejected_in_a_row:
            reason = (
                outcome.reason if isinstance(outcome, PoseRejection) else "the wrench is not still"
            )
            not_finite = isinstance(outcome, PoseRejection) and outcome.not_finite
            self.fail(
                CalibrationCode.BAD_INPUT if not_finite else CalibrationCode.POSES_NOT_STILL,
                f"{self._sweep.rejected_in_a_row} poses in a row can't be used; the last: {reason}",
            )
            return
        self._visit_next_pose()

    def _take_pose(self, sweep: Sweep, outcome: PoseRecord | PoseRejection) -> None:
        if isinstance(outcome, PoseRecord):
            outcome = replace(outcome, temperature_c=self.temperature_c)
        for verdict in sweep.take(outcome):
            self._report_pose(verdict)

    def _finish_sweep(self, sweep: Sweep) -> None:
        good, count = len(sweep.records), len(sweep.poses)
        if good < self._settings.min_pose_fraction * count:
            reason = sweep.rejections[-1]
            self.fail(
                CalibrationCode.BAD_INPUT if sweep.not_finite else CalibrationCode.POSES_NOT_STILL,
                f"only {good} of {count} poses of the {sweep.name} sweep can be used; {reason}",
            )
            return
        self._done_before += count
        self._sweep = None
        self._next()

    def _enter_estimate(self) -> None:
        assert self._tool is not None
        self.needs_arm = False
        self._report("estimating: comparing models")
        arm, sweeps = self._settings.arm, [self._bare or self._tool, self._tool]
        first_ns = min(record.stamp_ns for sweep in sweeps for record in sweep.records)
        bare, tool = (still_poses(sweep.records, arm, first_ns) for sweep in sweeps)
        self._commands.append(
            Measurements(
                bare=None if self._bare is None else bare,
                tool=tool,
                zero_angles=self._zero_angles,
                bare_indices=[] if self._bare is None else self._bare.indices,
                tool_indices=self._tool.indices,
                rejected=self._rejections(),
                warnings=self._warnings(),
                zeroed=self._request.zero,
            )
        )

    # ---- reports

    def _report(self, message: str) -> None:
        done, total = self.progress
        sweep = self._sweep
        self._commands.append(
            PoseFeedback(
                self._state,
                message,
                pose=sweep.finished_poses if sweep else 0,
                poses=len(sweep.poses) if sweep else 0,
                done=done,
                total=total,
            )
        )

    def _report_pose(self, verdict: PoseOutcome) -> None:
        assert self._sweep is not None
        done, total = self.progress
        wrench: tuple[float, ...] = (float("nan"),) * 6
        if verdict.record is not None:
            wrench = tuple(float(value) for value in verdict.record.wrench)
        sweep = self._sweep
        message = f"pose {sweep.finished_poses} of {len(sweep.poses)} recorded"
        if verdict.message:
            message = f"{sweep.name}/{verdict.index}: {verdict.message}"
        self._commands.append(
            PoseFeedback(
                self._state,
                message,
                pose=self._sweep.finished_poses,
                poses=len(self._sweep.poses),
                done=done,
                total=total,
                angles=verdict.angles,
                accepted=verdict.accepted,
                wrench=wrench,
            )
        )

    def _rejections(self) -> list[str]:
        return [text for sweep in (self._bare, self._tool) if sweep for text in sweep.rejections]
