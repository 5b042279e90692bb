"""How far a hand-guided tool drifts without contact while the arm turns.

The arm follows one and the same trajectory three times: with admittance off (that is where the
tool should be), with admittance on the raw reading, zeroed at home with the tool on as the arm did
it before the compensation, and with admittance on the compensated wrench. The drift is the distance
of the tip from where the first run had it at the same time of the trajectory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import HOME
from galen_model.arm.kinematics import tip_pose
from galen_model.arrays import Array
from galen_model.rotation import matrix_to_rotvec
from rich.progress import Progress

from galen_bringup.arm_client import MAX_ACCELERATION, MAX_VELOCITY, ArmClient, ArmError

TURNS = ((0.8, 0.0), (0.8, -0.6), (0.0, 0.6), (-0.8, 0.3), (0.0, 0.0))
"""Roll and tilt (rad) that the arm turns to, one after the other."""

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

    @property
    def end_m(self) -> float:
        """Distance at the end of the trajectory, m."""
        return float(self.distance[-1])

    @property
    def largest_m(self) -> float:
        """Largest distance, m."""
        return float(self.distance.max())


def measure_drift(arm: ArmClient, tip_m: Array, progress: Progress) -> tuple[Drift, Drift]:
    """Drift with compensation off, then on; the tool's tip (3,) in ft_sensor.

    The sensor is left zeroed at home with the tool on, so that nothing that relies on the
    calibration's zero may follow.
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
    raise ArmError("joint_states lost samples in three runs: this machine needs a lower speed")


def _go_home(arm: ArmClient) -> None:
    arm.move_to(HOME)
    arm.wait_for(lambda: _is_at(arm, HOME), 60.0, "the arm to come home")
    settled_ns = arm.stamp_ns + _NS // 2
    arm.wait_for(lambda: arm.stamp_ns > settled_ns, 60.0, "joint_states")


def _is_at(arm: ArmClient, target: Array) -> bool:
    return arm.position is not None and bool(np.all(np.abs(arm.position - target) < 1e-4))


def _follow(arm: ArmClient, source: str | None) -> tuple[Array, Array]:
    """Time (n,) since the trajectory's start and joints (n, 5)."""
    # The first point is home at the very start: what lies between now and then is no motion, so
    # that the runs don't differ by when the trajectory came in.
    targets, times = [HOME], [0.0]
    for turn, (roll, tilt) in enumerate(TURNS):
        target = HOME.copy()
        target[3:] = roll, tilt
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
    rotation, tip = tip_pose(run[1], tip_m)
    reference_rotation, reference_tip = tip_pose(reference, tip_m)
    turned = np.einsum("nij,nkj->nik", rotation, reference_rotation)
    return Drift(
        time,
        np.linalg.norm(tip - reference_tip, axis=1),
        np.linalg.norm(matrix_to_rotvec(turned), axis=1),
    )
