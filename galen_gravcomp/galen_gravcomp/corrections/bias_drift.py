# SPDX-License-Identifier: Apache-2.0
"""The sensor's bias drift, learned live while the arm is at rest without contact.

    out = untared - bias drift - tare

It is off unless it is asked for: nothing is subtracted from a surgeon's force unasked. What is
subtracted never jumps: each new value is gone to along the tare's smoothstep, and so is zero when
it is switched off. A tare defines zero anew: it averages the wrench with the bias drift still in
it, so its offset holds the bias drift's own, which goes to zero along the same ramp as the tare
comes in: their sum goes from the old value to the new one as if there were no bias drift. Beyond
`LIMITS` along an axis it stays where it is, until a tare, another tool or a restart of the driver:
a sensor that went so far needs attention.

The residual z (6,) of a window at rest, less the tool's weight and the tare, is taken as

    z = b(t) + G(u) d + e(pose) + noise

in one Kalman filter of sixteen states: b, the bias drift, a random walk of density q; d, what the
load (mass, first moment) differs from the file's, in which the reading is linear
(`galen_model.load.model`); e, whatever else the calibration leaves at a pose: another value at
another pose, the same at the same. With the angle a between gravity's directions u at two poses e
is carried over as rho e with rho = exp(-a^2 / (2 l^2)), and (1 - rho^2) sigma_e^2 of new variance.
So at one place every change of z is bias drift, a change from place to place mostly is not, and
what turns with gravity is not even on the average over many places.

Contact: a push begins faster than a sensor drifts. A window is contact if in any axis

    |z - b - G d - e| > k sqrt(S) + floor,     S: the innovation's variance, which grows with q t,

the floor standing for what the rate limit lets b lag behind. During contact nothing is learned and
the variance of b grows, up to a bound, so that a sensor that drifted under a long contact is
followed again; then `FEWEST_CALM` windows in a row must pass. b moves by no more than `_RATE_PER_S`
times the window, whatever happens: a push slower than that, or smaller than what the test lets
through, is learned, at no more than that rate and never by more than its own size.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from galen_common.stream.monitor import joined
from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.load.model import gravity_regressor
from galen_model.rest.windows import StillWindows

from galen_gravcomp.corrections.tare import TareRamp


def _axes(force_n: float, torque_nm: float) -> Array:
    return np.repeat([force_n, torque_nm], 3)


# N, N.m: a sensor that drifted further is to be looked at, not followed.
LIMITS = _axes(0.5, 0.02)
# No window at rest for so long, and nothing is being learned.
_HELD_AFTER_NS = 1_500_000_000
FEWEST_CALM = 3
_SIGMAS = 4.0
_LENGTH_RAD = 0.3
_SAME_PLACE_RAD = 0.01
_S_PER_H = 3600.0
_BIAS_DRIFT, _LOAD, _POSE = slice(0, 6), slice(6, 10), slice(10, 16)
# How a sensor drifts, by axis (6,), N and N.m. The fastest learning: 0.9 N/h in 60 s is 0.015 N,
# below the 0.02 N that a push of a minute may change at most though every other test failed.
_RATE_PER_S = _axes(0.9, 0.02) / _S_PER_H
# The random walk's density: 0.05 N in an hour.
_WALK_PER_SQRT_S = _axes(0.05, 0.001) / np.sqrt(_S_PER_H)
# How well a file fits: load (4,), kg and kg.m, and pose, together the 0.05 N and 2 mN.m up to which
# a file fits (`galen_model.load.verdict.Limits`).
_LOAD_STD = np.array([0.004, 2e-4, 2e-4, 2e-4])
_POSE_STD = _axes(0.03, 0.0015)
# Of b: when nothing was tared; at the most.
_START_STD = _axes(0.03, 0.001)
_LONGEST_STD = _axes(0.05, 0.0015)
_FLOOR = _axes(0.02, 5e-4)


class BiasDriftState(Enum):
    """What the estimate does now."""

    OFF = "off"
    LEARNING = "learning"
    HELD = "held"
    """The arm moves, the wrench is not steady, or the sensor's noise is not known yet."""
    CONTACT = "contact"
    """Contact of the tool, or a file that does not fit."""
    LIMIT = "limit"


class BiasDriftFilter:
    """The Kalman filter; takes means of windows at rest in the order of their times."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self.begin()

    @property
    def bias_drift(self) -> Array:
        """The bias drift b (6,), N and N.m."""
        return self._state[_BIAS_DRIFT].copy()

    @property
    def std(self) -> Array:
        """The bias drift's standard deviation (6,)."""
        return np.asarray(np.sqrt(np.diag(self._covariance)[_BIAS_DRIFT]))

    def begin(self, tared: tuple[int, tuple[float, ...]] | None = None) -> None:
        """Begin at zero.

        Args:
            tared: stamp and angles (k,), rad, of a tare, which defines the bias drift as zero
                there; None: none.

        """
        self._state: Array = np.zeros(16)
        variance = np.concatenate([_START_STD, _LOAD_STD, _POSE_STD]) ** 2
        self._covariance: Array = np.diag(variance)
        self._time_ns: int | None = None
        self._gravity: Array | None = None
        self._calm = 0
        self.learned = False
        """Whether the last window seen was learned from."""
        if tared is not None:
            self._covariance[_BIAS_DRIFT, _BIAS_DRIFT] = 0.0
            self._go_to(*tared)
            # A level of zero, with the accuracy of a tare's window.
            self._learn(np.zeros(6), self._design(), 1e-2 * _FLOOR**2)

    def see(self, end_ns: int, angles: tuple[float, ...], level: Array, std: Array) -> bool:
        """Take a steady window.

        Args:
            end_ns: its last stamp.
            angles: (k,), rad.
            level: (6,) its mean without weight and tare, in the sensor's frame, N and N.m.
            std: (6,) standard deviation of this mean.

        Returns:
            Whether it is free of contact.

        """
        elapsed_s = self._go_to(end_ns, angles)
        design = self._design()
        innovation = level - design @ self._state
        variance = np.einsum("ip,pq,iq->i", design, self._covariance, design) + std**2
        free = bool(np.all(np.abs(innovation) <= _SIGMAS * np.sqrt(variance) + _FLOOR))
        self._calm = self._calm + 1 if free else 0
        self.learned = free and self._calm >= FEWEST_CALM
        if self.learned:
            step = self._learn(innovation, design, std**2)
            # Time under a touch or in motion gives no right to a larger step.
            most = _RATE_PER_S * min(elapsed_s, 1.0)
            step[_BIAS_DRIFT] = np.clip(step[_BIAS_DRIFT], -most, most)
            self._state = self._state + step
        return free

    def unsteady(self) -> None:
        """Take note of an unsteady window: begin to count calm ones anew."""
        self._calm = 0

    def _design(self) -> Array:
        """H (6, 16) with z = H (b, d, e)."""
        assert self._gravity is not None
        return np.concatenate([np.eye(6), gravity_regressor(self._gravity), np.eye(6)], axis=1)

    def _learn(self, innovation: Array, design: Array, variance: Array) -> Array:
        """Update the covariance; returns the step (16,) of the state."""
        cross = self._covariance @ design.T
        gain = np.linalg.solve(design @ cross + np.diag(variance), cross.T).T
        after = self._covariance - gain @ cross.T
        self._covariance = (after + after.T) / 2.0
        return np.asarray(gain @ innovation)

    def _go_to(self, end_ns: int, angles: tuple[float, ...]) -> float:
        """Carry the states on to a time and pose; returns the elapsed time, s."""
        gravity = np.asarray(self._arm.gravity_in_sensor(angles))
        elapsed_s = 0.0
        if self._time_ns is not None and self._gravity is not None:
            elapsed_s = max((end_ns - self._time_ns) * 1e-9, 0.0)
            covariance = self._covariance
            own = np.diag(covariance)[_BIAS_DRIFT]
            room = np.maximum(_LONGEST_STD**2 - own, 0.0)
            grown = np.zeros(16)
            grown[_BIAS_DRIFT] = np.minimum(_WALK_PER_SQRT_S**2 * elapsed_s, room)
            # The chord: near zero the arc cosine has no figures left.
            chord = float(np.linalg.norm(gravity - self._gravity))
            angle = chord / float(np.linalg.norm(self._arm.gravity_m_s2))
            if angle > _SAME_PLACE_RAD:
                kept = float(np.exp(-(angle**2) / (2.0 * _LENGTH_RAD**2)))
                keep = np.ones(16)
                keep[_POSE] = kept
                self._state = keep * self._state
                covariance = covariance * np.outer(keep, keep)
                grown[_POSE] = (1.0 - kept**2) * _POSE_STD**2
                self._calm = min(self._calm, FEWEST_CALM - 2)
                self._gravity = gravity
            self._covariance = covariance + np.diag(grown)
        else:
            self._gravity = gravity
        self._time_ns = end_ns
        return elapsed_s


class BiasDrift:
    """The estimate of the bias drift, with its switch, limits and ramp."""

    def __init__(self, *, enabled: bool = False, ramp_s: float = 1.0, arm: Arm) -> None:
        """`ramp_s`: the tare's, along which every change is applied."""
        self._enabled = enabled
        self._windows = StillWindows()
        self._filter = BiasDriftFilter(arm)
        self._ramp = TareRamp(ramp_s)
        self._tare: Array = np.zeros(6)
        self._newest_ns: int | None = None
        self._window_ns: int | None = None
        self._learned_ns: int | None = None
        self._begin_state()

    # State

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
        ago_s: object = "never"
        if self._learned_ns is not None and self._newest_ns is not None:
            ago_s = (self._newest_ns - self._learned_ns) * 1e-9
        settled, std = self.settled, self._filter.std
        return {
            "bias_drift": self.state.value,
            "bias_drift_force_n": joined(settled[:3]),
            "bias_drift_torque_nm": joined(settled[3:]),
            "bias_drift_std_force_n": joined(std[:3]),
            "bias_drift_std_torque_nm": joined(std[3:]),
            "bias_drift_learned_s_ago": ago_s,
        }

    def set_enabled(self, enabled: bool) -> None:
        """Switch on or off; off drops what was learned along the ramp.

        Args:
            enabled: whether it is learned and subtracted.

        """
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
        """Return the offset active at a stamp.

        Args:
            stamp_ns: the wrench's stamp.

        Returns:
            (6,), N and N.m; the caller must not write into it.

        """
        # Also while nothing is pushed (a cable whose pull is not known): a ramp begins now.
        self._see_stamp(stamp_ns)
        return self._ramp.offset_at(stamp_ns)

    def push(self, stamp_ns: int, angles: tuple[float, ...], untared: Array) -> None:
        """Take a sample.

        Args:
            stamp_ns: the wrench's stamp.
            angles: (k,) at that stamp, rad.
            untared: (6,) wrench without weight, before tare and bias drift, N and N.m; it must not
                be written into later.

        """
        self._see_stamp(stamp_ns)
        if not self._enabled:
            return
        window = self._windows.push(stamp_ns, angles, untared)
        if window is None:
            return
        self._window_ns = window.end_ns
        if not window.steady:
            self._filter.unsteady()
            self._state = BiasDriftState.HELD
            return
        free = self._filter.see(
            window.end_ns, window.angles, window.mean - self._tare, window.std_of_mean
        )
        if not free:
            self._state = BiasDriftState.CONTACT
        elif not self._filter.learned:
            self._state = BiasDriftState.HELD
        else:
            self._learned(stamp_ns, window.end_ns)

    def tared(self, stamp_ns: int, angles: tuple[float, ...], offset: Array) -> None:
        """Follow a tare, which subtracts its offset along its ramp.

        Args:
            stamp_ns: where that ramp begins.
            angles: (k,) there, rad.
            offset: (6,) the tare's, N and N.m.

        """
        self._tare = np.array(offset)
        self._windows.drop()
        self._filter.begin((stamp_ns, angles))
        self._begin_state()
        self._ramp.start(stamp_ns, np.zeros(6))

    def clear(self) -> None:
        """Forget everything, the tare as well, at once: it belonged to another tool or driver."""
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
