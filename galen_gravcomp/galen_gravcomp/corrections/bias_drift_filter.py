"""Separate the sensor's bias drift from load, pose errors and contact, at rest.

The residual z (6,) of a still window, with the tool's weight and the tare off, is taken as

    z = b(t) + G(u) d + e(pose) + noise

in one Kalman filter of sixteen states: b, the bias drift, a random walk of density q; d, what the
load (mass, first moment) differs from the file's, in which the reading is linear
(`galen_model.load.model`); e, whatever else the calibration leaves at a pose: another value at
another pose, the same at the same. With the angle a between gravity's directions u at two stops e
is carried over as rho e with rho = exp(-a^2 / (2 l^2)), and (1 - rho^2) sigma_e^2 of new variance.
So at one place every change of z is bias drift, a change from place to place mostly is not, and
what turns with gravity is not even on the average over many places.

Contact: a push begins faster than a sensor drifts. A window is contact if in any axis

    |z - b - G d - e| > k sqrt(S) + floor,     S: the innovation's variance, which grows with q t,

the floor standing for what the rate limit lets b lag behind. During contact nothing is learned and
the variance of b grows, up to a bound, so that a sensor that drifted under a long contact is taken
up again; then `FEWEST_CALM` windows in a row must pass. b moves by no more than `rate_per_s` times
the window, whatever happens: a push slower than that, or smaller than what the test lets through,
is learned, at no more than that rate and never by more than its own size.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.load.model import gravity_regressor

FEWEST_CALM = 3
_SIGMAS = 4.0
_LENGTH_RAD = 0.3
_SAME_PLACE_RAD = 0.01
_S_PER_H = 3600.0
_BIAS_DRIFT, _LOAD, _POSE = slice(0, 6), slice(6, 10), slice(10, 16)


def _axes(force_n: float, torque_nm: float) -> Array:
    return np.repeat([force_n, torque_nm], 3)


def _load_std() -> Array:
    return np.array([0.004, 2e-4, 2e-4, 2e-4])


@dataclass(frozen=True)
class BiasDriftModel:
    """How a sensor drifts, by axis (6,), N and N.m, and how well a file fits.

    rate_per_s: fastest learning. 0.9 N/h in 60 s is 0.015 N, below the 0.02 N that a push of a
    minute may change at most though every other test failed. walk_per_sqrt_s: density of the
    random walk, 0.05 N in an hour; load_std (4,): kg and kg.m, and pose_std: together the 0.05 N
    and 2 mN.m up to which a file fits (`galen_model.evidence.verdict.Limits`);
    start_std: of b, when nothing was tared; floor: see above; longest_std: bound of b's standard
    deviation.
    """

    rate_per_s: Array = field(default_factory=lambda: _axes(0.9, 0.02) / _S_PER_H)
    walk_per_sqrt_s: Array = field(default_factory=lambda: _axes(0.05, 0.001) / np.sqrt(_S_PER_H))
    load_std: Array = field(default_factory=_load_std)
    pose_std: Array = field(default_factory=lambda: _axes(0.03, 0.0015))
    start_std: Array = field(default_factory=lambda: _axes(0.03, 0.001))
    floor: Array = field(default_factory=lambda: _axes(0.02, 5e-4))
    longest_std: Array = field(default_factory=lambda: _axes(0.05, 0.0015))


class BiasDriftFilter:
    """The filter; feed it still windows' means in the order of their times."""

    def __init__(self, model: BiasDriftModel | None = None) -> None:
        self._model = model or BiasDriftModel()
        self.begin()

    @property
    def bias_drift(self) -> Array:
        """The bias drift b (6,), N and N.m."""
        return self._state[_BIAS_DRIFT].copy()

    @property
    def std(self) -> Array:
        """Its standard deviation (6,) as the filter has it."""
        return np.asarray(np.sqrt(np.diag(self._covariance)[_BIAS_DRIFT]))

    @property
    def learned(self) -> bool:
        """Whether the last window seen was learned from."""
        return self._learned

    def begin(self, tared: tuple[int, float, float] | None = None) -> None:
        """Begin at zero.

        `tared`: stamp, roll and tilt at which a person said that the level is zero.
        """
        model = self._model
        self._state: Array = np.zeros(16)
        variance = np.concatenate([model.start_std, model.load_std, model.pose_std]) ** 2
        self._covariance: Array = np.diag(variance)
        self._time_ns: int | None = None
        self._gravity: Array | None = None
        self._calm = 0
        self._learned = False
        if tared is not None:
            stamp_ns, roll_rad, tilt_rad = tared
            self._covariance[_BIAS_DRIFT, _BIAS_DRIFT] = 0.0
            self._go_to(stamp_ns, roll_rad, tilt_rad)
            # A level of zero, known as well as a tare's window tells it.
            self._learn(np.zeros(6), self._design(), 1e-2 * model.floor**2)

    def see(self, end_ns: int, roll_rad: float, tilt_rad: float, level: Array, std: Array) -> bool:
        """Take a still, steady window's mean (6,) and its standard deviation (6,).

        Returns whether it was free; whether it was learned from too, `learned` says.
        """
        model = self._model
        elapsed_s = self._go_to(end_ns, roll_rad, tilt_rad)
        design = self._design()
        innovation = level - design @ self._state
        variance = np.einsum("ip,pq,iq->i", design, self._covariance, design) + std**2
        free = bool(np.all(np.abs(innovation) <= _SIGMAS * np.sqrt(variance) + model.floor))
        self._calm = self._calm + 1 if free else 0
        self._learned = free and self._calm >= FEWEST_CALM
        if self._learned:
            step = self._learn(innovation, design, std**2)
            # Time under a touch or in motion gives no right to a larger step.
            most = model.rate_per_s * min(elapsed_s, 1.0)
            step[_BIAS_DRIFT] = np.clip(step[_BIAS_DRIFT], -most, most)
            self._state = self._state + step
        return free

    def unsteady(self) -> None:
        """A still window whose wrench was not steady: begin to count calm ones anew."""
        self._calm = 0

    def _design(self) -> Array:
        """H (6, 16) with z = H (b, d, e)."""
        assert self._gravity is not None
        return np.concatenate([np.eye(6), gravity_regressor(self._gravity), np.eye(6)], axis=1)

    def _learn(self, innovation: Array, design: Array, variance: Array) -> Array:
        """Make the covariance that after a window; returns the step (16,) of the state."""
        cross = self._covariance @ design.T
        gain = np.linalg.solve(design @ cross + np.diag(variance), cross.T).T
        after = self._covariance - gain @ cross.T
        self._covariance = (after + after.T) / 2.0
        return np.asarray(gain @ innovation)

    def _go_to(self, end_ns: int, roll_rad: float, tilt_rad: float) -> float:
        """Carry the states on to a time and pose; returns the time that went by, s."""
        model = self._model
        gravity = np.asarray(gravity_in_sensor(roll_rad, tilt_rad))
        elapsed_s = 0.0
        if self._time_ns is not None and self._gravity is not None:
            elapsed_s = max((end_ns - self._time_ns) * 1e-9, 0.0)
            covariance = self._covariance
            own = np.diag(covariance)[_BIAS_DRIFT]
            room = np.maximum(model.longest_std**2 - own, 0.0)
            grown = np.zeros(16)
            grown[_BIAS_DRIFT] = np.minimum(model.walk_per_sqrt_s**2 * elapsed_s, room)
            # The chord: near zero the arc cosine has no figures left.
            angle = float(np.linalg.norm(gravity - self._gravity)) / -GRAVITY_M_S2[2]
            if angle > _SAME_PLACE_RAD:
                kept = float(np.exp(-(angle**2) / (2.0 * _LENGTH_RAD**2)))
                keep = np.ones(16)
                keep[_POSE] = kept
                self._state = keep * self._state
                covariance = covariance * np.outer(keep, keep)
                grown[_POSE] = (1.0 - kept**2) * model.pose_std**2
                self._calm = min(self._calm, FEWEST_CALM - 2)
                self._gravity = gravity
            self._covariance = covariance + np.diag(grown)
        else:
            self._gravity = gravity
        self._time_ns = end_ns
        return elapsed_s
