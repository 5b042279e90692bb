# SPDX-License-Identifier: Apache-2.0
"""A calibration in which an operator moves the arm: every rest segment is a pose of the sweep.

    REMOVE_TOOL -> ZERO -> SWEEP_BARE -> ATTACH_TOOL -> SWEEP_TOOL -> ESTIMATE

and for one sweep without SWEEP_BARE. A sweep ends when the compensation is known well enough: with
B(d) = [G(d), I] the rows of one load and six offsets under gravity along d, and n poses,

    N = sum_i B(d_i)^T Sigma^-1 B(d_i),    var(d) = diag(B(d) N^-1 B(d)^T),

averaged over the directions d that the arm's joints allow (`galen_model.poses.design`, the
same criterion). Sigma is one averaged reading's noise, from the residuals where those are larger.
The next orientation is the one that lowers the sum of the relative variances most.
"""

from __future__ import annotations

import math

import numpy as np
from galen_common.goal.arrival import PoseRecorder, PoseRejection
from galen_common.goal.procedure import OnRecord
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.estimation.problem import MIN_POSES_TO_REJECT
from galen_model.load.identification import (
    SingleLoad,
    identify_single_load,
)
from galen_model.load.model import LoadEstimate
from galen_model.load.readings import single_load_design
from galen_model.poses.design import compensation_std_under, workspace_gravity
from galen_model.rest.segments import PoseRecord

from galen_calibration_behavior.calibration.procedure import (
    CalibrationProcedure,
    CalibrationRequest,
)
from galen_calibration_behavior.common.commands import CalibrationCode, CalibrationState
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.common.sweep import Sweep, stack

TURN_RAD = 0.15
"""Two poses nearer than this, by gravity in the sensor, are one."""
_LOOK_EVERY_NS = 50_000_000


def missing_direction(gravity: Array, sigma: Array, arm: Arm) -> Array:
    """Find the direction of gravity in the sensor that would add most.

    Args:
        gravity: (n, 3) of the poses so far, m/s^2, in the sensor's frame; n at least 1.
        sigma: (6,) noise of one averaged reading, N and N.m.
        arm: whose joints limit the directions.

    Returns:
        Direction (3,), a unit vector in the sensor's frame, away from those so far.

    """
    directions = workspace_gravity(arm)
    each = _information(directions, sigma)
    # So little of every direction that it counts only until the poses identify the load.
    start = 1e-6 * each.mean(axis=0)
    so_far = _information(gravity, sigma).sum(axis=0) + start
    left = np.einsum("npq,qp->n", np.linalg.inv(so_far + each), each.mean(axis=0))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    cosine = unit @ (gravity / np.linalg.norm(gravity, axis=1, keepdims=True)).T
    left[np.max(cosine, axis=1) > math.cos(TURN_RAD)] = np.inf  # would be no new pose
    return np.asarray(unit[int(np.argmin(left))])


def _information(gravity: Array, sigma: Array) -> Array:
    rows = single_load_design(gravity)
    return np.asarray(np.swapaxes(rows, 1, 2) @ (rows / sigma[:, None] ** 2))


def down_text(direction: Array, frame: str) -> str:
    """Name the axes of a frame that are to point down.

    Args:
        direction: (3,) of gravity in the frame, any length.
        frame: its name.

    Returns:
        Such as "+z and -x of ft_sensor down alike"; axes by at least half of the largest component.

    """
    order = np.argsort(-np.abs(direction))
    shown = [k for k in order if abs(direction[k]) >= 0.5 * abs(direction[order[0]])]
    axes = " and ".join(f"{'+' if direction[k] > 0 else '-'}{'xyz'[k]}" for k in shown)
    return f"{axes} of {frame} down" + (" alike" if len(shown) > 1 else "")


class ByHandProcedure(CalibrationProcedure):
    """One calibration of an arm that is moved by hand or pendant; no motion is commanded."""

    moves = False
    two_sweeps = (
        CalibrationState.REMOVE_TOOL,
        CalibrationState.ZERO,
        CalibrationState.SWEEP_BARE,
        CalibrationState.ATTACH_TOOL,
        CalibrationState.SWEEP_TOOL,
        CalibrationState.ESTIMATE,
    )
    one_sweep = (*two_sweeps[:2], *two_sweeps[3:])

    def __init__(self, settings: CalibrationParameters, request: CalibrationRequest) -> None:
        super().__init__(settings, request)
        self._looked_ns = 0
        self._single: SingleLoad | None = None

    @property
    def waiting_for_person(self) -> bool:
        """Whether `confirm` would be heard: a tool to change, or a sweep that may end."""
        may_end = self._sweep is not None and self._single is not None and not self.ending
        return may_end or super().waiting_for_person

    def confirm(self) -> bool:
        """Take a person's word that the tool is off or on, or that a sweep is enough."""
        if self._sweep is not None and self.waiting_for_person:
            self._finish_sweep(self._sweep)
            return True
        return super().confirm()

    @property
    def progress(self) -> tuple[int, int]:
        """Poses so far, and about how many it will be."""
        done = self._done_before + (len(self._sweep.records) if self._sweep else 0)
        return done, max(done, self._planned)

    # ---- a sweep

    def _stand_for_zeroing(self, then: OnRecord) -> None:
        """Wait until the arm stands still: any pose will do."""
        self._record_here(then)

    def _record_zero(self) -> None:
        self._record_here(self._on_zero_checked)

    def _record_here(self, then: OnRecord) -> None:
        if self.ending:
            return
        settings = self._settings
        self._recorder = PoseRecorder(
            settings.arrival, settings.stillness, settings.average_s, None, math.inf
        )
        self._on_record = then

    def _enter_sweep(self, name: str) -> None:
        self._single = None
        angles = len(self._settings.arm.turning)
        self._sweep = Sweep(name, np.zeros((0, angles)), self._settings.stillness, 0)
        if name == "bare":
            self._bare = self._sweep
        else:
            self._tool = self._sweep
        with_tool = "without the tool" if name == "bare" else f"with {self._request.tool}"
        self._report(
            f"sweep {with_tool}: turn the wrist to many orientations, let go, and keep it still at"
            f" each for {self._settings.arrival.settle_s + self._settings.average_s:.1f} s"
        )

    def _take_joints(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        if self._recorder is None and self._sweep is not None:
            if abs(stamp_ns - self._looked_ns) < _LOOK_EVERY_NS:
                return
            self._looked_ns = stamp_ns
            if np.all(np.isfinite(position)) and self._is_new(position):
                self._record_here(self._on_pose)
        super()._take_joints(stamp_ns, position, velocity)

    def _is_new(self, joints: Array) -> bool:
        """Whether gravity in the sensor is away from where it was at every pose so far."""
        assert self._sweep is not None
        taken = self._gravity(self._sweep)
        if not len(taken):
            return True
        arm = self._settings.arm
        here = arm.gravity_in_sensor(arm.angles(joints))
        cosine = taken @ here / float(here @ here)
        return bool(np.max(cosine) < math.cos(TURN_RAD))

    def _gravity(self, sweep: Sweep) -> Array:
        arm = self._settings.arm
        return arm.gravity_in_sensor(stack(sweep.records, arm)[0])

    def _on_pose(self, outcome: PoseRecord | PoseRejection) -> None:
        assert self._sweep is not None
        if isinstance(outcome, PoseRejection) or not self._is_new(outcome.joints):
            reason = outcome.reason if isinstance(outcome, PoseRejection) else "no new orientation"
            self._report(f"not taken: {reason}")
            return
        self._waited_s = 0.0
        sweep = self._sweep
        sweep.append(self._settings.arm.angles(outcome.joints))
        self._take_pose(sweep, outcome)
        self._judge(sweep)

    def _judge(self, sweep: Sweep) -> None:
        """Report what is identified so far and what is missing; end the sweep if it is enough."""
        arm, count, self._single = self._settings.arm, len(sweep.records), None
        _, wrench, std_of_mean = stack(sweep.records, arm)
        gravity, sigma = self._gravity(sweep), np.median(std_of_mean, axis=0)
        text, expected = f"{count} poses of at least {MIN_POSES_TO_REJECT}", MIN_POSES_TO_REJECT
        enough = False
        if count >= MIN_POSES_TO_REJECT:
            try:
                self._single = single = identify_single_load(gravity, wrench, arm=arm)
            except GalenError as error:
                text = f"{count} poses: {error}"
            else:
                sigma = np.maximum(sigma, single.sigma)
                std = compensation_std_under(gravity, sigma, arm)
                worst = float(np.max(std / self._settings.by_hand_std))
                enough = worst <= 1.0
                expected = math.ceil(count * min(worst, 3.0) ** 2)
                text = f"{count} poses: {_found(single.load)}; {_precision(std, self._settings)}"
        self._planned = self._done_before + max(count, expected)
        if enough:
            self._report(f"{text}; enough")
            self._finish_sweep(sweep)
        else:
            direction = missing_direction(gravity, sigma, arm)
            self._report(f"{text}; missing: {down_text(direction, arm.sensor_frame)}")

    def _finish_sweep(self, sweep: Sweep) -> None:
        self._recorder = None
        self._done_before += len(sweep.records)
        self._sweep = None
        self._next()

    def _check_patience(self) -> None:
        super()._check_patience()
        if self._sweep is not None and self._waited_s > self._settings.confirm_timeout_s:
            self.fail(
                CalibrationCode.CONFIRM_TIMEOUT,
                f"no pose in a new orientation in {self._settings.confirm_timeout_s:g} s; the"
                f" {self._sweep.name} sweep has {len(self._sweep.records)}",
            )


def _found(load: LoadEstimate) -> str:
    centre = ", ".join(
        f"{1e3 * value:.2f} ± {1e3 * std:.2f}"
        for value, std in zip(load.com_m, load.com_std_m, strict=True)
    )
    return f"{1e3 * load.mass_kg:.2f} ± {1e3 * load.mass_std_kg:.2f} g at ({centre}) mm"


def _precision(std: Array, wanted: CalibrationParameters) -> str:
    return (
        f"compensation to {np.max(std[:3]):.4f} N and {1e3 * np.max(std[3:]):.3f} mN.m (1 sigma;"
        f" wanted {wanted.by_hand_std_n:g} N and {1e3 * wanted.by_hand_std_nm:g} mN.m)"
    )
