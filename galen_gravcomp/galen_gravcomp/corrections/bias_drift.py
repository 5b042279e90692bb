"""The sensor's bias drift, learned live while the arm is at rest without contact.

    out = untared - bias drift - tare

The estimate is `galen_gravcomp.corrections.bias_drift_filter`'s, from the windows of
`galen_model.rest.windows`; here are its switch, its limits and what is subtracted. It is off
unless it is asked for: nothing is subtracted from a surgeon's force unasked. What is subtracted
never jumps: each new value is gone to along the tare's smoothstep, and so
is zero when it is switched off.

A tare defines zero anew: it averages the wrench with the bias drift still in it, so its offset
holds the bias drift's own, which goes to zero along the same ramp as the tare comes in:
their sum goes from the old value to the new one as if there were no bias drift.

Beyond `LIMITS` along an axis it stays where it is, until a tare, another
tool or a restart of the driver: a sensor that went so far needs attention.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.rest.windows import StillWindows
from galen_ros.stream.monitor import joined

from galen_gravcomp.corrections.bias_drift_filter import BiasDriftFilter
from galen_gravcomp.corrections.tare import TareRamp

# N, N.m: a sensor that drifted further is to be looked at, not followed.
LIMITS = np.repeat([0.5, 0.02], 3)


class BiasDriftState(Enum):
    """What the estimate does now."""

    OFF = "off"
    LEARNING = "learning"
    HELD = "held"
    """The arm moves, the wrench is not steady, or the sensor's noise is not known yet."""
    CONTACT = "contact"
    """Contact of the tool, or a file that does not fit."""
    LIMIT = "limit"


# No still window for so long, and nothing is being learned.
_HELD_AFTER_NS = 1_500_000_000


class BiasDrift:
    """The estimate of the bias drift, with its switch, limits and ramp."""

    def __init__(self, *, enabled: bool = False, ramp_s: float = 1.0) -> None:
        """`ramp_s`: the tare's, along which every change is applied."""
        self._enabled = enabled
        self._windows = StillWindows()
        self._filter = BiasDriftFilter()
        self._ramp = TareRamp(ramp_s)
        self._tare: Array = np.zeros(6)
        self._newest_ns: int | None = None
        self._window_ns: int | None = None
        self._learned_ns: int | None = None
        self._begin_state()

    # State

    @property
    def enabled(self) -> bool:
        """Whether it learns, and subtracts what it learned."""
        return self._enabled

    @property
    def active(self) -> bool:
        """Whether it needs samples one by one, or subtracts anything."""
        return self._enabled or self._ramp.ramping or bool(self._ramp.target.any())

    @property
    def state(self) -> BiasDriftState:
        """What it does now."""
        if not self._enabled:
            return BiasDriftState.OFF
        if self._at_limit.any():
            return BiasDriftState.LIMIT
        newest, seen = self._newest_ns, self._window_ns
        if newest is None or seen is None or newest - seen > _HELD_AFTER_NS:
            return BiasDriftState.HELD
        return self._state

    @property
    def settled(self) -> Array:
        """Offset (6,) that is subtracted when no ramp runs; not to be written into."""
        return self._ramp.target

    @property
    def learned_s_ago(self) -> float | None:
        """Time by the stamps since something was learned; None: never since the last reset."""
        if self._learned_ns is None or self._newest_ns is None:
            return None
        return (self._newest_ns - self._learned_ns) * 1e-9

    @property
    def trouble(self) -> str:
        """What a person should be warned of, empty if nothing."""
        if self.state is not BiasDriftState.LIMIT:
            return ""
        axes = [axis for axis, over in zip(WRENCH_AXES, self._at_limit, strict=True) if over]
        return (
            f"the sensor drifted by the limit ({LIMITS[0]:g} N, {LIMITS[3]:g} N.m) in"
            f" {', '.join(axes)} and is not followed further: tare without contact, or recalibrate"
        )

    def values(self) -> dict[str, object]:
        """State, what is subtracted, and its standard deviation, for /diagnostics."""
        ago_s = self.learned_s_ago
        settled, std = self.settled, self._filter.std
        return {
            "bias_drift": self.state.value,
            "bias_drift_force_n": joined(settled[:3]),
            "bias_drift_torque_nm": joined(settled[3:]),
            "bias_drift_std_force_n": joined(std[:3]),
            "bias_drift_std_torque_nm": joined(std[3:]),
            "bias_drift_learned_s_ago": "never" if ago_s is None else ago_s,
        }

    def set_enabled(self, enabled: bool) -> None:
        """Switch on or off; off drops what was learned along the ramp."""
        if enabled == self._enabled:
            return
        self._enabled = enabled
        self._windows.clear()
        self._filter.begin()
        self._begin_state()
        if self._newest_ns is not None:
            self._ramp.start(self._newest_ns, np.zeros(6))

    # Samples

    def offset_at(self, stamp_ns: int) -> Array:
        """Offset (6,) active at a stamp; the caller must not write into it."""
        # Also while nothing is pushed (a cable whose pull is not known): a ramp begins now.
        self._see_stamp(stamp_ns)
        return self._ramp.offset_at(stamp_ns)

    def push(self, stamp_ns: int, roll_rad: float, tilt_rad: float, untared: Array) -> None:
        """Take an untared wrench (6,), which must not be written into later."""
        self._see_stamp(stamp_ns)
        if not self._enabled:
            return
        window = self._windows.push(stamp_ns, roll_rad, tilt_rad, untared)
        if window is None:
            return
        self._window_ns = window.end_ns
        if not window.steady:
            self._filter.unsteady()
            self._state = BiasDriftState.HELD
            return
        free = self._filter.see(
            window.end_ns, *window.angles, window.mean - self._tare, window.std_of_mean
        )
        if not free:
            self._state = BiasDriftState.CONTACT
        elif not self._filter.learned:
            self._state = BiasDriftState.HELD
        else:
            self._learned(stamp_ns, window.end_ns)

    def tared(self, stamp_ns: int, roll_rad: float, tilt_rad: float, offset: Array) -> None:
        """Follow a tare: it subtracts `offset` (6,) from `stamp_ns` on, along its ramp."""
        self._tare = np.array(offset)
        self._windows.drop()
        self._filter.begin((stamp_ns, roll_rad, tilt_rad))
        self._begin_state()
        self._ramp.start(stamp_ns, np.zeros(6))

    def clear(self, why: str) -> None:
        """Forget everything, the tare as well, at once: it belonged to another tool or driver."""
        del why
        self._tare = np.zeros(6)
        self._windows.clear()
        self._filter.begin()
        self._begin_state()
        self._ramp.reset()
        self._newest_ns = None

    # Inside

    def _see_stamp(self, stamp_ns: int) -> None:
        if self._newest_ns is None or stamp_ns > self._newest_ns:
            self._newest_ns = stamp_ns

    def _begin_state(self) -> None:
        self._state = BiasDriftState.HELD
        self._at_limit = np.zeros(6, dtype=bool)
        self._window_ns = self._learned_ns = None

    def _learned(self, stamp_ns: int, window_ns: int) -> None:
        self._at_limit |= np.abs(self._filter.bias_drift) >= LIMITS
        if self._at_limit.any():
            # Frozen as a whole: a sensor that is out along one axis is not to be trusted in others.
            return
        self._state = BiasDriftState.LEARNING
        self._learned_ns = window_ns
        self._ramp.start(stamp_ns, self._filter.bias_drift)
