"""Averages joints and wrench over one pose: wait for the arrival, settle, average, judge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import JOINT_NAMES, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.rest.pose import (
    PoseRecord,
    StillnessSettings,
    average_pose,
    joint_motion_fault,
)

from galen_ros.goal.arrival import ArrivalMonitor, ArrivalSettings
from galen_ros.goal.stamps import NS, StampClock

# How far the wrenches may lag behind the joint states before the window is given up.
_LAG_NS = NS // 2


@dataclass(frozen=True)
class Rejection:
    """Why a pose can't be used."""

    reason: str
    not_finite: bool = False


class PoseRecorder:
    """One visit of one pose. Feed it both streams; `result` is set when the visit is over.

    The average runs over the same stretch of stamps in both streams, so it does not matter in
    which order or how bunched the samples come in. Raises MotionTimeoutError from `add_joints`.
    A topic that brings nothing at all is waited for: whether the driver is silent is the wall
    clock's question, which the procedure asks.
    """

    def __init__(
        self,
        arrival: ArrivalSettings,
        stillness: StillnessSettings,
        average_s: float,
        target: Array,
        allowance_s: float,
    ) -> None:
        """`target` (5,) in m and rad; `allowance_s` for arriving, stopping and settling."""
        self._stillness = stillness
        self._average_ns = round(average_s * NS)
        self._arrival = ArrivalMonitor(arrival, target, allowance_s, "joint_states")
        self._joint_clock = self._arrival.clock
        self._wrench_clock = StampClock("wrench_raw", arrival.max_stamp_step_s)
        self._max_step_ns = round(arrival.max_stamp_step_s * NS)
        self._window: tuple[int, int] | None = None
        self._jumps_before = 0
        self._joints: list[tuple[int, Array]] = []
        self._wrenches: list[tuple[int, Array]] = []
        self.result: PoseRecord | Rejection | None = None

    @property
    def window_ns(self) -> tuple[int, int] | None:
        """First and last stamp of the average; None while the arm has not settled."""
        return self._window

    def close(self, end_ns: int) -> None:
        """End the average at this stamp, for the arm goes on then; nothing if it has not begun."""
        if self._window is not None and self.result is None:
            self._window = (self._window[0], min(self._window[1], end_ns))
            self.result = self._judge()

    @property
    def jumps(self) -> int:
        """Jumps of stamps seen in this visit, in both streams."""
        return self._joint_clock.jumps + self._wrench_clock.jumps

    @property
    def last_jump(self) -> str:
        """The last jump in words; empty when there was none."""
        reasons = [c.last_jump for c in (self._joint_clock, self._wrench_clock) if c.last_jump]
        return " and ".join(reasons)

    def add_joints(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        """Take a joint state, (5,) in m, rad and per s."""
        if self.result is not None:
            return
        if self._window is None:
            if self._arrival.add(stamp_ns, position, velocity):
                self._window = (stamp_ns, stamp_ns + self._average_ns)
                self._jumps_before = self.jumps
                self._joints.append((stamp_ns, position))
            return
        if self._joint_clock.advance(stamp_ns):
            self._joints.append((stamp_ns, position))
            self._finish_if_complete()

    def add_wrench(self, stamp_ns: int, wrench: Array) -> None:
        """Take a wrench, (6,) in ft_sensor, N and N.m."""
        if self.result is not None or not self._wrench_clock.advance(stamp_ns):
            return
        self._wrenches.append((stamp_ns, wrench))
        if self._window is not None:
            self._reject_if_behind(stamp_ns)
            self._finish_if_complete()
        elif len(self._wrenches) > 2000:
            # On the way: keep a little, for a wrench may be handed over before the joint state
            # of the same stamp.
            del self._wrenches[:-1000]

    def _reject_if_behind(self, wrench_ns: int) -> None:
        joint_ns = self._joint_clock.stamp_ns
        if joint_ns is None or self._window is None:
            return
        if wrench_ns < self._window[1] and joint_ns > self._window[1] + _LAG_NS:
            self.result = Rejection(
                f"the stamps of wrench_raw are {(joint_ns - wrench_ns) / NS:.3f} s behind those of"
                " joint_states"
            )

    def _finish_if_complete(self) -> None:
        if self._window is None or self.result is not None:
            return
        if self.jumps != self._jumps_before:
            self.result = Rejection(f"{self.last_jump} while averaging")
            return
        end = self._window[1]
        joint_ns, wrench_ns = self._joint_clock.stamp_ns, self._wrench_clock.stamp_ns
        if joint_ns is None or wrench_ns is None or min(joint_ns, wrench_ns) < end:
            return
        self.result = self._judge()

    def _judge(self) -> PoseRecord | Rejection:
        joints, _ = self._inside(self._joints)
        wrenches, wrench_stamps = self._inside(self._wrenches)
        needed = self._stillness.min_samples
        if len(wrenches) < needed or len(joints) < max(2, needed // 10):
            return Rejection(
                f"only {len(wrenches)} samples of wrench_raw and {len(joints)} of joint_states"
                f" while averaging ({needed} wrenches are needed)"
            )
        gap = int(np.max(np.diff(wrench_stamps)))
        if gap > self._max_step_ns or np.min(np.diff(wrench_stamps)) < 0:
            return Rejection(f"wrench_raw has a gap of {gap / NS:.3f} s while averaging")
        for values, names, topic in (
            (joints, JOINT_NAMES, "joint_states"),
            (wrenches, WRENCH_AXES, "wrench_raw"),
        ):
            bad = np.flatnonzero(~np.all(np.isfinite(values), axis=0))
            if len(bad):
                listed = ", ".join(names[k] for k in bad)
                return Rejection(f"{topic}: {listed} not finite", not_finite=True)
        record = average_pose(joints, wrenches)
        moved = joint_motion_fault(record, self._stillness)
        return Rejection(moved) if moved else record

    def _inside(self, samples: list[tuple[int, Array]]) -> tuple[Array, Array]:
        """Return values and stamps of the samples inside the window."""
        assert self._window is not None
        start, end = self._window
        kept = [(stamp, value) for stamp, value in samples if start <= stamp <= end]
        return (
            np.array([value for _, value in kept], float),
            np.array([stamp for stamp, _ in kept], np.int64),
        )
