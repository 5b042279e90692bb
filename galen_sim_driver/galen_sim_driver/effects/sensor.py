# SPDX-License-Identifier: Apache-2.0
"""Effects of the sensor and of the tracker (contract, section 6).

Mount rotation: with E = exp(r) the element's axes in ft_sensor, the reading is E^T f and E^T tau,
about the same origin. Gains: reading_k = (1 + gain_k) true_k. Crosstalk: reading_to += c true_from.

A bias step stays for the bags after, too: sweep, motion and push are recorded in this order. With
an empty bag's name, as in a driver that runs on, its time is that of the recording.

Drift, with t the time of the recording:

    b(t) = rate t, or piecewise linear through levels at knots;

the rate is then the mean one, (last level - first level) over the time between them.

Nonlinearity: reading_k = x + c x^2 of the reading x without it, or x + c x |x| (`signed`).

Hysteresis: the reading lags the load, or with `side` -1 runs ahead of it. With x counted from where
it was first and P its largest size, Bouc and Wen's state with the exponent 1 and their beta and
gamma equal (Y.-K. Wen, J. Eng. Mech. Div. ASCE 102 (2), 1976, pp. 249-263) is

    dz = (dx - (|dx| z + dx |z|) / 2) / (`knee` P),    reading = x - side c P z:

straight while z goes to 0, and exponentially on from there. c is such that `fraction` of the
largest load is left when it is gone. A driver, which knows one sample at a time, takes 10 N and
1 N.m for the largest.

The tracker's scale is about its own origin, so that both markers move away from it; rotations stay.
After a registration of base_link from the tracker's readings only a scale about the mean of the
tool's positions remains.

The base's marker goes by `translation_m` and turns about its own origin by `rotvec_rad`, both along
the axes of base_link, once during `push`, and stays there; arm and tracker stay where they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import ClassVar, Self

import numpy as np
from galen_common.parameters import param
from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.rotation import rotvec_to_matrix

from galen_sim_driver.effects.effect import (
    BAG_ORDER,
    ConfigError,
    Effect,
    Fitted,
    Instants,
    check_choice,
)
from galen_sim_driver.effects.hysteresis import GATE, along_turns


@dataclass(frozen=True)
class SensorMountRotation(Effect):
    """reading = exp(`rotvec_rad`)^T of force and of torque."""

    name = "sensor_mount_rotation"
    fitted = (Fitted("rotvec_rad", "rad", 0.01, -0.5, 0.5, 3),)
    order = 0

    rotvec_rad: tuple[float, ...] = param(
        (0.0,) * 3,
        "the sensing element is turned so in `ft_sensor`, rotation vector, rad",
        -0.5,
        0.5,
    )

    def read(self, when: Instants, wrench: Array) -> Array:
        """Turn into the element's axes: rows times E are E^T v.

        Args:
            when: not used.
            wrench: (n, 6) in ft_sensor, N and N.m.

        Returns:
            Reading (n, 6) along the element's axes.

        """
        return _turned(wrench, _matrix(tuple(self.rotvec_rad)))

    def unread(self, when: Instants, reading: Array) -> Array:
        """Turn back from the element's axes.

        Args:
            when: not used.
            reading: (n, 6) along the element's axes, N and N.m.

        Returns:
            Wrench (n, 6) in ft_sensor.

        """
        return _turned(reading, _matrix(tuple(self.rotvec_rad)).T)


@lru_cache(maxsize=256)
def _matrix(rotvec_rad: tuple[float, ...]) -> Array:
    return rotvec_to_matrix(rotvec_rad)


def _turned(wrench: Array, matrix: Array) -> Array:
    return np.concatenate([wrench[:, :3] @ matrix, wrench[:, 3:] @ matrix], axis=1)


@dataclass(frozen=True)
class AxisGain(Effect):
    """reading_k = (1 + gain_k) true_k."""

    name = "axis_gain"
    fitted = (Fitted("gain", "", 0.03, -0.9, 2.0, 6),)
    limit_parts = WRENCH_AXES
    order = 1

    gain: tuple[float, ...] = param(
        (0.0,) * 6, "what each axis of the sensor reads too much of itself, fx to tz", -0.9, 2.0
    )

    def read(self, when: Instants, wrench: Array) -> Array:
        """Multiply each axis by 1 + its gain.

        Args:
            when: not used.
            wrench: (n, 6), N and N.m.

        Returns:
            Reading (n, 6).

        """
        return wrench * (1.0 + np.asarray(self.gain))

    def unread(self, when: Instants, reading: Array) -> Array:
        """Divide each axis by 1 + its gain.

        Args:
            when: not used.
            reading: (n, 6), N and N.m.

        Returns:
            Wrench (n, 6).

        """
        return reading / (1.0 + np.asarray(self.gain))


@dataclass(frozen=True)
class Crosstalk(Effect):
    """reading of `to_axis` += `coefficient` times the true `from_axis`; fx fy fz tx ty tz."""

    name = "crosstalk"
    fitted = (Fitted("coefficient", "", 0.02, -2.0, 2.0),)
    order = 2
    contract_names: ClassVar[Mapping[str, str]] = {"from_axis": "from", "to_axis": "to"}

    from_axis: str = param("fz", "the axis that another one sees some of: fx fy fz tx ty tz")
    to_axis: str = param("fx", "the axis that sees it")
    coefficient: float = param(0.0, "how much it sees of it, in N and Nm", -100.0, 100.0)

    def validate(self) -> None:
        check_choice(self.name, "from", self.from_axis, WRENCH_AXES)
        check_choice(self.name, "to", self.to_axis, WRENCH_AXES)
        if self.from_axis == self.to_axis:
            raise ConfigError(f"{self.name}: from and to are both {self.to_axis}")

    def read(self, when: Instants, wrench: Array) -> Array:
        """Add a part of one axis to the other.

        Args:
            when: not used.
            wrench: (n, 6), N and N.m.

        Returns:
            Reading (n, 6).

        """
        return self._add(wrench, self.coefficient)

    def unread(self, when: Instants, reading: Array) -> Array:
        """Subtract a part of one axis from the other.

        Args:
            when: not used.
            reading: (n, 6), N and N.m.

        Returns:
            Wrench (n, 6).

        """
        return self._add(reading, -self.coefficient)

    def _add(self, wrench: Array, coefficient: float) -> Array:
        changed = wrench.copy()
        origin, target = WRENCH_AXES.index(self.from_axis), WRENCH_AXES.index(self.to_axis)
        changed[:, target] += coefficient * wrench[:, origin]
        return changed


@dataclass(frozen=True)
class SensorNonlinearity(Effect):
    """reading of `axis` += `coefficient` times its square, with its sign where `signed`.

    A sensor bends with its whole load, of which it has forgotten the `tare` t that it was zeroed
    at: what it reads too much is coefficient ((x + t)^2 - t^2).
    """

    name = "sensor_nonlinearity"
    fitted = (Fitted("coefficient", "1/N", 0.01, -10.0, 10.0),)
    order = 2
    beyond_contract = ("signed", "tare")

    axis: str = param("fz", "the axis that isn't linear: fx fy fz tx ty tz")
    coefficient: float = param(0.0, "what it reads too much over its square, 1/N or 1/Nm")
    signed: bool = param(False, "whether that has the sign of the reading, and not its own")
    tare: float = param(0.0, "load on the axis where it reads zero, N or Nm")

    @property
    def limit_parts(self) -> tuple[str, ...]:
        return (self.axis,)

    def limit_names(self, arm: Arm) -> tuple[str, ...]:
        """Return all names on an arm under which a specification may limit it.

        Args:
            arm: not used.

        Returns:
            The sensor's axes.

        """
        return WRENCH_AXES

    def validate(self) -> None:
        check_choice(self.name, "axis", self.axis, WRENCH_AXES)

    def read(self, when: Instants, wrench: Array) -> Array:
        """Add the coefficient times the axis' square.

        Args:
            when: not used.
            wrench: (n, 6), N and N.m.

        Returns:
            Reading (n, 6).

        """
        read = wrench.copy()
        own = WRENCH_AXES.index(self.axis)
        read[:, own] += self.too_much(wrench[:, own])
        return read

    def unread(self, when: Instants, reading: Array) -> Array:
        """Return the root that is the reading at a coefficient of 0, or where it bends back.

        Args:
            when: not used.
            reading: (n, 6), N and N.m.

        Returns:
            Wrench (n, 6).

        """
        true, own = reading.copy(), WRENCH_AXES.index(self.axis)
        bent = reading[:, own] + self.tare + self._square(np.array(self.tare))
        c = self.coefficient * (np.sign(bent) if self.signed else 1.0)
        root = np.sqrt(np.maximum(1.0 + 4.0 * c * bent, 0.0))
        true[:, own] = 2.0 * bent / (1.0 + root) - self.tare
        return true

    def too_much(self, wrench: Array) -> Array:
        """Return what the axis reads too much.

        Args:
            wrench: on the axis beyond the tare, (n,), N or N.m.

        Returns:
            Errors, (n,), N or N.m.

        """
        return self._square(wrench + self.tare) - self._square(np.array(self.tare))

    def _square(self, load: Array) -> Array:
        return self.coefficient * load * (np.abs(load) if self.signed else load)


_TYPICAL_LARGEST = np.array([10.0] * 3 + [1.0] * 3)
_PAUSE_S = 1.0
_WIDEST = 0.5
_TURNS = 4
AXES: Mapping[str, tuple[int, ...]] = {
    "all": (0, 1, 2, 3, 4, 5),
    "force": (0, 1, 2),
    "torque": (3, 4, 5),
    **{name: (axis,) for axis, name in enumerate(WRENCH_AXES)},
}
"""Axes that have hysteresis together."""


class _Lagging:
    """A driver's last wrench (6,), and the states (6,) then."""

    def __init__(self) -> None:
        self.last: Array | None = None
        self.state = np.zeros(6)


@dataclass(frozen=True)
class SensorHysteresis(Effect):
    """The reading lags the load, and keeps `fraction` of the largest when it is gone.

    The lag approaches its end gradually (P. R. Dahl, 1968) or goes straight to it and stops there
    (L. Prandtl's stop, 1928). `vector` holds the fraction with its side's sign, and the knee.
    """

    name = "sensor_hysteresis"
    fitted = (Fitted("signed_fraction", "", 0.02, -0.5, 0.5), Fitted("knee", "", 0.1, 0.02, 1.0))
    order = 2
    limit_parts = ("",)
    beyond_contract = ("side", "knee", "axes", "restarts", "sharp", "of_range")

    fraction: float = param(0.0, "what is left of the largest load when it is gone", 0.0, 0.5)
    side: float = param(
        1.0, "1: it is left on the load's side, as by friction; -1: on the other", -1.0, 1.0
    )
    knee: float = param(0.2, "load over which it turns, over the largest load", 0.02, 1.0)
    axes: str = param("all", "which axes have it: all, force, torque, fx fy fz tx ty tz")
    restarts: bool = param(
        True, "whether what is left is gone after a second without readings, as in a bag"
    )
    sharp: bool = param(False, "whether the lag goes straight to its end; the knee is 0.5 at most")
    of_range: bool = param(
        False,
        "whether the largest load is the sensor's (10 N, 1 Nm), as in the driver, and not a bag's",
    )

    _memory: ClassVar[_Lagging | None] = None

    @property
    def changes_nothing(self) -> bool:
        return self.fraction == 0.0

    def validate(self) -> None:
        check_choice(self.name, "axes", self.axes, AXES)
        if self.side not in (1.0, -1.0):
            raise ConfigError(f"{self.name}: side is {self.side}, but must be 1 or -1")
        if self.sharp and self.knee > _WIDEST:
            raise ConfigError(
                f"{self.name}: knee is {self.knee:g}, but at most {_WIDEST:g} where it is sharp"
            )
        if self._steepest >= 1.0:
            raise ConfigError(
                f"{self.name}: fraction is {self.fraction:g}, but with side 1 and knee"
                f" {self.knee:g} it stays below {self.fraction / self._steepest:.3g}"
            )

    def vector(self) -> Array:
        return np.array([self.side * self.fraction, self.knee])

    def with_vector(self, vector: Array) -> Self:
        """Return the same effect with other numbers.

        Args:
            vector: signed fraction, and knee.

        Returns:
            A new effect with the side of the fraction's sign.

        """
        signed, knee = vector.tolist()
        side = -1.0 if signed < 0.0 else 1.0
        knee = min(knee, _WIDEST) if self.sharp else knee
        return replace(self, fraction=abs(signed), side=side, knee=knee)

    def fresh(self) -> Self:
        new = replace(self)
        # A dataclass's own way into its frozen fields; the memory is none of its numbers.
        object.__setattr__(new, "_memory", _Lagging())
        return new

    def read(self, when: Instants, wrench: Array) -> Array:
        """Subtract what the reading lags.

        Args:
            when: times of the n samples.
            wrench: (n, 6), N and N.m, in the order of time.

        Returns:
            Reading (n, 6).

        """
        return wrench - self.lag(when, wrench)

    def unread(self, when: Instants, reading: Array) -> Array:
        """Return the wrench whose reading it is, by iteration with the middle of its slopes.

        Args:
            when: times of the n samples.
            reading: (n, 6), N and N.m, in the order of time.

        Returns:
            Wrench (n, 6), after four iterations.

        """
        true, slope = reading, 1.0 - 0.5 * min(self._steepest, 1.0)
        for _ in range(_TURNS):
            true = true + (reading - self.read(when, true)) / slope
        return true

    def lag(self, when: Instants, wrench: Array) -> Array:
        """Return by how much the reading of a wrench is behind it.

        Args:
            when: times of the n samples; a pause in the bag's may restart it.
            wrench: (n, 6), N and N.m, in the order of time.

        Returns:
            (n, 6), N and N.m; 0 in axes without hysteresis.

        """
        out = np.zeros_like(wrench)
        axes = np.array(AXES[self.axes])
        if self._memory is not None:
            for row, one in enumerate(wrench):
                out[row, axes] = (_TYPICAL_LARGEST * self._next(self._memory, one))[axes]
            return self._size * out
        paused = (np.diff(when.bag_s) > _PAUSE_S) & self.restarts
        for rows in np.split(np.arange(len(wrench)), np.flatnonzero(paused) + 1):
            if len(rows):
                loads = wrench[rows][:, axes] - wrench[rows[0], axes]
                out[np.ix_(rows, axes)] = self._from(0.0, loads)
        return self._size * out

    def kept(self, load: Array) -> Array:
        """Return what is left of a lag that was at its end before a stretch.

        Args:
            load: of the stretch, (n, k), N and N.m, in the order of time, in its axes.

        Returns:
            Half of how far lags (n, k) are apart that begin at one end and at the other, N and N.m.

        """
        loads = load - load[0]
        return 0.5 * self._size * (self._from(1.0, loads) - self._from(-1.0, loads))

    def _from(self, state: float, loads: Array) -> Array:
        """Return lags (n, k) of a size of 1, of loads since a state (-1 ... 1)."""
        largest, still = self._largest(loads), np.zeros(loads.shape[1])
        slide = partial(self._slide, self.knee * np.where(largest > 0.0, largest, 1.0))
        gate = GATE * np.abs(loads).max(axis=0)
        return largest * along_turns(loads, gate, slide, still, still + state)

    def _largest(self, loads: Array) -> Array:
        if self.of_range:
            return _TYPICAL_LARGEST[list(AXES[self.axes])]
        return np.asarray(np.abs(loads).max(axis=0))

    def _next(self, memory: _Lagging, wrench: Array) -> Array:
        change = 0.0 * wrench if memory.last is None else wrench - memory.last
        memory.last = wrench
        memory.state = self._slide(self.knee * _TYPICAL_LARGEST, memory.state, change)
        return memory.state

    @property
    def _slide(self) -> Callable[[Array, Array, Array], Array]:
        return _stopped if self.sharp else _slide

    @property
    def _size(self) -> float:
        """Return side c."""
        if self.sharp:
            return self.side * self.fraction
        turned = -np.expm1(-1.0 / self.knee)
        return self.side * self.fraction / float(-np.expm1(turned - 1.0 / self.knee))

    @property
    def _steepest(self) -> float:
        """How much the reading is behind at most, over a small change of the load."""
        return self._size / self.knee


def _slide(length: Array, state: Array, change: Array) -> Array:
    """Return states after straight changes; length: over which a state of 1 goes back to 0."""
    sign, way = np.sign(change), np.abs(change) / length
    along = sign * state
    beyond = np.maximum(way + np.minimum(along, 0.0), 0.0)
    on = 1.0 - (1.0 - np.maximum(along, 0.0)) * np.exp(-beyond)
    return np.where(change == 0.0, state, sign * np.where(along + way < 0.0, along + way, on))


def _stopped(length: Array, state: Array, change: Array) -> Array:
    """Return the same of a state that goes straight from end to end, and stops there."""
    return np.clip(state + change / length, -1.0, 1.0)


@dataclass(frozen=True)
class _Additive(Effect):
    def read(self, when: Instants, wrench: Array) -> Array:
        return wrench + self._at(when)

    def unread(self, when: Instants, reading: Array) -> Array:
        return reading - self._at(when)

    def _at(self, when: Instants) -> Array:
        raise NotImplementedError


@dataclass(frozen=True)
class BiasStep(_Additive):
    """`step` from `time_s` on, since the first stamp of `bag`."""

    name = "bias_step"
    has_limit = False
    fitted = (Fitted("step", "", (0.3, 0.3, 0.3, 0.01, 0.01, 0.01), -50.0, 50.0, 6),)
    order = 4
    recording_only = ("bag",)

    time_s: float = param(0.0, "when the reading jumps, since the start, s", minimum=0.0)
    step: tuple[float, ...] = param((0.0,) * 6, "how far it jumps, and stays, N and Nm")
    bag: str = param("", "the bag from whose first stamp the time counts, empty for the first")

    def validate(self) -> None:
        if self.bag:
            check_choice(self.name, "bag", self.bag, BAG_ORDER)

    def in_session(self, starts: Mapping[str, float]) -> Self:
        """Return the effect with its time since the session's start.

        Args:
            starts: first stamp of each bag, by its name, s since the session's.

        Returns:
            The effect without a bag's name.

        """
        if not self.bag:
            return self
        return replace(self, bag="", time_s=self.time_s + starts[self.bag])

    def _at(self, when: Instants) -> Array:
        if not self.bag:
            jumped = when.session_s >= self.time_s
        elif when.bag == self.bag:
            jumped = when.bag_s >= self.time_s
        else:
            later = when.bag in BAG_ORDER and BAG_ORDER.index(when.bag) > BAG_ORDER.index(self.bag)
            jumped = np.full(len(when), later)
        return np.outer(jumped, self.step)


@dataclass(frozen=True)
class WrenchDelay(Effect):
    """A wrench's stamp is `delay_s` later than its measurement."""

    name = "wrench_delay"
    fitted = (Fitted("delay_s", "s", 0.01, -0.2, 0.2),)

    delay_s: float = param(
        0.0, "a wrench's stamp is so much later than its measurement, s", -0.2, 0.2
    )

    @property
    def wrench_delay_s(self) -> float:
        """The delay itself: true time is the stamp minus it."""
        return self.delay_s


@dataclass(frozen=True)
class SensorSaturation(Effect):
    """`axis` reads nothing beyond +- `limit`; 0 for none. Clipping can't be undone."""

    name = "sensor_saturation"
    has_limit = False
    fitted = (Fitted("limit", "", 5.0, 1e-4, 1e3),)
    order = 5
    after_noise = True

    limit: float = param(
        0.0, "largest reading of an axis that clips, N or Nm; 0 for none", minimum=0.0
    )
    axis: str = param("fz", "the axis that clips: fx fy fz tx ty tz")

    def validate(self) -> None:
        check_choice(self.name, "axis", self.axis, WRENCH_AXES)

    def read(self, when: Instants, wrench: Array) -> Array:
        """Clip the axis.

        Args:
            when: not used.
            wrench: (n, 6), N and N.m, with the noise.

        Returns:
            Reading (n, 6).

        """
        if self.limit <= 0.0:
            return wrench
        clipped = wrench.copy()
        axis = WRENCH_AXES.index(self.axis)
        clipped[:, axis] = np.clip(wrench[:, axis], -self.limit, self.limit)
        return clipped


_HOUR_S = 3600.0


@dataclass(frozen=True)
class SensorDrift(_Additive):
    """A drift of `rate_per_hour`, or through `levels` (k, 6), row by row, at `knots_s` (k,)."""

    name = "sensor_drift"
    fitted = (Fitted("rate_per_hour", "1/h", (1.0, 1.0, 1.0, 0.02, 0.02, 0.02), -1e3, 1e3, 6),)
    limit_parts = ("force_N_per_hour",) * 3 + ("torque_Nm_per_hour",) * 3
    order = 3
    beyond_contract = ("knots_s", "levels")

    rate_per_hour: tuple[float, ...] = param(
        (0.0,) * 6,
        "steady drift of each axis an hour, N and Nm; the mean one where knots are given",
    )
    knots_s: tuple[float, ...] = param(
        (), "a drift of another shape: increasing times since the start, s; empty for a steady one"
    )
    levels: tuple[float, ...] = param(
        (),
        "what is added to the reading at those times, six numbers each, N and Nm; linear between",
    )

    @classmethod
    def through(cls, knots_s: Array, levels: Array) -> Self:
        """Make a drift through levels at times of the recording.

        Args:
            knots_s: (k,), s, increasing; k at least 2.
            levels: (k, 6), N and N.m.

        Returns:
            The drift, whose rate is the mean one.

        """
        times, values = np.asarray(knots_s, dtype=float), np.asarray(levels, dtype=float)
        rate = (values[-1] - values[0]) / (times[-1] - times[0]) * _HOUR_S
        return cls(_floats(rate), _floats(times), _floats(values.ravel()))

    @property
    def changes_nothing(self) -> bool:
        return not any(self.rate_per_hour) and not any(self.levels)

    def validate(self) -> None:
        if len(self.knots_s) == 1 or not np.all(np.diff(self.knots_s) > 0.0):
            raise ConfigError(f"{self.name}: knots_s must be two or more that increase, or none")
        if len(self.levels) != 6 * len(self.knots_s):
            raise ConfigError(
                f"{self.name}: levels has {len(self.levels)} numbers, but must have six for each "
                f"of {len(self.knots_s)} knots"
            )

    def with_vector(self, vector: Array) -> Self:
        """Return the same effect with other mean rates.

        Args:
            vector: (6,), N/h and N.m/h.

        Returns:
            A new effect; levels are tilted about the first knot.

        """
        if not self.knots_s:
            return super().with_vector(vector)
        times = np.array(self.knots_s)
        more = (np.asarray(vector) - self.rate_per_hour) / _HOUR_S
        levels = np.reshape(self.levels, (-1, 6)) + np.outer(times - times[0], more)
        return type(self).through(times, levels)

    def _at(self, when: Instants) -> Array:
        session_s = when.session_s
        if not self.knots_s:
            return np.outer(session_s, np.asarray(self.rate_per_hour) / _HOUR_S)
        levels = np.reshape(self.levels, (-1, 6))
        return np.stack([np.interp(session_s, self.knots_s, axis) for axis in levels.T], axis=1)


def _floats(values: Sequence[float] | Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


# The tracker


@dataclass(frozen=True)
class TrackerDelay(Effect):
    """A tracker's stamp is `delay_s` later than its measurement."""

    name = "tracker_delay"
    fitted = (Fitted("delay_s", "s", 0.02, -0.3, 0.3),)

    delay_s: float = param(
        0.0, "a tracker's stamp is so much later than its measurement, s", -0.3, 0.3
    )

    @property
    def tracker_delay_s(self) -> float:
        """The delay itself: true time is the stamp minus it."""
        return self.delay_s


@dataclass(frozen=True)
class TrackerScale(Effect):
    """Positions of both markers in the tracker's frame are (1 + `gain`) times true."""

    name = "tracker_scale"
    fitted = (Fitted("gain", "", 0.003, -0.5, 1.0),)

    gain: float = param(
        0.0, "how much too long the tracker's lengths are, as a fraction", -0.5, 1.0
    )

    def seen(self, when: Instants, position: Array) -> Array:
        """Scale a marker's position about the tracker's origin.

        Args:
            when: not used.
            position: true (n, 3) in the tracker's frame, m.

        Returns:
            Reading (n, 3), m.

        """
        return position * (1.0 + self.gain)


_BAG = "push"


@dataclass(frozen=True)
class BaseShift(Effect):
    """The base's marker moves at `time_s` after the first stamp of `push`.

    The time is none of the fitted numbers: what is seen jumps with it.
    """

    name = "base_shift"
    has_limit = False
    fitted = (
        Fitted("translation_m", "m", 0.001, -1.0, 1.0, 3),
        Fitted("rotvec_rad", "rad", 0.003, -1.5, 1.5, 3),
    )

    translation_m: tuple[float, ...] = param(
        (0.0,) * 3, "how far the base's marker moves, along base_link, m", -1.0, 1.0
    )
    rotvec_rad: tuple[float, ...] = param(
        (0.0,) * 3, "how it turns about itself, a rotation vector along base_link, rad", -1.5, 1.5
    )
    time_s: float = param(0.0, "when it moves, since the first stamp of push, s", minimum=0.0)

    def in_session(self, starts: Mapping[str, float]) -> Self:
        """Return the effect with its time since the session's start.

        Args:
            starts: first stamp of each bag, by its name, s since the session's; `push` must be
                there.

        Returns:
            A new effect, for a driver that runs on.

        """
        return replace(self, time_s=self.time_s + starts[_BAG])

    def base_marker(self, when: Instants) -> Array | None:
        """Return the base marker's displacement.

        Args:
            when: times of the n samples; those since the bag's first stamp count.

        Returns:
            Translation and rotation vector (n, 6) in base_link, m and rad; None in other bags than
            `push`.

        """
        if when.bag not in ("", _BAG):
            return None
        return np.outer(when.bag_s >= self.time_s, [*self.translation_m, *self.rotvec_rad])
