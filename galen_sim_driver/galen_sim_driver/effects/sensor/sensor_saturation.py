"""An axis of the sensor clips (contract, section 6): nothing beyond +- limit comes out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_ros.parameters.param import param

from galen_sim_driver.effects.effect import Effect, Fitted, Instants, check_axis


@dataclass(frozen=True)
class SensorSaturation(Effect):
    """`axis` reads nothing beyond +- `limit`; 0 for none. What was clipped can't be told back."""

    name: ClassVar[str] = "sensor_saturation"
    fitted: ClassVar[tuple[Fitted, ...]] = (Fitted("limit", "", 5.0, 1e-4, 1e3),)
    order: ClassVar[int] = 5
    after_noise: ClassVar[bool] = True

    limit: float = param(
        0.0, "largest reading of an axis that clips, N or Nm; 0 for none", minimum=0.0
    )
    axis: str = param("fz", "the axis that clips: fx fy fz tx ty tz")

    def validate(self) -> None:
        """The axis is one."""
        check_axis(self.name, "axis", self.axis)

    def read(self, when: Instants, wrench: Array) -> Array:
        """The axis within its limit."""
        if self.limit <= 0.0:
            return wrench
        clipped = wrench.copy()
        axis = WRENCH_AXES.index(self.axis)
        clipped[:, axis] = np.clip(wrench[:, axis], -self.limit, self.limit)
        return clipped
