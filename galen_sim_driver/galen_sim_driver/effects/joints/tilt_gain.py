"""The tilt joint goes farther than it tells: true tilt = (1 + gain) reported (contract, 6).

With an offset of the zero as well: (1 + gain) reported + offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants

_TILT = 4


@dataclass(frozen=True)
class TiltGain(Effect):
    """true tilt = (1 + `gain`) reported."""

    name: ClassVar[str] = "tilt_gain"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("gain", "", 0.02, -0.5, 0.5),)

    gain: float = param(0.0, "true tilt over what the encoder tells, less 1", -0.5, 0.5)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """The tilt times 1 + gain."""
        true = joints.copy()
        true[:, _TILT] *= 1.0 + self.gain
        return true
