"""The reading drifts slowly (contract, section 6).

    b(t) = rate t                                     with t the time of the recording, or
    b(t) = piecewise linear through levels at knots   for a bias drift of any shape;

the rate is then the mean one, (last level - first level) over the time between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants
from galen_sim_driver.errors import ConfigError

_HOUR_S = 3600.0


@dataclass(frozen=True)
class SensorDrift(Effect):
    """A drift of `rate_per_hour`, or through `levels` (k, 6), row by row, at `knots_s` (k,)."""

    name: ClassVar[str] = "sensor_drift"
    fitted: ClassVar[tuple[Fitted, ...]] = (
        Fitted("rate_per_hour", "1/h", (1.0, 1.0, 1.0, 0.02, 0.02, 0.02), -1e3, 1e3, 6),
    )
    order: ClassVar[int] = 3
    beyond_contract: ClassVar[tuple[str, ...]] = ("knots_s", "levels")
    driver_names: ClassVar[Mapping[str, str]] = {"rate_per_hour": "sensor_drift_per_hour"}

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
        """Through levels (k, 6) at times knots_s (k,) of the recording; the rate is their mean."""
        times, values = np.asarray(knots_s, dtype=float), np.asarray(levels, dtype=float)
        rate = (values[-1] - values[0]) / (times[-1] - times[0]) * _HOUR_S
        return cls(_floats(rate), _floats(times), _floats(values.ravel()))

    @property
    def changes_nothing(self) -> bool:
        """No rate and no level."""
        return not any(self.rate_per_hour) and not any(self.levels)

    def validate(self) -> None:
        """Knots increase, and there are six levels at each."""
        if len(self.knots_s) == 1 or not np.all(np.diff(self.knots_s) > 0.0):
            raise ConfigError(f"{self.name}: knots_s must be two or more that increase, or none")
        if len(self.levels) != 6 * len(self.knots_s):
            raise ConfigError(
                f"{self.name}: levels has {len(self.levels)} numbers, but must have six for each "
                f"of {len(self.knots_s)} knots"
            )

    def with_vector(self, vector: Array) -> Self:
        """Another mean rate; a shape keeps what it has beside its mean."""
        if not self.knots_s:
            return super().with_vector(vector)
        times = np.array(self.knots_s)
        more = (np.asarray(vector) - self.rate_per_hour) / _HOUR_S
        levels = np.reshape(self.levels, (-1, 6)) + np.outer(times - times[0], more)
        return type(self).through(times, levels)

    def read(self, when: Instants, wrench: Array) -> Array:
        """The reading with the drift."""
        return wrench + self._at(when.session_s)

    def unread(self, when: Instants, reading: Array) -> Array:
        """The reading without it."""
        return reading - self._at(when.session_s)

    def _at(self, session_s: Array) -> Array:
        if not self.knots_s:
            return np.outer(session_s, np.asarray(self.rate_per_hour) / _HOUR_S)
        levels = np.reshape(self.levels, (-1, 6))
        return np.stack([np.interp(session_s, self.knots_s, axis) for axis in levels.T], axis=1)


def _floats(values: Sequence[float] | Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
