"""Tell when the arm is at its target, has stopped, and has stayed so for the time to settle."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import JOINT_NAMES, JOINT_UNITS
from galen_model.arrays import Array

from galen_ros.goal.stamps import NS, StampClock

# Joint states are looked at this often (by stamps); each one costs only an append.
_LOOK_EVERY_NS = 20_000_000


@dataclass(frozen=True)
class ArrivalSettings:
    """Tolerances in the joint vector's order and units (m, m, m, rad, rad), times in s."""

    position_tolerance: Array
    velocity_tolerance: Array
    velocity_window_s: float
    settle_s: float
    max_stamp_step_s: float


class MotionTimeoutError(Exception):
    """A joint did not reach its target, or did not stop, in time; the message names the joints."""


class ArrivalMonitor:
    """Watches joint states until the arm is at the target, has stopped and has settled.

    Stopped means that over `velocity_window_s` the median of the reported speed is within
    tolerance or, where the message holds no velocity, that the position's span over the window,
    divided by the window, is. The median forgives noise of single samples but not a swing.
    All times are the samples' stamps; a jump of them starts the settling anew and never counts as
    waiting time. Where the arm is looked at hangs on the stamps alone and not on the first sample
    seen, so that a recording of the same samples settles at the same one.
    """

    def __init__(
        self, settings: ArrivalSettings, target: Array | None, allowance_s: float, topic: str
    ) -> None:
        """`target` (5,) or None to wait only for a standstill; `allowance_s` is the time-out."""
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
        """Take a joint state, (5,) in m, rad and per s; True once arrived, stopped and settled.

        Raises MotionTimeoutError when the allowance is used up.
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
        """What still keeps the arm from having arrived, a sentence a joint."""
        if span_ns < self._window_ns:
            return ["too few joint states yet to tell that the arm has stopped"]
        faults = []
        position = self._recent[-1][1]
        if not np.all(np.isfinite(position)):
            return [
                f"{JOINT_NAMES[k]} reports {position[k]}"
                for k in np.flatnonzero(~np.isfinite(position))
            ]
        if self._target is not None:
            away = np.abs(position - self._target) > self._settings.position_tolerance
            faults += [
                f"{JOINT_NAMES[k]} did not reach {self._target[k]:.4f} {JOINT_UNITS[k]}:"
                f" it stands at {position[k]:.4f} {JOINT_UNITS[k]}"
                for k in np.flatnonzero(away)
            ]
        speed = self._speed(span_ns)
        moving = ~(speed <= self._settings.velocity_tolerance)
        faults += [
            f"{JOINT_NAMES[k]} did not stop: it moves at {speed[k]:.4f} {JOINT_UNITS[k]}/s"
            for k in np.flatnonzero(moving)
        ]
        return faults

    def _speed(self, span_ns: int) -> Array:
        velocities = [sample[2] for sample in self._recent if sample[2] is not None]
        if len(velocities) == len(self._recent):
            median: Array = np.median(np.abs(np.array(velocities)), axis=0)
            return median
        positions = np.array([sample[1] for sample in self._recent])
        span: Array = np.ptp(positions, axis=0) / (span_ns / NS)
        return span
