"""The stand of the base's marker moves once during `push` (contract, section 6).

The marker goes by `translation_m` and turns about its own origin by `rotvec_rad`, both along the
axes of base_link, and stays there. Arm and tracker stay where they are: only who takes the marker
for base_link sees everything move.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants

_BAG = "push"


@dataclass(frozen=True)
class BaseShift(Effect):
    """The base's marker moves at `time_s` after the first stamp of `push`.

    The time is none of the fitted numbers: what is seen jumps with it.
    """

    name: ClassVar[str] = "base_shift"
    fitted: ClassVar[tuple[Fitted, ...]] = (
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
        """The shift from its time on; the driver, which knows no bags, counts from its start."""
        if when.bag not in ("", _BAG):
            return None
        return np.outer(when.bag_s >= self.time_s, [*self.translation_m, *self.rotvec_rad])
