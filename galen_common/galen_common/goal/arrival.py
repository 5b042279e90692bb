# SPDX-License-Identifier: Apache-2.0
"""When the arm is at its target and settled, and the average of joints and wrench there.

All times are the samples' stamps. The authors of the 2019 report lost weeks to jumps in the time
stamps of their recordings: here a jump never counts as time gone by, and never hides inside an
average.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.rest.segments import (
    PoseRecord,
    StillnessSettings,
    average_pose,
    joint_motion_fault,
)

NS = 1_000_000_000
# So many jumps, and more jumps than steps: then it is not a jump but how the topic is.
_MANY_JUMPS = 10
# Joint states are looked at this often (by stamps); each one costs only an append.
_LOOK_EVERY_NS = 20_000_000
# How far the wrenches may lag behind the joint states before the window is given up.
_LAG_NS = NS // 2


class StampsError(GalenError):
    """A topic whose stamps jump with nearly every sample; the message names it and the step."""


class StampClock:
    """Time gone by on a topic's stamps; a step back, or a long one, is a jump and adds nothing."""

    def __init__(self, topic: str, max_step_s: float) -> None:
        self._topic = topic
        self._max_step_ns = round(max_step_s * NS)
        self._elapsed_ns = 0
        self._steps = 0
        self.stamp_ns: int | None = None
        self.jumps = 0
        self.last_jump = ""

    @property
    def elapsed_ns(self) -> int:
        """Time gone by since the first sample, jumps left out."""
        return self._elapsed_ns

    def advance(self, stamp_ns: int) -> bool:
        """Take a sample's stamp.

        Args:
            stamp_ns: the stamp, ns.

        Returns:
            False for a repeated stamp.

        Raises:
            StampsError: most steps are jumps, as of a topic slower than the longest step allowed.

        """
        last, self.stamp_ns = self.stamp_ns, stamp_ns
        if last is None:
            return True
        step = stamp_ns - last
        if step == 0:
            return False
        if 0 < step <= self._max_step_ns:
            self._elapsed_ns += step
            self._steps += 1
        else:
            self.jumps += 1
            self.last_jump = f"the stamps of {self._topic} jumped by {step / NS:+.3f} s"
            if self.jumps >= _MANY_JUMPS and self.jumps > self._steps:
                raise StampsError(
                    f"{self.last_jump}, and so do most of its samples;"
                    f" max_stamp_step_s is {self._max_step_ns / NS:g}"
                )
        return True


@dataclass(frozen=True)
class ArrivalSettings:
    """Tolerances (n,) in the order and units of the arm's joints, times in s."""

    position_tolerance: Array
    velocity_tolerance: Array
    velocity_window_s: float
    settle_s: float
    max_stamp_step_s: float
    arm: Arm


class MotionTimeoutError(Exception):
    """A joint did not reach its target, or did not stop, in time; the message names the joints."""


class ArrivalMonitor:
    """Watch joint states until the arm is at the target, has stopped and has settled.

    Stopped means that over `velocity_window_s` the median of the reported speed is within
    tolerance or, where the message holds no velocity, that the position's span over the window,
    divided by the window, is. The median forgives noise of single samples but not a swing.
    A jump of the stamps starts the settling anew and never counts as waiting time. Where the arm
    is looked at depends on the stamps alone and not on the first sample seen, so that a recording
    of the same samples settles at the same one.
    """

    def __init__(
        self, settings: ArrivalSettings, target: Array | None, allowance_s: float, topic: str
    ) -> None:
        """Start before the first joint state.

        Args:
            settings: tolerances of the arm's n joints, and times.
            target: (n,), m and rad; None: only a standstill is waited for.
            allowance_s: time-out to arrive, stop and settle, s of stamps.
            topic: of the joint states, as it is called in sentences.

        """
        self._settings = settings
        self._target = None if target is None else np.array(target, float)
        self._allowance_s = allowance_s
        self._window_ns = round(settings.velocity_window_s * NS)
        self.clock = StampClock(topic, settings.max_stamp_step_s)
        self._recent: deque[tuple[int, Array, Array | None]] = deque()
        self._last_look: int | None = None
        self._settle_ns = round(settings.settle_s * NS)
        self._settling_since_ns: int | None = None
        self._jumps_seen = 0

    def add(self, stamp_ns: int, position: Array, velocity: Array | None) -> bool:
        """Take a joint state.

        Args:
            stamp_ns: its stamp, ns.
            position: (n,), m and rad.
            velocity: (n,), m/s and rad/s; None where the message has none.

        Returns:
            True once arrived, stopped and settled.

        Raises:
            MotionTimeoutError: the allowance is used up.
            StampsError: as `StampClock.advance` does.

        """
        if not self.clock.advance(stamp_ns):
            return False
        if self.clock.jumps != self._jumps_seen:
            self._jumps_seen = self.clock.jumps
            self._recent.clear()
            self._last_look = None
            self._settling_since_ns = None
        self._recent.append((stamp_ns, position, velocity))
        look = stamp_ns // _LOOK_EVERY_NS
        if look == self._last_look:
            return False
        self._last_look = look
        return self._look()

    def _look(self) -> bool:
        newest_ns = self._recent[-1][0]
        while len(self._recent) > 2 and newest_ns - self._recent[1][0] >= self._window_ns:
            self._recent.popleft()
        elapsed_ns = self.clock.elapsed_ns
        faults = self._faults(newest_ns - self._recent[0][0])
        if not faults:
            if self._settling_since_ns is None:
                self._settling_since_ns = elapsed_ns
            if elapsed_ns - self._settling_since_ns >= self._settle_ns:
                return True
        else:
            self._settling_since_ns = None
        if elapsed_ns > self._allowance_s * NS:
            reason = "; ".join(faults) or "the arm did not stay at its target long enough"
            raise MotionTimeoutError(f"{reason} (waited {elapsed_ns / NS:.1f} s)")
        return False

    def _faults(self, span_ns: int) -> list[str]:
        """Return why the arm has not arrived yet, a sentence a joint."""
        if span_ns < self._window_ns:
            return ["too few joint states yet to tell that the arm has stopped"]
        names, units = self._settings.arm.joint_names, self._settings.arm.units
        faults = []
        position = self._recent[-1][1]
        if not np.all(np.isfinite(position)):
            return [
                f"{names[k]} reports {position[k]}" for k in np.flatnonzero(~np.isfinite(position))
            ]
        if self._target is not None:
            position = self._settings.arm.nearest(position, self._target)
            away = np.abs(position - self._target) > self._settings.position_tolerance
            faults += [
                f"{names[k]} did not reach {self._target[k]:.4f} {units[k]}:"
                f" it stands at {position[k]:.4f} {units[k]}"
                for k in np.flatnonzero(away)
            ]
        speed = self._speed(span_ns)
        moving = ~(speed <= self._settings.velocity_tolerance)
        faults += [
            f"{names[k]} did not stop: it moves at {speed[k]:.4f} {units[k]}/s"
            for k in np.flatnonzero(moving)
        ]
        return faults

    def _speed(self, span_ns: int) -> Array:
        velocities = [sample[2] for sample in self._recent if sample[2] is not None]
        if len(velocities) == len(self._recent):
            # np.median is four times slower; a NaN, which comes last, counts as moving.
            size = np.sort(np.abs(np.array(velocities)), axis=0)
            middle: Array = 0.5 * (size[(len(size) - 1) // 2] + size[len(size) // 2])
            return np.where(np.isnan(size[-1]), np.nan, middle)
        positions = np.array([sample[1] for sample in self._recent])
        positions = self._settings.arm.nearest(positions, positions[0])
        span: Array = np.ptp(positions, axis=0) / (span_ns / NS)
        return span


@dataclass(frozen=True)
class PoseRejection:
    """Why a pose can't be used."""

    reason: str
    not_finite: bool = False


class PoseRecorder:
    """One visit of one pose. Feed it both streams; `result` is set when the visit is over.

    The average runs over the same stretch of stamps in both streams, so it does not matter in
    which order or how bunched the samples come in.
    A topic that brings nothing at all is waited for; `GoalProcedure` ends it by the wall clock.
    """

    def __init__(
        self,
        arrival: ArrivalSettings,
        stillness: StillnessSettings,
        average_s: float,
        target: Array | None,
        allowance_s: float,
    ) -> None:
        """Start before the first sample.

        Args:
            arrival: tolerances of the arm's n joints, and times.
            stillness: when the averaged pose was still.
            average_s: length of the average, s of stamps, from when the arm has settled.
            target: (n,), m and rad; None: anywhere.
            allowance_s: time-out to arrive, stop and settle, s of stamps.

        """
        self._arm = arrival.arm
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
        self.result: PoseRecord | PoseRejection | None = None

    @property
    def window_ns(self) -> tuple[int, int] | None:
        """First and last stamp of the average; None while the arm has not settled."""
        return self._window

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
        """Take a joint state.

        Args:
            stamp_ns: its stamp, ns.
            position: (n,), m and rad.
            velocity: (n,), m/s and rad/s; None where the message has none.

        Raises:
            MotionTimeoutError: the arm did not arrive, stop and settle in time.
            StampsError: as `StampClock.advance` does.

        """
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
        """Take a wrench.

        Args:
            stamp_ns: its stamp, ns.
            wrench: (6,) in the sensor's frame, N and N.m.

        Raises:
            StampsError: as `StampClock.advance` does.

        """
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
            self.result = PoseRejection(
                f"the stamps of wrench_raw are {(joint_ns - wrench_ns) / NS:.3f} s behind those of"
                " joint_states"
            )

    def _finish_if_complete(self) -> None:
        if self._window is None or self.result is not None:
            return
        if self.jumps != self._jumps_before:
            self.result = PoseRejection(f"{self.last_jump} while averaging")
            return
        end = self._window[1]
        joint_ns, wrench_ns = self._joint_clock.stamp_ns, self._wrench_clock.stamp_ns
        if joint_ns is None or wrench_ns is None or min(joint_ns, wrench_ns) < end:
            return
        self.result = self._judge()

    def _judge(self) -> PoseRecord | PoseRejection:
        assert self._window is not None
        joints, _ = self._inside(self._joints)
        wrenches, wrench_stamps = self._inside(self._wrenches)
        needed = self._stillness.min_samples
        if len(wrenches) < needed or len(joints) < max(2, needed // 10):
            return PoseRejection(
                f"only {len(wrenches)} samples of wrench_raw and {len(joints)} of joint_states"
                f" while averaging ({needed} wrenches are needed)"
            )
        gap = int(np.max(np.diff(wrench_stamps)))
        if gap > self._max_step_ns or np.min(np.diff(wrench_stamps)) < 0:
            return PoseRejection(f"wrench_raw has a gap of {gap / NS:.3f} s while averaging")
        for values, names, topic in (
            (joints, self._arm.joint_names, "joint_states"),
            (wrenches, WRENCH_AXES, "wrench_raw"),
        ):
            bad = np.flatnonzero(~np.all(np.isfinite(values), axis=0))
            if len(bad):
                listed = ", ".join(names[k] for k in bad)
                return PoseRejection(f"{topic}: {listed} not finite", not_finite=True)
        middle_ns = sum(self._window) // 2
        record = average_pose(self._arm.nearest(joints, joints[0]), wrenches, middle_ns)
        moved = joint_motion_fault(record, self._stillness, self._arm)
        return PoseRejection(moved) if moved else record

    def _inside(self, samples: list[tuple[int, Array]]) -> tuple[Array, Array]:
        assert self._window is not None
        start, end = self._window
        kept = [(stamp, value) for stamp, value in samples if start <= stamp <= end]
        return (
            np.array([value for _, value in kept], float),
            np.array([stamp for stamp, _ in kept], np.int64),
        )
