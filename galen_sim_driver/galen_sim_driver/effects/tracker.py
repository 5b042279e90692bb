"""Effects of the tracker (contract, section 6).

The scale is about the tracker's own origin, so that both markers move away from it; rotations stay.
After a registration of base_link from the tracker's readings only a scale about the mean of the
tool's positions remains.

The base's marker goes by `translation_m` and turns about its own origin by `rotvec_rad`, both along
the axes of base_link, once during `push`, and stays there; arm and tracker stay where they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_ros.parameters import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants


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
        return position * (1.0 + self.gain)


_BAG = "push"


@dataclass(frozen=True)
class BaseShift(Effect):
    """The base's marker moves at `time_s` after the first stamp of `push`.

    The time is none of the fitted numbers: what is seen jumps with it.
    """

    name = "base_shift"
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

    def base_marker(self, when: Instants) -> Array | None:
        if when.bag not in ("", _BAG):
            return None
        return np.outer(when.bag_s >= self.time_s, [*self.translation_m, *self.rotvec_rad])
