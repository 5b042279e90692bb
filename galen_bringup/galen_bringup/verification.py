"""Visit poses that the calibration has not seen, and record what is left of the tool's weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import HOME
from galen_model.arrays import Array
from galen_model.rest.pose import PoseRecord, StillnessSettings
from galen_ros.goal.arrival import ArrivalSettings, MotionTimeoutError, PoseRecorder
from rich.progress import Progress

from galen_bringup.arm_client import ArmClient, ArmError

_ARRIVAL = ArrivalSettings(
    position_tolerance=np.array([5e-4] * 3 + [3e-3] * 2),
    velocity_tolerance=np.array([5e-4] * 3 + [2e-3] * 2),
    velocity_window_s=0.06,
    settle_s=0.05,
    max_stamp_step_s=0.05,
)
_STILLNESS = StillnessSettings(
    joint_motion=np.array([1e-4] * 3 + [5e-4] * 2),
    scatter_ratio=1.5,
    trend_sigmas=6.0,
    min_samples=50,
)


@dataclass(frozen=True)
class PoseReadings:
    """n visited poses: joints (n, 5); averaged raw and compensated wrenches (n, 6), N and N.m.

    sample_std: (n, 6) standard deviation of single raw samples within each pose; samples: (n,).
    """

    joints: Array
    raw: Array
    compensated: Array
    sample_std: Array
    samples: Array
    skipped: tuple[str, ...]

    @property
    def noise(self) -> Array:
        """Noise (6,) of an averaged reading, from the scatter of the samples within the poses."""
        return np.asarray(np.sqrt(np.mean(self.sample_std**2 / self.samples[:, None], axis=0)))

    @property
    def rmse(self) -> Array:
        """Root mean square (6,) of the averaged compensated wrenches."""
        return np.asarray(np.sqrt(np.mean(self.compensated**2, axis=0)))

    def noise_at(self, poses_truth: Array) -> Array:
        """Noise (6,) that these very readings had, given the noise-free ones (n, 6).

        The constant part, which the zeroing left, is not noise and comes off. A ratio to it tells
        more than one to `noise`: what chance did to the readings is in both of its sides.
        """
        return np.asarray(np.std(self.raw - poses_truth, axis=0, ddof=1))


def random_poses(count: int, rng: np.random.Generator) -> Array:
    """Joints (count, 5) spread over the workspace, in an order that keeps the way short."""
    low = HOME + [-0.02, -0.02, -0.02, -1.5, -1.0]
    high = HOME + [0.02, 0.02, 0.02, 1.5, 0.9]
    poses = rng.uniform(low, high, (count, 5))
    left = list(range(1, count))
    order = [0]
    while left:  # always to the nearest: a good half as long as a random order, and plain
        here = poses[order[-1], 3:]
        nearest = min(left, key=lambda index: float(np.abs(poses[index, 3:] - here).max()))
        left.remove(nearest)
        order.append(nearest)
    return poses[order]


def visit(
    arm: ArmClient, poses: Array, average_s: float, progress: Progress, label: str
) -> PoseReadings:
    """Go to each of poses (n, 5), wait until the arm stands there, average both wrenches.

    A pose that was not still, or had no compensated wrench, is skipped and named. Raises ArmError
    when the arm does not get somewhere.
    """
    joints, raw, compensated, stds, samples, skipped = [], [], [], [], [], []
    task = progress.add_task(label, total=len(poses))
    with arm.wrenches():
        outcomes = []
        for target in poses:
            outcome = _visit_one(arm, target, average_s)
            if isinstance(outcome, str):  # once more: a busy machine may have lost samples
                outcome = _visit_one(arm, target, average_s)
            outcomes.append(outcome)
            progress.advance(task)
    for number, outcome in enumerate(outcomes):
        if isinstance(outcome, str):
            skipped.append(f"pose {number + 1}: {outcome}")
        else:
            one_raw, one_compensated = outcome
            joints.append(one_raw.joints)
            raw.append(one_raw.wrench)
            compensated.append(one_compensated.wrench)
            stds.append(one_raw.wrench_std)
            samples.append(one_raw.samples)
    if not joints:
        raise ArmError(f"no pose was still: {skipped[0]}")
    return PoseReadings(
        joints=np.array(joints),
        raw=np.array(raw),
        compensated=np.array(compensated),
        sample_std=np.array(stds),
        samples=np.array(samples, dtype=float),
        skipped=tuple(skipped),
    )


def _visit_one(
    arm: ArmClient, target: Array, average_s: float
) -> tuple[PoseRecord, PoseRecord] | str:
    duration_s = arm.move_to(target)
    recorders = [
        PoseRecorder(_ARRIVAL, _STILLNESS, average_s, target, duration_s + 10.0) for _ in range(2)
    ]
    failure: list[str] = []

    def on_joints(stamp_ns: int, position: Array, velocity: Array | None) -> None:
        try:
            for recorder in recorders:
                recorder.add_joints(stamp_ns, position, velocity)
        except MotionTimeoutError as error:
            failure.append(str(error))

    arm.on_joints = on_joints
    arm.on_raw, arm.on_compensated = recorders[0].add_wrench, recorders[1].add_wrench
    try:
        arm.wait_for(
            lambda: failure or all(recorder.result is not None for recorder in recorders),
            60.0,
            "a still pose with wrench_raw and wrench_compensated",
        )
    finally:
        arm.on_joints = arm.on_raw = arm.on_compensated = None
    if failure:
        raise ArmError(failure[0])
    raw, compensated = (recorder.result for recorder in recorders)
    if isinstance(raw, PoseRecord) and isinstance(compensated, PoseRecord):
        return raw, compensated
    reasons = [
        r.reason for r in (raw, compensated) if r is not None and not isinstance(r, PoseRecord)
    ]
    return "; ".join(reasons)
