# SPDX-License-Identifier: Apache-2.0
"""What the demonstration measures: residual weight at unseen poses, drift in admittance mode.

For the drift the arm follows one and the same trajectory three times: with admittance off (that is
where the tool should be), on the raw reading, zeroed at home with the tool on as the
arm did it before the compensation, and on the compensated wrench. The drift is the
distance of the tip from where the first run had it at the same time of the trajectory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from galen_common.goal.arrival import ArrivalSettings, MotionTimeoutError, PoseRecorder
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.rest.segments import PoseRecord, StillnessSettings
from galen_model.rotation import matrix_to_rotvec
from rich.progress import Progress

from galen_bringup.arm_client import MAX_ACCELERATION, MAX_VELOCITY, ArmClient

_ARRIVAL = ArrivalSettings(
    arm=GALEN,
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
        """Return the noise that these very readings had.

        The constant part, which the zeroing left, is not noise and comes off. A ratio to it is more
        certain than one to `noise`: the chance part of the readings is in both of its sides.

        Args:
            poses_truth: (n, 6) noise-free raw readings at `joints`, N and N.m.

        Returns:
            Standard deviation (6,) of the averaged raw readings, N and N.m.

        """
        return np.asarray(np.std(self.raw - poses_truth, axis=0, ddof=1))


def random_poses(count: int, rng: np.random.Generator) -> Array:
    """Draw poses spread over the workspace, in an order that keeps the way short.

    Args:
        count: how many.
        rng: generator of the poses.

    Returns:
        Joints (count, 5), m and rad.

    """
    low = GALEN.home + [-0.02, -0.02, -0.02, -1.5, -1.0]
    high = GALEN.home + [0.02, 0.02, 0.02, 1.5, 0.9]
    poses = rng.uniform(low, high, (count, 5))
    left = list(range(1, count))
    order = [0]
    while left:  # always to the nearest: a good half as long as a random order, and plain
        ways = np.abs(GALEN.angles(poses) - GALEN.angles(poses[order[-1]])).max(axis=1)
        nearest = min(left, key=ways.__getitem__)
        left.remove(nearest)
        order.append(nearest)
    return poses[order]


def visit(
    arm: ArmClient,
    poses: Array,
    average_s: float,
    progress: Progress,
    label: str,
    on_pose: Callable[[Array, Array], None] | None = None,
) -> PoseReadings:
    """Go to poses, wait until the arm stands at each, average both wrenches.

    A pose that was not still, or had no compensated wrench, is visited once more, then skipped and
    named.

    Args:
        arm: client of the arm and its streams.
        poses: (n, 5), m and rad.
        average_s: length of each average, s of stamps.
        progress: gets a task of its own.
        label: of that task.
        on_pose: called after each pose that is not skipped with both averages (6,), raw and
            compensated, N and N.m.

    Returns:
        The readings at the poses that were not skipped.

    Raises:
        GalenError: the arm does not get somewhere, or no pose was still.

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
            if on_pose is not None and not isinstance(outcome, str):
                on_pose(outcome[0].wrench, outcome[1].wrench)
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
        raise GalenError(f"no pose was still: {skipped[0]}")
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
        raise GalenError(failure[0])
    raw, compensated = (recorder.result for recorder in recorders)
    if isinstance(raw, PoseRecord) and isinstance(compensated, PoseRecord):
        return raw, compensated
    reasons = [
        r.reason for r in (raw, compensated) if r is not None and not isinstance(r, PoseRecord)
    ]
    return "; ".join(reasons)


TURNS = ((0.8, 0.0), (0.8, -0.6), (0.0, 0.6), (-0.8, 0.3), (0.0, 0.0))
"""Angles (rad) that the arm turns to, one after the other."""

_HOLD_S = 2.0
_MOVE_S = 2.0
_LARGEST_GAP_S = 0.01
_NS = 1_000_000_000


@dataclass(frozen=True)
class Drift:
    """Distance (n,) m and angle (n,) rad of the tip from where it should be; time (n,) s."""

    time: Array
    distance: Array
    angle: Array


def measure_drift(arm: ArmClient, tip_m: Array, progress: Progress) -> tuple[Drift, Drift]:
    """Measure the drift with compensation off, then on.

    The sensor is left zeroed at home with the tool on, so that nothing that relies on the
    calibration's zero may follow.

    Args:
        arm: client of the arm and its streams.
        tip_m: the tool's tip (3,) in ft_sensor, m.
        progress: gets a task of its own.

    Returns:
        Drift on the raw reading; drift on the compensated wrench.

    Raises:
        GalenError: a run lost samples three times, or the arm does not get somewhere.

    """
    task = progress.add_task("admittance mode, no contact", total=3)
    # The run on the compensated wrench comes before the sensor is zeroed anew for the raw one.
    runs = {}
    for mode in ("off", "compensated", "raw"):
        runs[mode] = _run(arm, mode)
        progress.advance(task)
    should_be = runs["off"]
    return _drift(runs["raw"], should_be, tip_m), _drift(runs["compensated"], should_be, tip_m)


def _run(arm: ArmClient, mode: str) -> tuple[Array, Array]:
    """Time (n,) and joints (n, 5) of one run, again where a busy machine lost samples of it."""
    for _ in range(3):
        _go_home(arm)
        if mode == "raw":
            arm.zero_ft_sensor()
        time, joints = _follow(arm, None if mode == "off" else mode)
        if len(time) > 1 and np.diff(time).max() < _LARGEST_GAP_S:
            return time, joints
    raise GalenError("joint_states lost samples in three runs: this machine needs a lower speed")


def _go_home(arm: ArmClient) -> None:
    arm.move_to(GALEN.home)
    arm.wait_for(lambda: _is_at(arm, GALEN.home), 60.0, "the arm to come home")
    settled_ns = arm.stamp_ns + _NS // 2
    arm.wait_for(lambda: arm.stamp_ns > settled_ns, 60.0, "joint_states")


def _is_at(arm: ArmClient, target: Array) -> bool:
    return arm.position is not None and bool(np.all(np.abs(arm.position - target) < 1e-4))


def _follow(arm: ArmClient, source: str | None) -> tuple[Array, Array]:
    """Time (n,) since the trajectory's start and joints (n, 5)."""
    # The first point is home at the very start: what lies between now and then is no motion, so
    # that the runs don't differ by when the trajectory came in.
    targets, times = [GALEN.home], [0.0]
    for turn, angles in enumerate(TURNS):
        target = GALEN.with_angles(angles)
        start_s = turn * (_MOVE_S + _HOLD_S)
        targets += [target, target]
        times += [start_s + _MOVE_S, start_s + _MOVE_S + _HOLD_S]
    steps = np.diff(targets, axis=0)
    assert np.all(1.875 * np.abs(steps) < MAX_VELOCITY * _MOVE_S)
    assert np.all(5.774 * np.abs(steps) < MAX_ACCELERATION * _MOVE_S**2)

    stamps: list[int] = []
    positions: list[Array] = []

    def on_joints(stamp_ns: int, position: Array, _: Array | None) -> None:
        stamps.append(stamp_ns)
        positions.append(position)

    if source is not None:
        arm.set_admittance(True, source)
    arm.on_joints = on_joints
    start_ns = arm.stamp_ns + _NS  # far enough ahead to have arrived by then
    arm.follow(targets, times, start_ns)
    end_ns = start_ns + round(times[-1] * _NS)
    try:
        arm.wait_for(lambda: stamps and stamps[-1] >= end_ns, 120.0, "the trajectory's end")
    finally:
        arm.on_joints = None
        if source is not None:
            arm.set_admittance(False, source)
    time = (np.array(stamps) - start_ns) / _NS
    inside = (time >= 0.0) & (time <= times[-1])
    return time[inside], np.array(positions)[inside]


def _drift(run: tuple[Array, Array], should_be: tuple[Array, Array], tip_m: Array) -> Drift:
    time = run[0]
    reference = np.column_stack(
        [np.interp(time, should_be[0], should_be[1][:, joint]) for joint in range(5)]
    )
    rotation, tip = GALEN.tip_pose(run[1], tip_m)
    reference_rotation, reference_tip = GALEN.tip_pose(reference, tip_m)
    turned = np.einsum("nij,nkj->nik", rotation, reference_rotation)
    return Drift(
        time,
        np.linalg.norm(tip - reference_tip, axis=1),
        np.linalg.norm(matrix_to_rotvec(turned), axis=1),
    )
